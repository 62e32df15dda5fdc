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
from pyklip_diffrender.observation import Observation
from pyklip_diffrender.opd import as_opd_map
from pyklip_diffrender.optics import OpticalSystem
from pyklip_diffrender.refinement.gradient import AdamOptions, LBFGSOptions, adam, lbfgs
from pyklip_diffrender.refinement.growth import gauss_newton
from pyklip_diffrender.refinement.options import GaussNewtonOptions
from pyklip_diffrender.refinement.problem import Problem
from pyklip_diffrender.refinement.result import Refinement, Status

__all__ = [
    "METHODS",
    "AdamOptions",
    "GaussNewtonOptions",
    "LBFGSOptions",
    "Refinement",
    "Status",
    "refine",
    "refine_again",
]

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
    seed : int
        Recorded with the result. The methods themselves draw no random numbers.
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
        found = gauss_newton(problems, chosen, seed=seed, progress=progress)
        return found if several else found[0]
    if several:
        raise IncompatibleSetupError(
            f"refine(method={method!r}) takes one observation, got {len(observations)}: several "
            'are fitted together by method="gauss-newton"'
        )
    if isinstance(chosen, AdamOptions):
        return adam(problems[0], chosen, seed=seed, progress=progress)
    return lbfgs(problems[0], chosen, seed=seed, progress=progress)


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
