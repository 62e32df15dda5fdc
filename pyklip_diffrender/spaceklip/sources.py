"""Candidates in the form of spaceKLIP's table of sources."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import Table
from numpy.typing import NDArray

from pyklip_diffrender.detection import Detection

__all__ = ["source_table"]

_FLUXES = ("FLUX_JY", "FLUX_JY_ERR", "FLUX_SI", "FLUX_SI_ERR", "FLUX_SI_ALT", "FLUX_SI_ALT_ERR")
_MAGNITUDES = ("APPMAG", "APPMAG_ERR", "MSTAR", "MSTAR_ERR")


def source_table(detection: Detection, product: Path) -> Table:
    """Make the table of a product's sources, highest S/N first.

    Parameters
    ----------
    detection : Detection
    product : path
        File that the sources are in.

    Returns
    -------
    Table
        Columns as in the tables that spaceKLIP's `extract_companions` makes: offsets in arcsec,
        contrasts to the star. What depends on the star's magnitude is NaN, and so are the
        throughputs, which the contrasts include.
    """
    found = detection.table
    count = len(found)
    unknown = np.full(count, np.nan)
    right_ascension, declination = _sky_errors(detection)
    columns: dict[str, NDArray[Any]] = {
        "ID": np.arange(1, count + 1),
        "RA": found["delta_ra"].value,
        "RA_ERR": right_ascension,
        "DEC": found["delta_dec"].value,
        "DEC_ERR": declination,
        **dict.fromkeys(_FLUXES, unknown),
        "CON": np.asarray(found["contrast"]),
        "CON_ERR": np.asarray(found["contrast_error"]),
        "DELMAG": found["delta_mag"].value,
        "DELMAG_ERR": found["delta_mag_error"].value,
        **dict.fromkeys(_MAGNITUDES, unknown),
        "SNR": np.asarray(found["snr"]),
        "LN(Z/Z0)": unknown,
        "TP_CORONMSK": unknown,
        "TP_COMSUBST": unknown,
        "FITSFILE": np.full(count, str(product)),
    }
    return Table(columns)


def _sky_errors(detection: Detection) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Errors of right ascension and declination in the order of the table, arcsec."""
    candidates, count = detection.candidates, len(detection.candidates)
    covariance = candidates.covariance.numpy().reshape(3, count, 3, count)
    places = detection.scatter**2 * np.einsum("akbk->kab", covariance)[:, 1:, 1:]
    cosine, sine = (f(math.radians(detection.north)) for f in (math.cos, math.sin))
    # x is towards the west where +y is north.
    axes = np.array([[-cosine, sine], [sine, cosine]])
    variances = np.einsum("ia,kab,ib->ik", axes, places, axes)
    snr = candidates.contrasts.numpy() / candidates.errors.numpy().reshape(-1, 3)[:, 0]
    errors = np.sqrt(variances)[:, np.argsort(-snr)]
    return errors[0], errors[1]
