"""Refinement by a plan: with the cheap model, then back to the one that was given."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.linear.response import NANOMETRE
from pyklip_diffrender.optics.grid import PupilGrid
from pyklip_diffrender.optics.system import OpticalSystem
from pyklip_diffrender.planning import ModelError, Plan, plan
from pyklip_diffrender.refinement.growth import gauss_newton
from pyklip_diffrender.refinement.options import GaussNewtonOptions
from pyklip_diffrender.refinement.problem import Problem
from pyklip_diffrender.refinement.result import Refinement
from pyklip_diffrender.scene.objects import Planet
from pyklip_diffrender.scene.observation import Observation
from pyklip_diffrender.wavefront.opd import OPDMap

__all__ = ["make_plan", "refine_by_plan", "require_plan_for"]

_log = logging.getLogger(__name__)


def make_plan(
    model: OpticalSystem,
    observations: Sequence[Observation],
    wavefront: OPDMap,
    options: GaussNewtonOptions,
    start: dict[str, Any],
    seed: int,
) -> Plan:
    """A plan for a fit with given settings; what they decide is not up to the plan.

    Parameters
    ----------
    model : OpticalSystem
    observations : sequence of Observation
        To be fitted together. The plan is made for the first that is of the target.
    wavefront : OPDMap
    options : GaussNewtonOptions
    start : dict
        Of that observation.
    seed : int
    """
    cycles = options.cycles or (24.0,)
    several = len(observations) > 1
    keep: dict[str, Any] = {}
    fixed = (options.basis, options.drift, options.resume)
    if any(each is not None for each in fixed) or not options.wavefront or not options.cycles:
        keep["cycles"] = float(cycles[0])
    if options.prior.amplitude_scale > 0:
        # The amplitude that the fit finds is a map on the model's own grid.
        keep["npix"] = model.npix
    if several:
        # A correction belongs to one position of the star.
        keep["multifidelity"] = False
    science = [each for each in observations if not each.reference] or list(observations)
    return plan(
        model,
        science[0],
        wavefront,
        # What one frame hardly sees, many do.
        error_budget=0.1 / math.sqrt(len(observations)),
        keep=keep,
        start=start,
        # Another basis has groups of its own, which say nothing about the default modes.
        prior=options.prior if options.basis is None else None,
        cycles=cycles,
        response_npix=options.response_npix,
        model_error=options.kappa_floor,
        seed=seed,
    )


def require_plan_for(model: OpticalSystem, planned: Plan) -> None:
    """Refuse a plan that was made for another system.

    Raises
    ------
    IncompatibleSetupError
    """
    given = planned.given
    ours = (model.npix, model.detector.shape, model.bandpass, model.parameters)
    theirs = (given.npix, given.detector.shape, given.bandpass, given.parameters)
    if ours != theirs:
        raise IncompatibleSetupError(
            f"fidelity: the plan was made for {given!r}, the model is {model!r}. Make one for it "
            "with plan(model, observation, opd)"
        )


def refine_by_plan(
    planned: Plan,
    problems: Sequence[Problem],
    options: GaussNewtonOptions,
    *,
    seed: int,
    progress: bool,
) -> list[Refinement]:
    """Refine with the plan's model, and give back results on the model of the problems.

    At the end the star is rendered with the given model. If that differs by more than the plan's
    budget, the fit goes on from there with the model as given.

    Parameters
    ----------
    planned : Plan
    problems : sequence of Problem
        With the model as given.
    options : GaussNewtonOptions
        As given: what the plan chooses takes the place of some of it.
    seed : int
    progress : bool
    """
    began = time.perf_counter()
    cheap = [Problem(planned.model, p.observation, p.initial, p.start, p) for p in problems]
    chosen = options
    if options.basis is None:
        chosen = replace(options, cycles=planned.refine_options["cycles"])
    fits = gauss_newton(cheap, chosen, seed=seed, progress=progress)
    if not fits[0].status.usable:
        return [replace(fit, plan=planned) for fit in fits]
    found = [_as_given(fit, p, planned) for fit, p in zip(fits, problems, strict=True)]
    error = ModelError.largest(each for _, each in found)
    if planned.allows(error):
        done = replace(planned, final_error=error)
        seconds = time.perf_counter() - began
        return [replace(fit, plan=done, seconds=seconds) for fit, _ in found]
    _log.warning(
        "the plan's star is %.2g sigma (worst pixel %.2g) from that of the given model, more than "
        "the budget of %.2g: the fit goes on with the model as given",
        error.rms,
        error.worst,
        planned.budget,
    )
    exact = gauss_newton(problems, _going_on(options, fits), seed=seed, progress=progress)
    done = replace(planned, final_error=error, abandoned=True)
    seconds = time.perf_counter() - began
    return [replace(fit, plan=done, seconds=seconds) for fit in exact]


def _as_given(fit: Refinement, problem: Problem, planned: Plan) -> tuple[Refinement, ModelError]:
    """A cheap fit on the grid of the given model, its star rendered with that, and the change."""
    model = problem.model
    opd = fit.opd
    if planned.model.npix != model.npix:
        assert fit.coefficients is not None
        grid = PupilGrid.full(model.npix, model.diameter)
        change = fit.settings.basis.opd(fit.coefficients.cpu() * NANOMETRE, grid)
        opd = problem.opd0.cpu().numpy() + change.numpy()
    given = {n: torch.from_numpy(v) for n, v in fit.values.items() if n in model.parameters}
    with torch.no_grad():
        image = model(torch.from_numpy(np.ascontiguousarray(opd)).to(model.device), **given)
    # Flux and background at which the given model's star comes nearest to the one fitted.
    before = torch.from_numpy(fit.star_image).to(model.device)
    free = tuple(name for name in ("flux", "background") if name in fit.settings.free)
    start = {name: float(fit.values[name][0]) for name in ("flux", "background")}
    flux, level = problem.flux_and_background(
        image.double(), problem.sigma, free, data=before, start=start
    )
    star = flux * image.double() + level
    away = ((star - before) / problem.sigma)[problem.valid].abs()
    error = ModelError(float(away.square().mean().sqrt()), float(away.max()))
    values = {**fit.values, "flux": np.array([flux]), "background": np.array([level])}
    finished = replace(fit, model=model, opd=opd, star_image=star.cpu().numpy(), values=values)
    return finished, error


def _going_on(options: GaussNewtonOptions, fits: Sequence[Refinement]) -> GaussNewtonOptions:
    """The given settings, from where cheap fits ended."""
    first = fits[0]
    scales = {name: first.scales[name] for name in options.prior.scales}
    drift = options.drift
    if drift is not None and len(fits) > 1:
        drift = replace(drift, scales={n: first.scales[f"{n} drift"] for n in drift.scales})
    planets = options.planets
    if not first.observation.reference:
        planets = tuple(
            Planet(max(c, 0.0), math.hypot(x, y), math.degrees(math.atan2(-x, y)))
            for c, x, y in first.companions.tolist()
        )
    return replace(
        options,
        prior=replace(options.prior, scales=scales),
        drift=drift,
        planets=planets,
        resume=first.linear,
    )
