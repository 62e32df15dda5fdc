"""What each economy costs on a scene: one function for each, all of the same shape.

A probe takes a trial and gives an `Economy`: its options from cheap to fine with the error of
each, alone, in units of the pixel noise.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from pyklip_diffrender.io.units import ARCSEC
from pyklip_diffrender.linear.response import coarse_npix
from pyklip_diffrender.optics.grid import samples_for_field
from pyklip_diffrender.planning.choice import Choice, Economy, Error, Option, allowed
from pyklip_diffrender.planning.modes import ring_edges
from pyklip_diffrender.planning.trial import PROBED, START, Trial

__all__ = ["PROBES", "Probe"]

Probe = Callable[[Trial], Economy]

_PAYS = 0.2
"""Share of the time that an economy must be able to save to be worth a measurement."""

_FEW = 0.4
"""Share of all modes above which a fit of them is not tried: it costs more than it can save."""

_GOOD = 0.3
"""Share of the budget below which nothing finer is looked at."""

_HOPELESS = 3.0
"""Share of the budget above which nothing cheaper is looked at."""

_ENOUGH = 256
"""Pupil samples on which wavelengths are compared."""

_FIXED = "the model cannot change it"


def _measured(
    trial: Trial,
    name: str,
    fields: tuple[str, ...],
    candidates: Iterable[dict[str, Any]],
    error: Callable[[Choice], Error],
    how: str = "down",
    why: str = "no choice",
) -> Economy:
    """Options with their errors; only what was given, if nothing else would pay.

    `why` is said where there are no candidates.

    Looked at are those "down" from fine to cheap, until one is hopeless; "up", until one is good;
    by "halves", down to the cheapest that is inside the budget; or "all", where errors cost
    nothing.
    """
    finest = trial.finest
    given = {key: getattr(finest, key) for key in fields}
    options = allowed(candidates, given, trial.pins)
    if options == [given]:
        pinned = not trial.pins.keys().isdisjoint(fields)
        return Economy(name, (Option(given),), "kept as asked" if pinned else why)
    # Of what the economies before leave.
    likely = trial.likely
    seconds = {k: trial.seconds(likely.changed(each)) for k, each in enumerate(options)}
    whole = trial.seconds(likely)
    if whole - min(seconds.values()) < _PAYS * whole and trial.pins.keys().isdisjoint(fields):
        return Economy(name, (Option(given),), "would hardly save time")
    order = [options[k] for k in sorted(seconds, key=lambda k: seconds[k])]
    cheaper = [each for each in order if each != given]
    found = _searched(cheaper, lambda each: error(finest.changed(each)), trial.budget, how)
    return Economy(name, (*found, *(Option(each) for each in options if each == given)))


def _searched(
    options: list[dict[str, Any]],
    error: Callable[[dict[str, Any]], Error],
    budget: float,
    how: str,
) -> list[Option]:
    """Those options that are looked at, with their errors, from cheap to fine."""
    found: dict[int, Option] = {}

    def look(k: int) -> Error:
        if k not in found:
            found[k] = Option(options[k], error(options[k]))
        return found[k].error

    places = range(len(options))
    if how == "halves":
        low, high = -1, len(options)
        while high - low > 1:
            middle = (low + high) // 2
            low, high = (low, middle) if look(middle).inside(budget) else (middle, high)
        if high + 1 < len(options):
            look(high + 1)  # In case that the first is too much with other errors.
    elif how == "up":
        next((k for k in places if look(k).rms < _GOOD * budget), None)
    elif how == "down":
        next((k for k in reversed(places) if look(k).rms > _HOPELESS * budget), None)
    else:
        for k in places:
            look(k)
    return [found[k] for k in sorted(found)]


def _rendered(trial: Trial, base: Choice | None = None) -> Callable[[Choice], Error]:
    """Error of a rendered star, the larger of that at the start and that after a drift."""
    return lambda choice: Error.largest(
        trial.rendering_error(choice, which, base) for which in (START, PROBED)
    )


def pupil_grid(trial: Trial) -> Economy:
    """Fewer samples across the pupil, for all of the field or for its changes only."""
    model, candidates = trial.model, []
    for npix in _grids(trial):
        candidates.append({"npix": npix, "multifidelity": False})
        # A correction belongs to the star: derivatives need a copy without one.
        if coarse_npix(model, trial.finest.response_npix) < npix:
            candidates.append({"npix": npix, "multifidelity": True})
    fields = ("npix", "multifidelity")
    why = _why_none(trial, "npix")
    return _measured(trial, "pupil grid", fields, candidates, _rendered(trial), "up", why)


def _why_none(trial: Trial, setting: str) -> str:
    """Why there are no candidates for a setting, if there are none."""
    return "no choice" if setting in trial.model.adjustable else _FIXED


def _grids(trial: Trial) -> list[int]:
    """Samples across coarser pupils, as few as the derivatives have or more."""
    model = trial.model
    ny, nx = model.detector.shape
    field = max(nx * model.detector.pixelscale[0], ny * model.detector.pixelscale[1])
    needed = samples_for_field(field, min(model.bandpass.wavelengths), model.diameter)
    least = max(needed, trial.finest.response_npix)
    # Only grids that divide the given one: others smear the map.
    halves = [model.npix >> k for k in range(6, 0, -1) if model.npix % (1 << k) == 0]
    return [npix for npix in halves if npix >= least and "npix" in model.adjustable]


def occulter(trial: Trial) -> Economy:
    """Fewer cells per lambda/D on the occulter."""
    given = trial.finest.occulter_sampling
    candidates = []
    if "occulter_sampling" in trial.model.adjustable:
        start = given or (2.0 if trial.work.lattice else 4.0)
        candidates = [{"occulter_sampling": s} for s in (1.5, 2.0, 3.0) if s < start]
    return _measured(
        trial,
        "occulter sampling",
        ("occulter_sampling",),
        candidates,
        _rendered(trial),
        why=_why_none(trial, "occulter_sampling"),
    )


def wavelengths(trial: Trial) -> Economy:
    """Fewer wavelengths, placed as Gauss quadrature has them."""
    finest = trial.finest
    candidates = []
    if "bandpass" in trial.model.adjustable:
        candidates = [{"wavelengths": n} for n in range(1, finest.wavelengths)]
    # What the wavelengths do is the same on any pupil: it is measured on a coarse one.
    grids = [npix for npix in _grids(trial) if npix >= _ENOUGH]
    base = {"npix": grids[0]} if grids else {}

    def error(choice: Choice) -> Error:
        return _rendered(trial, finest.changed(base))(choice.changed(base))

    why = _why_none(trial, "bandpass")
    return _measured(trial, "wavelengths", ("wavelengths",), candidates, error, "halves", why)


def precision(trial: Trial) -> Economy:
    """Single precision."""
    candidates = []
    if trial.finest.dtype == "float64" and "dtype" in trial.model.adjustable:
        candidates = [{"dtype": "float32"}]
    why = _why_none(trial, "dtype")
    return _measured(trial, "precision", ("dtype",), candidates, _rendered(trial), why=why)


def parts(trial: Trial) -> Economy:
    """Without squares and bars of the mask, or effects of the detector: one, or all that may."""
    single = [{"without": (name,)} for name in trial.parts]
    error = _rendered(trial)
    alone = {name: error(trial.finest.changed({"without": (name,)})) for name in trial.parts}
    ordered = sorted(trial.parts, key=lambda name: alone[name].rms)
    # The least important first: one more part goes with every option.
    growing = [{"without": tuple(sorted(ordered[:k]))} for k in range(len(ordered), 1, -1)]
    return _measured(trial, "optional parts", ("without",), [*growing, *single], error)


def cycles(trial: Trial) -> Economy:
    """Without the wavefront's fine structure.

    On a small field many modes do the same to the star, and those that are fitted make up for
    those that are not: then what counts is what such a fit leaves.
    """
    edges = ring_edges(trial.finest.cycles)[:-1]
    target, modes = trial.target, trial.modes
    # A mode of so many cycles puts its light at the edge of the field.
    edge = min(n * s for n, s in zip(target.image.shape[::-1], _scales(trial), strict=True)) / 2
    reach = edge * ARCSEC * trial.model.diameter / trial.model.bandpass.mean_wavelength
    most = _FEW * trial.work.modes(trial.finest.cycles)
    fitted = [c for c in edges if c >= reach and trial.work.modes(c) <= most]
    if fitted and "cycles" not in trial.pins:
        modes.prepare_fit(fitted[-1])

    def error(choice: Choice) -> Error:
        if choice.cycles in fitted:
            return target.error(modes.beyond_after_fit(choice.cycles) * target.valid)
        return target.error(modes.beyond(choice.cycles) * target.valid)

    candidates = [{"cycles": c} for c in edges]
    return _measured(trial, "wavefront modes", ("cycles",), candidates, error, "all")


def _scales(trial: Trial) -> tuple[float, float]:
    return trial.model.detector.pixelscale


def response(trial: Trial) -> Economy:
    """Derivatives from a coarser pupil."""
    finest = trial.finest.response_npix
    counts = [n for n in (32, 64) if n < finest and trial.model.npix % n == 0]
    counts = [n for n in counts if coarse_npix(trial.model, n) == n]
    candidates = [{"response_npix": n} for n in counts]
    return _measured(trial, "derivatives", ("response_npix",), candidates, trial.response_error)


def pixels(trial: Trial) -> Economy:
    """Pixels where the star hardly changes say nothing about the wavefront."""

    def error(choice: Choice) -> Error:
        power = trial.modes.upto(choice.cycles)
        dropped = ~trial.informative(choice) & trial.target.valid
        return trial.target.error(power * dropped)

    levels = [{"pixels": level} for level in (0.05, 0.02)]
    return _measured(trial, "pixels", ("pixels",), levels, error, "all")


PROBES: dict[str, Probe] = {
    "wavefront modes": cycles,
    "wavelengths": wavelengths,
    "pupil grid": pupil_grid,
    "occulter sampling": occulter,
    "precision": precision,
    "optional parts": parts,
    "derivatives": response,
    "pixels": pixels,
}
"""All economies, by name; first those that decide whether others pay."""
