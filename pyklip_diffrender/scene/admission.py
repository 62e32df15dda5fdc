"""Decide which files belong to a sequence, as what, and why the others do not.

The rules that look at headers are here, the rules that look at pixels in `pixel_checks`.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from astropy.time import Time

from pyklip_diffrender.errors import IncompatibleSetupError, NoValidPixelsError
from pyklip_diffrender.io.files import unpacked_name
from pyklip_diffrender.io.headers import same_name, unknown_name
from pyklip_diffrender.scene.associations import ListedFile, listed_files
from pyklip_diffrender.scene.exposure import CatalogueStar, Exposure
from pyklip_diffrender.scene.frame_file import FrameFile
from pyklip_diffrender.scene.jwst_files import BEHIND_THE_MASK
from pyklip_diffrender.scene.observation import Observation
from pyklip_diffrender.scene.pixel_checks import why_other_brightness, why_turned

EPOCH = 5.0
"""Days between frames that may share an OPD map."""

_TWO_STARS_ARCSEC = 1.0
"""arcsec between two stars of different names on one date, beyond which they are not one star."""

_USABLE = ("calints", "crfints", "cal", "crf", "rateints", "rate")
"""Levels of frames with the detector's own pixels, the best first."""

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
}


Reasons = dict[FrameFile, str]
"""Why files are left out: what a rule makes of the files that it gets."""


class Admission:
    """Files that may become part of a sequence, and why some of them are left out."""

    def __init__(self, files: Iterable[FrameFile]) -> None:
        self.files = list(files)
        self.reasons: Reasons = {each: each.fault for each in self.files if each.fault}

    def copy(self) -> Admission:
        """A copy from which other files can be left out."""
        copied = Admission(self.files)
        copied.reasons |= self.reasons
        return copied

    def left(self, files: Iterable[FrameFile] | None = None) -> list[FrameFile]:
        """Files that are not left out, among `files` or by default all."""
        return [e for e in (self.files if files is None else files) if e not in self.reasons]

    def apply(self, rule: Callable[..., Reasons], *groups: Iterable[FrameFile]) -> None:
        """Leave files out by a rule, which gets the files left in each group, by default all."""
        self.reasons |= rule(*map(self.left, groups or (self.files,)))

    def require_some(self) -> None:
        """Raise `NoValidPixelsError`, with the reasons, if every file is left out."""
        if not self.left():
            count = len(self.files)
            few = "the file cannot" if count == 1 else f"none of {count} files can"
            raise NoValidPixelsError(f"{few} be used: {self.in_words(self.files)}")

    def in_words(self, files: Iterable[FrameFile]) -> str:
        """Why files are left out, each reason once with the first files that it is for."""
        names: dict[str, list[str]] = {}
        for each in files:
            names.setdefault(self.reasons[each], []).append(each.name)
        parts = []
        for reason, those in names.items():
            more = f" and {len(those) - 3} more" if len(those) > 3 else ""
            parts.append(f"{', '.join(those[:3])}{more}: {reason}")
        return "; ".join(parts)


def admitted(files: Iterable[FrameFile]) -> Admission:
    """Leave out what cannot be a frame of a star behind a mask, and duplicates.

    Raises `NoValidPixelsError` if no file is left.
    """
    admission = Admission(files)
    for rule in (_without_star, _same_files, _same_exposures):
        admission.apply(rule)
    admission.require_some()
    return admission


def exposures_in(
    files: str | os.PathLike[str] | Iterable[str | os.PathLike[str]],
    references: Iterable[str | os.PathLike[str]] = (),
    filter: str | None = None,
) -> list[FrameFile]:
    """Find the files that are meant, and read their headers; raises as `listed_files`.

    If all files are marked as frames of reference stars, they are of the target if there are
    `references`. With a `filter`, the frames of its calints files are read at once, so that none of
    these is opened twice; files of other levels may be copies, which are not read.
    """

    def are_wanted(exposure: Exposure) -> bool:
        usable = same_name(exposure.filter, filter) and not _why_unusable(exposure)
        return filter is not None and usable and _rank(exposure) == 0

    def opened(listed: ListedFile) -> FrameFile:
        path = listed.path
        if listed.reason:
            return FrameFile(path, Exposure(path.name), listed.reason, is_product=True)
        file = FrameFile.opened(path, are_wanted)
        return file.marked(reference=False) if listed.role == "science" else file

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
        listed = [file.marked(reference=False) for file in listed]
    return listed + [replace(file.marked(reference=True), for_reference=True) for file in marked]


# Rules for files one by one, and for files of one exposure.


def _without_star(files: Iterable[FrameFile]) -> Reasons:
    """Files that cannot be frames of a star behind a mask, by their headers."""
    return {each: reason for each in files if (reason := _why_unusable(each.exposure))}


def with_odd_pixels(files: Iterable[FrameFile]) -> Reasons:
    """Read the pixels, and find files that cannot be frames of a star behind a mask."""
    return {each: each.fault_of_pixels for each in files if each.fault_of_pixels}


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
    """Identity, roll and time, which files of one exposure share; None if they are not known."""
    exposure = file.exposure
    if exposure.identity is None:
        return None
    angle, date = exposure.position_angle, exposure.date
    return (
        exposure.identity,
        None if angle is None else round(angle),
        None if date is None else round(date.mjd, 2),
    )


def _same_files(files: Iterable[FrameFile]) -> Reasons:
    """Files given twice, also packed and unpacked."""
    reasons: Reasons = {}
    for group in _groups(files, lambda each: unpacked_name(str(each.path.resolve()))):
        best, *others = sorted(group, key=lambda each: _rank(each.exposure))
        reasons |= dict.fromkeys(others, f"the same file as {best.name}")
    return reasons


def _same_exposures(files: Iterable[FrameFile]) -> Reasons:
    """Files of one exposure, except the best file whose pixels can be used."""
    reasons: Reasons = {}
    for group in _groups(files, _moment):
        ranked = sorted(group, key=lambda each: _rank(each.exposure))
        odd: Reasons = {}
        best = ranked[0]
        for each in ranked if len(ranked) > 1 else ():
            if not each.fault_of_pixels:
                best = each
                break
            odd[each] = each.fault_of_pixels
        same = f"the same exposure as {best.name} ({best.exposure.identity}), which is used"
        reasons |= {each: same for each in ranked if each is not best} | odd
    return reasons


def _groups(
    files: Iterable[FrameFile], key: Callable[[FrameFile], object]
) -> Iterable[list[FrameFile]]:
    """Files with one key; files whose key is None belong to no group."""
    groups: dict[object, list[FrameFile]] = {}
    for each in files:
        value = key(each)
        if value is not None:
            groups.setdefault(value, []).append(each)
    return groups.values()


def _rank(exposure: Exposure) -> int:
    # A file whose name does not tell is most probably a copy of calints.
    level = exposure.level or ("calints" if exposure.unit == "MJy/sr" else "rate")
    return _USABLE.index(level)


def choose_filter(admission: Admission, filter: str | None) -> str:
    """Leave out frames of other filters; returns the filter that is left.

    IncompatibleSetupError if no filter was chosen and the files have several, or if no file has the
    chosen filter; NoValidPixelsError if no file states its filter.
    """
    admission.apply(_without_filter)
    admission.require_some()
    if filter is None and len({each.exposure.filter for each in admission.left()}) > 1:
        admission.apply(with_odd_pixels)
        admission.require_some()
    chosen = _the_only("filter", filter, [each.exposure.filter for each in admission.left()])
    admission.apply(lambda files: {
        each: f"taken through {each.exposure.filter}, not {chosen}"
        for each in files if not same_name(each.exposure.filter, chosen)
    })  # fmt: skip
    return chosen


def _without_filter(files: Iterable[FrameFile]) -> Reasons:
    reason = "the header does not say through which FILTER it was taken"
    return {each: reason for each in files if each.exposure.filter is None}


def choose_target(
    admission: Admission, target: str | None
) -> tuple[str, dict[str, list[FrameFile]]]:
    """Tell stars apart: the name of the target, and the frames of every star.

    IncompatibleSetupError, with the choices, if the target cannot be decided.
    """
    if target is None and len(frames_by_star(admission.left())) > 1:
        # Which star is the target must not depend on files that cannot be used.
        admission.apply(with_odd_pixels)
        admission.require_some()
    usable = admission.left()
    if len(usable) == 1 and not usable[0].exposure.star.is_known:
        stars = {usable[0].name: usable}
    else:
        admission.apply(_nameless)
        admission.require_some()
        stars = frames_by_star(admission.left())
    if target is None:
        free = {
            star: frames for star, frames in stars.items()
            if not all(each.exposure.reference for each in frames)
        }  # fmt: skip
        if not free:
            _require_no_lost_target(admission, stars)
        choices = free or stars
        chosen = _the_only("target", None, [star for star in choices for _ in choices[star]])
    else:
        called = [
            star for star, frames in stars.items()
            if same_name(star, target) or any(e.exposure.star.is_called(target) for e in frames)
        ]  # fmt: skip
        if not called:
            raise unknown_name("target", target, list(stars))
        # Two stars of that name in one folder: the one with more frames.
        chosen = max(called, key=lambda star: len(stars[star]))
        star = stars[chosen][0].exposure.star
        admission.apply(
            lambda files: {each: _namesake(each.exposure.star, star) for each in files},
            [each for name in called if name != chosen for each in stars[name]],
        )
    admission.apply(_showing_the_target, stars[chosen])
    return chosen, stars


def _nameless(files: Iterable[FrameFile]) -> Reasons:
    reason = (
        "the header does not say which star it is. Add TARGPROP, TARGNAME, or TARG_RA and "
        "TARG_DEC, or IS_PSF for a reference star"
    )
    return {
        each: reason for each in files
        if not each.exposure.star.is_known and not each.exposure.reference
    }  # fmt: skip


def _showing_the_target(science: Iterable[FrameFile]) -> Reasons:
    reason = "a reference frame that shows the target itself"
    return {each: reason for each in science if each.for_reference}


def _require_no_lost_target(admission: Admission, stars: Mapping[str, Sequence[FrameFile]]) -> None:
    """Refuse to take a reference star for the target because the target's frames are left out."""
    marked = [each.exposure.star for frames in stars.values() for each in frames]
    lost = [
        each for each in admission.files
        if each in admission.reasons
        and not each.exposure.reference
        and not each.is_product
        and not any(each.exposure.star.is_same(star) for star in marked)
    ]  # fmt: skip
    if lost:
        reasons = "; ".join(f"{each.name}: {admission.reasons[each]}" for each in lost)
        raise NoValidPixelsError(
            f"only frames that are marked as references (IS_PSF) can be used, of "
            f"{', '.join(stars)}. Name one of them as the target, or correct the others: {reasons}"
        )


def frames_by_star(files: Sequence[FrameFile]) -> dict[str, list[FrameFile]]:
    """Group frames by star, by the proposer's name that most of them have.

    Frames of reference stars that are not known are stars of their own.
    """
    # A frame may belong to several groups: by its name to one, by its coordinates to another.
    # These groups are then joined.
    groups: list[list[FrameFile]] = []
    for each in files:
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
        if not group[0].exposure.star.is_known:
            name = f"reference star of {group[0].name}"
        if name in stars:
            name = f"{name} {at}"
        stars[name] = group
    return stars


def _are_two_stars(one: Exposure, other: Exposure) -> bool:
    """Whether two exposures of one epoch show stars of other names, more than an arcsec apart.

    This tells the stars of a binary; between epochs, coordinates of one star may differ by more.
    """
    apart = one.star.separation(other.star)
    if apart is None or apart <= _TWO_STARS_ARCSEC or not (one.star.names and other.star.names):
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


def of_other_setups(science: Sequence[FrameFile], references: Sequence[FrameFile]) -> Reasons:
    """Frames without the set-up that most of the target's usable frames have."""
    reasons: Reasons = {}
    if not science:
        return reasons
    counts = Counter(each.exposure.setup for each in science)
    everywhere = Counter(each.exposure.setup for each in (*science, *references))
    lengths: Counter[tuple[str | None, ...]] = Counter()
    for each in science:
        lengths[each.exposure.setup] += each.exposure.integrations or 0

    def preference(setup: tuple[str | None, ...]) -> tuple[float, ...]:
        # Among set-ups with as many frames of the target, more cards are preferred, then more
        # frames of all stars, then more integrations.
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
            reasons[each] = f"another set-up than {whose}: {', '.join(different)}"
    return reasons


def unoriented(science: Sequence[FrameFile]) -> Reasons:
    """Frames of the target whose roll or date is not known, where there are several frames.

    IncompatibleSetupError if no frame has the roll or the date.
    """
    facts: tuple[tuple[str, Callable[[Exposure], object]], ...] = (
        ("orientation on the sky (ROLL_REF with V3I_YANG)", lambda each: each.position_angle),
        ("date (DATE-BEG, or DATE-OBS with TIME-OBS)", lambda each: each.date),
    )
    reasons: Reasons = {}
    for fact, value in facts:
        frames = [each for each in science if each not in reasons]
        unknown = [each for each in frames if value(each.exposure) is None]
        if len(frames) < 2 or not unknown:
            continue
        if len(unknown) == len(frames):
            raise IncompatibleSetupError(
                f"{', '.join(each.name for each in frames)}: no header states the {fact}, which "
                "frames that are fitted together need. Add the cards, or reduce one file"
            )
        reasons |= dict.fromkeys(
            unknown,
            f"the header does not state the {fact}, which frames that are fitted together need. "
            "Add the cards",
        )
    return reasons


def turned(files: Sequence[FrameFile]) -> Reasons:
    """Frames whose pixels are mirrored or turned, see `why_turned`."""
    return _contradicting(files, why_turned(_frames(files)))


def of_other_brightness(files: Sequence[FrameFile]) -> Reasons:
    """Frames in which a star is much brighter or fainter than in its other frames."""
    return _contradicting(files, why_other_brightness(_frames(files)))


def _contradicting(files: Sequence[FrameFile], odd: Mapping[int, str]) -> Reasons:
    """Frames that contradict the others, by reasons for their indices.

    IncompatibleSetupError if half of the target's frames or more do, and nothing says which are
    right.
    """
    if 2 * len(odd) >= len(files) and odd and not files[0].exposure.reference:
        names = ", ".join(each.name for each in files)
        raise IncompatibleSetupError(
            f"{names} contradict each other: for {files[min(odd)].name}, {odd[min(odd)]}. Leave "
            "out the wrong files, or correct them"
        )
    return {files[k]: reason for k, reason in odd.items()}


def _frames(files: Sequence[FrameFile]) -> list[Observation]:
    """Frames of files that were judged, each of which has frames."""
    return [each.observation for each in files if each.observation is not None]


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
    dated = [(each.name, each.date) for each in observations if each.date is not None]
    days = [float(date.mjd) for _, date in dated]
    if days and max(days) - min(days) > EPOCH:
        listed = ", ".join(f"{name} ({date.isot[:10]})" for name, date in dated)
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
            "it. Add the orientation, or refine one observation alone"
        )
