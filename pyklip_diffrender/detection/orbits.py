"""Positions of candidates as programs that fit orbits read them."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
from astropy.table import QTable, Table

from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.io.files import replacing, require_new

__all__ = ["write_astrometry"]

_JD = 2400000.5


def _orbitize(table: QTable) -> Table:
    """Columns of orbitize!'s `read_file`: mas and degrees, objects numbered from 1.

    It takes the offsets of a row and leaves separation and position angle to the reader.
    """
    return Table(
        {
            "epoch": table["epoch_mjd"],
            "object": np.arange(1, len(table) + 1),
            "raoff": table["delta_ra"].to_value("mas"),
            "raoff_err": table["delta_ra_error"].to_value("mas"),
            "decoff": table["delta_dec"].to_value("mas"),
            "decoff_err": table["delta_dec_error"].to_value("mas"),
            "radec_corr": table["radec_corr"],
            "sep": table["separation"].to_value("mas"),
            "sep_err": table["separation_error"].to_value("mas"),
            "pa": table["position_angle"].to_value("deg"),
            "pa_err": table["position_angle_error"].to_value("deg"),
            "seppa_corr": table["seppa_corr"],
        }
    )


def _backtracks(table: QTable) -> Table:
    """Columns of backtracks, in its order; orbitize! reads them as well."""
    return Table(
        {
            "epoch": table["epoch_mjd"],
            "object": np.arange(1, len(table) + 1),
            "quant1": table["delta_ra"].to_value("mas"),
            "quant1_err": table["delta_ra_error"].to_value("mas"),
            "quant2": table["delta_dec"].to_value("mas"),
            "quant2_err": table["delta_dec_error"].to_value("mas"),
            "quant12_corr": table["radec_corr"],
            "quant_type": ["radec"] * len(table),
        }
    )


def _octofitter(table: QTable) -> Table:
    """Columns of Octofitter's relative astrometry: MJD and mas."""
    names = ("epoch", "object", "ra", "σ_ra", "dec", "σ_dec", "cor")
    plain = _backtracks(table)
    plain.remove_column("quant_type")
    plain.rename_columns(plain.colnames, list(names))
    return plain


def _orvara(table: QTable) -> Table:
    """Columns of orvara's relative astrometry: arcsec and degrees, companions from 0."""
    return Table(
        {
            "jd": np.asarray(table["epoch_mjd"]) + _JD,
            "sep": table["separation"].to_value("arcsec"),
            "sep_err": table["separation_error"].to_value("arcsec"),
            "pa": table["position_angle"].to_value("deg"),
            "pa_err": table["position_angle_error"].to_value("deg"),
            "corr": table["seppa_corr"],
            "companion": np.arange(len(table)),
        }
    )


_FORMATS: dict[str, tuple[Callable[[QTable], Table], str]] = {
    "orbitize": (_orbitize, "ascii.csv"),
    "backtracks": (_backtracks, "ascii.csv"),
    "octofitter": (_octofitter, "ascii.csv"),
    "orvara": (_orvara, "ascii.commented_header"),
}


def write_astrometry(
    table: QTable, path: str | os.PathLike[str], format: str, *, overwrite: bool = False
) -> Path:
    """Write the positions of candidates; see `Detection.write_astrometry`."""
    if format not in _FORMATS:
        raise IncompatibleSetupError(
            f"format: got {format!r}, expected one of {', '.join(_FORMATS)}"
        )
    missing = [
        what
        for column, what in (("delta_ra", "position angle"), ("epoch_mjd", "date"))
        if column not in table.colnames
    ]
    if missing:
        raise IncompatibleSetupError(
            f"the frames have no {' and no '.join(missing)}, which an orbit needs; their headers "
            "have them in ROLL_REF, and in EXPMID or DATE-BEG"
        )
    require_new([path], overwrite)
    convert, form = _FORMATS[format]
    plain = convert(table)
    for name in plain.colnames:
        if plain[name].dtype.kind == "f":
            plain[name].info.format = ".7f"
    with replacing(Path(path)) as temporary:
        plain.write(temporary, format=form, overwrite=True)
    return Path(path)
