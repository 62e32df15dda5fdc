"""Schedule of a fit: alignment first, then the wavefront, with a decreasing model error.

The star is bright, so that the first residuals are many times larger than the photon noise, and
undamped steps would diverge. Therefore the noise is taken as sqrt(sigma^2 + (kappa star)^2). The
model error kappa, a fraction of the star, begins at the value for which chi-squared per pixel is 1
and decreases to 0, or to the value that the final residual requires:

1. `Annealing._with_dominant` adds a companion that outshines what the mask leaves of the star, and
   `Annealing._align` fits alignment and levels until a step gains little, and adds companions that
   are significant in the residual.
2. `Annealing._anneal` fits the wavefront as well, and lowers kappa from step to step. Where the fit
   stalls because of a bright companion, `Annealing._restart` adds that and goes back to the
   alignment.
3. `Annealing._finish` leaves out bad pixels, and widens a prior that is too narrow.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Mapping, Sequence
from typing import Any

from pyklip_diffrender.io.progress import ProgressBar
from pyklip_diffrender.linear.frames import Unknown
from pyklip_diffrender.refinement.companions import bright_companions, with_dominant
from pyklip_diffrender.refinement.conclusion import conclude
from pyklip_diffrender.refinement.course import NOTHING, Course
from pyklip_diffrender.refinement.fit_result import Refinement
from pyklip_diffrender.refinement.mode_priors import ModePriors, count_modes_below
from pyklip_diffrender.refinement.objective import State
from pyklip_diffrender.refinement.outliers import isolated_outliers
from pyklip_diffrender.refinement.problem import Problem
from pyklip_diffrender.refinement.settings import GaussNewton
from pyklip_diffrender.refinement.solver import Solver
from pyklip_diffrender.refinement.status import Status
from pyklip_diffrender.scene.objects import Planet
from pyklip_diffrender.wavefront.bases import Basis

__all__ = ["Annealing"]

_log = logging.getLogger(__name__)

_EXPLAINED = 1.2
"""Chi-squared per pixel below which the noise explains the residual."""

_NEGLIGIBLE = 1e-3
"""Model error, as a fraction of the star, below which annealing ends."""

_COARSE = 0.01
"""Model error above which modes up to `_FEW_CYCLES` are sufficient."""

_FEW_CYCLES = 14.0

_NEAR = 0.003
"""Model error below which a new companion has hardly biased the wavefront.

Planets of contrast 5e-7 to 2e-6 were found at a model error of 0.001 to 0.0026. Side lobes of a
planet of contrast 1e-4 at 0.3 arcsec were mistaken for planets at 0.005 to 0.1.
"""

_BRIGHT = 8.0
"""S/N of a companion, in units of the scatter, that is added when the fit of the wavefront stalls.

Without companions, peaks reached 6 (drifts of 40 to 400 h); companions that stalled a fit had 12.
"""

_FAINT = 5.0
"""S/N of a companion below which the last steps of a fit do without it, that of a candidate. Errors
of the wavefront had less than 1 in real frames."""

_MOST_BRIGHT = 8
"""Largest number of companions that a fit may add in this way."""

_ALIGNED = 0.05
"""Gain in chi-squared per pixel below which the wavefront is fitted as well."""

_OUTSHONE = 1.0
"""Model error, as a fraction of the star, from which something may outshine the star."""

_ANNEALING = 0.6
"""Largest ratio of kappa in successive steps."""

_SEARCHES = 6
"""Largest number of searches for bad pixels at one state: a bright one hides fainter ones beside
it."""

_ROUNDS = 6
"""Largest number of states at which bad pixels are searched."""

_STEPS = 4
"""Largest number of steps after pixels were left out or the noise has changed, which both do little
to a fit with robust weights."""

_COMPANION_STEPS = 4
"""Largest number of steps that fit a new companion alone."""

_WIDENINGS = 3
"""Largest number of times that a prior is widened. Two rolls of HIP 17695 in F444W needed two."""


class Annealing:
    """One fit with a given basis.

    Parameters
    ----------
    problems : sequence of Problem
        One for each frame.
    settings : GaussNewton
    basis : Basis
    warm : mapping of Unknown to float, optional
        Final values of an earlier fit. The wavefront is then free from the first step.
    progress : bool
        Show progress bars.
    """

    def __init__(
        self,
        problems: Sequence[Problem],
        settings: GaussNewton,
        basis: Basis,
        warm: Mapping[Unknown, float] | None,
        progress: bool,
    ) -> None:
        self.settings, self.basis, self.progress = settings, basis, progress
        self.problems = list(problems)
        self.solver = Solver(problems, settings, basis, progress)
        self.objective = self.solver.objective
        self._few_modes = count_modes_below(basis, _FEW_CYCLES)
        unknowns = self.solver.first_unknowns()
        self._begin = self.objective.at(
            unknowns, unknowns.initial() if warm is None else unknowns.warm(warm)
        )
        self._is_warm = warm is not None
        self._first_scales = self.solver.priors.scales
        self.history: list[dict[str, Any]] = []

    def run(self) -> Refinement:
        """Fit the alignment, then alignment and wavefront; return the best iterate."""
        began = time.perf_counter()
        course, converged = self._beginning(), False
        with ProgressBar("wavefront", shown=self.progress) as bar:
            while course.remaining and not converged:
                gain = self._step(course)
                bar.update(chi2=course.chi2)
                converged = (self._anneal if course.modes else self._align)(course, gain)
        state, status = self._finish(course.best, converged)
        return conclude(
            self.solver,
            self.settings,
            state,
            self._unexplained(state),
            status,
            history=self.history,
            seconds=time.perf_counter() - began,
        )

    def _beginning(self) -> Course:
        """Where the schedule begins: a fit that continues another one has all its unknowns."""
        settings, state = self.settings, self._with_dominant(self._begin)
        kappa = max(self.objective.model_error(state), settings.min_model_error)
        if self._is_warm and settings.min_model_error:
            # A larger one would lead away from the solution, and back.
            kappa = settings.min_model_error
        skips_alignment = settings.wavefront and (not settings.free or self._is_warm)
        modes = self._modes_for(kappa) if skips_alignment else 0
        return Course(state, state, state, kappa, modes, settings.max_iterations)

    def _step(self, course: Course) -> float:
        """Take a step; return the decrease of the penalised chi-squared per pixel."""
        course.remaining -= 1
        course.state, gain = self.solver.step(course.state, course.kappa, course.modes)
        course.error = self.objective.model_error(course.state)
        course.chi2 = self.objective.chi2_per_pixel(course.state)
        if (course.error, course.chi2) < course.least:
            course.best, course.least = course.state, (course.error, course.chi2)
        self._record(course.kappa, course.modes, course.chi2, course.error, gain)
        return gain

    def _align(self, course: Course, gain: float) -> bool:
        """Choose what follows a step of the alignment; True if the fit has converged."""
        floor = self.settings.min_model_error
        course.kappa = max(floor, min(course.kappa, course.error))
        bright = self._significant(course) if gain < _ALIGNED else []
        if bright:
            course.state = self._with_companions(course.state, bright)
            return False
        if gain < _ALIGNED and self.settings.wavefront:
            course.aligned, course.modes = course.state, self._modes_for(course.kappa)
            # The damping of the alignment does not apply to the wavefront.
            self.solver.damping = 0.0
            return False
        return gain < self.settings.tolerance

    def _anneal(self, course: Course, gain: float) -> bool:
        """Choose what follows a step of the wavefront; True if the fit has converged."""
        floor = self.settings.min_model_error
        stalled = course.error > max(course.kappa, _NEGLIGIBLE)
        bright = self._stalling(course) if stalled else []
        if bright:
            self._restart(course, bright)
            return False
        is_last = course.kappa <= floor and course.modes == len(self.basis)
        if is_last and self._drop_faint(course):
            return False
        if gain < self.settings.tolerance and is_last:
            return True
        course.kappa = min(_ANNEALING * course.kappa, course.error / 2)
        if course.kappa < max(_NEGLIGIBLE, floor):
            course.kappa = floor
        course.modes = self._modes_for(course.kappa)
        return False

    def _restart(self, course: Course, added: Sequence[Planet]) -> None:
        """Go on with more companions: from here near the solution, else from the alignment.

        Near the solution the model is linear, so that further steps remove the bias of the
        wavefront.
        """
        is_close = course.error < _NEAR
        course.state = self._with_companions(course.state if is_close else course.aligned, added)
        course.least, course.remaining = NOTHING, self.settings.max_iterations
        course.may_drop, self.solver.damping = False, 0.0
        if is_close:
            # Images are less linear in positions than in the wavefront, and steps of these few
            # unknowns are cheap.
            course.state = self._settled(course.state, _COMPANION_STEPS, modes=0)
        else:
            self.solver.priors.scales = self._first_scales
            course.modes = 0
            floor = self.settings.min_model_error
            course.kappa = max(self.objective.model_error(course.state), floor)
        course.best = course.state

    def _drop_faint(self, course: Course) -> bool:
        """Go on without companions of the alignment that were errors of the wavefront.

        They would double the time of every step. The search finds a faint source without them.
        """
        is_close = course.error <= max(_NEAR, self.settings.min_model_error)
        if not (course.may_drop and is_close):
            return False
        snr = self.solver.companion_snr(course.state)
        faint = snr < _FAINT
        faint[: len(self._begin.unknowns.frames[0].companions)] = False
        if not bool(faint.any()):
            return False
        _log.info("companions of S/N %s are dropped", snr[faint].tolist())
        fewer = course.state.unknowns.without_companions(faint, course.state.vector)
        course.state = course.best = self.objective.at(*fewer)
        course.least = NOTHING
        return True

    def _finish(self, best: State, converged: bool) -> tuple[State, Status]:
        """Correct what the residual of the best iterate shows to be wrong."""
        best = self._without_outliers(best)
        if converged and self.settings.widen_prior:
            best = self._with_wider_prior(best)
        if best.flux <= 0:
            return best, Status.DIVERGED
        if not converged:
            return best, Status.ITERATION_LIMIT
        explained = self.objective.chi2_per_pixel(best) < _EXPLAINED
        return best, Status.CONVERGED if explained else Status.MODEL_MISMATCH

    def _without_outliers(self, state: State) -> State:
        """Leave out bad pixels that stand alone, and go on without them."""
        for _ in range(_ROUNDS):
            if not self._leave_out_outliers(state):
                break
            state = self._settled(state, _STEPS)
        return state

    def _with_wider_prior(self, state: State) -> State:
        """Raise the scales of a prior that is too narrow, and go on with them."""
        for _ in range(_WIDENINGS):
            if self.objective.chi2_per_pixel(state) >= _EXPLAINED:
                break
            self.solver.linear_model(state, 0.0, self._all_modes, math.inf, final=False)
            ratios = self.solver.priors.ratios_if_fixed(self.solver.posterior(state), self.settings)
            if not self.solver.priors.are_improbable(ratios):
                break
            _log.info("the wavefront is improbable under its prior, by factors %s", ratios)
            self.settings = self.settings.with_wider_priors(ratios)
            frames = len(self.problems)
            self.solver.priors = ModePriors.of(self.settings, self.basis, frames)
            state = self._without_outliers(self._settled(state, self.settings.max_iterations))
        return state

    def _settled(self, state: State, steps: int, modes: int | None = None) -> State:
        """Take steps, by default of all modes, until they gain little."""
        modes = self._all_modes if modes is None else modes
        kappa = max(self._unexplained(state), self.settings.min_model_error)
        for _ in range(steps):
            state, gain = self.solver.step(state, kappa, modes)
            error, chi2 = self.objective.model_error(state), self.objective.chi2_per_pixel(state)
            self._record(kappa, modes, chi2, error, gain)
            if gain < self.settings.tolerance:
                break
        return state

    def _leave_out_outliers(self, state: State) -> bool:
        """Leave out bad pixels that stand alone; False if there are none."""
        for k in range(_SEARCHES):
            kappa = self._unexplained(state)
            linear = self.solver.linear_model(state, kappa, self._all_modes, math.inf, final=False)
            outliers = isolated_outliers(self.objective, state, linear)
            del linear  # The next one is as large.
            if not any(bool(each.any()) for each in outliers):
                return k > 0
            self.solver.leave_out(outliers)
        return True

    @property
    def _all_modes(self) -> int:
        return len(self.basis) if self.settings.wavefront else 0

    def _unexplained(self, state: State) -> float:
        """The model error, as a fraction of the star, if the noise does not explain the data."""
        explained = self.objective.chi2_per_pixel(state) < _EXPLAINED
        return 0.0 if explained else self.objective.model_error(state)

    def _record(self, kappa: float, modes: int, chi2: float, error: float, gain: float) -> None:
        record = {
            "iteration": len(self.history),
            "wavefront": modes > 0,
            "kappa": kappa,
            "chi2_per_pixel": chi2,
            "model_error": error,
            "gain": gain,
            "damping": self.solver.damping,
        }
        self.history.append(record)
        _log.debug(
            "step %d: chi2 %.4g per pixel, model error %.2g %% of the star, gain %.2g"
            ", damping %.2g",
            record["iteration"], chi2, 100 * error, gain, self.solver.damping,
        )  # fmt: skip

    def _modes_for(self, kappa: float) -> int:
        """Number of leading modes to fit while the model error is kappa."""
        joint_fit = len(self.problems) > 1
        amplitude = len(self.solver.priors.amplitude) > 0
        coarse = self.settings.coarse_first and not joint_fit and not amplitude
        fine = kappa <= max(_COARSE, self.settings.min_model_error)
        return self._few_modes if coarse and not fine else len(self.basis)

    def _room(self, course: Course) -> int:
        """Number of companions that may still be added."""
        return self.settings.max_companions - len(course.state.unknowns.frames[0].companions)

    def _significant(self, course: Course) -> list[Planet]:
        """Companions in the residual of the alignment."""
        most, threshold = self._room(course), self.settings.companion_threshold
        if most < 1 and self.settings.companions_if_stalled and self.settings.wavefront:
            # Brighter than all that the wavefront can have left.
            most, threshold = min(1, most + _MOST_BRIGHT), _BRIGHT
        return bright_companions(
            self.objective, course.state, course.kappa, most=most, threshold=threshold
        )

    def _with_dominant(self, state: State) -> State:
        """Add a companion that outshines what the mask leaves of the star, if there is one.

        Without it the star's flux would follow the companion's light.
        """
        error = self.objective.model_error(state)
        is_fixed = self._is_warm or not self.settings.companions_if_stalled
        if error < _OUTSHONE or is_fixed:
            return state
        trial = with_dominant(self.objective, state, error)
        if trial is not state:
            trial = self._settled(trial, _COMPANION_STEPS, modes=0)
            self.solver.damping = 0.0
        if self.objective.model_error(trial) > error / 2:
            return state
        _log.info("a source outshines the star, and is fitted with it")
        return trial

    def _stalling(self, course: Course) -> list[Planet]:
        """A companion in the residual of a fit of the wavefront that stalled.

        One at a time, because the side lobes of a bright companion are peaks as well.
        """
        if not self.settings.companions_if_stalled:
            return []
        most = min(1, self._room(course) + _MOST_BRIGHT)
        return bright_companions(
            self.objective, course.state, course.error, most=most, threshold=_BRIGHT
        )

    def _with_companions(self, state: State, added: Sequence[Planet]) -> State:
        _log.info("possible sources, fitted with the star: %s", added)
        return self.objective.at(*state.unknowns.with_companions(added, state.vector))
