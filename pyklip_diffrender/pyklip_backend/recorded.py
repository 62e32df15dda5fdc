"""The pixels that the files of a `JWSTData` recorded, with what was added to the dataset since.

The frames in ``dataset.input`` of a `JWSTData` were shifted to the centre of the array when they
were read, which correlates their noise and makes sharp speckles ring. Where the recorded frames
are known, the fit gets those, plus whatever was added to ``dataset.input`` since (an injected
companion, for example). Only the subtracted frames are then shifted.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pyklip_diffrender.io.units import native_float64
from pyklip_diffrender.pyklip_backend.source import SourceFrames

__all__ = ["NotRecordedError", "Recorded", "recorded_frames"]

_ROUNDING = 1e-5
"""Relative difference of pixels that single precision explains."""


class NotRecordedError(Exception):
    """The recorded pixels are not those of the dataset, for the reason that the message gives."""


class Recorded(NamedTuple):
    """Recorded pixels with what was added to the dataset since, (n, ny, nx), and their star."""

    data: NDArray[np.float64]
    valid: NDArray[np.bool_]
    error: NDArray[np.float64] | None
    centers: NDArray[np.float64]
    factor: NDArray[np.float64]


def recorded_frames(
    source: SourceFrames,
    places: NDArray[np.intp] | None,
    dataset: Any,
    index: NDArray[np.intp],
    imgs: NDArray[np.float64],
) -> Recorded:
    """Recorded pixels plus what was added to `imgs` since reading, in the unit of the files.

    Raises
    ------
    NotRecordedError
        If no recorded pixels correspond to those of the dataset.
    """
    from pyklip.klip import align_and_scale

    if places is None:
        raise NotRecordedError("its frames are not those that were read, by their names")
    if imgs.shape[1:] != source.aligned.shape[1:]:
        ny, nx = source.aligned.shape[1:]
        raise NotRecordedError(
            f"its frames have {imgs.shape[2]} x {imgs.shape[1]} pixels, and had {nx} x {ny} when "
            "they were read"
        )
    rows = places[index]
    before = native_float64(source.aligned[rows])
    factor = np.array([_factor(one, other) for one, other in zip(imgs, before, strict=True)])
    # Pixels that were NaN when they were read belong to flagged ones, whatever was filled in.
    change = np.where(np.isfinite(before), imgs / factor[:, None, None] - before, 0.0)
    data = native_float64(source.data[rows])
    error = None if source.error is None else native_float64(source.error[rows])
    if error is not None:
        _require_same(change, error, source.usable[rows])
    valid = source.usable[rows] & np.isfinite(data)
    centers = native_float64(dataset.centers)[index]
    moved = centers - source.aligned_centers[rows]
    for i, frame in enumerate(rows):
        shift = {"new_center": source.centers[frame], "old_center": source.aligned_centers[frame]}
        masked = np.isnan(imgs[i]) & np.isfinite(before[i])
        added = np.where(np.isfinite(change[i]), change[i], 0.0)
        # A changed factor is known to the rounding of single precision.
        peak = np.max(np.abs(before[i]), where=np.isfinite(before[i]), initial=0.0)
        if np.abs(added).max() > _ROUNDING * peak:
            # Nothing is known beyond the edge of the shifted frame; assume nothing was added.
            data[i] += np.nan_to_num(align_and_scale(added, **shift))
        if masked.any():
            # A pixel masked by hand invalidates every recorded pixel that contributed to it.
            valid[i] &= np.nan_to_num(align_and_scale(masked.astype(float), **shift)) < 0.1
    return Recorded(data, valid, error, source.centers[rows] + moved, factor)


def _factor(now: NDArray[np.float64], before: NDArray[np.float64]) -> float:
    """Factor by which a frame was multiplied since it was read; 1 if it was not.

    Raises
    ------
    NotRecordedError
        If it is not positive.
    """
    known = np.isfinite(before) & np.isfinite(now)
    if not known.any():
        return 1.0
    with np.errstate(invalid="ignore"):
        bright = known & (np.abs(before) > np.percentile(np.abs(before[known]), 90))
    if not bright.any():
        return 1.0
    ratios = now[bright] / before[bright]
    factor = float(np.median(ratios))
    # Sources that were added since change few of the brightest pixels.
    if abs(factor - 1) < _ROUNDING or np.median(np.abs(ratios - factor)) > _ROUNDING * abs(factor):
        return 1.0
    if factor <= 0:
        raise NotRecordedError(f"its frames were multiplied by {factor:.3g} after reading")
    return factor


def _require_same(
    change: NDArray[np.float64], error: NDArray[np.float64], usable: NDArray[np.bool_]
) -> None:
    """Refuse frames in which most pixels were changed by more than their noise.

    Faint sources change few pixels, and another background changes all by the same amount.

    Raises
    ------
    NotRecordedError
    """
    for frame, sigma, good in zip(change, error, usable, strict=True):
        known, scale = frame[np.isfinite(frame)], sigma[good & (sigma > 0)]
        if not known.size or not scale.size:
            continue
        spread = float(np.median(np.abs(known - np.median(known))))
        if spread > float(np.median(scale)):
            raise NotRecordedError(
                "most of its pixels were changed by more than their noise after reading, for "
                "example by a filter"
            )
