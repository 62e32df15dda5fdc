"""Normal equations of all frames about a state of the fit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.linalg.blas import dsyrk
from torch import Tensor

from pyklip_diffrender.linear.frames import LinearFrame, summed_rows
from pyklip_diffrender.refinement.forward import Forward, Point
from pyklip_diffrender.refinement.objective import Objective, State, Weights

__all__ = ["NormalEquations", "curve", "linearise"]


@dataclass(frozen=True)
class NormalEquations:
    """Normal equations of a state, for the unknowns minus their starting values.

    Attributes
    ----------
    state : State
    kappa : float
        Assumed error of the star model, as a fraction of the star.
    robust : float
        Residual, in standard deviations, of half weight; inf for least squares.
    curvature : Tensor, (unknowns, unknowns)
        G G^T, with the whitened Jacobian G; see `linear.model` for frames that share a pattern.
    gradient : Tensor, (unknowns,)
        G r, with the residual r at the starting values.
    current : Tensor, (unknowns,)
        Unknowns of the state minus their starting values.
    frames : tuple of LinearFrame
    """

    state: State
    kappa: float
    robust: float
    curvature: Tensor
    gradient: Tensor
    current: Tensor
    frames: tuple[LinearFrame, ...]


_DIFFERENCE = 0.01
"""Part of a step between the images whose difference is a derivative. Their curvature matters less
than the rounding errors of single precision."""

_PIXELS = 1024
"""Number of pixels whose Jacobian is converted to double precision at a time."""


def _accumulate(jacobian: Tensor, weight: Tensor, residual: Tensor) -> tuple[Tensor, Tensor]:
    """G G^T and G r of the whitened Jacobian G = jacobian * weight.

    Parameters
    ----------
    jacobian : Tensor, (rows, pixels), float32
    weight, residual : Tensor, (pixels,), float64
        The residual is whitened.
    """
    count = len(jacobian)
    gradient = torch.zeros(count, dtype=torch.float64)
    # Only one triangle is computed, in place; LAPACK wants columns contiguous.
    triangle = np.zeros((count, count), order="F")
    for start in range(0, jacobian.shape[1], _PIXELS):
        piece = slice(start, start + _PIXELS)
        white = jacobian[:, piece].double().mul_(weight[piece])
        gradient += white @ residual[piece]
        triangle = dsyrk(1.0, white.numpy().T, beta=1.0, c=triangle, trans=1, overwrite_c=1)
    upper = torch.from_numpy(triangle)
    return upper + upper.triu(1).T, gradient


def linearise(
    objective: Objective,
    state: State,
    kappa: float,
    modes: int,
    robust: float,
    *,
    exact: bool = False,
) -> NormalEquations:
    """Linearise all frames about a state.

    Parameters
    ----------
    objective : Objective
    state : State
    kappa : float
        Assumed error of the star model, as a fraction of the star.
    modes : int
        Number of leading wavefront modes that are free; all of them if the wavefront drifts
        between frames, 0 for the alignment only.
    robust : float
        Residual, in standard deviations, of half weight; inf for least squares.
    exact : bool
        Whether the gradient is that of the model itself and not of its coarse copy, with which the
        curvature is computed; see `Forward.slopes`.
    """
    joint = state.joint
    size = joint.unknowns_with(modes)
    current = (state.vector - joint.initial())[:size]
    curvature = torch.zeros(size, size, dtype=torch.float64)
    gradient = torch.zeros(size, dtype=torch.float64)
    frames = []
    weights = objective.weights(state, kappa, robust)
    residuals = objective.residuals(state)
    whitened = objective.whiten(residuals, weights)
    for k, (forward, point) in enumerate(zip(objective.forwards, state.points, strict=True)):
        residual, weight, common = (each.cpu() for each in (residuals[k], *weights[k]))
        rendered = forward.jacobian(point, modes)
        first = point.unknowns.where("modes").start
        rows = joint.rows(k)[: len(rendered)]
        drift = joint.drift_rows(k) if modes else torch.zeros(0, dtype=torch.int64)
        frames.append(LinearFrame(residual, weight, rendered, rows, drift, first, common))
        product, pulled = _accumulate(
            rendered.flatten(1), weight.flatten(), whitened[k].cpu().flatten()
        )
        if exact and modes:
            _put_slopes(pulled, forward, point, weights[k].weight * whitened[k])
        if len(state.points) == 1:
            curvature, gradient = product, pulled
            continue
        leading = slice(first, first + len(drift))
        for to, which in ((rows, slice(None)), (drift, leading)):
            gradient.index_add_(0, to, pulled[which])
            for onto, selection in ((rows, slice(None)), (drift, leading)):
                curvature[to[:, None], onto] += product[which, selection]
    if objective.shares_pattern:
        rows = summed_rows(frames, size)
        ones = torch.ones(rows.shape[1], dtype=torch.float64)
        curvature -= _accumulate(rows, ones, ones)[0]
    gradient = gradient + curvature @ current
    return NormalEquations(state, kappa, robust, curvature, gradient, current, tuple(frames))


def curve(
    objective: Objective, equations: NormalEquations, weights: Sequence[Weights], step: Tensor
) -> Tensor:
    """Product of the curvature with a step, by derivatives of the model itself.

    The curvature of the equations is that of a coarse copy, whose derivatives are those of another
    point. Where the effects of several unknowns cancel, it may be wrong by an order of magnitude.

    Parameters
    ----------
    objective : Objective
    equations : NormalEquations
    weights : sequence of Weights
        Of the equations.
    step : Tensor, (unknowns,)

    Returns
    -------
    Tensor, (unknowns,)
    """
    state = equations.state
    moved = state.vector.clone()
    moved[: len(step)] += _DIFFERENCE * step
    images = [
        (ahead.total - point.total) / _DIFFERENCE
        for ahead, point in zip(objective.at(state.joint, moved).points, state.points, strict=True)
    ]
    total = torch.zeros_like(step)
    whitened = objective.whiten(images, weights)
    for k, (forward, point) in enumerate(zip(objective.forwards, state.points, strict=True)):
        frame = equations.frames[k]
        pixels = weights[k].weight * whitened[k]
        on_rows = (frame.jacobian.flatten(1) @ pixels.cpu().flatten().float()).double()
        _put_slopes(on_rows, forward, point, pixels)
        total += frame.onto_unknowns(on_rows, len(step))
    return total


def _put_slopes(on_rows: Tensor, forward: Forward, point: Point, pixels: Tensor) -> None:
    """Replace derivatives by the optical parameters and the wavefront by accurate ones."""
    for name, slope in forward.slopes(point, pixels).items():
        places = point.unknowns.where(name)
        on_rows[places] = slope[: len(on_rows[places])]
