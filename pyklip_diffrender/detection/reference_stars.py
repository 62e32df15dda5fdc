"""Point sources beside reference stars that were fitted together with a target."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray

from pyklip_diffrender.detection.templates import Templates
from pyklip_diffrender.refinement import Refinement

__all__ = ["sources_of_references"]

_log = logging.getLogger(__name__)

_THRESHOLD = 6.0
"""S/N above which a peak is a source. Fainter ones leave less than a fifth of it in the target."""

_WORTH_A_LOOK = 4.5
"""The same for an approximate S/N, in units of its scatter."""

_SAME_ROLL = 1.0
"""Degrees between frames whose sources are at the same pixels."""

_INNER = 0.3
"""Smallest separation, arcsec. Nearer to the star, a source is taken up by the wavefront."""

_STEP = 2
"""Pixels between the positions that are looked at: about lambda/D in the long-wave channel. Between
four of them a source keeps 0.7 of its S/N."""

_BATCH = 320
"""Number of templates that are rendered at a time."""


def sources_of_references(fit: Refinement) -> dict[int, NDArray[np.float64]]:
    """Find the most significant point source beside each reference star of a fit.

    A source beside a reference star leaves a dark spot in the residual of the target, at the same
    pixels of the detector.

    Parameters
    ----------
    fit : Refinement
        Of target and reference stars together.

    Returns
    -------
    dict of int to ndarray, (3,)
        Contrast to its star, and x and y from it in arcsec, by the frame's place in the fit, for
        all frames of the stars that have one.
    """
    stars: dict[str, list[int]] = {}
    for k, frame in enumerate(fit.frames):
        if frame.observation.reference:
            stars.setdefault(frame.observation.target, []).append(k)
    sources = {}
    for star, places in stars.items():
        brightest = _brightest_source(fit, places)
        if brightest is None:
            continue
        contrast, x, y, snr = brightest
        _log.info("%s has a source of S/N %.1f at x, y = %.2f, %.2f arcsec", star, snr, x, y)
        origin = fit.frames[places[0]].observation
        for k in places:
            ((turned_x, turned_y),) = fit.frames[k].observation.turned(np.array([[x, y]]), origin)
            sources[k] = np.array([contrast, turned_x, turned_y])
    return sources


def _brightest_source(
    fit: Refinement, places: list[int]
) -> tuple[float, float, float, float] | None:
    """Contrast, x, y and S/N of the most significant source in frames of one reference star."""
    templates = _templates_of(fit, places)
    away = np.hypot(templates.grid[..., 0], templates.grid[..., 1])
    rows, columns = (each.ravel() for each in np.indices(away.shape))
    chosen = (away.ravel() > _INNER) & (rows % _STEP == 0) & (columns % _STEP == 0)
    rows, columns = rows[chosen], columns[chosen]
    snr = _approximate_snr(fit, places, rows, columns)
    peak = int(snr.argmax())
    if snr[peak] < _WORTH_A_LOOK:
        return None
    # The highest of the neighbouring pixels is nearer to the source.
    near_rows, near_columns = (
        each.ravel()
        for each in np.meshgrid(
            np.clip(rows[peak] + np.arange(-1, 2), 0, away.shape[0] - 1),
            np.clip(columns[peak] + np.arange(-1, 2), 0, away.shape[1] - 1),
        )
    )
    products = fit.star_only.weigh(templates.at_pixels(near_rows, near_columns))
    size = products.numerator / torch.sqrt(products.information.clamp(min=1e-300))
    best = int(size.argmax())
    if size[best] < _THRESHOLD:
        return None
    x, y = templates.grid[near_rows[best], near_columns[best]]
    contrast = float(products.numerator[best] / products.information[best])
    return contrast, float(x), float(y), float(size[best])


def _templates_of(fit: Refinement, places: Sequence[int]) -> Templates:
    """Templates in some frames of a reference star, which takes the part of the target."""
    frames = [
        replace(frame, observation=replace(frame.observation, reference=k not in places))
        for k, frame in enumerate(fit.frames)
    ]
    return Templates(replace(fit, frames=tuple(frames)), frames[places[0]])


def _approximate_snr(
    fit: Refinement, places: Sequence[int], rows: NDArray[np.int64], columns: NDArray[np.int64]
) -> NDArray[np.float64]:
    """S/N of sources at pixels of the first frame of a star, (k,), in units of its scatter.

    With the residual r of all unknowns, p . Sigma^-1 r is exact, and p . C^-1 p takes the place of
    p . Sigma^-1 p, which differs from it by a factor that varies slowly over the field. Dithers
    move the star by a fraction of a pixel, so that templates of the first frame do for all.
    """
    linear, first = fit.star_only, places[0]
    templates = _templates_of(fit, [first])
    cleaned = torch.zeros_like(linear.cleaned[first])
    weight = torch.zeros_like(cleaned)
    for k in places:
        roll = fit.frames[k].observation.roll_from(fit.frames[first].observation)
        if abs(roll) < _SAME_ROLL:
            scale = fit.frames[k].flux / fit.frames[first].flux
            cleaned += scale * linear.frames[k].weight * linear.cleaned[k]
            weight += (scale * linear.frames[k].weight) ** 2
    snr = np.zeros(len(rows))
    for start in range(0, len(rows), _BATCH):
        part = slice(start, start + _BATCH)
        images = templates.at_pixels(rows[part], columns[part])[first].flatten(1).double()
        information = images.square() @ weight.flatten()
        snr[part] = images @ cleaned.flatten() / information.clamp(min=1e-300).sqrt()
    return snr / max(1e-300, 1.4826 * float(np.median(np.abs(snr))))
