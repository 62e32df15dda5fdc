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
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.linear.model import (
    LinearModel,
    Noise,
)
from pyklip_diffrender.linear.response import NANOMETRE, ResponseCache
from pyklip_diffrender.optics.grid import PupilGrid, resample
from pyklip_diffrender.refinement.accurate_steps import ModelDerivatives, accurate_step
from pyklip_diffrender.refinement.equations import EquationsCache, NormalEquations
from pyklip_diffrender.refinement.forward import (
    ACCURATE,
    Forward,
    Objective,
    Problem,
    State,
)
from pyklip_diffrender.refinement.settings import FitSettings, ModePriors
from pyklip_diffrender.refinement.start import first_unknowns
from pyklip_diffrender.refinement.unknowns import Unknowns
from pyklip_diffrender.wavefront.bases import Basis, coefficients_of
from pyklip_diffrender.wavefront.priors import EvidenceUpdate, solve_with_evidence

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

_RESPONSES_BYTES = 2e9
"""Largest number of bytes of stored derivatives: of five frames in F444W on 80 x 80 pixels, or of
seven in F210M."""

_FINAL_DERIVATIVE_ERROR = 0.01
"""Largest error of the derivatives in the linear model that gives the errors of a fit. With 0.05,
limits were up to 10 % too shallow near the occulter."""

_FAR_KAPPA = 0.03
"""Model error above which steps fail because they are large, and are damped."""

_STEP_PARTS = (1.0, 0.4, 0.16, 0.064)
"""Parts of an accurate step that are tried until one lowers the penalised chi-squared."""

_MAP_SAMPLES = 128
"""Samples across the pupil of the starting map, to which modes are fitted."""

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


def _fluxes(state: State) -> list[float]:
    """Flux of the star in each frame."""
    return [point.unknowns.level("flux", point.vector) for point in state.points]


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
        first = before = self._cost(state, noise, carried.priors)
        enough = self.settings.tolerance * objective.pixels / 2
        # Equations of an earlier state precondition nearly as well, and new ones take longer than
        # the step itself. But only new ones tell that no further step gains anything: along the
        # directions that the earlier ones do not see, a step is too short. Before the flux is
        # marginal, other steps follow.
        followed = self.settings.marginal_flux and not carried.priors.determined
        sufficient = 0.0 if followed else self.settings.tolerance
        for attempt in range(2):
            equations = None if attempt else self.equations.preconditioner(state, kappa, modes)
            if equations is None:
                equations = self.equations.about(state, kappa, modes, objective.robust, ACCURATE)
            is_new = equations.state is state
            derivatives = ModelDerivatives(objective, state, noise)
            volume = self._volume_gradient(state, carried.priors, len(equations.curvature))
            offset = state.vector - state.unknowns.initial()
            deviation = self.prior_deviation(state.unknowns, carried.priors)
            step, settled = accurate_step(
                derivatives, equations.curvature, offset, deviation, enough, volume=volume
            )
            del equations  # The next ones are as large.
            self.equations.judge(preconditions=settled)
            for part in _STEP_PARTS:
                trial = self._moved(state, part * step)
                after = self._cost(trial, noise, carried.priors)
                if after < before and trial.has_star:
                    state, before = trial, after
                    break
            gain = (first - before) / objective.pixels
            if is_new or gain > sufficient:
                break
        return Step(state, gain, carried)

    def _moved(self, state: State, step: Tensor) -> State:
        """The state after a step of the leading unknowns, within the bounds of all parameters."""
        unknowns = state.unknowns
        has_modes = len(step) > unknowns.where("amplitude").start
        of_map = self._modes_of_map if has_modes else None
        return self.objective.at(unknowns, unknowns.stepped(state.vector, step, of_map))

    @cached_property
    def _modes_of_map(self) -> Tensor:
        """Coefficients of the starting map, (modes,), nm."""
        problem = self.objective.forwards[0].problem
        if not problem.initial.data.any():
            return torch.zeros(len(self.basis), dtype=torch.float64)
        grid = PupilGrid.full(_MAP_SAMPLES, problem.model.diameter)
        opd = torch.from_numpy(resample(problem.initial.data, _MAP_SAMPLES)) / NANOMETRE
        return coefficients_of(opd[None], self.basis, grid)[0]

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
