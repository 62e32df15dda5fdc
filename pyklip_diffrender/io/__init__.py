"""Units, files and headers: everything that crosses the package's border."""

from __future__ import annotations

from pyklip_diffrender.io.files import open_fits, replacing, sha256, write_fits
from pyklip_diffrender.io.headers import sensing_date
from pyklip_diffrender.io.progress import ProgressBar, stage
from pyklip_diffrender.io.units import ARCSEC, native_float64, require_finite, to_metres, to_unit

__all__ = [
    "ARCSEC",
    "ProgressBar",
    "native_float64",
    "open_fits",
    "replacing",
    "require_finite",
    "sensing_date",
    "sha256",
    "stage",
    "to_metres",
    "to_unit",
    "write_fits",
]
