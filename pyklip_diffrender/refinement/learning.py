"""Learning the pattern of the model's error from stars other than the target."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.refinement.frame_fit import FrameFit
from pyklip_diffrender.refinement.result import Refinement
from pyklip_diffrender.refinement.systematics import Systematics

__all__ = ["learn_systematics"]

Image = NDArray[np.float64]

_RING = 4.0
"""Width in pixels of the rings in which scatters are estimated."""

_OUTLIER = 4.0
"""Standard deviations from the median of the frames beyond which a pixel of a frame is left out:
a companion or background source of that star, or a cosmic ray."""

_FAINT = 0.05
"""Ratios of a standard deviation above this times the prior's say nothing worth their cost."""


@dataclass(frozen=True)
class _Ratio:
    """Residual over star of one frame on the common pixels; weight 0 where not known."""

    star: str
    value: Image
    variance: Image


def learn_systematics(
    fits: Refinement | Sequence[Refinement], *, name: str | None = None
) -> Systematics:
    """Learn the pattern that the star model misses from fits of other stars.

    In every frame the residual is divided by the star. The ratios are averaged with inverse
    variances, which are those of the data's noise and of the scatter between frames beyond that
    noise; a zero-mean Gaussian prior, as wide as the ratios scatter over the pixels of a ring,
    shrinks pixels that were not measured well. The error of the pattern for another frame is that
    of this average and the scatter between frames.

    Parameters
    ----------
    fits : Refinement or sequence of Refinement
        Of other stars than the one that the pattern will be used for: a planet of the target
        would be learned as well. Two frames at least; rolls of one star will do, several stars
        show better how well the pattern carries over.
    name : str, optional
        Short label; default the names of the stars.

    Returns
    -------
    Systematics

    Raises
    ------
    IncompatibleSetupError
        For fewer than two frames, frames of different filters, or failed fits.
    """
    several = [fits] if isinstance(fits, Refinement) else list(fits)
    frames = [frame for fit in several if fit.status.usable for frame in fit.frames]
    if len(frames) < 2:
        raise IncompatibleSetupError(
            f"learn_systematics: got {len(frames)} usable frames, expected at least two, such as "
            "two rolls of a reference star"
        )
    filters = {frame.observation.filter for frame in frames}
    if len(filters) > 1:
        raise IncompatibleSetupError(
            f"learn_systematics: got frames of {sorted(map(str, filters))}, expected one filter"
        )
    ratios, center = _on_common_pixels(frames)
    ring = _rings(ratios[0].value.shape, center)
    values = np.stack([ratio.value for ratio in ratios])
    variances = np.stack([ratio.variance for ratio in ratios])
    scatter = _scatter_between_frames(ratios, ring)
    variances = np.where(_outliers(values, variances + scatter**2), np.inf, variances)
    width = _prior_width(values, variances, ring)
    precision = (1 / (variances + scatter**2)).sum(axis=0)
    # Frames of one star share what is particular to that star: they count as one for its scatter.
    total = precision + width**-2.0
    pattern = (values / (variances + scatter**2)).sum(axis=0) / total
    error = np.sqrt(1 / total + np.where(precision > 0, scatter**2, 0.0))
    error = np.minimum(error, width)
    observation = frames[0].observation
    stars = list(dict.fromkeys(ratio.star for ratio in ratios))
    return Systematics(
        pattern=pattern,
        error=error,
        center=center,
        unknown=float(np.median(width)),
        filter=observation.filter,
        image_mask=_text(observation.header.get("CORONMSK")),
        name=name or ", ".join(stars),
        provenance={
            "stars": stars,
            "frames": [frame.observation.name for frame in frames],
            "dates": [str(frame.observation.date) for frame in frames],
        },
    )


def _text(value: object) -> str | None:
    return value if isinstance(value, str) else None


def _ratio(frame: FrameFit) -> tuple[Image, Image]:
    """Residual over the star's light, and its variance (inf where nothing is known)."""
    combined = frame.observation.combined()
    background = float(frame.values["background"][0])
    light = (frame.star - background) / frame.gain
    left = combined.data[0] - background - frame.companion_image
    usable = combined.valid[0] & (light > 0)
    safe = np.where(usable, light, 1.0)
    value = np.where(usable, left / safe - 1, 0.0)
    return value, np.where(usable, (combined.error[0] / safe) ** 2, np.inf)


def _on_common_pixels(frames: Sequence[FrameFit]) -> tuple[list[_Ratio], tuple[float, float]]:
    """The frames' ratios on an array that holds all of them, stars on one pixel."""
    corners = []
    for frame in frames:
        x, y = np.round(frame.observation.center[0]).astype(int)
        ny, nx = frame.observation.shape
        corners.append((-x, -y, nx - x, ny - y))
    left, bottom = np.min(corners, axis=0)[:2]
    right, top = np.max(corners, axis=0)[2:]
    ratios = []
    for frame, (x, y, _, _) in zip(frames, corners, strict=True):
        value, variance = _ratio(frame)
        ny, nx = value.shape
        window = np.s_[y - bottom : y - bottom + ny, x - left : x - left + nx]
        on_common = np.zeros((top - bottom, right - left))
        of_common = np.full(on_common.shape, np.inf)
        on_common[window], of_common[window] = value, variance
        header = frame.observation.header
        star = _text(header.get("TARGPROP")) or frame.observation.name
        ratios.append(_Ratio(star, on_common, of_common))
    x, y = frames[0].observation.center[0]
    return ratios, (float(x - round(x) - left), float(y - round(y) - bottom))


def _rings(shape: tuple[int, int], center: tuple[float, float]) -> NDArray[np.int64]:
    """Number of the ring about the star that every pixel lies in."""
    y, x = np.indices(shape)
    distance = np.hypot(x - center[0], y - center[1])
    return (distance / _RING).astype(np.int64)


def _by_ring(variance: NDArray[np.float64], ring: NDArray[np.int64]) -> Image:
    """Standard deviations by ring, from variances that may be negative, on the pixels."""
    return np.sqrt(np.maximum(variance, 0.0))[ring]


def _scatter_between_frames(ratios: Sequence[_Ratio], ring: NDArray[np.int64]) -> Image:
    """Standard deviation of the ratio between frames beyond noise, on the pixels.

    From frames of different stars where there are any.
    """
    pairs = [(a, b) for k, a in enumerate(ratios) for b in ratios[k + 1 :]]
    across = [(a, b) for a, b in pairs if a.star != b.star] or pairs
    count = ring.max() + 1
    excess, weight = np.zeros(count), np.zeros(count)
    for a, b in across:
        noise = a.variance + b.variance
        known = np.isfinite(noise)
        difference = np.abs(a.value - b.value)
        for k in range(count):
            inside = known & (ring == k)
            if not inside.any():
                continue
            # The median square holds back companions; 0.4549 is that of a unit normal variable.
            spread = np.median(difference[inside] ** 2) / 0.4549
            share = 1 / np.median(noise[inside]) ** 2
            excess[k] += share * (spread - np.median(noise[inside]))
            weight[k] += share
    return _by_ring(np.divide(excess, 2 * weight, where=weight > 0, out=np.zeros(count)), ring)


def _outliers(values: Image, variances: Image) -> NDArray[np.bool_]:
    """Pixels of single frames that are far from the median of the others."""
    known = np.isfinite(variances)
    if len(values) < 3:
        return ~known
    middle = np.nanmedian(np.where(known, values, np.nan), axis=0)
    return ~known | (np.abs(values - middle) > _OUTLIER * np.sqrt(variances))


def _prior_width(values: Image, variances: Image, ring: NDArray[np.int64]) -> Image:
    """Standard deviation of the pattern over the pixels of a ring, beyond noise."""
    count = ring.max() + 1
    width = np.zeros(count)
    for k in range(count):
        inside = np.isfinite(variances) & (ring == k)
        if inside.any():
            weight = 1 / variances[inside] ** 2
            width[k] = np.average(values[inside] ** 2 - variances[inside], weights=weight)
    # No ring is taken to be free of the pattern just because it is too faint to show it.
    seen = width[width > 0]
    floor = np.median(seen) / 4 if len(seen) else 1e-4
    return _by_ring(np.maximum(width, floor), ring)
