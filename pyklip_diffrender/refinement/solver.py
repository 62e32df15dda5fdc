"""Damped Gauss-Newton steps on the unknowns of a fit.

A quick step solves the linearised problem with Gaussian priors. If it does not lower the penalised
chi-squared, it is repeated with Levenberg-Marquardt damping. Quick steps use derivatives of a
coarse copy of the model at an earlier point. Where these derivatives are not sufficient, an
accurate step follows: by conjugate gradients, with derivatives of the model itself along every
direction. The schedule of a fit, with a model error that decreases from step to step, is in
`annealing`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from scipy.linalg.blas import dsyrk
from torch import Tensor

from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.linear.model import (
    LinearFrame,
    LinearModel,
    Noise,
    pixel_pieces,
    summed_rows,
)
from pyklip_diffrender.linear.response import ResponseCache
from pyklip_diffrender.refinement.forward import (
    ACCURATE,
    Forward,
    FrameDerivatives,
    Objective,
    Problem,
    State,
    allowance,
)
from pyklip_diffrender.refinement.settings import OWN_PARAMETERS, FitSettings, ModePriors
from pyklip_diffrender.refinement.unknowns import FrameUnknowns, Unknowns
from pyklip_diffrender.wavefront.bases import Basis
from pyklip_diffrender.wavefront.priors import EvidenceUpdate, solve_with_evidence

# The unknowns of a fit, and the values from which they start.

_PEDESTAL_PRIOR_ERROR = 0.5
"""Relative prior deviation of the pedestal of a known pattern."""

_BRIGHT_PIXEL_RATIO = 0.3
"""Brightness of pixels where the star is bright, relative to its brightest one."""


def first_unknowns(
    forwards: Sequence[Forward], settings: FitSettings, basis: Basis, priors: ModePriors
) -> Unknowns:
    """The unknowns of frames that are fitted together, before companions are added.

    Flux and background start at their best estimates for the starting wavefront. Raises
    `IncompatibleSetupError` if the flux has a prior deviation but no starting value.
    """
    origin = forwards[0].problem.observation
    frames = tuple(
        _frame_unknowns(
            forward, settings, len(basis), len(priors.amplitude),
            forward.problem.observation.roll_from(origin),
        )
        for forward in forwards
    )  # fmt: skip
    own = OWN_PARAMETERS if len(frames) > 1 else ()
    return Unknowns(frames, own, priors.drift, priors.blocks)


def _frame_unknowns(
    forward: Forward, settings: FitSettings, modes: int, amplitude_modes: int, roll: float
) -> FrameUnknowns:
    problem = forward.problem
    free, deviations = settings.free, dict(settings.deviations)
    start = problem.optical_start(tuple(n for n in free if n in problem.model.parameters))
    if problem.has_free_pedestal:
        free = (*free, "pedestal")
        deviations["pedestal"] = _PEDESTAL_PRIOR_ERROR * problem.pedestal
    zero = torch.zeros(1, dtype=torch.float64)
    levels = {"flux": zero, "background": zero, "pedestal": zero + problem.pedestal}
    # The unknowns and their algebra stay on the CPU, wherever the model renders.
    unknowns = FrameUnknowns(
        free,
        {**{n: v.cpu() for n, v in start.items()}, **levels},
        modes,
        amplitude_modes,
        settings.companions,
        roll,
        not problem.observation.reference,
    )
    image = forward.at(unknowns, unknowns.initial()).image
    # With photon-noise weights the faint pixels would dominate this first estimate.
    flat = torch.full_like(problem.sigma, float(problem.sigma.median()))
    # A catalogue's flux is the target's.
    if problem.observation.reference and "flux" not in problem.start:
        deviations.pop("flux", None)
    is_known = "flux" in deviations
    if is_known and "flux" not in problem.start:
        raise IncompatibleSetupError(
            "deviations has 'flux', but start does not: how bright is the star? Give "
            "start={'flux': ...} in the unit of the frames"
        )
    names = tuple(n for n in settings.free if not (is_known and n == "flux"))
    flux, level = problem.flux_and_background(problem.gain * image, flat, names)
    if flux <= 0 and "flux" in names:
        flux = _median_flux(problem, problem.gain * image)
    if is_known:
        deviations["flux"] *= flux
    levels["flux"] = torch.tensor([flux], dtype=torch.float64)
    levels["background"] = torch.tensor([level], dtype=torch.float64)
    return replace(unknowns, start={**unknowns.start, **levels}, deviations=deviations)


def _fluxes(state: State) -> list[float]:
    """Flux of the star in each frame."""
    return [point.unknowns.level("flux", point.vector) for point in state.points]


def _median_flux(problem: Problem, image: Tensor) -> float:
    """Median flux of the star from the pixels where it is bright.

    Least squares give a negative flux where a companion outshines what the mask leaves of the star.
    """
    bright = problem.valid & (image > _BRIGHT_PIXEL_RATIO * image[problem.valid].max())
    return float((problem.data[bright] / image[bright]).median())


# Normal equations of all frames about a state of the fit.


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
    derive: Callable[[int], FrameDerivatives] | None = None,
) -> NormalEquations:
    """Linearise all frames about a state, with its first `modes` modes.

    `derive` gives the derivatives of a frame by its index, by default at the state. A wavefront
    that drifts between frames needs all modes.
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
    for k, (forward, point) in enumerate(zip(objective.forwards, state.points, strict=True)):
        residual, weight, common = (
            each.cpu() for each in (residuals[k], noise.weight[k], noise.common[k])
        )
        derived = FrameDerivatives.at(forward, point, modes) if derive is None else derive(k)
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


# Gauss-Newton steps with derivatives of the model itself, by conjugate gradients.
#
# Normal equations of a coarse copy of the model are wrong where the effects of several unknowns
# cancel, and steps along such directions are too long. Products of the model's own curvature with a
# vector take as long as three images. The coarse copy's equations precondition them, and may come
# from an earlier step.

_GRADIENT_ITERATIONS = 6
_GRADIENT_TOLERANCE = 0.05

_CURVATURE_ROUNDING = 1e-12
"""Relative error of the curvature's elements."""

_CURVATURE_STEP_RATIO = 0.01
"""Part of a step between the images whose difference is a derivative. Over this part, curvature
matters less than the rounding errors of single precision."""


class ModelDerivatives:
    """Gradient and curvature of chi-squared, by derivatives of the model itself.

    The curvature has the approximate derivatives of the frames `rough`, by index.
    """

    def __init__(
        self,
        objective: Objective,
        state: State,
        noise: Noise,
        rough: Mapping[int, LinearFrame] | None = None,
    ) -> None:
        self._objective, self._state, self._noise = objective, state, noise
        self._rough = rough or {}
        self._levels = [
            forward.levels(point, point.unknowns.visible_sources(point.vector)).double()
            for forward, point in zip(objective.forwards, state.points, strict=True)
        ]
        self._bright = [point.unknowns.are_bright(point.vector) for point in state.points]
        # The gradient includes all light. In the curvature, which determines the path to the
        # minimum and not its place, the light of faint companions is linear: it depends on their
        # contrasts and positions and on the star's flux, and not on the wavefront.
        self._without_faint = [
            point if bool(bright.all()) else forward.at(point.unknowns, point.vector, bright)
            for forward, point, bright in zip(
                objective.forwards, state.points, self._bright, strict=True
            )
        ]

    def gradient(self) -> Tensor:
        """Minus half the derivative of chi-squared, (unknowns,)."""
        sources = [point.unknowns.visible_sources(point.vector) for point in self._state.points]
        return self._pull(dict(enumerate(self._objective.residuals(self._state))), sources, {})

    def product(self, step: Tensor) -> Tensor:
        """Product of the curvature with a step, (unknowns,)."""
        # A s = J C^-1 (J^T s): a difference of two images along the step s has J^T s, and `_pull`
        # applies J C^-1 in reverse mode.
        vector, images, sources = self._state.vector + _CURVATURE_STEP_RATIO * step, {}, []
        for k, before in enumerate(self._without_faint):
            sources.append(before.unknowns.visible_sources(before.vector)[self._bright[k]])
            if k in self._rough:
                images[k] = self._rough[k].image(step).to(before.total.device)
                continue
            rows, bright = self._state.unknowns.rows[k], self._bright[k]
            after = self._objective.forwards[k].at(
                before.unknowns, rows.of_unknowns(vector), bright
            )
            images[k] = (after.total - before.total) / _CURVATURE_STEP_RATIO
            if not bool(bright.all()):
                images[k] = images[k] + self._change_of_faint(k, rows.of_unknowns(step))
        return self._pull(images, sources, self._rough)

    def _change_of_faint(self, k: int, step: Tensor) -> Tensor:
        """Change of the light of faint companions in a frame by a step of its unknowns."""
        point = self._state.points[k]
        unknowns, faint = point.unknowns, ~self._bright[k]
        of_companions = step[unknowns.where("companions")]
        rows = self._levels[k][-len(of_companions) :].unflatten(0, (-1, 3))[faint].flatten(0, 1)
        change = torch.tensordot(of_companions.reshape(-1, 3)[faint].flatten(), rows, dims=1)
        light = point.total - self._without_faint[k].total
        change_of_flux = unknowns.level("flux", step) if "flux" in unknowns.linear else 0.0
        relative = change_of_flux / unknowns.level("flux", point.vector)
        return relative * light + change.to(light.device)

    def _pull(
        self,
        images: Mapping[int, Tensor],
        sources: Sequence[Tensor],
        rough: Mapping[int, LinearFrame],
    ) -> Tensor:
        """Product of the whitened Jacobian with images of all frames, which are whitened here.

        The Jacobian by optics and wavefront includes the star and `sources`, (k, 3) by frame;
        frames in `rough` have their approximate Jacobian.
        """
        objective, unknowns = self._objective, self._state.unknowns
        total = torch.zeros(unknowns.size, dtype=torch.float64)
        whitened = self._noise.inverse(images)
        for k, (forward, point) in enumerate(
            zip(objective.forwards, self._state.points, strict=True)
        ):
            # `inverse` has C^-1 x over w. Levels and companions have images in `_levels`, and the
            # derivatives by the other unknowns come from reverse mode.
            pixels = self._noise.weight[k] * whitened[k]
            if k in rough:
                on_rows = rough[k].pulled(pixels.cpu()[None])
                total += rough[k].onto_unknowns(on_rows, unknowns.size)[:, 0]
                continue
            where, levels = point.unknowns.slices, self._levels[k]
            of_frame = torch.zeros(len(point.vector), dtype=torch.float64)
            last = where["companions"].stop
            of_frame[last - len(levels) : last] = levels.flatten(1) @ pixels.cpu().flatten()
            for name, slopes in forward.slopes(point, pixels, sources[k]).items():
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
    volume: Tensor | float = 0.0,
    iterations: int = _GRADIENT_ITERATIONS,
    sufficient: float = _GRADIENT_TOLERANCE,
) -> tuple[Tensor, bool]:
    """Compute the step (unknowns,) to the minimum of the linearised penalised chi-squared.

    `curvature` (some, some) is approximate and by the leading unknowns, the only ones that the step
    changes. `offset` (unknowns,) is from the means of the priors, whose standard deviations are
    `deviation`, and `volume` (some,) is added to the gradient. See `conjugate_gradients` for the
    flag and the last arguments.
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
    iterations: int = _GRADIENT_ITERATIONS,
    sufficient: float = _GRADIENT_TOLERANCE,
) -> tuple[Tensor, bool]:
    """Minimise x A x - 2 g x approximately; also whether another iteration would hardly lower it.

    `product` gives A x with a positive definite A, `precondition` B^-1 x with an approximation B to
    A, and `gradient` g is (n,). The iteration is the last whose decrease is below `enough`, or
    below the part `sufficient` of the whole decrease.
    """
    # Along a direction p, with the remaining gradient r = g - A x and z = B^-1 r, the minimum is at
    # the length (r . z) / (p . A p) and lowers the function by (r . z)^2 / (p . A p), since r is
    # orthogonal to the earlier directions. Every iteration lowers it, however poor the
    # preconditioner is; a few are sufficient where that is wrong in a few directions only.
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
        # SciPy's `cg` ends by the size of the gradient, which says little where unknowns are nearly
        # degenerate.
        if decrease < max(sufficient * total, enough):
            return x, True
        ahead = precondition(remaining)
        power, before = float(remaining @ ahead), power
        direction = ahead + power / before * direction
    return x, False


_MOST_ATTEMPTS = 7
"""Largest number of attempts at a step, with increasing damping. The last attempt has a damping of
2,300: what has a prior hardly moves any more."""

_LEAST_DAMPING = 0.05
"""Smallest damping, as a multiple of the prior's precision. Less has no effect on a step."""

_HARDER = 6.0
"""Growth of the damping after an attempt that raised chi-squared: `_MOST_ATTEMPTS` attempts then
span all dampings that matter, and each costs one image of every frame."""

_HARD = 2.5
"""Growth of the damping after a step that gained much less than predicted. Since the step did gain,
the next one needs less damping than after an attempt that failed."""

_EASIER = 0.25
"""Change of the damping after a step that gained what was predicted: a few such steps remove it."""

_NONE = 1e-3
"""Damping that a step that gained what was predicted sets to 0."""

_AS_PREDICTED, _BELOW_PREDICTED = 0.7, 0.3
"""Ratios of the actual to the predicted gain above which the damping decreases, and below which it
grows. Between them the linear model is neither good nor bad, and the damping stays; trust-region
methods have similar limits (Nocedal and Wright 2006, Numerical Optimization, algorithm 4.1)."""

_RESPONSES_BYTES = 4e9
"""Largest number of bytes of stored derivatives."""

_FINAL_DERIVATIVE_ERROR = 0.01
"""Largest error of the derivatives in the linear model that gives the errors of a fit. With 0.05,
limits were up to 10 % too shallow near the occulter."""

_FAR_KAPPA = 0.03
"""Model error above which steps fail because they are large, and are damped."""

_SIMILAR_KAPPA_RATIO = 1.5
"""Ratio of model errors above which normal equations precondition poorly."""

_STEP_PARTS = (1.0, 0.4, 0.16, 0.064)
"""Parts of an accurate step that are tried until one lowers the penalised chi-squared."""

_SLOW_GAIN_RATIO = 0.8
"""Ratio of the gains of successive steps with the same derivatives above which they are poor: with
right ones, gains decrease tenfold. Near a companion of 0.1 of the star's flux, whose light depends
on the wavefront as well, each gain was 0.9 of the one before."""

_POOR_GAIN_RATIO = 0.5
"""Ratio of the actual to the expected gain of a step below which its derivatives are poor."""


@dataclass(frozen=True)
class StepState:
    """Priors, damping and model error that one step of a fit hands on to the next."""

    priors: ModePriors  # With the scales that the step has fitted, unless they are fixed.
    damping: float = 0.0  # Levenberg-Marquardt damping of the next step.
    kappa: float = math.inf  # Model error that the step has assumed.
    gain: float = 0.0  # Gain of that step, in chi-squared per pixel, if it was a quick one.
    # Whether the next step needs derivatives of the model itself, unless kappa grows.
    needs_accurate: bool = False

    def without_damping(self) -> StepState:
        """This state without damping, for a step to which the damping does not apply."""
        return replace(self, damping=0.0)

    def relaxed(self, ratio: float) -> StepState:
        """This state with the damping for a ratio of the actual to the predicted gain."""
        if ratio > _AS_PREDICTED:
            return replace(self, damping=self.damping * _EASIER if self.damping > _NONE else 0.0)
        if ratio < _BELOW_PREDICTED:
            return replace(self, damping=max(_HARD * self.damping, _LEAST_DAMPING))
        return self


class Step(NamedTuple):
    """The state after a step, its gain, and what is handed on to the next step."""

    state: State
    gain: float
    carried: StepState


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
            reading = self._responses.reading(enough, keep, is_last=final)
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


class Solver:
    """Takes damped Gauss-Newton steps with a given basis.

    A step is a function of its arguments: what steers it besides the state is a `StepState`, which
    the step before has returned. Raises `IncompatibleSetupError` for a free parameter that the
    model does not have, or a star of unknown flux.
    """

    def __init__(
        self, problems: Sequence[Problem], settings: FitSettings, basis: Basis, progress: bool
    ) -> None:
        self.settings, self.basis = settings, basis
        for problem in problems:
            problem.require_parameters(settings.free)
        if "flux" not in settings.free and not float(problems[0].start.get("flux", 0.0)):
            raise IncompatibleSetupError(
                "flux is not free and start has no 'flux': how bright is the star? Add 'flux' to "
                "free, or give start={'flux': light that the pupil collects}"
            )
        # Bytes of the Jacobians by modes, in single precision, which are always stored.
        jacobians = 4.0 * len(problems) * (len(basis) + settings.prior.amplitude_modes(basis))
        jacobians *= math.prod(problems[0].observation.shape)
        responses = ResponseCache(
            problems[0].model,
            basis,
            npix=settings.response_npix,
            wavelengths=settings.response_wavelengths,
            relinearise=settings.relinearise,
            keep=len(problems),
            memory=min(_RESPONSES_BYTES, settings.memory_beside(jacobians)),
            progress=progress,
        )
        self.objective = Objective(
            [Forward(problem, responses) for problem in problems], settings.robust
        )
        self.equations = EquationsCache(self.objective, responses)

    def priors_of(self, settings: FitSettings) -> ModePriors:
        """The priors of the modes that settings state, for the frames of this fit."""
        observations = [forward.problem.observation for forward in self.objective.forwards]
        return ModePriors.of(settings, self.basis, observations)

    def first_unknowns(self, priors: ModePriors) -> Unknowns:
        """The unknowns, with starting values, before companions are added."""
        return first_unknowns(self.objective.forwards, self.settings, self.basis, priors)

    @staticmethod
    def prior_deviation(unknowns: Unknowns, priors: ModePriors) -> Tensor:
        """Prior standard deviations of all unknowns."""
        return torch.cat([unknowns.prior_deviation(), priors.deviation])

    def step(self, state: State, carried: StepState, kappa: float, modes: int) -> Step:
        """Take one damped step with the first `modes` modes; 0 for the alignment only.

        The state is unchanged if no step lowers the penalised chi-squared. The gain is the
        decrease, or expected decrease, of the penalised chi-squared per pixel.
        """
        needs_accurate = carried.needs_accurate and kappa <= carried.kappa and kappa < _FAR_KAPPA
        carried = replace(carried, kappa=kappa, needs_accurate=needs_accurate)
        # Without the wavefront, derivatives are cheap and always accurate.
        may_repeat = self.settings.accurate_steps and modes > 0
        if not (may_repeat and needs_accurate):
            taken, gain, carried = self._quick_step(state, carried, kappa, modes, may_repeat)
            # Only derivatives of the model itself can tell that no further step gains anything.
            is_last = may_repeat and gain < self.settings.tolerance and kappa < _FAR_KAPPA
            if taken is not None and not is_last:
                return Step(taken, gain, carried)
            carried = replace(carried, damping=0.0, needs_accurate=True)
            state = state if taken is None else taken
        return self._accurate_step(state, carried, kappa, modes)

    # The linearised problem. Let x be the unknowns minus their starting values, J the Jacobian by
    # them, C the covariance of the noise, r the residual at the starting values, and p the
    # precision of the priors. The penalised chi-squared of the linear model is, but for a constant,
    #
    #     q(x) = x A x - 2 g x + sum p x^2,    A = J C^-1 J^T,    g = J C^-1 r,
    #
    # and a step leads from the present x0 to the x that minimises q(x) + d sum p (x - x0)^2 with
    # the damping d, which solves
    #
    #     (A + (1 + d) p) x = g + d p x0.
    #
    # Damping by the prior's precision rather than by the curvature (Marquardt) holds back what the
    # data hardly determine, along which a step is long and the model not linear. Without damping
    # the step is a Gauss-Newton step. The ratio of the actual decrease of chi-squared to
    # q(x0) - q(x) says how linear the model is over the step, and so how to damp the next one.

    def _quick_step(
        self, state: State, carried: StepState, kappa: float, modes: int, may_repeat: bool
    ) -> tuple[State | None, float, StepState]:
        """Take a step with the derivatives that there are; None if it needs better ones."""
        unknowns, objective = state.unknowns, self.objective
        equations = self.equations.about(
            state, kappa, modes, objective.robust, self.settings.relinearise
        )
        # New derivatives that fail show that the model is not linear, as do large steps.
        is_stale = may_repeat and not equations.is_exact and kappa < _FAR_KAPPA
        noise = objective.errors(state, kappa, objective.robust)
        fits_scales = self.settings.prior.fit_scales
        damping = 0.0 if fits_scales else carried.damping
        update = self._solve(
            unknowns, equations, carried.priors, fit_scales=fits_scales, damping=damping
        )
        priors = replace(carried.priors, scales=update.scales)
        carried = replace(carried, priors=priors)
        # Only derivatives of the model itself can tell that no further step gains anything.
        unmoved = None if may_repeat else state
        expected = self._predicted_gain(unknowns, equations, priors, update.step)
        if expected < self.settings.tolerance * objective.pixels:
            # The gain is too small for another linearisation.
            return unmoved, expected / objective.pixels, carried
        before = self._cost(state, noise, priors)
        for _ in range(_MOST_ATTEMPTS):
            if carried.damping != damping:
                damping = carried.damping
                update = self._solve(unknowns, equations, priors, damping=damping)
                expected = self._predicted_gain(unknowns, equations, priors, update.step)
            trial = self._moved(state, update.step - equations.current)
            after = self._cost(trial, noise, priors)
            if after < before and trial.has_star:
                ratio, gain = (before - after) / expected, (before - after) / objective.pixels
                slow = _SLOW_GAIN_RATIO * carried.gain < gain < carried.gain
                poor = is_stale and (ratio < _POOR_GAIN_RATIO or slow)
                carried = replace(carried, needs_accurate=True) if poor else carried.relaxed(ratio)
                return trial, gain, replace(carried, gain=gain)
            if is_stale:
                return None, 0.0, carried
            carried = replace(carried, damping=max(_HARDER * carried.damping, _LEAST_DAMPING))
        return unmoved, 0.0, carried

    def _accurate_step(self, state: State, carried: StepState, kappa: float, modes: int) -> Step:
        """Take a step, or a part of it, with derivatives of the model itself."""
        objective = self.objective
        noise = objective.errors(state, kappa, objective.robust)
        before = self._cost(state, noise, carried.priors)
        offset = state.vector - state.unknowns.initial()
        deviation = self.prior_deviation(state.unknowns, carried.priors)
        enough = self.settings.tolerance * objective.pixels / 2
        # Equations of an earlier state precondition nearly as well, and new ones take longer than
        # the step itself.
        for is_new in (False, True):
            equations = None if is_new else self.equations.preconditioner(state, kappa, modes)
            if equations is None:
                equations = self.equations.about(state, kappa, modes, objective.robust, ACCURATE)
            # Frames of reference stars, perhaps many, hardly change the direction.
            rough = {
                k: equations.frames[k]
                for k, forward in enumerate(objective.forwards)
                if forward.problem.observation.reference
            }
            derivatives = ModelDerivatives(objective, state, noise, rough)
            volume = self._volume_gradient(state, carried.priors, len(equations.curvature))
            step, settled = accurate_step(
                derivatives, equations.curvature, offset, deviation, enough, volume=volume
            )
            self.equations.judge(preconditions=settled)
            for part in _STEP_PARTS:
                trial = self._moved(state, part * step)
                after = self._cost(trial, noise, carried.priors)
                if after < before and trial.has_star:
                    return Step(trial, (before - after) / objective.pixels, carried)
            if equations.state is state:
                break
            del equations  # The next ones are as large.
        return Step(state, 0.0, carried)

    def _moved(self, state: State, step: Tensor) -> State:
        """The state after a step of the leading unknowns, within the bounds of all parameters."""
        return self.objective.at(state.unknowns, state.unknowns.stepped(state.vector, step))

    def leave_out(self, pixels: Sequence[Tensor]) -> None:
        """Leave out pixels from now on; a mask, (ny, nx), for every frame."""
        for forward, mask in zip(self.objective.forwards, pixels, strict=True):
            forward.problem.leave_out(mask)
        self.equations.forget_weights()

    def linear_model(
        self,
        state: State,
        priors: ModePriors,
        kappa: float,
        modes: int,
        robust: float,
        *,
        final: bool = True,
    ) -> LinearModel:
        """Return the linear model about a state, with its first `modes` modes.

        `final` says whether errors will be computed from it, for which derivatives must be
        accurate.
        """
        unknowns, equations = state.unknowns, self.equations.last
        count = unknowns.with_modes(modes)
        allowed = self.allowed_error(final=final)
        if (
            equations is None
            or not equations.is_within(allowed)
            or equations.state is not state
            or not equations.has_weights
            or (equations.kappa, equations.robust) != (kappa, robust)
            or len(equations.current) != count
            or (final and not equations.counts_companions)
        ):
            del equations
            equations = self.equations.about(state, kappa, modes, robust, allowed, final=final)
        return LinearModel(
            unknowns=unknowns.labels()[:count],
            frames=equations.frames,
            vector=state.vector[:count],
            mean=unknowns.initial()[:count],
            deviation=self.prior_deviation(unknowns, priors)[:count],
            curvature=equations.curvature,
        )

    def allowed_error(self, *, final: bool) -> float:
        """Largest error of the derivatives in linear models, see `linear_model`."""
        if not self.settings.accurate_steps:
            return self.settings.relinearise
        return _FINAL_DERIVATIVE_ERROR if final else ACCURATE

    def posterior(self, state: State, priors: ModePriors) -> EvidenceUpdate:
        """Return the errors of all unknowns of the last linear model, which is about `state`."""
        equations = self.equations.last
        assert equations is not None
        assert equations.state is state
        return self._solve(state.unknowns, equations, priors, errors=True)

    def companion_snr(self, state: State, priors: ModePriors) -> Tensor:
        """S/N of the companions of a state, (companions,).

        Errors come from the last linearisation; the S/N is infinite if it had other companions.
        """
        equations, unknowns = self.equations.last, state.unknowns
        where = unknowns.where("companions")
        contrasts = state.vector[where][::3]
        if not len(contrasts) or equations is None or equations.state.unknowns is not unknowns:
            return torch.full_like(contrasts, math.inf)
        variance = self._solve(unknowns, equations, priors, errors=True).variance
        assert variance is not None
        return contrasts / variance[where][::3].sqrt()

    def _solve(
        self,
        unknowns: Unknowns,
        equations: NormalEquations,
        priors: ModePriors,
        *,
        damping: float = 0.0,
        fit_scales: bool = False,
        errors: bool = False,
    ) -> EvidenceUpdate:
        """Most probable unknowns of the linearised model, minus their starting values."""
        curvature = equations.curvature
        modes = max(0, len(curvature) - unknowns.where("modes").start)
        fixed = unknowns.prior_deviation()
        if modes:
            fixed = torch.cat([fixed, priors.amplitude])
        # Unknowns differ by many powers of ten, so the system is solved in scaled units.
        unit = torch.ones(len(curvature), dtype=torch.float64)
        unit[: len(fixed)] = curvature.diagonal()[: len(fixed)].clamp(min=1e-300) ** -0.5
        gradient = equations.gradient + self._volume_gradient(equations.state, priors, len(unit))
        update = solve_with_evidence(
            (curvature * unit[:, None]).mul_(unit),
            gradient * unit,
            priors.shape[:modes],
            priors.group[:modes],
            priors.scales,
            fixed / unit[: len(fixed)],
            iterations=1 if fit_scales and modes else 0,
            damping=damping,
            current=equations.current / unit,
            errors=errors,
        )
        return update.in_units(unit)

    def _cost(self, state: State, noise: Noise, priors: ModePriors) -> float:
        """Penalised chi-squared of a state with given noise."""
        deviation = self.prior_deviation(state.unknowns, priors)
        # Cauchy's loss is concave in the squared residual, so that its tangent lies above it: with
        # weights that were made robust about the state before a step, a step that lowers this sum
        # also lowers the loss.
        offset = (state.vector - state.unknowns.initial()) / deviation
        logs = [math.log(flux) for flux in _fluxes(state) if flux > 0] if priors.determined else []
        volume = priors.determined * float(np.mean(logs)) if logs else 0.0
        return self.objective.chi2(state, noise) + float((offset**2).sum()) + volume

    # The flux of the star, marginalised over the wavefront. The data fix the product of the flux F
    # and the intensity |E|^2 of the diffracted field, so that a brighter star goes with a smaller
    # wavefront. The derivative of the image by a mode, F |E| up to factors that do not depend on
    # it, is then in proportion to sqrt(F), and the volume of the n modes that the data determine to
    # F^(-n / 2). The marginal probability of F has that factor, and the joint one has not: where
    # the prior pulls the wavefront to 0, the most probable pair has too large a flux. The penalised
    # chi-squared of a fit with a marginal flux has n log F in addition, with n of
    # `ModePriors.determined` and the mean of log F over frames, whose ratios the data determine.
    # See D. J. C. MacKay 1992, Neural Computation 4, 415, for Laplace's approximation.

    @staticmethod
    def _volume_gradient(state: State, priors: ModePriors, count: int) -> Tensor:
        """Minus half the derivative of n log F by the first `count` unknowns."""
        total = torch.zeros(state.unknowns.size, dtype=torch.float64)
        if not priors.determined:
            return total[:count]
        for rows, point in zip(state.unknowns.rows, state.points, strict=True):
            flux, of_frame = point.unknowns.where("flux"), torch.zeros_like(point.vector)
            of_frame[flux] = -priors.determined / (2 * len(state.points) * point.vector[flux])
            total += rows.onto_unknowns(of_frame, len(total))
        return total[:count]

    def _predicted_gain(
        self, unknowns: Unknowns, equations: NormalEquations, priors: ModePriors, step: Tensor
    ) -> float:
        """Decrease of the penalised chi-squared if the model were linear."""
        precision = self.prior_deviation(unknowns, priors)[: len(step)] ** -2
        curvature, current = equations.curvature, equations.current
        gradient = equations.gradient + self._volume_gradient(equations.state, priors, len(step))

        def quadratic(x: Tensor) -> float:
            return float(x @ (curvature @ x) - 2 * gradient @ x + precision @ x**2)

        return max(quadratic(current) - quadratic(step), 1e-12)
