"""Decide which files belong to a sequence, as what, and why the others do not.

The rules that look at headers are here; those that look at pixels are in `pixel_checks`.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from astropy import units as u
from astropy.io import fits
from astropy.time import Time

from pyklip_diffrender.errors import DiffrenderError, IncompatibleSetupError, NoValidPixelsError
from pyklip_diffrender.io.files import open_fits, product_in, unpacked_name
from pyklip_diffrender.io.headers import merged_header, same_name, unknown_name
from pyklip_diffrender.scene.associations import ListedFile, listed_files
from pyklip_diffrender.scene.exposure import CatalogueStar, Exposure
from pyklip_diffrender.scene.jwst_files import BEHIND_THE_MASK
from pyklip_diffrender.scene.observation import Observation

# Files of frames, and which of them cannot be used or are there twice.

_SENSED = "RESULT_PHASE"
"""Extension of wavefront-sensing files of MAST."""

_MAP = "it is a wavefront map, no frame of a star; wavefront maps are chosen with opd"

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
    """A file that may become part of a sequence."""

    path: Path
    exposure: Exposure
    star: str = ""  # the same for all files of the star
    reason: str = field(default="", repr=False)  # why it is excluded, or empty
    for_reference: bool = False  # asked for as a reference star's, whatever its header says
    is_product: bool = False  # made from frames, and has none
    place: tuple[float, float] | None = None  # x, y of the star, from 0, if not the header's
    # The mean of the integrations of each pointing, or why they cannot be read; None until needed.
    frames: Observation | DiffrenderError | None = field(default=None, repr=False)
    # The mean of the integrations of each pointing that are used, once they were read.
    observation: Observation | None = field(default=None, repr=False)

    @classmethod
    def in_hdus(
        cls, hdus: fits.HDUList, path: Path, *, frames: bool | Callable[[Exposure], bool]
    ) -> FrameFile:
        """Read the header of an open file, and the means of its frames if they are asked for."""
        product = _why_a_product(hdus)
        if product:
            return cls(path, Exposure(path.name), reason=product, is_product=True)
        try:
            science = hdus["SCI"]
            header = merged_header(hdus[0].header, science.header, path.name)
            shape = tuple(science.shape) if science.is_image else ()
            file = cls(path, Exposure.of(header, path.name, shape))
        except DiffrenderError as error:
            file = cls(path, Exposure(path.name), reason=_without_name(error, path.name))
        if frames if isinstance(frames, bool) else not file.reason and frames(file.exposure):
            try:
                file.frames = Observation.means_from_hdus(hdus, path)
            except DiffrenderError as error:
                file.frames = error
        return file

    @classmethod
    def opened(cls, path: Path, *, frames: bool | Callable[[Exposure], bool]) -> FrameFile:
        """Open a file once; read its header, and the means of its frames if they are asked for."""
        try:
            with open_fits(path, images=False) as hdus:
                return cls.in_hdus(hdus, path, frames=frames)
        except DiffrenderError as error:
            return cls(path, Exposure(path.name), reason=_without_name(error, path.name))

    @property
    def name(self) -> str:
        """Name of the file."""
        return self.path.name

    def read(self) -> Observation | None:
        """The means of the file, read once; None, with the reason, if it has none."""
        if self.observation is None and not self.reason:
            try:
                self.observation = self._means()
            except DiffrenderError as error:
                self.reason = _without_name(error, self.name)
        return self.observation

    def _means(self) -> Observation:
        """The mean of the integrations of each pointing that are used."""
        if isinstance(self.frames, DiffrenderError):
            raise self.frames
        if self.frames is None:
            return Observation.means_from_fits(self.path, star=self.place)
        return self.frames


def _without_name(error: Exception, name: str) -> str:
    return str(error).removeprefix(f"{name}: ")


def exposures_in(
    files: str | os.PathLike[str] | Iterable[str | os.PathLike[str]],
    references: Iterable[str | os.PathLike[str]] = (),
    filter: str | None = None,
) -> list[FrameFile]:
    """Find the files that are meant, and read their headers; raises as `listed_files`.

    Files that are all marked as those of reference stars are of the target if there are
    `references`. With a `filter`, the frames of its calints files are read at once, so that none of
    these is opened twice; files of other levels may be copies, which are not read.
    """

    def is_wanted(exposure: Exposure) -> bool:
        usable = same_name(exposure.filter, filter) and not _why_unusable(exposure)
        return usable and _rank(exposure) == 0

    frames = False if filter is None else is_wanted

    def opened(listed: ListedFile) -> FrameFile:
        path = listed.path
        if listed.reason:
            return FrameFile(path, Exposure(path.name), reason=listed.reason, is_product=True)
        file = FrameFile.opened(path, frames=frames)
        if listed.role == "science":
            file.exposure = replace(file.exposure, reference=False)
        return file

    found = listed_files(files)
    others = list(references)
    marked = [
        *(each for each in found if each.role == "psf"),
        *(listed_files(others) if others else ()),
    ]
    return with_references(
        [opened(each) for each in found if each.role != "psf"], list(map(opened, marked))
    )


def with_references(listed: list[FrameFile], marked: list[FrameFile]) -> list[FrameFile]:
    """Add files of reference stars, whatever their headers say, see `exposures_in`."""
    if marked and all(file.exposure.reference for file in listed if not file.is_product):
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
    product, what = product_in(hdus), ""
    if product:
        what = f"{product}, a product of pyklip_diffrender"
    elif "SCI" not in hdus and any(_is_map(hdu) for hdu in hdus):
        return _MAP
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


Judge = Callable[[Iterable[FrameFile]], None]
"""Reads files, and excludes those with wrong pixels, such as `sequence.judge_frames`."""


def admissible(files: Iterable[FrameFile]) -> list[FrameFile]:
    """Files that are not excluded."""
    return [each for each in files if not each.reason]


def exclude_unusable(files: Sequence[FrameFile], judge: Judge) -> None:
    """Exclude files that cannot be frames of a star behind a mask, and duplicates.

    Of several files of one exposure, `judge` decides which is the best that can be used.
    """
    for each in admissible(files):
        each.reason = _why_unusable(each.exposure)
    _exclude_duplicates(admissible(files), lambda each: str(each.path.resolve()), _same_file)
    # The same file, packed and unpacked.
    _exclude_duplicates(
        admissible(files), lambda each: unpacked_name(str(each.path.resolve())), _same_file
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
    judge: Judge | None = None,
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
        few = "the file cannot" if len(files) == 1 else f"none of {len(files)} files can"
        raise NoValidPixelsError(f"{few} be used: {reasons_of(files)}")


def reasons_of(files: Sequence[FrameFile]) -> str:
    """Why files are excluded, each reason once with the names of the first files it is for."""
    names: dict[str, list[str]] = {}
    for each in files:
        names.setdefault(each.reason, []).append(each.name)
    parts = []
    for reason, those in names.items():
        more = f" and {len(those) - 3} more" if len(those) > 3 else ""
        parts.append(f"{', '.join(those[:3])}{more}: {reason}")
    return "; ".join(parts)


# Decide which files belong to a sequence, as what, and why the others do not.

EPOCH = 5.0
"""Days between frames that may share a wavefront map."""


_TWO_STARS = 1.0
"""arcsec between stars with other names on one date that are not one star."""


def choose_filter(files: Sequence[FrameFile], filter: str | None, judge: Judge) -> str:
    """Exclude frames of other filters; returns the one that is left.

    IncompatibleSetupError if none was chosen and there are several, or none of the chosen one;
    NoValidPixelsError if no file states its filter.
    """
    for each in admissible(files):
        if each.exposure.filter is None:
            each.reason = "the header does not say through which FILTER it was taken"
    require_some(files)
    if filter is None and len({each.exposure.filter for each in admissible(files)}) > 1:
        judge(files)
        require_some(files)
    filter = _the_only("filter", filter, [each.exposure.filter for each in admissible(files)])
    for each in admissible(files):
        if not same_name(each.exposure.filter, filter):
            each.reason = f"taken through {each.exposure.filter}, not {filter}"
    return filter


def choose_target(
    files: Sequence[FrameFile], target: str | None, judge: Judge
) -> tuple[list[FrameFile], list[FrameFile]]:
    """Tell stars apart: the frames of the target and those of reference stars.

    IncompatibleSetupError, with the choices, if the target cannot be decided.
    """
    usable = admissible(files)
    stars = frames_by_star(usable)
    if target is None and len(stars) > 1:
        # Which star is the target must not depend on files that cannot be used.
        judge(usable)
        require_some(files)
        usable = admissible(files)
        stars = frames_by_star(usable)
    for star, frames in stars.items():
        for each in frames:
            each.star = star
    nameless = [each for each in usable if not each.exposure.star.is_known]
    if len(usable) == len(nameless) == 1:
        nameless[0].star = nameless[0].name
        stars, nameless = {nameless[0].name: nameless}, []
    if not stars and nameless:
        unmarked = [each for each in nameless if not each.exposure.reference]
        if len(unmarked) != 1:
            raise IncompatibleSetupError(
                f"target: the files {', '.join(each.name for each in nameless)} do not say of "
                "which star they are. Add TARGPROP, TARGNAME, or TARG_RA and TARG_DEC"
            )
        unmarked[0].star = unmarked[0].name
        stars, nameless = (
            {unmarked[0].star: unmarked},
            [e for e in nameless if e.exposure.reference],
        )
    if target is None:
        free = {
            star: frames for star, frames in stars.items()
            if not all(each.exposure.reference for each in frames)
        }  # fmt: skip
        if not free:
            _require_no_lost_target(files, stars)
        names = [each.star for frames in (free or stars).values() for each in frames]
        chosen = _the_only("target", None, names)
    else:
        called = [
            star for star, frames in stars.items()
            if same_name(star, target) or any(e.exposure.star.is_called(target) for e in frames)
        ]  # fmt: skip
        if not called:
            raise unknown_name("target", target, list(stars))
        # Two stars of that name in one folder: the one with more frames.
        chosen = max(called, key=lambda star: len(stars[star]))
        for star in called:
            for each in stars[star] if star != chosen else ():
                each.reason = _namesake(each.exposure.star, stars[chosen][0].exposure.star)
    references = [e for star, frames in stars.items() if star != chosen for e in frames]
    for each in nameless:
        if each.exposure.reference:
            each.star = f"reference star of {each.name}"
            references.append(each)
        else:
            each.reason = (
                "the header does not say which star it is. Add TARGPROP, TARGNAME, or TARG_RA and "
                "TARG_DEC, or IS_PSF for a reference star"
            )
    for each in stars[chosen]:
        if each.for_reference:
            each.reason = "a reference frame that shows the target itself"
    return admissible(stars[chosen]), admissible(references)


def _require_no_lost_target(
    files: Sequence[FrameFile], stars: Mapping[str, Sequence[FrameFile]]
) -> None:
    """Refuse to take a reference star for the target because the target's frames are excluded."""
    marked = [each.exposure.star for frames in stars.values() for each in frames]
    lost = [
        each for each in files
        if not each.exposure.reference
        and not each.is_product
        # Of some files it is not known which star they show.
        and (each.reason or not each.exposure.star.is_known)
        and not any(each.exposure.star.is_same(star) for star in marked)
    ]  # fmt: skip
    if lost:
        reasons = "; ".join(f"{e.name}: {e.reason or 'its star is not known'}" for e in lost)
        raise NoValidPixelsError(
            f"only frames that are marked as references (IS_PSF) can be used, of "
            f"{', '.join(stars)}. Name one of them as the target, or correct the others: {reasons}"
        )


def frames_by_star(files: Sequence[FrameFile]) -> dict[str, list[FrameFile]]:
    """Group frames by star, by the proposer's name that most of them have."""
    # A frame may be alike to several groups: by its name to one, by its coordinates to another.
    # They then become one.
    groups: list[list[FrameFile]] = []
    for each in files:
        if not each.exposure.star.is_known:
            continue
        alike = [
            group for group in groups
            if any(each.exposure.star.is_same(other.exposure.star) for other in group)
            and not any(_are_two_stars(each.exposure, other.exposure) for other in group)
        ]  # fmt: skip
        groups = [group for group in groups if group not in alike]
        groups.append([other for group in alike for other in group] + [each])
    stars: dict[str, list[FrameFile]] = {}
    for group in groups:
        names = Counter(each.exposure.star.names[:1] for each in group if each.exposure.star.names)
        place = next(
            (e.exposure.star.coordinates for e in group if e.exposure.star.coordinates), None
        )
        at = "" if place is None else "at {:.4f} {:+.4f}".format(*place)
        name = names.most_common(1)[0][0][0] if names else f"star {at}"
        if name in stars:
            name = f"{name} {at}"
        stars[name] = group
    return stars


def _are_two_stars(one: Exposure, other: Exposure) -> bool:
    """Whether two exposures of one epoch show stars with other names, more than an arcsec apart.

    The stars of a binary are; coordinates of one star may differ by more between epochs.
    """
    apart = one.star.separation(other.star)
    if apart is None or apart <= _TWO_STARS or not (one.star.names and other.star.names):
        return False
    if any(other.star.is_called(name) for name in one.star.names):
        return False
    if one.date is None or other.date is None:
        return False
    return bool(abs(one.date.mjd - other.date.mjd) <= EPOCH)


def _namesake(star: CatalogueStar, target: CatalogueStar) -> str:
    away = star.separation(target)
    distance = "somewhere else" if away is None else f"{away / 3600:.2f} deg from the target"
    return f"a star of the target's name whose TARG_RA and TARG_DEC are {distance}"


def exclude_other_setups(science: Sequence[FrameFile], references: Sequence[FrameFile]) -> None:
    """Keep the set-up that most of the target's usable frames have."""
    science, references = admissible(science), admissible(references)
    if not science:
        return
    counts = Counter(each.exposure.setup for each in science)
    everywhere = Counter(each.exposure.setup for each in (*science, *references))
    lengths: Counter[tuple[str | None, ...]] = Counter()
    for each in science:
        lengths[each.exposure.setup] += each.exposure.integrations or 0

    def preference(setup: tuple[str | None, ...]) -> tuple[float, ...]:
        # Of set-ups with as many frames of the target: the one with more cards, then with more
        # frames of all stars, then with more integrations.
        known = sum(part is not None for part in setup)
        return counts[setup], known, everywhere[setup], lengths[setup]

    majority = max(counts, key=preference)
    names = ("INSTRUME", "DETECTOR", "mask", "PUPIL", "FILTER", "BUNIT")
    for each in (*science, *references):
        different = [
            f"{name} is {own}, which they do not state; add the card"
            if other is None
            else f"{name} is {own or 'not stated'}, not {other}"
            for name, own, other in zip(names, each.exposure.setup, majority, strict=True)
            if own != other
        ]
        if different:
            whose = "the target's frames" if each in references else "most of the target's frames"
            each.reason = f"another set-up than {whose}: {', '.join(different)}"


def exclude_unoriented(science: Sequence[FrameFile]) -> None:
    """Exclude frames of the target whose roll or date is not known, where there are several.

    IncompatibleSetupError if it is known of none of them.
    """
    facts: tuple[tuple[str, Callable[[Exposure], object]], ...] = (
        ("orientation on the sky (ROLL_REF with V3I_YANG)", lambda each: each.position_angle),
        ("date (DATE-BEG, or DATE-OBS with TIME-OBS)", lambda each: each.date),
    )
    for fact, value in facts:
        frames = admissible(science)
        unknown = [each for each in frames if value(each.exposure) is None]
        if len(frames) < 2 or not unknown:
            continue
        if len(unknown) == len(frames):
            raise IncompatibleSetupError(
                f"{', '.join(each.name for each in frames)}: no header states the {fact}, which "
                "frames that are fitted together need. Add the cards, or reduce one file"
            )
        for each in unknown:
            each.reason = (
                f"the header does not state the {fact}, which frames that are fitted together "
                "need. Add the cards"
            )


def epochs_of(dates: Sequence[Time | None]) -> list[list[int]]:
    """Indices of frames by epoch, in order of time; what has no date belongs to the first."""
    dated = [(float(date.mjd), k) for k, date in enumerate(dates) if date is not None]
    groups: list[list[int]] = []
    first = -np.inf
    for day, k in sorted(dated):
        if day - first > EPOCH:
            groups.append([])
            first = day
        groups[-1].append(k)
    undated = [k for k, date in enumerate(dates) if date is None]
    return [undated + groups[0], *groups[1:]] if groups else [undated]


def _the_only(key: str, choice: str | None, values: Sequence[str | None]) -> str:
    """Return the requested value, or the only one in the files."""
    counts = Counter(str(value) for value in values)
    if choice is not None:
        if not any(same_name(choice, value) for value in counts):
            raise unknown_name(key, choice, counts)
        return choice
    if len(counts) > 1:
        raise IncompatibleSetupError(
            f"{key}: the files have {', '.join(f'{n} ({c})' for n, c in counts.items())}; choose "
            f"one with {key}=..."
        )
    return next(iter(counts))


# Requirements on observations that are fitted together.


def require_agreement(observations: Sequence[Observation]) -> None:
    """Raise IncompatibleSetupError for observations that cannot share a fit.

    The frames of each have one place and orientation, their dates are at most 5 days apart, and
    where the orientation of one is known, or the frames are real, it is known of all.
    """
    for each in observations:
        parts = each.pointings()
        if len(parts) > 1:
            raise IncompatibleSetupError(
                f"{each.name}: its {len(each)} frames show the star at {len(parts)} places or "
                "orientations, and the frames of an observation are averaged. Give its parts, "
                "observation.pointings(), as several observations"
            )
    if len(observations) < 2:
        return
    dated = [each for each in observations if each.date is not None]
    days = [float(each.date.mjd) for each in dated if each.date is not None]
    if days and max(days) - min(days) > EPOCH:
        listed = ", ".join(
            f"{each.name} ({each.date.isot[:10]})" for each in dated if each.date is not None
        )
        raise IncompatibleSetupError(
            f"observation: the wavefront of frames that are more than {EPOCH:g} days apart is not "
            f"the same: {listed}. Refine each epoch alone"
        )
    turning = [each for each in observations if not each.reference]
    unknown = [each for each in turning if each.position_angles is None]
    real = any(each.is_nircam for each in turning)
    if unknown and len(turning) > 1 and (real or len(unknown) < len(turning)):
        raise IncompatibleSetupError(
            f"{', '.join(each.name for each in unknown)}: the orientation on the sky is not known "
            "(ROLL_REF and V3I_YANG of the header, position_angles), and companions rotate with "
            "it. Add it, or refine one observation alone"
        )
