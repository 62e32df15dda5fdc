"""Find which pixels of the detector frames show, from the pattern of the flat field itself.

The detector pixels of frames that were shifted without a record are unknown.
The residual of a fit does: it correlates with the known pattern at only one position.
"""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import fourier_shift

from pyklip_diffrender.pattern.measure import measure_patterns
from pyklip_diffrender.refinement.fit_result import Refinement
from pyklip_diffrender.scene.detector_pixels import shift_frames, shift_variances
from pyklip_diffrender.scene.observation import Observation
from pyklip_diffrender.scene.systematics import Systematics

__all__ = ["place_on_detector"]

_log = logging.getLogger(__name__)

_REACH = 3.0
"""Pixels by which stars behind the same mask may be apart."""

_COARSE, _FINE = 0.25, 0.05
"""Steps of the search, pixels."""

_SIGNIFICANT = 6.0
"""Height of the peak in units of the correlation's scatter elsewhere."""

_SEPARATE = 1.5
"""Distance from the peak beyond which the correlation measures its scatter, pixels."""

_MODEL_ERROR = 0.05
"""Error of the ratio of residual and star that the pattern does not explain."""

_INNER = 0.3
"""Smallest separation used, arcsec. Closer in, the ratio is dominated by errors of the model."""


def place_on_detector(fit: Refinement, pattern: Systematics) -> Observation | None:
    """Move the frames of a fit onto the pixels of the detector that a pattern was measured on.

    Parameters
    ----------
    fit : Refinement
        Of one observation, without a pattern.
    pattern : Systematics
        With `first_pixel`.

    Returns
    -------
    Observation or None
        Shifted by less than a pixel, with `first_pixel`; None if the pattern is not detected.
    """
    frame, (measured,) = fit.frames[0], measure_patterns(fit)
    observation = frame.observation
    if pattern.first_pixel is None:
        return None
    start = np.round(np.subtract(measured.center, pattern.center)).astype(int)
    column, row = np.subtract(pattern.first_pixel, start).tolist()
    expected = pattern.at(replace(observation, first_pixel=(column, row)))[0]
    y, x = np.indices(expected.shape)
    scale_x, scale_y = frame.model.detector.pixelscale
    distance = np.hypot((x - measured.center[0]) * scale_x, (y - measured.center[1]) * scale_y)
    weight = np.where(distance > _INNER, 1 / (measured.variance + _MODEL_ERROR**2), 0.0)
    steps = np.arange(-_REACH, _REACH + _COARSE / 2, _COARSE)
    coarse = _correlation(measured.value, expected, weight, steps, steps)
    row, column = np.unravel_index(int(coarse.argmax()), coarse.shape)
    best = np.array([steps[column], steps[row]])
    elsewhere = np.hypot(*np.meshgrid(steps - best[0], steps - best[1])) > _SEPARATE
    scatter = float(coarse[elsewhere].std())
    _log.info("pattern seen at %s pixels, correlation %.2f, elsewhere %.3f",
              best, coarse.max(), scatter)  # fmt: skip
    if coarse.max() < _SIGNIFICANT * scatter:
        return None
    nearby = np.arange(-_COARSE, _COARSE + _FINE / 2, _FINE)
    fine = _correlation(measured.value, expected, weight, best[0] + nearby, best[1] + nearby)
    row, column = np.unravel_index(int(fine.argmax()), fine.shape)
    moved = start + best + (nearby[column], nearby[row])
    pixels = np.round(moved).astype(int)
    shift = np.broadcast_to(pixels - moved, (len(observation), 2))
    column, row = np.subtract(pattern.first_pixel, pixels).tolist()
    # Masked pixels are filled in, because empty ones would ring into their neighbours.
    valid = observation.valid
    data = shift_frames(np.where(valid, observation.data, frame.star), shift)
    error = np.sqrt(shift_variances(observation.error, valid, shift))
    return replace(
        observation,
        data=np.where(valid, data, 0.0),
        error=np.where(valid, error, 1.0),
        valid=valid,
        center=observation.center + shift,
        first_pixel=(column, row),
    )


def _correlation(
    value: NDArray[np.float64],
    pattern: NDArray[np.float64],
    weight: NDArray[np.float64],
    right: NDArray[np.floating],
    up: NDArray[np.floating],
) -> NDArray[np.float64]:
    """Weighted correlation of a ratio with the pattern shifted, (up, right)."""
    transform = np.fft.fft2(pattern)
    total = weight.sum()
    centred = value - (weight * value).sum() / total
    length = np.sqrt((weight * centred**2).sum())
    correlation = np.empty((len(up), len(right)))
    for row, y in enumerate(up):
        for column, x in enumerate(right):
            moved = np.fft.ifft2(fourier_shift(transform, (y, x))).real
            moved -= (weight * moved).sum() / total
            product = (weight * centred * moved).sum()
            correlation[row, column] = product / (length * np.sqrt((weight * moved**2).sum()))
    return correlation
