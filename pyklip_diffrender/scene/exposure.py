"""The exposure of a file and the star that it shows, as header and file name describe them.

No card has a default here: a value that is not stated is None.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from itertools import combinations
from pathlib import Path

import numpy as np
from astropy import units as u
from astropy.coordinates import angular_separation, offset_by
from astropy.io import fits
from astropy.time import Time
from numpy.typing import NDArray

from pyklip_diffrender.errors import CorruptFileError, IncompatibleSetupError
from pyklip_diffrender.io.headers import (
    card_error,
    day_and_time,
    header_date,
    header_number,
    header_text,
    same_name,
)
from pyklip_diffrender.io.units import full_circle, half_circle

# The names of files in the archive: the product, the exposure, and the detector.

_LEVEL = re.compile(r"_([a-z0-9]+)\.fits(\.gz)?$", re.IGNORECASE)
_LEVELS = (
    "calints", "crfints", "cal", "crf", "rateints", "rate", "uncal", "ramp", "jump", "dark",
    "trapsfilled", "i2d", "s2d", "psfsub", "psfalign", "psfstack", "x1d", "segm", "cat",
)  # fmt: skip
"""Products of the pipeline, the usable ones first, and of these the best first."""

_STEPS_BEYOND_DETECTOR = {
    "S_KLIP": "psfsub",
    "S_PSFALI": "psfalign",
    "S_PSFSTK": "psfstack",
    "S_RESAMP": "i2d",
}
"""Steps of the pipeline after which frames no longer have a detector's own pixels."""

_ARCHIVE_NAME = re.compile(
    r"jw(\d{5})(\d{3})(\d{3})_(\d{2})(\d)(\w{2})_(\d{5})(?:-seg(\d{3}))?_([a-z0-9]+)", re.IGNORECASE
)
"""Programme, observation, visit, visit group, parallel sequence, activity, exposure, segment and
detector in the name that the archive gives to a file."""

_IDENTITY = ("PROGRAM", "OBSERVTN", "VISIT", "VISITGRP", "SEQ_ID", "ACT_ID", "EXPOSURE")

_DETECTORS = {"NRCA5": "NRCALONG", "NRCB5": "NRCBLONG"}
"""Detectors whose apertures (APERNAME) have another name."""


def level_of(header: fits.Header, name: str, dimensions: int) -> str | None:
    """Product of the pipeline, from its steps, the unit, and the names of the file."""
    for key, level in _STEPS_BEYOND_DETECTOR.items():
        if str(header.get(key, "")).strip().upper() == "COMPLETE":
            return level
    texts = (Path(name).name, header_text(header, "FILENAME", name) or "")
    named = [match[1].lower() for match in map(_LEVEL.search, texts) if match]
    known = [each for each in named if each in _LEVELS]
    # If the names disagree, the least useful product is assumed.
    stated = max(known, key=_LEVELS.index, default=None)
    unit = (header_text(header, "BUNIT", name) or "").upper().replace(" ", "")
    if unit in ("DN/S", "ADU/S", "COUNT/S") and stated in (None, "calints", "cal"):
        return "rateints" if dimensions == 3 else "rate"
    if stated == "calints" and dimensions == 2:
        return "cal"
    return stated


def detector_of(header: fits.Header, name: str) -> str | None:
    """Detector, from DETECTOR, APERNAME or the archive's name of the file; None if not stated."""
    stated = header_text(header, "DETECTOR", name)
    if stated is not None:
        return stated.upper()
    aperture = (header_text(header, "APERNAME", name) or "").upper().partition("_")[0]
    if re.fullmatch(r"NRC[AB]\d", aperture):
        return _DETECTORS.get(aperture, aperture)
    match = _ARCHIVE_NAME.search(Path(name).name)
    return match[9].upper() if match else None


def flat_field_of(header: fits.Header, name: str) -> str | None:
    """Name of the flat field of the calibration (R_FLAT), without its address; None if unstated."""
    stated = header_text(header, "R_FLAT", name)
    return None if stated is None else stated.rpartition("/")[2]


def identity_of(header: fits.Header, name: str) -> str | None:
    """Name of the exposure, as the archive makes it; None if the header does not say."""
    detector = detector_of(header, name)
    parts = [str(header.get(key, "")).strip() for key in _IDENTITY]
    if detector is not None and all(each and each.upper() != "UNKNOWN" for each in parts):
        digits = [part.zfill(n) for part, n in zip(parts, (5, 3, 3, 2, 1, 2, 5), strict=True)]
        segment = f"{header_number(header, 'EXSEGNUM', name) or 1:03.0f}"
    else:
        texts = (header_text(header, "FILENAME", name) or "", Path(name).name)
        match = next(filter(None, map(_ARCHIVE_NAME.search, texts)), None)
        if match is None:
            return None
        *digits, segment, detector = match.groups()
    program, observation, visit, group, sequence, activity, exposure = digits
    part = "" if segment in (None, "001") else f"-seg{segment}"
    return (
        f"jw{program}{observation}{visit}_{group}{sequence}{activity}_{exposure}{part}_"
        f"{detector.lower()}"
    )


# Stars as headers describe them: names, coordinates and proper motion.

_COORDINATES: tuple[tuple[str, str], ...] = (("TARG_RA", "TARG_DEC"), ("RA_REF", "DEC_REF"))
"""Cards of the star's coordinates, and of where the telescope pointed."""

_SAME_STAR_ARCSEC = 5.0
"""arcsec between the coordinates of one star in two headers, at one epoch."""

_SAME_POINTING_ARCSEC = 60.0
"""arcsec between the coordinates of one star if its names agree, or if one of the two is where the
telescope pointed."""

_FASTEST_ARCSEC_YR = 11.0
"""arcsec per year that no star exceeds: Barnard's star moves by 10.4."""

_SAME_ARCSEC_YR = 0.01
"""arcsec per year by which the proper motions of one star in two headers may differ. Catalogues
agree to a few milliarcseconds, and a background source is measured to about ten."""

_OLDEST_COORDINATES_YEAR = 2000.0
"""Julian year of the oldest coordinates in proposals: coordinates of the equinox J2000."""


@dataclass(frozen=True)
class CatalogueStar:
    """A star as a header describes it."""

    names: tuple[str, ...] = ()  # the proposer's (TARGPROP), the catalogue's (TARGNAME)
    coordinates: tuple[float, float] | None = None  # RA and Dec, degrees
    pointing: bool = False  # the coordinates are where the telescope pointed
    motion: tuple[float, float] | None = None  # see `proper_motion`; None also if it cannot be true
    # Possible Julian years of the coordinates: the catalogue's and the exposure's.
    epochs: tuple[float, ...] = ()

    @property
    def is_known(self) -> bool:
        """Whether the header says which star it is."""
        return bool(self.names or self.coordinates)

    def is_called(self, name: str) -> bool:
        """Whether the star has this name, in any spelling."""
        return any(same_name(name, each) for each in self.names)

    def separation(self, other: CatalogueStar) -> float | None:
        """Arcsec between the coordinates of two headers at one epoch; None if one has none.

        TARG_RA and TARG_DEC are of the catalogue's epoch in some headers and of the exposure in
        others, and no card says which: the separation is the least of the possible ones.
        """
        if self.coordinates is None or other.coordinates is None:
            return None
        year = max((*self.epochs, *other.epochs), default=_OLDEST_COORDINATES_YEAR)
        one, two = self._places(year, other.motion), other._places(year, self.motion)
        apart = angular_separation(*one[:, :, None], *two[:, None])
        return float(np.rad2deg(apart.min()) * 3600)

    def _places(self, year: float, motion: tuple[float, float] | None) -> NDArray[np.float64]:
        """RA and Dec in radians in a year, (2, epochs); `motion` is used if the star has none."""
        east, north = self.motion or motion or (0.0, 0.0)
        rate = np.deg2rad(np.hypot(east, north) / 3600)
        years = year - np.array(self.epochs or (_OLDEST_COORDINATES_YEAR, year))
        place = np.deg2rad(self.coordinates or (0.0, 0.0))
        moved = offset_by(*place, np.arctan2(east, north), rate * years)
        return np.array([each.radian for each in moved])

    def is_same(self, other: CatalogueStar) -> bool:
        """Whether two headers describe one star: coordinates decide, names where there are none."""
        alike = any(other.is_called(name) for name in self.names)
        apart = self.separation(other)
        if apart is None:
            return alike
        coarse = alike or self.pointing or other.pointing
        limit = _SAME_POINTING_ARCSEC if coarse else _SAME_STAR_ARCSEC
        if alike and self.motion is None and other.motion is None:
            # As far as a star may have moved since the epoch of a catalogue.
            latest = max((*self.epochs, *other.epochs), default=_OLDEST_COORDINATES_YEAR)
            limit = max(limit, _FASTEST_ARCSEC_YR * (latest - _OLDEST_COORDINATES_YEAR))
        return apart < limit


def star_of(header: fits.Header, name: str) -> CatalogueStar:
    """Read which star a header names, and where it is."""
    names = [header_text(header, key, name) for key in ("TARGPROP", "TARGNAME")]
    motion = _motion(header, name)
    if motion is not None and np.hypot(*motion) > _FASTEST_ARCSEC_YR:
        motion = None
    date, since = beginning(header, name), catalogue_epoch(header, name)
    epochs = [] if date is None else [float(date.jyear)]
    for keys in _COORDINATES:
        place = [header_number(header, key, name) for key in keys]
        # Files without a target have zeros.
        if None not in place and any(place):
            ra, dec = (float(each or 0.0) for each in place)
            if not -90 <= dec <= 90:
                raise card_error(name, keys[1], dec, "a declination in degrees")
            pointing = keys != _COORDINATES[0]
            if not pointing:
                epochs.insert(0, _OLDEST_COORDINATES_YEAR if since is None else float(since.jyear))
            return CatalogueStar(
                tuple(filter(None, names)), (ra, dec), pointing, motion, tuple(epochs)
            )
    return CatalogueStar(tuple(filter(None, names)), motion=motion)


def catalogue_epoch(header: fits.Header, name: str) -> Time | None:
    """Epoch of the catalogue's coordinates (MU_EPOCH), a date or a Julian year; None if unknown."""
    year = re.fullmatch(r"\s*(\d{4}(?:\.\d*)?)\s*", str(header.get("MU_EPOCH", "")))
    if year is not None:
        return Time(float(year[1]), format="jyear")
    return header_date(header, ("MU_EPOCH",), name)


def _motion(header: fits.Header, name: str) -> tuple[float, float] | None:
    """MU_RA and MU_DEC, arcsec per year; None if not stated, as by two zeros."""
    east, north = (header_number(header, key, name) for key in ("MU_RA", "MU_DEC"))
    # Proposals that do not state it have zeros.
    return None if east is None or north is None or not (east or north) else (east, north)


def proper_motion(header: fits.Header, name: str) -> tuple[float, float] | None:
    """Proper motion of the star, arcsec per year (MU_RA, which includes cos Dec, and MU_DEC).

    None if the header does not state it, or states two zeros, as for an empty proposal;
    CorruptFileError if no star moves as fast.
    """
    motion = _motion(header, name)
    if motion is not None and np.hypot(*motion) > _FASTEST_ARCSEC_YR:
        raise CorruptFileError(
            f"{name}: MU_RA and MU_DEC are {motion[0]:g} and {motion[1]:g}, expected arcsec per "
            f"year, less than {_FASTEST_ARCSEC_YR:g} in all. If these are milliarcseconds, divide "
            "them by 1000 in the header"
        )
    return motion


def common_motion(headers: Iterable[tuple[fits.Header, str]]) -> tuple[float, float] | None:
    """Proper motion of a star, arcsec per year, from several headers with the names of their files.

    The motion is the mean of what the headers state; None if no header states it.
    IncompatibleSetupError if two headers disagree.
    """
    known = [
        (name, motion)
        for header, name in headers
        if (motion := proper_motion(header, name)) is not None
    ]
    for (first, one), (second, other) in combinations(known, 2):
        if np.hypot(*np.subtract(one, other)) > _SAME_ARCSEC_YR:
            raise IncompatibleSetupError(
                f"the headers disagree on the star's proper motion (MU_RA, MU_DEC, arcsec per "
                f"year): got {one[0]:g}, {one[1]:g} in {first} and {other[0]:g}, {other[1]:g} in "
                f"{second}, expected the same to {_SAME_ARCSEC_YR:g}. Correct the headers, or give "
                "the motion as proper_motion (--proper-motion)"
            )
    if not known:
        return None
    east, north = np.mean([motion for _, motion in known], axis=0)
    return float(east), float(north)


# The exposure of a file, as its header describes it.

_MASK = re.compile(r"(?<![A-Z0-9])(?:SUB\d+|MASK)?[AB]?(?:MASK)?(\d{3}R|LWB|SWB)(?![A-Z0-9])")
"""A mask in CORONMSK (MASKA335R), APERNAME (NRCA5_MASK335R) or SUBARRAY (SUB320A335R)."""

_SAME_ANGLE_DEG = 0.1
"""Degrees by which the sum of two angles may differ from the sum in a card."""

_LONGEST_HALF_EXPOSURE_DAYS = 2.0
"""Days from the beginning of an exposure to its middle, or to the midnight before."""

_LAUNCH_MJD = 59573.0
"""Modified Julian date of the launch of JWST, 2021-12-25."""


@dataclass(frozen=True)
class Exposure:
    """The facts by which a file is admitted to a sequence, or not; None where not stated."""

    name: str
    level: str | None = None  # product of the pipeline, such as "calints"
    exposure_type: str | None = None  # EXP_TYPE
    identity: str | None = None  # see `identity_of`
    instrument: str | None = None
    detector: str | None = None
    mask: str | None = None  # without its module, such as MASK335R
    stop: str | None = None
    subarray: str | None = None
    filter: str | None = None
    unit: str | None = None  # BUNIT
    star: CatalogueStar = field(default_factory=CatalogueStar)
    reference: bool | None = None  # IS_PSF
    background: bool = False  # of the background (BKGDTARG)
    position_angle: float | None = None  # of +y, degrees east of north
    date: Time | None = None  # beginning, UTC
    offset: tuple[float, float] = (0.0, 0.0)  # XOFFSET, YOFFSET, arcsec; 0 where not stated
    integrations: int | None = None

    @classmethod
    def of(cls, header: fits.Header, name: str, shape: tuple[int, ...] = ()) -> Exposure:
        """Read the facts from the merged headers and the `shape` of the science data.

        CorruptFileError if a card holds something else than it should, or two cards contradict each
        other.
        """

        def text(key: str) -> str | None:
            value = header_text(header, key, name)
            return None if value is None else value.upper()

        mask = image_mask(header, name)
        stop = text("PUPIL")
        if stop is None and mask is not None:
            stop = "MASKRND" if mask.endswith("R") else "MASKBAR"
        x, y = (header_number(header, key, name) or 0.0 for key in ("XOFFSET", "YOFFSET"))
        return cls(
            name=name,
            level=level_of(header, name, len(shape)),
            exposure_type=text("EXP_TYPE"),
            identity=identity_of(header, name),
            instrument=instrument_of(header, name),
            detector=detector_of(header, name),
            mask=mask,
            stop=stop,
            subarray=text("SUBARRAY"),
            filter=text("FILTER"),
            unit=_unit(header, name),
            star=star_of(header, name),
            reference=is_reference(header),
            background=_flag(header, "BKGDTARG") is True,
            position_angle=position_angle(header, name),
            date=beginning(header, name),
            offset=(x, y),
            integrations=shape[0] if len(shape) == 3 else 1 if len(shape) == 2 else None,
        )

    @property
    def setup(self) -> tuple[str | None, ...]:
        """Instrument, mask, filter and unit, which frames that are reduced together share."""
        return (self.instrument, self.detector, self.mask, self.stop, self.filter, self.unit)


def image_mask(header: fits.Header, name: str) -> str | None:
    """Image mask of a coronagraph, from CORONMSK, APERNAME or SUBARRAY (SUB320A335R: MASK335R).

    "NONE" where the header says that there is none, None where it does not say; CorruptFileError if
    two of the cards name different masks.
    """
    stated: dict[str, str] = {}
    for key in ("CORONMSK", "APERNAME", "SUBARRAY"):
        text = (header_text(header, key, name) or "").upper()
        match = next(filter(None, map(_MASK.search, text.split("_"))), None)
        if match is not None:
            stated[key] = f"MASK{match[1]}"
        elif key == "CORONMSK" and text:
            # Masks of other instruments, or none.
            stated[key] = text
    if len(set(stated.values())) > 1:
        listed = ", ".join(f"{key} {header[key]}" for key in stated)
        raise CorruptFileError(
            f"{name}: {listed}: the cards name different masks. Correct the header, or fetch the "
            "file again"
        )
    return next(iter(stated.values()), None)


def module_of(header: fits.Header, name: str) -> str | None:
    """NIRCam's module, "A" or "B", from the detector or MODULE; "B" if one of them says so.

    None where the header does not say.
    """
    detector, stated = detector_of(header, name), header_text(header, "MODULE", name)
    letters = ((detector or "")[3:4], (stated or "").upper())
    return next((module for module in "BA" if module in letters), None)


def bar_place(header: fits.Header, name: str) -> str | None:
    """Place of the star along a bar, from APERNAME: a filter or "NARROW", see `detector_place`."""
    text = (header_text(header, "APERNAME", name) or "").upper()
    match = re.search(r"MASK[LS]WB_(F\d{3}W2?|F\d{3}M|F\d{3}N|NARROW)$", text)
    return match[1] if match else None


def _flag(header: fits.Header, key: str) -> bool | None:
    """Logical value of a card, which may be written as text or a number."""
    value = header.get(key)
    if isinstance(value, bool | int):
        return bool(value)
    return {"T": True, "TRUE": True, "F": False, "FALSE": False}.get(str(value).strip().upper())


def is_reference(header: fits.Header) -> bool | None:
    """Whether a header marks a reference star (IS_PSF); None if it does not say."""
    return _flag(header, "IS_PSF")


def position_angle(header: fits.Header, name: str) -> float | None:
    """Position angle of the +y axis of a JWST image, degrees east of north, from 0 to 360.

    None if the cards do not say; CorruptFileError if they contradict each other.
    """
    # ROLL_REF, of V3, with V3I_YANG, the angle from V3 to +y. Where the latter is missing, PA_APER
    # states the sum.
    roll, angle, parity, total = (
        header_number(header, key, name) for key in ("ROLL_REF", "V3I_YANG", "VPARITY", "PA_APER")
    )
    if roll is None:
        return None
    if angle is None:
        return None if total is None else full_circle(total)
    # -1 for every detector of JWST, in which x goes opposite to V2.
    turned = roll - angle * (-1.0 if parity is None else parity)
    if total is not None and abs(half_circle(turned - total)) > _SAME_ANGLE_DEG:
        raise card_error(name, "PA_APER", total, f"{turned:.3f}, by ROLL_REF and V3I_YANG")
    return full_circle(turned)


def beginning(header: fits.Header, name: str) -> Time | None:
    """Beginning of an exposure, UTC; None if the header does not say.

    The date is DATE-BEG, DATE-OBS with TIME-OBS, EXPSTART, or the day of DATE-OBS alone.
    CorruptFileError if a card does not hold a date.
    """
    dates = header_date(header, ("DATE-BEG",), name), day_and_time(header, name)
    date = next((each for each in dates if each is not None), None)
    if date is None:
        start = header_number(header, "EXPSTART", name)
        if start:
            date = Time(start, format="mjd", scale="utc")
        else:
            date = header_date(header, ("DATE-OBS",), name)
    if date is not None and date.mjd < _LAUNCH_MJD:
        raise CorruptFileError(
            f"{name}: the exposure began on {date.iso[:10]} by the header, before the launch of "
            "JWST. Correct DATE-BEG, DATE-OBS or EXPSTART, or fetch the file again"
        )
    return date


def middle(header: fits.Header, name: str) -> Time | None:
    """Middle of an exposure, UTC (EXPMID); None if the header does not say.

    CorruptFileError if the middle is more than two days from the beginning.
    """
    day = header_number(header, "EXPMID", name)
    if not day:
        return None
    start = beginning(header, name)
    if start is not None and abs(day - start.mjd) > _LONGEST_HALF_EXPOSURE_DAYS:
        raise card_error(name, "EXPMID", day, f"about {start.mjd:.2f}, when the exposure began")
    return Time(day, format="mjd", scale="utc")


def instrument_of(header: fits.Header, name: str) -> str | None:
    """Instrument, from INSTRUME or the detector; None if not stated."""
    stated = header_text(header, "INSTRUME", name)
    if stated is None and (detector_of(header, name) or "").startswith("NRC"):
        return "NIRCAM"
    return None if stated is None else stated.upper()


def _unit(header: fits.Header, name: str) -> str | None:
    """BUNIT, spelled as the pipeline does where it is the pipeline's."""
    stated = header_text(header, "BUNIT", name)
    usual = u.MJy / u.sr
    is_usual = stated is not None and u.Unit(stated, parse_strict="silent") == usual
    return "MJy/sr" if is_usual else stated
