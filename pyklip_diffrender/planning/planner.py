"""`plan`: measure economies, choose the cheapest set within the budget, verify it as a whole."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields, replace
from itertools import product
from typing import Any

import numpy as np
import torch

from pyklip_diffrender.errors import DiffrenderWarning, IncompatibleSetupError, MissingOPDError
from pyklip_diffrender.optics.system import OpticalSystem
from pyklip_diffrender.planning.choice import Choice, Economy, ModelError, Option
from pyklip_diffrender.planning.probes import PROBES
from pyklip_diffrender.planning.result import Plan, plan_table
from pyklip_diffrender.planning.trial import Trial
from pyklip_diffrender.scene.objects import Scene
from pyklip_diffrender.scene.observation import Observation
from pyklip_diffrender.wavefront.opd import as_opd_map, resample
from pyklip_diffrender.wavefront.priors import WavefrontPrior

__all__ = ["plan"]

_log = logging.getLogger(__name__)

_SHARE_OF_BUDGET = 0.9
"""Fraction of the budget for the expected errors, which differ between wavefronts."""


def plan(
    model: OpticalSystem,
    subject: Scene | Observation,
    opd: Any,
    *,
    error_budget: float = 0.1,
    keep: Mapping[str, Any] | None = None,
    start: Mapping[str, Any] | None = None,
    prior: WavefrontPrior | None = None,
    cycles: Sequence[float] = (24.0, 32.0),
    response_npix: int = 128,
    model_error: float = 0.0,
    seed: int = 0,
) -> Plan:
    """Find the cheapest settings that model a star to within a fraction of its noise.

    Every economy is measured on the scene itself: the star is rendered with and without it, at
    the starting wavefront and after a drift drawn from the prior, and the difference is taken in
    units of the pixel noise. Flux and background, which are free in every fit, are fitted to the
    difference and subtracted. Errors of several economies add in quadrature. The chosen set is
    rendered as a whole at an independent wavefront; if its error exceeds the budget, the economy
    that matters most is made finer and the set is verified again.

    Parameters
    ----------
    model : OpticalSystem
        The finest model: errors are relative to it, and no setting becomes finer. Settings that it
        cannot change (see `OpticalSystem.adjustable`) stay as they are.
    subject : Scene or Observation
        A scene to be simulated, or frames. For frames, the prior is widened until it explains
        their misfit at the start.
    opd : path, OPDMap, Quantity or array
        Wavefront to start from, as for `refine`.
    error_budget : float
        Largest rms error of the star model over the valid pixels, in units of their noise. The
        error of a single pixel may be ten times as large.
    keep : mapping, optional
        Fixed settings: fields of `planning.Choice`, such as ``npix`` and ``cycles``.
    start : mapping, optional
        The model's other parameters, as for `refine`.
    prior : WavefrontPrior, optional
        Expected drift of the wavefront.
    cycles : sequence of float
        Highest spatial frequencies of the modes that a fit may use, see `refine`; the plan starts
        from the first.
    response_npix : int
        Pupil samples for derivatives; see `refine`.
    model_error : float
        Known model error as a fraction of the star (`GaussNewton.min_model_error`).
    seed : int
        Random seed of the drifts.

    Returns
    -------
    Plan
        ``print(plan)`` shows what was chosen and why.

    Raises
    ------
    MissingOPDError
        If `opd` is None.
    IncompatibleSetupError
        For a setting in `keep` that is unknown or not available, a budget that is not positive, no
        `cycles`, or a subject of another type.
    ShapeError, NoValidPixelsError
        For frames of another shape than the model's, or without valid pixels.

    Warns
    -----
    DiffrenderWarning
        If the settings in `keep` exceed the budget.

    Examples
    --------
    >>> import pyklip_diffrender as dr
    >>> model = dr.nircam_coronagraph("F444W", monochromatic=4.5e-6, npix=128, fov_pixels=24)
    >>> scene = dr.Scene(star=dr.Star(w2_magnitude=11.0))
    >>> plan = dr.plan(model, scene, dr.random_opd(1, npix=128))
    >>> plan.choice.npix <= 128
    True
    """
    if opd is None:
        raise MissingOPDError("plan needs the wavefront that the refinement will start from")
    if not error_budget > 0:
        raise IncompatibleSetupError(
            f"error_budget: got {error_budget}, expected a positive number of sigma, such as 0.1"
        )
    if not cycles:
        raise IncompatibleSetupError("cycles: got none, expected at least one")
    if not isinstance(subject, Scene | Observation):
        raise IncompatibleSetupError(
            f"plan: got a {type(subject).__name__} to plan for, expected a Scene or an Observation"
        )
    pins = dict(keep or {})
    names = [setting.name for setting in fields(Choice)]
    if unknown := [name for name in pins if name not in names]:
        raise IncompatibleSetupError(
            f"keep: got {unknown}, expected settings that a plan chooses: {', '.join(names)}"
        )
    wavefront = np.ascontiguousarray(resample(as_opd_map(opd).data, model.npix))
    values = {name: value for name, value in (start or {}).items() if name in model.parameters}
    if isinstance(subject, Scene) and any(subject.star_offset):
        values.setdefault("star_offset", subject.star_offset)
    trial = Trial(
        model,
        subject,
        torch.from_numpy(wavefront).to(model.device),
        model.values(values),
        prior=prior or WavefrontPrior(),
        cycles=float(cycles[0]),
        response_npix=response_npix,
        model_error=model_error,
        budget=error_budget,
        seed=seed,
        pins=pins,
    )
    economies = []
    for probe in PROBES.values():
        economies.append(probe(trial))
        trial.learn(economies[-1])
    picked = _cheapest(trial, economies)
    picked, verified, steps = _verified(trial, economies, picked)
    if not verified.inside(error_budget):
        warnings.warn(
            f"plan: what is kept ({', '.join(pins)}) leaves {verified.rms:.2g} sigma (worst pixel "
            f"{verified.worst:.2g}), more than the budget of {error_budget:g}",
            DiffrenderWarning,
            stacklevel=2,
        )
    choice = _choice(trial, picked)
    _log.info("%s: %.3g sigma, verified %.3g", choice, error_budget, verified.rms)
    return Plan(
        model=trial.system(choice),
        given=model,
        choice=choice,
        refine_options={"cycles": (choice.cycles, *(c for c in cycles if c > choice.cycles))},
        table=plan_table(trial, economies, picked),
        budget=error_budget,
        error=ModelError.in_quadrature(option.error for option in picked),
        verified_error=verified,
        seconds=trial.seconds(choice),
        seconds_given=trial.seconds(trial.finest),
        seed=seed,
        pinned=tuple(pins),
        steps=tuple(steps),
    )


def _choice(trial: Trial, picked: Iterable[Option]) -> Choice:
    choice = trial.finest
    for option in picked:
        choice = replace(choice, **option.changes)
    return choice


def _cheapest(trial: Trial, economies: Sequence[Economy]) -> list[Option]:
    """The fastest of all sets of options whose combined error is within the budget."""
    room = _SHARE_OF_BUDGET * trial.budget
    offered = []
    for economy in economies:
        fitting = [option for option in economy.options if option.error.inside(room)]
        # Settings that the caller keeps may exceed it; then take the best of them.
        offered.append(fitting or [min(economy.options, key=lambda option: option.error.rms)])

    def rank(picked: Iterable[Option]) -> tuple[bool, float, float]:
        error = ModelError.in_quadrature(option.error for option in picked)
        inside = error.inside(room)
        seconds = trial.seconds(_choice(trial, picked)) if inside else 0.0
        return not inside, seconds, error.rms

    return list(min(product(*offered), key=rank))


def _verified(
    trial: Trial, economies: Sequence[Economy], picked: list[Option]
) -> tuple[list[Option], ModelError, list[str]]:
    """Verify the set as a whole; while over the budget, refine what matters most."""
    steps: list[str] = []
    while True:
        error = trial.verified(_choice(trial, picked))
        if error.inside(trial.budget):
            return picked, error, steps
        attempts = []
        for k, economy in enumerate(economies):
            after = economy.options[economy.options.index(picked[k]) + 1 :]
            finer = [option for option in after if option.error.rms <= picked[k].error.rms]
            if finer:
                # Each is rendered, because the errors that the probes expect may be wrong.
                candidate = [*picked[:k], finer[0], *picked[k + 1 :]]
                attempts.append((trial.verified(_choice(trial, candidate)).rms, k, candidate))
        if not attempts:
            return picked, error, steps
        _, k, picked = min(attempts, key=lambda attempt: attempt[:2])
        steps.append(economies[k].name)
        _log.info("verification: %.3g sigma; finer: %s", error.rms, economies[k].name)
