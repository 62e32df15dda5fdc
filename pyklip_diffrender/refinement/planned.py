"""Refinement with the cheaper model of a plan, and transfer of the result to the full model."""

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
from pyklip_diffrender.linear.frames import Unknown
from pyklip_diffrender.linear.mode_fields import NANOMETRE
from pyklip_diffrender.optics.grid import PupilGrid
from pyklip_diffrender.optics.system import OpticalSystem
from pyklip_diffrender.planning import ModelError, Plan, plan
from pyklip_diffrender.refinement.breakdown import breakdown_explained
from pyklip_diffrender.refinement.continuation import continue_from, fit_in_stages
from pyklip_diffrender.refinement.frame_fit import FrameFit
from pyklip_diffrender.refinement.problem import Problem
from pyklip_diffrender.refinement.result import Refinement
from pyklip_diffrender.refinement.settings import GaussNewton

__all__ = ["choose_plan", "fit_problems", "refine_again"]

_log = logging.getLogger(__name__)


def choose_plan(
    requested: Plan | str, problems: Sequence[Problem], settings: GaussNewton, seed: int
) -> Plan | None:
    """Return the plan of a fit, or None to fit with the full model.

    Parameters
    ----------
    requested : Plan, "auto" or "off"
    problems : sequence of Problem
        To be fitted together.
    settings : GaussNewton
    seed : int
        Seed of the wavefronts that a plan draws.

    Raises
    ------
    IncompatibleSetupError
        For a plan that was made for another system.
    """
    if isinstance(requested, Plan):
        _require_plan_for(problems[0].model, requested)
        return requested
    if requested not in ("auto", "off"):
        raise IncompatibleSetupError(f"plan: got {requested!r}, expected 'auto', 'off' or a Plan")
    # A user who chooses the basis, or fits no wavefront, has decided how fine the model is to be.
    # The preset for real frames, with a free pupil amplitude, cannot be made coarser.
    decided = settings.basis is not None or not settings.wavefront
    if requested == "off" or decided or settings.prior.amplitude_scale > 0:
        return None
    return _make_plan(problems, settings, seed)


def _make_plan(problems: Sequence[Problem], settings: GaussNewton, seed: int) -> Plan:
    """Plan the model fidelity for the first problem that is not of a reference star."""
    science = next((p for p in problems if not p.observation.reference), problems[0])
    cycles = settings.cycles or (24.0,)
    keep: dict[str, Any] = {}
    if settings.drift is not None or not settings.cycles:
        keep["cycles"] = float(cycles[0])
    if len(problems) > 1:
        # A correction belongs to one position of the star.
        keep["multifidelity"] = False
    return plan(
        science.model,
        science.observation,
        science.initial,
        # Several frames have less noise than one, so that smaller model errors matter.
        error_budget=0.1 / math.sqrt(len(problems)),
        keep=keep,
        start=science.start,
        prior=settings.prior,
        cycles=cycles,
        model_error=settings.min_model_error,
        seed=seed,
    )


def _require_plan_for(model: OpticalSystem, planned: Plan) -> None:
    original = planned.given
    ours, theirs = (
        (each.npix, each.detector.shape, each.bandpass, each.parameters)
        for each in (model, original)
    )
    if ours != theirs:
        raise IncompatibleSetupError(
            f"plan: it was made for {original!r}, the model is {model!r}. Make one for it with "
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
    """Refine with the cheaper model of a plan, if there is one.

    At the end the star is rendered with the full model. If the two stars differ by more than the
    budget of the plan, the fit continues with the full model.

    Parameters
    ----------
    problems : sequence of Problem
        One for each frame, with the full model.
    settings : GaussNewton
    planned : Plan or None
        None to fit with the full model.
    warm : mapping of Unknown to float, optional
        Starting values.
    seed : int
        Recorded with the result.
    progress : bool
        Show progress bars.
    """
    if planned is None:
        return fit_in_stages(problems, settings, warm, seed=seed, progress=progress)
    began = time.perf_counter()
    cheap = [problem.with_model(planned.model) for problem in problems]
    adapted = settings
    if settings.basis is None and warm is None:
        adapted = replace(settings, cycles=planned.refine_options["cycles"])
    fit = fit_in_stages(cheap, adapted, warm, seed=seed, progress=progress)
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
        "the stars of the planned and of the full model differ by %.2g sigma (worst pixel %.2g), "
        "more than the budget of %.2g: the fit continues with the full model",
        error.rms,
        error.worst,
        planned.budget,
    )
    exact = fit_in_stages(problems, *continue_from(fit), seed=seed, progress=progress)
    return replace(
        exact,
        plan=replace(planned, final_error=error, abandoned=True),
        seconds=time.perf_counter() - began,
    )


def _on_full_model(
    fit: Refinement, k: int, problem: Problem, free: tuple[str, ...]
) -> tuple[FrameFit, ModelError]:
    """One frame of a planned fit with the full model, and the change of its star."""
    frame, model = fit.frames[k], problem.model
    opd = frame.opd
    if frame.model.npix != model.npix:
        grid = PupilGrid.full(model.npix, model.diameter)
        coefficients = torch.from_numpy(frame.coefficients)
        change = fit.basis.opd(coefficients * NANOMETRE, grid)
        opd = problem.starting_opd(model.npix).cpu().numpy() + change.numpy()
    values = {n: torch.from_numpy(v) for n, v in frame.values.items() if n in model.parameters}
    with torch.no_grad():
        image = model(torch.from_numpy(np.ascontiguousarray(opd)).to(model.device), **values)
    image = problem.gain * image.double()
    fixed = frame.pedestal * (problem.gain - 1)
    # Flux and background for which the full model is closest to the fitted star.
    before = torch.from_numpy(frame.star).to(model.device)
    linear = tuple(name for name in ("flux", "background") if name in free)
    start = {name: float(frame.values[name][0]) for name in ("flux", "background")}
    flux, level = problem.flux_and_background(
        image, problem.sigma, linear, data=before - fixed, start=start
    )
    star = flux * image + level + fixed
    difference = ((star - before) / problem.sigma)[problem.valid].abs()
    error = ModelError(float(difference.square().mean().sqrt()), float(difference.max()))
    fitted = {**frame.values, "flux": np.array([flux]), "background": np.array([level])}
    return replace(frame, model=model, opd=opd, star=star.cpu().numpy(), values=fitted), error


def refine_again(fit: Refinement, *, progress: bool = False, **changes: Any) -> Refinement:
    """Continue a refinement with other settings.

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
        If the fit was read from a file without its linear model.
    """
    settings, warm = continue_from(fit, **changes)
    problems = [
        Problem(frame.model, frame.observation, fit.initial, frame.start, fit.systematics)
        for frame in fit.frames
    ]
    planned = None if fit.plan is None or fit.plan.abandoned else fit.plan
    with breakdown_explained(problems[0].observation.name):
        return fit_problems(problems, settings, planned, warm, seed=fit.seed, progress=progress)
