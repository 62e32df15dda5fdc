"""Rotation of a sampled pupil field by any angle, as in poppy."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch
from scipy.ndimage import spline_filter1d
from torch import Tensor

from pyklip_diffrender.optics.grid import PupilGrid
from pyklip_diffrender.optics.planes import Plane, Values, Wavefront

__all__ = ["FreeRotation", "SplineRotation"]


class SplineRotation:
    """Cubic-spline rotation of arrays: `scipy.ndimage.rotate` as a linear torch function.

    Parameters
    ----------
    angle : float
        Degrees, from the first axis of the array to the second, as scipy counts.
    shape : tuple of int
        Rows and columns, of the output as well.
    """

    def __init__(self, angle: float, shape: tuple[int, int]) -> None:
        self._filters = [
            torch.from_numpy(spline_filter1d(np.eye(n), order=3, axis=0)) for n in shape
        ]
        cosine, sine = math.cos(math.radians(angle)), math.sin(math.radians(angle))
        half = [(n - 1) / 2 for n in shape]
        y = (torch.arange(shape[0], dtype=torch.float64) - half[0])[:, None]
        x = (torch.arange(shape[1], dtype=torch.float64) - half[1])[None, :]
        from_row = cosine * y + sine * x + half[0]
        from_column = -sine * y + cosine * x + half[1]
        self._rows = self._taps(from_row, shape[0])
        self._columns = self._taps(from_column, shape[1])
        self._inside = (
            (from_row >= 0)
            & (from_row <= shape[0] - 1)
            & (from_column >= 0)
            & (from_column <= shape[1] - 1)
        )

    @staticmethod
    def _taps(position: Tensor, size: int) -> list[tuple[Tensor, Tensor]]:
        """Index and weight of the four spline coefficients around every position."""
        first = torch.floor(position)
        t = position - first
        weights = (
            (1 - t) ** 3 / 6,
            (3 * t**3 - 6 * t**2 + 4) / 6,
            (-3 * t**3 + 3 * t**2 + 3 * t + 1) / 6,
            t**3 / 6,
        )
        taps = []
        for k, weight in enumerate(weights):
            index = (first.to(torch.int64) + k - 1).abs()
            index = torch.where(index > size - 1, 2 * (size - 1) - index, index)
            taps.append((index.clamp(0, size - 1), weight))
        return taps

    def __call__(self, array: Tensor) -> Tensor:
        """Rotate (..., rows, columns), real or complex, with zeros outside the array."""
        kind = array.dtype
        real = torch.float32 if kind in (torch.float32, torch.complex64) else torch.float64
        device = array.device
        down, across = (matrix.to(device, kind) for matrix in self._filters)
        coefficients = down @ array @ across.T
        total = torch.zeros_like(coefficients)
        for rows, row_weight in self._rows:
            for columns, column_weight in self._columns:
                weight = (row_weight * column_weight * self._inside).to(device, real)
                total = total + coefficients[..., rows.to(device), columns.to(device)] * weight
        return total


class FreeRotation(Plane):
    """A rotation of the field in a pupil by any angle.

    Parameters
    ----------
    angle : float
        Degrees, counter-clockwise (from +x to +y), frame of the system.
    """

    def __init__(self, angle: float, npix: int, diameter: float, name: str) -> None:
        self.name = name
        self._full = PupilGrid.full(npix, diameter)
        self._rotation = SplineRotation(-angle, (npix, npix))

    def window(self, values: Values) -> PupilGrid:
        """The whole pupil."""
        return self._full

    def apply(self, wavefront: Wavefront, values: Values, onto: PupilGrid) -> Wavefront:
        """Rotate the field on the array of the pupil."""
        field = self._rotation(wavefront.grid.crop(wavefront.field, self._full))
        return replace(wavefront, field=self._full.crop(field, onto), grid=onto)
