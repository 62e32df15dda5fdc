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
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from scipy.linalg.blas import dsyrk
from torch import Tensor
from tqdm import tqdm

from pyklip_diffrender.bases import Basis, default_basis
from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.priors import EvidenceUpdate, WavefrontPrior, solve_with_evidence
from pyklip_diffrender.refinement.companions import bright_companions
from pyklip_diffrender.refinement.forward import Forward, Point
from pyklip_diffrender.refinement.problem import Problem
from pyklip_diffrender.refinement.result import Refinement, Status
from pyklip_diffrender.refinement.unknowns import Unknowns

__all__ = ["GaussNewtonOptions", "gauss_newton"]

_log = logging.getLogger(__name__)

_EXPLAINED = 1.5
"""chi2 per pixel below which the noise is taken to explain what is left."""

_NEGLIGIBLE = 1e-3
"""Model error, as a share of the star, below which annealing ends."""

_ANNEALING = 0.6
"""Factor by which kappa shrinks at least from step to step."""

_TRIES = 7
"""How often a step is tried again with more damping."""


@dataclass(frozen=True)
class GaussNewtonOptions:
    """Settings of the Gauss-Newton refinement.

    Attributes
    ----------
    free : tuple of str
        Free parameters besides the wavefront.
    wavefront : bool
        Fit the wavefront; False fits the alignment only.
    basis : Basis, optional
        Default segment motions and Fourier modes to 24 cycles.
    prior : WavefrontPrior
    companions : int
        Most companions that may get parameters of their own, if they stand out of what the
        alignment fit leaves.
    companion_threshold : float
        How far they must stand out, in units of the matched filter's scatter.
    response_npix : int
        Pupil samples of the copy of the model that gives derivatives.
    max_iterations : int
    tolerance : float
        Converged when a step lowers the penalised chi2 per pixel by less than this.
    kappa_floor : float
        Smallest model error, as a share of the star.
    relinearise : float
        Change of the pupil's phase (rms, radians) after which the response of the field to the
        wavefront is computed anew.
    robust : float
        Residuals of this many sigma count half (Cauchy's weights); inf for plain least squares.
    """

    free: tuple[str, ...] = ("star_offset", "lyot_shift", "lyot_rotation", "flux", "background")
    wavefront: bool = True
    basis: Basis | None = None
    prior: WavefrontPrior = field(default_factory=WavefrontPrior)
    companions: int = 0
    companion_threshold: float = 4.0
    response_npix: int = 128
    max_iterations: int = 40
    tolerance: float = 1e-3
    kappa_floor: float = 0.0
    relinearise: float = 0.3
    robust: float = math.inf


@dataclass(frozen=True)
class _Linearised:
    """Curvature G^T G, gradient G^T r at the unknowns' starts, and where they are now."""

    curvature: Tensor
    gradient: Tensor
    current: Tensor


def _self_product(rows: Tensor) -> Tensor:
    """``rows @ rows.T`` at half the cost: only one triangle is computed, then mirrored."""
    upper = torch.from_numpy(dsyrk(1.0, rows.numpy().T, trans=1))
    return upper + upper.triu(1).T


class _GaussNewton:
    def __init__(self, problem: Problem, options: GaussNewtonOptions, progress: bool) -> None:
        self.problem, self.options, self.progress = problem, options, progress
        self.basis = options.basis or default_basis()
        problem.require_parameters(options.free)
        if not options.free and not options.wavefront:
            raise IncompatibleSetupError("free is empty and wavefront is False: nothing to fit")
        if "flux" not in options.free and not float(problem.start.get("flux", 0.0)):
            raise IncompatibleSetupError(
                "flux is not free and start has no 'flux': how bright is the star? Add 'flux' to "
                "free, or give start={'flux': light that the pupil collects}"
            )
        self.forward = Forward(
            problem, self.basis, options.response_npix, progress, options.relinearise
        )
        self.shape = options.prior.shape(self.basis)
        self.amplitude_deviation = options.prior.amplitude_deviation(self.basis)
        self.group = self.basis.group_index
        self.scales = torch.tensor(
            [options.prior.scales[name] for name in self.basis.groups], dtype=torch.float64
        )
        self.history: list[dict[str, Any]] = []
        self.damping = 0.0
        self.unknowns, self.point = self._begin()

    def _begin(self) -> tuple[Unknowns, Point]:
        problem, free = self.problem, self.options.free
        start = problem.optical_start(tuple(n for n in free if n in problem.model.parameters))
        zero = torch.zeros(1, dtype=torch.float64)
        # The unknowns and their algebra stay on the CPU, wherever the model renders.
        unknowns = Unknowns(
            free,
            {**{n: v.cpu() for n, v in start.items()}, "flux": zero, "background": zero},
            len(self.basis),
            len(self.amplitude_deviation),
        )
        point = self.forward.at(unknowns, unknowns.initial())
        # Photon-noise weights before the star is known would trust the faint pixels only.
        flat = torch.full_like(problem.sigma, float(problem.sigma.median()))
        flux, level = problem.flux_and_background(point.image, flat, unknowns.linear)
        unknowns.start["flux"] = torch.tensor([flux], dtype=torch.float64)
        unknowns.start["background"] = torch.tensor([level], dtype=torch.float64)
        return unknowns, self.forward.at(unknowns, unknowns.initial())

    # -- how far the model is from the data --------------------------------------------------

    def sigma(self, point: Point, kappa: float) -> Tensor:
        return torch.sqrt(self.problem.sigma**2 + (kappa * point.total) ** 2)

    def whitened(self, point: Point, sigma: Tensor) -> Tensor:
        residual = (self.problem.data - point.total) / sigma
        return torch.where(self.problem.valid, residual, 0.0)

    def chi2_per_pixel(self, point: Point) -> float:
        """With the observation's own errors."""
        return float((self.whitened(point, self.problem.sigma) ** 2).sum()) / self.problem.pixels

    def model_error(self, point: Point) -> float:
        """The share kappa of the star that brings chi2 per pixel to 1; 0 if it is there."""
        valid = self.problem.valid
        residual = (self.problem.data - point.total)[valid] ** 2
        noise, star = self.problem.sigma[valid] ** 2, point.total[valid] ** 2
        if float((residual / noise).mean()) <= 1:
            return 0.0
        low, high = 0.0, 10.0
        for _ in range(50):
            middle = (low + high) / 2
            excess = float((residual / (noise + middle**2 * star)).mean()) > 1
            low, high = (middle, high) if excess else (low, middle)
        return high

    def deviation(self, unknowns: Unknowns) -> Tensor:
        """Prior standard deviations of all unknowns."""
        wavefront = self.scales[self.group] * self.shape
        return torch.cat([unknowns.prior_deviation(), self.amplitude_deviation, wavefront])

    def cost(self, point: Point, sigma: Tensor) -> float:
        """Penalised chi2 (Cauchy's loss where robust), which every step must lower."""
        squared = self.whitened(point, sigma) ** 2
        if math.isfinite(self.options.robust):
            limit = self.options.robust**2
            squared = limit * torch.log1p(squared / limit)
        unknowns = point.unknowns
        away = (point.vector - unknowns.initial()) / self.deviation(unknowns)
        return float(squared.sum() + (away**2).sum())

    # -- steps -------------------------------------------------------------------------------

    def linearised(self, point: Point, sigma: Tensor, with_modes: bool) -> _Linearised:
        """Normal equations about a point, for the unknowns as distances from their starts."""
        residual = self.whitened(point, sigma)
        weight = torch.where(self.problem.valid, 1 / sigma, 0.0)
        if math.isfinite(self.options.robust):
            halving = torch.rsqrt(1 + (residual / self.options.robust) ** 2)
            residual, weight = residual * halving, weight * halving
        whitened = (self.forward.jacobian(point, with_modes) * weight).flatten(1).cpu()
        current = (point.vector - point.unknowns.initial())[: len(whitened)]
        curvature = _self_product(whitened)
        gradient = whitened @ residual.flatten().cpu() + curvature @ current
        return _Linearised(curvature, gradient, current)

    def solve(
        self,
        unknowns: Unknowns,
        equations: _Linearised,
        *,
        damping: float = 0.0,
        fit_scales: bool = False,
        covariance: bool = False,
    ) -> EvidenceUpdate:
        """Most probable unknowns, as distances from their starts, for the linearised model."""
        curvature = equations.curvature
        before = unknowns.where("modes").start
        with_modes = len(curvature) > unknowns.where("companions").stop
        fixed = unknowns.prior_deviation()
        if with_modes:
            fixed = torch.cat([fixed, self.amplitude_deviation])
        # Columns differ by many powers of ten (flux against nm): solve in their own units.
        own = torch.ones(len(curvature), dtype=torch.float64)
        own[: len(fixed)] = curvature.diagonal()[: len(fixed)].clamp(min=1e-300) ** -0.5
        modes = slice(None) if with_modes else slice(0, 0)
        assert not with_modes or before == len(fixed)
        update = solve_with_evidence(
            curvature * own[:, None] * own,
            equations.gradient * own,
            self.shape[modes],
            self.group[modes],
            self.scales,
            fixed / own[: len(fixed)],
            iterations=2 if fit_scales and with_modes else 0,
            damping=damping,
            current=equations.current / own,
            covariance=covariance,
        )
        return update.in_units(own)

    def descend(self, point: Point, sigma: Tensor, with_modes: bool) -> tuple[Point, float]:
        """One damped step; returns the new point and by how much chi2 per pixel fell."""
        unknowns = point.unknowns
        equations = self.linearised(point, sigma, with_modes)
        fit_scales = with_modes and self.options.prior.fit_scales
        if fit_scales:
            self.scales = self.solve(unknowns, equations, fit_scales=True).scales
        before = self.cost(point, sigma)
        for _ in range(_TRIES):
            update = self.solve(unknowns, equations, damping=self.damping)
            vector = point.vector.clone()
            vector[: len(update.step)] += update.step - equations.current
            trial = self.forward.at(unknowns, unknowns.clamped(vector))
            after = self.cost(trial, sigma)
            if after < before:
                self._relax(
                    (before - after) / self.predicted_gain(unknowns, equations, update.step)
                )
                return trial, (before - after) / self.problem.pixels
            self.damping = max(6 * self.damping, 0.05)
        return point, 0.0

    def predicted_gain(self, unknowns: Unknowns, equations: _Linearised, step: Tensor) -> float:
        """By how much the penalised chi2 would fall if the model were linear."""
        precision = self.deviation(unknowns)[: len(step)] ** -2
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

    def add_companions(self, point: Point, kappa: float) -> Point:
        """Give companions that stand out parameters of their own."""
        unknowns = point.unknowns
        sigma = self.sigma(point, kappa)
        residual = torch.where(self.problem.valid, self.problem.data - point.total, 0.0)
        found = bright_companions(
            self.forward.coarse,
            self.forward.coarse_opd(point),
            unknowns.values(point.vector),
            residual.cpu().numpy(),
            torch.where(self.problem.valid, sigma, math.inf).cpu().numpy(),
            unknowns.level("flux", point.vector),
            most=self.options.companions - len(unknowns.companions),
            threshold=self.options.companion_threshold,
        )
        if not found:
            return point
        _log.info("companions given parameters of their own: %s", found)
        return self.forward.at(*unknowns.with_companions(found, point.vector))

    def run(self, seed: int) -> Refinement:
        """Anneal kappa; fit alignment, then alignment and wavefront; return the best iterate."""
        began = time.perf_counter()
        options, point = self.options, self.point
        kappa = max(self.model_error(point), options.kappa_floor)
        best, best_error = point, (math.inf, math.inf)
        status = Status.ITERATION_LIMIT
        with_modes = not options.free
        bar = tqdm(total=options.max_iterations, desc="refine", disable=not self.progress)
        for iteration in range(options.max_iterations):
            point, gain = self.descend(point, self.sigma(point, kappa), with_modes)
            needed, chi2 = self.model_error(point), self.chi2_per_pixel(point)
            if (needed, chi2) < best_error:
                best, best_error = point, (needed, chi2)
            record = {
                "iteration": iteration,
                "wavefront": with_modes,
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
            if not with_modes:
                kappa = max(options.kappa_floor, min(kappa, needed))
                if gain < 0.05 and len(point.unknowns.companions) < options.companions:
                    known = len(point.unknowns.companions)
                    point = self.add_companions(point, kappa)
                    if len(point.unknowns.companions) > known:
                        continue
                if gain < 0.05 and options.wavefront:
                    with_modes = True
                elif settled:
                    status = self.status_of(chi2)
                    break
                continue
            if settled and kappa <= options.kappa_floor:
                status = self.status_of(chi2)
                break
            kappa = min(_ANNEALING * kappa, needed / 2)
            if kappa < max(_NEGLIGIBLE, options.kappa_floor):
                kappa = options.kappa_floor
        bar.close()
        if best.unknowns.level("flux", best.vector) <= 0:
            status = Status.DIVERGED
        return self.result(best, status, began, seed)

    def status_of(self, chi2: float) -> Status:
        """How a fit that has settled ended."""
        return Status.CONVERGED if chi2 < _EXPLAINED else Status.MODEL_MISMATCH

    def result(self, point: Point, status: Status, began: float, seed: int) -> Refinement:
        """Errors at the end, and everything in the form that users see."""
        chi2 = self.chi2_per_pixel(point)
        kappa = 0.0 if chi2 < _EXPLAINED else self.model_error(point)
        sigma = self.sigma(point, kappa)
        unknowns = point.unknowns
        equations = self.linearised(point, sigma, self.options.wavefront)
        update = self.solve(unknowns, equations, covariance=True)
        assert update.covariance is not None
        deviation = torch.sqrt(update.covariance.diagonal())
        values = {n: v.cpu().numpy() for n, v in unknowns.values(point.vector).items()}
        for name in ("flux", "background"):
            values[name] = np.array([unknowns.level(name, point.vector)])
        errors = {name: np.full(len(value), np.nan) for name, value in values.items()}
        for name in unknowns.ordered:
            errors[name] = deviation[unknowns.where(name)].numpy()
        return Refinement(
            model=self.problem.model,
            observation=self.problem.observation,
            initial=self.problem.initial,
            opd=self.forward.opd(unknowns, point.vector).cpu().numpy(),
            star_image=point.star.cpu().numpy(),
            values=values,
            errors=errors,
            status=status,
            method="gauss-newton",
            chi2_per_pixel=chi2,
            model_error=kappa,
            history=self.history,
            seconds=time.perf_counter() - began,
            seed=seed,
            companions=unknowns.sources(point.vector).numpy(),
            companion_errors=deviation[unknowns.where("companions")].reshape(-1, 3).numpy(),
            companion_image=(point.total - point.star).cpu().numpy(),
            scales=dict(zip(self.basis.groups, self.scales.tolist(), strict=True)),
            effective_parameters=update.effective,
            coefficients=point.vector[unknowns.where("modes")],
            covariance=update.covariance,
            response=self.forward.jacobian(point, self.options.wavefront),
        )


def gauss_newton(
    problem: Problem, options: GaussNewtonOptions, *, seed: int, progress: bool
) -> Refinement:
    """Refine by damped Gauss-Newton; see the module's text and `GaussNewtonOptions`."""
    return _GaussNewton(problem, options, progress).run(seed)
