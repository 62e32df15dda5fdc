"""Planets that are added to fitted frames, and what the same reduction measures of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from astropy import units as u
from astropy.table import QTable
from numpy.typing import NDArray

from pyklip_diffrender.detection.search_result import Detection
from pyklip_diffrender.io.geometry import full_circle
from pyklip_diffrender.io.progress import progressed
from pyklip_diffrender.refinement import FrameFit
from pyklip_diffrender.scene.objects import Planet
from pyklip_diffrender.scene.observation import Observation

__all__ = ["CLEAR", "TOGETHER", "measured_planet", "recover_planets", "with_planets"]

_STRENGTH = 1.6
"""Contrast of an injected planet over the limit with the small-sample correction, which is the
threshold of the search. At a limit of 5 sigma, nearly all planets of 8 sigma should be detected."""

TOGETHER = 7
"""Largest number of planets in the frames at a time."""

_APART = 0.3
"""Smallest distance in separation of planets in the frames at a time, arcsec: of images that
overlap, each is noise for the others."""

_FRACTION = 0.618
"""The golden section, whose multiples modulo 1 are spread evenly."""

_SAME = 0.1
"""A candidate this near to an injected planet is the planet, arcsec."""

CLEAR = 0.3
"""Distance of injected planets from candidates, arcsec."""

_GOLDEN = 137.5
"""Degrees between neighbours in separation."""

_NEXT = 47.0
"""Degrees between planets at the same separation, one set and the next."""

_STEP = 10.0
"""Degrees by which a planet is moved on until its place is free."""

_COLUMNS = {
    "separation": ".3f",
    "position_angle": ".1f",
    "injected": ".2e",
    "contrast": ".2e",
    "contrast_error": ".1e",
    "snr": ".1f",
    "detected": None,
}
_UNITS = {"separation": u.arcsec, "position_angle": u.deg}


class MeasuredPlanet(NamedTuple):
    """Measurement of a planet.

    Attributes
    ----------
    contrast : float
        Of the candidate within 0.1 arcsec, or else measured at the place of the planet.
    contrast_error : float
        Without that of the star's flux.
    snr : float
    detected : bool
        Whether there is such a candidate.
    """

    contrast: float
    contrast_error: float
    snr: float
    detected: bool


def recover_planets(
    detection: Detection, count: int, search: Callable[[tuple[Observation, ...]], Detection]
) -> QTable:
    """Add planets to the frames of a detection and search them again.

    The planets are spread over all separations and angles, up to seven at a time, and are 1.6 times
    as bright as the limit with the small-sample correction at their separations. Their contrasts,
    injected and measured, are relative to the star of the detection. How bright the star is in the
    fit of the frames with planets does not matter; for AU Mic, which the model does not explain, it
    was 13 and 17 % brighter.

    Parameters
    ----------
    detection : Detection
    count : int
        Number of planets.
    search : callable
        Fits and searches frames of the target as it was done for the detection.

    Returns
    -------
    QTable
        One row for each planet: where it was injected (as in the table of candidates), its
        contrast, and what `measured_planet` says of it.
    """
    frames = [each for each in detection.fits[0].frames if not each.observation.reference]
    curve = detection.contrast_curve
    planets = QTable(names=list(_COLUMNS), dtype=[float] * (len(_COLUMNS) - 1) + [bool])
    inner, outer = (float(end) for end in curve["separation"].value[[0, -1]])
    together = int(np.clip((outer - inner) / _APART, 1, TOGETHER))
    for trial, start in enumerate(range(0, count, together)):
        rings = min(together, count - start)
        # Other separations in every set, so that sets fill the gaps.
        parts = (np.arange(rings) + (0.5 + _FRACTION * trial) % 1) / rings
        separations = inner + (outer - inner) * parts
        limits = np.exp(
            np.interp(separations, curve["separation"].value, np.log(curve["small_sample"]))
        )
        places = np.array(
            [
                _free_place(detection, separation, _GOLDEN * k + _NEXT * trial)
                for k, separation in enumerate(separations)
            ]
        )
        injected = [
            Planet.from_offset(_STRENGTH * limit, *place)
            for limit, place in zip(limits, places, strict=True)
        ]
        again = search(with_planets(frames, injected))
        for planet in injected:
            angle = full_circle(planet.position_angle + detection.north)
            measured = measured_planet(again, planet.offset, frames[0].flux)
            planets.add_row((planet.separation, angle, planet.contrast, *measured))
        progressed((start + rings) / count)
    for name, unit in _UNITS.items():
        planets[name] = planets[name] * unit
    for name, form in _COLUMNS.items():
        planets[name].info.format = form
    planets.meta["strength"] = _STRENGTH
    return planets


def with_planets(frames: Sequence[FrameFit], planets: Sequence[Planet]) -> tuple[Observation, ...]:
    """Add planets to the data of fitted frames, with the wavefront and the flux of the fit.

    Parameters
    ----------
    frames : sequence of FrameFit
        Of the target.
    planets : sequence of Planet
        Position angles are counted from +y of the first frame.

    Returns
    -------
    tuple of Observation
        Without photon noise of the planets.
    """
    science = []
    for frame in frames:
        roll = frame.observation.roll_from(frames[0].observation)
        star = frame.values.get("star_offset", np.zeros(2))
        data = frame.observation.data
        for planet in planets:
            x, y = star + planet.rotated(roll).offset
            light = frame.render(background=False, source=(float(x), float(y)))
            data = data + planet.contrast * light
        science.append(replace(frame.observation, data=data))
    return tuple(science)


def measured_planet(
    detection: Detection, place: tuple[float, float], flux: float
) -> MeasuredPlanet:
    """Measure a planet of which the position is known.

    Parameters
    ----------
    detection : Detection
    place : (float, float)
        x, y from the star in the first frame, arcsec.
    flux : float
        Of the star to which the contrast is relative, in the unit of `FrameFit.flux`: of an
        injected planet, that of the fit with which it was rendered.

    Returns
    -------
    MeasuredPlanet
    """
    sources, factor = detection.sources, detection.error_factor
    unit = detection.fits[0].frames[0].flux / flux
    distances = np.hypot(*(sources.offsets.numpy() - place).T)
    if len(sources) and distances.min() < _SAME:
        k = int(distances.argmin())
        error = float(factor.of(sources.offsets)[k] * sources.errors[k, 0])
        contrast = float(sources.contrasts[k])
        return MeasuredPlanet(unit * contrast, unit * error, float(sources.snr(factor)[k]), True)
    row = detection.measure([place])[0]
    contrast, snr = float(row["contrast"]), float(row["snr"])
    error = contrast / snr if snr else float(row["contrast_error"])
    return MeasuredPlanet(unit * contrast, unit * error, snr, False)


def _free_place(detection: Detection, separation: float, angle: float) -> NDArray[np.float64]:
    """x, y at a separation, where there are limits and no candidate is near.

    The first such place counter-clockwise from the angle; if there is none, that at the angle.
    """
    table = detection.candidates
    candidates = np.stack([table["x"].value, table["y"].value], axis=-1)
    turns = np.arange(0, 360, _STEP).tolist()
    circle: list[NDArray[np.float64]] = [
        np.array(Planet(1.0, separation, angle + turn).offset) for turn in turns
    ]
    for place in circle:
        away = np.hypot(*np.moveaxis(detection.grid - place, -1, 0))
        nearest = np.unravel_index(away.argmin(), away.shape)
        if detection.has_limits[nearest] and (np.hypot(*(candidates - place).T) > CLEAR).all():
            return place
    return circle[0]
