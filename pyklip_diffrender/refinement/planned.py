"""Refinement with a planned, cheaper model, whose result is put back onto the model as given."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.linear.model import Unknown
from pyklip_diffrender.linear.response import NANOMETRE
from pyklip_diffrender.optics.grid import PupilGrid
from pyklip_diffrender.optics.system import OpticalSystem
from pyklip_diffrender.planning import ModelError, Plan, plan
from pyklip_diffrender.refinement.continuation import (
    continued,
    fit_with_growing_basis,
    warm_start,
)
from pyklip_diffrender.refinement.frame_fit import FrameFit
from pyklip_diffrender.refinement.problem import Problem
from pyklip_diffrender.refinement.result import Refinement
from pyklip_diffrender.refinement.settings import GaussNewton

__all__ = ["fit_problems", "make_plan", "refine_again", "require_plan_for"]

_log = logging.getLogger(__name__)


def make_plan(problems: Sequence[Problem], settings: GaussNewton, seed: int) -> Plan:
    """Plan the model fidelity of a fit; what the settings decide is left alone.

    Parameters
    ----------
    problems : sequence of Problem
        To be fitted together. The plan is made for the first that is not of a reference star.
    settings : GaussNewton
    seed : int
        Of the wavefronts that the plan draws.
    """
    science = next((p for p in problems if not p.observation.reference), problems[0])
    cycles = settings.cycles or (24.0,)
    keep: dict[str, Any] = {}
    fixed = settings.basis is not None or settings.drift is not None
    if fixed or not settings.wavefront or not settings.cycles:
        keep["cycles"] = float(cycles[0])
    if len(problems) > 1:
        # A correction belongs to one position of the star.
        keep["multifidelity"] = False
    return plan(
        science.model,
        science.observation,
        science.initial,
        # What one frame hardly sees, many do.
        error_budget=0.1 / math.sqrt(len(problems)),
        keep=keep,
        start=science.start,
        # Another basis has groups of its own, which say nothing about the default modes.
        prior=settings.prior if settings.basis is None else None,
        cycles=cycles,
        model_error=settings.min_model_error,
        seed=seed,
    )


def require_plan_for(model: OpticalSystem, planned: Plan) -> None:
    """Refuse a plan that was made for another system.

    Raises
    ------
    IncompatibleSetupError
    """
    other = planned.given
    ours = (model.npix, model.detector.shape, model.bandpass, model.parameters)
    theirs = (other.npix, other.detector.shape, other.bandpass, other.parameters)
    if ours != theirs:
        raise IncompatibleSetupError(
            f"plan: it was made for {other!r}, the model is {model!r}. Make one for it with "
            "plan(model, observation, opd)"
        )


def fit_problems(
    problems: Sequence[Problem],
    settings: GaussNewton,
    planned: Plan | None,
    warm: Mapping[Unknown, float] | None = None,
    *,
    seed: int,
    progress: bool,
) -> Refinement:
    """Refine with the plan's model, if there is a plan; the result is on the problems' model.

    At the end the star is rendered with the problems' model. If that differs by more than the
    plan's budget, the fit goes on from there with the model as given.

    Parameters
    ----------
    problems : sequence of Problem
        One for each frame, with the model as given.
    settings : GaussNewton
    planned : Plan or None
        None to fit with the model as given.
    warm : mapping of Unknown to float, optional
        Where to start.
    seed : int
    progress : bool
    """
    if planned is None:
        return fit_with_growing_basis(problems, settings, warm, seed=seed, progress=progress)
    began = time.perf_counter()
    cheap = [problem.with_model(planned.model) for problem in problems]
    chosen = settings
    if settings.basis is None and warm is None:
        chosen = replace(settings, cycles=planned.refine_options["cycles"])
    fit = fit_with_growing_basis(cheap, chosen, warm, seed=seed, progress=progress)
    finished = [_on_full_model(fit, k, each, settings.free) for k, each in enumerate(problems)]
    error = ModelError.largest(change for _, change in finished)
    if planned.allows(error) or not fit.status.usable:
        return replace(
            fit,
            frames=tuple(frame for frame, _ in finished),
            plan=replace(planned, final_error=error),
            seconds=time.perf_counter() - began,
        )
    _log.warning(
        "the planned model's star differs from that of the given model by %.2g sigma (worst pixel "
        "%.2g), more than the budget of %.2g: the fit goes on with the model as given",
        error.rms,
        error.worst,
        planned.budget,
    )
    exact = fit_with_growing_basis(
        problems, continued(fit), warm_start(fit), seed=seed, progress=progress
    )
    return replace(
        exact,
        plan=replace(planned, final_error=error, abandoned=True),
        seconds=time.perf_counter() - began,
    )


def _on_full_model(
    fit: Refinement, k: int, problem: Problem, free: tuple[str, ...]
) -> tuple[FrameFit, ModelError]:
    """One frame of a planned fit on the given model, and by how much its star changes."""
    frame, model = fit.frames[k], problem.model
    opd = frame.opd
    if frame.model.npix != model.npix:
        assert fit.basis is not None
        grid = PupilGrid.full(model.npix, model.diameter)
        coefficients = torch.from_numpy(frame.coefficients)
        change = fit.basis.opd(coefficients * NANOMETRE, grid)
        opd = problem.starting_opd(model.npix).cpu().numpy() + change.numpy()
    values = {n: torch.from_numpy(v) for n, v in frame.values.items() if n in model.parameters}
    with torch.no_grad():
        image = model(torch.from_numpy(np.ascontiguousarray(opd)).to(model.device), **values)
    image = problem.gain * image.double()
    # Flux and background at which the given model's star comes nearest to the one fitted.
    before = torch.from_numpy(frame.star).to(model.device)
    linear = tuple(name for name in ("flux", "background") if name in free)
    start = {name: float(frame.values[name][0]) for name in ("flux", "background")}
    flux, level = problem.flux_and_background(
        image, problem.sigma, linear, data=before, start=start
    )
    star = flux * image + level
    away = ((star - before) / problem.sigma)[problem.valid].abs()
    error = ModelError(float(away.square().mean().sqrt()), float(away.max()))
    fitted = {**frame.values, "flux": np.array([flux]), "background": np.array([level])}
    return replace(frame, model=model, opd=opd, star=star.cpu().numpy(), values=fitted), error


def refine_again(fit: Refinement, *, progress: bool = False, **changes: Any) -> Refinement:
    """Go on from a refinement with other settings.

    Parameters
    ----------
    fit : Refinement
    progress : bool
        Show progress bars.
    **changes
        Fields of `GaussNewton` with other values, such as `companions`.

    Raises
    ------
    IncompatibleSetupError
        If the fit is by another method than Gauss-Newton.
    """
    settings = continued(fit, **changes)
    problems = [
        Problem(frame.model, frame.observation, fit.initial, frame.start, fit.systematics)
        for frame in fit.frames
    ]
    planned = None if fit.plan is None or fit.plan.abandoned else fit.plan
    return fit_problems(
        problems, settings, planned, warm_start(fit), seed=fit.seed, progress=progress
    )
