"""Bright companions in what a star model leaves: found so that a fit does not bend to them.

A companion as bright as the star's own speckles pulls the wavefront towards itself. One that
stands out of the residual of the alignment fit is given parameters of its own. This is no search
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

from pyklip_diffrender.optics import OpticalSystem
from pyklip_diffrender.scene import Planet

__all__ = ["bright_companions"]

_INNER = 0.35
"""arcsec; closer in, the occulter distorts and the star's own errors dominate."""


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
