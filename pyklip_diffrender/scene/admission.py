"""Decide which files belong to a sequence, as what, and why the others do not.

The rules that look at headers are here; those that look at pixels are in `pixel_checks`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence

import numpy as np
from astropy.time import Time

from pyklip_diffrender.errors import IncompatibleSetupError, NoValidPixelsError
from pyklip_diffrender.io.names import same_name, unknown_name
from pyklip_diffrender.scene.catalogue_star import CatalogueStar
from pyklip_diffrender.scene.exposure import Exposure
from pyklip_diffrender.scene.frame_files import FrameFile, admissible, require_some
from pyklip_diffrender.scene.measured_noise import why_odd_noise
from pyklip_diffrender.scene.observation import Observation
from pyklip_diffrender.scene.pixel_checks import (
    copies,
    why_no_star,
    why_odd_unit,
)

__all__ = [
    "EPOCH",
    "choose_filter",
    "choose_target",
    "epochs_of",
    "exclude_contradicting",
    "exclude_copies",
    "exclude_other_setups",
    "exclude_unoriented",
    "frames_by_star",
    "judge_frames",
]

EPOCH = 5.0
"""Days between frames that may share a wavefront map."""


_TWO_STARS = 1.0
"""arcsec between stars with other names on one date that are not one star."""


def choose_filter(files: Sequence[FrameFile], filter: str | None) -> str:
    """Exclude frames of other filters; returns the one that is left.

    Raises
    ------
    IncompatibleSetupError
        If no filter was chosen and there are several, or none of the chosen one.
    NoValidPixelsError
        If no file states its filter.
    """
    for each in admissible(files):
        if each.exposure.filter is None:
            each.reason = "the header does not say through which FILTER it was taken"
    require_some(files)
    if filter is None and len({each.exposure.filter for each in admissible(files)}) > 1:
        judge_frames(files)
        require_some(files)
    filter = _the_only("filter", filter, [each.exposure.filter for each in admissible(files)])
    for each in admissible(files):
        if not same_name(each.exposure.filter, filter):
            each.reason = f"taken through {each.exposure.filter}, not {filter}"
    return filter


def choose_target(
    files: Sequence[FrameFile], target: str | None
) -> tuple[list[FrameFile], list[FrameFile]]:
    """Tell stars apart; returns the frames of the target and those of reference stars.

    Raises
    ------
    IncompatibleSetupError
        If the target cannot be decided, with the choices.
    """
    usable = admissible(files)
    stars = frames_by_star(usable)
    if target is None and len(stars) > 1:
        # Which star is the target must not depend on files that cannot be used.
        judge_frames(usable)
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
        known = sum(part is not None for part in setup)
        return counts[setup], known, everywhere[setup], lengths[setup]

    majority = max(counts, key=preference)
    names = ("INSTRUME", "DETECTOR", "mask", "PUPIL", "FILTER", "BUNIT")
    for each in (*science, *references):
        different = [
            f"{name} is {own or 'not stated'}, not {other}"
            for name, own, other in zip(names, each.exposure.setup, majority, strict=True)
            if own != other
        ]
        if different:
            whose = "the target's frames" if each in references else "most of the target's frames"
            each.reason = f"another set-up than {whose}: {', '.join(different)}"


def exclude_unoriented(science: Sequence[FrameFile]) -> None:
    """Exclude frames of the target whose roll or date is not known, where there are several.

    Raises
    ------
    IncompatibleSetupError
        If it is known of none of them.
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


def judge_frames(files: Iterable[FrameFile]) -> None:
    """Read files, and exclude those whose pixels cannot be those of a star behind the mask.

    A file is read and judged once. Of frames whose star's position was stated by the user, it is
    not judged whether the star is there.
    """
    for each in admissible(files):
        if each.observation is not None:
            continue
        observation = each.read()
        if observation is not None:
            each.reason = (
                why_odd_noise(observation.noise_ratios)
                or why_odd_unit(observation)
                or ("" if each.place is not None else why_no_star(observation))
            )


def exclude_contradicting(
    files: Iterable[FrameFile],
    why: Callable[[Sequence[Observation]], Mapping[int, str]],
) -> None:
    """Exclude frames that contradict the others.

    Parameters
    ----------
    files : iterable of FrameFile
        Files that were read.
    why : callable
        Reasons by index, such as `pixel_checks.why_turned`.

    Raises
    ------
    IncompatibleSetupError
        If half of the target's frames or more are, and nothing says which are right.
    """
    usable = admissible(files)
    odd = why([_frames(each) for each in usable])
    if 2 * len(odd) >= len(usable) and odd and not usable[0].exposure.reference:
        names = ", ".join(each.name for each in usable)
        raise IncompatibleSetupError(
            f"{names} contradict each other: for {usable[min(odd)].name}, {odd[min(odd)]}. Leave "
            "out those that are wrong, or correct them"
        )
    for k, reason in odd.items():
        usable[k].reason = reason


def exclude_copies(files: Iterable[FrameFile]) -> None:
    """Exclude frames whose pixels are those of another file, whatever the headers say."""
    usable = admissible(files)
    for k, j in copies([_frames(each) for each in usable]).items():
        usable[k].reason = f"its pixels are those of {usable[j].name}: a copy of the exposure"


def _frames(file: FrameFile) -> Observation:
    assert file.observation is not None  # A file that could not be read has a reason.
    return file.observation


def epochs_of(dates: Sequence[Time | None]) -> list[list[int]]:
    """Indices of frames by epoch, in order of time; what has no date belongs to the first.

    Examples
    --------
    >>> from astropy.time import Time
    >>> epochs_of(Time(["2023-10-01", "2022-10-01", "2022-10-03"]))
    [[1, 2], [0]]
    """
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
