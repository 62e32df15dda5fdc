"""Candidates in the form of spaceKLIP's table of sources."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import Table
from numpy.typing import NDArray

from pyklip_diffrender.detection import Detection

__all__ = ["source_table"]

_OTHER_FLUXES = ("FLUX_SI", "FLUX_SI_ERR", "FLUX_SI_ALT", "FLUX_SI_ALT_ERR")
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
    table = detection.candidates
    count = len(table)
    unknown = np.full(count, np.nan)

    def column(name: str) -> NDArray[Any]:
        """Values of a column, NaN where the frames do not allow it."""
        values = table[name] if name in table.colnames else unknown
        return np.asarray(getattr(values, "value", values))

    columns: dict[str, NDArray[Any]] = {
        "ID": np.arange(1, count + 1),
        "RA": column("delta_ra"),
        "RA_ERR": column("delta_ra_error"),
        "DEC": column("delta_dec"),
        "DEC_ERR": column("delta_dec_error"),
        "FLUX_JY": column("flux_density"),
        "FLUX_JY_ERR": column("flux_density_error"),
        **dict.fromkeys(_OTHER_FLUXES, unknown),
        "CON": column("contrast"),
        "CON_ERR": column("contrast_error"),
        "DELMAG": column("delta_mag"),
        "DELMAG_ERR": column("delta_mag_error"),
        **dict.fromkeys(_MAGNITUDES, unknown),
        "SNR": column("snr"),
        "LN(Z/Z0)": unknown,
        "TP_CORONMSK": unknown,
        "TP_COMSUBST": unknown,
        "FITSFILE": np.full(count, str(product)),
    }
    return Table(columns)
