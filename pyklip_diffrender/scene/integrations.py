"""Compare the integrations of a file, and leave out what deviates from the others.

All integrations of an exposure show the same star through nearly the same wavefront. One that is
empty, or has the afterglow of an earlier exposure, would spoil the average.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, uniform_filter
from scipy.stats import median_abs_deviation

from pyklip_diffrender.io.geometry import half_circle

__all__ = ["Judgement", "empty_integrations", "judge_integrations", "judge_pointings", "pointings"]

Stack = NDArray[np.float64]
Mask = NDArray[np.bool_]

_FEW = 3
"""Integrations below which none is an exception among the others."""

_BRIGHT = 10.0
"""S/N of the pixels that show how bright the star is."""

_FACTOR = 0.15
"""Deviation of the star's brightness from the median that jitter does not explain."""

_JITTER = 0.05
"""Pixels by which the star may move between integrations."""

_CHANGE = 0.03
"""Fraction by which the star's light may change from one integration to the next."""

_PATCH = 5
"""Side of the squares in which smooth deviations are looked for, pixels."""

_SMOOTH, _SINGLE = 6.0, 8.0
"""Deviations of a square and of a pixel, in standard deviations, above which they are masked."""

_NEAR = 3.0
"""arcsec from the star within which the masked pixels of an integration are counted."""

_MOST = 0.25
"""Share of these above which an integration is left out."""


_SAME_PLACE = 0.3
"""Pixels between the stars of frames that are averaged: a planet is then blurred by less than
a tenth of its width. Positions in aligned files were measured for each integration, to a tenth of
a pixel or so; a tighter rule would take their errors for pointings of their own."""

_SAME_ANGLE = 0.05
"""Degrees between frames that are averaged: a tenth of a pixel 7 arcsec from the star."""


@dataclass(frozen=True, eq=False)
class Judgement:
    """Integrations and pixels of a file that are used.

    Attributes
    ----------
    kept : ndarray of bool, (frames,)
        Integrations that are used.
    valid : ndarray of bool, (frames, ny, nx)
        Pixels that are used.
    remarks : tuple of str
        Integrations and pixels that were left out, and why.
    """

    kept: NDArray[np.bool_]
    valid: Mask
    remarks: tuple[str, ...]


def empty_integrations(data: Stack, valid: Mask) -> Judgement:
    """Find integrations without usable pixels, or whose pixels all have one value.

    Parameters
    ----------
    data : ndarray, (frames, ny, nx)
    valid : ndarray of bool, (frames, ny, nx)
        Finite pixels with errors and without flags.
    """
    kept = np.ones(len(data), dtype=bool)
    remarks = []
    for k, (frame, usable) in enumerate(zip(data, valid, strict=True)):
        values = frame[usable]
        if not len(values):
            reason = "all of its pixels are flagged, not finite or without an error"
        elif len(values) > 1 and np.ptp(values) == 0:
            reason = f"all of its pixels have the value {values[0]:g}"
        else:
            continue
        kept[k] = False
        remarks.append(f"integration {k + 1} of {len(data)} is left out: {reason}")
    return Judgement(kept, valid, tuple(remarks))


def judge_integrations(
    data: Stack,
    error: Stack,
    valid: Mask,
    center: Stack,
    pixelscale: tuple[float, float],
    names: Sequence[str],
) -> Judgement:
    """Compare integrations of one pointing with their median.

    The star's light may move by a twentieth of a pixel and change by 3 % between integrations.
    Larger deviations that are significant are masked; an integration is left out if they are a
    quarter of the pixels within 3 arcsec of the star, or if its star is 15 % brighter or fainter.

    Parameters
    ----------
    data, error : ndarray, (frames, ny, nx)
    valid : ndarray of bool, (frames, ny, nx)
    center : ndarray, (frames, 2)
        x, y of the star.
    pixelscale : tuple of float
        x, y, arcsec per pixel.
    names : sequence of str
        Names of the integrations in remarks, such as "integration 3 of 8".
    """
    count = len(data)
    kept, left = np.ones(count, dtype=bool), valid.copy()
    if count < _FEW:
        return Judgement(kept, left, ())
    median = _median(data, valid)
    rows, columns = np.indices(median.shape)
    x, y = center.mean(axis=0)
    near = np.hypot((columns - x) * pixelscale[0], (rows - y) * pixelscale[1]) < _NEAR
    remarks = []
    slopes = np.hypot(*np.gradient(median))
    allowed = _JITTER * slopes + _CHANGE * np.abs(median)
    for k, (frame, sigma, usable, name) in enumerate(zip(data, error, valid, names, strict=True)):
        scale = _brightness(frame, median, sigma, usable & near)
        if abs(scale - 1) > _FACTOR:
            kept[k] = False
            remarks.append(
                f"{name} is left out: its star is {scale:.2f} times as "
                "bright as in the median of all"
            )
            continue
        deviating = _deviating(frame - median, sigma, usable, allowed)
        share = float((deviating & near).sum() / max(1, (usable & near).sum()))
        if share > _MOST:
            kept[k] = False
            remarks.append(
                f"{name} is left out: {share:.0%} of its pixels within "
                f"{_NEAR:g} arcsec of the star deviate from the median of all"
            )
        elif deviating.any():
            left[k] &= ~deviating
            if deviating.sum() > _PATCH**2:
                remarks.append(
                    f"{name}: {int(deviating.sum())} pixels that deviate "
                    "from the median of all are masked"
                )
    return Judgement(kept, left, tuple(remarks))


def judge_pointings(
    data: Stack,
    error: Stack,
    valid: Mask,
    center: Stack,
    angles: NDArray[np.float64] | None,
    pixelscale: tuple[float, float],
    names: Sequence[str],
) -> Judgement:
    """Compare the integrations of every pointing with their median, see `judge_integrations`.

    Parameters
    ----------
    data, error, valid, center, pixelscale, names
        See `judge_integrations`.
    angles : ndarray, (frames,), or None
        Position angles, degrees.
    """
    kept, left = np.ones(len(data), dtype=bool), valid.copy()
    remarks: tuple[str, ...] = ()
    for group in pointings(center, angles):
        named = [names[k] for k in group]
        part = judge_integrations(
            data[group], error[group], valid[group], center[group], pixelscale, named
        )
        kept[group], left[group] = part.kept, part.valid
        remarks += part.remarks
    return Judgement(kept, left, remarks)


def _median(data: Stack, valid: Mask) -> Stack:
    """Median of the valid pixels; 0 where there are none."""
    ordered = np.sort(np.where(valid, data, np.inf), axis=0)
    count = valid.sum(axis=0)
    low, high = np.maximum(count - 1, 0) // 2, count // 2
    pair = [np.take_along_axis(ordered, each[None], axis=0)[0] for each in (low, high)]
    return np.where(count > 0, np.where(count > 0, pair[0] + pair[1], 0.0) / 2, 0.0)


def _brightness(frame: Stack, median: Stack, sigma: Stack, usable: Mask) -> float:
    """Brightness of the star over that in the median; 1 if the star is not seen."""
    bright = usable & (median > _BRIGHT * sigma)
    norm = float((median[bright] ** 2).sum())
    return float((frame[bright] * median[bright]).sum() / norm) if norm > 0 else 1.0


def _deviating(difference: Stack, sigma: Stack, usable: Mask, allowed: Stack) -> Mask:
    """Pixels that deviate by more than noise and jitter, singly or in squares."""
    weight = usable.astype(float)
    excess = np.maximum(np.abs(difference) - allowed, 0.0) * weight
    # Stated errors may be too small.
    scatter = median_abs_deviation((difference / sigma)[usable], scale="normal")
    noise = sigma * max(1.0, float(scatter))
    single = excess > _SINGLE * noise
    area = _PATCH**2
    total = uniform_filter(difference * weight, _PATCH, mode="constant") * area
    tolerated = uniform_filter(allowed * weight, _PATCH, mode="constant") * area
    variance = uniform_filter(noise**2 * weight, _PATCH, mode="constant") * area
    spread = np.sqrt(np.where(variance > 0, variance, np.inf))
    # Noise that neighbouring pixels share, such as 1/f noise, adds up in squares.
    shared = median_abs_deviation((total / spread)[usable], scale="normal")
    spread *= max(1.0, float(shared))
    smooth = np.abs(total) - tolerated > _SMOOTH * spread
    reach = np.ones((_PATCH, _PATCH), dtype=bool)
    return np.asarray(usable & (single | binary_dilation(smooth, reach)))


def pointings(center: Stack, angles: NDArray[np.float64] | None) -> Iterator[NDArray[np.intp]]:
    """Sort frames by where and how they show the star.

    Parameters
    ----------
    center : ndarray, (frames, 2)
        x, y of the star, pixels.
    angles : ndarray, (frames,), or None
        Position angles, degrees.

    Yields
    ------
    ndarray of int
        Indices of frames that can be averaged.
    """
    left = np.ones(len(center), dtype=bool)
    turns = np.zeros(len(center)) if angles is None else angles
    while left.any():
        first = int(np.argmax(left))
        apart = np.hypot(*(center - center[first]).T)
        turned = np.abs(half_circle(turns - turns[first]))
        group = left & (apart <= _SAME_PLACE) & (turned <= _SAME_ANGLE)
        left &= ~group
        yield np.flatnonzero(group)
