"""Boxes around the star: the part of a frame that is fitted, and where it belongs in the frame."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pyklip_diffrender.errors import NoValidPixelsError
from pyklip_diffrender.scene.observation import Observation

__all__ = ["Window", "extent"]


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
        """The box whose middle is within half a pixel of `center`, [x, y]."""
        ny, nx = shape
        return cls(round(center[1] - (ny - 1) / 2), round(center[0] - (nx - 1) / 2), shape)

    def __contains__(self, other: Window) -> bool:
        (ny, nx), (other_ny, other_nx) = self.shape, other.shape
        return (
            self.y <= other.y
            and self.x <= other.x
            and self.y + ny >= other.y + other_ny
            and self.x + nx >= other.x + other_nx
        )

    def _overlap(self, frame: tuple[int, ...]) -> tuple[Any, Any]:
        """Slices of the overlap of box and frame, in the frame and in the box."""
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

    def of(self, observation: Observation) -> Observation:
        """The part of an observation inside the box.

        Raises
        ------
        NoValidPixelsError
            If a frame has no valid pixel there.
        """
        valid = self.cut(observation.valid, False)
        if not np.any(valid, axis=(1, 2)).all():
            raise NoValidPixelsError(
                f"{observation.name}: no valid pixel within {self.shape[1]} x {self.shape[0]} "
                "pixels of the star. Check the star centre in the header, or fit a larger field "
                "with fit_pixels"
            )
        origin = observation.first_pixel
        return dataclasses.replace(
            observation,
            data=self.cut(observation.data, 0.0),
            error=self.cut(observation.error, 1.0),
            valid=valid,
            center=observation.center - np.array([self.x, self.y]),
            first_pixel=None if origin is None else (origin[0] + self.x, origin[1] + self.y),
        )


def extent(observation: Observation) -> Window:
    """The box that holds all valid pixels; frames may be padded with NaN."""
    _, rows, columns = np.nonzero(observation.valid)
    return Window(
        int(rows.min()), int(columns.min()), (int(np.ptp(rows)) + 1, int(np.ptp(columns)) + 1)
    )
