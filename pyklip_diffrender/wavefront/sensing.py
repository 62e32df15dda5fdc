"""The aberrations that a wavefront-sensing map contains besides the telescope's, by stpsf's models.

stpsf and its data (``STPSF_PATH``) are optional, and imported when they are first used.
"""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import zoom

from pyklip_diffrender.errors import CorruptFileError, IncompatibleSetupError
from pyklip_diffrender.instrument.jwst import jwst_pupil
from pyklip_diffrender.io.files import open_fits
from pyklip_diffrender.io.units import native_float64
from pyklip_diffrender.wavefront.map_files import opd_to_hdus

__all__ = ["TO_METRES", "finest_pupil", "pupil_samples", "sensing_terms", "stpsf_module"]

Array = NDArray[np.float64]

_TARGET_PHASES = {
    "NRCA3_FP1": "wss_target_phase_fp1.fits",
    "NRCA1_FP6": "wss_target_phase_fp6.fits",
}
TO_METRES = {"um": 1e-6, "micron": 1e-6, "microns": 1e-6, "m": 1.0, "meter": 1.0, "nm": 1e-9}
"""Units of maps, as the files spell them, in metres."""


def stpsf_module(purpose: str) -> Any:
    """The module stpsf, with its submodule for MAST."""
    try:
        import stpsf
        import stpsf.mast_wss
    except ImportError as error:
        raise IncompatibleSetupError(
            f"stpsf is needed {purpose} and is not installed ({error}): python -m pip install stpsf"
        ) from error
    return stpsf


def _data_folder() -> Path | None:
    folder = os.environ.get("STPSF_PATH") or os.environ.get("WEBBPSF_PATH")
    return Path(folder) if folder else None


def finest_pupil() -> int:
    """Samples across the finest pupil in stpsf's data; 1024 without such data."""
    folder = _data_folder()
    names = [] if folder is None else [path.name for path in folder.glob("jwst_pupil_RevW_npix*")]
    matches = [re.search(r"npix(\d+)\.fits", name) for name in names]
    return max((int(match[1]) for match in matches if match), default=1024)


def pupil_samples(npix: int, required: bool) -> Array:
    """1 inside the pupil: that of stpsf's data if available, otherwise of the embedded outlines."""
    folder = _data_folder()
    for ending in ("fits.gz", "fits"):
        path = None if folder is None else folder / f"jwst_pupil_RevW_npix{npix}.{ending}"
        if path is not None and path.is_file():
            with open_fits(path) as hdus:
                return native_float64(hdus[0].data != 0)
    if required:
        raise CorruptFileError(
            f"jwst_pupil_RevW_npix{npix}.fits.gz is not in STPSF_PATH ({folder}). Set it to the "
            "complete stpsf data files, choose another npix, or pass backout_si_wfe=False"
        )
    return native_float64(jwst_pupil(npix) > 0)


def sensing_terms(aperture: str, opd: Array, npix: int, name: str) -> tuple[Array, str]:
    """Sum of the camera's aberration and the telescope's field dependence (m), and its source."""
    if not aperture:
        raise CorruptFileError(
            f"{name}: no APERNAME in the primary header, so the sensing camera is not known. Pass "
            "backout_si_wfe=False to keep the sum"
        )
    folder = _data_folder()
    if folder is None:
        raise CorruptFileError(
            "STPSF_PATH is not set. Set it to the complete stpsf data files, or pass "
            "backout_si_wfe=False"
        )
    stpsf = stpsf_module("to subtract the sensing terms")
    try:
        instrument = stpsf.instrument(aperture[:3])
        instrument.pupil = str(next(folder.glob(f"jwst_pupil_RevW_npix{npix}.fits*")))
        instrument.pupilopd = opd_to_hdus(opd)
        instrument.set_position_from_aperture_name(aperture)
        if aperture in _TARGET_PHASES:
            source = _TARGET_PHASES[aperture]
            with open_fits(folder / "NIRCam" / "OPD" / source) as hdus:
                scale = TO_METRES[str(hdus[0].header.get("BUNIT", "m")).strip().lower()]
                si_wfe = native_float64(hdus[0].data) * scale
        else:
            source = "Zernikes of the internal aberrations"
            si_wfe = native_float64(instrument.get_wfe("si"))
        ote_wfe = native_float64(instrument.get_wfe("ote_field_dep"))
    except (RuntimeError, FileNotFoundError, StopIteration, ValueError, KeyError) as error:
        raise CorruptFileError(
            f"the models of stpsf for {aperture!r} could not be read from {folder} ({error}). "
            "STPSF_PATH must hold the complete stpsf data files"
        ) from error
    if len(si_wfe) != npix:
        si_wfe = native_float64(zoom(si_wfe, npix / len(si_wfe)))
    return si_wfe + ote_wfe, source
