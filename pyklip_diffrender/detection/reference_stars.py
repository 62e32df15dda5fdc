"""Point sources beside reference stars that were fitted together with a target."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from pyklip_diffrender.detection.candidates import Candidates, refine_candidates
from pyklip_diffrender.detection.error_factor import ErrorFactor
from pyklip_diffrender.detection.field import pixel_width
from pyklip_diffrender.detection.templates import Templates
from pyklip_diffrender.refinement import Refinement

__all__ = ["ReferenceSource", "sources_of_references"]

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

_STEPS = 6
"""Largest number of steps of its position."""

_BATCH = 320
"""Number of templates that are rendered at a time."""


class ReferenceSource(NamedTuple):
    """A point source beside a reference star, in one frame.

    Attributes
    ----------
    contrast : float
        To its star.
    offset : tuple of float
        x, y from the star, arcsec.
    light : ndarray, (ny, nx)
        Its image, in the unit of the frame.
    """

    contrast: float
    offset: tuple[float, float]
    light: NDArray[np.float64]


def sources_of_references(fit: Refinement) -> dict[int, ReferenceSource]:
    """Find the most significant point source beside each reference star of a fit.

    A source beside a reference star leaves a dark spot in the residual of the target, at the same
    pixels of the detector.

    Parameters
    ----------
    fit : Refinement
        Of target and reference stars together.

    Returns
    -------
    dict of int to ReferenceSource
        By the frame's place in the fit, for all frames of the stars that have one.
    """
    stars: dict[str, list[int]] = {}
    for k, frame in enumerate(fit.frames):
        if frame.observation.reference:
            stars.setdefault(frame.observation.target, []).append(k)
    sources = {}
    for star, places in stars.items():
        templates = _templates_of(fit, places)
        brightest = _brightest_source(fit, templates, places)
        if brightest is None:
            continue
        contrast, x, y, snr = brightest
        _log.info("%s has a source of S/N %.1f at x, y = %.2f, %.2f arcsec", star, snr, x, y)
        offset = np.array([[x, y]])
        images = templates.at(torch.from_numpy(offset))
        origin = fit.frames[places[0]].observation
        for k in places:
            ((turned_x, turned_y),) = fit.frames[k].observation.turned(offset, origin)
            sources[k] = ReferenceSource(
                contrast, (float(turned_x), float(turned_y)), contrast * images[k][0].numpy()
            )
    return sources


def _brightest_source(
    fit: Refinement, templates: Templates, places: Sequence[int]
) -> tuple[float, float, float, float] | None:
    """Contrast, x, y and S/N of the most significant source in frames of one reference star."""
    away = np.hypot(templates.grid[..., 0], templates.grid[..., 1])
    rows, columns = (each.ravel() for each in np.indices(away.shape))
    chosen = (away.ravel() > _INNER) & (rows % _STEP == 0) & (columns % _STEP == 0)
    rows, columns = rows[chosen], columns[chosen]
    snr = _approximate_snr(fit, places, rows, columns)
    peak = int(snr.argmax())
    if snr[peak] < _WORTH_A_LOOK:
        return None
    # The search steps over pixels, and a source may be between them.
    group, pixel = (fit.star_only, templates), pixel_width(templates.grid)
    row, column = rows[peak : peak + 1], columns[peak : peak + 1]
    products = fit.star_only.weigh(templates.at_pixels(row, column))
    contrast = (products.numerator / products.information).numpy()
    start = Candidates.at(templates.grid[row, column], contrast)
    source = refine_candidates([group], start, _STEP * pixel, _STEPS)
    measured = float(source.snr(ErrorFactor.constant(1.0))[0])
    if measured < _THRESHOLD:
        return None
    x, y = source.offsets[0].tolist()
    return float(source.contrasts[0]), x, y, measured


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
