"""Learn the detector pattern from stars other than the target."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from scipy.optimize import minimize_scalar

from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.refinement.fit_result import FrameFit, Refinement
from pyklip_diffrender.scene.detector_pattern import DetectorPattern
from pyklip_diffrender.scene.exposure import (
    CatalogueStar,
    detector_of,
    flat_field_of,
    image_mask,
    star_of,
)
from pyklip_diffrender.scene.observation import Observation

# The pedestal of a pattern: light besides the star that the pattern multiplies.

Image = NDArray[np.float64]

KNOWN_MODEL_ERROR = 0.002
"""Smallest model error, as a fraction of the star, where the pattern is known from other stars: the
pattern's own error is counted apart."""

_RING_WIDTH_PIXELS = 4.0
"""Width in pixels of the rings in which scatters are estimated."""

_FIRST_RING = 2
"""First ring from which the pedestal is estimated: closer to the star, the wavefront has residuals
as well."""

FEW_PIXELS = 50
"""Number of pixels below which no scatter is estimated in a ring."""

_RING_TO_RING_ERROR = 0.2
"""Relative error of a ring's mean product, because the pattern is not the same in all rings."""

_OTHER_BRIGHTNESS_RATIO = 1.5
"""Ratio of the brightness of two stars from which their residuals tell the pedestal."""

_HALF_WEIGHT_SIGMAS = 2.0
"""Deviation, in standard deviations, of half weight."""

OUTLIER = 4.0
"""Standard deviations from the median of the frames beyond which a pixel of a frame is left out:
a companion or background source of that star, or a cosmic ray."""


class _Pair(NamedTuple):
    """Pixels that frames of two stars share, (2, pixels) each."""

    light: Image
    left: Image
    noise: Image


def pattern_pedestal(fits: Sequence[Refinement]) -> float:
    """The pedestal, in the frames' unit, with which one pattern holds near the star and far away.

    The pedestal is 0 where no two frames of a fit show the same pixels.
    """
    # Frames have a fixed pattern m that does not become fainter with the distance from the star. In
    # frames of two stars s of different brightness the residuals of a pixel are r = m (s + B), so
    # r_1 / (s_1 + B) = r_2 / (s_2 + B): a fit by robust total least squares gives B.
    pairs = list(_pairs_of_stars(fits))
    if pairs:
        return _pedestal_between_stars(pairs)
    # For rolls of one star the pattern must be taken to be as strong in all rings about it. The
    # product of the residuals of two frames of the same pixels, averaged over a ring, is
    # m^2 (s_1 + B) (s_2 + B) for a pattern of rms m. A least-squares fit to all rings gives m, B.
    rings = [ring for fit in fits for ring in _products(fit)]
    if not rings:
        return 0.0
    product, first, second, error = np.array(rings).T

    def misfit(pedestal: float) -> float:
        shape = (first + pedestal) * (second + pedestal)
        # m^2 for this B: least squares are linear in it.
        strength = (shape * product / error**2).sum() / ((shape / error) ** 2).sum()
        return float((((product - strength * shape) / error) ** 2).sum())

    brightest = float(np.sqrt((first * second).max()))
    return float(minimize_scalar(misfit, bounds=(0.0, brightest), method="bounded").x)


def _pairs_of_stars(fits: Sequence[Refinement]) -> Iterator[_Pair]:
    """Shared pixels of frames of stars whose brightness differs."""
    for a, b in combinations([frame for fit in fits for frame in fit.frames], 2):
        pixel, star = a.observation.first_pixel, a.observation.target
        if pixel is None or pixel != b.observation.first_pixel or star == b.observation.target:
            continue
        first, second = light_and_residual(a), light_and_residual(b)
        fainter, brighter = sorted((first[0].sum(), second[0].sum()))
        if brighter < _OTHER_BRIGHTNESS_RATIO * fainter:
            continue
        valid = first[3] & second[3]
        light, left, noise = (
            np.stack([one[valid], other[valid]])
            for one, other in zip(first[:3], second[:3], strict=True)
        )
        yield _Pair(light, left, noise)


def _pedestal_between_stars(pairs: Sequence[_Pair]) -> float:
    """The pedestal for which the patterns of all pairs agree best."""

    def misfit(pedestal: float) -> float:
        total = 0.0
        for light, left, noise in pairs:
            # r_1 (s_2 + B) - r_2 (s_1 + B) is 0 but for the noise of both residuals.
            other = light[::-1] + pedestal
            deviation = (left[0] * other[0] - left[1] * other[1]) ** 2
            ratio = deviation / ((noise * other) ** 2).sum(axis=0)
            # Cauchy's loss, because of companions, outliers and errors of the wavefront.
            total += float(np.log1p(ratio / _HALF_WEIGHT_SIGMAS**2).sum())
        return total

    brightest = max(float(pair.light.max()) for pair in pairs)
    grid = np.geomspace(1e-4, 1.0, 40) * brightest
    coarse = grid[int(np.argmin([misfit(each) for each in grid]))]
    return float(minimize_scalar(misfit, bounds=(coarse / 1.4, 1.4 * coarse), method="bounded").x)


def _products(fit: Refinement) -> list[tuple[float, float, float, float]]:
    """Mean product of the residuals of two frames, mean stars, and error, for every ring."""
    rings = []
    for a, b in combinations(fit.frames, 2):
        pixel = a.observation.first_pixel
        if pixel is None or pixel != b.observation.first_pixel:
            continue
        (light, left, noise, valid), (light_b, left_b, noise_b, valid_b) = (
            light_and_residual(frame) for frame in (a, b)
        )
        x, y = a.observation.center[0]
        ring = rings_about(light.shape, (float(x), float(y)))
        for k in range(_FIRST_RING, ring.max() + 1):
            inside = (ring == k) & valid & valid_b
            products = (left * left_b)[inside]
            if len(products) < FEW_PIXELS:
                continue
            # Clipped, because companions and outliers are no part of the pattern.
            variances = [median_variance(each[inside]) for each in (left, left_b)]
            limit = OUTLIER * np.sqrt(np.prod(variances))
            mean = float(np.clip(products, -limit, limit).mean())
            scatter = float(np.sqrt((noise**2).mean() * (noise_b**2).mean() / len(products)))
            rings.append(
                (mean, float(light[inside].mean()), float(light_b[inside].mean()),
                 float(np.hypot(scatter, _RING_TO_RING_ERROR * mean)))
            )  # fmt: skip
    return rings


def median_variance(values: Image) -> float:
    """Variance about 0 from the median square, which companions and outliers hardly change."""
    # 0.4549 is the median square of a unit normal variable.
    return float(np.median(values**2)) / 0.4549


def light_and_residual(frame: FrameFit) -> tuple[Image, Image, Image, NDArray[np.bool_]]:
    """Star without the known pattern, what the frame shows beyond it, noise, and valid pixels."""
    combined = frame.observation.combined()
    background = float(frame.values["background"][0])
    known = frame.pedestal
    # star = s (1 + m) + B m + background = (s + B) g - B + background, with the gain g = 1 + m.
    light = (frame.star - background + known) / frame.gain - known
    left = combined.data[0] - background - frame.companion_image - light
    return light, left, combined.error[0], combined.valid[0]


def widths_from_star(shape: tuple[int, int], center: tuple[float, float]) -> Image:
    """Distance of every pixel from the star, in widths of a ring."""
    y, x = np.indices(shape)
    return np.asarray(np.hypot(x - center[0], y - center[1]) / _RING_WIDTH_PIXELS)


def rings_about(shape: tuple[int, int], center: tuple[float, float]) -> NDArray[np.int64]:
    """Number of the ring about the star that every pixel lies in."""
    return widths_from_star(shape, center).astype(np.int64)


# How much of a known detector pattern the frames of a fit show.
#
# A library of patterns is valid for frames that were calibrated with the same flat field. With
# another one, which may be better, the frames show less of the pattern, or none of it.

_log = logging.getLogger(__name__)

_LACKING_PATTERN_SIZE = 0.5
"""Size below which more of the pattern would remain with it than without it."""

_LACKING_PATTERN_SIGMAS = 2.0
"""Standard deviations by which the size must be below `_LACKING_PATTERN_SIZE`."""


def pattern_size(fit: Refinement) -> tuple[float, float] | None:
    """Measure the size of the known pattern in the frames, and the error of the size.

    The size is 1 if the frames show what ``DetectorPattern.value`` says, and 0 if they show nothing
    of it. All unknowns of the fit are marginalised, as well as the error of the pattern.

    Parameters
    ----------
    fit : Refinement

    Returns
    -------
    tuple of float, or None
        Size and error; None for a fit without a pattern whose values are known, or without a linear
        model.

    Examples
    --------
    Frames with a quarter of the pattern that a fit takes for known:

    >>> from dataclasses import replace
    >>> import numpy as np
    >>> import pyklip_diffrender as dr
    >>> from pyklip_diffrender.pattern import pattern_size
    >>> model = dr.nircam_coronagraph("F444W", monochromatic=4.5e-6, npix=128, fov_pixels=32)
    >>> opd = dr.wavefront.random_opd(1, npix=128)
    >>> frames = dr.simulate(model, dr.Scene(), opd, seed=3)
    >>> pattern = 0.04 * np.random.default_rng(1).normal(size=(32, 32))
    >>> frames = replace(frames, data=frames.data * (1 + pattern / 4))
    >>> error = np.full_like(pattern, 0.01)
    >>> known = dr.DetectorPattern(pattern, error, frames.center[0], unknown=0.04)
    >>> settings = dr.FitSettings(cycles=6)
    >>> fit = dr.refine(model, frames, opd, settings=settings, pattern=known)
    >>> size, error = pattern_size(fit)
    >>> print(f"{size:.2f} +- {error:.2f}")
    0.25 +- 0.02
    """
    if fit.pattern is None:
        return None
    # The residual of a fit with the pattern m is (size - 1) m (s + B): it is fitted as a template,
    # marginalised over the unknowns.
    templates = {}
    for k, frame in enumerate(fit.frames):
        light = light_and_residual(frame)[0] + frame.pedestal
        templates[k] = torch.from_numpy((frame.gain - 1) * light)[None]
    if not any(bool(each.any()) for each in templates.values()):
        return None
    products = fit.linear.weigh(templates)
    information = float(products.information)
    return 1 + float(products.numerator) / information, information**-0.5


def lacks_pattern(fit: Refinement) -> bool:
    """Whether frames of a fit show less than half of its known pattern; if so, the log warns."""
    measured = pattern_size(fit)
    if measured is None:
        return False
    size, error = measured
    _log.info("the frames show %.2f +- %.2f of the pattern", size, error)
    lacks = size + _LACKING_PATTERN_SIGMAS * error < _LACKING_PATTERN_SIZE
    if lacks:
        assert fit.pattern is not None
        _log.warning(
            "%s: the frames show %.2f +- %.2f of the detector pattern of %s. They were probably "
            "calibrated with another flat field",
            fit.frames[0].observation.name, size, error, fit.pattern.name,
        )  # fmt: skip
    return lacks


_SHARED_PROPERTIES = {
    "filter": "filter", "image_mask": "mask", "detector": "detector", "flat": "flat field (R_FLAT)",
}  # fmt: skip
"""Properties that averaged patterns share, by the names of their attributes."""

_SMOOTH_RINGS = 1.0
"""Rings (standard deviation) over which the scatter between frames is averaged."""


@dataclass(frozen=True, eq=False)
class MeasuredPattern:
    """Residual over star, as one frame shows it."""

    star: str
    # (ny, nx), residual over the sum of star and pedestal; 0 where not known.
    value: Image
    # (ny, nx), variance by the data's noise; inf where not known.
    variance: Image
    # x, y of the star, 0-indexed pixels.
    center: tuple[float, float]
    # Column and row of the first pixel on the full detector, as in an `Observation`.
    first_pixel: tuple[int, int] | None = None
    filter: str | None = None
    image_mask: str | None = None
    # Where and when the pattern was measured.
    frame: str = ""
    date: str = ""
    # The pedestal as in `DetectorPattern`, in the unit of the frame.
    pedestal: float = 0.0
    # The detector as headers name it, such as NRCALONG.
    detector: str | None = None
    # Name of the flat field with which the frame was calibrated (R_FLAT).
    flat: str | None = None
    # (ny, nx), the star without the pattern, in the unit of the frame; None where it was not kept.
    light: Image | None = None
    # Names and place of the star.
    catalogue: CatalogueStar = field(default_factory=CatalogueStar)

    @property
    def stars(self) -> tuple[CatalogueStar, ...]:
        """The star, by every name that is known."""
        names = dict.fromkeys((*self.catalogue.names, self.star))
        return (replace(self.catalogue, names=tuple(names)),)

    @property
    def frames(self) -> tuple[str, ...]:
        """The frame, as a tuple."""
        return (self.frame,) if self.frame else ()

    def with_pedestal(self, pedestal: float) -> MeasuredPattern:
        """Return the pattern as a fraction of the sum of the star and another pedestal.

        Raises IncompatibleSetupError for another pedestal than the pattern's if its star was not
        kept.
        """
        if pedestal == self.pedestal:
            return self
        if self.light is None:
            raise IncompatibleSetupError(
                f"{self.frame}: got a pattern with the pedestal {self.pedestal:.4g}, expected "
                f"{pedestal:.4g}; the pattern was stored without its star, by which the pedestal "
                "could be changed. Learn the pattern again"
            )
        multiplied = self.light + pedestal
        usable = np.isfinite(self.variance) & (multiplied > 0)
        # The residual is m (s + B) = m' (s + B').
        ratio = (self.light + self.pedestal) / np.where(usable, multiplied, 1.0)
        variance = np.where(usable, self.variance, 0.0) * ratio**2
        return replace(
            self,
            value=np.where(usable, self.value * ratio, 0.0),
            variance=np.where(usable, variance, np.inf),
            pedestal=pedestal,
        )


def learn_pattern(
    fits: Refinement | Sequence[Refinement], *, name: str | None = None
) -> DetectorPattern:
    """Learn the pattern that the star model misses from fits of other stars.

    In every frame the residual is divided by the sum of the star and a pedestal, the same in all
    frames, see `pattern_pedestal`. The ratios are averaged with inverse variances, from the data's
    noise and the scatter between frames beyond that noise; a zero-mean Gaussian prior, as wide as
    the ratios scatter over the pixels of a ring, shrinks pixels that were not measured well. The
    error of the pattern for another frame combines the error of this average and the scatter
    between frames.

    Parameters
    ----------
    fits : Refinement or sequence of Refinement
        Fits of other stars than the star that the pattern will be used for: a planet of the target
        would be learned as well. Two frames at least; rolls of one star will do, several stars
        show better how well the pattern carries over.
    name : str, optional
        Short label; default the names of the stars.

    Returns
    -------
    DetectorPattern

    Raises
    ------
    IncompatibleSetupError
        For fewer than two frames, frames of different filters, or failed fits.

    Examples
    --------
    >>> import pyklip_diffrender as dr
    >>> model = dr.nircam_coronagraph("F444W", monochromatic=4.5e-6, npix=128, fov_pixels=32)
    >>> opd = dr.wavefront.random_opd(1, npix=128)
    >>> frames = [dr.simulate(model, dr.Scene(), opd, seed=k) for k in (1, 2)]
    >>> fit = dr.refine(model, frames, opd, settings=dr.FitSettings(cycles=6))
    >>> dr.learn_pattern(fit, name="noise")
    <DetectorPattern 'noise': F444W, 32 x 32 pixels>
    """
    patterns = measure_patterns(fits)
    if len(patterns) < 2:
        raise IncompatibleSetupError(
            f"learn_pattern: got {len(patterns)} usable frames, expected at least two, such "
            "as two rolls of a reference star"
        )
    return combine_patterns(patterns, name)


def measure_patterns(
    fits: Refinement | Sequence[Refinement], pedestal: float | None = None
) -> list[MeasuredPattern]:
    """Measure the pattern in every frame of the fits that did not fail.

    The pedestal, as in `DetectorPattern` and in the unit of the frames, is estimated by default.
    """
    several = [fits] if isinstance(fits, Refinement) else list(fits)
    usable = [fit for fit in several if fit.status.usable]
    if pedestal is None:
        pedestal = pattern_pedestal(usable)
    return [_measured(frame, pedestal) for fit in usable for frame in fit.frames]


def combine_patterns(
    patterns: Sequence[MeasuredPattern], name: str | None = None
) -> DetectorPattern:
    """Average measured patterns, see `learn_pattern`, with one pedestal (`common_pedestal`).

    Raises IncompatibleSetupError for patterns of several filters, masks, detectors or flat fields,
    or of none, and if patterns whose stars were not kept have different pedestals.
    """
    setup: dict[str, str | None] = {}
    for aspect in ("filter", "image_mask", "detector", "flat"):
        stated = {getattr(pattern, aspect) for pattern in patterns}
        if len(stated - {None}) > 1 or not stated:
            raise IncompatibleSetupError(
                f"pattern: got patterns of {sorted(map(str, stated))}, expected one "
                f"{_SHARED_PROPERTIES[aspect]}"
            )
        # What some patterns do not state is not known of all.
        setup[aspect] = stated.pop() if len(stated) == 1 else None
    pedestal = common_pedestal(patterns)
    patterns = [pattern.with_pedestal(pedestal) for pattern in patterns]
    values, variances, center, first_pixel = _on_common_pixels(patterns)
    away = widths_from_star(values[0].shape, center)
    ring = away.astype(np.int64)
    stars = [pattern.star for pattern in patterns]
    variances = variances * _noise_ratio(values, variances, ring)
    scatter = _scatter_between_frames(values, variances, stars, away)
    variances = np.where(_outliers(values, variances + scatter**2), np.inf, variances)
    width = _prior_width(values, variances, away)
    # Posterior of a pixel m ~ N(0, width^2) that frames show as m + e with
    # e ~ N(0, variance + scatter^2). Another frame shows it with its own scatter, which adds to the
    # error of the mean.
    precision = (1 / (variances + scatter**2)).sum(axis=0)
    total = precision + width**-2.0
    value = (values / (variances + scatter**2)).sum(axis=0) / total
    error = np.sqrt(1 / total + np.where(precision > 0, scatter**2, 0.0))
    names = list(dict.fromkeys(stars))
    return DetectorPattern(
        value=value,
        error=np.minimum(error, width),
        center=center,
        first_pixel=first_pixel,
        unknown=float(np.median(width)),
        pedestal=pedestal,
        **setup,
        catalogue=tuple(dict.fromkeys(star for each in patterns for star in each.stars)),
        name=name or ", ".join(names),
        provenance={
            "stars": names,
            "frames": [pattern.frame for pattern in patterns],
            "dates": [pattern.date for pattern in patterns],
        },
    )


def common_pedestal(patterns: Sequence[MeasuredPattern]) -> float:
    """The pedestal of the patterns whose star was not kept, or else the median of all."""
    fixed = [pattern.pedestal for pattern in patterns if pattern.light is None]
    return float(np.median(fixed or [pattern.pedestal for pattern in patterns]))


def flat_of(observation: Observation) -> str | None:
    """Name of the flat field with which frames were calibrated (R_FLAT), without its address."""
    return flat_field_of(observation.header, observation.name)


def _measured(frame: FrameFit, pedestal: float) -> MeasuredPattern:
    observation = frame.observation
    light, left, error, valid = light_and_residual(frame)
    multiplied = light + pedestal
    usable = valid & (multiplied > 0)
    safe = np.where(usable, multiplied, 1.0)
    x, y = observation.center.mean(axis=0)
    return MeasuredPattern(
        star=observation.target,
        value=np.where(usable, left / safe, 0.0),
        variance=np.where(usable, (error / safe) ** 2, np.inf),
        center=(float(x), float(y)),
        first_pixel=observation.first_pixel,
        filter=observation.filter,
        image_mask=image_mask(observation.header, observation.name),
        frame=observation.name,
        date="" if observation.date is None else observation.date.isot,
        pedestal=pedestal,
        detector=detector_of(observation.header, observation.name),
        flat=flat_of(observation),
        light=light,
        catalogue=star_of(observation.header, observation.name),
    )


def _on_common_pixels(
    patterns: Sequence[MeasuredPattern],
) -> tuple[Image, Image, tuple[float, float], tuple[int, int] | None]:
    """Values and variances (patterns, ny, nx) on an array that holds all patterns.

    Also x, y of the first pattern's star, and `first_pixel`, which is None unless all patterns have
    one.
    """
    # Pixels are matched on the detector where all patterns say which ones they have, else by the
    # position of the star, to whole pixels.
    on_detector = all(pattern.first_pixel is not None for pattern in patterns)
    starts = np.array(
        [
            pattern.first_pixel if on_detector else -np.round(pattern.center).astype(int)
            for pattern in patterns
        ]
    )
    ends = starts + [pattern.value.shape[::-1] for pattern in patterns]
    left, bottom = starts.min(axis=0)
    right, top = ends.max(axis=0)
    values = np.zeros((len(patterns), top - bottom, right - left))
    variances = np.full(values.shape, np.inf)
    for k, pattern in enumerate(patterns):
        ny, nx = pattern.value.shape
        x, y = starts[k] - (left, bottom)
        values[k, y : y + ny, x : x + nx] = pattern.value
        variances[k, y : y + ny, x : x + nx] = pattern.variance
    x, y = starts[0] - (left, bottom) + patterns[0].center
    return (
        values,
        variances,
        (float(x), float(y)),
        (int(left), int(bottom)) if on_detector else None,
    )


def _on_pixels(variance: NDArray[np.float64], away: Image) -> Image:
    """Standard deviations on the pixels, interpolated between rings, from variances by ring."""
    return np.sqrt(np.interp(away - 0.5, np.arange(len(variance)), np.maximum(variance, 0.0)))


def _scatter_between_frames(
    values: Image, variances: Image, stars: Sequence[str], away: Image
) -> Image:
    """Standard deviation (ny, nx) of the ratio between frames beyond their noise."""
    # Frames of different stars, where there are any: frames of one star share what is particular to
    # it. var(v_a - v_b) = noise_a + noise_b + 2 scatter^2. The error of a variance is in proportion
    # to it, hence the weights 1 / noise^2. In a single ring it is so uncertain that the difference
    # may be negative, so neighbouring rings are averaged.
    ring = away.astype(np.int64)
    pairs = [(a, b) for a in range(len(stars)) for b in range(a + 1, len(stars))]
    across = [(a, b) for a, b in pairs if stars[a] != stars[b]] or pairs
    count = ring.max() + 1
    excess, weight = np.zeros(count), np.zeros(count)
    for a, b in across:
        noise = variances[a] + variances[b]
        known = np.isfinite(noise)
        difference = np.abs(values[a] - values[b])
        for k in range(count):
            inside = known & (ring == k)
            if not inside.any():
                continue
            spread = median_variance(difference[inside])
            share = 1 / np.median(noise[inside]) ** 2
            excess[k] += share * (spread - np.median(noise[inside]))
            weight[k] += share
    excess, weight = (
        gaussian_filter1d(each, _SMOOTH_RINGS, mode="nearest") for each in (excess, weight)
    )
    return _on_pixels(np.divide(excess, 2 * weight, where=weight > 0, out=np.zeros(count)), away)


def _noise_ratio(values: Image, variances: Image, ring: NDArray[np.int64]) -> Image:
    """Ratio (ny, nx) of the noise's variance in a ring to the stated one, at most 1."""
    # The noise of resampled frames is correlated between neighbours. Errors are such that they hold
    # for an image of several pixels, and the noise of a single pixel is less.
    count = ring.max() + 1
    total, weight = np.zeros(count), np.zeros(count)
    for a, b in combinations(range(len(values)), 2):
        noise = variances[a] + variances[b]
        for k in range(count):
            inside = np.isfinite(noise) & (ring == k)
            if inside.sum() < FEW_PIXELS:
                continue
            deviations = (values[a] - values[b])[inside] / np.sqrt(noise[inside])
            total[k] += inside.sum() * median_variance(deviations)
            weight[k] += inside.sum()
    ratio = np.divide(total, weight, where=weight > 0, out=np.ones(count))
    return np.minimum(ratio, 1.0)[ring]


def _outliers(values: Image, variances: Image) -> NDArray[np.bool_]:
    """Pixels of single frames, (patterns, ny, nx), that are far from the median of the others."""
    # Of two frames that differ, nothing says which is wrong.
    known = np.isfinite(variances)
    if len(values) < 3:
        return ~known
    middle = np.ma.median(np.ma.array(values, mask=~known), axis=0).filled(0.0)
    return ~known | (np.abs(values - middle) > OUTLIER * np.sqrt(variances))


def _prior_width(values: Image, variances: Image, away: Image) -> Image:
    """Standard deviation (ny, nx) of the pattern over the pixels of a ring."""
    # <v_a v_b> = width^2, because the noise of different frames is independent; squares of one
    # frame would show, where noise dominates, how well its errors are known. Where it does,
    # var(v_a v_b) = variance_a variance_b.
    ring = away.astype(np.int64)
    count = ring.max() + 1
    total, weight = np.zeros(count), np.zeros(count)
    known = np.isfinite(variances)
    for a in range(len(values)):
        for b in range(a + 1, len(values)):
            both = known[a] & known[b]
            share = 1 / (variances[a][both] * variances[b][both])
            product = values[a][both] * values[b][both]
            total += np.bincount(ring[both], share * product, count)
            weight += np.bincount(ring[both], share, count)
    width = np.divide(total, weight, where=weight > 0, out=np.zeros(count))
    # No ring is taken to be free of the pattern just because it is too faint to show it.
    seen = width[width > 0]
    floor = np.median(seen) / 4 if len(seen) else 1e-4
    return _on_pixels(np.maximum(width, floor), away)
