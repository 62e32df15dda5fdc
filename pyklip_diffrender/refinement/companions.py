"""Bright companions in what a star model leaves: found so that a fit does not bend to them.

A companion as bright as the star's own speckles pulls the wavefront towards itself. One that
stands out of the residual of a fit is given parameters of its own. This is no search
for planets: faint ones are the business of the detection step, where the wavefront is
marginalised.
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
"""arcsec; closer in, the occulter distorts and the star's own errors dominate."""

_APART = 0.15
"""arcsec, about lambda/D; nearer to a known companion, what stands out is what is left of it."""


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
        Its standard deviation, model error included; inf where masked.
    flux : float
        The star's light, so that amplitudes are contrasts.
    most : int
        How many at most, brightest first.
    threshold : float
        In units of the scatter (median absolute deviation) of the matched-filter map.
    known : ndarray, (k, 2), optional
        Offsets x, y from the star of companions that are in the model already, arcsec.

    Returns
    -------
    list of Planet
        To the nearest pixel; relative to the star.
    """
    scale_x, scale_y = model.detector.pixelscale
    ny, nx = residual.shape
    star = values.get("star_offset", torch.zeros(2, dtype=torch.float64)).cpu()
    axis = values.get("detector_shift", torch.zeros(2, dtype=torch.float64)).cpu()
    # The off-axis image in the middle of the array: half-way out, where the occulter is clear.
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
    peaks = (snr == maximum_filter(snr, size=7)) & allowed & (snr > threshold * scatter)
    order = np.argsort(-snr[peaks])[:most]
    found = []
    for row, column in np.argwhere(peaks)[order]:
        contrast = numerator[row, column] / information[row, column]
        found.append(
            Planet(
                float(contrast),
                float(distance[row, column]),
                math.degrees(math.atan2(-x_sky[row, column], y_sky[row, column])),
            )
        )
    return found


def standing_out(
    misfit: Objective, state: State, kappa: float, *, most: int, threshold: float
) -> list[Planet]:
    """Companions that stand out of the first science frame, as they stand in the first frame.

    Parameters
    ----------
    misfit : Objective
    state : State
    kappa : float
        Share of the star that the model may miss.
    most, threshold
        See `bright_companions`.
    """
    joint = state.joint
    shown = [unknowns.shows_companions for unknowns in joint.frames]
    if most < 1 or True not in shown:
        return []
    k = shown.index(True)
    point, forward = state.points[k], misfit.forwards[k]
    problem = forward.problem
    sigma = misfit.sigma(k, point, kappa)
    residual = torch.where(problem.valid, problem.data - point.total, 0.0)
    found = bright_companions(
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
    turn = joint.frames[k].roll
    return [Planet(p.contrast, p.separation, p.position_angle - turn) for p in found]
