"""The contrast curve."""

from __future__ import annotations

import math

import numpy as np
from astropy import units as u
from astropy.table import QTable
from numpy.typing import NDArray

from pyklip_diffrender.detection.error_factor import ErrorFactor

__all__ = ["contrast_table", "described"]

_SIGMAS = 5.0
"""S/N of a contrast curve."""

_COLUMNS = {
    "separation": (".3f", "from the star"),
    "contrast": (".2e", "median of the ring"),
    "delta_mag": (".2f", "magnitude difference of the median"),
    "lowest": (".2e", "of the ring"),
    "highest": (".2e", "of the ring"),
    "known_star": (".2e", "median if the image of the star were known"),
    "small_sample": (".2e", "median with the small-sample correction of measured errors"),
    "error_factor": (".2f", "by which errors were multiplied, included in all but known_star"),
    "flux_density": (".2e", "of the median, in the photometric calibration of the frames"),
}
"""Formats and descriptions of the columns."""


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
        Standard deviations for a known star.
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
        with the small-sample correction: where errors were scaled to the scatter of the S/N, noise
        follows Student's t, with as many degrees of freedom as positions told of the scatter, and
        exceeds this limit as rarely as Gaussian noise exceeds 5 sigma; the factor; if `star` is
        known, the flux density of the median.
    """
    rows = []
    corrections = factor.threshold_at(_SIGMAS, separations) / _SIGMAS
    for separation, error, photon_error, correction in zip(
        separations, errors, photon, corrections, strict=True
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
