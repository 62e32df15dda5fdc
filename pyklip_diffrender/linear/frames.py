"""The unknowns of a linear model, and the part that one frame has in it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

__all__ = ["FrameRows", "LinearFrame", "Unknown", "pixel_pieces"]

_PIXELS = 1024
"""Number of pixels that are processed at a time, where there is a number for every unknown."""


class Unknown(NamedTuple):
    """One unknown of a fit.

    Attributes
    ----------
    name : str
        A parameter of the parameter table, or "companions", "amplitude", "modes" or "drift".
    component : int
        Index within that parameter.
    frame : int
        The frame whose own value it is, or the block of drift; -1 if all frames share it.
    """

    name: str
    component: int
    frame: int = -1

    def __str__(self) -> str:
        suffix = "" if self.frame < 0 else f" of frame {self.frame}"
        return f"{self.name}[{self.component}]{suffix}"


@dataclass(frozen=True)
class FrameRows:
    """The unknowns of a fit that the rows of one of its frames belong to.

    Attributes
    ----------
    rows : Tensor, (rows,), int64
        Index of the unknown that each row belongs to.
    drift : Tensor, (blocks, some), int64
        Indices of the unknowns by which the leading wavefront modes of this frame differ from
        those that all frames share. One block may be the frame's own, and another one that of its
        exposure sequence.
    first_mode : int
        Index of the first wavefront mode among the rows.
    """

    rows: Tensor
    drift: Tensor
    first_mode: int

    def onto_unknowns(self, on_rows: Tensor, size: int) -> Tensor:
        """Sum values by row, (rows, k), to values by unknown, (size, k)."""
        total = torch.zeros(size, *on_rows.shape[1:], dtype=on_rows.dtype)
        total.index_add_(0, self.rows, on_rows)
        leading = on_rows[self.first_mode : self.first_mode + self.drift.shape[-1]]
        for block in self.drift:
            total.index_add_(0, block, leading)
        return total

    def of_unknowns(self, values: Tensor) -> Tensor:
        """Values by row from values by unknown; the adjoint of `onto_unknowns`."""
        rows = values[self.rows]
        for block in self.drift:
            rows[self.first_mode : self.first_mode + len(block)] += values[block]
        return rows


@dataclass(frozen=True)
class LinearFrame(FrameRows):
    """One frame's part of a linear model.

    Attributes
    ----------
    residual : Tensor, (ny, nx), float64
        Data minus prediction where the model is linearised.
    weight : Tensor, (ny, nx), float64
        1 / standard deviation; 0 for masked pixels.
    jacobian : Tensor, (rows, ny, nx), float32
        Derivatives of the pixels with respect to the unknowns, in the data's unit.
    common : Tensor, (ny, nx), float64
        c of the pattern that the frames share, see `linear.noise`, in the data's unit; 0 without
        one.
    """

    residual: Tensor
    weight: Tensor
    jacobian: Tensor
    common: Tensor

    def image(self, values: Tensor) -> Tensor:
        """Change of the image, (..., ny, nx), for changes of the unknowns, (size, ...)."""
        on_rows = self.of_unknowns(values).movedim(0, -1)
        flat = self.jacobian.flatten(1)
        parts = [on_rows @ flat[:, piece].double() for piece in pixel_pieces(flat.shape[1])]
        return torch.cat(parts, dim=-1).unflatten(-1, self.jacobian.shape[1:])

    def pulled(self, images: Tensor) -> Tensor:
        """Products of the derivatives with images, (k, ny, nx), by row: (rows, k).

        They are computed in the precision of the images. The rounding errors of single precision
        exceed the noise where a companion's light is 1e5 standard deviations.
        """
        flat, columns = self.jacobian.flatten(1), images.flatten(1).T
        if images.dtype == flat.dtype:
            return flat @ columns
        total = torch.zeros(len(flat), columns.shape[1], dtype=images.dtype)
        for piece in pixel_pieces(len(columns)):
            total += flat[:, piece].to(images.dtype) @ columns[piece]
        return total


def pixel_pieces(pixels: int) -> list[slice]:
    """Parts of an image of which arrays with all unknowns are small."""
    return [slice(start, start + _PIXELS) for start in range(0, pixels, _PIXELS)]
