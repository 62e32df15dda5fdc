"""Gauss-Newton steps with derivatives of the model itself, by conjugate gradients.

Normal equations of a coarse copy of the model are wrong where the effects of several unknowns
cancel, and steps along such directions are too long. Products of the model's own curvature with a
vector, at half of the wavelengths, take as long as two images. The coarse copy's equations
precondition them, and may come from an earlier step.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from pyklip_diffrender.linear.model import Noise
from pyklip_diffrender.refinement.forward import Forward, Objective, Point, State

_GRADIENT_ITERATIONS = 6
"""Largest number of iterations of one step."""

_GRADIENT_TOLERANCE = 0.05
"""Part of the decrease so far below which an iteration is the last."""

_CURVATURE_ROUNDING = 1e-12
"""Relative error of the curvature's elements."""

_CURVATURE_STEP_RATIO = 0.01
"""Part of a step between the images whose difference is a derivative. Over this part, curvature
matters less than the rounding errors of single precision."""


@dataclass(frozen=True)
class _Frames:
    """Frames at a state, their forward models, and their derivatives by levels and companions."""

    forwards: Sequence[Forward]
    points: Sequence[Point]
    levels: Sequence[Tensor]  # (unknowns, ny, nx) each, see `Forward.levels`.

    @classmethod
    def of(cls, forwards: Sequence[Forward], points: Sequence[Point]) -> _Frames:
        """Frames at points, with all the companions that each one shows."""
        levels = [
            forward.levels(point, point.unknowns.visible_sources(point.vector)).double()
            for forward, point in zip(forwards, points, strict=True)
        ]
        return cls(forwards, points, levels)


class ModelDerivatives:
    """Gradient and curvature of chi-squared, by derivatives of the model itself."""

    def __init__(self, objective: Objective, state: State, noise: Noise) -> None:
        self._objective, self._state, self._noise = objective, state, noise
        self._bright = [point.unknowns.are_bright(point.vector) for point in state.points]

    def gradient(self) -> Tensor:
        """Minus half the derivative of chi-squared, (unknowns,)."""
        residuals = dict(enumerate(self._objective.residuals(self._state)))
        sources = [point.unknowns.visible_sources(point.vector) for point in self._state.points]
        frames = _Frames.of(self._objective.forwards, self._state.points)
        return self._pull(residuals, frames, sources)

    @cached_property
    def _cheaper(self) -> _Frames:
        """The frames as the curvature sees them.

        The curvature determines the path to the minimum and not its place. Half of the wavelengths
        are sufficient, and the light of faint companions is linear: it depends on their contrasts
        and positions and on the star's flux, and not on the wavefront.
        """
        forwards = [forward.at_half_the_wavelengths for forward in self._objective.forwards]
        points = [
            forward.at(point.unknowns, point.vector, bright)
            for forward, point, bright in zip(
                forwards, self._state.points, self._bright, strict=True
            )
        ]
        return _Frames.of(forwards, points)

    @cached_property
    def _faint_light(self) -> list[Tensor]:
        """Light of the faint companions in each frame, (ny, nx)."""
        frames = zip(self._cheaper.forwards, self._cheaper.points, strict=True)
        return [
            forward.at(point.unknowns, point.vector).total - point.total
            for forward, point in frames
        ]

    def product(self, step: Tensor) -> Tensor:
        """Product of the curvature with a step, (unknowns,)."""
        # A s = J C^-1 (J^T s): a difference of two images along the step s has J^T s, and `_pull`
        # applies J C^-1 in reverse mode.
        vector, images, sources = self._state.vector + _CURVATURE_STEP_RATIO * step, {}, []
        for k, before in enumerate(self._cheaper.points):
            sources.append(before.unknowns.visible_sources(before.vector)[self._bright[k]])
            rows, bright = self._state.unknowns.rows[k], self._bright[k]
            forward = self._cheaper.forwards[k]
            after = forward.at(before.unknowns, rows.of_unknowns(vector), bright)
            images[k] = (after.total - before.total) / _CURVATURE_STEP_RATIO
            if not bool(bright.all()):
                images[k] = images[k] + self._change_of_faint(k, rows.of_unknowns(step))
        return self._pull(images, self._cheaper, sources)

    def _change_of_faint(self, k: int, step: Tensor) -> Tensor:
        """Change of the light of faint companions in a frame by a step of its unknowns."""
        frames, point = self._cheaper, self._cheaper.points[k]
        unknowns, faint = point.unknowns, ~self._bright[k]
        of_companions = step[unknowns.where("companions")]
        rows = frames.levels[k][-len(of_companions) :].unflatten(0, (-1, 3))[faint].flatten(0, 1)
        change = torch.tensordot(of_companions.reshape(-1, 3)[faint].flatten(), rows, dims=1)
        light = self._faint_light[k]
        change_of_flux = unknowns.level("flux", step) if "flux" in unknowns.linear else 0.0
        relative = change_of_flux / unknowns.level("flux", point.vector)
        return relative * light + change.to(light.device)

    def _pull(
        self, images: Mapping[int, Tensor], frames: _Frames, sources: Sequence[Tensor]
    ) -> Tensor:
        """Product of the whitened Jacobian with images of all frames, which are whitened here.

        The Jacobian by optics and wavefront includes the star and `sources`, (k, 3) by frame.
        """
        unknowns = self._state.unknowns
        total = torch.zeros(unknowns.size, dtype=torch.float64)
        whitened = self._noise.inverse(images)
        for k, point in enumerate(frames.points):
            # `inverse` has C^-1 x over w. Levels and companions have images in `levels`, and the
            # derivatives by the other unknowns come from reverse mode.
            pixels = self._noise.weight[k] * whitened[k]
            where, levels = point.unknowns.slices, frames.levels[k]
            of_frame = torch.zeros(len(point.vector), dtype=torch.float64)
            last = where["companions"].stop
            of_frame[last - len(levels) : last] = levels.flatten(1) @ pixels.cpu().flatten()
            slopes = frames.forwards[k].slopes(point, pixels, sources[k])
            for name, slope in slopes.items():
                of_frame[where[name]] = slope
            total += unknowns.rows[k].onto_unknowns(of_frame, unknowns.size)
        return total


def accurate_step(
    derivatives: ModelDerivatives,
    curvature: Tensor,
    offset: Tensor,
    deviation: Tensor,
    enough: float,
    *,
    volume: Tensor | float = 0.0,
) -> tuple[Tensor, bool]:
    """Compute the step (unknowns,) to the minimum of the linearised penalised chi-squared.

    `curvature` (some, some) is approximate and by the leading unknowns, the only ones that the step
    changes. `offset` (unknowns,) is from the means of the priors, whose standard deviations are
    `deviation`, and `volume` (some,) is added to the gradient. See `conjugate_gradients` for the
    flag and for `enough`.
    """
    count = len(curvature)
    # The step s minimises s (A + p) s - 2 s (g - p x0), with the curvature A and gradient g of the
    # model itself, the priors' precision p, and the offset x0 from their means. A + p is known by
    # its products with vectors, and the approximate curvature preconditions it.
    precision = deviation[:count] ** -2
    # Unknowns differ by many powers of ten, so the system is solved in scaled units.
    unit = (curvature.diagonal() + precision).clamp(min=1e-300) ** -0.5
    system = (curvature * unit[:, None]).mul_(unit)
    system.diagonal().mul_(1 + _CURVATURE_ROUNDING).add_(precision * unit**2)
    factor = torch.linalg.cholesky(system)
    step = torch.zeros_like(offset)

    def product(scaled: Tensor) -> Tensor:
        step[:count] = unit * scaled
        return unit * (derivatives.product(step)[:count] + precision * step[:count])

    def precondition(scaled: Tensor) -> Tensor:
        return torch.cholesky_solve(scaled[:, None], factor)[:, 0]

    gradient = derivatives.gradient()[:count] - precision * offset[:count] + volume
    scaled, settled = conjugate_gradients(product, precondition, unit * gradient, enough)
    step[:count] = unit * scaled
    return step, settled


def conjugate_gradients(
    product: Callable[[Tensor], Tensor],
    precondition: Callable[[Tensor], Tensor],
    gradient: Tensor,
    enough: float = 0.0,
) -> tuple[Tensor, bool]:
    """Minimise x A x - 2 g x approximately; also whether another iteration would hardly lower it.

    `product` gives A x with a positive definite A, `precondition` B^-1 x with an approximation B to
    A, and `gradient` g is (n,). The iteration is the last whose decrease is below `enough`, or
    below the part `_GRADIENT_TOLERANCE` of the whole decrease.
    """
    # Along a direction p, with the remaining gradient r = g - A x and z = B^-1 r, the minimum is at
    # the length (r . z) / (p . A p) and lowers the function by (r . z)^2 / (p . A p), since r is
    # orthogonal to the earlier directions. Every iteration lowers it, however poor the
    # preconditioner is; a few are sufficient where that is wrong in a few directions only.
    x = torch.zeros_like(gradient)
    remaining = gradient.clone()
    direction = precondition(remaining)
    power, total = float(remaining @ direction), 0.0
    for _ in range(_GRADIENT_ITERATIONS):
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
        # SciPy's `cg` ends by the size of the gradient, which says little where unknowns are nearly
        # degenerate.
        if decrease < max(_GRADIENT_TOLERANCE * total, enough):
            return x, True
        ahead = precondition(remaining)
        power, before = float(remaining @ ahead), power
        direction = ahead + power / before * direction
    return x, False
