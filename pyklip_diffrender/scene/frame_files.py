"""Files of frames, and which of them cannot be used or are there twice."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from astropy import units as u
from astropy.io import fits

from pyklip_diffrender.errors import DiffrenderError, NoValidPixelsError
from pyklip_diffrender.io.files import open_fits
from pyklip_diffrender.io.headers import merged_header
from pyklip_diffrender.scene.exposure import Exposure
from pyklip_diffrender.scene.jwst_files import BEHIND_THE_MASK
from pyklip_diffrender.scene.observation import Observation

__all__ = [
    "FrameFile",
    "admissible",
    "exclude_unusable",
    "exposures_in",
    "require_some",
    "with_references",
]

_SUFFIXES = (".fits", ".fits.gz")

_SENSED = "RESULT_PHASE"
"""Extension of wavefront-sensing files of MAST."""

_MAP = "it is a wavefront map, no frame of a star; wavefront maps are chosen with opd (--opd)"

_USABLE = ("calints", "crfints", "cal", "crf", "rateints", "rate")
"""Levels of frames that are still those of the detector, the best first."""

_NOT_USABLE = {
    "i2d": "a resampled image (i2d), whose pixels are not the detector's",
    "psfsub": "an image from which the star was subtracted (psfsub)",
    "psfalign": "images of reference stars that were aligned (psfalign)",
    "psfstack": "a stack of reference stars (psfstack)",
}


_OTHER_TYPES = {
    "NRC_TACQ": "an image for acquiring the target",
    "NRC_TACONFIRM": "an image that confirms the acquisition of the target",
    "NRC_IMAGE": "an image without a coronagraph",
    "MIR_TACQ": "an image for acquiring the target",
    "MIR_TACONFIRM": "an image that confirms the acquisition of the target",
}


@dataclass(eq=False)
class FrameFile:
    """A file that may become part of a sequence.

    Attributes
    ----------
    path : Path
    exposure : Exposure
    star : str
        Name of its star, the same for all files of the star.
    reason : str
        Why the file is excluded; empty for those that are not.
    for_reference : bool
        Whether it was asked for as a file of a reference star, whatever its header says.
    is_product : bool
        Whether the file holds something that was made from frames, and no frames.
    place : tuple of float or None
        x, y of the star in the file, 0-indexed pixels, which replaces that of the header.
    frames : Observation or DiffrenderError, optional
        Its frames, one for every integration, or why they cannot be read; None for a file that is
        read when its frames are needed.
    observation : Observation or None
        The frames of integrations that are used, once they were read.
    """

    path: Path
    exposure: Exposure
    star: str = ""
    reason: str = field(default="", repr=False)
    for_reference: bool = False
    is_product: bool = False
    place: tuple[float, float] | None = None
    frames: Observation | DiffrenderError | None = field(default=None, repr=False)
    observation: Observation | None = field(default=None, repr=False)

    @classmethod
    def in_hdus(cls, hdus: fits.HDUList, path: Path, *, frames: bool) -> FrameFile:
        """Read the header of an open file, and its frames if they are asked for."""
        product = _why_a_product(hdus)
        if product:
            return cls(path, Exposure(path.name), reason=product, is_product=True)
        try:
            header = merged_header(hdus[0].header, hdus["SCI"].header, path.name)
            file = cls(path, Exposure.of(header, path.name, np.shape(hdus["SCI"].data)))
        except DiffrenderError as error:
            file = cls(path, Exposure(path.name), reason=_without_name(error, path.name))
        if frames:
            try:
                file.frames = Observation.from_hdus(hdus, path.name)
            except DiffrenderError as error:
                file.frames = error
        return file

    @classmethod
    def opened(cls, path: Path, *, frames: bool) -> FrameFile:
        """Open a file once, and read its header, and its frames if they are asked for."""
        try:
            with open_fits(path) as hdus:
                return cls.in_hdus(hdus, path, frames=frames)
        except DiffrenderError as error:
            return cls(path, Exposure(path.name), reason=_without_name(error, path.name))

    @property
    def name(self) -> str:
        """Name of the file."""
        return self.path.name

    def read(self) -> Observation | None:
        """The frames of integrations that are used, read once; None, with the reason, if none."""
        if self.observation is None and not self.reason:
            try:
                self.observation = self._used()
            except DiffrenderError as error:
                self.reason = _without_name(error, self.name)
        return self.observation

    def _used(self) -> Observation:
        """The frames of integrations that are used."""
        if isinstance(self.frames, DiffrenderError):
            raise self.frames
        if self.frames is None:
            return Observation.from_fits(self.path, star=self.place)
        used = self.frames.valid.any(axis=(1, 2))
        return self.frames if used.all() else self.frames.part(np.flatnonzero(used))


def _without_name(error: Exception, name: str) -> str:
    return str(error).removeprefix(f"{name}: ")


def exposures_in(
    files: str | os.PathLike[str] | Iterable[str | os.PathLike[str]],
    references: Iterable[str | os.PathLike[str]] = (),
) -> list[FrameFile]:
    """Find FITS files and read what their headers say.

    Parameters
    ----------
    files : path or sequence of path
        Files, or folders of them.
    references : iterable of path
        Files of reference stars. Files that are all marked as such, too, are then of the target.

    Raises
    ------
    NoValidPixelsError
        If there are no files.
    """
    entries = [files] if isinstance(files, str | os.PathLike) else list(files)
    paths: list[Path] = []
    for each in map(Path, entries):
        if each.is_dir():
            inside = sorted(p for p in each.iterdir() if p.name.lower().endswith(_SUFFIXES))
            if not inside:
                raise NoValidPixelsError(f"{each}: the folder has no FITS files")
            paths += inside
        else:
            paths.append(each)
    if not paths:
        raise NoValidPixelsError("files: got none, expected at least one")
    listed = [FrameFile.opened(path, frames=False) for path in paths]
    return with_references(
        listed, [FrameFile.opened(Path(path), frames=False) for path in references]
    )


def with_references(listed: list[FrameFile], marked: list[FrameFile]) -> list[FrameFile]:
    """Add files of reference stars, whatever their headers say, see `exposures_in`."""
    if marked and all(file.exposure.reference for file in listed):
        for file in listed:
            file.exposure = replace(file.exposure, reference=False)
    for file in marked:
        file.exposure = replace(file.exposure, reference=True)
        file.for_reference = True
    return listed + marked


def _why_a_product(hdus: fits.HDUList) -> str:
    """Why a file holds no frames but something made from them; empty for frames.

    Only the contents count: products keep cards of the frames, and may have any name.
    """
    first = hdus[0].header
    what = ""
    if "SCI" not in hdus and any(_is_map(hdu) for hdu in hdus):
        return _MAP
    if any(key in first for key in ("DRVERS", "PATVERS")):
        what = "a product of pyklip_diffrender"
    elif any(key in hdu.header for hdu in hdus[:2] for key in ("PYKLIPV", "PSFSUB")):
        what = "an image from which pyKLIP has subtracted the star"
    elif "SCI" not in hdus:
        names = ", ".join(hdu.name or "unnamed" for hdu in hdus)
        what = f"a file without an SCI extension ({names})"
        if any(key in first for key in ("OPD", "PUPILOPD", "PUPLSCAL", "WFSGUID", "TSTAMP")):
            what = f"an image of a model ({names}), without an SCI extension"
    return f"it is {what}; expected frames of stage 2 (calints)" if what else ""


def _is_map(hdu: Any) -> bool:
    """Whether an HDU has a map of path differences, as wavefront sensing writes them."""
    if hdu.name == _SENSED:
        return True
    unit = u.Unit(str(hdu.header.get("BUNIT", "")), parse_strict="silent")
    return bool(hdu.is_image and unit.is_equivalent(u.m))


def admissible(files: Iterable[FrameFile]) -> list[FrameFile]:
    """Files that are not excluded."""
    return [each for each in files if not each.reason]


def exclude_unusable(
    files: Sequence[FrameFile], judge: Callable[[Iterable[FrameFile]], None]
) -> None:
    """Exclude files that cannot be frames of a star behind a mask, and duplicates.

    Parameters
    ----------
    files : sequence of FrameFile
    judge : callable
        Reads files and excludes those with wrong pixels. Of several files of one exposure, it
        decides which is the best that can be used.
    """
    for each in admissible(files):
        each.reason = _why_unusable(each.exposure)
    _exclude_duplicates(admissible(files), lambda each: str(each.path.resolve()), _same_file)
    # The same file, packed and unpacked.
    _exclude_duplicates(
        admissible(files), lambda each: str(each.path.resolve()).removesuffix(".gz"), _same_file
    )
    _exclude_duplicates(admissible(files), _moment, _same_exposure, judge)


def _why_unusable(exposure: Exposure) -> str:
    level, kind = exposure.level, exposure.exposure_type
    if level is not None and level not in _USABLE:
        what = _NOT_USABLE.get(level, f"a product of another kind ({level})")
        return f"it is {what}; expected frames of stage 2 (calints)"
    if exposure.instrument not in (None, "NIRCAM"):
        return (
            f"it was taken with {exposure.instrument}; only NIRCam's coronagraph is built in. For "
            "another one, make the model with from_webbpsf or from_poppy, and fit with refine"
        )
    if kind not in (None, "NRC_CORON"):
        what = _OTHER_TYPES.get(kind, "no coronagraphic exposure")
        return f"EXP_TYPE is {kind}: {what}; expected NRC_CORON"
    if exposure.background:
        return "BKGDTARG is true: an exposure of the background, without a star"
    if exposure.mask == "NONE":
        return "CORONMSK is NONE: the star is not behind a mask"
    away = float(np.hypot(*exposure.offset))
    if away >= BEHIND_THE_MASK:
        x, y = exposure.offset
        unit = ""
        if away / 1000 < BEHIND_THE_MASK:
            unit = ". If these are milliarcseconds, divide them by 1000 in the header"
        return (
            f"XOFFSET and YOFFSET are {x:g} and {y:g} arcsec, expected less than "
            f"{BEHIND_THE_MASK:g} for a star behind the mask{unit}"
        )
    return ""


def _moment(file: FrameFile) -> tuple[object, ...] | None:
    """Identity, roll and time, which the files of one exposure share; None if they are not known.

    Copies whose headers were given another roll or date are no files of one exposure.
    """
    exposure = file.exposure
    if exposure.identity is None:
        return None
    angle, date = exposure.position_angle, exposure.date
    return (
        exposure.identity,
        None if angle is None else round(angle),
        None if date is None else round(date.mjd, 2),
    )


def _exclude_duplicates(
    files: Sequence[FrameFile],
    key: Callable[[FrameFile], object],
    reason: Callable[[FrameFile], str],
    judge: Callable[[Iterable[FrameFile]], None] | None = None,
) -> None:
    """Keep the file of the best level among those with one key, of those that can be used."""
    groups: dict[object, list[FrameFile]] = {}
    for each in files:
        value = key(each)
        if value is not None:
            groups.setdefault(value, []).append(each)
    for group in groups.values():
        ranked = sorted(group, key=lambda each: _rank(each.exposure))
        best = ranked[0]
        if judge is not None and len(ranked) > 1:
            for each in ranked:
                judge([each])
                if not each.reason:
                    best = each
                    break
        for each in ranked:
            if each is not best and not each.reason:
                each.reason = reason(best)


def _rank(exposure: Exposure) -> int:
    # A file whose name does not tell is most probably a copy of calints.
    level = exposure.level or ("calints" if exposure.unit == "MJy/sr" else "rate")
    return _USABLE.index(level)


def _same_file(best: FrameFile) -> str:
    return f"the same file as {best.name}"


def _same_exposure(best: FrameFile) -> str:
    return f"the same exposure as {best.name} ({best.exposure.identity}), which is used"


def require_some(files: Sequence[FrameFile]) -> None:
    """Raise `NoValidPixelsError`, with the reasons, if every file is excluded."""
    if not admissible(files):
        reasons = "; ".join(f"{each.name}: {each.reason}" for each in files)
        raise NoValidPixelsError(f"none of {len(files)} files can be used: {reasons}")
