"""Measurements in the linear models of refined frames: point sources, extended ones, residuals."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from astropy import units as u
from astropy.table import QTable
from numpy.typing import ArrayLike

from pyklip_diffrender.detection.calibration import calibration_errors
from pyklip_diffrender.detection.candidates import Candidates
from pyklip_diffrender.detection.error_factor import ErrorFactor
from pyklip_diffrender.detection.field import Image, require_inside
from pyklip_diffrender.detection.groups import Group, has_only_reference_stars, weigh
from pyklip_diffrender.detection.relinearise import without_light
from pyklip_diffrender.errors import ShapeError
from pyklip_diffrender.io.units import to_arcsec
from pyklip_diffrender.linear.model import LinearModel
from pyklip_diffrender.refinement import FrameFit, Refinement

__all__ = ["contrasts_at", "measured_shape", "subtracted_frames"]

_ROUNDS = 5
"""Largest number of refinements of the star for a bright extended source."""

_SETTLED = 0.2
"""The refinements end when its amplitude changes by less than this many standard deviations."""


def contrasts_at(
    groups: Sequence[Group], offsets: ArrayLike, factor: ErrorFactor
) -> tuple[QTable, Image]:
    """Contrasts of point sources at known positions, one at a time; see `Detection.measure`.

    All errors are multiplied by the factor of their position.

    Returns
    -------
    table : QTable
        x, y, contrast, contrast_error, snr.
    calibration : ndarray, (2, k)
        See `calibration.calibration_errors`.
    """
    places = torch.from_numpy(np.atleast_2d(to_arcsec(offsets, "offsets")))
    if places.ndim != 2 or places.shape[1] != 2:
        raise ShapeError(f"offsets: got shape {tuple(places.shape)}, expected (k, 2)")
    require_inside(places.numpy(), groups[0][1].grid)
    products = weigh(groups, lambda templates: templates.at(places))
    factors = factor.of(places)
    error = factors / products.information.sqrt().numpy()
    contrast = (products.numerator / products.information).numpy()
    snr = contrast / error
    calibration = calibration_errors(
        groups, places, torch.from_numpy(snr), torch.from_numpy(factors)
    ).numpy()
    table = QTable(
        {
            "x": places[:, 0].numpy() * u.arcsec,
            "y": places[:, 1].numpy() * u.arcsec,
            "contrast": contrast,
            "contrast_error": np.hypot(error, contrast * calibration[0]),
            "snr": snr,
        }
    )
    return table, calibration


def measured_shape(
    fits: Sequence[Refinement],
    groups: Sequence[Group],
    image: ArrayLike,
    scatter: float,
    relinearise: float,
) -> tuple[float, float]:
    """Amplitude of an extended source and its error; see `Detection.measure_shape`."""
    light = np.ascontiguousarray(image, dtype=float)
    expected = groups[0][1].grid.shape[:2]
    if light.shape != expected:
        raise ShapeError(f"image: got {light.shape}, expected {expected}")
    shape = torch.from_numpy(light)
    amplitude, error = _amplitude(groups[0][0], shape)
    total, bright = amplitude, amplitude > relinearise * error
    single_frame = len(fits) == 1 and len(fits[0].frames) == 1
    factor = scatter
    for _ in range(_ROUNDS if bright and single_frame else 0):
        fit = without_light(fits[0], {0: total * light})
        amplitude, error = _amplitude(fit.star_only, shape)
        total += amplitude
        factor = 1.0 if fit.status.calibrated else scatter
        if abs(amplitude) < _SETTLED * error:
            break
    return total, factor * error


def _amplitude(linear: LinearModel, shape: torch.Tensor) -> tuple[float, float]:
    """Amplitude of an image in the first frame, and its standard deviation."""
    products = linear.weigh({0: shape[None]})
    information = float(products.information[0])
    return float(products.numerator[0]) / information, information**-0.5


def subtracted_frames(
    fits: Sequence[Refinement], groups: Sequence[Group], candidates: Candidates
) -> tuple[Image, ...]:
    """Star-subtracted frames of all fits; see `Detection.subtracted`."""
    images: list[Image] = []
    remaining = iter(groups)
    for fit in fits:
        if has_only_reference_stars(fit):
            images += [_residual(frame) for frame in fit.frames]
            continue
        linear, templates = next(remaining)
        light = candidates.light(templates)
        # Candidates are removed before the star is estimated, and added again afterwards.
        cleaned = linear.clean(light) if light else {}
        for k, frame in enumerate(linear.frames):
            residual = linear.cleaned[k]
            if cleaned:
                residual = residual - cleaned[k][0]
            image = residual / frame.weight + light.get(k, torch.zeros(1))[0]
            images.append(torch.where(frame.weight > 0, image, torch.nan).numpy())
    return tuple(images)


def _residual(frame: FrameFit) -> Image:
    """Residual of a frame of a reference star that was fitted without the target."""
    combined = frame.observation.combined()
    return np.where(combined.valid[0], combined.data[0] - frame.star, np.nan)
