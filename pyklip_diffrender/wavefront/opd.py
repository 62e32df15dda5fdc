"""OPD maps: read from FITS files, drawn at random, or chosen by date from a folder."""

from __future__ import annotations

import hashlib
import logging
import math
import os
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from astropy import units as u
from astropy.io import fits
from astropy.time import Time
from astropy.utils.exceptions import AstropyUserWarning
from numpy.typing import NDArray

from pyklip_diffrender.errors import (
    CorruptFileError,
    DiffrenderWarning,
    IncompatibleSetupError,
    MissingFileError,
    MissingOPDError,
    NonFiniteError,
    ShapeError,
    UnitError,
)
from pyklip_diffrender.instrument.masks import jwst_pupil
from pyklip_diffrender.io.files import BROKEN, fits_files, open_fits, product_in, sha256
from pyklip_diffrender.io.headers import header_text, merged_header, sensing_date
from pyklip_diffrender.io.units import native_float64, to_metres, to_number, warn_of_rms
from pyklip_diffrender.optics.grid import PupilGrid, resample
from pyklip_diffrender.wavefront.bases import FourierModes, SegmentMotions
from pyklip_diffrender.wavefront.opd_map import FLAT, OPDMap, length_unit
from pyklip_diffrender.wavefront.wss import (
    EXTENSION,
    analysis_of,
    interpolate_wss,
    load_wss_opd,
    why_not_sensed_well,
)

_MAP_NAMES = ("OPD", "OPDMAP", "WFE", "WAVEFRONT")
"""Names of extensions that hold a wavefront, whatever else is in the file."""

_FLAT_SAMPLES = 256
"""Samples across a flat wavefront, which is the same with any number."""


def read_opd(
    path: str | os.PathLike[str],
    extension: str | int | None = None,
    unit: str | u.UnitBase | None = None,
) -> OPDMap:
    """Read an OPD map from a FITS file.

    Maps of the mission's wavefront sensing from MAST are recognised by their extension
    RESULT_PHASE. These maps are in microns without a unit in the header, and contain the
    aberrations of the sensing camera. The aberrations are subtracted with stpsf's models if stpsf
    and its data are installed, and otherwise kept, with a warning. See ``wss.load_wss_opd``.

    Parameters
    ----------
    path : path
        FITS file, gzipped or not.
    extension : str or int, optional
        HDU to read unchanged; default the one named OPD (or OPDMAP, WFE, WAVEFRONT), otherwise the
        first with a two-dimensional image.
    unit : str or Unit, optional
        Unit of the values if the header has no BUNIT.

    Returns
    -------
    OPDMap

    Raises
    ------
    CorruptFileError
        If the file is missing or truncated, has no two-dimensional image, is an exposure and no
        map, or is constant inside the pupil, such as a mask.
    UnitError
        If no unit is known, or it is not a length.
    ShapeError
        If the map is not square.
    NonFiniteError
        For NaN or infinity inside the pupil (outside they become 0).

    Warns
    -----
    DiffrenderWarning
        If the rms inside the pupil is not plausible for JWST, or if a wavefront-sensing map still
        contains the aberrations of the sensing camera.

    Examples
    --------
    With a file from MAST, which the package does not contain:

    >>> from pyklip_diffrender import read_opd
    >>> opd = read_opd("R2022081102-NRCA3_FP1-1.fits")  # doctest: +SKIP
    """
    path = Path(path)
    if path.is_dir():
        raise CorruptFileError(
            f"{path} is a folder, expected a file. choose_opd(folder, date) takes the map of a "
            "folder that is nearest to a date"
        )
    if not path.exists():
        raise MissingFileError(f"{path}: no such file, expected an OPD map")
    with open_fits(path) as hdus:
        if extension is None and EXTENSION in hdus:
            return _checked(load_wss_opd(path))
        hdu = _image(hdus, extension, path)
        raw = native_float64(hdu.data)
        others = [each.name or k for k, each in enumerate(hdus)]
        header = merged_header(hdus[0].header, hdu.header, path.name)
        sensed = hdu.name == EXTENSION
    unit = unit or header_text(header, "BUNIT", path.name) or ("micron" if sensed else None)
    _require_wavefront(raw, path.name, hdu.name, others)
    if not unit:
        raise UnitError(
            f"{path.name}: the header has no BUNIT. Give the unit: read_opd(path, unit='m') "
            "(or 'um', 'nm')"
        )
    length = length_unit(unit)
    if length is None:
        raise UnitError(f"{path.name}: BUNIT is {unit!r}, expected a unit of length")
    data = raw * length.to(u.m)
    date = sensing_date(header, path.name)
    return _checked(OPDMap(data, date, path.name, sha256(path), path=path))


def as_opd_map(opd: Any) -> OPDMap:
    """Make an `OPDMap` of a path, Quantity, array, tensor, map or "flat"; bare numbers are metres.

    Raises what `read_opd` raises.
    """
    if isinstance(opd, OPDMap):
        return opd
    name = "array"
    if isinstance(opd, str) and opd == FLAT:
        opd, name = np.zeros((_FLAT_SAMPLES, _FLAT_SAMPLES)), "flat wavefront"
    if isinstance(opd, str | os.PathLike):
        return read_opd(opd)
    data = to_metres(opd, "opd")
    return _checked(OPDMap(data, None, name, hashlib.sha256(data.tobytes()).hexdigest()))


def _image(hdus: fits.HDUList, extension: str | int | None, path: Path) -> Any:
    if extension is not None:
        try:
            return hdus[extension]
        except (KeyError, IndexError) as error:
            raise CorruptFileError(
                f"{path}: no extension {extension!r}; it has {[h.name for h in hdus]}"
            ) from error
    exposure = str(hdus[0].header.get("EXP_TYPE", "")).strip()
    product = product_in(hdus)
    has_map = any(hdu.name in _MAP_NAMES for hdu in hdus)
    if "SCI" in hdus or exposure or (product and not has_map):
        what = f"an exposure of type {exposure}" if exposure else "an exposure"
        if product:
            what = f"{product}, a product of pyklip_diffrender"
        raise CorruptFileError(
            f"{path.name}: this is no OPD map, but {what}. Expected a map of the wavefront "
            "sensing (R2022081102-NRCA3_FP1-1.fits, for example) or another OPD map. Give "
            "exposures as frames instead"
        )
    images = [each for each in hdus if each.data is not None and np.ndim(each.data) == 2]
    if not images:
        raise CorruptFileError(f"{path}: no two-dimensional image in it; expected an OPD map")
    return next((each for each in images if each.name in _MAP_NAMES), images[0])


def _require_wavefront(
    values: NDArray[np.float64], name: str, hdu: str, others: list[str | int]
) -> None:
    """Raise for an image that is constant in the pupil, such as a mask."""
    if values.ndim != 2 or values.shape[0] != values.shape[1] or not values.size:
        return  # `_checked` raises for it.
    inside = values[_inside(len(values)) & np.isfinite(values)]
    different = np.unique(inside)
    # A mask with struts and gaps of its own has two values inside the pupil.
    if len(different) > 2 or not len(different):
        return
    raise CorruptFileError(
        f"{name}: the image {hdu or 'in the primary HDU'} is no wavefront: inside the pupil it has "
        f"only the value{'s' if len(different) > 1 else ''} "
        f"{' and '.join(f'{value:g}' for value in different)}, as a mask has. Choose the HDU with "
        f"extension=, out of {others}, or give {FLAT!r} in place of the file where a flat "
        "wavefront is meant"
    )


def _inside(npix: int) -> NDArray[np.bool_]:
    """Samples inside the pupil."""
    return np.asarray(jwst_pupil(npix).numpy() > 0.5)


def _checked(raw: OPDMap) -> OPDMap:
    """A square map with a plausible rms, and zeros where values outside the pupil are NaN."""
    data, name = raw.data, raw.name
    if data.ndim != 2 or data.shape[0] != data.shape[1] or not data.size:
        raise ShapeError(f"{name}: got shape {data.shape}, expected a square map")
    pupil = _inside(data.shape[0])
    bad = ~np.isfinite(data)
    if (bad & pupil).any():
        first = tuple(int(i) for i in np.argwhere(bad & pupil)[0])
        raise NonFiniteError(
            f"{name}: {int((bad & pupil).sum())} values inside the pupil are NaN or infinite, the "
            f"first at [y, x] = {first}. Interpolate them or use another map"
        )
    data = np.where(bad, 0.0, data)
    warn_of_rms(float(data[pupil].std()), name, stacklevel=4)
    return replace(raw, data=data)


def random_opd(seed: int, npix: int = 1024, rms: float = 66e-9) -> OPDMap:
    """Draw a wavefront like the wavefronts measured in flight.

    Segment piston, tip and tilt carry 24 % of the variance (as in the maps of 2022-08-11 and
    2022-08-14). The rest is texture inside the segments, whose amplitude is constant up to 8
    cycles per pupil and falls as the square of the frequency beyond.

    Parameters
    ----------
    seed : int
    npix : int
        Samples across the pupil. The same seed gives the same wavefront at any sampling.
    rms : float or Quantity
        Rms over the pupil, m.

    Returns
    -------
    OPDMap

    Examples
    --------
    >>> import pyklip_diffrender as dr
    >>> opd = dr.wavefront.random_opd(1, npix=128, rms=50e-9)
    >>> f"{1e9 * opd.data[opd.data != 0].std():.0f} nm"
    '50 nm'
    """
    rms = to_number(rms, u.m, "rms", "not negative")
    return _random(seed, npix, rms, 0.24, "random_opd")


def random_drift(seed: int, hours: float, npix: int = 1024) -> OPDMap:
    """Draw a change of the wavefront that grows linearly with `hours`, h or a Quantity."""
    # 9 nm rms after 86 hours, because the published pair of maps differs by 9.06 nm. Segment
    # motions carry 62 % of the variance (as in the change from 2022-08-11 to 08-14), low and mid
    # frequencies the rest.
    hours = to_number(hours, u.h, "hours")
    unit = _random(seed, npix, 1e-8, 0.62, "random_drift")
    data = unit.data * (9e-9 / 1e-8 * hours / 86.0)
    return OPDMap(data, None, f"random_drift(seed={seed}, hours={hours})", unit.sha256)


def _random(seed: int, npix: int, rms: float, segment_variance: float, name: str) -> OPDMap:
    generator = np.random.default_rng(seed)
    grid = PupilGrid.full(npix)
    pupil = jwst_pupil(npix)
    segments, fourier = SegmentMotions(), FourierModes(32.0)
    # Pistons twice as large as tips and tilts, as measured.
    motions = torch.from_numpy(generator.normal(size=(18, 3)) * np.array([2.0, 1.0, 0.8]))
    texture = torch.from_numpy(generator.normal(size=len(fourier)))
    texture = texture / (1 + (fourier.frequencies / 8.0) ** 2.0)
    parts = [segments.opd(motions.flatten(), grid), fourier.opd(texture, grid)]
    weight = pupil / pupil.sum()

    def normalised(opd: torch.Tensor) -> torch.Tensor:
        opd = opd - (weight * opd).sum()
        return opd / torch.sqrt((weight * opd**2).sum())

    # Both have the variance 1, so that the squares of the factors are their shares of the total.
    rigid, inner = (normalised(part) for part in parts)
    mixed = math.sqrt(segment_variance) * rigid + math.sqrt(1 - segment_variance) * inner
    data = (rms * normalised(mixed) * (pupil > 0)).numpy()
    return OPDMap(data, None, f"{name}(seed={seed})", hashlib.sha256(data.tobytes()).hexdigest())


# Choose an OPD map by its date, from a folder of maps.

_log = logging.getLogger(__name__)

Rule = Literal["nearest", "before", "after", "interpolate"]

RULES: tuple[Rule, ...] = ("nearest", "before", "after", "interpolate")

OUTDATED_DAYS = 200.0
"""Days between a map and the frames above which a warning is given: the telescope is realigned
every few weeks to months, so that such a map is of another state of the mirror."""


def choose_opd(folder: str | os.PathLike[str], date: str | Time, rule: Rule = "nearest") -> OPDMap:
    """Choose an OPD map from a folder by its date.

    Parameters
    ----------
    folder : path
        Wavefront-sensing files of MAST, stpsf's files and other maps may be mixed. The date of a
        map is in its header, else in the file's name. Files that are not OPD maps, and maps
        without a date, are skipped with a message to the log. So are the maps that stpsf leaves
        out: analyses with known faults, and sensing in F187N. Of several analyses of one sensing
        the last is used.
    date : str (ISO, UTC) or Time
        When the frames were taken.
    rule : "nearest", "before", "after" or "interpolate"
        Take the nearest map, the last one before the date, the first one after it, or interpolate
        linearly in time between these two.

    Returns
    -------
    OPDMap
        The map; its `history` says how many days lie between the map and the date, and which
        earlier analyses it replaces.

    Raises
    ------
    MissingOPDError
        If the folder has no map with a date, or none on the side that is asked for.
    IncompatibleSetupError
        For another rule.
    UnitError, ShapeError, NonFiniteError, CorruptFileError
        As `read_opd`, for the map that is chosen.

    Warns
    -----
    DiffrenderWarning
        If the map is more than 200 days from the date, or is interpolated.

    Examples
    --------
    With a folder of maps, which the package does not contain:

    >>> from pyklip_diffrender import choose_opd
    >>> opd = choose_opd("maps", "2022-07-30T12:00", rule="before")  # doctest: +SKIP
    """
    if rule not in RULES:
        raise IncompatibleSetupError(f"rule: got {rule!r}, expected one of {', '.join(RULES)}")
    when = Time(date)
    maps, superseded = _last_analyses(dated_maps(Path(folder)))
    before = max((each for each in maps if each[0] <= when), default=None)
    after = min((each for each in maps if each[0] >= when), default=None)
    sides = {"before": [before], "after": [after], "interpolate": [before, after]}
    wanted = sides.get(rule) or [min(maps, key=lambda each: abs(each[0] - when))]
    if None in wanted:
        raise MissingOPDError(
            f"{folder}: no OPD map was sensed {'before' if before is None else 'after'} "
            f"{when.isot[:19]}; the {len(maps)} maps are of {min(maps)[0].isot[:10]} to "
            f"{max(maps)[0].isot[:10]}. The rule 'nearest' takes one of them"
        )
    # A map of exactly that date is taken once.
    paths = [path for _, path in sorted(set(filter(None, wanted)))]
    chosen = [read_opd(path) for path in paths]
    notes = [f"{opd.name}, {opd.age(when)}" for opd in chosen]
    for opd in chosen:
        _warn_if_outdated(opd, when)
    opd = chosen[0]
    if len(chosen) == 2:
        npix = max(each.shape[0] for each in chosen)
        first, last = (replace(each, data=resample(each.data, npix)) for each in chosen)
        opd = interpolate_wss(first, last, when)
    note = f"{rule} of {len(maps)} maps: {', '.join(notes)} {when.isot[:19]}"
    _log.info("OPD map %s", note)
    replaced = [
        f"{path.name} is the last analysis of its sensing, in place of {', '.join(earlier)}"
        for path in paths
        if (earlier := superseded.get(path))
    ]
    for line in replaced:
        _log.warning("%s", line)
    return replace(opd, history=(*opd.history, note, *replaced))


def _last_analyses(
    maps: list[tuple[Time, Path]],
) -> tuple[list[tuple[Time, Path]], dict[Path, list[str]]]:
    """Maps that have no later analysis, and the names of the maps that each replaces.

    Maps of one moment to the second are of one sensing, whatever the order of the files.
    """
    sensings: dict[float, list[tuple[Time, Path]]] = {}
    for date, path in maps:
        sensings.setdefault(round(date.mjd * 86400.0), []).append((date, path))
    last, superseded = [], {}
    for several in sensings.values():
        *earlier, latest = sorted(several, key=lambda each: analysis_of(each[1].name))
        last.append(latest)
        superseded[latest[1]] = [path.name for _, path in earlier]
    return last, superseded


def opd_for(opd: Any, date: Time | None) -> OPDMap:
    """The wavefront for frames of a date: as `as_opd_map`, or the nearest map in a folder.

    Raises what `choose_opd` and `read_opd` raise, and IncompatibleSetupError for a folder if the
    date of the frames is not known; warns if the map is more than 200 days from the date.
    """
    if isinstance(opd, str | os.PathLike) and opd != FLAT and Path(opd).is_dir():
        if date is None:
            raise IncompatibleSetupError(
                f"{opd} is a folder of OPD maps, and the frames have no date (DATE-BEG) to "
                "choose one by. Give the file of the map"
            )
        return choose_opd(opd, date)
    wavefront = as_opd_map(opd)
    if date is not None:
        _warn_if_outdated(wavefront, date)
    return wavefront


def dated_maps(folder: Path) -> list[tuple[Time, Path]]:
    """Date and path of every OPD map in a folder."""
    if not folder.is_dir():
        raise MissingOPDError(f"{folder}: no such folder, expected a folder of OPD maps")
    files = fits_files(folder)
    maps = []
    for path in files:
        try:
            maps.append((_date_of_map(path), path))
        except CorruptFileError as error:
            _log.warning("%s is skipped: %s", path.name, error)
        except LookupError as error:
            _log.info("%s is skipped: %s", path.name, error.args[0])
    if not maps:
        raise MissingOPDError(
            f"{folder}: none of its {len(files)} FITS files is an OPD map with a date, "
            "expected DATE-OBS in the header or a name such as opd_2022-08-14.fits"
        )
    return maps


def _date_of_map(path: Path) -> Time:
    """Date of an OPD map, from its headers alone; LookupError if it has none or is no map."""
    try:
        # Headers only, because a folder may hold hundreds of files.
        with (
            warnings.catch_warnings(action="error", category=AstropyUserWarning),
            path.open("rb") as file,
            fits.open(file) as hdus,
        ):
            sensed = EXTENSION in hdus
            squares = [
                hdu.header
                for hdu in ([hdus[EXTENSION]] if sensed else hdus)
                if hdu.header.get("NAXIS") == 2 and hdu.header["NAXIS1"] == hdu.header["NAXIS2"]
            ]
            primary = hdus[0].header
    except BROKEN as error:
        raise CorruptFileError(f"not a complete FITS file ({error})") from error
    if not squares:
        raise LookupError("it has no square image")
    header = merged_header(primary, squares[0], path.name)
    if sensed:
        correction, observation = (
            header_text(header, key, path.name) or "" for key in ("CORR_ID", "OBS_ID")
        )
        reason = why_not_sensed_well(correction or path.name.split("-")[0], observation)
        if reason:
            raise LookupError(reason)
    unit = header_text(header, "BUNIT", path.name)
    if not sensed and length_unit(unit or "") is None:
        raise LookupError(f"its image is not an OPD map: BUNIT is {unit!r}")
    date = sensing_date(header, path.name)
    if date is None:
        raise LookupError("it has no date in its header nor in its name")
    return date


def _warn_if_outdated(opd: OPDMap, when: Time) -> None:
    days = opd.days_after(when)
    if days is not None and abs(days) > OUTDATED_DAYS:
        warnings.warn(
            f"{opd.name}: the wavefront was sensed {abs(days):.0f} days "
            f"{'after' if days > 0 else 'before'} the frames of {when.isot[:10]}. The telescope "
            "has probably been realigned in between; use a map nearer in time",
            DiffrenderWarning,
            stacklevel=3,
        )
