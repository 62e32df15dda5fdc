"""Contrast that a planet needs to be seen, in closed form."""

from __future__ import annotations

import math

import numpy as np
from astropy import units as u
from astropy.table import QTable
from numpy.typing import NDArray
from scipy import stats

__all__ = ["contrast_table", "ring_pixels", "small_sample_factor"]

Image = NDArray[np.float64]


def small_sample_factor(
    separation: NDArray[np.float64], resolution: float, sigmas: float = 5.0
) -> NDArray[np.float64]:
    """By how much a threshold must grow when the noise was estimated from few elements.

    D. Mawet et al., "Fundamental limitations of high contrast imaging set by small sample
    statistics", ApJ 792, 97 (2014), section 3.2: with n = 2 pi r / resolution elements the false
    alarm probability of `sigmas` Gaussian standard deviations is reached at a t value with n - 2
    degrees of freedom, times sqrt(1 + 1 / (n - 1)).

    Parameters
    ----------
    separation : ndarray
        In the unit of `resolution`.
    resolution : float
        Size of a resolution element, lambda/D.

    Returns
    -------
    ndarray
        Threshold over `sigmas`; inf where fewer than three elements fit.
    """
    elements = np.floor(2 * math.pi * np.asarray(separation, dtype=float) / resolution)
    freedom = np.maximum(elements - 2, 1)
    threshold = stats.t.isf(stats.norm.sf(sigmas), freedom) * np.sqrt(
        1 + 1 / np.maximum(elements - 1, 1)
    )
    return np.where(elements >= 3, threshold / sigmas, np.inf)


def ring_pixels(
    grid: Image, separations: NDArray[np.float64], most: int
) -> list[tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """Pixels at some separations, evenly spread in angle.

    Parameters
    ----------
    grid : ndarray, (ny, nx, 2)
        x, y of the pixels from the star, arcsec.
    separations : ndarray
        arcsec.
    most : int
        Pixels per separation, at most.

    Returns
    -------
    list of (rows, columns)
        Empty where the ring is not on the detector.
    """
    radius = np.hypot(grid[..., 0], grid[..., 1])
    angle = np.arctan2(grid[..., 0], grid[..., 1])
    pixel = float(np.abs(np.diff(grid[:, :, 0], axis=1)).mean())
    found = []
    for separation in separations:
        rows, columns = np.nonzero(np.abs(radius - separation) <= pixel / 2)
        order = np.argsort(angle[rows, columns])
        if len(order) > most:
            order = order[np.linspace(0, len(order), most, endpoint=False).astype(int)]
        found.append((rows[order], columns[order]))
    return found


def contrast_table(
    separations: NDArray[np.float64],
    errors: list[NDArray[np.float64]],
    photon: list[NDArray[np.float64]],
    resolution: float,
    sigmas: float = 5.0,
) -> QTable:
    """The contrast curve.

    Parameters
    ----------
    separations : ndarray
        arcsec.
    errors : list of ndarray
        Standard deviations of a contrast at the pixels of each ring.
    photon : list of ndarray
        The same if the star were known.
    resolution : float
        lambda/D, arcsec.
    sigmas : float
        Of a detection.

    Returns
    -------
    QTable
        Separation; median, lowest and highest contrast of the ring; the median for a known star
        (the matched filter's photon limit); the median with the small-sample correction, which
        applies where the noise was scaled to the scatter that was found.
    """
    rows = []
    factor = small_sample_factor(separations, resolution, sigmas)
    for separation, error, known, few in zip(separations, errors, photon, factor, strict=True):
        if not len(error):
            continue
        limit = sigmas * np.asarray(error)
        middle = float(np.median(limit))
        bound = sigmas * float(np.median(known))
        rows.append((separation, middle, limit.min(), limit.max(), bound, middle * few))
    names = ("separation", "contrast", "lowest", "highest", "known_star", "small_sample")
    table = QTable(rows=rows, names=names, dtype=(float,) * len(names))
    table["separation"].unit = u.arcsec
    table["separation"] = u.Quantity(table["separation"])
    table.meta = {"sigmas": sigmas, "resolution_arcsec": resolution}
    return table
