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
   alignment; where it stalls because of bad pixels, these are left out.
3. `Annealing._finish` leaves out the other bad pixels, and gives a prior that is too narrow or too
   wide another size.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from pyklip_diffrender.io.progress import ProgressBar
from pyklip_diffrender.linear.model import Unknown
from pyklip_diffrender.refinement.conclusion import conclude, derivatives_of
from pyklip_diffrender.refinement.fit_result import Refinement, Status
from pyklip_diffrender.refinement.forward import (
    Problem,
    State,
)
from pyklip_diffrender.refinement.residual import (
    INNER,
    bright_companions,
    isolated_outliers,
    with_dominant,
)
from pyklip_diffrender.refinement.settings import FitSettings, ModePriors
from pyklip_diffrender.refinement.solver import Solver, StepState
from pyklip_diffrender.scene.objects import Planet
from pyklip_diffrender.wavefront.bases import Basis
from pyklip_diffrender.wavefront.priors import EvidenceUpdate

_BAD_PIXEL_STATES = 6
"""Largest number of states at which bad pixels are searched."""

NOTHING = (math.inf, math.inf)
"""Model error and chi-squared of no state."""


@dataclass
class Course:
    """Where a fit is in its schedule."""

    state: State
    best: State  # The state of the least model error.
    aligned: State  # The state at the end of the alignment.
    carried: StepState  # What the last step hands on to the next one.
    # Settings of the fit, with the size of the drift between frames once it is measured.
    settings: FitSettings
    kappa: float  # Model error that the next step assumes.
    modes: int  # Number of leading wavefront modes that are free; 0 for the alignment.
    remaining: int  # Number of steps that may follow.
    error: float = math.inf  # Model error of `state`.
    chi2: float = math.inf  # Chi-squared per pixel of `state`.
    least: tuple[float, float] = NOTHING  # Model error and chi-squared per pixel of `best`.
    # Companions may not be dropped after some were added to a fit that had stalled, or it might add
    # and drop them for ever.
    may_drop: bool = True
    outlier_searches: int = _BAD_PIXEL_STATES  # Number of searches for bad pixels that may follow.
    may_settle: bool = True  # Whether the priors have not been measured near the solution.


_log = logging.getLogger(__name__)

_EXPLAINED_CHI2 = 1.2
"""Chi-squared per pixel below which the noise explains the residual."""

_LAST_MODEL_ERROR = 1e-3
"""Model error, as a fraction of the star, below which annealing ends."""

_NEW_COMPANION_MODEL_ERROR = 0.003
"""Model error below which a new companion has hardly biased the wavefront.

Planets of contrast 5e-7 to 2e-6 were found at a model error of 0.001 to 0.0026. Side lobes of a
planet of contrast 1e-4 at 0.3 arcsec were mistaken for planets at 0.005 to 0.1.
"""

_STALLED_COMPANION_SNR = 8.0
"""S/N, in units of the scatter, above which a companion is added when the wavefront's fit stalls.

Without companions, peaks reached 6 (drifts of 40 to 400 h). Companions that stalled a fit had 12.
"""

_FIELD_COMPANION_SNR = 7.0
_FIELD_COMPANION_ARCSEC = 0.7
"""S/N and separation, arcsec, of further companions that are added to an aligned star. In pairs of
real rolls, peaks reached 9 within 0.6 arcsec and 5 beyond; two neighbours of 1e-3 of the star's
flux had 34 and 17, and the last of ten that are added in a crowded field 9."""

_SOURCES_MODEL_ERROR = 0.12
"""Model error, as a fraction of the star, that only sources leave where the wavefront is free. The
disk of AU Mic leaves 0.11 at most, and ten neighbours up to 8e-4 of the star's flux 0.15 to 0.3."""

_DROPPED_COMPANION_SNR = 5.0
"""S/N below which the last steps of a fit leave out a companion; candidates have as much. Errors
of the wavefront had an S/N below 1 in real frames."""

_MOST_ADDED_COMPANIONS = 20
"""Largest number of bright companions that a fit may add."""

_ALIGNED_CHI2_GAIN = 0.05
"""Gain in chi-squared per pixel below which the wavefront is fitted as well."""

_OUTSHONE_MODEL_ERROR = 1.0
"""Model error, as a fraction of the star, from which something may outshine the star."""

_STALLED_CHI2_GAIN = 0.01
"""Gain of a step in chi-squared per pixel below which bad pixels are looked for. An unflagged bad
pixel can keep the model error at 3 %, and the fit would take six more steps that gain nothing."""

_RESTART_MODEL_ERROR = 0.01
"""Model error from which a fit goes back to the alignment after bad pixels were left out, if these
pixels made more than half of chi-squared."""

_KAPPA_STEP_RATIO = 0.6
"""Largest ratio of kappa in successive steps."""

_BAD_PIXEL_SEARCHES = 6
"""Largest number of searches for bad pixels at one state: a bright one hides fainter ones beside
it."""

_CONTINUED_STEPS = 4
"""Largest number of steps after pixels were left out or the noise has changed, which both do little
to a fit with robust weights."""

_COMPANION_STEPS = 4
"""Largest number of steps that fit a new companion alone."""

_MOST_WIDENINGS = 3
"""Largest number of times that a prior is widened. Two rolls of HIP 17695 in F444W needed two."""

_FOREIGN = 2.0
"""Chi-squared per pixel above which frames show more than a star, such as a disk, which a wider
prior would take for an error of the wavefront."""

_NARROWED_SIZE_RATIO = 0.8
"""Size of the fitted wavefront, relative to its prior, below which the prior is narrowed."""

_MOST_NARROWINGS = 3
_SOLUTIONS = 8
_SAME_SIZE = 0.05
_SIZE_SLOPE = 0.2
"""Largest number of times that a prior is narrowed; largest number of solutions of a linear model
from which the size of the wavefront follows; negligible logarithm of that size; and least change of
the logarithm that is believed, relative to the change of the scale."""

_PRIOR_NAMES = ("amplitude", "modes", "drift")
"""Names of the unknowns that have a prior of `ModePriors`."""

_PRIOR_MEASURED_AFTER_STEPS = 1
"""Number of steps of a fit that continues another one, after which the sizes of the wavefront and
of the drift between frames are measured for the first time."""

_DRIFT_STEPS = 2
_SAME_DRIFT = 0.25
"""Largest number of steps after the last measurement of the drift's size, and relative change of
the size that needs no step."""


@dataclass(frozen=True)
class _Fitted:
    """The end of a fit: its state, what its last step carries, and its settings.

    The priors in the settings differ from the priors at the start where the data changed them.
    """

    state: State
    carried: StepState
    settings: FitSettings


# How the model error decreases. With the data d, the star s, and the noise sigma of a pixel, the
# model error is the fraction e of the star for which chi-squared per pixel is 1,
#
#     mean of (d - s)^2 / (sigma^2 + (e s)^2) = 1,
#
# and 0 if the noise alone explains the residual. A fit with the errors sqrt(sigma^2 + (kappa s)^2)
# takes steps that are right where the linear model is: with kappa = e, all pixels have residuals
# about as large as their errors, so that no bright pixel alone decides. After each step kappa is
#
#     kappa' = min(0.6 kappa, e / 2),
#
# half the error that is left, so that the next step aims at explaining more than the last one did,
# and at most `_KAPPA_STEP_RATIO` times the last kappa, so that it ends even where e no longer
# decreases. A kappa below `_LAST_MODEL_ERROR` is 0 (or `min_model_error`): the noise is then the
# photons' own.


class Annealing:
    """One fit with a given basis.

    `warm` has the final values of an earlier fit; the wavefront is then free from the first step.
    `earlier` is that fit if it had the same frames; its derivatives are then used again.
    """

    def __init__(
        self,
        problems: Sequence[Problem],
        settings: FitSettings,
        basis: Basis,
        warm: Mapping[Unknown, float] | None,
        progress: bool,
        earlier: Refinement | None = None,
    ) -> None:
        self.settings, self.basis, self.progress = settings, basis, progress
        self.problems = list(problems)
        self.solver = Solver(problems, settings, basis, progress)
        self.objective = self.solver.objective
        self._first = StepState(self.solver.priors_of(settings))
        unknowns = self.solver.first_unknowns(self._first.priors)
        self._begin = self.objective.at(
            unknowns, unknowns.initial() if warm is None else unknowns.warm(warm)
        )
        self._is_warm = warm is not None
        self.history: list[dict[str, Any]] = []
        # Whether the sizes of priors are known from these frames, and need not be measured again.
        self._has_scales = False
        if earlier is not None and len(earlier.basis) == len(basis):
            error = self.solver.allowed_error(final=True)
            known = derivatives_of(earlier, self.objective.forwards, error)
            self.solver.equations.start_from(known)
            adapted = earlier.settings.adapt_prior or not settings.adapt_prior
            self._has_scales = earlier.status.calibrated and adapted
            if settings.marginal_flux and earlier.settings.marginal_flux:
                others = sum(each.name not in _PRIOR_NAMES for each in earlier.linear.unknowns)
                determined = max(0.0, earlier.effective_parameters - others)
                priors = replace(self._first.priors, determined=determined)
                self._first = replace(self._first, priors=priors)

    def run(self) -> Refinement:
        """Fit the alignment, then alignment and wavefront; return the best iterate."""
        began = time.perf_counter()
        course, converged = self._beginning(), False
        with ProgressBar("wavefront", shown=self.progress) as bar:
            while course.remaining and not converged:
                gain = self._step(course)
                bar.update(chi2=course.chi2)
                priors = course.carried.priors
                if self._is_warm and not self._has_scales:
                    self._measure_on_the_way(course, gain)
                settled = (self._anneal if course.modes else self._align)(course, gain)
                # With other priors a step may gain more than the last one did.
                converged = settled and course.carried.priors is priors
        end, status = self._finish(replace(self._end_of(course), state=course.best), converged)
        return conclude(
            self.solver,
            end.settings,
            end.carried.priors,
            end.state,
            self._unexplained(end.state),
            status,
            history=self.history,
            seconds=time.perf_counter() - began,
        )

    @staticmethod
    def _end_of(course: Course) -> _Fitted:
        """The end of a fit, if it were to end now."""
        return _Fitted(course.state, course.carried, course.settings)

    def _beginning(self) -> Course:
        """Where the schedule begins: a fit that continues another one has all its unknowns."""
        settings = self.settings
        state, carried = self._with_dominant(self._begin, self._first)
        kappa = max(self.objective.model_error(state), settings.min_model_error)
        if self._is_warm and settings.min_model_error:
            # A larger kappa would lead away from the solution, and back.
            kappa = settings.min_model_error
        skips_alignment = settings.wavefront and (not settings.free or self._is_warm)
        modes = self._all_modes if skips_alignment else 0
        return Course(state, state, state, carried, settings, kappa, modes, settings.max_iterations)

    def _step(self, course: Course) -> float:
        """Take a step; return the decrease of the penalised chi-squared per pixel."""
        course.remaining -= 1
        course.state, gain, course.carried = self.solver.step(
            course.state, course.carried, course.kappa, course.modes
        )
        course.error = self.objective.model_error(course.state)
        course.chi2 = self.objective.chi2_per_pixel(course.state)
        # Where the flux is marginal, steps may raise chi-squared.
        if course.carried.priors.determined or (course.error, course.chi2) < course.least:
            course.best, course.least = course.state, (course.error, course.chi2)
        damping = course.carried.damping
        self._record(course.kappa, course.modes, course.chi2, course.error, gain, damping)
        return gain

    def _align(self, course: Course, gain: float) -> bool:
        """Choose what follows a step of the alignment; True if the fit has converged."""
        floor = self.settings.min_model_error
        course.kappa = max(floor, min(course.kappa, course.error))
        bright = self._significant(course) if gain < _ALIGNED_CHI2_GAIN else []
        if bright:
            course.state = self._with_companions(course.state, bright)
            return False
        if gain < _ALIGNED_CHI2_GAIN and self.settings.wavefront:
            course.aligned, course.modes = course.state, self._all_modes
            # The damping of the alignment does not apply to the wavefront.
            course.carried = course.carried.without_damping()
            return False
        return gain < self.settings.tolerance

    def _anneal(self, course: Course, gain: float) -> bool:
        """Choose what follows a step of the wavefront; True if the fit has converged."""
        floor = self.settings.min_model_error
        stalled = course.error > max(course.kappa, _LAST_MODEL_ERROR)
        bright = self._stalling(course) if stalled else []
        if bright:
            self._restart(course, bright)
            return False
        if stalled and gain < _STALLED_CHI2_GAIN and course.outlier_searches:
            self._go_on_without_outliers(course)
            if not course.modes:
                return False
        is_last = course.kappa <= floor
        if is_last and self._drop_faint(course):
            return False
        if gain < self.settings.tolerance and is_last:
            return True
        course.kappa = min(_KAPPA_STEP_RATIO * course.kappa, course.error / 2)
        if course.kappa < max(_LAST_MODEL_ERROR, floor):
            course.kappa = floor
        return False

    def _go_on_without_outliers(self, course: Course) -> None:
        """Leave out bad pixels that stand alone, without which the model error may be smaller."""
        course.outlier_searches -= 1
        if not self._leave_out_outliers(self._end_of(course), course.modes):
            course.outlier_searches = 0
            return
        course.least, course.error = NOTHING, self.objective.model_error(course.state)
        # The wavefront was fitted to a very bad pixel.
        fewer = self.objective.chi2_per_pixel(course.state) < course.chi2 / 2
        if fewer and course.error > _RESTART_MODEL_ERROR:
            self._back_to_alignment(course, course.aligned)
            course.remaining = self.settings.max_iterations
        course.best = course.state

    def _restart(self, course: Course, added: Sequence[Planet]) -> None:
        """Go on with more companions: from here near the solution, else from the alignment."""
        is_close = course.error < _NEW_COMPANION_MODEL_ERROR
        course.least, course.remaining = NOTHING, self.settings.max_iterations
        course.may_drop, course.carried = False, course.carried.without_damping()
        if is_close:
            # Near the solution the model is linear, so that further steps remove the bias of the
            # wavefront. Images are less linear in positions than in the wavefront, and steps of
            # these few unknowns are cheap.
            course.state, course.carried = self._settled(
                self._with_companions(course.state, added),
                course.carried,
                _COMPANION_STEPS,
                modes=0,
            )
        else:
            self._back_to_alignment(course, self._with_companions(course.aligned, added))
        course.best = course.state

    def _back_to_alignment(self, course: Course, state: State) -> None:
        """Go on from a state of the alignment, with the priors of the beginning."""
        priors = replace(course.carried.priors, scales=self._first.priors.scales)
        course.state, course.modes = state, 0
        course.carried = replace(course.carried.without_damping(), priors=priors)
        course.kappa = max(self.objective.model_error(state), self.settings.min_model_error)

    def _drop_faint(self, course: Course) -> bool:
        """Go on without companions of the alignment that were errors of the wavefront.

        Faint companions would double the time of every step, and the search finds them anyway.
        """
        is_close = course.error <= max(_NEW_COMPANION_MODEL_ERROR, self.settings.min_model_error)
        first, present = (
            len(each.unknowns.frames[0].companions) for each in (self._begin, course.state)
        )
        if not (course.may_drop and is_close and present > first):
            return False
        snr = self.solver.companion_snr(course.state, course.carried.priors)
        faint = snr < _DROPPED_COMPANION_SNR
        faint[:first] = False
        if not bool(faint.any()):
            return False
        _log.info("companions of S/N %s are dropped", snr[faint].tolist())
        fewer = course.state.unknowns.without_companions(faint, course.state.vector)
        course.state = course.best = self.objective.at(*fewer)
        course.least = NOTHING
        return True

    def _finish(self, best: _Fitted, converged: bool) -> tuple[_Fitted, Status]:
        """Correct what the residual of the best iterate shows to be wrong."""
        best = self._without_outliers(best)
        if converged and not self._has_scales:
            if self.settings.adapt_prior:
                best = self._with_wider_prior(best)
            best = self._with_narrower_prior(best)
            best = self._with_measured_drift(best)
            if not best.carried.priors.determined:
                counted = self._counted(best)
                if counted is not best:
                    best = self._gone_on(counted, self.settings.max_iterations)
        if best.state.flux <= 0:
            return best, Status.DIVERGED
        if not converged:
            return best, Status.ITERATION_LIMIT
        explained = self.objective.chi2_per_pixel(best.state) < _EXPLAINED_CHI2
        return best, Status.CONVERGED if explained else Status.MODEL_MISMATCH

    def _without_outliers(self, end: _Fitted) -> _Fitted:
        """Leave out bad pixels that stand alone, and go on without them."""
        for _ in range(_BAD_PIXEL_STATES):
            if not self._leave_out_outliers(end, self._all_modes):
                break
            end = self._gone_on(end, _CONTINUED_STEPS)
        return end

    def _with_wider_prior(self, end: _Fitted) -> _Fitted:
        """Raise the scales of a prior that is too narrow, and go on with them."""
        for _ in range(_MOST_WIDENINGS):
            settings = self._widened(end)
            if settings is end.settings:
                break
            end = self._with_settings(end, settings)
            end = self._without_outliers(self._gone_on(end, self.settings.max_iterations))
        return end

    def _widened(self, end: _Fitted) -> FitSettings:
        """Settings with the prior of highest evidence if wider, else the settings of `end`."""
        settings, priors = end.settings, end.carried.priors
        if self.objective.chi2_per_pixel(end.state) > _FOREIGN:
            return settings
        ratios = priors.ratios_if_fixed(self._posterior(end), settings)
        if not priors.are_improbable(ratios):
            return settings
        # A fit under a narrow prior shows a part of the wavefront's size: with wider scales the
        # most probable wavefront of the same linear model grows, until the two agree.
        for _ in range(_SOLUTIONS):
            settings = settings.with_wider_priors(ratios)
            priors = self._priors_of(settings, priors)
            ratios = priors.ratios(self.solver.posterior(end.state, priors))
            if max(ratios.values()) < 1 + _SAME_SIZE:
                break
        _log.info("the wavefront is larger than its prior says, which is now %s", settings.prior)
        return settings

    def _measure_on_the_way(self, course: Course, gain: float) -> None:
        """Measure priors early, and once more, without bad pixels, where steps gain little.

        The sizes of the wavefront and its drift change the solution more than the last steps do. A
        prior is widened only where steps gain little: before, the wavefront is not yet known.
        """
        gains_little = bool(course.modes) and gain < _STALLED_CHI2_GAIN
        if len(self.history) == _PRIOR_MEASURED_AFTER_STEPS:
            self._measure_priors(course, may_widen=gains_little)
        elif course.may_settle and gains_little:
            course.may_settle = False
            if course.outlier_searches:
                self._go_on_without_outliers(course)
            if course.modes:
                self._measure_priors(course, may_widen=True)

    def _measure_priors(self, course: Course, may_widen: bool) -> None:
        """Go on with priors of the sizes that the present state of the wavefront shows."""
        end = self._end_of(course)
        adapted = self._narrowed(end)
        may_widen = may_widen and self.settings.adapt_prior and not self._unexplained(end.state)
        if may_widen and adapted is end.settings:
            adapted = self._widened(end)
        if adapted is not end.settings:
            end = self._with_settings(end, adapted)
        end, _ = self._with_drift_of(end)
        counted = self._counted(end)
        if end.settings is not course.settings or counted is not end:
            course.carried, course.settings = counted.carried, end.settings
            # Under a narrower prior the best state has a larger chi-squared.
            course.best, course.least = course.state, NOTHING

    def _with_narrower_prior(self, end: _Fitted) -> _Fitted:
        """Lower the scales of a prior that is too wide, and go on with them."""
        for _ in range(_MOST_NARROWINGS):
            settings = self._narrowed(end)
            if settings is end.settings:
                break
            end = self._gone_on(self._with_settings(end, settings), self.settings.max_iterations)
        return end

    def _narrowed(self, end: _Fitted) -> FitSettings:
        """Settings with the prior of highest evidence if narrower, else the settings of `end`."""
        # The most probable wavefront and flux are found together. Where the prior is too wide, the
        # likelihood leaves the wavefront free to be smaller, which the prior favours, and the flux
        # of the star comes out too high. Without a map, only the product of the flux and the square
        # of the wavefront's size is known, and neither can be measured.
        settings, priors = end.settings, end.carried.priors
        has_map = bool(self.problems[0].initial.data.any())
        is_fixed = settings.wavefront and not settings.prior.fit_scales
        may_narrow = settings.adapt_prior and is_fixed and has_map
        if not may_narrow or self._unexplained(end.state):
            return settings
        update = self._posterior(end)
        size = priors.size(update)
        if size > _NARROWED_SIZE_RATIO:
            return settings
        # The logarithm of the size is nearly linear in the logarithm of the prior's scale, so that
        # the last two solutions say where it is 0 (secant method).
        log_size, slope = math.log(size), 1.0
        for _ in range(_SOLUTIONS):
            change = log_size / slope
            amplitude = priors.ratios(update)["amplitude"] ** (1 / slope)
            settings = settings.with_narrower_prior(math.exp(change), amplitude)
            priors = self._priors_of(settings, priors)
            update = self.solver.posterior(end.state, priors)
            last, log_size = log_size, math.log(priors.size(update))
            if abs(log_size) < _SAME_SIZE:
                break
            slope = min(1.0, max(_SIZE_SLOPE, (last - log_size) / change))
        _log.info("the wavefront is smaller than its prior says, which is now %s", settings.prior)
        return settings

    def _with_measured_drift(self, end: _Fitted) -> _Fitted:
        """Give the drift between frames the size that maximises the evidence, and go on with it."""
        if self._unexplained(end.state):
            return end
        end, is_other = self._with_drift_of(end)
        return self._gone_on(end, _DRIFT_STEPS) if is_other else end

    def _with_drift_of(self, end: _Fitted) -> tuple[_Fitted, bool]:
        """Give the drift the size of highest evidence; False if the size hardly changes."""
        before = end.carried.priors
        if not before.drift:
            return end, False
        ratios = before.ratios(self._posterior(end))
        changed = end.settings.with_drift_scales(ratios, self.settings)
        if changed == end.settings:
            return end, False
        _log.info("the drift between frames is %s times the stated one", ratios)
        end = self._with_settings(end, changed)
        change = (end.carried.priors.scales / before.scales).log().abs().max()
        return end, float(change) > _SAME_DRIFT

    def _counted(self, end: _Fitted) -> _Fitted:
        """Count the modes that the data determine, if the flux is to be marginal."""
        wanted = self.settings.marginal_flux and self.settings.wavefront
        if not wanted or self._unexplained(end.state):
            return end
        counted = end.carried.priors.counted(self._posterior(end))
        _log.info("the data determine %.0f modes", counted.determined)
        return replace(end, carried=replace(end.carried, priors=counted))

    def _posterior(self, end: _Fitted) -> EvidenceUpdate:
        """Errors of all unknowns, with the weights of all pixels.

        The errors include a model error where the noise does not explain the data.
        """
        priors, kappa = end.carried.priors, self._unexplained(end.state)
        self.solver.linear_model(end.state, priors, kappa, self._all_modes, math.inf, final=False)
        return self.solver.posterior(end.state, priors)

    def _with_settings(self, end: _Fitted, settings: FitSettings) -> _Fitted:
        """State of a fit with other settings, and the priors that these state."""
        priors = self._priors_of(settings, end.carried.priors)
        return replace(end, carried=replace(end.carried, priors=priors), settings=settings)

    def _priors_of(self, settings: FitSettings, before: ModePriors) -> ModePriors:
        """The priors of other settings, with the number of modes of the priors `before`."""
        return replace(self.solver.priors_of(settings), determined=before.determined)

    def _gone_on(self, end: _Fitted, steps: int) -> _Fitted:
        """Take more steps of all unknowns, see `_settled`."""
        state, carried = self._settled(end.state, end.carried, steps)
        return replace(end, state=state, carried=carried)

    def _settled(
        self, state: State, carried: StepState, steps: int, modes: int | None = None
    ) -> tuple[State, StepState]:
        """Take steps, by default of all modes, until they gain little."""
        modes = self._all_modes if modes is None else modes
        kappa = max(self._unexplained(state), self.settings.min_model_error)
        for _ in range(steps):
            state, gain, carried = self.solver.step(state, carried, kappa, modes)
            error, chi2 = self.objective.model_error(state), self.objective.chi2_per_pixel(state)
            self._record(kappa, modes, chi2, error, gain, carried.damping)
            if gain < self.settings.tolerance:
                break
        return state, carried

    def _leave_out_outliers(self, end: _Fitted, modes: int) -> bool:
        """Leave out bad pixels that stand alone; False if there are none.

        The fit has adapted the first `modes` modes of the wavefront.
        """
        state, priors = end.state, end.carried.priors
        for k in range(_BAD_PIXEL_SEARCHES):
            kappa = self._unexplained(state)
            linear = self.solver.linear_model(state, priors, kappa, modes, math.inf, final=False)
            outliers = isolated_outliers(self.objective, state, linear)
            del linear  # The next linear model is as large.
            if not any(bool(each.any()) for each in outliers):
                return k > 0
            self.solver.leave_out(outliers)
        return True

    @property
    def _all_modes(self) -> int:
        return len(self.basis) if self.settings.wavefront else 0

    def _unexplained(self, state: State) -> float:
        """The model error, as a fraction of the star, if the noise does not explain the data."""
        explained = self.objective.chi2_per_pixel(state) < _EXPLAINED_CHI2
        return 0.0 if explained else self.objective.model_error(state)

    def _record(
        self, kappa: float, modes: int, chi2: float, error: float, gain: float, damping: float
    ) -> None:
        record = {
            "iteration": len(self.history),
            "wavefront": modes > 0,
            "kappa": kappa,
            "chi2_per_pixel": chi2,
            "model_error": error,
            "gain": gain,
            "damping": damping,
        }
        self.history.append(record)
        _log.debug(
            "step %d: chi2 %.4g per pixel, model error %.2g %% of the star, gain %.2g"
            ", damping %.2g",
            record["iteration"], chi2, 100 * error, gain, damping,
        )  # fmt: skip

    @property
    def _may_add(self) -> bool:
        """Whether sources that nothing else explains may become companions of the fit."""
        return self.settings.companions_if_stalled or self.settings.max_companions > 0

    def _room(self, course: Course) -> int:
        """Number of companions that may still be added."""
        return self.settings.max_companions - len(course.state.unknowns.frames[0].companions)

    def _significant(self, course: Course) -> list[Planet]:
        """Companions in the residual of the alignment."""
        most, threshold = self._room(course), self.settings.companion_threshold
        inner = INNER
        if most < 1 and self._may_add and self.settings.wavefront:
            # Brighter than all that the wavefront can have left. In real frames, peaks near the
            # star are errors of the model.
            most, threshold = min(1, most + _MOST_ADDED_COMPANIONS), _STALLED_COMPANION_SNR
            if not self.settings.companions_if_stalled:
                threshold, inner = _FIELD_COMPANION_SNR, _FIELD_COMPANION_ARCSEC
        return bright_companions(
            self.objective, course.state, course.kappa, most=most, threshold=threshold, inner=inner
        )

    def _with_dominant(self, state: State, carried: StepState) -> tuple[State, StepState]:
        """Add a companion that outshines what the mask leaves of the star, if there is one.

        Without this companion the star's flux would follow the companion's light.
        """
        error = self.objective.model_error(state)
        if error < _OUTSHONE_MODEL_ERROR or self._is_warm or not self._may_add:
            return state, carried
        # A star that is not aligned yet is as wrong.
        steps = len(self.history)
        alone, _ = self._settled(state, carried, _COMPANION_STEPS, modes=0)
        if self.objective.model_error(alone) < _OUTSHONE_MODEL_ERROR:
            del self.history[steps:]
            return state, carried
        trial = with_dominant(self.objective, state, error)
        if trial is not state:
            trial, carried = self._settled(trial, carried, _COMPANION_STEPS, modes=0)
            carried = carried.without_damping()
        if self.objective.model_error(trial) > error / 2:
            return state, carried
        _log.info("a source outshines the star, and is fitted with it")
        return trial, carried

    def _stalling(self, course: Course) -> list[Planet]:
        """A companion in the residual of a fit of the wavefront that stalled.

        Companions come one at a time, because side lobes of a bright companion are peaks as well.
        """
        is_hopeless = self._may_add and course.error > _SOURCES_MODEL_ERROR
        if not (self.settings.companions_if_stalled or is_hopeless):
            return []
        most = min(1, self._room(course) + _MOST_ADDED_COMPANIONS)
        return bright_companions(
            self.objective, course.state, course.error, most=most, threshold=_STALLED_COMPANION_SNR
        )

    def _with_companions(self, state: State, added: Sequence[Planet]) -> State:
        _log.info("possible sources, fitted with the star: %s", added)
        return self.objective.at(*state.unknowns.with_companions(added, state.vector))
