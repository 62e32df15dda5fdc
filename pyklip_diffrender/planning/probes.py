"""What each economy costs on a scene: one function for each, all of the same shape.

A probe takes a trial and returns an `Economy`: its options from cheap to fine, each with the error
that it causes alone, in units of the pixel noise.
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
"""Share of the time that an economy must be able to save to be worth a measurement."""

_FEW = 0.4
"""Share of all modes above which a fit of them is not tried: it costs more than it can save."""

_GOOD = 0.3
"""Share of the budget below which nothing finer is measured."""

_RING = 2.0
"""Step between the spatial frequencies that are tried, cycles across the pupil."""


def _allowed(candidates: Candidates, given: dict[str, Any], trial: Trial) -> Candidates:
    """The candidates, and what was given, that agree with what is pinned."""
    pins = {name: trial.pins[name] for name in given if name in trial.pins}
    everything = [*(each for each in candidates if each != given), given]
    kept = [each for each in everything if all(each[name] == pins[name] for name in pins)]
    if not kept:
        offered = [tuple(each[name] for name in pins) for each in everything]
        raise IncompatibleSetupError(
            f"keep: got {', '.join(f'{n}={value!r}' for n, value in pins.items())}; this model "
            f"offers ({', '.join(pins)}) = {', '.join(map(str, dict.fromkeys(offered)))}"
        )
    return kept


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
    """Options with their errors; only the model as given, if nothing else would pay.

    Measured are options from cheap to fine until one is good; where errors fall with the cost of
    an option, from the cheapest that is inside the budget, which is found by bisection. `fixed`
    says what this system cannot change.
    """
    given = {field: getattr(trial.finest, field) for field in fields}
    options = _allowed([] if fixed else candidates, given, trial)
    pinned = not trial.pins.keys().isdisjoint(fields)
    if options == [given]:
        return Economy(name, (Option(given),), "kept as asked" if pinned else fixed or "no choice")
    seconds = [trial.seconds(replace(trial.likely, **each)) for each in options]
    whole = trial.seconds(trial.likely)
    if not pinned and whole - min(seconds) < _PAYS * whole:
        return Economy(name, (Option(given),), "would hardly save time")
    order = sorted(range(len(options)), key=lambda k: seconds[k])
    cheaper = [options[k] for k in order if options[k] != given]
    seen: dict[int, Option] = {}

    def measure(k: int) -> ModelError:
        if k not in seen:
            seen[k] = Option(cheaper[k], error(replace(trial.finest, **cheaper[k])))
        return seen[k].error

    places, first = range(len(cheaper)), 0
    if monotonic:
        first = bisect_left(places, True, key=lambda k: measure(k).inside(trial.budget))
    next((k for k in places[first:] if measure(k).rms < _GOOD * trial.budget), None)
    finest = [Option(given)] if given in options else []
    return Economy(name, (*(seen[k] for k in sorted(seen)), *finest))


def _rendered(trial: Trial, base: Choice | None = None) -> Callable[[Choice], ModelError]:
    """Error of a rendered star, the larger of that at the start and that after a drift."""
    return lambda choice: ModelError.largest(
        trial.error(choice, which, base) for which in (START, PROBED)
    )


def wavefront_modes(trial: Trial) -> Economy:
    """Without the wavefront's fine structure.

    On a small field many modes do the same to the star, and those that are fitted make up for
    those that are not: then what counts is what such a fit leaves.
    """
    finest, detector = trial.finest.cycles, trial.model.detector
    steps = [_RING * (k + 1) for k in range(math.ceil(finest / _RING) - 1)]
    # A mode of so many cycles puts its light at the edge of the field.
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
    """Fewer wavelengths, placed as Gauss quadrature has them."""
    count = trial.finest.wavelengths
    # Their error is the same on any pupil: it is measured on a coarse one.
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
    """Fewer samples across the pupil, for all of the field or for its changes only."""
    candidates: Candidates = []
    for npix in trial.grids:
        candidates.append({"npix": npix, "multifidelity": False})
        # Steps from a fine field are those of the star: derivatives need a copy without.
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
"""All economies, by name; first those that decide whether others pay."""
