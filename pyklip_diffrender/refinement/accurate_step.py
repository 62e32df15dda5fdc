"""Gauss-Newton steps with derivatives of the model itself, by conjugate gradients.

Normal equations of a coarse copy of the model are wrong where the effects of several unknowns
cancel, and steps along such directions are too long. Products of the model's own curvature with a
vector take as long as three images. The coarse copy's equations precondition them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from pyklip_diffrender.refinement.normal_equations import NormalEquations, curve
from pyklip_diffrender.refinement.objective import Objective, Weights

__all__ = ["accurate_step", "conjugate_gradients"]

_ITERATIONS = 6
_SUFFICIENT = 0.05
"""Part of the whole decrease below which that of one iteration is the last."""

_ROUNDING = 1e-12
"""Relative error of the curvature's elements."""


def accurate_step(
    objective: Objective,
    equations: NormalEquations,
    weights: Sequence[Weights],
    deviation: Tensor,
    enough: float,
) -> Tensor:
    """Compute the step to the minimum of the linearised penalised chi-squared.

    Parameters
    ----------
    objective : Objective
    equations : NormalEquations
        With the gradient of the model itself.
    weights : sequence of Weights
        Of the equations.
    deviation : Tensor, (unknowns,)
        Prior standard deviations.
    enough : float
        Decrease of the penalised chi-squared that does not matter.

    Returns
    -------
    Tensor, (unknowns,)
    """
    curvature, current = equations.curvature, equations.current
    precision = deviation**-2
    # Unknowns differ by many powers of ten, so the system is solved in scaled units.
    unit = (curvature.diagonal() + precision).clamp(min=1e-300) ** -0.5
    system = (curvature * unit[:, None]).mul_(unit)
    system.diagonal().mul_(1 + _ROUNDING).add_(precision * unit**2)
    factor = torch.linalg.cholesky(system)

    def product(scaled: Tensor) -> Tensor:
        step = unit * scaled
        return unit * (curve(objective, equations, weights, step) + precision * step)

    def precondition(scaled: Tensor) -> Tensor:
        return torch.cholesky_solve(scaled[:, None], factor)[:, 0]

    gradient = equations.gradient - curvature @ current - precision * current
    return unit * conjugate_gradients(product, precondition, unit * gradient, enough)


def conjugate_gradients(
    product: Callable[[Tensor], Tensor],
    precondition: Callable[[Tensor], Tensor],
    gradient: Tensor,
    enough: float = 0.0,
) -> Tensor:
    """Minimise x A x - 2 g x approximately, (n,).

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

    Examples
    --------
    >>> import torch
    >>> from pyklip_diffrender.refinement.accurate_step import conjugate_gradients
    >>> matrix = torch.tensor([[2.0, 1.0], [1.0, 3.0]])
    >>> conjugate_gradients(lambda x: matrix @ x, lambda x: x, torch.tensor([3.0, 4.0]))
    tensor([1.0000, 1.0000])
    """
    x = torch.zeros_like(gradient)
    remaining = gradient.clone()
    direction = precondition(remaining)
    power, total = float(remaining @ direction), 0.0
    for _ in range(_ITERATIONS):
        # The decrease if the preconditioner were right; it understates the curvature, if anything.
        if power <= enough:
            break
        pulled = product(direction)
        curvature = float(direction @ pulled)
        if curvature <= 0:  # By rounding errors.
            break
        x += power / curvature * direction
        remaining -= power / curvature * pulled
        decrease = power**2 / curvature
        total += decrease
        if decrease < max(_SUFFICIENT * total, enough):
            break
        ahead = precondition(remaining)
        power, before = float(remaining @ ahead), power
        direction = ahead + power / before * direction
    return x
