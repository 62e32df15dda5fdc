"""Boxes of pixels about the star: cutting them out of frames and putting them back."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["Window"]


@dataclass(frozen=True)
class Window:
    """A box in frames that have their star in one place; it may reach beyond their edges.

    Attributes
    ----------
    y, x : int
        The box's first row and column in the frame.
    shape : tuple of int
        (ny, nx) of the box.
    """

    y: int
    x: int
    shape: tuple[int, int]

    @classmethod
    def about(cls, center: NDArray[np.float64], shape: tuple[int, int]) -> Window:
        """Return the box whose middle is within half a pixel of `center`, [x, y]."""
        ny, nx = shape
        return cls(round(center[1] - (ny - 1) / 2), round(center[0] - (nx - 1) / 2), shape)

    @classmethod
    def holding(cls, valid: NDArray[np.bool_]) -> Window:
        """Return the smallest box that holds all valid pixels of frames, (n, ny, nx)."""
        _, rows, columns = np.nonzero(valid)
        shape = (int(np.ptp(rows)) + 1, int(np.ptp(columns)) + 1)
        return cls(int(rows.min()), int(columns.min()), shape)

    def __contains__(self, other: Window) -> bool:
        (ny, nx), (other_ny, other_nx) = self.shape, other.shape
        return (
            self.y <= other.y
            and self.x <= other.x
            and self.y + ny >= other.y + other_ny
            and self.x + nx >= other.x + other_nx
        )

    def _overlap(self, frame: tuple[int, ...]) -> tuple[Any, Any]:
        """Return the slices of the overlap of box and frame, in the frame and in the box."""
        y0, x0 = max(self.y, 0), max(self.x, 0)
        y1 = max(min(self.y + self.shape[0], frame[0]), y0)
        x1 = max(min(self.x + self.shape[1], frame[1]), x0)
        return np.s_[..., y0:y1, x0:x1], np.s_[
            ..., y0 - self.y : y1 - self.y, x0 - self.x : x1 - self.x
        ]

    def cut(self, cube: NDArray[Any], fill: Any) -> NDArray[Any]:
        """Cut the box out of (n, Ny, Nx): (n, ny, nx), with `fill` outside the frame."""
        boxes = np.full((len(cube), *self.shape), fill, dtype=cube.dtype)
        in_frame, in_box = self._overlap(cube.shape[1:])
        boxes[in_box] = cube[in_frame]
        return boxes

    def paste(self, box: NDArray[np.float64], frame: tuple[int, int]) -> NDArray[np.float64]:
        """Put a box (ny, nx) back into a frame (Ny, Nx) of NaN."""
        out = np.full(frame, np.nan)
        in_frame, in_box = self._overlap(frame)
        out[in_frame] = box[in_box]
        return out
