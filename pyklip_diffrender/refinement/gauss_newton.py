"""The default method: damped Gauss-Newton on a few thousand modes, with an annealed noise budget.

Far from the data, in units of photon noise, undamped steps diverge: the star is bright and its
noise small. So the noise is taken as sqrt(sigma^2 + (kappa star)^2), where the share kappa of the
star that the model is allowed to miss starts as large as the first residual demands and shrinks
to nothing, or to what the model cannot explain. Alignment is fitted first, the wavefront after.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.linear.model import LinearModel
from pyklip_diffrender.linear.response import Responses
from pyklip_diffrender.refinement.companions import standing_out
from pyklip_diffrender.refinement.conclusion import as_refinements
from pyklip_diffrender.refinement.forward import Forward
from pyklip_diffrender.refinement.joint import Joint
from pyklip_diffrender.refinement.linearised import Linearised, linearise
from pyklip_diffrender.refinement.misfit import Misfit, State
from pyklip_diffrender.refinement.options import GaussNewtonOptions
from pyklip_diffrender.refinement.problem import Problem
from pyklip_diffrender.refinement.result import Refinement, Status
from pyklip_diffrender.refinement.unknowns import Unknowns
from pyklip_diffrender.scene.objects import Planet
from pyklip_diffrender.wavefront.bases import Basis
from pyklip_diffrender.wavefront.priors import EvidenceUpdate, scale_ratios, solve_with_evidence

__all__ = ["GaussNewton"]

_log = logging.getLogger(__name__)

_EXPLAINED = 1.5
"""chi2 per pixel below which the noise is taken to explain what is left."""

_NEGLIGIBLE = 1e-3
"""Model error, as a share of the star, below which annealing ends."""

_COARSE = 0.01
"""Model error, as a share of the star, above which modes to `_FEW_CYCLES` do as well as all."""

_FEW_CYCLES = 14.0

_NEAR = 0.003
"""Model error below which a companion that a fit finds has bent the wavefront but little.

Planets of 5e-7 to 2e-6 were found at 0.001 to 0.0026; side lobes of one of 1e-4 at 0.3 arcsec, in
its place, at 0.005 to 0.1.
"""

_BRIGHT = 8.0
"""How far a companion must stand out, in units of the scatter, when the wavefront's fit stalls.

Without companions, peaks reached 6 (drifts of 40 to 400 h); companions that stalled a fit, 12.
"""

_MOST_BRIGHT = 8
"""Companions that a fit may find in this way."""

_IMPROBABLE = 1.5
"""Ratio of the scale that modes have to the scale held, above which the prior is wrong."""

_ANNEALING = 0.6
"""Factor by which kappa shrinks at least from step to step."""

_TRIES = 7
"""How often a step is tried again with more damping."""


def _first_modes(basis: Basis, cycles: float) -> int:
    """How many modes, from the first one on, have at most a spatial frequency."""
    beyond = torch.nonzero(basis.frequencies > cycles).flatten()
    return int(beyond[0]) if len(beyond) else len(basis)


class GaussNewton:
    """One fit with a given basis.

    Parameters
    ----------
    problems : sequence of Problem
        The frames.
    options : GaussNewtonOptions
        With a basis.
    progress : bool
    """

    def __init__(
        self, problems: Sequence[Problem], options: GaussNewtonOptions, progress: bool
    ) -> None:
        self.options, self.progress = options, progress
        assert options.basis is not None
        self.basis = options.basis
        for problem in problems:
            problem.require_parameters(options.free)
        if not options.free and not options.wavefront:
            raise IncompatibleSetupError("free is empty and wavefront is False: nothing to fit")
        if "flux" not in options.free and not float(problems[0].start.get("flux", 0.0)):
            raise IncompatibleSetupError(
                "flux is not free and start has no 'flux': how bright is the star? Add 'flux' to "
                "free, or give start={'flux': light that the pupil collects}"
            )
        responses = Responses(
            problems[0].model,
            self.basis,
            npix=options.response_npix,
            relinearise=options.relinearise,
            progress=progress,
        )
        forwards = [Forward(problem, responses) for problem in problems]
        self.misfit = Misfit(forwards, options.robust)
        several = len(problems) > 1
        self.own_prior = options.drift if several else None
        self.drift = _first_modes(self.basis, options.drift_cycles) if self.own_prior else 0
        self.few = _first_modes(self.basis, _FEW_CYCLES)
        self.amplitude_deviation = options.prior.amplitude_deviation(self.basis)
        self._prepare_priors(len(problems))
        self.history: list[dict[str, Any]] = []
        self.damping = 0.0
        self.equations: Linearised | None = None
        self.state = self._begin(problems)

    def _prepare_priors(self, frames: int) -> None:
        """Groups, shapes and scales of the shared modes and of each frame's difference."""
        basis, groups = self.basis, self.basis.groups
        self.shape = self.options.prior.shape(basis)
        self.group = basis.group_index
        self.scale_names = list(groups)
        scales = [self.options.prior.scales[name] for name in groups]
        if self.own_prior is not None:
            own = self.own_prior.shape(basis)[: self.drift]
            self.shape = torch.cat([self.shape, own.repeat(frames)])
            self.group = torch.cat(
                [self.group, (basis.group_index[: self.drift] + len(groups)).repeat(frames)]
            )
            self.scale_names += [f"{name} drift" for name in groups]
            scales += [self.own_prior.scales[name] for name in groups]
        self.scales = torch.tensor(scales, dtype=torch.float64)

    def _begin(self, problems: Sequence[Problem]) -> State:
        first = problems[0].observation.position_angles
        frames = []
        for problem, forward in zip(problems, self.misfit.forwards, strict=True):
            angles = problem.observation.position_angles
            turned = 0.0 if first is None or angles is None else float(angles[0] - first[0])
            frames.append(self._begin_frame(problem, forward, roll=-turned))
        several = len(frames) > 1
        joint = Joint(tuple(frames), self.options.own if several else (), self.drift)
        vector = joint.initial()
        if self.options.resume is not None:
            vector = joint.resumed(self.options.resume)
        return self.misfit.at(joint, vector)

    def _begin_frame(self, problem: Problem, forward: Forward, roll: float) -> Unknowns:
        free = self.options.free
        start = problem.optical_start(tuple(n for n in free if n in problem.model.parameters))
        zero = torch.zeros(1, dtype=torch.float64)
        # The unknowns and their algebra stay on the CPU, wherever the model renders.
        unknowns = Unknowns(
            free,
            {**{n: v.cpu() for n, v in start.items()}, "flux": zero, "background": zero},
            len(self.basis),
            len(self.amplitude_deviation),
            list(self.options.planets),
            roll,
            not problem.observation.reference,
        )
        image = forward.at(unknowns, unknowns.initial()).image
        # Photon-noise weights before the star is known would trust the faint pixels only.
        flat = torch.full_like(problem.sigma, float(problem.sigma.median()))
        flux, level = problem.flux_and_background(image, flat, unknowns.linear)
        unknowns.start["flux"] = torch.tensor([flux], dtype=torch.float64)
        unknowns.start["background"] = torch.tensor([level], dtype=torch.float64)
        return unknowns

    def deviation(self, joint: Joint) -> Tensor:
        """Prior standard deviations of all unknowns."""
        wavefront = self.scales[self.group] * self.shape
        return torch.cat([joint.prior_deviation(), self.amplitude_deviation, wavefront])

    def cost(self, state: State, sigmas: Sequence[Tensor]) -> float:
        """Penalised chi2, which every step must lower."""
        away = (state.vector - state.joint.initial()) / self.deviation(state.joint)
        return self.misfit.loss(state, sigmas) + float((away**2).sum())

    # -- steps -------------------------------------------------------------------------------

    def solve(
        self,
        joint: Joint,
        equations: Linearised,
        *,
        damping: float = 0.0,
        fit_scales: bool = False,
        errors: bool = False,
    ) -> EvidenceUpdate:
        """Most probable unknowns, as distances from their starts, for the linearised model."""
        curvature = equations.curvature
        modes = max(0, len(curvature) - joint.where("modes").start)
        fixed = joint.prior_deviation()
        if modes:
            fixed = torch.cat([fixed, self.amplitude_deviation])
        # Columns differ by many powers of ten (flux against nm): solve in their own units.
        own = torch.ones(len(curvature), dtype=torch.float64)
        own[: len(fixed)] = curvature.diagonal()[: len(fixed)].clamp(min=1e-300) ** -0.5
        update = solve_with_evidence(
            curvature * own[:, None] * own,
            equations.gradient * own,
            self.shape[:modes],
            self.group[:modes],
            self.scales,
            fixed / own[: len(fixed)],
            iterations=1 if fit_scales and modes else 0,
            damping=damping,
            current=equations.current / own,
            errors=errors,
        )
        return update.in_units(own)

    def descend(self, state: State, kappa: float, modes: int) -> tuple[State, float]:
        """One damped step; returns the new state and by how much chi2 per pixel fell."""
        joint = state.joint
        equations = self.equations = linearise(self.misfit, state, kappa, modes)
        sigmas = [self.misfit.sigma(k, point, kappa) for k, point in enumerate(state.points)]
        update = self.solve(joint, equations, fit_scales=self.fits_scales)
        self.scales = update.scales
        expected = self.predicted_gain(joint, equations, update.step)
        if expected < self.options.tolerance * self.misfit.pixels:
            # Not worth a step, after which all would have to be linearised again.
            return state, expected / self.misfit.pixels
        before = self.cost(state, sigmas)
        for _ in range(_TRIES):
            if self.damping:
                update = self.solve(joint, equations, damping=self.damping)
                expected = self.predicted_gain(joint, equations, update.step)
            vector = state.vector.clone()
            vector[: len(update.step)] += update.step - equations.current
            trial = self.misfit.at(joint, joint.clamped(vector))
            after = self.cost(trial, sigmas)
            if after < before:
                self._relax((before - after) / expected)
                return trial, (before - after) / self.misfit.pixels
            self.damping = max(6 * self.damping, 0.05)
        return state, 0.0

    @property
    def fits_scales(self) -> bool:
        """Whether the prior's scales are free."""
        return self.options.prior.fit_scales

    def predicted_gain(self, joint: Joint, equations: Linearised, step: Tensor) -> float:
        """By how much the penalised chi2 would fall if the model were linear."""
        precision = self.deviation(joint)[: len(step)] ** -2
        curvature, current = equations.curvature, equations.current

        def quadratic(x: Tensor) -> float:
            return float(x @ (curvature @ x) - 2 * equations.gradient @ x + precision @ x**2)

        return max(quadratic(current) - quadratic(step), 1e-12)

    def _relax(self, ratio: float) -> None:
        """Adapt the damping to how much of the predicted gain a step brought."""
        if ratio > 0.7:
            self.damping = self.damping / 4 if self.damping > 1e-3 else 0.0
        elif ratio < 0.3:
            self.damping = max(2.5 * self.damping, 0.05)

    def bright_in(self, state: State, kappa: float, modes: int) -> list[Planet]:
        """Companions that stand out of what a step left, to be given parameters of their own."""
        options, known = self.options, len(state.joint.frames[0].companions)
        if not modes:
            most, threshold = options.companions - known, options.companion_threshold
        elif options.kappa_floor > 0 or known >= options.companions + _MOST_BRIGHT:
            # A model error that is allowed for may be all that stands out.
            return []
        else:
            # One at a time: a bright one's side lobes stand out as well.
            most, threshold = 1, _BRIGHT
        found = standing_out(self.misfit, state, kappa, most=most, threshold=threshold)
        if found:
            _log.info("companions given parameters of their own: %s", found)
        return found

    def with_companions(self, state: State, found: Sequence[Planet]) -> State:
        """A state with parameters for further companions."""
        return self.misfit.at(*state.joint.with_companions(found, state.vector))

    def run(self, seed: int) -> list[Refinement]:
        """Anneal kappa; fit alignment, then alignment and wavefront; return the best iterate."""
        began = time.perf_counter()
        options, state = self.options, self.state
        needed = self.misfit.model_error(state)
        kappa = max(needed, options.kappa_floor)
        best, best_error = state, (math.inf, math.inf)
        aligned, scales = state, self.scales
        status = Status.ITERATION_LIMIT
        modes = 0
        if options.wavefront and (not options.free or options.resume is not None):
            modes = self.modes_for(kappa)
        bar = tqdm(total=options.max_iterations, desc="refine", disable=not self.progress)
        left = options.max_iterations
        while left:
            left -= 1
            state, gain = self.descend(state, kappa, modes)
            needed, chi2 = self.misfit.model_error(state), self.misfit.chi2_per_pixel(state)
            if (needed, chi2) < best_error:
                best, best_error = state, (needed, chi2)
            record = {
                "iteration": len(self.history),
                "wavefront": modes > 0,
                "kappa": kappa,
                "chi2_per_pixel": chi2,
                "model_error": needed,
                "gain": gain,
                "damping": self.damping,
            }
            self.history.append(record)
            _log.info("%s, scales %s", record, self.scales.tolist())
            bar.update()
            bar.set_postfix(chi2=f"{chi2:.3g}", kappa=f"{kappa:.2g}")
            settled = gain < options.tolerance
            if not modes:
                kappa = max(options.kappa_floor, min(kappa, needed))
                bright = self.bright_in(state, kappa, modes) if gain < 0.05 else []
                if bright:
                    state = self.with_companions(state, bright)
                elif gain < 0.05 and options.wavefront:
                    # What the alignment alone could not follow says nothing about these steps.
                    aligned, modes, self.damping = state, self.modes_for(kappa), 0.0
                elif settled:
                    status = self.status_of(chi2)
                    break
                continue
            stalled = needed > max(kappa, _NEGLIGIBLE)
            bright = self.bright_in(state, needed, modes) if stalled else []
            if bright:
                # Near the solution all is linear, and the wavefront gives back what it took. Where
                # it has bent too far for that: back to where there was none.
                near = needed < _NEAR
                best = state = self.with_companions(state if near else aligned, bright)
                best_error, left = (math.inf, math.inf), options.max_iterations
                bar.reset()
                if not near:
                    self.scales, self.damping, modes = scales, 0.0, 0
                    kappa = max(self.misfit.model_error(state), options.kappa_floor)
                continue
            if settled and kappa <= options.kappa_floor and modes == len(self.basis):
                status = self.status_of(chi2)
                break
            kappa = min(_ANNEALING * kappa, needed / 2)
            if kappa < max(_NEGLIGIBLE, options.kappa_floor):
                kappa = options.kappa_floor
            modes = self.modes_for(kappa)
        bar.close()
        if best.flux <= 0:
            status = Status.DIVERGED
        return self.results(best, status, began, seed)

    def modes_for(self, kappa: float) -> int:
        """How many modes are worth fitting while the model may miss a share kappa of the star."""
        several = len(self.misfit.forwards) > 1
        everything = self.options.kappa_floor > 0 or len(self.amplitude_deviation) or several
        return len(self.basis) if everything or kappa <= _COARSE else self.few

    def status_of(self, chi2: float) -> Status:
        """How a fit that has settled ended."""
        return Status.CONVERGED if chi2 < _EXPLAINED else Status.MODEL_MISMATCH

    def prior_holds(self, update: EvidenceUpdate) -> bool:
        """Whether modes are about as large as their prior says, where its scales were held."""
        if self.fits_scales or not self.options.wavefront or update.variance is None:
            return True
        deviation = self.scales[self.group] * self.shape
        last = slice(-len(deviation), None)
        ratios = scale_ratios(update.step[last], update.variance[last], deviation, self.group)
        return bool((ratios < _IMPROBABLE).all())

    def results(self, state: State, status: Status, began: float, seed: int) -> list[Refinement]:
        """Errors at the end, and everything in the form that users see."""
        joint, chi2 = state.joint, self.misfit.chi2_per_pixel(state)
        kappa = 0.0 if chi2 < _EXPLAINED else self.misfit.model_error(state)
        equations, modes = self.equations, len(self.basis) if self.options.wavefront else 0
        count = joint.unknowns_with(modes)
        if (
            equations is None
            or equations.state is not state
            or equations.kappa != kappa
            or len(equations.current) != count
        ):
            equations = linearise(self.misfit, state, kappa, modes)
        update = self.solve(joint, equations, errors=True)
        assert update.variance is not None
        deviation = torch.sqrt(update.variance)
        if status is Status.CONVERGED and not self.prior_holds(update):
            status = Status.PRIOR_MISMATCH
        linear = LinearModel(
            names=joint.names()[:count],
            frames=equations.frames,
            vector=state.vector[:count],
            mean=joint.initial()[:count],
            deviation=self.deviation(joint)[:count],
            curvature=equations.curvature,
        )
        return as_refinements(
            self.misfit,
            state,
            linear,
            deviation,
            status=status,
            chi2_per_pixel=chi2,
            model_error=kappa,
            history=self.history,
            seconds=time.perf_counter() - began,
            seed=seed,
            scales=dict(zip(self.scale_names, self.scales.tolist(), strict=True)),
            effective_parameters=update.effective,
            log_evidence=update.log_evidence,
            settings=self.options,
        )
