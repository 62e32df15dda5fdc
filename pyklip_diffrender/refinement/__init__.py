"""Refinement of a wavefront until the star that it renders matches the data."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace
from typing import Any, overload

import numpy as np

from pyklip_diffrender.errors import (
    IncompatibleSetupError,
    MissingOPDError,
    NoValidPixelsError,
    ShapeError,
)
from pyklip_diffrender.optics.system import OpticalSystem
from pyklip_diffrender.planning import Plan
from pyklip_diffrender.refinement.gradient import AdamOptions, LBFGSOptions, adam, lbfgs
from pyklip_diffrender.refinement.growth import gauss_newton
from pyklip_diffrender.refinement.options import GaussNewtonOptions
from pyklip_diffrender.refinement.planned import make_plan, refine_by_plan, require_plan_for
from pyklip_diffrender.refinement.problem import Problem
from pyklip_diffrender.refinement.result import Refinement, Status
from pyklip_diffrender.scene.observation import Observation
from pyklip_diffrender.wavefront.opd import as_opd_map

__all__ = [
    "FIDELITY",
    "METHODS",
    "AdamOptions",
    "GaussNewtonOptions",
    "LBFGSOptions",
    "Refinement",
    "Status",
    "refine",
    "refine_again",
]

FIDELITY = "planned"
"""Of `refine` by the default method, where nothing is said: "as given" or "planned"."""

METHODS = {
    "gauss-newton": GaussNewtonOptions,
    "adam": AdamOptions,
    "lbfgs": LBFGSOptions,
}
"""Methods and their settings."""


@overload
def refine(
    model: OpticalSystem,
    observation: Observation,
    opd: Any,
    *,
    method: str = ...,
    start: dict[str, Any] | None = ...,
    fidelity: Plan | str | None = ...,
    seed: int = ...,
    progress: bool = ...,
    **options: Any,
) -> Refinement: ...


@overload
def refine(
    model: OpticalSystem,
    observation: Sequence[Observation],
    opd: Any,
    *,
    method: str = ...,
    start: dict[str, Any] | Sequence[dict[str, Any]] | None = ...,
    fidelity: Plan | str | None = ...,
    seed: int = ...,
    progress: bool = ...,
    **options: Any,
) -> list[Refinement]: ...


def refine(
    model: OpticalSystem,
    observation: Observation | Sequence[Observation],
    opd: Any,
    *,
    method: str = "gauss-newton",
    start: dict[str, Any] | Sequence[dict[str, Any]] | None = None,
    fidelity: Plan | str | None = None,
    seed: int = 0,
    progress: bool = False,
    **options: Any,
) -> Refinement | list[Refinement]:
    """Refine an outdated wavefront until the rendered star matches an observation.

    Parameters
    ----------
    model : OpticalSystem
        Its detector must have the observation's shape.
    observation : Observation or sequence of Observation
        The frames of one observation see the same star through the same wavefront and are
        averaged. Several observations (rolls, dithers, snapshots, a reference star) are fitted
        together: each has its own star position, flux and background (option `own`), their
        wavefront is shared, or differs by as much as the option `drift` allows, and what is said
        to be a companion turns with the position angle.
    opd : path, OPDMap, Quantity or array
        The wavefront to start from, entrance-pupil orientation; bare arrays in metres. It is
        resampled to the model's pupil.
    method : "gauss-newton", "adam" or "lbfgs"
        The default fits segment motions and Fourier modes with a prior and gives errors; adam is
        the recipe of Feng et al. 2025; lbfgs needs no response matrix.
    start : dict or sequence of dict, optional
        Starting values by parameter name, for all observations or one by one; "detector_shift"
        follows from the observation's star position unless given.
    fidelity : "planned", "as given" or Plan, optional
        "planned" first finds out, with `pyklip_diffrender.plan`, what can be made cheaper without
        an error that could be seen; a plan that was made before is used as it is. "as given" fits
        with the model as it is. Either way the result is on the model as given, and its star
        rendered with that. Default "planned", but as given where the options bring a basis of
        their own or fit no wavefront. The recipes "adam" and "lbfgs" are always done as given.
    seed : int
        Recorded with the result. The methods themselves draw no random numbers; a plan does.
    progress : bool
        Show a bar.
    **options
        Fields of `GaussNewtonOptions`, `AdamOptions` or `LBFGSOptions`, such as `free`.

    Returns
    -------
    Refinement, or a list of them, one an observation
        The best iterate; look at its `status`. Those of a list share one linear model.

    Raises
    ------
    MissingOPDError
        If `opd` is None.
    IncompatibleSetupError
        For an unknown method or option.
    ShapeError, UnitError, NonFiniteError, NoValidPixelsError, CorruptFileError
        As their names say.
    """
    if opd is None:
        raise MissingOPDError(
            "refine needs a wavefront to start from: a path to an OPD map, an array in metres, "
            "or opd.random_opd(seed) to try things out"
        )
    if method not in METHODS:
        raise IncompatibleSetupError(f"method: got {method!r}, expected one of {tuple(METHODS)}")
    settings = METHODS[method]
    try:
        chosen = settings(**options)
    except TypeError as error:
        raise IncompatibleSetupError(
            f"refine(method={method!r}): {error}. It takes "
            f"{', '.join(field.name for field in fields(settings))}"
        ) from error
    if "free" not in options and not isinstance(chosen, AdamOptions):
        # A system without a Lyot stop has no parameters of one.
        known = (*model.parameters, "flux", "background")
        chosen = replace(chosen, free=tuple(name for name in chosen.free if name in known))
    several = not isinstance(observation, Observation)
    observations = [observation] if isinstance(observation, Observation) else list(observation)
    if not observations:
        raise NoValidPixelsError("observation: got an empty sequence, expected at least one")
    starts = _one_by_one(start, len(observations))
    wavefront = as_opd_map(opd)
    problems = [
        Problem(model, each, wavefront, _with_position(model, each, begin))
        for each, begin in zip(observations, starts, strict=True)
    ]
    if isinstance(chosen, GaussNewtonOptions):
        planned = _plan(fidelity, problems, chosen, seed)
        if planned is None:
            found = gauss_newton(problems, chosen, seed=seed, progress=progress)
        else:
            found = refine_by_plan(planned, problems, chosen, seed=seed, progress=progress)
        return found if several else found[0]
    if fidelity not in (None, "as given"):
        raise IncompatibleSetupError(
            f"refine(method={method!r}): fidelity: got {fidelity!r}, but this recipe is done with "
            'the model as given; use method="gauss-newton"'
        )
    if several:
        raise IncompatibleSetupError(
            f"refine(method={method!r}) takes one observation, got {len(observations)}: several "
            'are fitted together by method="gauss-newton"'
        )
    if isinstance(chosen, AdamOptions):
        return adam(problems[0], chosen, seed=seed, progress=progress)
    return lbfgs(problems[0], chosen, seed=seed, progress=progress)


def _plan(
    fidelity: Plan | str | None, problems: Sequence[Problem], options: GaussNewtonOptions, seed: int
) -> Plan | None:
    """The plan to follow; None for the model as given."""
    first = problems[0]
    # Own modes, or none, say how fine a fit is meant to be.
    decided = options.basis is not None or options.resume is not None or not options.wavefront
    if fidelity is None and decided:
        return None
    wanted = FIDELITY if fidelity is None else fidelity
    if isinstance(wanted, Plan):
        require_plan_for(first.model, wanted)
        return wanted
    if wanted == "as given":
        return None
    if wanted != "planned":
        raise IncompatibleSetupError(
            f"fidelity: got {wanted!r}, expected 'as given', 'planned' or a Plan"
        )
    science = next((p for p in problems if not p.observation.reference), first)
    observations = [problem.observation for problem in problems]
    return make_plan(first.model, observations, science.initial, options, science.start, seed)


def refine_again(
    fits: Sequence[Refinement], *, progress: bool = False, **changes: Any
) -> list[Refinement]:
    """Go on from frames that were refined together, with other settings.

    Parameters
    ----------
    fits : sequence of Refinement
        All that one call of `refine` gave, in order.
    progress : bool
    **changes
        Fields of `GaussNewtonOptions`, such as `planets`.

    Returns
    -------
    list of Refinement
    """
    first = fits[0]
    if first.linear is None or not isinstance(first.settings, GaussNewtonOptions):
        raise IncompatibleSetupError("refine_again: only fits by Gauss-Newton can be gone on with")
    old = first.settings
    prior = replace(old.prior, scales={name: first.scales[name] for name in old.prior.scales})
    drift = old.drift
    if drift is not None and len(fits) > 1:
        found = {name: first.scales[f"{name} drift"] for name in drift.scales}
        drift = replace(drift, scales=found)
    settings = replace(old, **{"prior": prior, "drift": drift, "resume": first.linear, **changes})
    problems = [Problem(f.model, f.observation, f.initial, f.start) for f in fits]
    if first.plan is not None and not first.plan.abandoned:
        return refine_by_plan(first.plan, problems, settings, seed=first.seed, progress=progress)
    return gauss_newton(problems, settings, seed=first.seed, progress=progress)


def _one_by_one(
    start: dict[str, Any] | Sequence[dict[str, Any]] | None, count: int
) -> list[dict[str, Any]]:
    if start is None or isinstance(start, dict):
        return [start or {}] * count
    if len(start) != count:
        raise ShapeError(
            f"start: got {len(start)} dicts for {count} observations, expected one for each or "
            "one for all"
        )
    return list(start)


def _with_position(
    model: OpticalSystem, observation: Observation, start: dict[str, Any]
) -> dict[str, Any]:
    """Starting values, with the star's position on the detector if the observation has one."""
    ny, nx = observation.shape
    away = observation.center[0] - np.array([(nx - 1) / 2, (ny - 1) / 2])
    if "detector_shift" in start or np.abs(away).max() <= 1e-9:
        return dict(start)
    return {**start, "detector_shift": away * np.array(model.detector.pixelscale)}
