"""Decide which files belong to a sequence, as what, and why the others do not.

The rules that look at headers are here; those that look at pixels are in `pixel_checks`.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from astropy.time import Time

from pyklip_diffrender.errors import (
    DiffrenderError,
    IncompatibleSetupError,
    NoValidPixelsError,
)
from pyklip_diffrender.io.files import open_fits
from pyklip_diffrender.io.headers import merged_header
from pyklip_diffrender.io.names import same_name, unknown_name
from pyklip_diffrender.scene.exposure import Exposure, Star
from pyklip_diffrender.scene.jwst_files import BEHIND_THE_MASK
from pyklip_diffrender.scene.noise import why_odd_noise
from pyklip_diffrender.scene.observation import Observation
from pyklip_diffrender.scene.pixel_checks import (
    copies,
    why_no_star,
    why_odd_unit,
    why_other_brightness,
)

__all__ = [
    "EPOCH",
    "Candidate",
    "choose_filter",
    "choose_target",
    "compare_brightness",
    "epochs_of",
    "exclude_copies",
    "exclude_other_setups",
    "exclude_unoriented",
    "exclude_unusable",
    "exposures_in",
    "judge_frames",
    "require_some",
]

EPOCH = 5.0
"""Days between frames that may share a wavefront map."""

_SUFFIXES = (".fits", ".fits.gz")

_USABLE = ("calints", "crfints", "cal", "crf", "rateints", "rate")
"""Levels of frames that are still those of the detector, the best first."""

_NOT_USABLE = {
    "i2d": "a resampled image (i2d), whose pixels are not the detector's",
    "psfsub": "an image from which the star was subtracted (psfsub)",
    "psfalign": "images of reference stars that were aligned (psfalign)",
    "psfstack": "a stack of reference stars (psfstack)",
}

_CORONAGRAPHIC = ("NRC_CORON", "MIR_LYOT", "MIR_4QPM", "NIS_CORON")

_OTHER_TYPES = {
    "NRC_TACQ": "an image for acquiring the target",
    "NRC_TACONFIRM": "an image that confirms the acquisition of the target",
    "NRC_IMAGE": "an image without a coronagraph",
    "MIR_TACQ": "an image for acquiring the target",
    "MIR_TACONFIRM": "an image that confirms the acquisition of the target",
}


@dataclass(eq=False)
class Candidate:
    """A file that may become part of a sequence.

    Attributes
    ----------
    path : Path
    exposure : Exposure
    star : str
        Name of its star, the same for all files of the star.
    reason : str
        Why the file is excluded; empty for those that are not.
    """

    path: Path
    exposure: Exposure
    star: str = ""
    reason: str = field(default="", repr=False)

    @property
    def name(self) -> str:
        """Name of the file."""
        return self.path.name

    def read(self) -> Observation | None:
        """Read the frames; if they cannot be read, None, with the reason."""
        try:
            return Observation.from_fits(self.path)
        except DiffrenderError as error:
            self.reason = str(error).removeprefix(f"{self.name}: ")
            return None


def exposures_in(
    files: str | os.PathLike[str] | Iterable[str | os.PathLike[str]],
) -> list[Candidate]:
    """Find FITS files and read what their headers say.

    Parameters
    ----------
    files : path or sequence of path
        Files, or folders of them.

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
    return [_candidate(path) for path in paths]


def _candidate(path: Path) -> Candidate:
    try:
        with open_fits(path) as hdus:
            header, shape = hdus[0].header, ()
            if "SCI" in hdus:
                header = merged_header(header, hdus["SCI"].header, path.name)
                shape = np.shape(hdus["SCI"].data)
            return Candidate(path, Exposure.of(header, path.name, shape))
    except DiffrenderError as error:
        return Candidate(path, Exposure(path.name), reason=str(error))


def left(candidates: Iterable[Candidate]) -> list[Candidate]:
    """Those that are not excluded."""
    return [each for each in candidates if not each.reason]


def exclude_unusable(candidates: Sequence[Candidate]) -> None:
    """Exclude files that cannot be frames of a star behind a mask, and duplicates."""
    for each in left(candidates):
        each.reason = _why_unusable(each.exposure)
    _exclude_duplicates(left(candidates), lambda each: str(each.path.resolve()), _same_file)
    # The same file, packed and unpacked.
    _exclude_duplicates(
        left(candidates), lambda each: str(each.path.resolve()).removesuffix(".gz"), _same_file
    )
    _exclude_duplicates(left(candidates), _moment, _same_exposure)


def _why_unusable(exposure: Exposure) -> str:
    level, kind = exposure.level, exposure.exposure_type
    if level is not None and level not in _USABLE:
        what = _NOT_USABLE.get(level, f"a product of another kind ({level})")
        return f"it is {what}; expected frames of stage 2 (calints)"
    if kind is not None and kind not in _CORONAGRAPHIC:
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


def _moment(candidate: Candidate) -> tuple[object, ...] | None:
    """What the files of one exposure have in common; None if that is not known.

    Copies whose headers were given another roll or date are no files of one exposure.
    """
    exposure = candidate.exposure
    if exposure.identity is None:
        return None
    angle, date = exposure.position_angle, exposure.date
    return (
        exposure.identity,
        None if angle is None else round(angle),
        None if date is None else round(date.mjd, 2),
    )


def _exclude_duplicates(
    candidates: Sequence[Candidate],
    key: Callable[[Candidate], object],
    reason: Callable[[Candidate], str],
) -> None:
    """Keep the file of the best level among those with one key."""
    groups: dict[object, list[Candidate]] = {}
    for each in candidates:
        value = key(each)
        if value is not None:
            groups.setdefault(value, []).append(each)
    for group in groups.values():
        best = min(group, key=lambda each: _rank(each.exposure))
        for each in group:
            if each is not best:
                each.reason = reason(best)


def _rank(exposure: Exposure) -> int:
    # A file whose name does not tell is most probably a copy of calints.
    level = exposure.level or ("calints" if exposure.unit == "MJy/sr" else "rate")
    return _USABLE.index(level)


def _same_file(best: Candidate) -> str:
    return f"the same file as {best.name}"


def _same_exposure(best: Candidate) -> str:
    return f"the same exposure as {best.name} ({best.exposure.identity}), which is used"


def choose_filter(candidates: Sequence[Candidate], filter: str | None) -> str:
    """Exclude frames of other filters; returns the one that is left.

    Raises
    ------
    IncompatibleSetupError
        If no filter was chosen and there are several, or none of the chosen one.
    NoValidPixelsError
        If no file states its filter.
    """
    for each in left(candidates):
        if each.exposure.filter is None:
            each.reason = "the header does not say through which FILTER it was taken"
    require_some(candidates)
    filter = _the_only("filter", filter, [each.exposure.filter for each in left(candidates)])
    for each in left(candidates):
        if not same_name(each.exposure.filter, filter):
            each.reason = f"taken through {each.exposure.filter}, not {filter}"
    return filter


def choose_target(
    candidates: Sequence[Candidate], target: str | None
) -> tuple[list[Candidate], list[Candidate]]:
    """Tell stars apart; returns the frames of the target and those of reference stars.

    Raises
    ------
    IncompatibleSetupError
        If the target cannot be decided, with the choices.
    """
    usable = left(candidates)
    stars = _by_star(usable)
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
            _require_no_lost_target(candidates, stars)
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
    return stars[chosen], left(references)


def _require_no_lost_target(
    candidates: Sequence[Candidate], stars: Mapping[str, Sequence[Candidate]]
) -> None:
    """Refuse to take a reference star for the target because the target's frames are excluded."""
    marked = [each.exposure.star for frames in stars.values() for each in frames]
    lost = [
        each for each in candidates
        if each.reason and each.exposure.star.is_known and not each.exposure.reference
        and not any(each.exposure.star.is_same(star) for star in marked)
    ]  # fmt: skip
    if lost:
        reasons = "; ".join(f"{each.name}: {each.reason}" for each in lost)
        raise NoValidPixelsError(
            f"only frames that are marked as references (IS_PSF) can be used, of "
            f"{', '.join(stars)}. Name one of them as the target, or correct the others: {reasons}"
        )


def _by_star(candidates: Sequence[Candidate]) -> dict[str, list[Candidate]]:
    """Group frames by star, by the proposer's name that most of them have."""
    groups: list[list[Candidate]] = []
    for each in candidates:
        if not each.exposure.star.is_known:
            continue
        alike = [
            group for group in groups
            if any(each.exposure.star.is_same(other.exposure.star) for other in group)
        ]  # fmt: skip
        groups = [group for group in groups if group not in alike]
        groups.append([other for group in alike for other in group] + [each])
    stars: dict[str, list[Candidate]] = {}
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


def _namesake(star: Star, target: Star) -> str:
    away = star.separation(target)
    distance = "somewhere else" if away is None else f"{away / 3600:.2f} deg from the target"
    return f"a star of the target's name whose TARG_RA and TARG_DEC are {distance}"


def exclude_other_setups(science: Sequence[Candidate], references: Sequence[Candidate]) -> None:
    """Keep the set-up that most of the target's frames have."""
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


def exclude_unoriented(science: Sequence[Candidate]) -> None:
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
        frames = left(science)
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


def judge_frames(candidates: Iterable[Candidate], frames: Mapping[int, Observation | None]) -> None:
    """Exclude frames whose pixels cannot be those of a star behind the mask.

    Parameters
    ----------
    candidates : iterable of Candidate
    frames : mapping of int to Observation
        By the `id` of the candidate.
    """
    for each in candidates:
        observation = frames[id(each)]
        if observation is not None:
            each.reason = (
                why_odd_noise(observation.noise_ratios)
                or why_odd_unit(observation)
                or why_no_star(observation)
            )


def compare_brightness(
    candidates: Iterable[Candidate], frames: Mapping[int, Observation | None]
) -> None:
    """Exclude frames that are much brighter or fainter than the others of their star.

    Raises
    ------
    IncompatibleSetupError
        If half of the frames or more are, and nothing says which are right.
    """
    usable = left(candidates)
    odd = why_other_brightness([_known(frames[id(each)]) for each in usable])
    if 2 * len(odd) >= len(usable) and odd and not usable[0].exposure.reference:
        names = ", ".join(each.name for each in usable)
        raise IncompatibleSetupError(
            f"{names} contradict each other: for {usable[min(odd)].name}, {odd[min(odd)]}. Leave "
            "out those that are wrong, or correct them"
        )
    for k, reason in odd.items():
        usable[k].reason = reason


def exclude_copies(
    candidates: Iterable[Candidate], frames: Mapping[int, Observation | None]
) -> None:
    """Exclude frames whose pixels are those of another file, whatever the headers say."""
    usable = left(candidates)
    for k, j in copies([_known(frames[id(each)]) for each in usable]).items():
        usable[k].reason = f"its pixels are those of {usable[j].name}: a copy of the exposure"


def _known(observation: Observation | None) -> Observation:
    assert observation is not None  # A candidate that could not be read has a reason.
    return observation


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


def require_some(candidates: Sequence[Candidate]) -> None:
    """Raise `NoValidPixelsError`, with the reasons, if every file is excluded."""
    if not left(candidates):
        reasons = "; ".join(f"{each.name}: {each.reason}" for each in candidates)
        raise NoValidPixelsError(f"none of {len(candidates)} files can be used: {reasons}")


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
