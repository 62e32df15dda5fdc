"""Wavefront-sensing maps (WSS) as MAST archives them, turned into maps of the telescope.

The steps are those of stpsf's `load_wss_opd`: fill the gaps, interpolate, convert microns, mask,
and take out what is not the telescope's common wavefront: the internal aberration of the sensing
camera and the telescope's field dependence, both at the sensing field point.
"""

from __future__ import annotations

import logging
import os
import re
import warnings
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits
from astropy.time import Time
from numpy.typing import NDArray
from scipy.interpolate import RectBivariateSpline
from scipy.ndimage import zoom

from pyklip_diffrender.bridges.maps import check_opd, opd_to_hdus
from pyklip_diffrender.errors import (
    CorruptFileError,
    DiffrenderWarning,
    IncompatibleSetupError,
    MissingOPDError,
)
from pyklip_diffrender.instrument.jwst import jwst_pupil
from pyklip_diffrender.io.files import open_fits, sha256
from pyklip_diffrender.io.units import native_float64, require_shape
from pyklip_diffrender.optics.grid import JWST_DIAMETER

__all__ = ["WSSMap", "interpolate_wss", "load_wss_opd", "load_wss_opd_by_date"]

Array = NDArray[np.float64]

_LOG = logging.getLogger(__name__)
_TARGET_PHASES = {
    "NRCA3_FP1": "wss_target_phase_fp1.fits",
    "NRCA1_FP6": "wss_target_phase_fp6.fits",
}
_TO_METRES = {"um": 1e-6, "micron": 1e-6, "microns": 1e-6, "m": 1.0, "meter": 1.0, "nm": 1e-9}


@dataclass(frozen=True)
class WSSMap:
    """A wavefront map of the telescope, with where it comes from.

    Attributes
    ----------
    opd : ndarray, (npix, npix)
        m, entrance-pupil orientation, 0 outside the pupil. The telescope's wavefront common to
        the field; stpsf adds the field dependence where it is used.
    epoch : Time or None
        When the wavefront was measured.
    name : str
        File, or files.
    aperture : str
        Sensing field point.
    history : tuple of str
        What was done, with hashes of the files.
    sensing_si_wfe, sensing_ote_wfe : ndarray or None
        What was taken out, m.
    """

    opd: Array
    epoch: Time | None
    name: str
    aperture: str
    history: tuple[str, ...] = ()
    sensing_si_wfe: Array | None = field(default=None, repr=False)
    sensing_ote_wfe: Array | None = field(default=None, repr=False)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> Array:
        return np.array(self.opd, dtype=dtype)

    def hdus(self) -> fits.HDUList:
        """For ``nircam.pupilopd``, or for a file that every reader of OPDs takes."""
        hdus = opd_to_hdus(self.opd, JWST_DIAMETER)
        header = hdus[0].header
        header["APERNAME"] = (self.aperture, "Sensing field point")
        header["WSSFILE"] = self.name
        if self.epoch is not None:
            header["DATE-OBS"], header["TIME-OBS"] = self.epoch.isot.split("T")
        for line in self.history:
            header.add_history(line)
        return hdus


def load_wss_opd(
    path: str | os.PathLike[str], *, npix: int = 1024, backout_si_wfe: bool = True
) -> WSSMap:
    """Read a wavefront-sensing file.

    Parameters
    ----------
    path : path
        File as MAST has it, such as ``R2022081102-NRCA3_FP1-1.fits``.
    npix : int
        Samples across the map; one that stpsf has a pupil for if the sensing terms are taken out.
    backout_si_wfe : bool
        Take out the sensing camera's aberration and the telescope's field dependence at the
        sensing field point, with stpsf's models. False keeps the measured sum.

    Raises
    ------
    CorruptFileError
        If it is not such a file, or stpsf's data are incomplete.
    UnitError
        If the values cannot be microns.
    """
    path = Path(path)
    with open_fits(path) as hdus:
        if "RESULT_PHASE" not in hdus:
            raise CorruptFileError(
                f"{path}: no extension RESULT_PHASE; those there are are "
                f"{[hdu.name for hdu in hdus]}. Expected a wavefront-sensing product of MAST"
            )
        coarse = native_float64(hdus["RESULT_PHASE"].data)
        header, unit = hdus[0].header.copy(), hdus["RESULT_PHASE"].header.get("BUNIT", "micron")
    require_shape(coarse, (None, None), f"{path}: RESULT_PHASE", "It must be an image")
    if unit.strip().lower() not in _TO_METRES:
        raise IncompatibleSetupError(f"{path}: RESULT_PHASE has BUNIT={unit!r}, expected 'micron'")
    aperture = header.get("APERNAME", "")
    pupil = _pupil(npix, required=backout_si_wfe)
    opd = _interpolated(_gaps_filled(coarse), npix) * _TO_METRES[unit.strip().lower()]
    history = [
        f"{path.name} sha256 {sha256(path)}",
        f"gaps filled, interpolated from {len(coarse)} to {npix} samples, {unit} to m, masked",
    ]
    check_opd(np.where(_drawn(coarse, npix), opd, 0), pupil, str(path))
    opd = opd * pupil
    si_wfe = ote_wfe = None
    if backout_si_wfe:
        if not aperture:
            raise CorruptFileError(
                f"{path}: no APERNAME in the primary header, so the sensing camera's aberration "
                "cannot be taken out. Pass backout_si_wfe=False to keep the sum"
            )
        si_wfe, ote_wfe, source = _sensing_terms(aperture, opd, npix)
        opd = opd - (si_wfe + ote_wfe) * pupil
        history.append(f"subtracted SI WFE ({source}) and OTE field dependence at {aperture}")
    epoch = _epoch(header, path.name)
    return WSSMap(opd, epoch, path.name, aperture, tuple(history), si_wfe, ote_wfe)


def load_wss_opd_by_date(
    date: str | Time,
    choice: str = "closest",
    *,
    npix: int = 1024,
    backout_si_wfe: bool = True,
    folder: str | os.PathLike[str] | None = None,
) -> WSSMap:
    """Read the wavefront-sensing map of a date, through stpsf's own retrieval from MAST.

    Parameters
    ----------
    date : str (ISO, UTC) or Time
    choice : "closest", "before", "after" or "interpolate"
        Which measurement; the last interpolates linearly between the two around the date.
    folder : path, optional
        Where downloads are kept; default stpsf's own cache.

    Raises
    ------
    MissingOPDError
        If MAST cannot be reached or has none.
    """
    if choice not in ("closest", "before", "after", "interpolate"):
        raise IncompatibleSetupError(
            f"choice: got {choice!r}, expected 'closest', 'before', 'after' or 'interpolate'"
        )
    mast_wss = _stpsf("to ask MAST").mast_wss
    when = Time(date)
    cache = None if folder is None else os.fspath(folder)
    choices = ("before", "after") if choice == "interpolate" else (choice,)
    try:
        paths = [
            mast_wss.get_opd_at_time(when, choice=which, output_path=cache) for which in choices
        ]
    except (OSError, RuntimeError, ValueError, LookupError, TypeError) as error:
        # No network, a proxy's answer in place of the service's, no map within a week.
        raise MissingOPDError(
            f"no wavefront map for {when.isot} from MAST ({type(error).__name__}: {error}). "
            "Where the network does not allow it, download the file elsewhere "
            "(https://mast.stsci.edu, product type OPD) and pass its path to load_wss_opd"
        ) from error
    maps = [load_wss_opd(path, npix=npix, backout_si_wfe=backout_si_wfe) for path in paths]
    return maps[0] if len(maps) == 1 else interpolate_wss(maps[0], maps[1], when)


def interpolate_wss(before: WSSMap, after: WSSMap, date: str | Time) -> WSSMap:
    """Interpolate linearly in time between two maps.

    Warns
    -----
    DiffrenderWarning
        Always: segments move in steps, and nobody measured this wavefront.
    """
    when = Time(date)
    if before.epoch is None or after.epoch is None:
        raise IncompatibleSetupError(
            f"{before.name}, {after.name}: both need a date to interpolate between them"
        )
    if not before.epoch <= when <= after.epoch or before.epoch == after.epoch:
        raise IncompatibleSetupError(
            f"{when.isot} is not between {before.epoch.isot} and {after.epoch.isot}"
        )
    share = float((when - before.epoch).jd / (after.epoch - before.epoch).jd)
    warnings.warn(
        f"the wavefront of {when.isot} is an interpolation, {1 - share:.0%} of {before.name} and "
        f"{share:.0%} of {after.name}: not a measurement, and blind to steps in between",
        DiffrenderWarning,
        stacklevel=2,
    )
    return replace(
        before,
        opd=(1 - share) * before.opd + share * after.opd,
        epoch=when,
        name=f"{before.name} + {after.name}",
        history=(
            *before.history,
            *after.history,
            f"interpolated linearly in time: {1 - share:.6f} and {share:.6f} of the two",
        ),
        sensing_si_wfe=None,
        sensing_ote_wfe=None,
    )


def _gaps_filled(opd: Array) -> Array:
    """Blank samples next to valid ones become the mean of their valid neighbours."""
    valid = opd != 0
    total, count = np.zeros_like(opd), np.zeros_like(opd)
    for dy in (-1, 0, 1):
        for dx in (-1, 0, 1):
            if (dx, dy) != (0, 0):
                total += np.roll(opd * valid, (dy, dx), axis=(0, 1))
                count += np.roll(valid, (dy, dx), axis=(0, 1))
    return np.where(valid, opd, total / np.maximum(count, 1))


def _interpolated(opd: Array, npix: int) -> Array:
    """Cubic spline onto `npix` samples, as stpsf places them.

    Output sample i is taken at ``i dim / npix`` on the input's index, not at the same place in the
    pupil: the map moves by (1 - dim / npix) / 2 input samples. stpsf's maps have that shift, and
    those that are compared with them need it.
    """
    index = np.arange(len(opd), dtype=float)
    wanted = np.arange(npix) * (len(opd) / npix)
    return native_float64(RectBivariateSpline(index, index, opd)(wanted, wanted))


def _drawn(coarse: Array, npix: int) -> NDArray[np.bool_]:
    """Where the map has values, on the output's samples."""
    index = (np.arange(npix) * len(coarse)) // npix
    return (coarse != 0)[np.ix_(index, index)]


def _stpsf(purpose: str) -> Any:
    """The module stpsf, with its submodule for MAST."""
    try:
        import stpsf
        import stpsf.mast_wss
    except ImportError as error:
        raise IncompatibleSetupError(
            f"stpsf is needed {purpose} and is not installed ({error}): "
            'pip install "pyklip-diffrender[webbpsf]"'
        ) from error
    return stpsf


def _data_folder() -> Path | None:
    folder = os.environ.get("STPSF_PATH") or os.environ.get("WEBBPSF_PATH")
    return Path(folder) if folder else None


def _pupil(npix: int, required: bool) -> Array:
    """1 inside the pupil: stpsf's where its data are, else the embedded outlines."""
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


def _sensing_terms(aperture: str, opd: Array, npix: int) -> tuple[Array, Array, str]:
    """What the sensing camera adds: its own aberration, the telescope's field dependence; m."""
    stpsf = _stpsf("to take out the sensing terms")
    folder = _data_folder()
    assert folder is not None  # _pupil has read from it.
    try:
        instrument = stpsf.instrument(aperture[:3])
        instrument.pupil = str(next(folder.glob(f"jwst_pupil_RevW_npix{npix}.fits*")))
        instrument.pupilopd = opd_to_hdus(opd, JWST_DIAMETER)
        instrument.set_position_from_aperture_name(aperture)
        if aperture in _TARGET_PHASES:
            source = _TARGET_PHASES[aperture]
            with open_fits(folder / "NIRCam" / "OPD" / source) as hdus:
                scale = _TO_METRES[str(hdus[0].header.get("BUNIT", "m")).strip().lower()]
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
    if npix != 1024 and len(si_wfe) != npix:
        si_wfe = native_float64(zoom(si_wfe, npix / 1024))
    return si_wfe, ote_wfe, source


def _epoch(header: Any, name: str) -> Time | None:
    """When it was measured: from the header, or to the day from the name."""
    if "DATE-OBS" in header:
        epoch = f"{header['DATE-OBS']}T{header.get('TIME-OBS', '00:00:00')}"
        try:
            return Time(epoch, scale="utc")
        except ValueError as error:
            raise CorruptFileError(
                f"{name}: DATE-OBS and TIME-OBS are {epoch!r}, expected such as "
                "'2022-08-11T01:02:03'. Correct the header, or fetch the file again"
            ) from error
    found = re.match(r"[A-Z](\d{4})(\d{2})(\d{2})\d{2}-", name)
    if found is None:
        _LOG.warning("%s: no DATE-OBS, and no date in its name", name)
        return None
    return Time("-".join(found.groups()), scale="utc")
