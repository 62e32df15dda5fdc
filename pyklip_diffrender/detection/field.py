"""The field of view of a detection: where pixels are, relative to the star."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.io.units import require_finite, to_arcsec

__all__ = [
    "curve_separations",
    "far_from",
    "pixel_width",
    "pixels_of",
    "reaching",
    "require_inside",
    "ring_pixels",
    "separation_of",
]

Image = NDArray[np.float64]


def separation_of(grid: Image) -> Image:
    """Separation of pixels from the star, (ny, nx), from their x, y, (ny, nx, 2)."""
    return np.asarray(np.hypot(grid[..., 0], grid[..., 1]))


def far_from(grid: Image, offsets: Tensor | Image, distance: float) -> NDArray[np.bool_]:
    """Pixels that are at least `distance` from all positions (k, 2), (ny, nx)."""
    far = np.ones(grid.shape[:2], dtype=bool)
    for offset in np.asarray(offsets):
        far &= separation_of(grid - offset) >= distance
    return far


def reaching(grid: Image, inner: float) -> NDArray[np.bool_]:
    """Pixels that reach beyond a separation, arcsec, though their centre may be within it.

    A source beyond it has its maximum in one of them.
    """
    return np.asarray(separation_of(grid) >= inner - pixel_width(grid) / math.sqrt(2))


def pixel_width(grid: Image) -> float:
    """Mean width of a pixel along x, arcsec."""
    return float(np.abs(np.diff(grid[:, :, 0], axis=1)).mean())


def pixels_of(grid: Image, offsets: Image) -> Image:
    """Columns and rows, (..., 2), of positions x, y from the star on a regular grid."""
    origin = grid[0, 0]
    steps = np.stack([grid[0, 1] - origin, grid[1, 0] - origin], axis=1)
    return np.asarray((offsets - origin) @ np.linalg.inv(steps).T)


def require_inside(offsets: Image, grid: Image) -> None:
    """Raise an exception for positions (k, 2) outside the field.

    Raises
    ------
    IncompatibleSetupError
    NonFiniteError
    """
    require_finite(offsets, "offsets")
    # Pixels have an extent; half a diagonal beyond their centres is still on the detector.
    pixel = np.hypot(*(grid[1, 1] - grid[0, 0])) if min(grid.shape[:2]) > 1 else 0.0
    reach = separation_of(grid).max() + pixel / 2
    distance = separation_of(offsets)
    if (distance > reach).any():
        x, y = offsets[np.argmax(distance)]
        raise IncompatibleSetupError(
            f"offsets: got ({x:.4g}, {y:.4g}) arcsec, {distance.max():.4g} arcsec from the star; "
            f"the corners of the field are within {reach:.3g} arcsec. Give x and y from the star "
            "in arcsec, or with their unit, such as [[-485, 353]] * u.mas"
        )


def curve_separations(grid: Image, separations: ArrayLike | None) -> Image:
    """Separations of a contrast curve, arcsec; default every 0.1 from 0.2 to the nearest edge.

    Raises
    ------
    IncompatibleSetupError
        For a separation that is not positive.
    """
    if separations is None:
        x, y = np.abs(grid[..., 0]), np.abs(grid[..., 1])
        edge = min(x[:, 0].min(), x[:, -1].min(), y[0].min(), y[-1].min())
        return np.arange(0.2, edge + 1e-9, 0.1)
    values = np.atleast_1d(to_arcsec(separations, "separations"))
    if not (values > 0).all():
        raise IncompatibleSetupError(
            f"separations: got {values.tolist()} arcsec, expected positive numbers"
        )
    return values


def ring_pixels(
    grid: Image, separations: Image, most: int
) -> list[tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """Pixels at several separations, evenly spread in angle.

    Parameters
    ----------
    grid : ndarray, (ny, nx, 2)
        x, y of the pixels from the star, arcsec.
    separations : ndarray
        arcsec.
    most : int
        Largest number of pixels per separation.

    Returns
    -------
    list of (rows, columns)
        Empty where the ring is not on the detector.
    """
    radius = separation_of(grid)
    angle = np.arctan2(grid[..., 0], grid[..., 1])
    half_width = pixel_width(grid) / 2
    rings = []
    for separation in separations:
        rows, columns = np.nonzero(np.abs(radius - separation) <= half_width)
        order = np.argsort(angle[rows, columns])
        if len(order) > most:
            order = order[np.linspace(0, len(order), most, endpoint=False).astype(int)]
        rings.append((rows[order], columns[order]))
    return rings
