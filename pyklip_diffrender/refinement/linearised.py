"""Normal equations of all frames about a state of the fit."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from scipy.linalg.blas import dsyrk
from torch import Tensor

from pyklip_diffrender.linear.model import LinearFrame
from pyklip_diffrender.refinement.misfit import Misfit, State

__all__ = ["Linearised", "linearise"]


@dataclass(frozen=True)
class Linearised:
    """A state's normal equations, for the unknowns as distances from their starts.

    Attributes
    ----------
    state : State
    kappa : float
    curvature : Tensor
        G G^T.
    gradient : Tensor
        G r at the unknowns' starts.
    current : Tensor
        Where they are now.
    frames : tuple of LinearFrame
    """

    state: State
    kappa: float
    curvature: Tensor
    gradient: Tensor
    current: Tensor
    frames: tuple[LinearFrame, ...]


def _self_product(rows: Tensor) -> Tensor:
    """``rows @ rows.T`` at half the cost: only one triangle is computed, then mirrored."""
    upper = torch.from_numpy(dsyrk(1.0, rows.numpy().T, trans=1))
    return upper + upper.triu(1).T


def linearise(misfit: Misfit, state: State, kappa: float, modes: int) -> Linearised:
    """Normal equations about a state.

    Parameters
    ----------
    misfit : Misfit
    state : State
    kappa : float
        Share of the star that the model may miss.
    modes : int
        How many of the wavefront's modes are free, the first ones: all, or fewer where frames do
        not drift apart; 0 for none and no amplitude.
    """
    joint = state.joint
    size = joint.unknowns_with(modes)
    current = (state.vector - joint.initial())[:size]
    curvature = torch.zeros(size, size, dtype=torch.float64)
    gradient = torch.zeros(size, dtype=torch.float64)
    frames = []
    for k, (forward, point) in enumerate(zip(misfit.forwards, state.points, strict=True)):
        residual, weight = misfit.weighted(k, point, kappa)
        rendered = forward.jacobian(point, modes)
        first = point.unknowns.where("modes").start
        rows = joint.rows(k)[: len(rendered)]
        drift = joint.drift_rows(k) if modes else torch.zeros(0, dtype=torch.int64)
        left = torch.where(weight > 0, residual / weight.clamp(min=1e-300), 0.0).cpu()
        slopes = rendered.float().cpu()
        frames.append(LinearFrame(left, weight.cpu(), slopes, rows, drift, first))
        whitened = rendered.mul_(weight).flatten(1).cpu()
        pulled = whitened @ residual.flatten().cpu()
        product = _self_product(whitened)
        if len(state.points) == 1:
            curvature, gradient = product, pulled
            continue
        own = slice(first, first + len(drift))
        for to, which in ((rows, slice(None)), (drift, own)):
            gradient.index_add_(0, to, pulled[which])
            for onto, other in ((rows, slice(None)), (drift, own)):
                curvature[to[:, None], onto] += product[which, other]
    gradient = gradient + curvature @ current
    return Linearised(state, kappa, curvature, gradient, current, tuple(frames))
