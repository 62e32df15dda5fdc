"""The integrations of a file: checks of their arrays, which of them deviate, and their noise.

All integrations of an exposure show the same star through nearly the same wavefront. One that is
empty, or has the afterglow of an earlier exposure, would spoil the average.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from astropy import units as u
from astropy.stats import mad_std
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, convolve, uniform_filter

from pyklip_diffrender.errors import (
    IncompatibleSetupError,
    NoValidPixelsError,
    ShapeError,
    UnitError,
)
from pyklip_diffrender.io.units import (
    half_circle,
    require_finite,
    require_shape,
    to_arcsec,
    to_pair,
    to_unit,
)

# Checks of the arrays and numbers that an observation is made of.


def unit_of_frames(unit: Any, name: str) -> u.UnitBase:
    """Unit of an observation; UnitError if it is not known."""
    try:
        return u.Unit(unit)
    except (ValueError, TypeError) as reason:
        raise UnitError(
            f"{name}: got the unit {unit!r}, expected an astropy unit such as 'MJy/sr'"
        ) from reason


def usable_pixels(
    data: NDArray[Any], error: NDArray[Any], valid: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Valid pixels of a frame, (ny, nx), that are finite and have an error."""
    return np.asarray(valid & np.isfinite(data) & np.isfinite(error) & (error > 0))


def mask_unusable(frames: Mapping[str, Any], valid: NDArray[np.bool_] | None = None) -> None:
    """Set data to 0, errors to 1 and valid to False where pixels cannot be used, in place.

    The arrays of `frames`, and `valid`, which says what else is not to be used, are
    (frames, ny, nx). The arrays are changed frame by frame, which takes no memory.
    """
    for k, (data, error, good) in enumerate(
        zip(frames["data"], frames["error"], frames["valid"], strict=True)
    ):
        good &= usable_pixels(data, error, good if valid is None else valid[k])
        data[~good], error[~good] = 0.0, 1.0


def checked_stacks(
    data: NDArray[Any],
    error: NDArray[Any],
    *,
    valid: NDArray[np.bool_] | None = None,
    unit: str | u.UnitBase,
    pixelscale: float | tuple[float, float],
    center: Any = None,
    **details: Any,
) -> dict[str, Any]:
    """Return the attributes of an `Observation`, checked, with the caller's own arrays.

    `mask_unusable` sets what cannot be used to the values that an `Observation` has there.
    """
    name = details.get("name", "observation")
    unit = unit_of_frames(unit, name)
    values = data[None] if data.ndim == 2 else data
    if values.ndim != 3 or values.size == 0:
        raise ShapeError(f"{name}: data: got shape {np.shape(data)}, expected ([frames,] ny, nx)")
    sigma = error[None] if error.ndim == 2 else error
    require_shape(sigma, values.shape, f"{name}: error", "Give one error for every pixel")
    mask = np.ones(values.shape, dtype=bool) if valid is None else valid
    mask = mask[None] if mask.ndim == 2 else mask
    require_shape(mask, values.shape, f"{name}: valid", "Give one value for every pixel")
    for k, each in enumerate(map(usable_pixels, values, sigma, mask)):
        if not each.any():
            raise NoValidPixelsError(
                f"{name}: all {each.size} pixels of frame {k} are masked, not "
                "finite or without an error. Look at its DQ"
            )
    if details.get("star_offset") is not None:
        details["star_offset"] = to_pair(details["star_offset"], u.arcsec, "star_offset")
    if details.get("position_angles") is not None:
        angles = to_unit(details["position_angles"], u.deg, "position_angles")
        details["position_angles"] = _spread(angles, (len(values),), f"{name}: position_angles")
    frames, ny, nx = values.shape
    middle = [(nx - 1) / 2, (ny - 1) / 2]
    position = to_unit(middle if center is None else center, u.pix, f"{name}: center")
    require_finite(position, f"{name}: center")
    scale = _spread(to_arcsec(pixelscale, "pixelscale"), (2,), f"{name}: pixelscale")
    if not (np.isfinite(scale) & (scale > 0)).all():
        raise IncompatibleSetupError(
            f"{name}: pixelscale: got {pixelscale}, expected a positive number of arcsec per "
            "pixel, such as 0.0624"
        )
    return {
        "data": values,
        "error": sigma,
        "valid": mask,
        "unit": unit,
        "pixelscale": (float(scale[0]), float(scale[1])),
        "center": _spread(position, (frames, 2), f"{name}: center"),
        **details,
    }


def selected(frames: Mapping[str, Any], which: NDArray[np.intp]) -> dict[str, Any]:
    """The attributes of an `Observation` that change if frames are selected by their indices."""
    names = ("data", "error", "valid", "center", "position_angles")
    counted = {name: frames.get(name, ()) for name in ("noise_ratios", "integrations")}
    return {
        **{name: frames[name][which] for name in names if frames[name] is not None},
        **{name: tuple(each[k] for k in which) if each else () for name, each in counted.items()},
    }


def _spread(array: NDArray[np.float64], shape: tuple[int, ...], name: str) -> NDArray[np.float64]:
    """Copy of an array, repeated to a shape."""
    try:
        return np.broadcast_to(array, shape).copy()
    except ValueError as error:
        raise ShapeError(f"{name}: got shape {array.shape}, expected {shape}") from error


# Compare the integrations of a file, and leave out what deviates from the others.

Image = NDArray[np.float64]
Mask = NDArray[np.bool_]

_PIXELS_AT_A_TIME = 2**18
"""Largest number of pixels in one call of the median, which bounds its memory."""

_FEWEST_INTEGRATIONS = 3
"""Number of integrations below which none can be told from the others."""

_STARLIT_PIXEL_SNR = 10.0
"""S/N of the pixels that show how bright the star is."""

_BRIGHTNESS_DEVIATION = 0.15
"""Deviation of the star's brightness from the median that jitter does not explain."""

_JITTER_PIXELS = 0.05
"""Pixels by which the star may move between integrations."""

_INTEGRATION_FLUX_CHANGE = 0.03
"""Fraction by which the star's light may change from one integration to the next."""

_PATCH_PIXELS = 5
"""Side of the squares in which smooth deviations are looked for, pixels."""

_PATCH_OUTLIER_SIGMAS, _PIXEL_OUTLIER_SIGMAS = 6.0, 8.0
"""Deviations of a square and of a pixel, in standard deviations, above which they are masked."""

_MASKED_PIXELS_ARCSEC = 3.0
"""arcsec from the star within which the masked pixels of an integration are counted."""

_MASKED_PIXELS_SHARE = 0.25
"""Share of masked pixels above which an integration is left out."""


_SAME_STAR_PIXELS = 0.3
"""Pixels between the stars of frames that are averaged: a planet is then blurred by less than
a tenth of its width. Positions in aligned files were measured for each integration, to a tenth of
a pixel or so; a tighter rule would take their errors for pointings of their own."""

_SAME_ROLL_DEG = 0.05
"""Degrees between frames that are averaged: a tenth of a pixel 7 arcsec from the star."""


@dataclass(frozen=True, eq=False)
class Judgement:
    """Integrations and pixels of a file that are used."""

    kept: NDArray[np.bool_]  # (frames,), integrations that are used
    remarks: tuple[str, ...]  # what was left out, and why


def compressed(stack: NDArray[Any], kept: NDArray[np.bool_]) -> NDArray[Any]:
    """The frames of a stack, (frames, ...), that are kept, moved to its beginning in place."""
    where = np.flatnonzero(kept)
    for k, old in enumerate(where):
        if k != old:
            stack[k] = stack[old]
    return stack[: len(where)]


def empty_integrations(data: Image, valid: Iterable[Mask]) -> Judgement:
    """Find integrations without `valid` pixels, or whose pixels all have one value.

    `data` is (frames, ny, nx), each of `valid` (ny, nx).
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
    return Judgement(kept, tuple(remarks))


def judge_integrations(frames: Mapping[str, Any], names: Sequence[str]) -> Judgement:
    """Compare the integrations of every pointing with their median.

    `frames` are the attributes of an `Observation`. Pixels that deviate are masked in its valid
    pixels, in place. `names` call the integrations in remarks, such as "integration 3 of 8".
    """
    kept = np.ones(len(frames["data"]), dtype=bool)
    remarks: list[str] = []
    for group in pointings(frames["center"], frames["position_angles"]):
        remarks += _judge_pointing(frames, names, group, kept)
    return Judgement(kept, tuple(remarks))


def _judge_pointing(
    frames: Mapping[str, Any], names: Sequence[str], group: NDArray[np.intp], kept: Mask
) -> list[str]:
    """Judge the integrations with the indices `group`; what is not used is not `kept`, in place."""
    data, error, valid = frames["data"], frames["error"], frames["valid"]
    pixelscale = frames["pixelscale"]
    remarks = []
    for k in group:
        if not valid[k].any():
            kept[k] = False
            remarks.append(
                f"{names[k]} is left out: no pixel is valid. Where the shift of an alignment is "
                "undone, pixels without a value or a positive error take their neighbours along"
            )
    group = group[kept[group]]
    # A single row or column has no slopes.
    if len(group) < _FEWEST_INTEGRATIONS or min(data.shape[1:]) < 2:
        return remarks
    # The star may move by a twentieth of a pixel between integrations and its light change by 3 %.
    # Larger deviations that are significant are masked; an integration is left out if they are a
    # quarter of the pixels within 3 arcsec of the star, or if its star is 15 % brighter or fainter.
    # The stacks are never copied as a whole, because they may be larger than the memory.
    median = _median(data, valid, group)
    rows, columns = np.indices(median.shape)
    x, y = frames["center"][group].mean(axis=0)
    distance = np.hypot((columns - x) * pixelscale[0], (rows - y) * pixelscale[1])
    near = distance < _MASKED_PIXELS_ARCSEC
    # A star that moves by d changes a pixel by its slope times d.
    slopes = np.hypot(*np.gradient(median))
    allowed = _JITTER_PIXELS * slopes + _INTEGRATION_FLUX_CHANGE * np.abs(median)
    for k in group:
        frame, sigma = data[k].astype(float), error[k].astype(float)
        usable, name = valid[k], names[k]
        scale = _brightness(frame, median, sigma, usable & near)
        if abs(scale - 1) > _BRIGHTNESS_DEVIATION:
            kept[k] = False
            remarks.append(
                f"{name} is left out: its star is {scale:.2f} times as "
                "bright as in the median of all"
            )
            continue
        deviating = _deviating(frame - median, sigma, usable, allowed)
        share = float((deviating & near).sum() / max(1, (usable & near).sum()))
        if share > _MASKED_PIXELS_SHARE:
            kept[k] = False
            remarks.append(
                f"{name} is left out: {share:.0%} of its pixels within "
                f"{_MASKED_PIXELS_ARCSEC:g} arcsec of the star deviate from the median of all"
            )
        elif deviating.any():
            usable &= ~deviating
            if deviating.sum() > _PATCH_PIXELS**2:
                remarks.append(
                    f"{name}: {int(deviating.sum())} pixels that deviate "
                    "from the median of all are masked"
                )
    return remarks


def _median(data: Image, valid: Mask, group: NDArray[np.intp]) -> Image:
    """Median of the valid pixels of some frames, (ny, nx); 0 where there are none."""
    median = np.zeros(data.shape[1:])
    rows = max(1, _PIXELS_AT_A_TIME // (len(group) * data.shape[2]))
    for first in range(0, len(median), rows):
        part = slice(first, first + rows)
        # Masked pixels are sorted to the end, so that the median of the valid ones is the mean of
        # the two in the middle of the first `count`.
        usable = valid[group, part]
        ordered = np.sort(np.where(usable, data[group, part], np.inf), axis=0)
        count = usable.sum(axis=0)
        low, high = np.maximum(count - 1, 0) // 2, count // 2
        pair = [np.take_along_axis(ordered, each[None], axis=0)[0] for each in (low, high)]
        total = pair[0].astype(float) + pair[1]
        median[part] = np.where(count > 0, total, 0.0) / 2
    return median


def _brightness(frame: Image, median: Image, sigma: Image, usable: Mask) -> float:
    """Ratio of the star's brightness in a frame and in the median; 1 if the star is not seen."""
    # sum of (frame - a median)^2 is minimal at a = sum of frame median / sum of median^2.
    bright = usable & (median > _STARLIT_PIXEL_SNR * sigma)
    norm = float((median[bright] ** 2).sum())
    return float((frame[bright] * median[bright]).sum() / norm) if norm > 0 else 1.0


def _deviating(difference: Image, sigma: Image, usable: Mask, allowed: Image) -> Mask:
    """Pixels that deviate by more than noise and jitter, singly or in squares."""
    weight = usable.astype(float)
    excess = np.maximum(np.abs(difference) - allowed, 0.0) * weight
    # Stated errors may be too small.
    scatter = mad_std((difference / sigma)[usable])
    noise = sigma * max(1.0, float(scatter))
    single = excess > _PIXEL_OUTLIER_SIGMAS * noise
    area = _PATCH_PIXELS**2
    total = uniform_filter(difference * weight, _PATCH_PIXELS, mode="constant") * area
    tolerated = uniform_filter(allowed * weight, _PATCH_PIXELS, mode="constant") * area
    variance = uniform_filter(noise**2 * weight, _PATCH_PIXELS, mode="constant") * area
    spread = np.sqrt(np.where(variance > 0, variance, np.inf))
    # Noise that neighbouring pixels share, such as 1/f noise, adds up in squares.
    shared = mad_std((total / spread)[usable])
    spread *= max(1.0, float(shared))
    smooth = np.abs(total) - tolerated > _PATCH_OUTLIER_SIGMAS * spread
    reach = np.ones((_PATCH_PIXELS, _PATCH_PIXELS), dtype=bool)
    return np.asarray(usable & (single | binary_dilation(smooth, reach)))


def pointings(center: Image, angles: NDArray[np.float64] | None) -> Iterator[NDArray[np.intp]]:
    """Indices of frames that can be averaged, one array for each place and angle of the star.

    `center` is x, y of the star in pixels, (frames, 2); `angles` are in degrees, (frames,), or
    None.
    """
    # Groups are formed about the first frame that is left, so that none is wider than twice the
    # limits.
    left = np.ones(len(center), dtype=bool)
    turns = np.zeros(len(center)) if angles is None else angles
    while left.any():
        first = int(np.argmax(left))
        apart = np.hypot(*(center - center[first]).T)
        turned = np.abs(half_circle(turns - turns[first]))
        group = left & (apart <= _SAME_STAR_PIXELS) & (turned <= _SAME_ROLL_DEG)
        left &= ~group
        yield np.flatnonzero(group)


# Noise of real frames, measured where there is no starlight.
#
# The errors in the ERR extension of coadded JWST frames may be wrong by up to a factor of two in
# the part that does not depend on the light (read noise and background). That part is measured here
# on the frame itself, far from the star.

_log = logging.getLogger(__name__)

_STARLIGHT_NOISE_ARCSEC = 6.0
"""arcsec from the star beyond which its light adds no noise. Closer in, a bright star's light still
shows in differences of neighbouring pixels."""

_FEWEST_FAR_PIXELS = 2000
"""Number of far pixels below which the errors are left as they are."""

_PLAUSIBLE_SCATTER_RATIO = (0.1, 5.0)
"""Ratios of scatter and errors beyond which the errors belong to other pixels. The ratio was 0.4 to
1.2 in the real frames at hand."""

_DARK_BOX_PIXELS = 15
"""Side of the squares, pixels, whose mean light tells which parts of a frame are dark."""

_STARLIT_BOX_SIGMAS = 4.0
"""Standard deviations from the median of the mean lights above which a part is not dark."""

_DARK_PIXELS_SHARE = 0.25
"""Least share of the far pixels that is taken as dark, in a field that is full of sources."""

NEIGHBOURS = np.array([[0, 1, 0], [1, 0, 1], [0, 1, 0]]) / 4.0
"""Kernel of the mean of the four neighbours of a pixel."""


def calibrated_errors(
    data: Image,
    error: Image,
    valid: NDArray[np.bool_],
    center: Image,
    pixelscale: tuple[float, float],
    name: str = "frames",
    *,
    out: Image | None = None,
) -> tuple[Image, tuple[float, ...]]:
    """Correct the part of the errors, (frames, ny, nx), that does not depend on the light.

    `center` is x, y of the star, (frames, 2), 0-indexed, `pixelscale` x, y in arcsec per pixel. The
    new errors are written to `out`, which may be `error`. The second value has for every frame the
    factor by which its errors were wrong. Frames with fewer than 2000 usable pixels far from the
    star keep their errors, and their factor is NaN.
    """
    # Pixels are compared with the mean of their four neighbours, 6 arcsec or more from the star and
    # where the frame is dark. The robust scatter of these differences over what the errors predict
    # is the factor f by which the errors there are wrong. With b the median of these errors,
    # (f^2 - 1) b^2 is added to the variance of every pixel, which leaves the photon noise of the
    # star as it is. Noise that neighbouring pixels share, such as 1/f noise, cancels in the
    # differences and is not counted.
    corrected, ratios = error.copy() if out is None else out, []
    y, x = np.indices(data.shape[1:])
    for k, usable in enumerate(valid):
        frame, sigma = data[k].astype(float), error[k].astype(float)
        away = np.hypot((x - center[k, 0]) * pixelscale[0], (y - center[k, 1]) * pixelscale[1])
        # A pixel is compared only where all of its neighbours are usable.
        complete = convolve(usable.astype(float), NEIGHBOURS, mode="constant") > 0.99
        far = dark_pixels(frame, usable & complete & (away > _STARLIGHT_NOISE_ARCSEC))
        if far.sum() < _FEWEST_FAR_PIXELS:
            ratios.append(np.nan)
            continue
        # The difference x - (a + b + c + d) / 4 has the variance s_x^2 + (s_a^2 + s_b^2 + s_c^2 +
        # s_d^2) / 16, and `convolve` averages four.
        difference = frame - convolve(frame, NEIGHBOURS, mode="nearest")
        predicted = np.sqrt(sigma**2 + convolve(sigma**2, NEIGHBOURS, mode="nearest") / 4)
        ratio, floor = float(mad_std((difference / predicted)[far])), float(np.median(sigma[far]))
        ratios.append(ratio)
        if not ratio > 0:
            continue
        # An error below b would get too small or even a negative variance if f < 1: no error is
        # multiplied by less than f.
        least = min(ratio, 1.0) * sigma
        variance = np.maximum(sigma**2 + (ratio**2 - 1) * floor**2, least**2)
        corrected[k] = np.where(usable, np.sqrt(variance), sigma)
        _log.info("%s, frame %d: the noise far from the star is %.2f of ERR", name, k, ratio)
    return corrected, tuple(ratios)


def weighted_mean(
    data: Image,
    error: Image,
    valid: NDArray[np.bool_],
    which: Iterable[int] | None = None,
) -> tuple[Image, Image, NDArray[np.bool_]]:
    """Mean and error, (ny, nx), of frames (frames, ny, nx), and where they are valid.

    Mean and error are 0 and 1 where no frame is valid. `which` are the indices of the frames, by
    default of all.
    """
    # Weights are the inverse median variances of the frames: m = sum of w d / sum of w, with the
    # variance sum of w^2 s^2 / (sum of w)^2. The errors of single pixels are no weights: they come
    # from the counts of the pixels, so that low counts would weigh more, and the mean would be too
    # low.
    light, noise, total = np.zeros((3, *data.shape[1:]))
    # Frame by frame, which takes no memory.
    for k in range(len(data)) if which is None else which:
        frame, usable = data[k], valid[k]
        variance = error[k].astype(float) ** 2
        weight = 1 / np.median(variance[usable]) if usable.any() else 1.0
        # Masked pixels may have any value if the data were replaced, also NaN.
        light += np.where(usable, weight * frame, 0.0)
        noise += np.where(usable, weight**2 * variance, 0.0)
        total += weight * usable
    covered = total > 0
    safe = np.where(covered, total, 1.0)
    return light / safe, np.where(covered, np.sqrt(noise) / safe, 1.0), covered


def dark_pixels(frame: Image, usable: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Find the usable pixels (ny, nx) with noise, and without other stars, galaxies or nebulae."""
    if not usable.any():
        return usable
    # The light is averaged over squares of 15 pixels, so that the noise of a pixel does not decide
    # whether it counts. Dark is what is at most four standard deviations above the median of these
    # means, or the darkest quarter of a field that is full of sources.
    # A single bright pixel is an outlier, and no source.
    median = np.median(frame[usable])
    limit = 5 * mad_std(frame[usable])
    clipped = np.where(usable, np.clip(frame - median, -limit, limit), 0.0)
    weight = uniform_filter(usable.astype(float), _DARK_BOX_PIXELS, mode="constant")
    smooth = uniform_filter(clipped, _DARK_BOX_PIXELS, mode="constant") / np.maximum(weight, 1e-3)
    values = smooth[usable]
    middle = float(np.median(values))
    below = middle - values[values <= middle]
    # 0.6745 is the median of |x| for a normal x of variance 1.
    # The scatter of the darker half, which sources do not reach.
    spread = float(np.median(below)) / 0.6745
    threshold = max(
        middle + _STARLIT_BOX_SIGMAS * spread, float(np.quantile(values, _DARK_PIXELS_SHARE))
    )
    return usable & (smooth <= threshold)


def why_odd_noise(ratios: Iterable[float]) -> str:
    """Why errors with the ratios of `calibrated_errors` are not the pixels', or an empty text."""
    low, high = _PLAUSIBLE_SCATTER_RATIO
    for ratio in ratios:
        if np.isfinite(ratio) and not low < ratio < high:
            return (
                f"far from the star, where the frame is darkest, its pixels scatter {ratio:.2g} "
                f"times as much as ERR says, expected {low:g} to {high:g} times. ERR is probably "
                "in another unit than SCI, a variance, or of other frames; or SCI was multiplied "
                "by a factor; or a crowded field or a nebula leaves no dark part of the frame"
            )
    return ""
