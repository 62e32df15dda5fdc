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
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from pyklip_diffrender.bases import Basis, default_basis
from pyklip_diffrender.geometry import PupilGrid
from pyklip_diffrender.parameters import FLUX_AND_BACKGROUND, parameter
from pyklip_diffrender.priors import EvidenceUpdate, WavefrontPrior, solve_with_evidence
from pyklip_diffrender.refinement.problem import Problem
from pyklip_diffrender.refinement.result import Refinement, Status
from pyklip_diffrender.response import (
    NANOMETRE,
    coarse_copy,
    downsample,
    parameter_jacobian,
    wavefront_jacobian,
)

__all__ = ["GaussNewtonOptions", "gauss_newton"]

_log = logging.getLogger(__name__)

_EXPLAINED = 1.5
"""chi2 per pixel below which the noise is taken to explain what is left."""

_NEGLIGIBLE = 1e-3
"""Model error, as a share of the star, below which annealing ends."""


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
    response_npix : int
        Pupil samples of the copy of the model that gives derivatives.
    max_iterations : int
    tolerance : float
        Converged when a step lowers the penalised chi2 per pixel by less than this.
    kappa_floor : float
        Smallest model error, as a share of the star.
    relinearise : float
        The response is computed anew when the star has changed by more than this share (rms,
        weighted) since the last time.
    robust : float
        Residuals beyond this many sigma count as if they were that far (Huber); inf for never.
    """

    free: tuple[str, ...] = ("star_offset", "lyot_shift", "lyot_rotation", "flux", "background")
    wavefront: bool = True
    basis: Basis | None = None
    prior: WavefrontPrior = WavefrontPrior()  # noqa: RUF009 - frozen
    response_npix: int = 256
    max_iterations: int = 40
    tolerance: float = 1e-3
    kappa_floor: float = 0.0
    relinearise: float = 0.1
    robust: float = math.inf


@dataclass
class _State:
    """A point of the fit: parameter values, what they render, how far it is from the data."""

    values: dict[str, Tensor]
    flux: float
    background: float
    coefficients: Tensor
    image: Tensor | None = None

    def star(self) -> Tensor:
        assert self.image is not None
        return self.flux * self.image


class _GaussNewton:
    def __init__(self, problem: Problem, options: GaussNewtonOptions, progress: bool) -> None:
        self.problem, self.options, self.progress = problem, options, progress
        self.model = problem.model
        self.basis = options.basis or default_basis()
        extra = {p.name for p in FLUX_AND_BACKGROUND}
        self.optical = tuple(name for name in options.free if name not in extra)
        self.linear = tuple(name for name in options.free if name in extra)
        for name in self.optical:
            if name not in self.model.parameters:
                raise ValueError(
                    f"free: {name!r} is not a parameter of this model, which has "
                    f"{self.model.parameters}"
                )
        self.coarse = coarse_copy(self.model, options.response_npix)
        self.grid = PupilGrid.full(self.model.npix, self.model.diameter)
        self.shape = options.prior.shape(self.basis)
        self.group = self.basis.group_index
        self.scales = torch.tensor(
            [options.prior.scales[name] for name in self.basis.groups], dtype=torch.float64
        )
        self.start_values = problem.optical_start(self.optical)
        self.fixed_deviation = torch.tensor(
            [
                parameter(name).prior
                for name in (*self.optical, *self.linear)
                for _ in range(parameter(name).size)
            ],
            dtype=torch.float64,
        )
        self.history: list[dict[str, Any]] = []
        self._slopes = torch.zeros(0)
        self._modes: Tensor | None = None
        self._linearised_at: Tensor | None = None

    # -- the model ---------------------------------------------------------------------------

    def opd(self, coefficients: Tensor) -> Tensor:
        if not bool((coefficients != 0).any()):
            return self.problem.opd0
        change = self.basis.opd(coefficients * NANOMETRE, self.grid)
        return self.problem.opd0 + change.to(self.model.device)

    def rendered(self, state: _State) -> _State:
        with torch.no_grad():
            image = self.model(self.opd(state.coefficients), **state.values).double()
        return replace(state, image=image)

    def whitened(self, state: _State, sigma: Tensor) -> Tensor:
        residual = (self.problem.data - state.star() - state.background) / sigma
        return torch.where(self.problem.valid, residual, 0.0)

    def sigma(self, state: _State, kappa: float) -> Tensor:
        return torch.sqrt(self.problem.sigma**2 + (kappa * state.star()) ** 2)

    def weights(self, residual: Tensor) -> Tensor:
        """Square roots of Huber's weights."""
        if math.isinf(self.options.robust):
            return torch.ones_like(residual)
        return torch.sqrt((self.options.robust / residual.abs().clamp(min=1e-30)).clamp(max=1.0))

    def cost(self, state: _State, sigma: Tensor) -> float:
        """Penalised chi2 (Huber's loss where robust), what every step must lower."""
        residual = self.whitened(state, sigma).abs()
        limit = self.options.robust
        loss = torch.where(residual <= limit, residual**2, 2 * limit * residual - limit**2)
        if math.isinf(limit):
            loss = residual**2
        penalty = ((state.coefficients / (self.scales[self.group] * self.shape)) ** 2).sum()
        offset = self._from_start(state) / self.fixed_deviation
        return float(loss.sum() + penalty + (offset**2).sum())

    def _from_start(self, state: _State) -> Tensor:
        """Distance of the parameters that are not modes from where their priors are centred."""
        optical = [(state.values[n] - self.start_values[n]).cpu() for n in self.optical]
        free = torch.zeros(len(self.linear), dtype=torch.float64)
        return torch.cat([*optical, free])

    def model_error(self, state: _State) -> float:
        """The share kappa of the star that brings chi2 per pixel to 1; 0 if it is there."""
        residual = (self.problem.data - state.star() - state.background)[self.problem.valid]
        noise, star = self.problem.sigma[self.problem.valid], state.star()[self.problem.valid]
        if float(((residual / noise) ** 2).mean()) <= 1:
            return 0.0
        low, high = 0.0, 10.0
        for _ in range(50):
            middle = (low + high) / 2
            chi2 = float((residual**2 / (noise**2 + (middle * star) ** 2)).mean())
            low, high = (middle, high) if chi2 > 1 else (low, middle)
        return high

    # -- derivatives -------------------------------------------------------------------------

    def jacobian(self, state: _State, with_modes: bool) -> Tensor:
        """(parameters, ny, nx) in the data's unit; optical, flux, background, modes."""
        if self._moved_since_linearised(state):
            opd = downsample(self.opd(state.coefficients), self.coarse.npix)
            self._slopes = (
                parameter_jacobian(self.coarse, opd, state.values, self.optical).double()
                if self.optical
                else torch.zeros(0, *self.problem.data.shape, dtype=torch.float64)
            )
            self._modes = None
            self._linearised_at = state.star()
        if with_modes and self._modes is None:
            self._modes = wavefront_jacobian(
                self.model,
                self.basis,
                self.opd(state.coefficients),
                state.values,
                npix=self.options.response_npix,
                progress=self.progress,
            )
        assert state.image is not None
        rows = [state.flux * self._slopes]
        if "flux" in self.linear:
            rows.append(state.image[None])
        if "background" in self.linear:
            rows.append(torch.ones_like(state.image)[None])
        if with_modes and self._modes is not None:
            rows.append(state.flux * self._modes.double())
        return torch.cat(rows)

    def _moved_since_linearised(self, state: _State) -> bool:
        """Whether the star differs by more than the allowed share from the linearised one."""
        if self._linearised_at is None:
            return True
        weight = torch.where(self.problem.valid, self.problem.sigma**-2, 0.0)
        moved = (weight * (state.star() - self._linearised_at) ** 2).sum()
        size = (weight * state.star() ** 2).sum()
        return float(torch.sqrt(moved / size)) > self.options.relinearise

    # -- steps -------------------------------------------------------------------------------

    def normal_equations(
        self, state: _State, sigma: Tensor, with_modes: bool
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Curvature, gradient and the parameters' current distances from their priors."""
        residual = self.whitened(state, sigma)
        weight = self.weights(residual)
        jacobian = self.jacobian(state, with_modes)
        scale = torch.where(self.problem.valid, weight / sigma, 0.0)
        whitened = (jacobian * scale).flatten(1).cpu()
        del jacobian
        target = (residual * weight).flatten().cpu()
        current = self._from_start(state)
        if with_modes:
            current = torch.cat([current, state.coefficients])
        curvature = whitened @ whitened.T
        # The unknown is the distance from the prior's centre, not the step.
        gradient = whitened @ target + curvature @ current
        return curvature, gradient, current

    def solve(
        self, state: _State, sigma: Tensor, with_modes: bool, *, covariance: bool = False
    ) -> tuple[EvidenceUpdate, Tensor]:
        curvature, gradient, current = self.normal_equations(state, sigma, with_modes)
        # Columns differ by many powers of ten (flux against nm): solve in their own units.
        length = torch.sqrt(curvature.diagonal()).clamp(min=1e-300)
        length[len(self.fixed_deviation) :] = 1.0
        own = 1 / length
        others = len(self.fixed_deviation)
        update = solve_with_evidence(
            curvature * own[:, None] * own,
            gradient * own,
            self.shape if with_modes else self.shape[:0],
            self.group if with_modes else self.group[:0],
            self.scales,
            self.fixed_deviation / own[:others],
            iterations=2 if with_modes and self.options.prior.fit_scales else 0,
            covariance=covariance,
        )
        spread = update.covariance
        if spread is not None:
            spread = spread * own[:, None] * own
        return replace(update, step=update.step * own, covariance=spread), current

    def moved(self, state: _State, step: Tensor, fraction: float) -> _State:
        values, k = dict(state.values), 0
        for name in self.optical:
            entry = parameter(name)
            value = values[name] + fraction * step[k : k + entry.size].to(values[name].device)
            values[name] = value.clamp(entry.lower, entry.upper)
            k += entry.size
        flux, background = state.flux, state.background
        if "flux" in self.linear:
            flux, k = flux + fraction * float(step[k]), k + 1
        if "background" in self.linear:
            background, k = background + fraction * float(step[k]), k + 1
        coefficients = state.coefficients
        if k < len(step):
            coefficients = coefficients + fraction * step[k:]
        return self.rendered(_State(values, flux, background, coefficients))

    def descend(self, state: _State, sigma: Tensor, with_modes: bool) -> tuple[_State, float]:
        """One damped step; returns the new state and by how much chi2 per pixel fell."""
        update, current = self.solve(state, sigma, with_modes)
        if with_modes:
            self.scales = update.scales
        before = self.cost(state, sigma)
        fraction = 1.0
        while fraction > 0.01:
            trial = self.moved(state, update.step - current, fraction)
            after = self.cost(trial, sigma)
            if after < before:
                return trial, (before - after) / self.problem.pixels
            fraction /= 2
        return state, 0.0

    def initial_state(self) -> _State:
        state = _State(
            self.start_values, 0.0, 0.0, torch.zeros(len(self.basis), dtype=torch.float64)
        )
        state = self.rendered(state)
        # Photon-noise weights before the star is known would trust the faint pixels only.
        flat = torch.full_like(self.problem.sigma, float(self.problem.sigma.median()))
        assert state.image is not None
        state.flux, state.background = self.problem.flux_and_background(
            state.image, flat, self.linear
        )
        return state

    def run(self, seed: int) -> Refinement:
        """Anneal kappa; fit alignment, then alignment and wavefront; return the best iterate."""
        began = time.perf_counter()
        options = self.options
        state = self.initial_state()
        kappa = max(self.model_error(state), options.kappa_floor)
        best, best_error = state, kappa
        status = Status.ITERATION_LIMIT
        with_modes = False
        bar = tqdm(total=options.max_iterations, desc="refine", disable=not self.progress)
        for iteration in range(options.max_iterations):
            sigma = self.sigma(state, kappa)
            state, gain = self.descend(state, sigma, with_modes)
            needed = self.model_error(state)
            if needed <= best_error:
                best, best_error = state, needed
            chi2 = self.chi2_per_pixel(state)
            self.history.append(
                {
                    "iteration": iteration,
                    "wavefront": with_modes,
                    "kappa": kappa,
                    "chi2_per_pixel": chi2,
                    "model_error": needed,
                    "gain": gain,
                }
            )
            _log.info(
                "iteration %d: chi2/pixel %.4g, model error %.3g, kappa %.3g, scales %s",
                iteration, chi2, needed, kappa, self.scales.tolist() if with_modes else None,
            )  # fmt: skip
            bar.update()
            bar.set_postfix(chi2=f"{chi2:.3g}", kappa=f"{kappa:.2g}")
            settled = gain < options.tolerance
            if not with_modes:
                if gain < 0.05 and options.wavefront:
                    with_modes = True
                elif settled:
                    status = self.status_of(chi2)
                    break
                kappa = max(options.kappa_floor, min(kappa, needed))
                continue
            lower = max(options.kappa_floor, min(kappa, needed / 2))
            if needed < _NEGLIGIBLE:
                lower = options.kappa_floor
            if settled and lower >= 0.9 * kappa:
                status = self.status_of(chi2)
                break
            kappa = lower
        bar.close()
        if best.flux <= 0:
            status = Status.DIVERGED
        return self.result(best, status, began, seed)

    def chi2_per_pixel(self, state: _State) -> float:
        """With the observation's own errors."""
        residual = self.whitened(state, self.problem.sigma)
        return float((residual**2).sum()) / self.problem.pixels

    def status_of(self, chi2: float) -> Status:
        """How a fit that has settled ended."""
        return Status.CONVERGED if chi2 < _EXPLAINED else Status.MODEL_MISMATCH

    def result(self, state: _State, status: Status, began: float, seed: int) -> Refinement:
        kappa = self.model_error(state)
        chi2 = self.chi2_per_pixel(state)
        if chi2 < _EXPLAINED:
            kappa = 0.0
        sigma = self.sigma(state, kappa)
        update, _ = self.solve(state, sigma, self.options.wavefront, covariance=True)
        assert update.covariance is not None
        deviation = torch.sqrt(update.covariance.diagonal())
        values, errors, k = {}, {}, 0
        for name in (*self.optical, *self.linear):
            size = parameter(name).size
            errors[name] = deviation[k : k + size].numpy()
            k += size
        for name in self.start_values:
            values[name] = state.values[name].cpu().numpy()
            errors.setdefault(name, np.full(len(values[name]), np.nan))
        values["flux"] = np.array([state.flux])
        values["background"] = np.array([state.background])
        for name in ("flux", "background"):
            errors.setdefault(name, np.array([np.nan]))
        return Refinement(
            model=self.model,
            observation=self.problem.observation,
            initial=self.problem.initial,
            opd=self.opd(state.coefficients).cpu().numpy(),
            star_image=(state.star() + state.background).cpu().numpy(),
            values=values,
            errors=errors,
            status=status,
            method="gauss-newton",
            chi2_per_pixel=chi2,
            model_error=kappa,
            history=self.history,
            seconds=time.perf_counter() - began,
            seed=seed,
            scales=dict(zip(self.basis.groups, self.scales.tolist(), strict=True)),
            effective_parameters=update.effective,
            coefficients=state.coefficients,
            covariance=update.covariance,
            response=self.jacobian(state, self.options.wavefront),
        )


def gauss_newton(
    problem: Problem, options: GaussNewtonOptions, *, seed: int, progress: bool
) -> Refinement:
    """Refine by damped Gauss-Newton; see the module's text and `GaussNewtonOptions`."""
    return _GaussNewton(problem, options, progress).run(seed)
