"""Choose a wavefront map by its date, from a folder of maps."""

from __future__ import annotations

import logging
import os
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

from astropy import units as u
from astropy.io import fits
from astropy.time import Time
from astropy.utils.exceptions import AstropyUserWarning

from pyklip_diffrender.errors import (
    CorruptFileError,
    DiffrenderWarning,
    IncompatibleSetupError,
    MissingOPDError,
)
from pyklip_diffrender.io.files import BROKEN, fits_files
from pyklip_diffrender.io.headers import header_text, merged_header, sensing_date
from pyklip_diffrender.io.opd_map import FLAT, OPDMap
from pyklip_diffrender.optics.grid import resample
from pyklip_diffrender.wavefront.opd import as_opd_map, read_opd
from pyklip_diffrender.wavefront.wss import (
    EXTENSION,
    analysis_of,
    interpolate_wss,
    why_not_sensed_well,
)

__all__ = ["RULES", "Rule", "choose_map", "dated_maps", "wavefront_for"]

_log = logging.getLogger(__name__)

Rule = Literal["nearest", "before", "after", "interpolate"]

RULES: tuple[Rule, ...] = ("nearest", "before", "after", "interpolate")

_OUTDATED = 200.0
"""Days between a map and the frames above which a warning is given: the telescope is realigned
every few weeks to months, so that such a map is of another state of the mirror."""


def choose_map(folder: str | os.PathLike[str], date: str | Time, rule: Rule = "nearest") -> OPDMap:
    """Choose a wavefront map from a folder by its date.

    Parameters
    ----------
    folder : path
        Wavefront-sensing files of MAST, stpsf's files and other maps may be mixed. The date of a
        map is that of its header, else the one in the file's name. Files that are not wavefront
        maps, and maps without a date, are skipped with a message to the log. So are those that
        stpsf leaves out: analyses with known faults, and sensing in F187N. Of several analyses of
        one sensing the last is used.
    date : str (ISO, UTC) or Time
        When the frames were taken.
    rule : "nearest", "before", "after" or "interpolate"
        Take the nearest map, the last one before the date, the first one after it, or interpolate
        linearly in time between these two.

    Returns
    -------
    OPDMap
        Its `history` says how many days lie between the map and the date, and which earlier
        analyses it replaces.

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

    >>> from pyklip_diffrender import choose_map
    >>> opd = choose_map("maps", "2022-07-30T12:00", rule="before")  # doctest: +SKIP
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
            f"{folder}: no wavefront map was sensed {'before' if before is None else 'after'} "
            f"{when.isot[:19]}; the {len(maps)} maps are of {min(maps)[0].isot[:10]} to "
            f"{max(maps)[0].isot[:10]}. The rule 'nearest' takes one of them"
        )
    # Once if a map is of exactly that date.
    paths = [path for _, path in sorted(set(filter(None, wanted)))]
    chosen = [read_opd(path) for path in paths]
    notes = [f"{opd.name}, {opd.age(when)}" for opd in chosen]
    for opd in chosen:
        _warn_if_outdated(opd, when)
    opd = chosen[0] if len(chosen) == 1 else _interpolated(chosen[0], chosen[1], when)
    note = f"{rule} of {len(maps)} maps: {', '.join(notes)} {when.isot[:19]}"
    _log.info("wavefront map %s", note)
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
    """Maps without those of which there is a later analysis, and the names that each replaces.

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


def wavefront_for(opd: Any, date: Time | None) -> OPDMap:
    """The wavefront for frames of a date: as `as_opd_map`, or the nearest map in a folder.

    Raises
    ------
    IncompatibleSetupError
        For a folder, if the date of the frames is not known.
    DiffrenderError
        See `choose_map` and `read_opd`.

    Warns
    -----
    DiffrenderWarning
        If the map is more than 200 days from the date.
    """
    if isinstance(opd, str | os.PathLike) and opd != FLAT and Path(opd).is_dir():
        if date is None:
            raise IncompatibleSetupError(
                f"{opd} is a folder of wavefront maps, and the frames have no date (DATE-BEG) to "
                "choose one by. Give the file of the map"
            )
        return choose_map(opd, date)
    wavefront = as_opd_map(opd)
    if date is not None:
        _warn_if_outdated(wavefront, date)
    return wavefront


def dated_maps(folder: Path) -> list[tuple[Time, Path]]:
    """Date and path of every wavefront map in a folder."""
    if not folder.is_dir():
        raise MissingOPDError(f"{folder}: no such folder, expected a folder of wavefront maps")
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
            f"{folder}: none of its {len(files)} FITS files is a wavefront map with a date, "
            "expected DATE-OBS in the header or a name such as opd_2022-08-14.fits"
        )
    return maps


def _date_of_map(path: Path) -> Time:
    """Date of a wavefront map, from its headers alone; LookupError if it has none or is no map."""
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
    if not (sensed or _is_length(unit)):
        raise LookupError(f"its image is not a wavefront map: BUNIT is {unit!r}")
    date = sensing_date(header, path.name)
    if date is None:
        raise LookupError("it has no date in its header nor in its name")
    return date


def _is_length(unit: str | None) -> bool:
    try:
        return bool(u.Unit((unit or "").strip().rstrip("s").lower()).is_equivalent(u.m))
    except ValueError:
        return False


def _interpolated(before: OPDMap, after: OPDMap, when: Time) -> OPDMap:
    npix = max(before.shape[0], after.shape[0])
    before, after = (replace(opd, data=resample(opd.data, npix)) for opd in (before, after))
    return interpolate_wss(before, after, when)


def _warn_if_outdated(opd: OPDMap, when: Time) -> None:
    days = opd.days_after(when)
    if days is not None and abs(days) > _OUTDATED:
        warnings.warn(
            f"{opd.name}: the wavefront was sensed {abs(days):.0f} days "
            f"{'after' if days > 0 else 'before'} the frames of {when.isot[:10]}. The telescope "
            "has probably been realigned in between; use a map nearer in time",
            DiffrenderWarning,
            stacklevel=3,
        )
