"""Noise of real frames, measured where there is no starlight.

The errors in the ERR extension of coadded JWST frames may be wrong by up to a factor of two in the
part that does not depend on the light (read noise and background). That part is measured here on
the frame itself, far from the star.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import convolve, uniform_filter
from scipy.stats import median_abs_deviation

__all__ = ["calibrated_errors", "dark_pixels", "weighted_mean", "why_odd_noise"]

_log = logging.getLogger(__name__)

Image = NDArray[np.float64]

_FAR = 6.0
"""arcsec from the star beyond which its light adds no noise. Closer than that a bright star's light
still shows in differences of neighbouring pixels."""

_ENOUGH = 2000
"""Number of far pixels below which the errors are left as they are."""

_PLAUSIBLE = (0.1, 5.0)
"""Ratio of scatter and errors beyond which the errors are not those of these pixels. It was 0.4 to
1.2 in the real frames at hand."""

_SMOOTHED = 15
"""Side of the squares, pixels, whose mean light tells which parts of a frame are dark."""

_BRIGHT = 4.0
"""Standard deviations of these means above their median from which a part is not dark."""

_DARKEST = 0.25
"""Least share of the far pixels that is taken as dark, in a field that is full of sources."""

_NEIGHBOURS = np.array([[0, 1, 0], [1, 0, 1], [0, 1, 0]]) / 4.0


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
    """Correct the part of the errors that does not depend on the light.

    Pixels are compared with the mean of their four neighbours, 6 arcsec or more from the star and
    where the frame is dark, see `dark_pixels`. The
    robust scatter of these differences over what the errors predict is the factor f by which the
    errors there are wrong. Let b be the median of these errors: (f^2 - 1) b^2 is added to the
    variance of every pixel, which leaves the photon noise of the star as it is.

    Parameters
    ----------
    data, error : ndarray, (frames, ny, nx)
        Frames and their standard deviations, in the same unit.
    valid : ndarray of bool, (frames, ny, nx)
    center : ndarray, (frames, 2)
        x, y of the star, 0-indexed pixels.
    pixelscale : tuple of float
        x, y, arcsec per pixel.
    name : str
        For the log.
    out : ndarray, (frames, ny, nx), optional
        For the new errors, in place of a new array; may be `error`.

    Returns
    -------
    errors : ndarray, (frames, ny, nx)
        New standard deviations. Frames with fewer than 2000 usable pixels that far from the star
        keep theirs.
    ratios : tuple of float
        f of every frame; NaN where there are too few pixels.

    Notes
    -----
    Noise that neighbouring pixels share, such as 1/f noise, cancels in the differences and is not
    counted.

    Examples
    --------
    >>> import numpy as np
    >>> noise = np.random.default_rng(1).normal(0.0, 0.5, (1, 300, 300))
    >>> ones = np.ones_like(noise)
    >>> center = np.array([[150, 150]])
    >>> error, (ratio,) = calibrated_errors(noise, ones, ones > 0, center, (0.063, 0.063))
    >>> bool(abs(error.mean() - 0.5) < 0.01), bool(abs(ratio - 0.5) < 0.01)
    (True, True)
    """
    corrected, ratios = error.copy() if out is None else out, []
    for k, (ratio, floor) in enumerate(_measured(data, error, valid, center, pixelscale)):
        ratios.append(ratio)
        if not ratio > 0:
            continue
        sigma = error[k].astype(float)
        least = min(ratio, 1.0) * sigma
        variance = np.maximum(sigma**2 + (ratio**2 - 1) * floor**2, least**2)
        corrected[k] = np.where(valid[k], np.sqrt(variance), sigma)
        _log.info("%s, frame %d: the noise far from the star is %.2f of ERR", name, k, ratio)
    return corrected, tuple(ratios)


def weighted_mean(
    data: Image,
    error: Image,
    valid: NDArray[np.bool_],
    which: Iterable[int] | None = None,
) -> tuple[Image, Image, NDArray[np.bool_]]:
    """Mean of frames, (frames, ny, nx), each weighted by its inverse median variance.

    The errors of single pixels are no weights: they come from the counts of the pixels, so that
    low counts would weigh more, and the mean would be too low. `which` are the indices of the
    frames, by default of all.

    Returns
    -------
    mean, error : ndarray, (ny, nx)
        0 and 1 where no frame is valid.
    valid : ndarray of bool, (ny, nx)

    Examples
    --------
    >>> import numpy as np
    >>> counts = np.random.default_rng(1).poisson(5.0, (400, 10, 10)).astype(float)
    >>> error = np.sqrt(np.maximum(counts, 1.0))
    >>> mean, deviation, _ = weighted_mean(counts, error, counts >= 0)
    >>> bool(abs((mean - 5.0).mean()) < 0.3 * deviation.mean())
    True
    """
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
    """Find the pixels of a frame that show noise, and no other stars, galaxies or nebulae.

    The light is averaged over squares of 15 pixels, so that the noise of a pixel does not decide
    whether it counts. Dark is what is at most four standard deviations above the median of these
    means, or the darkest quarter of a field that is full of sources.

    Parameters
    ----------
    frame : ndarray, (ny, nx)
    usable : ndarray of bool, (ny, nx)
        Pixels that may be chosen.

    Returns
    -------
    ndarray of bool, (ny, nx)

    Examples
    --------
    >>> import numpy as np
    >>> frame = np.random.default_rng(1).normal(size=(60, 60))
    >>> frame[:, :10] += 5.0
    >>> dark = dark_pixels(frame, np.ones((60, 60), dtype=bool))
    >>> bool(dark[:, :10].any()), bool(dark[:, 20:].mean() > 0.98)
    (False, True)
    """
    if not usable.any():
        return usable
    # A single bright pixel is an outlier, and no source.
    median = np.median(frame[usable])
    limit = 5 * median_abs_deviation(frame[usable], scale="normal")
    clipped = np.where(usable, np.clip(frame - median, -limit, limit), 0.0)
    weight = uniform_filter(usable.astype(float), _SMOOTHED, mode="constant")
    smooth = uniform_filter(clipped, _SMOOTHED, mode="constant") / np.maximum(weight, 1e-3)
    values = smooth[usable]
    middle = float(np.median(values))
    below = middle - values[values <= middle]
    # The scatter of the darker half, which sources do not reach.
    spread = float(np.median(below)) / 0.6745
    threshold = max(middle + _BRIGHT * spread, float(np.quantile(values, _DARKEST)))
    return usable & (smooth <= threshold)


def why_odd_noise(ratios: Iterable[float]) -> str:
    """Why errors cannot be those of the pixels; empty if they can.

    Parameters
    ----------
    ratios : iterable of float
        See `calibrated_errors`.
    """
    low, high = _PLAUSIBLE
    for ratio in ratios:
        if np.isfinite(ratio) and not low < ratio < high:
            return (
                f"far from the star, where the frame is darkest, its pixels scatter {ratio:.2g} "
                f"times as much as ERR says, expected {low:g} to {high:g} times. ERR is probably "
                "in another unit than SCI, a variance, or of other frames; or SCI was multiplied "
                "by a factor; or a crowded field or a nebula leaves no dark part of the frame"
            )
    return ""


def _measured(
    data: Image,
    error: Image,
    valid: NDArray[np.bool_],
    center: Image,
    pixelscale: tuple[float, float],
) -> Iterator[tuple[float, float]]:
    """Ratio and median of the errors far from the star, for every frame; NaN if not known."""
    y, x = np.indices(data.shape[1:])
    for k, (frame, sigma, usable) in enumerate(zip(data, error, valid, strict=True)):
        frame, sigma = frame.astype(float), sigma.astype(float)
        away = np.hypot((x - center[k, 0]) * pixelscale[0], (y - center[k, 1]) * pixelscale[1])
        # A pixel is compared only where all of its neighbours are usable.
        complete = convolve(usable.astype(float), _NEIGHBOURS, mode="constant") > 0.99
        far = dark_pixels(frame, usable & complete & (away > _FAR))
        if far.sum() < _ENOUGH:
            yield np.nan, np.nan
            continue
        difference = frame - convolve(frame, _NEIGHBOURS, mode="nearest")
        predicted = np.sqrt(sigma**2 + convolve(sigma**2, _NEIGHBOURS, mode="nearest") / 4)
        ratio = float(median_abs_deviation((difference / predicted)[far], scale="normal"))
        yield ratio, float(np.median(sigma[far]))
