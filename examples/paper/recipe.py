"""The recipe of Feng et al. 2025, section IV: Adam on every pixel of the OPD map."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

import pyklip_diffrender as dr

__all__ = ["AdamFit", "adam_recipe"]

Image = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class AdamFit:
    """Result of the recipe.

    Attributes
    ----------
    wavefront : ndarray, (npix, npix)
        The map of the iterate with the lowest loss, m.
    star : ndarray, (ny, nx)
        Star and background of this map, in the unit of the observation.
    residual : ndarray, (ny, nx)
        Data minus `star`; NaN where the data are masked.
    losses : tuple of float
        Mean absolute error over the valid pixels before each step.
    """

    wavefront: Image
    star: Image
    residual: Image
    losses: tuple[float, ...]


def adam_recipe(
    model: dr.OpticalSystem,
    observation: dr.Observation,
    opd: Image,
    *,
    flux: float,
    background: float = 0.0,
    steps: int = 1000,
    learning_rate: float = 1e-11,
    **values: float | tuple[float, ...],
) -> AdamFit:
    """Minimise the mean absolute error of the star over the pixels of the OPD map.

    Parameters
    ----------
    model : OpticalSystem
    observation : Observation
        Its frames are averaged.
    opd : ndarray
        Map to start from, m; on the model's grid.
    flux, background : float
        Light of the star that the pupil collects, and light per pixel, both held.
    steps : int
    learning_rate : float
        m.
    **values
        Other parameters of the model, such as ``star_offset``, held as well.
    """
    frame = observation.combined()
    data, valid = torch.from_numpy(frame.data[0]), torch.from_numpy(frame.valid[0])
    map_ = torch.from_numpy(opd).to(model.dtype).clone().requires_grad_()
    optimiser = torch.optim.Adam([map_], lr=learning_rate)
    losses: list[float] = []
    best_loss, best = math.inf, map_.detach().clone()
    for _ in range(steps):
        optimiser.zero_grad()
        star = flux * model(map_, **values) + background
        loss = (star - data)[valid].abs().mean()
        loss.backward()
        losses.append(float(loss.detach()))
        if losses[-1] < best_loss:
            best_loss, best = losses[-1], map_.detach().clone()
        optimiser.step()
    with torch.no_grad():
        fitted = (flux * model(best, **values).double() + background).numpy()
    residual = np.where(frame.valid[0], frame.data[0] - fitted, np.nan)
    return AdamFit(best.double().numpy(), fitted, residual, tuple(losses))
