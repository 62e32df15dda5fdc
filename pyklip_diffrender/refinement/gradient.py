"""Refinement by gradients: Adam on every OPD pixel (the paper's recipe), and L-BFGS on modes."""

from __future__ import annotations

import logging
import math
import time
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import minimize
from torch import Tensor
from tqdm import tqdm

from pyklip_diffrender.linear.response import NANOMETRE
from pyklip_diffrender.optics.grid import PupilGrid
from pyklip_diffrender.parameters import FLUX_AND_BACKGROUND, parameter
from pyklip_diffrender.refinement.problem import Problem
from pyklip_diffrender.refinement.result import Refinement, Status
from pyklip_diffrender.wavefront.bases import Basis, default_basis
from pyklip_diffrender.wavefront.priors import WavefrontPrior

__all__ = ["AdamOptions", "LBFGSOptions", "adam", "lbfgs"]

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class AdamOptions:
    """The recipe of Feng et al. 2025, section IV: mean absolute error, every OPD pixel free.

    Attributes
    ----------
    iterations : int
    learning_rate : float
        m.
    """

    iterations: int = 1000
    learning_rate: float = 1e-11


@dataclass(frozen=True)
class LBFGSOptions:
    """Settings of the L-BFGS refinement; the same objective as Gauss-Newton at kappa = 0.

    Attributes
    ----------
    free : tuple of str
        Free parameters besides the wavefront.
    basis : Basis, optional
    prior : WavefrontPrior
        Its scales are kept.
    max_iterations : int
    tolerance : float
        Relative decrease of the objective at which it stops.
    """

    free: tuple[str, ...] = ("star_offset", "lyot_shift", "lyot_rotation", "flux", "background")
    basis: Basis | None = None
    prior: WavefrontPrior = field(default_factory=WavefrontPrior)
    max_iterations: int = 300
    tolerance: float = 1e-7


def _finish(
    problem: Problem,
    opd: Tensor,
    values: dict[str, Tensor],
    flux: float,
    background: float,
    **facts: Any,
) -> Refinement:
    with torch.no_grad():
        star = flux * problem.model(opd, **values).double() + background
    noise = ((problem.data - star) / problem.sigma)[problem.valid]
    found = {name: value.detach().cpu().numpy() for name, value in values.items()}
    found["flux"], found["background"] = np.array([flux]), np.array([background])
    return Refinement(
        model=problem.model,
        observation=problem.observation,
        initial=problem.initial,
        opd=opd.detach().double().cpu().numpy(),
        star_image=star.cpu().numpy(),
        values=found,
        errors={name: np.full(len(value), np.nan) for name, value in found.items()},
        chi2_per_pixel=float((noise**2).mean()),
        model_error=math.nan,
        **facts,
    )


def adam(problem: Problem, options: AdamOptions, *, seed: int, progress: bool) -> Refinement:
    """The paper's recipe: Adam on the OPD pixels, L1 loss, everything else known.

    Star offset and alignment are held at their starts; flux and background are those given, or
    the least-squares fit of the starting star. The best iterate is returned.
    """
    began = time.perf_counter()
    values = problem.optical_start(())
    opd = problem.opd0.to(problem.model.dtype).clone().requires_grad_()
    with torch.no_grad():
        image = problem.model(opd, **values).double()
    names = tuple(name for name in ("flux", "background") if name not in problem.start)
    flux, background = problem.flux_and_background(image, problem.sigma, names)
    optimiser = torch.optim.Adam([opd], lr=options.learning_rate)
    history: list[dict[str, Any]] = []
    best_loss, best = math.inf, problem.opd0
    for iteration in tqdm(range(options.iterations), desc="adam", disable=not progress):
        optimiser.zero_grad()
        star = flux * problem.model(opd, **values) + background
        loss = (star - problem.data)[problem.valid].abs().mean()
        loss.backward()
        value = float(loss.detach())
        history.append({"iteration": iteration, "loss": value})
        if value < best_loss:
            best_loss, best = value, opd.detach().clone()
        optimiser.step()
    return _finish(
        problem,
        best,
        values,
        flux,
        background,
        status=Status.COMPLETED if math.isfinite(best_loss) else Status.DIVERGED,
        method="adam",
        history=history,
        seconds=time.perf_counter() - began,
        seed=seed,
    )


def lbfgs(problem: Problem, options: LBFGSOptions, *, seed: int, progress: bool) -> Refinement:
    """L-BFGS (scipy's L-BFGS-B) on all parameters in units of their prior deviations."""
    began = time.perf_counter()
    model = problem.model
    basis = options.basis or default_basis()
    grid = PupilGrid.full(model.npix, model.diameter)
    extra = {p.name for p in FLUX_AND_BACKGROUND}
    optical = tuple(name for name in options.free if name not in extra)
    problem.require_parameters(optical)
    linear = tuple(name for name in options.free if name in extra)
    start = problem.optical_start(optical)
    with torch.no_grad():
        image = model(problem.opd0, **start).double()
    flux0, background0 = problem.flux_and_background(image, problem.sigma, linear)
    scales = torch.tensor([options.prior.scales[n] for n in basis.groups], dtype=torch.float64)
    deviation = scales[basis.group_index] * options.prior.shape(basis)
    # What has no prior gets a scale at which it matters, so that all unknowns are of order 1.
    unit = {"flux": abs(flux0), "background": float(problem.sigma[problem.valid].median())}

    def unpack(z: Tensor) -> tuple[Tensor, dict[str, Tensor], Tensor, Tensor]:
        values, k = dict(start), 0
        for name in optical:
            entry = parameter(name)
            values[name] = start[name] + entry.prior * z[k : k + entry.size].to(model.device)
            k += entry.size
        level = {
            "flux": torch.tensor(flux0, dtype=torch.float64),
            "background": torch.tensor(background0, dtype=torch.float64),
        }
        for name in linear:
            level[name] = level[name] + unit[name] * z[k]
            k += 1
        opd = problem.opd0 + basis.opd(z[k:] * deviation * NANOMETRE, grid).to(model.device)
        return opd, values, level["flux"], level["background"]

    history: list[dict[str, Any]] = []
    free_of_prior = torch.cat(
        [
            torch.ones(sum(parameter(n).size for n in optical), dtype=torch.float64),
            torch.zeros(len(linear), dtype=torch.float64),
            torch.ones(len(basis), dtype=torch.float64),
        ]
    )

    def objective(z: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        unknown = torch.from_numpy(z.copy()).requires_grad_()
        opd, values, flux, background = unpack(unknown)
        star = flux.to(model.device) * model(opd, **values).double()
        residual = (problem.data - star - background.to(model.device)) / problem.sigma
        chi2 = torch.where(problem.valid, residual, 0.0).pow(2).sum()
        total = (chi2.cpu() + (free_of_prior * unknown**2).sum()) / problem.pixels
        total.backward()
        assert unknown.grad is not None
        history.append(
            {"iteration": len(history), "chi2_per_pixel": float(chi2.detach()) / problem.pixels}
        )
        return float(total.detach()), unknown.grad.numpy()

    bar = tqdm(total=options.max_iterations, desc="l-bfgs", disable=not progress)
    answer = minimize(
        objective,
        np.zeros(len(free_of_prior)),
        jac=True,
        method="L-BFGS-B",
        options={"maxiter": options.max_iterations, "ftol": options.tolerance, "maxcor": 30},
        callback=lambda _: bar.update(),
    )
    bar.close()
    with torch.no_grad():
        opd, values, flux, background = unpack(torch.from_numpy(answer.x))
    chi2 = history[-1]["chi2_per_pixel"]
    if not math.isfinite(answer.fun) or float(flux) <= 0:
        status = Status.DIVERGED
    elif not answer.success:
        status = Status.ITERATION_LIMIT
    else:
        status = Status.CONVERGED if chi2 < 1.5 else Status.MODEL_MISMATCH
    return _finish(
        problem,
        opd,
        values,
        float(flux),
        float(background),
        status=status,
        method="lbfgs",
        history=history,
        seconds=time.perf_counter() - began,
        seed=seed,
    )
