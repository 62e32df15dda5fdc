"""The pedestal of a pattern: light besides the star that the pattern multiplies."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from pyklip_diffrender.refinement.fit_result import Refinement
from pyklip_diffrender.refinement.frame_fit import FrameFit

__all__ = [
    "FEW_PIXELS",
    "OUTLIER",
    "light_and_residual",
    "median_variance",
    "pattern_pedestal",
    "rings_about",
    "widths_from_star",
]

Image = NDArray[np.float64]

_RING = 4.0
"""Width in pixels of the rings in which scatters are estimated."""

_FIRST_RING = 2
"""First ring from which the pedestal is estimated: closer to the star, residuals are
also those of the wavefront."""

FEW_PIXELS = 50
"""Number of pixels below which no scatter is estimated in a ring."""

_RING_TO_RING = 0.2
"""Relative error of a ring's mean product, because the pattern is not the same in all of them."""

_DIFFERENT = 1.5
"""Ratio of the brightness of two stars from which their residuals tell the pedestal."""

_ROBUST = 2.0
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
    """Estimate the pedestal with which one pattern holds near the star and far from it.

    Frames have a fixed pattern that does not become fainter with the distance from the star. In
    frames of two stars s of different brightness the residuals r of a pixel obey
    r_1 / (s_1 + B) = r_2 / (s_2 + B), which gives the pedestal B by robust total least squares.

    For rolls of one star the pattern must be taken to be as strong in all rings about it. The
    product of the residuals of two frames of the same pixels, averaged over a ring, is
    m^2 (s_1 + B) (s_2 + B) for a pattern of rms m. A least-squares fit to all rings gives m and B.

    Returns
    -------
    float
        In the unit of the frames; 0 where no two frames of a fit show the same pixels.
    """
    pairs = list(_pairs_of_stars(fits))
    if pairs:
        return _pedestal_between_stars(pairs)
    rings = [ring for fit in fits for ring in _products(fit)]
    if not rings:
        return 0.0
    product, first, second, error = np.array(rings).T

    def misfit(pedestal: float) -> float:
        shape = (first + pedestal) * (second + pedestal)
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
        if brighter < _DIFFERENT * fainter:
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
            other = light[::-1] + pedestal
            deviation = (left[0] * other[0] - left[1] * other[1]) ** 2
            ratio = deviation / ((noise * other) ** 2).sum(axis=0)
            # Cauchy's loss, because of companions, outliers and errors of the wavefront.
            total += float(np.log1p(ratio / _ROBUST**2).sum())
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
                 float(np.hypot(scatter, _RING_TO_RING * mean)))
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
    light = (frame.star - background + known) / frame.gain - known
    left = combined.data[0] - background - frame.companion_image - light
    return light, left, combined.error[0], combined.valid[0]


def widths_from_star(shape: tuple[int, int], center: tuple[float, float]) -> Image:
    """Distance of every pixel from the star, in widths of a ring."""
    y, x = np.indices(shape)
    return np.asarray(np.hypot(x - center[0], y - center[1]) / _RING)


def rings_about(shape: tuple[int, int], center: tuple[float, float]) -> NDArray[np.int64]:
    """Number of the ring about the star that every pixel lies in."""
    return widths_from_star(shape, center).astype(np.int64)
