"""Choosing: probe, pick the cheapest set inside the budget, verify it as a whole."""

from __future__ import annotations

import logging
import time
import warnings
from collections.abc import Mapping, Sequence
from itertools import product
from typing import Any

import numpy as np
import torch
from astropy import units as u
from astropy.table import QTable

from pyklip_diffrender.errors import (
    DiffrenderWarning,
    IncompatibleSetupError,
    MissingOPDError,
)
from pyklip_diffrender.optics.system import OpticalSystem
from pyklip_diffrender.planning import probes
from pyklip_diffrender.planning.build import DTYPES
from pyklip_diffrender.planning.choice import Choice, Economy, Error, Option, check_pins
from pyklip_diffrender.planning.result import Plan
from pyklip_diffrender.planning.trial import VERIFIED, Trial
from pyklip_diffrender.scene.objects import Scene
from pyklip_diffrender.scene.observation import Observation
from pyklip_diffrender.wavefront.opd import as_opd_map, resample
from pyklip_diffrender.wavefront.priors import WavefrontPrior

__all__ = ["plan"]

_log = logging.getLogger(__name__)

_SHARE_OF_BUDGET = 0.9
"""Of the budget that the expected errors may fill: another wavefront has somewhat other errors."""


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
    """Find the cheapest settings that model a star to within a share of its noise.

    Every economy is measured on the scene itself: the star is rendered with and without it, at
    the starting wavefront and after a drift drawn from the prior, and compared in units of the
    pixel noise. What another flux and background would explain is taken off, for every fit has
    them free; what a fit's wavefront would absorb is not, so that the errors are upper limits.
    Errors of several economies add in quadrature. The set that is chosen is rendered as a whole,
    at a wavefront that no probe has seen; if its error exceeds the budget, the economy that
    matters most is made finer and the set is verified again.

    Parameters
    ----------
    model : OpticalSystem
        As fine as wanted: errors are relative to it, and nothing becomes finer than it is.
    subject : Scene or Observation
        A star that is to be simulated, or frames. Of frames, the prior is widened until it
        explains how far the star is from them.
    opd : path, OPDMap, Quantity or array
        The wavefront to start from, as for `refine`.
    error_budget : float
        Largest rms error of the star model over the valid pixels, in units of their noise. The
        worst pixel may be ten times as far off.
    keep : mapping, optional
        Settings that are decided: fields of `fidelity.choice.Choice`, such as ``npix`` and
        ``cycles``.
    start : mapping, optional
        The model's other parameters, as for `refine`.
    prior : WavefrontPrior, optional
        How far the wavefront may have moved.
    cycles : sequence of float
        Of the finest set of modes; see `refine`.
    response_npix : int
        Of the finest derivatives; see `refine`.
    model_error : float
        Share of the star that the model may miss anyway (``kappa_floor`` of `refine`).
    seed : int
        Of the wavefronts and modes that are drawn.

    Returns
    -------
    Plan
        With ``print(plan)`` it explains itself.

    Raises
    ------
    MissingOPDError
        If `opd` is None.
    IncompatibleSetupError
        For a setting to keep that is not known or not to be had, or a budget that is not positive.
    ShapeError, NoValidPixelsError
        As their names say.

    Warns
    -----
    DiffrenderWarning
        If what is kept does not fit into the budget.
    """
    began = time.perf_counter()
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
    pins = _pins(keep or {})
    wavefront = np.ascontiguousarray(resample(as_opd_map(opd).data, model.npix))
    trial = Trial(
        model,
        subject,
        torch.from_numpy(wavefront).to(model.device),
        _values(model, subject, start or {}),
        prior=prior or WavefrontPrior(),
        cycles=float(cycles[0]),
        response_npix=response_npix,
        share=model_error,
        budget=error_budget,
        seed=seed,
        pins=pins,
    )
    economies = []
    for probe in probes.PROBES.values():
        economies.append(probe(trial))
        trial.learn(economies[-1])
    picked = _cheapest(trial, economies, error_budget)
    picked, verified, steps = _verified(trial, economies, picked, error_budget)
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
        refine_options={
            "cycles": (choice.cycles, *(c for c in cycles if c > choice.cycles)),
            "response_npix": choice.response_npix,
        },
        informative=trial.informative(choice).cpu().numpy(),
        table=_table(trial, economies, picked, error_budget),
        budget=error_budget,
        error=Error.in_quadrature(option.error for option in picked),
        verified_error=verified,
        seconds=trial.seconds(choice),
        seconds_given=trial.seconds(trial.finest),
        memory=trial.work.memory(choice),
        memory_given=trial.work.memory(trial.finest),
        planning_seconds=time.perf_counter() - began,
        seed=seed,
        pinned=tuple(pins),
        steps=tuple(steps),
    )


def _pins(keep: Mapping[str, Any]) -> dict[str, Any]:
    check_pins(keep)
    pins = dict(keep)
    names = {dtype: name for name, dtype in DTYPES.items()}
    if isinstance(pins.get("dtype"), torch.dtype):
        pins["dtype"] = names.get(pins["dtype"], str(pins["dtype"]))
    if "without" in pins:
        pins["without"] = tuple(sorted(pins["without"]))
    return pins


def _values(
    model: OpticalSystem, subject: Scene | Observation, start: Mapping[str, Any]
) -> dict[str, torch.Tensor]:
    given = {name: value for name, value in start.items() if name in model.parameters}
    if isinstance(subject, Scene) and any(subject.star_offset):
        given.setdefault("star_offset", subject.star_offset)
    return model.values(given)


def _choice(trial: Trial, picked: Sequence[Option]) -> Choice:
    choice = trial.finest
    for option in picked:
        choice = choice.changed(option.changes)
    return choice


def _cheapest(trial: Trial, economies: Sequence[Economy], budget: float) -> list[Option]:
    """Of all sets whose errors together stay inside the budget, the one that takes least time."""
    room = _SHARE_OF_BUDGET * budget
    offered = []
    for economy in economies:
        fitting = [each for each in economy.options if each.error.inside(room)]
        # What is pinned may be outside; then the best of it is taken, and the rest stays fine.
        offered.append(fitting or [min(economy.options, key=lambda each: each.error.rms)])
    best, best_rank = None, (False, float("inf"), float("inf"))
    for picked in product(*offered):
        error = Error.in_quadrature(option.error for option in picked)
        rank = (error.inside(room), 0.0, error.rms)
        if rank[0]:
            rank = (True, trial.seconds(_choice(trial, picked)), error.rms)
        if best is None or (not rank[0], *rank[1:]) < (not best_rank[0], *best_rank[1:]):
            best, best_rank = list(picked), rank
    assert best is not None, "every economy has an option"
    return best


def _verified(
    trial: Trial, economies: Sequence[Economy], picked: list[Option], budget: float
) -> tuple[list[Option], Error, list[str]]:
    """Verify as a whole; as long as that is outside the budget, make finer what matters most."""
    steps: list[str] = []
    while True:
        error = trial.verified(_choice(trial, picked))
        if error.inside(budget):
            return picked, error, steps
        tried = []
        for k, economy in enumerate(economies):
            after = economy.options[economy.options.index(picked[k]) + 1 :]
            finer = [each for each in after if each.error.rms <= picked[k].error.rms]
            if finer:
                # Whatever the probes say of it: one of them may be wrong.
                other = [*picked[:k], finer[0], *picked[k + 1 :]]
                tried.append((trial.verified(_choice(trial, other)).rms, k, other))
        if not tried:
            return picked, error, steps
        _, k, picked = min(tried, key=lambda each: each[:2])
        steps.append(economies[k].name)
        _log.info("verification: %.3g sigma; finer: %s", error.rms, economies[k].name)


_LABELS = {
    "pupil grid": "{npix}",
    "occulter sampling": "{occulter_sampling}",
    "wavelengths": "{wavelengths}",
    "precision": "{dtype}",
    "optional parts": "without {without}",
    "wavefront modes": "to {cycles:g} cycles",
    "derivatives": "{response_npix}",
    "pixels": "all",
}


def _label(trial: Trial, name: str, choice: Choice) -> str:
    if name == "pixels" and choice.pixels > 0:
        return f"{int(trial.informative(choice).sum())} informative"
    if name == "optional parts" and not choice.without:
        return "all"
    if name == "occulter sampling" and choice.occulter_sampling is None:
        return "default"
    words = {**vars(choice), "without": ", ".join(choice.without)}
    label = _LABELS[name].format(**words)
    return label + " for differences" * (name == "pupil grid" and choice.multifidelity)


def _why(economy: Economy, option: Option, trial: Trial, budget: float) -> str:
    if economy.note:
        return economy.note
    if any(name in trial.pins for name in option.changes):
        return "kept as asked"
    place = economy.options.index(option)
    if place == 0:
        return "the cheapest is good enough"
    before = economy.options[place - 1]
    label = _label(trial, economy.name, trial.finest.changed(before.changes))
    error = before.error
    if not error.inside(budget):
        return f"{label}: {error.rms:.2g} sigma (worst pixel {error.worst:.2g})"
    return f"{label}: {error.rms:.2g} sigma, too much with the others, or no faster"


def _table(
    trial: Trial, economies: Sequence[Economy], picked: Sequence[Option], budget: float
) -> QTable:
    whole = _choice(trial, picked)
    rows = []
    for economy, option in zip(economies, picked, strict=True):
        alone = trial.finest.changed(option.changes)
        shown = whole if economy.name == "pixels" else alone
        verified = trial.verified(alone)
        rows.append(
            (
                economy.name,
                _label(trial, economy.name, shown),
                _label(trial, economy.name, trial.finest),
                _why(economy, option, trial, budget),
                option.error.rms,
                option.error.worst,
                verified.rms,
                trial.seconds(alone) * u.s,
                trial.work.memory(alone) / 1e6 * u.Mbyte,
            )
        )
    names = (
        "what", "chosen", "finest", "why", "error", "worst", "verified_error", "seconds", "memory",
    )  # fmt: skip
    table = QTable(rows=rows, names=names)
    table.meta = {"error": "units of the pixel noise", "verified": VERIFIED}
    for name in ("error", "worst", "verified_error", "seconds", "memory"):
        table[name].info.format = ".3g"
    return table
