"""Frames of reference stars in one likelihood with the target's frames.

The target is fitted first. The frames of reference stars of the same visit are then aligned with
its wavefront, and a few steps fit all frames together: with one wavefront, but for a drift from
exposure to exposure whose size is measured, and with one detector pattern on the pixels of the
detector. What speaks against a frame is looked at in this order:

1. Frames that the target's wavefront is far from explaining, or whose star is too faint, do not
   take part. If it explains them together with a point source beside the star, that is subtracted
   and masked.
2. A companion of a reference star that the joint fit shows is treated in the same way.
3. Frames of a reference star that the joint fit does not explain as well as it does the target's
   are left out.
4. Limits of all frames together are compared with limits of the target's frames alone, which
   may have the library's pattern. At every separation the deeper ones are used (`deeper`); where
   the target alone was fitted roughly, one of the two fits is kept as a whole.
"""

from __future__ import annotations

import itertools
import logging
import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.special import chdtri

from pyklip_diffrender.detection import (
    Detection,
    ReferenceSource,
    deeper,
    detect,
    sources_of_references,
    stated_limits,
)
from pyklip_diffrender.detection.field import ring_pixels
from pyklip_diffrender.detection.templates import Templates
from pyklip_diffrender.errors import DiffrenderError
from pyklip_diffrender.io.progress import counted, stage
from pyklip_diffrender.pattern import PatternChoice, pattern_for_visit, with_known_pattern
from pyklip_diffrender.refinement import FitSettings, FrameFit, Refinement, align_frame, join_frames
from pyklip_diffrender.scene.detector_pattern import DetectorPattern
from pyklip_diffrender.scene.objects import Planet
from pyklip_diffrender.scene.observation import Observation
from pyklip_diffrender.wavefront.priors import WavefrontPrior

_log = logging.getLogger(__name__)

_SLEWS = WavefrontPrior(scales={"segment": 0.75, "texture": 0.5}, knee=1.0, slope=1.0)
_DITHERS = WavefrontPrior(scales={"segment": 0.4, "texture": 0.25}, knee=1.0, slope=1.0)
_DRIFT_CYCLES = 8.0
"""Drift of the wavefront, nm, between exposures with a slew between them and between the dithers of
one of them: 2.7 and 1.4 nm rms to begin with, and as the frames themselves show it, from a fourth
of that up to 11 nm. The heaters of the instruments' electronics alone change it by 1 to 2 nm within
minutes (R. Telfer et al. 2024, SPIE 13092), and it drifts by 9 nm within days (Feng et al. 2025,
section 4). Modes finer than 8 cycles per pupil belong to the polished segments,
which last; with 12 cycles, limits of a simulated visit are the same within 1 %, and take a quarter
longer."""

_JOINT_FIT_TOLERANCE = 3e-4
"""`FitSettings.tolerance` of the joint fit: 13 units of chi-squared for seven frames."""

_ROUGH_TOLERANCE = 1e-3
"""`FitSettings.tolerance` of the fit of the target alone, before the joint fit."""

_CONTRADICTING_CHI2_RATIO = 1.5
"""Chi-squared per pixel of a reference frame over the target's, from which the frame contradicts
the target."""

_UNLIKE_STAR_RATIO = 0.14
"""Part of a star's light that the target's wavefront leaves unexplained, at 4.4 um, from which a
frame spoils the fit of all and lets it converge slowly. In frames of stpsf whose wavefronts differ
by 2 nm it was 0.05, between real stars hours apart 0.125, and 0.155 to 0.165 for AU Mic with its
disk. It grows as 1 / wavelength."""

_JOINT_FIT_STEPS = 20
"""Largest number of steps of the joint fit. Fits that converged took 7 to 12."""

_FAINT_REFERENCE_FLUX_RATIO = 0.05
"""Flux of a reference star over the target's below which its frames teach nothing: their noise is
20 times the target's, relative to the star."""

_MASKED_COMPANION_LAMBDA_D = 1.5
"""Radius of the mask about a companion of a reference star, lambda/D: its core. Its side lobes are
subtracted with the contrast that the joint fit without it leaves, three quarters or more."""

_SUBTRACTED_LIGHT_ERROR = 0.1
"""Error of the light that is subtracted: a star that the wavefront of another one explains
is 0.05 to 0.13 off, see `_UNLIKE_STAR_RATIO`."""

_MOST_JOINT_FITS = 4
"""Largest number of joint fits, with companions masked and frames left out one after another."""

_SEPARATIONS = (0.4, 0.55, 0.7, 0.85, 1.0, 1.25, 1.5, 2.0)
"""arcsec at which limits with and without the references are compared."""

_POSITIONS_PER_SEPARATION = 6
"""Positions at each of them."""

_JOINT_COMPANION_SNR = 12.0
"""S/N of a candidate in the target's frames alone above which all candidates are companions of the
joint fit. Candidates above 25 in all frames would have it refined again, for half of its time,
and the references make the S/N up to twice as large."""

_FRAME_RATIO = 2.2
"""Memory for one more frame, relative to the derivatives of its pixels by all unknowns."""


@dataclass(frozen=True)
class Contribution:
    """Use of a frame of a reference star, and its share in the fit."""

    # Name of its file.
    name: str
    star: str
    # "wavefront": in one likelihood with the target; "pattern": for the pattern only; or "not used"
    # by the fit, though by KLIP for comparison.
    use: str
    # Why it was not used, or not all of its pixels; else empty.
    reason: str = ""
    # Per pixel in the joint fit; like the following NaN without one.
    chi2: float = math.nan
    # Flux of its star over the target's.
    flux: float = math.nan
    # Rms of its wavefront minus the wavefront of the target's first frame, nm.
    drift: float = math.nan


@dataclass(frozen=True)
class Visit:
    """Frames of reference stars in a reduction: their use, and the gain in the limits."""

    # One for each frame of a reference star.
    contributions: tuple[Contribution, ...] = ()
    # Limits of the target's frames alone over the limits of all frames, in units of light: the
    # median over the separations at which all frames are used. NaN if they are used nowhere.
    gain: float = math.nan
    # These separations in words, such as "at 0.2 to 0.5 arcsec"; empty for all.
    where: str = ""

    def __repr__(self) -> str:
        return f"<Visit: {self.in_words()}>"

    @classmethod
    def from_facts(cls, facts: Mapping[str, Any]) -> Visit:
        """Make it from the entry of ``summary.json``, in which None stands for NaN."""

        def known(entries: Mapping[str, Any]) -> dict[str, Any]:
            return {key: math.nan if value is None else value for key, value in entries.items()}

        contributions = []
        for each in facts["contributions"]:
            # KLIP is not a use by the fit.
            use = "not used" if each["use"] == "KLIP only" else each["use"]
            contributions.append(Contribution(**known({**each, "use": use})))
        return cls(tuple(contributions), known(facts)["gain"], facts["where"])

    @property
    def unused(self) -> tuple[Contribution, ...]:
        """Frames that took no part in the fit."""
        return tuple(each for each in self.contributions if each.use == "not used")

    def in_words(self) -> str:
        """Uses of the frames in a line, and reasons why some were not used."""
        counts = Counter(each.use for each in self.contributions)
        total = len(self.contributions)
        if not total:
            return "no reference frames"
        parts = []
        if counts["wavefront"]:
            parts.append(
                f"{counts['wavefront']} in the likelihood, limits {self.gain:.2f} times deeper"
                f"{' ' + self.where if self.where else ''}"
            )
        if counts["pattern"]:
            parts.append(f"{counts['pattern']} for the detector pattern")
        if counts["not used"]:
            reasons = dict.fromkeys(each.reason for each in self.unused)
            parts.append(f"{counts['not used']} not used by the fit: {'; '.join(reasons)}")
        return f"of {counted(total, 'reference frame')} {', '.join(parts)}"


class Joined(NamedTuple):
    """The fit of a target that was kept, with or without the frames of reference stars."""

    fit: Refinement  # the target's frames come first
    visit: Visit
    detection: Detection | None = None  # its search, if there was one


def rough_settings(settings: FitSettings) -> FitSettings:
    """Settings of a fit of the target from which the fit of all frames goes on."""
    return replace(settings, tolerance=max(settings.tolerance, _ROUGH_TOLERANCE), adapt_prior=False)


def with_references(
    fit: Refinement,
    choice: PatternChoice,
    references: Sequence[Observation],
    *,
    search: Callable[[Refinement], Detection] | None = None,
    memory: float | None = None,
    progress: bool = False,
) -> Joined:
    """Fit the target's frames together with frames of reference stars that are cut like them.

    `choice` has the pattern of `fit`, the target's own fit. Limits are compared as `search`
    states them, with errors scaled to the scatter of the S/N, else as the linear models predict
    them. Frames that do not fit into `memory`, bytes of the process, are left out.
    """
    if not references or not fit.status.usable:
        return Joined(fit, Visit())
    left_out: dict[str, str] = {}
    used = _that_fit_into(memory, fit, references, left_out)
    pattern = pattern_for_visit(choice, [each.observation for each in fit.frames], used)
    settings = replace(
        fit.settings,
        drift=fit.settings.drift or _SLEWS,
        dither_drift=_DITHERS,
        drift_cycles=_DRIFT_CYCLES,
        tolerance=max(fit.settings.tolerance, _JOINT_FIT_TOLERANCE),
        adapt_prior=True,
        marginal_flux=True,
        max_iterations=min(fit.settings.max_iterations, _JOINT_FIT_STEPS),
    )
    if pattern is not None:
        settings = with_known_pattern(settings)
    alone = search(fit) if search is not None and used else None
    companions = _companions(fit, alone) if used else ()
    joint: Refinement | None = None
    remarks: dict[str, str] = {}
    with stage("reference stars and target together"):
        # Each round masks the companions that the joint fit shows, or else leaves out the frames
        # that it does not explain, until there are neither.
        for _ in range(_MOST_JOINT_FITS):
            joint = None
            if not used:
                break
            try:
                used, aligned = _aligned(fit, used, settings, pattern, left_out, remarks)
                if not used:
                    break
                joint = join_frames(
                    fit, aligned, settings, pattern=pattern, companions=companions,
                    progress=progress,
                )  # fmt: skip
            except DiffrenderError as error:
                _log.warning("the reference frames are not fitted with the target: %s", error)
                left_out |= {each.name: f"the joint fit failed: {error}" for each in used}
                break
            masked = _with_companions_masked(joint, used, remarks)
            if masked is not None:
                used = masked
                continue
            contradicting = _contradicting(joint, len(fit.frames))
            if not contradicting:
                break
            left_out |= contradicting
            used = [each for each in used if each.name not in contradicting]
        else:
            joint = None
            reason = "what contradicts the target in the frames of reference stars has no end"
            left_out |= {each.name: reason for each in used}
    if joint is None or not joint.status.usable:
        return Joined(fit, Visit(_left_out(references, left_out)), alone)
    outcome = _kept(fit, joint, alone, None if search is None else search(joint))
    if isinstance(outcome, str):
        left_out |= {each.name: outcome for each in used}
        return Joined(fit, Visit(_left_out(references, left_out)), alone)
    kept, detection, gain, where = outcome
    _log.info("limits with the reference frames are %.2f times deeper %s", gain, where)
    contributions = _contributions(joint, references, left_out, remarks)
    return Joined(kept, Visit(contributions, gain, where), detection)


def _kept(
    fit: Refinement, joint: Refinement, alone: Detection | None, together: Detection | None
) -> tuple[Refinement, Detection | None, float, str] | str:
    """The fit that is kept, its search, and where limits are deeper with the reference stars.

    If they are deeper nowhere, it is the reason why the frames are not used.
    """
    # Deeper limits of a fit whose errors are not calibrated are no gain over one whose are.
    if fit.status.calibrated and not joint.status.calibrated:
        return f"the fit of all frames ended as {joint.status.name}"
    if alone is None or together is None:
        gain = _gain(fit, joint)
        if gain > 1:
            return joint, together, gain, ""
        return f"limits would be {1 / gain:.2f} times those without it"
    separations, limits = stated_limits(alone)
    gains = limits / np.interp(separations, *stated_limits(together))
    is_deeper = gains > 1
    if not is_deeper.any():
        return f"limits would be {1 / np.median(gains):.2f} times those without it"
    # The fit that is deeper at most separations has the wavefront and the images of the products.
    if np.median(gains) > 1:
        kept, detection = joint, deeper(together, alone)
    else:
        kept, detection = fit, deeper(alone, together)
    where = "" if is_deeper.all() else f"at {_in_ranges(separations, is_deeper)} arcsec"
    return kept, detection, float(np.median(gains[is_deeper])), where


def _in_ranges(separations: NDArray[np.float64], chosen: NDArray[np.bool_]) -> str:
    """Chosen separations in words, such as "0.2 to 0.5 and 1.2"."""
    ranges = []
    for is_chosen, part in itertools.groupby(zip(separations, chosen, strict=True), lambda x: x[1]):
        within = [f"{separation:.1f}" for separation, _ in part]
        if is_chosen:
            ranges.append(" to ".join(dict.fromkeys((within[0], within[-1]))))
    return " and ".join([", ".join(ranges[:-1]), ranges[-1]] if ranges[1:] else ranges)


def _companions(fit: Refinement, alone: Detection | None) -> tuple[Planet, ...]:
    """The companions of a fit of the target; all its candidates if one of them is bright."""
    if alone is None and fit.status.calibrated:
        # It is not refined with them: that is left to the fit of all frames.
        alone = detect(fit, relinearise=math.inf)
    if alone is None or not (np.asarray(alone.candidates["snr"]) > _JOINT_COMPANION_SNR).any():
        return fit.planets
    return alone.sources.planets()


def _that_fit_into(
    memory: float | None,
    fit: Refinement,
    references: Sequence[Observation],
    left_out: dict[str, str],
) -> list[Observation]:
    """As many frames as the memory allows, those nearest in time to the target first."""
    if memory is None:
        return list(references)
    # A frame's derivatives are in single precision, four bytes each, and it takes `_FRAME_RATIO`
    # times them.
    derivatives = 4.0 * fit.linear.frames[0].jacobian.numel()
    spare = fit.settings.memory_beside(len(fit.frames) * derivatives) / (_FRAME_RATIO * derivatives)
    date = fit.frames[0].observation.date

    def days(each: Observation) -> float:
        return 0.0 if each.date is None or date is None else abs(float(each.date.mjd - date.mjd))

    nearest = sorted(references, key=days)
    chosen = nearest[: max(0, int(spare))]
    for each in nearest[len(chosen) :]:
        left_out[each.name] = f"it does not fit into {memory / 1e9:.3g} GB of the option memory"
        _log.warning("%s is left out: %s", each.name, left_out[each.name])
    return [each for each in references if any(each is one for one in chosen)]


def _aligned(
    fit: Refinement,
    references: Sequence[Observation],
    settings: FitSettings,
    pattern: DetectorPattern | None,
    left_out: dict[str, str],
    remarks: dict[str, str],
) -> tuple[list[Observation], list[Refinement]]:
    """The frames that the target's wavefront nearly explains, and their fits with it.

    A bright companion of a reference star is subtracted from its frames and masked.
    """
    wavelength = float(np.mean(fit.model.bandpass.wavelengths))
    limit = _UNLIKE_STAR_RATIO * 4.4e-6 / wavelength
    observations, aligned = [], []
    for each in references:
        one = align_frame(fit, each, settings, pattern=pattern)
        brightness = one.frames[0].flux / fit.frames[0].flux
        unexplained = _unexplained(one)
        if brightness >= _FAINT_REFERENCE_FLUX_RATIO and unexplained > limit:
            each, one = _with_bright_companion(fit, each, one, settings, pattern, limit, remarks)
            unexplained = _unexplained(one)
        reason = ""
        if brightness < _FAINT_REFERENCE_FLUX_RATIO:
            reason = f"its star has {brightness:.2g} of the target's flux"
        elif unexplained > limit:
            reason = (
                f"with the target's wavefront, {100 * unexplained:.0f} % of its star's light is "
                f"not explained, more than {100 * limit:.0f} %: another wavefront, or more than a "
                "star"
            )
        if reason:
            left_out[each.name] = reason
            _log.warning("%s is left out: %s", each.name, reason)
        else:
            observations.append(each)
            aligned.append(one)
    return observations, aligned


def _with_bright_companion(
    fit: Refinement,
    observation: Observation,
    alone: Refinement,
    settings: FitSettings,
    pattern: DetectorPattern | None,
    limit: float,
    remarks: dict[str, str],
) -> tuple[Observation, Refinement]:
    """A frame without a companion that kept the wavefront from explaining it, and its fit.

    If there is none, these are the frame and the fit as they were.
    """
    both = align_frame(fit, observation, settings, pattern=pattern, companions=1)
    if not len(both.companions) or _unexplained(both) > limit:
        return observation, alone
    (frame,), ((contrast, x, y),) = both.frames, both.companions.tolist()
    source = ReferenceSource(contrast, (x, y), frame.companion_image)
    without = _subtracted(observation, frame, source, remarks)
    return without, align_frame(fit, without, settings, pattern=pattern)


def _subtracted(
    observation: Observation, frame: FrameFit, source: ReferenceSource, remarks: dict[str, str]
) -> Observation:
    """A frame without the light of a point source, whose core is masked.

    The frame is returned as it is if nothing is left to mask.
    """
    x, y = source.offset
    away = np.hypot(frame.grid[..., 0] - x, frame.grid[..., 1] - y)
    near = away < _MASKED_COMPANION_LAMBDA_D * frame.model.resolution
    # It was subtracted and masked in an earlier round.
    if not (observation.valid & near).any():
        return observation
    remark = (
        f"a source of {source.contrast:.1e} of its star's light at {math.hypot(x, y):.2f} "
        "arcsec is subtracted and masked"
    )
    _log.warning("%s: %s", observation.name, remark)
    known = remarks.get(observation.name)
    remarks[observation.name] = f"{known}; {remark}" if known else remark
    return replace(
        observation,
        data=observation.data - source.light,
        error=np.hypot(observation.error, _SUBTRACTED_LIGHT_ERROR * source.light),
        valid=observation.valid & ~near,
    )


def _unexplained(aligned: Refinement) -> float:
    """Part of the star's light in a pixel that a fit of one frame leaves, robust to companions."""
    # With the residual r, the noise s and the star's light l of a pixel, it is the k for which
    # r^2 / (s^2 + k^2 l^2) has the median of the square of a normal deviate.
    (frame,) = aligned.frames
    observation = frame.observation.combined()
    valid = observation.valid[0]
    square = (observation.data[0] - frame.star - frame.companion_image)[valid] ** 2
    light = (frame.star - frame.values["background"][0])[valid] ** 2
    noise = observation.error[0][valid] ** 2

    def excess(part: float) -> float:
        return float(np.median(square / (noise + part**2 * light)) - chdtri(1, 0.5))

    if excess(0.0) <= 0:
        return 0.0
    return 1.0 if excess(1.0) >= 0 else float(brentq(excess, 0.0, 1.0))


def _frame_chi2(fit: Refinement) -> NDArray[np.float64]:
    """Chi-squared per pixel of every frame, with the error of the pattern as noise."""
    values = []
    for frame in fit.frames:
        observation = frame.observation.combined()
        valid, noise = observation.valid[0], observation.error[0]
        if fit.pattern is not None:
            light = frame.star - frame.values["background"][0] + frame.pedestal
            # The pattern's error multiplies star and pedestal, as the pattern does.
            noise = np.hypot(noise, fit.pattern.at(observation)[1] * light)
        residual = observation.data[0] - frame.star - frame.companion_image
        values.append(float(np.mean((residual / noise)[valid] ** 2)))
    return np.array(values)


def _contradicting(joint: Refinement, science: int) -> dict[str, str]:
    """Frames of reference stars that are not explained as the target's are, and why."""
    values = _frame_chi2(joint)
    # A frame that is far from the others spoils the fit of all. Those that are half as far are not
    # blamed yet: the next joint fit, without the worst, shows whether they were.
    usual = max(1.0, float(np.median(values[:science])))
    limit = max(_CONTRADICTING_CHI2_RATIO * usual, values[science:].max() / 2)
    reasons = {}
    for k, frame in enumerate(joint.frames[science:], science):
        name = frame.observation.name
        if values[k] > limit:
            reasons[name] = (
                "the model that explains the target leaves it a chi-squared of "
                f"{values[k]:.2f} per pixel"
            )
    for name, reason in reasons.items():
        _log.warning("%s is left out: %s", name, reason)
    return reasons


def _with_companions_masked(
    joint: Refinement, used: Sequence[Observation], remarks: dict[str, str]
) -> list[Observation] | None:
    """Frames with the companions of reference stars masked; None if there are no new ones."""
    masked = list(used)
    science = len(joint.frames) - len(used)
    for k, source in sources_of_references(joint).items():
        observation, frame = used[k - science], joint.frames[k]
        masked[k - science] = _subtracted(observation, frame, source, remarks)
    is_new = any(one is not other for one, other in zip(masked, used, strict=True))
    return masked if is_new else None


def _gain(alone: Refinement, joint: Refinement) -> float:
    """Median over separations of the limits of one fit over another's, in units of light."""
    return float(np.nanmedian(_light_errors(alone) / _light_errors(joint)))


def _light_errors(fit: Refinement) -> NDArray[np.float64]:
    """Errors of the light of point sources, medians of the positions at each separation."""
    templates, edge = Templates(fit), float(np.abs(fit.frames[0].grid).max())
    separations = [each for each in _SEPARATIONS if each < edge] or [edge / 2]
    rings = ring_pixels(templates.grid, np.array(separations), _POSITIONS_PER_SEPARATION)
    rows, columns = np.concatenate(rings, axis=1)
    products = templates.linear.weigh(templates.at_pixels(rows, columns))
    ends = np.cumsum([len(ring[0]) for ring in rings])[:-1]
    errors = np.split(products.information.numpy() ** -0.5, ends)
    return fit.frames[0].star_light * np.array([np.median(each) for each in errors if len(each)])


def _drifts(joint: Refinement) -> NDArray[np.float64]:
    """Rms of the difference of every frame's wavefront from the first frame's, nm."""
    coefficients = []
    linear = joint.linear
    for frame in linear.frames:
        drift = torch.zeros(frame.drift.shape[-1], dtype=torch.float64)
        for block in frame.drift:
            drift = drift + linear.vector[block]
        coefficients.append(drift)
    return np.array([float((each - coefficients[0]).norm()) for each in coefficients])


def _contributions(
    joint: Refinement,
    references: Iterable[Observation],
    left_out: dict[str, str],
    remarks: dict[str, str],
) -> tuple[Contribution, ...]:
    """Use of every frame of a reference star, and its share in the fit."""
    values, drifts = _frame_chi2(joint), _drifts(joint)
    places = {
        frame.observation.name: k
        for k, frame in enumerate(joint.frames)
        if frame.observation.reference
    }
    contributions: list[Contribution] = []
    for each in references:
        if each.name in left_out:
            contributions += _left_out([each], left_out)
            continue
        k = places[each.name]
        contributions.append(
            Contribution(
                each.name,
                each.target,
                "wavefront",
                remarks.get(each.name, ""),
                float(values[k]),
                joint.frames[k].flux / joint.frames[0].flux,
                float(drifts[k]),
            )
        )
    return tuple(contributions)


def _left_out(
    references: Iterable[Observation], reasons: dict[str, str]
) -> tuple[Contribution, ...]:
    return tuple(
        Contribution(each.name, each.target, "not used", reasons.get(each.name, ""))
        for each in references
    )
