"""Schedule of a fit: alignment first, then the wavefront, with a decreasing model error.

The star is bright, so that the first residuals are many times larger than the photon noise, and
undamped steps would diverge. Therefore the noise is taken as sqrt(sigma^2 + (kappa star)^2). The
model error kappa, a fraction of the star, begins at the value for which chi-squared per pixel is 1
and decreases to 0, or to the value that the final residual requires.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Mapping, Sequence
from typing import Any

from pyklip_diffrender.io.progress import ProgressBar
from pyklip_diffrender.linear.frames import Unknown
from pyklip_diffrender.refinement.companions import bright_companions
from pyklip_diffrender.refinement.frame_fit import FrameFit
from pyklip_diffrender.refinement.mode_priors import ModePriors, count_modes_below
from pyklip_diffrender.refinement.objective import State
from pyklip_diffrender.refinement.outliers import isolated_outliers
from pyklip_diffrender.refinement.problem import Problem
from pyklip_diffrender.refinement.result import Refinement
from pyklip_diffrender.refinement.settings import GaussNewton
from pyklip_diffrender.refinement.solver import Solver
from pyklip_diffrender.refinement.status import Status
from pyklip_diffrender.scene.objects import Planet
from pyklip_diffrender.wavefront.bases import Basis
from pyklip_diffrender.wavefront.priors import EvidenceUpdate

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

_MOST_BRIGHT = 8
"""Largest number of companions that a fit may add in this way."""

_ALIGNED = 0.05
"""Gain in chi-squared per pixel below which the wavefront is fitted as well."""

_ANNEALING = 0.6
"""Largest ratio of kappa in successive steps."""

_ROUNDS = 6
"""Largest number of searches for bad pixels at one state, because a bright one hides fainter ones
beside it, and of states that are searched."""

_IMPROBABLE = 1.5
"""Ratio of the fitted to the fixed scale of modes above which the prior is wrong."""

_STEPS = 4
"""Largest number of steps after each, because bad pixels have done little harm with robust weights,
and of steps that fit a new companion alone."""

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
        layout = self.solver.first_layout()
        self._begin = self.objective.at(
            layout, layout.initial() if warm is None else layout.warm(warm)
        )
        self._is_warm = warm is not None
        self.history: list[dict[str, Any]] = []

    def run(self, seed: int) -> Refinement:
        """Fit the alignment, then alignment and wavefront; return the best iterate."""
        with ProgressBar("wavefront", shown=self.progress) as bar:
            return self._run(seed, bar)

    def _run(self, seed: int, bar: ProgressBar) -> Refinement:
        began = time.perf_counter()
        settings, solver, floor = self.settings, self.solver, self.settings.min_model_error
        state = aligned = best = self._begin
        best_error = (math.inf, math.inf)
        first_scales = solver.priors.scales
        kappa = max(self.objective.model_error(state), floor)
        if self._is_warm and floor:
            kappa = floor  # A larger one would lead away from the solution, and back.
        modes = 0
        if settings.wavefront and (not settings.free or self._is_warm):
            modes = self._modes_for(kappa)
        status = Status.ITERATION_LIMIT
        remaining = settings.max_iterations
        while remaining:
            remaining -= 1
            state, gain = solver.step(state, kappa, modes)
            error, chi2 = self.objective.model_error(state), self.objective.chi2_per_pixel(state)
            if (error, chi2) < best_error:
                best, best_error = state, (error, chi2)
            self._record(kappa, modes, chi2, error, gain)
            bar.update(chi2=chi2)
            settled = gain < settings.tolerance
            if not modes:
                kappa = max(floor, min(kappa, error))
                bright = self._new_companions(state, kappa, False) if gain < _ALIGNED else []
                if bright:
                    state = self._with_companions(state, bright)
                elif gain < _ALIGNED and settings.wavefront:
                    # The damping of the alignment does not apply to the wavefront.
                    aligned, modes, solver.damping = state, self._modes_for(kappa), 0.0
                elif settled:
                    status = _status_of(chi2)
                    break
                continue
            stalled = error > max(kappa, _NEGLIGIBLE)
            bright = self._new_companions(state, error, True) if stalled else []
            if bright:
                # Near the solution the model is linear, so that further steps remove the bias of
                # the wavefront. Otherwise the fit starts again from the alignment.
                is_close = error < _NEAR
                state = self._with_companions(state if is_close else aligned, bright)
                best_error, remaining = (math.inf, math.inf), settings.max_iterations
                if is_close:
                    # Images are less linear in positions than in the wavefront, and steps of these
                    # few unknowns are cheap.
                    solver.damping = 0.0
                    state = self._settled(state, _STEPS, modes=0)
                else:
                    solver.priors.scales = first_scales
                    solver.damping, modes = 0.0, 0
                    kappa = max(self.objective.model_error(state), floor)
                best = state
                continue
            if settled and kappa <= floor and modes == len(self.basis):
                status = _status_of(chi2)
                break
            kappa = min(_ANNEALING * kappa, error / 2)
            if kappa < max(_NEGLIGIBLE, floor):
                kappa = floor
            modes = self._modes_for(kappa)
        best = self._without_outliers(best)
        if status in (Status.CONVERGED, Status.MODEL_MISMATCH):
            if settings.widen_prior:
                best = self._with_wider_prior(best)
            status = _status_of(self.objective.chi2_per_pixel(best))
        if best.flux <= 0:
            status = Status.DIVERGED
        return self._conclude(best, status, seed, time.perf_counter() - began)

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
            ratios = self._prior_ratios(self.solver.posterior(state))
            if not self._is_improbable(ratios):
                break
            _log.info("the wavefront is improbable under its prior, by factors %s", ratios)
            self.settings = self.settings.with_wider_priors(ratios)
            frames = len(self.problems)
            self.solver.priors = ModePriors.of(self.settings, self.basis, frames)
            state = self._without_outliers(self._settled(state, self.settings.max_iterations))
        return state

    def _prior_ratios(self, update: EvidenceUpdate) -> dict[str, float]:
        """Size of the fitted modes relative to their prior, by group; empty with fitted scales."""
        is_fixed = self.settings.wavefront and not self.settings.prior.fit_scales
        return self.solver.priors.ratios(update) if is_fixed else {}

    def _is_improbable(self, ratios: Mapping[str, float]) -> bool:
        """Whether the wavefront is too large for its prior."""
        of_wavefront = [ratios[name] for name in self.solver.priors.names if ratios]
        return max(of_wavefront, default=0.0) >= _IMPROBABLE

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
        for k in range(_ROUNDS):
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

    def _new_companions(self, state: State, kappa: float, stalled: bool) -> list[Planet]:
        """Companions in the residual of the alignment, or of a wavefront fit that stalled."""
        room = self.settings.max_companions - len(state.joint.frames[0].companions)
        threshold = self.settings.companion_threshold
        if stalled:
            if not self.settings.companions_if_stalled:
                return []
            # One at a time, because the side lobes of a bright companion are peaks as well.
            room, threshold = min(1, room + _MOST_BRIGHT), _BRIGHT
        return bright_companions(self.objective, state, kappa, most=room, threshold=threshold)

    def _with_companions(self, state: State, added: Sequence[Planet]) -> State:
        _log.info("companions given parameters of their own: %s", added)
        return self.objective.at(*state.joint.with_companions(added, state.vector))

    def _conclude(self, state: State, status: Status, seed: int, seconds: float) -> Refinement:
        """Compute errors and make the result."""
        kappa = self._unexplained(state)
        # Robust weights take a source that is not in the model for an outlier, and a tenth of the
        # light of one of S/N 7 with it.
        robust = self.objective.robust if kappa else math.inf
        linear = self.solver.linear_model(state, kappa, self._all_modes, robust)
        update = self.solver.posterior(state)
        assert update.variance is not None
        deviation = update.variance.sqrt()
        priors, ratios = self.solver.priors, self._prior_ratios(update)
        if status is Status.CONVERGED and self._is_improbable(ratios):
            status = Status.PRIOR_MISMATCH
        frames = []
        for k, (problem, point) in enumerate(zip(self.problems, state.points, strict=True)):
            layout = point.unknowns
            own = deviation[state.joint.rows(k)[: len(linear.frames[k].rows)]]
            values = {n: v.cpu().numpy() for n, v in layout.values(point.vector).items()}
            levels = ("flux", "background", *(["pedestal"] if problem.systematics else []))
            for name in levels:
                values[name] = layout.start[name].numpy()
            errors = {name: math.nan * value for name, value in values.items()}
            for name in layout.ordered:
                values[name] = point.vector[layout.where(name)].numpy()
                errors[name] = own[layout.where(name)].numpy()
            frames.append(
                FrameFit(
                    model=problem.model,
                    observation=problem.observation,
                    start=problem.start,
                    opd=point.opd.cpu().numpy(),
                    star=point.star.cpu().numpy(),
                    companion_image=(point.total - point.star).cpu().numpy(),
                    values=values,
                    errors=errors,
                    gain=problem.gain.cpu().numpy(),
                    coefficients=point.vector[layout.where("modes")].numpy(),
                )
            )
        first = state.points[0]
        sources = first.unknowns.where("companions")
        rows = state.joint.rows(0)[sources]
        return Refinement(
            frames=tuple(frames),
            initial=self.problems[0].initial,
            settings=self.settings,
            basis=self.basis,
            status=status,
            chi2_per_pixel=self.objective.chi2_per_pixel(state),
            model_error=kappa,
            companions=first.unknowns.sources(first.vector).numpy(),
            companion_errors=deviation[rows].reshape(-1, 3).numpy(),
            scales=dict(zip(priors.names, priors.scales.tolist(), strict=True)),
            prior_ratios=ratios,
            effective_parameters=update.effective,
            log_evidence=update.log_evidence,
            stored_linear=linear,
            systematics=self.problems[0].systematics,
            history=self.history,
            seconds=seconds,
            seed=seed,
        )


def _status_of(chi2: float) -> Status:
    """Status of a fit that has converged."""
    return Status.CONVERGED if chi2 < _EXPLAINED else Status.MODEL_MISMATCH
