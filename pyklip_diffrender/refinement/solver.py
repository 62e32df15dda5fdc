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
from dataclasses import replace

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

__all__ = ["Solver"]

_TRIES = 7
"""Largest number of attempts at a step, with increasing damping."""

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


class Solver:
    """Takes damped Gauss-Newton steps with a given basis.

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
    priors : ModePriors
        Their scales are updated in every step unless they are fixed.
    damping : float
        Levenberg-Marquardt damping of the next step.

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
        self._responses = responses = ResponseCache(
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
        self.priors = ModePriors.of(settings, basis, [each.observation for each in problems])
        self.damping = 0.0
        self._kappa, self._needs_accurate = math.inf, False
        self._equations: NormalEquations | None = None
        self._has_poor_equations = False

    def first_unknowns(self) -> Unknowns:
        """The unknowns, with starting values, before companions are added."""
        return first_unknowns(self.objective.forwards, self.settings, self.basis, self.priors)

    def prior_deviation(self, unknowns: Unknowns) -> Tensor:
        """Prior standard deviations of all unknowns."""
        return torch.cat([unknowns.prior_deviation(), self.priors.deviation])

    def step(self, state: State, kappa: float, modes: int) -> tuple[State, float]:
        """Take one damped step.

        Parameters
        ----------
        state : State
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
        """
        if kappa > self._kappa or kappa >= _FAR:
            self._needs_accurate = False
        self._kappa = kappa
        # Without the wavefront, derivatives are cheap and always accurate.
        may_repeat = self.settings.accurate_steps and modes > 0
        if not (may_repeat and self._needs_accurate):
            taken = self._quick_step(state, kappa, modes, may_repeat)
            if taken is not None:
                return taken
            self._needs_accurate, self.damping = True, 0.0
        return self._accurate_step(state, kappa, modes)

    def _quick_step(
        self, state: State, kappa: float, modes: int, may_repeat: bool
    ) -> tuple[State, float] | None:
        """Take a step with the derivatives that there are; None if it needs better ones."""
        unknowns, objective = state.unknowns, self.objective
        equations = self._linearise(
            state, kappa, modes, objective.robust, self.settings.relinearise
        )
        # New derivatives that fail show that the model is not linear, as do large steps.
        is_stale = may_repeat and self._responses.farthest > 0 and kappa < _FAR
        noise = objective.errors(state, kappa, objective.robust)
        fits_scales = self.settings.prior.fit_scales
        damping = 0.0 if fits_scales else self.damping
        update = self._solve(unknowns, equations, fit_scales=fits_scales, damping=damping)
        self.priors.scales = update.scales
        expected = self._predicted_gain(unknowns, equations, update.step)
        if expected < self.settings.tolerance * objective.pixels:
            # The gain is too small for another linearisation.
            return None if may_repeat else (state, expected / objective.pixels)
        before = self._cost(state, noise)
        for _ in range(_TRIES):
            if self.damping != damping:
                damping = self.damping
                update = self._solve(unknowns, equations, damping=self.damping)
                expected = self._predicted_gain(unknowns, equations, update.step)
            trial = self._moved(state, update.step - equations.current)
            after = self._cost(trial, noise)
            if after < before and trial.has_star:
                ratio = (before - after) / expected
                if is_stale and ratio < _POOR:
                    self._needs_accurate = True
                else:
                    self._relax(ratio)
                return trial, (before - after) / objective.pixels
            if is_stale:
                return None
            self.damping = max(6 * self.damping, 0.05)
        return None if may_repeat else (state, 0.0)

    def _accurate_step(self, state: State, kappa: float, modes: int) -> tuple[State, float]:
        """Take a step, or a part of it, with derivatives of the model itself."""
        objective = self.objective
        noise = objective.errors(state, kappa, objective.robust)
        before = self._cost(state, noise)
        derivatives = ModelDerivatives(objective, state, noise)
        offset = state.vector - state.unknowns.initial()
        deviation = self.prior_deviation(state.unknowns)
        enough = self.settings.tolerance * objective.pixels / 2
        # Equations of an earlier state precondition nearly as well, and new ones take longer than
        # the step itself.
        for is_new in (False, True):
            if is_new or not self._can_precondition(state, kappa, modes):
                self._linearise(state, kappa, modes, objective.robust, _ACCURATE)
            equations = self._equations
            assert equations is not None
            step, settled = accurate_step(
                derivatives, equations.curvature, offset, deviation, enough
            )
            self._has_poor_equations = not settled
            for part in _PARTS:
                trial = self._moved(state, part * step)
                after = self._cost(trial, noise)
                if after < before and trial.has_star:
                    return trial, (before - after) / objective.pixels
            if equations.state is state:
                break
            del equations  # The next ones are as large.
        return state, 0.0

    def _can_precondition(self, state: State, kappa: float, modes: int) -> bool:
        """Whether the last equations can precondition an accurate step from a state."""
        equations = self._equations
        return (
            equations is not None
            and not self._has_poor_equations
            and not equations.kappa > _SIMILAR * kappa  # It is NaN where weights have changed.
            and self._responses.farthest <= _ACCURATE
            and len(equations.current) == state.unknowns.with_modes(modes)
        )

    def _linearise(
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
        jacobians: list[Tensor] = []
        equations = self._equations
        if (
            equations is not None
            and equations.state is state
            and self._responses.farthest <= allowed
            and len(equations.current) == state.unknowns.with_modes(modes)
            and equations.bright_companions == bright
        ):
            jacobians = [frame.jacobian for frame in equations.frames]
        else:
            self._responses.relinearise, self._responses.farthest = allowed, 0.0
            self._responses.keep = len(state.points) + bright
        equations = self._equations = None  # The next ones are as large.
        self._equations = linearise(
            self.objective, state, kappa, modes, robust, jacobians, outweighing
        )
        self._has_poor_equations = False
        return self._equations

    def _moved(self, state: State, step: Tensor) -> State:
        """The state after a step of the leading unknowns, within the bounds of all parameters."""
        return self.objective.at(state.unknowns, state.unknowns.stepped(state.vector, step))

    def _forget_weights(self) -> None:
        """Keep the Jacobians of the last equations, but not what follows from their weights."""
        if self._equations is not None:
            self._equations = replace(self._equations, kappa=math.nan)

    def leave_out(self, pixels: Sequence[Tensor]) -> None:
        """Leave out pixels from now on; a mask, (ny, nx), for every frame."""
        for forward, mask in zip(self.objective.forwards, pixels, strict=True):
            forward.problem.leave_out(mask)
        self._forget_weights()

    def linear_model(
        self, state: State, kappa: float, modes: int, robust: float, *, final: bool = True
    ) -> LinearModel:
        """Return the linear model about a state.

        Parameters
        ----------
        state : State
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
        unknowns, equations = state.unknowns, self._equations
        count = unknowns.with_modes(modes)
        allowed = _FINAL if final else _ACCURATE
        allowed = allowed if self.settings.accurate_steps else self.settings.relinearise
        if (
            equations is None
            or self._responses.farthest > allowed
            or equations.state is not state
            or (equations.kappa, equations.robust) != (kappa, robust)
            or len(equations.current) != count
            or (final and equations.bright_companions != state.bright_companions())
        ):
            del equations
            equations = self._linearise(state, kappa, modes, robust, allowed, final=final)
        return LinearModel(
            unknowns=unknowns.labels()[:count],
            frames=equations.frames,
            vector=state.vector[:count],
            mean=unknowns.initial()[:count],
            deviation=self.prior_deviation(unknowns)[:count],
            curvature=equations.curvature,
        )

    def posterior(self, state: State) -> EvidenceUpdate:
        """Return the errors of all unknowns of the last linear model, which is about `state`."""
        assert self._equations is not None
        assert self._equations.state is state
        return self._solve(state.unknowns, self._equations, errors=True)

    def companion_snr(self, state: State) -> Tensor:
        """S/N of the companions of a state, (companions,).

        The errors are those of the last linearisation; infinite S/N if it had other companions.
        """
        equations, unknowns = self._equations, state.unknowns
        where = unknowns.where("companions")
        contrasts = state.vector[where][::3]
        if not len(contrasts) or equations is None or equations.state.unknowns is not unknowns:
            return torch.full_like(contrasts, math.inf)
        variance = self._solve(unknowns, equations, errors=True).variance
        assert variance is not None
        return contrasts / variance[where][::3].sqrt()

    def _solve(
        self,
        unknowns: Unknowns,
        equations: NormalEquations,
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
            fixed = torch.cat([fixed, self.priors.amplitude])
        # Unknowns differ by many powers of ten, so the system is solved in scaled units.
        unit = torch.ones(len(curvature), dtype=torch.float64)
        unit[: len(fixed)] = curvature.diagonal()[: len(fixed)].clamp(min=1e-300) ** -0.5
        update = solve_with_evidence(
            (curvature * unit[:, None]).mul_(unit),
            equations.gradient * unit,
            self.priors.shape[:modes],
            self.priors.group[:modes],
            self.priors.scales,
            fixed / unit[: len(fixed)],
            iterations=1 if fit_scales and modes else 0,
            damping=damping,
            current=equations.current / unit,
            errors=errors,
        )
        return update.in_units(unit)

    def _cost(self, state: State, noise: Noise) -> float:
        """Penalised chi-squared.

        With weights that were made robust about the state before a step, a step that lowers it also
        lowers Cauchy's loss.
        """
        offset = (state.vector - state.unknowns.initial()) / self.prior_deviation(state.unknowns)
        return self.objective.chi2(state, noise) + float((offset**2).sum())

    def _predicted_gain(
        self, unknowns: Unknowns, equations: NormalEquations, step: Tensor
    ) -> float:
        """Decrease of the penalised chi-squared if the model were linear."""
        precision = self.prior_deviation(unknowns)[: len(step)] ** -2
        curvature, current = equations.curvature, equations.current

        def quadratic(x: Tensor) -> float:
            return float(x @ (curvature @ x) - 2 * equations.gradient @ x + precision @ x**2)

        return max(quadratic(current) - quadratic(step), 1e-12)

    def _relax(self, ratio: float) -> None:
        """Adapt the damping to the ratio of actual to predicted gain."""
        if ratio > 0.7:
            self.damping = self.damping / 4 if self.damping > 1e-3 else 0.0
        elif ratio < 0.3:
            self.damping = max(2.5 * self.damping, 0.05)
