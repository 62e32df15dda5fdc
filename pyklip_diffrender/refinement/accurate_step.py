"""Gauss-Newton steps with derivatives of the model itself, by conjugate gradients.

Normal equations of a coarse copy of the model are wrong where the effects of several unknowns
cancel, and steps along such directions are too long. Products of the model's own curvature with a
vector take as long as three images. The coarse copy's equations precondition them, and may be those
of an earlier step.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import torch
from torch import Tensor

from pyklip_diffrender.linear.noise import Noise
from pyklip_diffrender.refinement.objective import Objective, State

__all__ = ["ModelDerivatives", "accurate_step", "conjugate_gradients"]

_ITERATIONS = 6
_SUFFICIENT = 0.05

_ROUNDING = 1e-12
"""Relative error of the curvature's elements."""

_DIFFERENCE = 0.01
"""Part of a step between the images whose difference is a derivative. Their curvature matters less
than the rounding errors of single precision."""


class ModelDerivatives:
    """Gradient and curvature of chi-squared, by derivatives of the model itself.

    Parameters
    ----------
    objective : Objective
    state : State
    noise : Noise
        Of all frames.
    """

    def __init__(self, objective: Objective, state: State, noise: Noise) -> None:
        self._objective, self._state, self._noise = objective, state, noise
        self._levels = [
            forward.levels(point, point.unknowns.visible_sources(point.vector)).double()
            for forward, point in zip(objective.forwards, state.points, strict=True)
        ]

    def gradient(self) -> Tensor:
        """Minus half the derivative of chi-squared, (unknowns,)."""
        return self._pull(dict(enumerate(self._objective.residuals(self._state))))

    def product(self, step: Tensor) -> Tensor:
        """Product of the curvature with a step, (unknowns,)."""
        state = self._state
        ahead = self._objective.at(state.unknowns, state.vector + _DIFFERENCE * step)
        images = {
            k: (after.total - before.total) / _DIFFERENCE
            for k, (after, before) in enumerate(zip(ahead.points, state.points, strict=True))
        }
        return self._pull(images)

    def _pull(self, images: Mapping[int, Tensor]) -> Tensor:
        """Product of the whitened Jacobian with images of all frames, which it whitens as well."""
        objective, unknowns = self._objective, self._state.unknowns
        total = torch.zeros(unknowns.size, dtype=torch.float64)
        whitened = self._noise.inverse(images)
        for k, (forward, point) in enumerate(
            zip(objective.forwards, self._state.points, strict=True)
        ):
            pixels = self._noise.weight[k] * whitened[k]
            where, levels = point.unknowns.slices, self._levels[k]
            of_frame = torch.zeros(len(point.vector), dtype=torch.float64)
            last = where["companions"].stop
            of_frame[last - len(levels) : last] = levels.flatten(1) @ pixels.cpu().flatten()
            for name, slopes in forward.slopes(point, pixels).items():
                of_frame[where[name]] = slopes
            total += unknowns.rows[k].onto_unknowns(of_frame, unknowns.size)
        return total


def accurate_step(
    derivatives: ModelDerivatives,
    curvature: Tensor,
    offset: Tensor,
    deviation: Tensor,
    enough: float,
    *,
    iterations: int = _ITERATIONS,
    sufficient: float = _SUFFICIENT,
) -> tuple[Tensor, bool]:
    """Compute the step to the minimum of the linearised penalised chi-squared.

    Parameters
    ----------
    derivatives : ModelDerivatives
    curvature : Tensor, (some, some)
        Approximate curvature by the leading unknowns, the only ones that the step changes.
    offset : Tensor, (unknowns,)
        Unknowns of the state minus the means of their priors.
    deviation : Tensor, (unknowns,)
        Prior standard deviations.
    enough : float
        Decrease of the penalised chi-squared that does not matter.
    iterations, sufficient
        See `conjugate_gradients`.

    Returns
    -------
    step : Tensor, (unknowns,)
    settled : bool
        Whether another iteration would hardly have lowered chi-squared.
    """
    count = len(curvature)
    precision = deviation[:count] ** -2
    # Unknowns differ by many powers of ten, so the system is solved in scaled units.
    unit = (curvature.diagonal() + precision).clamp(min=1e-300) ** -0.5
    system = (curvature * unit[:, None]).mul_(unit)
    system.diagonal().mul_(1 + _ROUNDING).add_(precision * unit**2)
    factor = torch.linalg.cholesky(system)
    step = torch.zeros_like(offset)

    def product(scaled: Tensor) -> Tensor:
        step[:count] = unit * scaled
        return unit * (derivatives.product(step)[:count] + precision * step[:count])

    def precondition(scaled: Tensor) -> Tensor:
        return torch.cholesky_solve(scaled[:, None], factor)[:, 0]

    gradient = derivatives.gradient()[:count] - precision * offset[:count]
    scaled, settled = conjugate_gradients(
        product, precondition, unit * gradient, enough, iterations, sufficient
    )
    step[:count] = unit * scaled
    return step, settled


def conjugate_gradients(
    product: Callable[[Tensor], Tensor],
    precondition: Callable[[Tensor], Tensor],
    gradient: Tensor,
    enough: float = 0.0,
    iterations: int = _ITERATIONS,
    sufficient: float = _SUFFICIENT,
) -> tuple[Tensor, bool]:
    """Minimise x A x - 2 g x approximately.

    Every iteration lowers it, however poor the preconditioner is; a few are sufficient where that
    is wrong in a few directions only. SciPy's `cg` ends by the size of the gradient, which says
    little where unknowns are nearly degenerate.

    Parameters
    ----------
    product : callable
        A x, with a positive definite matrix A.
    precondition : callable
        B^-1 x, with an approximation B to A.
    gradient : Tensor, (n,)
        g.
    enough : float
        Decrease below which that of one iteration is the last.
    iterations : int
        Largest number of iterations.
    sufficient : float
        Part of the whole decrease below which that of one iteration is the last.

    Returns
    -------
    x : Tensor, (n,)
    settled : bool
        Whether another iteration would hardly have lowered it.

    Examples
    --------
    >>> import torch
    >>> from pyklip_diffrender.refinement.accurate_step import conjugate_gradients
    >>> matrix = torch.tensor([[2.0, 1.0], [1.0, 3.0]])
    >>> conjugate_gradients(lambda x: matrix @ x, lambda x: x, torch.tensor([3.0, 4.0]))
    (tensor([1.0000, 1.0000]), True)
    """
    x = torch.zeros_like(gradient)
    remaining = gradient.clone()
    direction = precondition(remaining)
    power, total = float(remaining @ direction), 0.0
    for _ in range(iterations):
        if power <= 0:
            return x, True
        # What the preconditioner expects does not tell the decrease. Errors of its Jacobian count
        # as curvature along a direction in which the effects of unknowns cancel.
        pulled = product(direction)
        curvature = float(direction @ pulled)
        if curvature <= 0:  # By rounding errors.
            return x, True
        x += power / curvature * direction
        remaining -= power / curvature * pulled
        decrease = power**2 / curvature
        total += decrease
        if decrease < max(sufficient * total, enough):
            return x, True
        ahead = precondition(remaining)
        power, before = float(remaining @ ahead), power
        direction = ahead + power / before * direction
    return x, False
