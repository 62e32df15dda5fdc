"""Refinement of a wavefront until the star that it renders matches the data."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import numpy as np

from pyklip_diffrender.errors import IncompatibleSetupError, MissingOPDError
from pyklip_diffrender.observation import Observation
from pyklip_diffrender.opd import as_opd_map
from pyklip_diffrender.optics import OpticalSystem
from pyklip_diffrender.refinement.gauss_newton import GaussNewtonOptions, gauss_newton
from pyklip_diffrender.refinement.gradient import AdamOptions, LBFGSOptions, adam, lbfgs
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
]

METHODS = {
    "gauss-newton": (gauss_newton, GaussNewtonOptions),
    "adam": (adam, AdamOptions),
    "lbfgs": (lbfgs, LBFGSOptions),
}


def refine(
    model: OpticalSystem,
    observation: Observation,
    opd: Any,
    *,
    method: str = "gauss-newton",
    start: dict[str, Any] | None = None,
    seed: int = 0,
    progress: bool = False,
    **options: Any,
) -> Refinement:
    """Refine an outdated wavefront until the rendered star matches an observation.

    Parameters
    ----------
    model : OpticalSystem
        Its detector must have the observation's shape.
    observation : Observation
        All its frames see the same star through the same wavefront; refine rolls one by one.
    opd : path, OPDMap, Quantity or array
        The wavefront to start from, entrance-pupil orientation; bare arrays in metres. It is
        resampled to the model's pupil.
    method : "gauss-newton", "adam" or "lbfgs"
        The default fits segment motions and Fourier modes with a prior and gives errors; adam is
        the recipe of Feng et al. 2025; lbfgs needs no response matrix.
    start : dict, optional
        Starting values by parameter name; "detector_shift" follows from the observation's star
        position unless given.
    seed : int
        Recorded with the result. The methods themselves draw no random numbers.
    progress : bool
        Show a bar.
    **options
        Fields of `GaussNewtonOptions`, `AdamOptions` or `LBFGSOptions`, such as `free`.

    Returns
    -------
    Refinement
        The best iterate; look at its `status`.

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
    run, settings = METHODS[method]
    try:
        chosen = settings(**options)
    except TypeError as error:
        raise IncompatibleSetupError(
            f"refine(method={method!r}): {error}. It takes "
            f"{', '.join(field.name for field in fields(settings))}"
        ) from error
    begin = dict(start or {})
    ny, nx = observation.shape
    away = observation.center[0] - np.array([(nx - 1) / 2, (ny - 1) / 2])
    if "detector_shift" not in begin and np.abs(away).max() > 1e-9:
        begin["detector_shift"] = away * np.array(model.detector.pixelscale)
    problem = Problem(model, observation, as_opd_map(opd), begin)
    return run(problem, chosen, seed=seed, progress=progress)  # type: ignore[operator]
