"""Bright companions in the residual of a fit.

A companion as bright as the speckles of the star biases the fitted wavefront. A companion that
is significant in the residual therefore gets its own parameters. Faint planets are found by the
detection, which marginalises the wavefront.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter
from scipy.signal import fftconvolve

from pyklip_diffrender.refinement.objective import Objective, State
from pyklip_diffrender.scene.objects import Planet

__all__ = ["bright_companions", "local_maxima", "with_dominant"]

_INNER = 0.35
"""arcsec; closer to the star, the occulter distorts images and the star's errors dominate."""

_APART = 0.15
"""arcsec, about lambda/D; closer to a known companion, peaks are its own residuals."""


def bright_companions(
    objective: Objective, state: State, kappa: float, *, most: int, threshold: float
) -> list[Planet]:
    """Find point sources in the residual of the first frame that is not of a reference star.

    Parameters
    ----------
    objective : Objective
    state : State
    kappa : float
        Assumed error of the star model, as a fraction of the star.
    most : int
        Largest number of companions.
    threshold : float
        Smallest S/N, in units of the scatter (median absolute deviation) of the S/N map.

    Returns
    -------
    list of Planet
        Highest S/N first, at the positions of pixels, in the orientation of the first frame.
    """
    has_companions = [each.shows_companions for each in state.unknowns.frames]
    if most < 1 or True not in has_companions:
        return []
    k = has_companions.index(True)
    point, forward = state.points[k], objective.forwards[k]
    unknowns, problem, model = point.unknowns, forward.problem, forward.coarse
    residual = torch.where(problem.valid, problem.data - point.total, 0.0).cpu().numpy()
    sigma = torch.where(problem.valid, objective.sigma(k, point, kappa), math.inf).cpu().numpy()
    values = unknowns.values(point.vector)
    star = values.get("star_offset", torch.zeros(2, dtype=torch.float64)).cpu()
    axis = values.get("detector_shift", torch.zeros(2, dtype=torch.float64)).cpu()
    # The template is an image in the middle of the array of a source beyond the occulter.
    displacement = torch.tensor([1.5, 0.0], dtype=torch.float64)
    centred = {
        **values,
        "star_offset": star + displacement,
        "detector_shift": -(star + displacement),
    }
    with torch.no_grad():
        image = model(forward.coarse_opd(point), **centred).double().cpu().numpy()
    template = unknowns.level("flux", point.vector) * image[::-1, ::-1]
    weight = sigma**-2.0
    numerator = fftconvolve(residual * weight, template, mode="same")
    information = fftconvolve(weight, template**2, mode="same")
    snr = numerator / np.sqrt(np.maximum(information, 1e-300))
    x, y = (
        (index - (count - 1) / 2) * scale - float(shift)
        for index, count, scale, shift in zip(
            np.indices(residual.shape)[::-1],
            residual.shape[::-1],
            model.detector.pixelscale,
            axis + star,
            strict=True,
        )
    )
    allowed = (np.hypot(x, y) > _INNER) & np.isfinite(sigma)
    positions = unknowns.sources(point.vector)[:, 1:] @ unknowns.turn.T
    for x_known, y_known in positions.tolist():
        allowed &= np.hypot(x - x_known, y - y_known) > _APART
    scatter = 1.4826 * float(np.median(np.abs(snr[allowed] - np.median(snr[allowed]))))
    return [
        Planet.from_offset(
            float(numerator[peak] / information[peak]), float(x[peak]), float(y[peak])
        ).rotated(-unknowns.roll)
        for peak in local_maxima(snr, allowed, threshold * scatter, size=7)[:most]
    ]


def with_dominant(objective: Objective, state: State, kappa: float) -> State:
    """Add the most significant companion, with levels that follow from star and companion together.

    Parameters
    ----------
    objective : Objective
    state : State
        Whose companion may outshine what the mask leaves of the star, so that its levels are wrong.
    kappa : float
        See `bright_companions`.
    """
    added = bright_companions(objective, state, kappa, most=1, threshold=0.0)
    if not added or state.flux <= 0:
        return state
    unknowns, vector = state.unknowns.with_companions(added, state.vector)
    points = objective.at(unknowns, vector).points
    problems = [forward.problem for forward in objective.forwards]
    stars = [problem.gain * point.image for problem, point in zip(problems, points, strict=True)]
    companions = [
        (point.total - before.total)
        / (before.unknowns.level("flux", before.vector) * added[0].contrast)
        for point, before in zip(points, state.points, strict=True)
    ]
    k = [each.shows_companions for each in unknowns.frames].index(True)
    valid = problems[k].valid
    columns = torch.stack([stars[k], companions[k], torch.ones_like(stars[k])])[:, valid]
    flux, light, _ = torch.linalg.lstsq(columns.T, problems[k].data[valid]).solution.tolist()
    if min(flux, light) <= 0:
        return state
    vector = vector.clone()
    vector[unknowns.where("companions")][-3] = light / flux
    for frame, part, problem, star, companion in zip(
        unknowns.frames, unknowns.rows, problems, stars, companions, strict=True
    ):
        free = set(frame.linear) - set(frame.deviations)
        names = tuple(name for name in ("flux", "background") if name in free)
        flat = torch.full_like(problem.sigma, float(problem.sigma.median()))
        levels = problem.flux_and_background(star + light / flux * companion, flat, names)
        for name, level in zip(("flux", "background"), levels, strict=True):
            if name in names:
                vector[part.rows[frame.where(name)]] = level
    return objective.at(unknowns, vector)


def local_maxima(
    image: NDArray[np.float64], allowed: NDArray[np.bool_], threshold: float, *, size: int
) -> list[tuple[int, int]]:
    """Find pixels above a threshold that are the maximum of the square around them.

    Parameters
    ----------
    image : ndarray, (ny, nx)
        NaN where unknown.
    allowed : ndarray of bool, (ny, nx)
        Where maxima are accepted.
    threshold : float
    size : int
        Side of the square, pixels.

    Returns
    -------
    list of (row, column)
        Highest first.
    """
    filled = np.where(np.isnan(image), -math.inf, image)
    peaks = (filled == maximum_filter(filled, size=size)) & allowed & (filled > threshold)
    places = np.argwhere(peaks)[np.argsort(-filled[peaks], kind="stable")]
    return [(int(row), int(column)) for row, column in places]
