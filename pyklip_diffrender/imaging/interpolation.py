"""Interpolation of an image at many places, as a sparse matrix."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

__all__ = ["interpolation_matrix"]

_REACH = 3
"""Pixels to each side that Lanczos' kernel has."""


def interpolation_matrix(places: NDArray[np.float64], shape: tuple[int, int]) -> sparse.csr_matrix:
    """Make the matrix that interpolates an image at places between its pixels (Lanczos, 3 pixels).

    Parameters
    ----------
    places : ndarray, (n, 2)
        x, y, 0-indexed pixels of the image.
    shape : tuple of int
        (ny, nx) of the image, which is zero beyond its edges.

    Returns
    -------
    csr_matrix, (n, ny * nx)
    """
    ny, nx = shape
    steps = np.arange(1 - _REACH, 1 + _REACH)
    first = np.floor(places).astype(np.int64)
    columns, rows = (first[:, k, None] + steps for k in (0, 1))
    across, up = (_lanczos(places[:, k, None] - pixels) for k, pixels in ((0, columns), (1, rows)))
    weights = up[:, :, None] * across[:, None, :]
    inside = ((rows >= 0) & (rows < ny))[:, :, None] & ((columns >= 0) & (columns < nx))[:, None]
    pixels = rows[:, :, None] * nx + columns[:, None]
    point = np.broadcast_to(np.arange(len(places))[:, None, None], weights.shape)
    entries = weights[inside], (point[inside], pixels[inside])
    return sparse.csr_matrix(entries, shape=(len(places), ny * nx))


def _lanczos(distance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Weights of pixels at distances, (n, pixels), with a sum of 1."""
    weights = np.sinc(distance) * np.sinc(distance / _REACH)
    return np.asarray(weights / weights.sum(axis=1, keepdims=True))
