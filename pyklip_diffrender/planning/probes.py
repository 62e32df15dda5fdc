"""Probes: functions that measure the errors of an economy on a scene.

A probe takes a `Trial` and returns an `Economy`: its options from cheap to fine, each with the
error that it causes alone, in units of the pixel noise.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.io.units import ARCSEC
from pyklip_diffrender.planning.choice import Choice, Economy, ModelError, Option
from pyklip_diffrender.planning.trial import PROBED, START, Trial

__all__ = ["PROBES"]

Candidates = list[dict[str, Any]]

_PAYS = 0.2
"""Fraction of the time that an economy must be able to save to be measured."""

_FEW = 0.4
"""Fraction of all modes above which fitting them costs more than it can save."""

_GOOD = 0.3
"""Fraction of the budget below which finer options are not measured."""

_RING = 2.0
"""Step between candidate spatial frequencies, cycles across the pupil."""


def _allowed(candidates: Candidates, full: dict[str, Any], trial: Trial) -> Candidates:
    """Of the candidates and the full model's setting, those that the caller's pins allow."""
    pins = {name: trial.pins[name] for name in full if name in trial.pins}
    everything = [*(option for option in candidates if option != full), full]
    allowed = [option for option in everything if all(option[name] == pins[name] for name in pins)]
    if not allowed:
        offered = [tuple(option[name] for name in pins) for option in everything]
        raise IncompatibleSetupError(
            f"keep: got {', '.join(f'{n}={value!r}' for n, value in pins.items())}; this model "
            f"offers ({', '.join(pins)}) = {', '.join(map(str, dict.fromkeys(offered)))}"
        )
    return allowed


def _measured(
    trial: Trial,
    name: str,
    fields: tuple[str, ...],
    candidates: Candidates,
    error: Callable[[Choice], ModelError],
    *,
    fixed: str = "",
    monotonic: bool = False,
) -> Economy:
    """Options with their errors; only the full model if no other option would save time.

    Options are measured from cheap to fine until one is good. If errors decrease with cost
    (`monotonic`), the first is the cheapest within the budget, found by bisection. `fixed` says
    why the system cannot change these settings.
    """
    full = {field: getattr(trial.finest, field) for field in fields}
    options = _allowed([] if fixed else candidates, full, trial)
    pinned = not trial.pins.keys().isdisjoint(fields)
    if options == [full]:
        reason = "kept as requested" if pinned else fixed or "no choice"
        return Economy(name, (Option(full),), reason)
    seconds = [trial.seconds(replace(trial.likely, **option)) for option in options]
    now = trial.seconds(trial.likely)
    if not pinned and now - min(seconds) < _PAYS * now:
        return Economy(name, (Option(full),), "would hardly save time")
    order = sorted(range(len(options)), key=lambda k: seconds[k])
    cheaper = [options[k] for k in order if options[k] != full]
    measured: dict[int, Option] = {}

    def measure(k: int) -> ModelError:
        if k not in measured:
            measured[k] = Option(cheaper[k], error(replace(trial.finest, **cheaper[k])))
        return measured[k].error

    indices, first = range(len(cheaper)), 0
    if monotonic:
        first = bisect_left(indices, True, key=lambda k: measure(k).inside(trial.budget))
    next((k for k in indices[first:] if measure(k).rms < _GOOD * trial.budget), None)
    finest = [Option(full)] if full in options else []
    return Economy(name, (*(measured[k] for k in sorted(measured)), *finest))


def _rendered(trial: Trial, base: Choice | None = None) -> Callable[[Choice], ModelError]:
    """Error of a rendered star: the larger of those at the start and after a drift."""
    return lambda choice: ModelError.largest(
        trial.error(choice, which, base) for which in (START, PROBED)
    )


def wavefront_modes(trial: Trial) -> Economy:
    """Economy: fewer modes, without the fine structure of the wavefront.

    On a small field many modes have the same effect on the star, so fitted modes compensate for
    omitted ones. The error is then the residual of such a fit.
    """
    finest, detector = trial.finest.cycles, trial.model.detector
    steps = [_RING * (k + 1) for k in range(math.ceil(finest / _RING) - 1)]
    # A mode with this many cycles diffracts light to the edge of the field.
    (ny, nx), (x, y) = detector.shape, detector.pixelscale
    edge = min(nx * x, ny * y) / 2 * ARCSEC
    reach = edge * trial.model.diameter / trial.model.bandpass.mean_wavelength
    most = _FEW * trial.drift.count(finest)
    fitted = [c for c in steps if c >= reach and trial.drift.count(c) <= most]

    def error(choice: Choice) -> ModelError:
        if fitted:
            trial.prepare_fit(fitted[-1])
        return trial.error(replace(trial.rough, cycles=choice.cycles), PROBED, trial.rough)

    candidates = [{"cycles": c} for c in steps]
    return _measured(trial, "wavefront modes", ("cycles",), candidates, error, monotonic=True)


def wavelengths(trial: Trial) -> Economy:
    """Economy: fewer wavelengths, at the nodes of a Gauss quadrature."""
    count = trial.finest.wavelengths
    # Their error hardly depends on the pupil grid, so it is measured on a coarse one.
    npix, fixed = trial.rough.npix, "the wavelengths of this system are fixed"
    error = _rendered(trial, replace(trial.finest, npix=npix))
    return _measured(
        trial,
        "wavelengths",
        ("wavelengths",),
        [{"wavelengths": n} for n in range(1, count)],
        lambda choice: error(replace(choice, npix=npix)),
        fixed=fixed if count > 1 and "bandpass" not in trial.model.adjustable else "",
        monotonic=True,
    )


def pupil_grid(trial: Trial) -> Economy:
    """Economy: fewer samples across the pupil, for the whole field or only for its changes."""
    candidates: Candidates = []
    for npix in trial.grids:
        candidates.append({"npix": npix, "multifidelity": False})
        # A constant is added to the field of the star only, so derivatives need another copy.
        if trial.response_npix < npix:
            candidates.append({"npix": npix, "multifidelity": True})
    can_change = "npix" in trial.model.adjustable
    fixed = "" if can_change else "the pupil grid of this system is fixed"
    fields = ("npix", "multifidelity")
    return _measured(trial, "pupil grid", fields, candidates, _rendered(trial), fixed=fixed)


PROBES: dict[str, Callable[[Trial], Economy]] = {
    "wavefront modes": wavefront_modes,
    "wavelengths": wavelengths,
    "pupil grid": pupil_grid,
}
"""All economies by name, starting with those that decide whether others pay."""
