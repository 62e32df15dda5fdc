"""Units, files and headers: everything that crosses the package's border."""

from __future__ import annotations

from pyklip_diffrender.io.files import embedded_table, open_fits, replacing, sha256, write_fits
from pyklip_diffrender.io.headers import same_name, sensing_date
from pyklip_diffrender.io.html_repr import html_summary
from pyklip_diffrender.io.progress import ProgressBar, stage
from pyklip_diffrender.io.units import (
    ARCSEC,
    native_float64,
    require_finite,
    require_shape,
    to_arcsec,
    to_metres,
    to_number,
    to_pair,
    to_unit,
)

__all__ = [
    "ARCSEC",
    "ProgressBar",
    "embedded_table",
    "html_summary",
    "native_float64",
    "open_fits",
    "replacing",
    "require_finite",
    "require_shape",
    "same_name",
    "sensing_date",
    "sha256",
    "stage",
    "to_arcsec",
    "to_metres",
    "to_number",
    "to_pair",
    "to_unit",
    "write_fits",
]
