"""Damped Gauss-Newton steps on the unknowns of a fit.

A quick step solves the linearised problem with Gaussian priors. If it does not lower the penalised
chi-squared, it is repeated with Levenberg-Marquardt damping. Its derivatives are those of a coarse
copy of the model at an earlier point. Where they are not sufficient, an accurate step follows: by
conjugate gradients, with derivatives of the model itself along every direction. The schedule of a
fit, with a model error that decreases from step to step, is in `annealing`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.linear.model import LinearModel
from pyklip_diffrender.linear.noise import Noise
from pyklip_diffrender.linear.response_cache import ResponseCache
from pyklip_diffrender.refinement.accurate_step import ModelDerivatives, accurate_step
from pyklip_diffrender.refinement.first_unknowns import first_unknowns
from pyklip_diffrender.refinement.forward import Forward
from pyklip_diffrender.refinement.mode_priors import ModePriors
from pyklip_diffrender.refinement.normal_equations import NormalEquations, linearise
from pyklip_diffrender.refinement.objective import Objective, State
from pyklip_diffrender.refinement.problem import Problem
from pyklip_diffrender.refinement.settings import GaussNewton
from pyklip_diffrender.refinement.unknowns import Unknowns
from pyklip_diffrender.wavefront.bases import Basis
from pyklip_diffrender.wavefront.priors import EvidenceUpdate, solve_with_evidence

__all__ = ["EquationsCache", "Solver", "Step", "StepState"]

_TRIES = 7
"""Largest number of attempts at a step, with increasing damping. The last has a damping of 2,300:
what has a prior hardly moves any more."""

_LEAST = 0.05
"""Smallest damping, as a multiple of the prior's precision. With less, a step is that without."""

_HARDER = 6.0
"""Growth of the damping after an attempt that raised chi-squared: `_TRIES` attempts then span all
dampings that matter, and each costs one image of every frame."""

_HARD = 2.5
"""Growth of the damping after a step that gained much less than predicted. It did gain, so that the
next one needs less than after an attempt that failed."""

_EASIER = 0.25
"""Change of the damping after a step that gained what was predicted: a few such steps remove it."""

_NONE = 1e-3
"""Damping that a step that gained what was predicted sets to 0."""

_AS_PREDICTED, _BELOW_PREDICTED = 0.7, 0.3
"""Ratios of the actual to the predicted gain above which the damping decreases, and below which it
grows. Between them the linear model is neither good nor bad, and the damping stays; trust-region
methods have similar limits (Nocedal and Wright 2006, Numerical Optimization, algorithm 4.1)."""

_RESPONSES = 4e9
"""Largest number of bytes of stored derivatives."""

_ACCURATE = 0.05
"""Largest error of the derivatives that precondition accurate steps. Without these steps, fits
of bright stars stopped at a chi-squared that was up to a fifth too large: along directions in which
the effects of unknowns cancel, the curvature of the coarse copy was 20 times too small."""

_FINAL = 0.01
"""Error of derivatives above which the linear model of such a fit gets new ones. With 0.05, limits
were up to 10 % too shallow near the occulter."""

_FAR = 0.03
"""Model error above which steps fail because they are large. They are damped then."""

_SIMILAR = 1.5
"""Ratio of model errors above which normal equations precondition poorly."""

_PARTS = (1.0, 0.4, 0.16, 0.064)
"""Parts of an accurate step that are tried until one lowers the penalised chi-squared."""

_POOR = 0.5
"""Ratio of the actual to the expected gain of a step below which its derivatives are poor."""


@dataclass(frozen=True)
class StepState:
    """What one step of a fit hands on to the next.

    Attributes
    ----------
    priors : ModePriors
        With the scales that the step has fitted, unless they are fixed.
    damping : float
        Levenberg-Marquardt damping of the next step.
    kappa : float
        Model error that the step has assumed, as a fraction of the star.
    needs_accurate : bool
        Whether the next step needs derivatives of the model itself, unless kappa grows.
    """

    priors: ModePriors
    damping: float = 0.0
    kappa: float = math.inf
    needs_accurate: bool = False

    def without_damping(self) -> StepState:
        """For a step to which the damping of this one does not apply."""
        return replace(self, damping=0.0)

    def relaxed(self, ratio: float) -> StepState:
        """With the damping that follows from the ratio of the actual to the predicted gain."""
        if ratio > _AS_PREDICTED:
            return replace(self, damping=self.damping * _EASIER if self.damping > _NONE else 0.0)
        if ratio < _BELOW_PREDICTED:
            return replace(self, damping=max(_HARD * self.damping, _LEAST))
        return self


class Step(NamedTuple):
    """The state after a step, its gain, and what is handed on to the next step."""

    state: State
    gain: float
    carried: StepState


class EquationsCache:
    """The last normal equations of a fit, which are its largest arrays.

    There is only one set, because the next one is as large: it is freed before others are computed.
    Its Jacobians are used again at the same state, and its curvature preconditions accurate steps
    from states near it. What it returns has the error of derivatives that the caller allows.

    Parameters
    ----------
    objective : Objective
    responses : ResponseCache
        Of the frames of the objective.

    Attributes
    ----------
    last : NormalEquations or None
    """

    def __init__(self, objective: Objective, responses: ResponseCache) -> None:
        self._objective, self._responses = objective, responses
        self.last: NormalEquations | None = None
        self._preconditions = False

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
        """Linearise about a state, with derivatives whose error is at most `allowed`."""
        outweighing = 0.0 if final else kappa
        bright = state.bright_companions(outweighing)
        last, reading = self.last, self._responses.reading(allowed, len(state.points) + bright)
        jacobians: list[Tensor] = []
        error = None
        if (
            last is not None
            and last.state is state
            and last.error <= allowed
            and len(last.current) == state.unknowns.with_modes(modes)
            and last.bright_companions == bright
        ):
            jacobians, error = [frame.jacobian for frame in last.frames], last.error
        last = self.last = None
        equations = linearise(
            self._objective, state, kappa, modes, robust, jacobians, outweighing, reading
        )
        self.last = equations if error is None else replace(equations, error=error)
        self._preconditions = True
        return self.last

    def preconditioner(self, state: State, kappa: float, modes: int) -> NormalEquations | None:
        """Return the last equations if they can precondition an accurate step from a state."""
        last = self.last
        if (
            last is not None
            and self._preconditions
            and (last.kappa <= _SIMILAR * kappa or not last.has_weights)
            and last.error <= _ACCURATE
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
    the step before has returned. Derivatives come from caches, within the errors that are allowed.

    Parameters
    ----------
    problems : sequence of Problem
        One for each frame.
    settings : GaussNewton
    basis : Basis
    progress : bool
        Show progress bars.

    Attributes
    ----------
    objective : Objective
    equations : EquationsCache

    Raises
    ------
    IncompatibleSetupError
        For a free parameter that the model does not have, or a star of unknown flux.
    """

    def __init__(
        self, problems: Sequence[Problem], settings: GaussNewton, basis: Basis, progress: bool
    ) -> None:
        self.settings, self.basis = settings, basis
        for problem in problems:
            problem.require_parameters(settings.free)
        if "flux" not in settings.free and not float(problems[0].start.get("flux", 0.0)):
            raise IncompatibleSetupError(
                "flux is not free and start has no 'flux': how bright is the star? Add 'flux' to "
                "free, or give start={'flux': light that the pupil collects}"
            )
        jacobians = 4.0 * len(problems) * (len(basis) + settings.prior.amplitude_modes(basis))
        jacobians *= math.prod(problems[0].observation.shape)
        responses = ResponseCache(
            problems[0].model,
            basis,
            npix=settings.response_npix,
            wavelengths=settings.response_wavelengths,
            relinearise=settings.relinearise,
            keep=len(problems),
            memory=min(_RESPONSES, settings.memory_beside(jacobians)),
            progress=progress,
        )
        self.objective = Objective(
            [Forward(problem, responses) for problem in problems], settings.robust
        )
        self.equations = EquationsCache(self.objective, responses)

    def priors_of(self, settings: GaussNewton) -> ModePriors:
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
        """Take one damped step.

        Parameters
        ----------
        state : State
        carried : StepState
            Of the step before.
        kappa : float
            Assumed error of the star model, as a fraction of the star.
        modes : int
            Number of leading wavefront modes that are free; 0 for alignment only.

        Returns
        -------
        state : State
            Unchanged if no step lowers the penalised chi-squared.
        gain : float
            Decrease, or expected decrease, of the penalised chi-squared per pixel.
        carried : StepState
            For the next step.
        """
        needs_accurate = carried.needs_accurate and kappa <= carried.kappa and kappa < _FAR
        carried = replace(carried, kappa=kappa, needs_accurate=needs_accurate)
        # Without the wavefront, derivatives are cheap and always accurate.
        may_repeat = self.settings.accurate_steps and modes > 0
        if not (may_repeat and needs_accurate):
            taken, gain, carried = self._quick_step(state, carried, kappa, modes, may_repeat)
            if taken is not None:
                return Step(taken, gain, carried)
            carried = replace(carried, damping=0.0, needs_accurate=True)
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
    # the step is that of Gauss and Newton. The ratio of the actual decrease of chi-squared to
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
        is_stale = may_repeat and equations.error > 0 and kappa < _FAR
        noise = objective.errors(state, kappa, objective.robust)
        fits_scales = self.settings.prior.fit_scales
        damping = 0.0 if fits_scales else carried.damping
        update = self._solve(
            unknowns, equations, carried.priors, fit_scales=fits_scales, damping=damping
        )
        priors = replace(carried.priors, scales=update.scales)
        carried = replace(carried, priors=priors)
        # Whether no step gains anything is for the derivatives of the model itself to say.
        unmoved = None if may_repeat else state
        expected = self._predicted_gain(unknowns, equations, priors, update.step)
        if expected < self.settings.tolerance * objective.pixels:
            # The gain is too small for another linearisation.
            return unmoved, expected / objective.pixels, carried
        before = self._cost(state, noise, priors)
        for _ in range(_TRIES):
            if carried.damping != damping:
                damping = carried.damping
                update = self._solve(unknowns, equations, priors, damping=damping)
                expected = self._predicted_gain(unknowns, equations, priors, update.step)
            trial = self._moved(state, update.step - equations.current)
            after = self._cost(trial, noise, priors)
            if after < before and trial.has_star:
                ratio = (before - after) / expected
                poor = is_stale and ratio < _POOR
                carried = replace(carried, needs_accurate=True) if poor else carried.relaxed(ratio)
                return trial, (before - after) / objective.pixels, carried
            if is_stale:
                return None, 0.0, carried
            carried = replace(carried, damping=max(_HARDER * carried.damping, _LEAST))
        return unmoved, 0.0, carried

    def _accurate_step(self, state: State, carried: StepState, kappa: float, modes: int) -> Step:
        """Take a step, or a part of it, with derivatives of the model itself."""
        objective = self.objective
        noise = objective.errors(state, kappa, objective.robust)
        before = self._cost(state, noise, carried.priors)
        derivatives = ModelDerivatives(objective, state, noise)
        offset = state.vector - state.unknowns.initial()
        deviation = self.prior_deviation(state.unknowns, carried.priors)
        enough = self.settings.tolerance * objective.pixels / 2
        # Equations of an earlier state precondition nearly as well, and new ones take longer than
        # the step itself.
        for is_new in (False, True):
            equations = None if is_new else self.equations.preconditioner(state, kappa, modes)
            if equations is None:
                equations = self.equations.about(state, kappa, modes, objective.robust, _ACCURATE)
            step, settled = accurate_step(
                derivatives, equations.curvature, offset, deviation, enough
            )
            self.equations.judge(preconditions=settled)
            for part in _PARTS:
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
        """Return the linear model about a state.

        Parameters
        ----------
        state : State
        priors : ModePriors
        kappa : float
            Assumed error of the star model, as a fraction of the star.
        modes : int
            Number of leading wavefront modes that are unknowns.
        robust : float
            Residual, in standard deviations, of half weight; inf for the full weights of all
            pixels.
        final : bool
            Whether errors will be computed from it, for which derivatives must be accurate.
        """
        unknowns, equations = state.unknowns, self.equations.last
        count = unknowns.with_modes(modes)
        allowed = _FINAL if final else _ACCURATE
        allowed = allowed if self.settings.accurate_steps else self.settings.relinearise
        if (
            equations is None
            or equations.error > allowed
            or equations.state is not state
            or not equations.has_weights
            or (equations.kappa, equations.robust) != (kappa, robust)
            or len(equations.current) != count
            or (final and equations.bright_companions != state.bright_companions())
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

    def posterior(self, state: State, priors: ModePriors) -> EvidenceUpdate:
        """Return the errors of all unknowns of the last linear model, which is about `state`."""
        equations = self.equations.last
        assert equations is not None
        assert equations.state is state
        return self._solve(state.unknowns, equations, priors, errors=True)

    def companion_snr(self, state: State, priors: ModePriors) -> Tensor:
        """S/N of the companions of a state, (companions,).

        The errors are those of the last linearisation; infinite S/N if it had other companions.
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
        update = solve_with_evidence(
            (curvature * unit[:, None]).mul_(unit),
            equations.gradient * unit,
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
        """Penalised chi-squared.

        With weights that were made robust about the state before a step, a step that lowers it also
        lowers Cauchy's loss.
        """
        deviation = self.prior_deviation(state.unknowns, priors)
        offset = (state.vector - state.unknowns.initial()) / deviation
        return self.objective.chi2(state, noise) + float((offset**2).sum())

    def _predicted_gain(
        self, unknowns: Unknowns, equations: NormalEquations, priors: ModePriors, step: Tensor
    ) -> float:
        """Decrease of the penalised chi-squared if the model were linear."""
        precision = self.prior_deviation(unknowns, priors)[: len(step)] ** -2
        curvature, current = equations.curvature, equations.current

        def quadratic(x: Tensor) -> float:
            return float(x @ (curvature @ x) - 2 * equations.gradient @ x + precision @ x**2)

        return max(quadratic(current) - quadratic(step), 1e-12)
