"""The contrast curve and its small-sample correction."""

from __future__ import annotations

import math

import numpy as np
from astropy import units as u
from astropy.table import QTable
from numpy.typing import NDArray
from scipy import stats

from pyklip_diffrender.detection.error_factor import ErrorFactor

__all__ = ["contrast_table", "described", "small_sample_factor"]

_SIGMAS = 5.0
"""S/N of a contrast curve."""

_COLUMNS = {
    "separation": (".3f", "from the star"),
    "contrast": (".2e", "median of the ring"),
    "delta_mag": (".2f", "magnitude difference of the median"),
    "lowest": (".2e", "of the ring"),
    "highest": (".2e", "of the ring"),
    "known_star": (".2e", "median if the image of the star were known"),
    "small_sample": (".2e", "median with the small-sample correction"),
    "error_factor": (".2f", "by which errors were multiplied, included in all but known_star"),
    "flux_density": (".2e", "of the median, in the photometric calibration of the frames"),
}
"""Formats and descriptions of the columns."""


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
    factor: ErrorFactor,
    star: float | None = None,
) -> QTable:
    """Make the table of a 5-sigma contrast curve.

    Parameters
    ----------
    separations : ndarray
        arcsec.
    errors : list of ndarray
        Standard deviations of contrasts at the pixels of each ring, multiplied by the factor.
    photon : list of ndarray
        The same for a known star.
    resolution : float
        lambda/D, arcsec.
    factor : ErrorFactor
    star : float, optional
        Flux density of the star, Jy.

    Returns
    -------
    QTable
        Separation; median contrast of the ring and its magnitude difference; lowest and highest
        contrast; the median for a known star (the photon limit of a matched filter); the median
        with the small-sample correction, which applies where errors were scaled to the measured
        scatter; the factor; if `star` is known, the flux density of the median.
    """
    rows = []
    small_sample = small_sample_factor(separations, resolution, _SIGMAS)
    for separation, error, photon_error, correction in zip(
        separations, errors, photon, small_sample, strict=True
    ):
        if not len(error):
            continue
        limit = _SIGMAS * np.asarray(error)
        middle = float(np.median(limit))
        bound = _SIGMAS * float(np.median(photon_error))
        magnitude = -2.5 * math.log10(middle)
        rows.append(
            (separation, middle, magnitude, limit.min(), limit.max(), bound, middle * correction)
        )
    names = [name for name in _COLUMNS if name not in ("error_factor", "flux_density")]
    table = QTable(rows=rows, names=names, dtype=(float,) * len(names))
    for name, unit in (("separation", u.arcsec), ("delta_mag", u.mag)):
        table[name] = np.asarray(table[name]) * unit
    table["error_factor"] = factor.at(table["separation"].value)
    if star is not None:
        table["flux_density"] = star * np.asarray(table["contrast"]) * u.Jy
    table.meta = {"sigmas": _SIGMAS, "resolution_arcsec": resolution}
    return described(table)


def described(table: QTable) -> QTable:
    """Give the columns of a contrast curve their formats and descriptions."""
    for name in table.colnames:
        table[name].info.format, table[name].info.description = _COLUMNS[name]
    return table
