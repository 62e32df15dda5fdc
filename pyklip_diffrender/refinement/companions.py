"""Bright companions in the residual of a fit.

A companion as bright as the speckles of the star biases the fitted wavefront. A companion that
stands out of the residual therefore gets parameters of its own. Faint planets are left to the
detection, which marginalises the wavefront.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter
from scipy.signal import fftconvolve
from torch import Tensor

from pyklip_diffrender.optics.system import OpticalSystem
from pyklip_diffrender.refinement.objective import Objective, State
from pyklip_diffrender.scene.objects import Planet

__all__ = ["bright_companions", "standing_out"]

_INNER = 0.35
"""arcsec; closer to the star, the occulter distorts images and the star's errors dominate."""

_APART = 0.15
"""arcsec, about lambda/D; closer to a known companion, peaks are its own residuals."""


def bright_companions(
    model: OpticalSystem,
    opd: Tensor,
    values: dict[str, Tensor],
    residual: NDArray[np.float64],
    sigma: NDArray[np.float64],
    flux: float,
    *,
    most: int,
    threshold: float,
    known: NDArray[np.float64] | None = None,
) -> list[Planet]:
    """Find point sources that stand out of a residual image.

    Parameters
    ----------
    model : OpticalSystem
    opd : Tensor, (npix, npix)
        m.
    values : dict of Tensor
        The model's other parameters.
    residual : ndarray, (ny, nx)
        Data minus star; 0 where masked.
    sigma : ndarray, (ny, nx)
        Standard deviation of the residual, model error included; inf where masked.
    flux : float
        Flux of the star, which turns amplitudes into contrasts.
    most : int
        Largest number of companions; the most significant are returned.
    threshold : float
        In units of the scatter (median absolute deviation) of the matched-filter map.
    known : ndarray, (k, 2), optional
        Offsets x, y from the star of companions that are part of the model, arcsec.

    Returns
    -------
    list of Planet
        Positions are those of pixels, highest S/N first.
    """
    scale_x, scale_y = model.detector.pixelscale
    ny, nx = residual.shape
    star = values.get("star_offset", torch.zeros(2, dtype=torch.float64)).cpu()
    axis = values.get("detector_shift", torch.zeros(2, dtype=torch.float64)).cpu()
    # The template is an image in the middle of the array of a source beyond the occulter.
    away = torch.tensor([1.5, 0.0], dtype=torch.float64)
    centred = {**values, "star_offset": star + away, "detector_shift": -(star + away)}
    with torch.no_grad():
        template = flux * model(opd, **centred).double().cpu().numpy()
    weight = sigma**-2.0
    numerator = fftconvolve(residual * weight, template[::-1, ::-1], mode="same")
    information = fftconvolve(weight, template[::-1, ::-1] ** 2, mode="same")
    # For an even size the template's centre is half a pixel off the convolution's.
    snr = numerator / np.sqrt(np.maximum(information, 1e-300))
    middle = np.array([(nx - 1) / 2, (ny - 1) / 2])
    y, x = np.indices(residual.shape)
    x_sky = (x - middle[0]) * scale_x - float(axis[0] + star[0])
    y_sky = (y - middle[1]) * scale_y - float(axis[1] + star[1])
    distance = np.hypot(x_sky, y_sky)
    allowed = (distance > _INNER) & np.isfinite(sigma)
    for x_known, y_known in () if known is None else known.tolist():
        allowed &= np.hypot(x_sky - x_known, y_sky - y_known) > _APART
    scatter = 1.4826 * float(np.median(np.abs(snr[allowed] - np.median(snr[allowed]))))
    return [
        Planet.from_offset(
            float(numerator[peak] / information[peak]), float(x_sky[peak]), float(y_sky[peak])
        )
        for peak in local_maxima(snr, allowed, threshold * scatter, size=7)[:most]
    ]


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


def standing_out(
    objective: Objective, state: State, kappa: float, *, most: int, threshold: float
) -> list[Planet]:
    """Find companions in the first science frame; positions refer to the first frame.

    Parameters
    ----------
    objective : Objective
    state : State
    kappa : float
        Assumed error of the star model, as a fraction of the star.
    most, threshold
        See `bright_companions`.
    """
    joint = state.joint
    shown = [unknowns.shows_companions for unknowns in joint.frames]
    if most < 1 or True not in shown:
        return []
    k = shown.index(True)
    point, forward = state.points[k], objective.forwards[k]
    problem = forward.problem
    sigma = objective.sigma(k, point, kappa)
    residual = torch.where(problem.valid, problem.data - point.total, 0.0)
    companions = bright_companions(
        forward.coarse,
        forward.coarse_opd(point),
        point.unknowns.values(point.vector),
        residual.cpu().numpy(),
        torch.where(problem.valid, sigma, math.inf).cpu().numpy(),
        point.unknowns.level("flux", point.vector),
        most=most,
        threshold=threshold,
        known=(point.unknowns.sources(point.vector)[:, 1:] @ point.unknowns.turn.T).numpy(),
    )
    return [planet.rotated(-joint.frames[k].roll) for planet in companions]
