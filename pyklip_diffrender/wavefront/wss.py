"""Maps of JWST's wavefront-sensing software (WSS) as archived by MAST.

The steps are the same as in stpsf's `load_wss_opd`: fill the gaps, interpolate, convert microns,
mask, and subtract the internal aberration of the sensing camera and the telescope's field
dependence, both at the sensing field point. The subtracted terms come from stpsf, and the other
steps also work without it.
"""

from __future__ import annotations

import hashlib
import logging
import os
import re
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from astropy import units as u
from astropy.time import Time
from numpy.typing import NDArray

from pyklip_diffrender.errors import (
    CorruptFileError,
    DiffrenderWarning,
    IncompatibleSetupError,
    MissingOPDError,
)
from pyklip_diffrender.instrument.masks import jwst_pupil
from pyklip_diffrender.io.files import open_fits, sha256
from pyklip_diffrender.io.headers import header_text, sensing_date
from pyklip_diffrender.io.units import native_float64, require_shape
from pyklip_diffrender.wavefront.opd_map import OPDMap, check_opd, length_unit

# The aberrations that a wavefront-sensing map contains besides the telescope's, by stpsf's models.
#
# stpsf and its data (``STPSF_PATH``) are optional, and imported when they are first used.

Array = NDArray[np.float64]


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
    """The pupil, 1 inside: from stpsf's data if available, otherwise from the embedded outlines."""
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


def sensing_terms(path: Path, aperture: str, npix: int) -> tuple[Array, str]:
    """Sum of the camera's aberration and the telescope's field dependence (m), and its source."""
    if not aperture:
        raise CorruptFileError(
            f"{path.name}: no APERNAME in the primary header, so the sensing camera is not known. "
            "Pass backout_si_wfe=False to keep the sum"
        )
    folder = _data_folder()
    if folder is None:
        raise CorruptFileError(
            "STPSF_PATH is not set. Set it to the complete stpsf data files, or pass "
            "backout_si_wfe=False"
        )
    stpsf = stpsf_module("to subtract the sensing terms")
    try:
        nircam = stpsf.NIRCam()
        nircam.pupil = str(next(folder.glob(f"jwst_pupil_RevW_npix{npix}.fits*")))
        nircam.load_wss_opd(os.fspath(path), verbose=False)
    except (RuntimeError, FileNotFoundError, StopIteration, ValueError, KeyError) as error:
        raise CorruptFileError(
            f"the models of stpsf for {aperture!r} could not be read from {folder} ({error}). "
            "STPSF_PATH must hold the complete stpsf data files"
        ) from error
    with nircam.pupilopd as hdus:
        camera, telescope = hdus["SENSING_SI_WFE"], hdus["SENSING_OTE_FD_WFE"]
        return native_float64(camera.data + telescope.data), camera.header["SOURCE"]


_log = logging.getLogger(__name__)


EXTENSION = "RESULT_PHASE"
"""Name of the extension that holds the map; only these files have one."""

_INVALID = ("R2022083106",)
"""Analyses with known faults (stpsf 2.2, ``mast_wss.deduplicate_opd_table``)."""

_F187N = ("02106", "0210E", "03109", "0310H", "04109", "0410H")
"""Activities of visits that sense in F187N as well. NIRCam's focus is another one there than in
F212N, for which the sensing terms are (stpsf 2.2, ``mast_wss.infer_pre_or_post_correction``)."""

_NEVER_F187N = ("V01163111001", "V01445")
"""Visits, or beginnings of their names, that never sense in F187N (ibid.)."""

_MAST_NAME = re.compile(r"([A-Z]\d{10})-\w+?-(\d+)(?=\.|$)")
"""Correction and number of the analysis in the name of a file of MAST."""

_SEARCH_WINDOWS_DAYS = (3.0, 6.0, 12.0)
"""Days around a date in which MAST is asked for maps; they are sensed every two to four days."""


def analysis_of(name: str) -> tuple[str, int]:
    """Key by which the analyses of one sensing are sorted, the last one at the end."""
    match = _MAST_NAME.search(name)
    # The letter says who asked for the correction; its number counts the day's.
    return (name, 0) if match is None else (match[1][1:], int(match[2]))


def why_not_sensed_well(correction: str, observation: str) -> str:
    """Why a measurement is not used where there are others; empty if it is used.

    `correction` is such as "R2022083106" (CORR_ID), `observation` the identifier of the exposure
    (OBS_ID), which ends in the activity. stpsf leaves the same ones out of its tables.
    """
    if correction in _INVALID:
        return f"the analysis {correction} has known faults"
    visit = observation if observation.startswith("V") else f"V{observation}"
    if observation[-5:] in _F187N and not visit.startswith(_NEVER_F187N):
        return "it was sensed in F187N, in which the camera has another focus"
    return ""


def load_wss_opd(
    path: str | os.PathLike[str],
    *,
    npix: int | None = None,
    backout_si_wfe: bool | None = None,
) -> OPDMap:
    """Read a wavefront-sensing file.

    Parameters
    ----------
    path : path
        File as MAST has it, such as ``R2022081102-NRCA3_FP1-1.fits``.
    npix : int, optional
        Samples across the map. To subtract the sensing terms, stpsf's data must include a pupil
        with as many. Default as in the finest pupil of stpsf's data, else 1024.
    backout_si_wfe : bool, optional
        Subtract the sensing camera's aberration and the telescope's field dependence at the
        sensing field point, with stpsf's models. False keeps the measured sum. By default they
        are subtracted if stpsf and its data are installed (``STPSF_PATH``); otherwise the sum is
        kept, with a warning.

    Returns
    -------
    OPDMap
        The telescope's wavefront without its field dependence, which stpsf adds for the position
        of each instrument. 0 outside the pupil.

    Raises
    ------
    CorruptFileError
        If the file is not a wavefront-sensing file, or stpsf's data are incomplete.
    IncompatibleSetupError
        If the map's unit is not a length, or stpsf is needed and not installed.
    UnitError, NonFiniteError
        If the values cannot be a wavefront in that unit.

    Warns
    -----
    DiffrenderWarning
        If the sensing terms are kept because stpsf's models are not available, or if the map
        seems to be flipped.

    Notes
    -----
    At NRCA3_FP1, where most maps are sensed, the terms have 27 nm rms (field dependence of the
    telescope) and 22 nm rms (NIRCam) in the models of stpsf 2.2. With them a map typically has
    63 nm rms where the telescope alone has 54 nm rms.
    """
    path = Path(path)
    with open_fits(path) as hdus:
        if EXTENSION not in hdus:
            raise CorruptFileError(
                f"{path}: no extension {EXTENSION}, but {[hdu.name for hdu in hdus]}. Expected a "
                "wavefront-sensing product of MAST"
            )
        coarse = native_float64(hdus[EXTENSION].data)
        header = hdus[0].header.copy()
        # MAST's files are in microns and do not say so.
        unit = header_text(hdus[EXTENSION].header, "BUNIT", path.name) or "micron"
    require_shape(coarse, (None, None), f"{path}: {EXTENSION}", "It must be an image")
    length = length_unit(unit)
    if length is None:
        raise IncompatibleSetupError(f"{path}: {EXTENSION} has BUNIT={unit!r}, expected 'micron'")
    if not coarse.any():
        raise CorruptFileError(
            f"{path}: all values of {EXTENSION} are zero, expected a measured wavefront. Fetch "
            "the file again"
        )
    npix = npix or finest_pupil()
    aperture = header_text(header, "APERNAME", path.name) or ""
    pupil = pupil_samples(npix, required=backout_si_wfe is True)
    opd = _interpolated(_gaps_filled(coarse), npix) * length.to(u.m)
    history = [
        f"{path.name} sha256 {sha256(path)}",
        f"gaps filled, interpolated from {len(coarse)} to {npix} samples, {unit} to m, masked",
    ]
    check_opd(np.where(_has_values(coarse, npix), opd, 0), pupil, str(path))
    opd = opd * pupil
    if backout_si_wfe is not False:
        try:
            terms, source = sensing_terms(path, aperture, npix)
        except (CorruptFileError, IncompatibleSetupError) as error:
            if backout_si_wfe:
                raise
            _warn_of_terms(path.name, error)
            history.append("kept SI WFE and OTE field dependence at the sensing field point")
        else:
            opd = opd - terms * pupil
            history.append(f"subtracted SI WFE ({source}) and OTE field dependence at {aperture}")
    date = sensing_date(header, path.name)
    return OPDMap(opd, date, path.name, sha256(path), aperture, tuple(history))


def _warn_of_terms(name: str, reason: Exception) -> None:
    warnings.warn(
        f"{name}: the map is as the sensing camera saw it, with that camera's own "
        "aberration and the telescope's field dependence at the sensing field point, typically "
        "63 nm rms in all where the telescope alone has 54 nm rms, because stpsf's models of them "
        f"are not available ({reason}). A refinement with a wide enough prior corrects for it; "
        "load_wss_opd(path, backout_si_wfe=False) keeps the terms without this warning",
        DiffrenderWarning,
        stacklevel=4,
    )


def load_wss_opd_by_date(
    date: str | Time,
    choice: str = "nearest",
    *,
    npix: int | None = None,
    backout_si_wfe: bool | None = None,
    folder: str | os.PathLike[str] | None = None,
) -> OPDMap:
    """Read the wavefront-sensing map of a date, through stpsf's own retrieval from MAST.

    Parameters
    ----------
    date : str (ISO, UTC) or Time
    choice : "nearest", "before", "after" or "interpolate"
        Measurement to take; the last interpolates linearly between the two around the date. stpsf's
        name "closest" for the nearest one is accepted.
    npix, backout_si_wfe
        See `load_wss_opd`.
    folder : path, optional
        Folder for downloads; default stpsf's own cache.

    Returns
    -------
    OPDMap

    Raises
    ------
    MissingOPDError
        If MAST cannot be reached, or has no map.
    IncompatibleSetupError
        For another `choice`, or if stpsf is not installed.
    """
    if choice not in ("closest", "nearest", "before", "after", "interpolate"):
        raise IncompatibleSetupError(
            f"choice: got {choice!r}, expected 'nearest', 'before', 'after' or 'interpolate'"
        )
    mast_wss = stpsf_module("to ask MAST").mast_wss
    when = Time(date)
    cache = None if folder is None else os.fspath(folder)
    try:
        names = _names_in_archive(mast_wss, when, choice)
        paths = [mast_wss.mast_retrieve_opd(name, output_path=cache) for name in names]
    except (OSError, RuntimeError, ValueError, LookupError, TypeError) as error:
        # No network, an answer from a proxy instead of the service, or no map within a week.
        raise MissingOPDError(
            f"no OPD map for {when.isot} from MAST ({type(error).__name__}: {error}). "
            "Where the network does not allow it, download the file elsewhere "
            "(https://mast.stsci.edu, product type OPD) and pass its path to load_wss_opd, or "
            "give it as opd"
        ) from error
    maps = [load_wss_opd(path, npix=npix, backout_si_wfe=backout_si_wfe) for path in paths]
    return maps[0] if len(maps) == 1 else interpolate_wss(maps[0], maps[1], when)


def _names_in_archive(mast_wss: Any, when: Time, choice: str) -> list[str]:
    """Names of the files at MAST that a rule chooses, in order of time.

    `LookupError` if there are none within twelve days on the side that is asked for.
    """
    for days in _SEARCH_WINDOWS_DAYS:
        # The last analysis of each sensing.
        rows: dict[float, str] = {}
        for row in mast_wss.mast_wss_date_query(when, days * u.day):
            name, moment = str(row["fileName"]), float(row["date_obs_mjd"])
            reason = why_not_sensed_well(str(row["corr_id"]), str(row["obs_id"]))
            if reason:
                _log.info("%s is not used: %s", name, reason)
            elif moment not in rows or analysis_of(name) > analysis_of(rows[moment]):
                if moment in rows:
                    _log.info("%s is not used: %s is a later analysis", rows[moment], name)
                rows[moment] = name
        before = max((t for t in rows if t <= when.mjd), default=None)
        after = min((t for t in rows if t >= when.mjd), default=None)
        nearest = min(rows, key=lambda t: abs(t - when.mjd), default=None)
        sides = {"before": [before], "after": [after], "interpolate": [before, after]}
        wanted = sides.get(choice, [nearest])
        # The nearest is known where there are some on both sides.
        sure = choice in sides or (before is not None and after is not None)
        if None not in wanted and (sure or days == _SEARCH_WINDOWS_DAYS[-1]):
            return [rows[t] for t in sorted({t for t in wanted if t is not None})]
    raise LookupError(f"no map {choice} that date within {_SEARCH_WINDOWS_DAYS[-1]:g} days")


def interpolate_wss(before: OPDMap, after: OPDMap, date: str | Time) -> OPDMap:
    """Interpolate linearly in time between two maps, with a warning that this is no measurement.

    IncompatibleSetupError if a map has no date, or `date` is not between the dates of the maps.
    """
    when = Time(date)
    if before.date is None or after.date is None:
        raise IncompatibleSetupError(
            f"{before.name}, {after.name}: both need a date to interpolate between them"
        )
    if not before.date <= when <= after.date or before.date == after.date:
        raise IncompatibleSetupError(
            f"{when.isot} is not between {before.date.isot} and {after.date.isot}"
        )
    share = float((when - before.date).jd / (after.date - before.date).jd)
    warnings.warn(
        f"the wavefront of {when.isot} is an interpolation, {1 - share:.0%} of {before.name} and "
        f"{share:.0%} of {after.name}: not a measurement, and without steps in between",
        DiffrenderWarning,
        stacklevel=2,
    )
    data = (1 - share) * before.data + share * after.data
    return replace(
        before,
        data=data,
        date=when,
        name=f"{before.name} + {after.name}",
        sha256=hashlib.sha256(data.tobytes()).hexdigest(),
        history=(
            *before.history,
            *after.history,
            f"interpolated linearly in time: {1 - share:.6f} and {share:.6f} of the two",
        ),
    )


def _gaps_filled(opd: Array) -> Array:
    """Replace blank samples next to valid ones by the mean of their valid neighbours."""
    valid = opd != 0
    total, count = np.zeros_like(opd), np.zeros_like(opd)
    for dy in (-1, 0, 1):
        for dx in (-1, 0, 1):
            if (dx, dy) != (0, 0):
                total += np.roll(opd * valid, (dy, dx), axis=(0, 1))
                count += np.roll(valid, (dy, dx), axis=(0, 1))
    return np.where(valid, opd, total / np.maximum(count, 1))


def _interpolated(opd: Array, npix: int) -> Array:
    """Interpolate to `npix` samples by a cubic spline, with the shift that stpsf has.

    Output sample i is at ``i dim / npix`` of the input's index and not at the same position in the
    pupil: the map moves by (1 - dim / npix) / 2 input samples, as in stpsf, for maps to agree.
    """
    # Imported where it is used: few reductions read such maps.
    from scipy.interpolate import RectBivariateSpline

    index = np.arange(len(opd), dtype=float)
    fine = np.arange(npix) * (len(opd) / npix)
    return native_float64(RectBivariateSpline(index, index, opd)(fine, fine))


def _has_values(coarse: Array, npix: int) -> NDArray[np.bool_]:
    """Samples of the output at which the map has values."""
    index = (np.arange(npix) * len(coarse)) // npix
    return (coarse != 0)[np.ix_(index, index)]
