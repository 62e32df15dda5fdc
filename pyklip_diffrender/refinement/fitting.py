"""`refine`: fit the star in observed frames, starting from a wavefront map."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from pyklip_diffrender.errors import (
    IncompatibleSetupError,
    MissingOPDError,
    NoValidPixelsError,
    ShapeError,
)
from pyklip_diffrender.optics.system import OpticalSystem
from pyklip_diffrender.refinement.continuation import fit_in_stages
from pyklip_diffrender.refinement.fit_result import Refinement
from pyklip_diffrender.refinement.problem import Problem
from pyklip_diffrender.refinement.settings import GaussNewton, settings_for
from pyklip_diffrender.refinement.status import breakdown_explained
from pyklip_diffrender.scene.agreement import require_agreement
from pyklip_diffrender.scene.observation import Observation
from pyklip_diffrender.scene.systematics import Systematics
from pyklip_diffrender.wavefront.opd import as_opd_map

__all__ = ["refine"]

Start = Mapping[str, Any]


def refine(
    model: OpticalSystem,
    observation: Observation | Sequence[Observation],
    opd: Any,
    *,
    settings: GaussNewton | None = None,
    start: Start | Sequence[Start] | None = None,
    systematics: Systematics | None = None,
    progress: bool = False,
) -> Refinement:
    """Refine an outdated wavefront until the rendered star matches the data.

    Parameters
    ----------
    model : OpticalSystem
        Its detector must have the shape of the observations.
    observation : Observation or sequence of Observation
        The frames of one observation see the same star through the same wavefront and are
        averaged. Several observations (rolls, dithers, a reference star) are fitted together:
        each has its own star position, flux and background (`GaussNewton.own`), their wavefront
        is shared, or differs by as much as `GaussNewton.drift` allows, and companions rotate with
        the position angle.
    opd : path, OPDMap, Quantity, array or "flat"
        The wavefront to start from, entrance-pupil orientation; bare arrays in metres. It is
        resampled to the model's pupil. "flat" stands for a flat wavefront.
    settings : GaussNewton, optional
        Default `GaussNewton.nircam()` for frames whose header says NIRCam, else `GaussNewton()`.
    start : dict or sequence of dict, optional
        Starting values by parameter name, for all observations or one by one. "detector_shift"
        is by default that of the star in the observation.
    systematics : Systematics, optional
        Known flat-field pattern, see `learn_systematics`.
    progress : bool
        Show progress bars.

    Returns
    -------
    Refinement
        The best iterate; check its `status`.

    Raises
    ------
    MissingOPDError
        If `opd` is None.
    IncompatibleSetupError
        For settings or systematics that do not fit the model and the observations.
    ShapeError, UnitError, NonFiniteError, NoValidPixelsError, CorruptFileError
        As their names say.
    RefinementError
        If the frames show something so different from the model that the equations cannot be
        solved.

    Examples
    --------
    >>> import pyklip_diffrender as dr
    >>> model = dr.nircam_coronagraph("F444W", monochromatic=4.5e-6, npix=128, fov_pixels=32)
    >>> opd = dr.random_opd(1, npix=128)
    >>> frames = dr.simulate(model, dr.Scene(), opd, seed=3)
    >>> fit = dr.refine(model, frames, opd, settings=dr.GaussNewton(cycles=6))
    >>> fit.status.name
    'CONVERGED'
    """
    if opd is None:
        raise MissingOPDError(
            "refine needs a wavefront to start from: a path to an OPD map, an array in metres, "
            "'flat' if there is none, or random_opd(seed) to try things out"
        )
    if not isinstance(model, OpticalSystem):
        raise IncompatibleSetupError(
            f"model: got a {type(model).__name__}, expected an OpticalSystem. The order of the "
            "arguments is refine(model, observation, opd)"
        )
    observations = [observation] if isinstance(observation, Observation) else list(observation)
    if not observations:
        raise NoValidPixelsError("observation: got an empty sequence, expected at least one")
    require_agreement(observations)
    adapted = settings_for(observations[0]) if settings is None else settings
    if not isinstance(adapted, GaussNewton):
        raise IncompatibleSetupError(
            f"settings: got a {type(adapted).__name__}, expected GaussNewton"
        )
    if adapted.free == GaussNewton().free:
        # A system without a Lyot stop has no parameters of one.
        available = (*model.parameters, "flux", "background")
        adapted = replace(adapted, free=tuple(name for name in adapted.free if name in available))
    wavefront = as_opd_map(opd)
    problems = [
        Problem(model, each, wavefront, _with_position(model, each, begin), systematics)
        for each, begin in zip(observations, _one_by_one(start, len(observations)), strict=True)
    ]
    with breakdown_explained(observations[0].name):
        return fit_in_stages(problems, adapted, progress=progress)


def _one_by_one(start: Start | Sequence[Start] | None, count: int) -> list[Start]:
    if start is None or isinstance(start, Mapping):
        return [start or {}] * count
    if len(start) != count:
        raise ShapeError(
            f"start: got {len(start)} dicts for {count} observations, expected one for each or "
            "one for all"
        )
    return list(start)


def _with_position(model: OpticalSystem, observation: Observation, start: Start) -> dict[str, Any]:
    """Add the position of the star, if the observation has one, to the starting values."""
    ny, nx = observation.shape
    displacement = observation.center[0] - np.array([(nx - 1) / 2, (ny - 1) / 2])
    axis = displacement * np.array(model.detector.pixelscale)
    if observation.star_offset is not None and "star_offset" in model.parameters:
        start = {"star_offset": observation.star_offset, **start}
        # The optical axis goes through the occulter, and the star's image is beside it.
        axis -= observation.star_offset
    if "detector_shift" in start or np.abs(axis).max() <= 1e-10:
        return dict(start)
    return {**start, "detector_shift": axis}
