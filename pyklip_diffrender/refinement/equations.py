"""Normal equations of all frames about a state of a fit."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.linalg.blas import dsyrk
from torch import Tensor

from pyklip_diffrender.linear.model import (
    LinearFrame,
    pixel_pieces,
    summed_rows,
)
from pyklip_diffrender.linear.response import Reading, ResponseCache
from pyklip_diffrender.refinement.forward import (
    ACCURATE,
    FrameDerivatives,
    Objective,
    State,
    allowance,
)

_SIMILAR_KAPPA_RATIO = 1.5
"""Ratio of model errors above which normal equations precondition poorly."""


@dataclass(frozen=True)
class NormalEquations:
    """Normal equations of a state, for the unknowns minus their starting values."""

    state: State
    kappa: float  # Model error.
    robust: float  # Residual of half weight, standard deviations; inf for least squares.
    curvature: Tensor  # (unknowns, unknowns), J C^-1 J^T, see `Noise`.
    gradient: Tensor  # (unknowns,), g = J C^-1 r with the residual r at the starting values.
    current: Tensor  # (unknowns,), unknowns of the state minus their starting values.
    frames: tuple[LinearFrame, ...]
    derivatives: tuple[FrameDerivatives, ...]
    # Whether curvature and gradient have the present weights of the pixels. If not, only the
    # Jacobians can be used again, and the curvature to precondition.
    has_weights: bool = True

    @property
    def is_exact(self) -> bool:
        """Whether the equations have the derivatives of this state."""
        return all(each.error == 0.0 for each in self.derivatives)

    @property
    def counts_companions(self) -> bool:
        """Whether all companions count in the Jacobians whose light depends on the wavefront."""
        return all(
            torch.equal(each.bright, point.unknowns.bright_sources(point.vector))
            for each, point in zip(self.derivatives, self.state.points, strict=True)
        )

    def is_within(self, error: float) -> bool:
        """Whether the derivatives of all frames are accurate enough."""
        return all(each.error <= max(error, each.allowance) for each in self.derivatives)


_ROWS_AT_A_TIME = 256
"""Rows of a large matrix that are copied at a time."""


def _accumulate(jacobian: Tensor, weight: Tensor, residual: Tensor) -> tuple[Tensor, Tensor]:
    """G G^T and G r of the whitened Jacobian G = jacobian * weight.

    `jacobian` is (rows, pixels), float32; `weight` and the whitened `residual` are (pixels,),
    float64.
    """
    count = len(jacobian)
    gradient = torch.zeros(count, dtype=torch.float64)
    # Only one triangle is computed, in place. BLAS wants columns contiguous, so that its upper
    # triangle is the lower one of a tensor.
    lower = np.zeros((count, count), order="F")
    for piece in pixel_pieces(jacobian.shape[1]):
        white = jacobian[:, piece].double().mul_(weight[piece])
        gradient += white @ residual[piece]
        lower = dsyrk(1.0, white.numpy().T, beta=1.0, c=lower, trans=1, overwrite_c=1)
    return _mirror(torch.from_numpy(lower.T)), gradient


def _mirror(matrix: Tensor) -> Tensor:
    """Copy the lower triangle of a square matrix onto the upper one, in place, block by block."""
    for start in range(0, len(matrix), _ROWS_AT_A_TIME):
        block = slice(start, start + _ROWS_AT_A_TIME)
        corner = matrix[block, block]
        corner.copy_(corner.tril() + corner.tril(-1).T)
        matrix[block, start + _ROWS_AT_A_TIME :] = matrix[start + _ROWS_AT_A_TIME :, block].T
    return matrix


def linearise(
    objective: Objective,
    state: State,
    kappa: float,
    modes: int,
    robust: float,
    derive: Callable[[int], FrameDerivatives],
) -> NormalEquations:
    """Linearise all frames about a state, with its first `modes` modes.

    `derive` gives the derivatives of a frame by its index. A wavefront that drifts between frames
    needs all modes.
    """
    size = state.unknowns.with_modes(modes)
    # S_f distributes the rows of frame f onto the unknowns: the row of a leading mode to the shared
    # mode and to its blocks of drift. With the Jacobians J_f by row and W = diag(w^2),
    #
    #     A = sum_f S_f J_f W_f J_f^T S_f^T - R R^T,    R = sum_f S_f J_f W_f c_f  by pixel,
    #     g = sum_f S_f J_f (C^-1 r)_f + A x0.
    #
    # R R^T is what C^-1 = W - W c c^T W subtracts where frames share a pattern, see `Noise`. A x0
    # takes the residual r of the state to the starting values, where x0 is `current`.
    current = (state.vector - state.unknowns.initial())[:size]
    curvature = torch.zeros(size, size, dtype=torch.float64)
    gradient = torch.zeros(size, dtype=torch.float64)
    frames: list[LinearFrame] = []
    derivatives: list[FrameDerivatives] = []
    noise = objective.errors(state, kappa, robust)
    residuals = objective.residuals(state)
    whitened = noise.inverse(dict(enumerate(residuals)))
    for k in range(len(residuals)):
        residual, weight, common = (
            each.cpu() for each in (residuals[k], noise.weight[k], noise.common[k])
        )
        derived = derive(k)
        derivatives.append(derived)
        rendered = derived.jacobian
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
        lower = curvature.numpy().T
        for rows in summed_rows(frames, size):
            lower = dsyrk(-1.0, rows.double().numpy().T, beta=1.0, c=lower, trans=1, overwrite_c=1)
        curvature = _mirror(torch.from_numpy(lower.T))
    gradient = gradient + curvature @ current
    return NormalEquations(
        state, kappa, robust, curvature, gradient, current, tuple(frames), tuple(derivatives)
    )


class EquationsCache:
    """The last normal equations of a fit, which are its largest arrays."""

    def __init__(self, objective: Objective, responses: ResponseCache) -> None:
        self._objective, self._responses = objective, responses
        # There is only one set of equations, because they are large: they are freed before others
        # are computed. Their Jacobians are used again at the same state, and their curvature
        # preconditions accurate steps from states near it.
        self.last: NormalEquations | None = None
        self._known: list[FrameDerivatives] = []
        self._preconditions = False

    def start_from(self, derivatives: Sequence[FrameDerivatives]) -> None:
        """Begin with derivatives of all frames from another fit."""
        self._known = list(derivatives)

    def about(
        self,
        state: State,
        kappa: float,
        modes: int,
        robust: float,
        allowed: float,
        *,
        final: bool = False,
    ) -> NormalEquations:
        """Linearise about a state, with derivatives whose error is at most `allowed`.

        Nothing is linearised after the equations that are `final`.
        """
        outweighing = 0.0 if final else kappa
        keep = len(state.points) + state.bright_companions(outweighing)
        # Jacobians do not depend on the weights of pixels, so that they stay right at the same
        # state.
        known: list[FrameDerivatives | None] = list(self._known)
        if self.last is not None:
            known = list(self.last.derivatives)
        self.last, self._known = None, []

        def derive(k: int) -> FrameDerivatives:
            forward, point = self._objective.forwards[k], state.points[k]
            enough = max(allowed, allowance(forward))
            if known:
                # The old Jacobian is freed before the new one, which is as large, is computed.
                earlier, known[k] = known[k], None
                if (
                    earlier is not None
                    and earlier.error <= enough
                    and earlier.is_about(point, modes, outweighing)
                ):
                    return earlier.with_companions_of(forward, point)
                del earlier
            # Each response of the last reading is used once, and takes most of the memory.
            reading = Reading(self._responses, enough, keep, is_last=final)
            return FrameDerivatives.at(forward, point, modes, outweighing, reading)

        self.last = linearise(self._objective, state, kappa, modes, robust, derive)
        self._preconditions = True
        return self.last

    def preconditioner(self, state: State, kappa: float, modes: int) -> NormalEquations | None:
        """Return the last equations if they can precondition an accurate step from a state."""
        last = self.last
        if (
            last is not None
            and self._preconditions
            and (last.kappa <= _SIMILAR_KAPPA_RATIO * kappa or not last.has_weights)
            and last.is_within(ACCURATE)
            and len(last.current) == state.unknowns.with_modes(modes)
        ):
            return last
        return None

    def judge(self, preconditions: bool) -> None:
        """Say whether the last equations precondition well."""
        self._preconditions = preconditions

    def forget_weights(self) -> None:
        """Keep the Jacobians of the last equations, but not what follows from their weights."""
        if self.last is not None:
            self.last = replace(self.last, has_weights=False)
