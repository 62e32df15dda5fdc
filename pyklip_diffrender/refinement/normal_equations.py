"""Normal equations of all frames about a state of the fit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.linalg.blas import dsyrk
from torch import Tensor

from pyklip_diffrender.linear.frames import LinearFrame, pixel_pieces
from pyklip_diffrender.linear.noise import summed_rows
from pyklip_diffrender.linear.response_cache import Reading
from pyklip_diffrender.refinement.objective import Objective, State

__all__ = ["NormalEquations", "linearise"]


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
        J C^-1 J^T, with the Jacobian J and the covariance C of the noise, see `linear.noise`.
    gradient : Tensor, (unknowns,)
        J C^-1 r, with the residual r at the starting values.
    current : Tensor, (unknowns,)
        Unknowns of the state minus their starting values.
    frames : tuple of LinearFrame
    bright_companions : int
        Number of companions, over all frames, that count in the Jacobians.
    error : float
        Largest error of the derivatives, as that of a `Reading`.
    has_weights : bool
        Whether curvature and gradient have the present weights of the pixels. If not, only the
        Jacobians can be used again, and the curvature to precondition.
    """

    state: State
    kappa: float
    robust: float
    curvature: Tensor
    gradient: Tensor
    current: Tensor
    frames: tuple[LinearFrame, ...]
    bright_companions: int
    error: float = 0.0
    has_weights: bool = True


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
    for piece in pixel_pieces(jacobian.shape[1]):
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
    jacobians: Sequence[Tensor] = (),
    outweighing: float = 0.0,
    reading: Reading | None = None,
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
    jacobians : sequence of Tensor, optional
        Jacobians of all frames at this state, if they are known.
    outweighing : float
        Error of the star model, as a fraction of the star, that decides which companions count in
        the Jacobians, see `brightest`.
    reading : Reading, optional
        Takes the derivatives of the field, where the Jacobians are not known.
    """
    size = state.unknowns.with_modes(modes)
    current = (state.vector - state.unknowns.initial())[:size]
    curvature = torch.zeros(size, size, dtype=torch.float64)
    gradient = torch.zeros(size, dtype=torch.float64)
    frames = []
    noise = objective.errors(state, kappa, robust)
    residuals = objective.residuals(state)
    whitened = noise.inverse(dict(enumerate(residuals)))
    for k, (forward, point) in enumerate(zip(objective.forwards, state.points, strict=True)):
        residual, weight, common = (
            each.cpu() for each in (residuals[k], noise.weight[k], noise.common[k])
        )
        rendered = (
            jacobians[k] if jacobians else forward.jacobian(point, modes, outweighing, reading)
        )
        part = state.unknowns.rows[k]
        rows, first = part.rows[: len(rendered)], part.first_mode
        drift = part.drift if modes else part.drift[:, :0]
        frames.append(LinearFrame(rows, drift, first, residual, weight, rendered, common))
        product, pulled = _accumulate(
            rendered.flatten(1), weight.flatten(), whitened[k].cpu().flatten()
        )
        if len(state.points) == 1:
            curvature, gradient = product, pulled
            continue
        leading = slice(first, first + drift.shape[1])
        parts = [(rows, slice(None)), *((block, leading) for block in drift)]
        for to, which in parts:
            gradient.index_add_(0, to, pulled[which])
            for onto, selection in parts:
                curvature[to[:, None], onto] += product[which, selection]
    if noise.shares_pattern:
        rows = summed_rows(frames, size)
        ones = torch.ones(rows.shape[1], dtype=torch.float64)
        curvature -= _accumulate(rows, ones, ones)[0]
    gradient = gradient + curvature @ current
    return NormalEquations(
        state, kappa, robust, curvature, gradient, current, tuple(frames),
        state.bright_companions(outweighing), 0.0 if reading is None else reading.farthest,
    )  # fmt: skip
