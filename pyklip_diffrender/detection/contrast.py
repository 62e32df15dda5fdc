"""The contrast curve and its small-sample correction."""

from __future__ import annotations

import math

import numpy as np
from astropy import units as u
from astropy.table import QTable
from numpy.typing import NDArray
from scipy import stats

__all__ = ["contrast_table", "small_sample_factor"]

_SIGMAS = 5.0
"""S/N of a contrast curve."""


def small_sample_factor(
    separation: NDArray[np.float64], resolution: float, sigmas: float = 5.0
) -> NDArray[np.float64]:
    """Factor of a detection threshold when the noise is estimated from few resolution elements.

    D. Mawet et al., "Fundamental limitations of high contrast imaging set by small sample
    statistics", ApJ 792, 97 (2014), section 3.2. With n = 2 pi r / resolution elements, the false
    alarm probability of `sigmas` Gaussian standard deviations belongs to a value of Student's t
    with n - 2 degrees of freedom, times sqrt(1 + 1 / (n - 1)).

    Parameters
    ----------
    separation : ndarray
        In the unit of `resolution`.
    resolution : float
        Size of a resolution element, lambda/D.

    Returns
    -------
    ndarray
        Threshold over `sigmas`; inf for fewer than three elements.
    """
    elements = np.floor(2 * math.pi * np.asarray(separation, dtype=float) / resolution)
    freedom = np.maximum(elements - 2, 1)
    threshold = stats.t.isf(stats.norm.sf(sigmas), freedom) * np.sqrt(
        1 + 1 / np.maximum(elements - 1, 1)
    )
    return np.where(elements >= 3, threshold / sigmas, np.inf)


def contrast_table(
    separations: NDArray[np.float64],
    errors: list[NDArray[np.float64]],
    photon: list[NDArray[np.float64]],
    resolution: float,
) -> QTable:
    """Make the table of a 5-sigma contrast curve.

    Parameters
    ----------
    separations : ndarray
        arcsec.
    errors : list of ndarray
        Standard deviations of contrasts at the pixels of each ring.
    photon : list of ndarray
        The same for a known star.
    resolution : float
        lambda/D, arcsec.

    Returns
    -------
    QTable
        Separation; median, lowest and highest contrast of the ring; the median for a known star
        (the photon limit of a matched filter); the median with the small-sample correction, which
        applies where errors were scaled to the measured scatter.
    """
    rows = []
    factor = small_sample_factor(separations, resolution, _SIGMAS)
    for separation, error, photon_error, correction in zip(
        separations, errors, photon, factor, strict=True
    ):
        if not len(error):
            continue
        limit = _SIGMAS * np.asarray(error)
        middle = float(np.median(limit))
        bound = _SIGMAS * float(np.median(photon_error))
        rows.append((separation, middle, limit.min(), limit.max(), bound, middle * correction))
    names = ("separation", "contrast", "lowest", "highest", "known_star", "small_sample")
    table = QTable(rows=rows, names=names, dtype=(float,) * len(names))
    table["separation"].unit = u.arcsec
    table["separation"] = u.Quantity(table["separation"])
    table.meta = {"sigmas": _SIGMAS, "resolution_arcsec": resolution}
    return table
