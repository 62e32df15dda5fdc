"""Planets that are added to frames: what a reduction measures of them, and how many it finds."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from astropy import units as u
from astropy.table import QTable
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from pyklip_diffrender.detection.candidates import Maps
from pyklip_diffrender.detection.deeper import SAME_SOURCE_LAMBDA_D
from pyklip_diffrender.detection.error_factor import Significance
from pyklip_diffrender.detection.field import (
    Image,
    curve_separations,
    far_from,
    is_within,
)
from pyklip_diffrender.detection.measurement import significance_of
from pyklip_diffrender.detection.search_result import Detection
from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.io.progress import ProgressBar
from pyklip_diffrender.io.tables import add_columns
from pyklip_diffrender.io.units import full_circle
from pyklip_diffrender.refinement import FrameFit
from pyklip_diffrender.scene.objects import Planet
from pyklip_diffrender.scene.observation import Observation

_PLANET_OVER_LIMIT = 1.6
"""Contrast of an injected planet over the limit with the small-sample correction, which is the
threshold of the search. At a limit of 5 sigma, nearly all planets of 8 sigma should be detected."""

_MOST_PLANETS_AT_A_TIME = 7
"""Largest number of planets in the frames at a time."""

_PLANETS_APART_ARCSEC = 0.3
"""Smallest distance in separation of planets in the frames at a time, arcsec: of images that
overlap, each is noise for the others."""

_GOLDEN_SECTION = 0.618
"""The golden section, whose multiples modulo 1 are spread evenly."""

_SAME_ARCSEC = 0.1
"""A candidate this near to an injected planet is the planet, arcsec."""

CLEAR = 0.3
"""Distance of injected planets from candidates, arcsec."""

_GOLDEN_ANGLE_DEG = 137.5
"""Degrees between neighbours in separation."""

_PLACES_ON_CIRCLE = 36
"""Number of places at a separation, one of which is to be free."""

_NEXT_SET_ANGLE_DEG = 47.0
"""Degrees between planets at the same separation, one set and the next."""


class MeasuredPlanet(NamedTuple):
    """Measurement of a planet."""

    # Values of the candidate within 0.1 arcsec, or else measured at the place of the planet.
    contrast: float
    contrast_error: float  # Without the error of the star's flux.
    snr: float
    detected: bool  # Whether there is such a candidate.


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
    frames = [each for each in detection.fit.frames if not each.observation.reference]
    curve = detection.contrast_curve
    rows: list[tuple[float, ...]] = []
    inner, outer = (float(end) for end in curve["separation"].value[[0, -1]])
    together = int(np.clip((outer - inner) / _PLANETS_APART_ARCSEC, 1, _MOST_PLANETS_AT_A_TIME))
    for trial, start in enumerate(range(0, count, together)):
        rings = min(together, count - start)
        # Other separations in every set, so that sets fill the gaps.
        parts = (np.arange(rings) + (0.5 + _GOLDEN_SECTION * trial) % 1) / rings
        separations = inner + (outer - inner) * parts
        limits = np.exp(
            np.interp(separations, curve["separation"].value, np.log(curve["small_sample"]))
        )
        places = np.array(
            [
                _free_place(
                    detection, separation, _GOLDEN_ANGLE_DEG * k + _NEXT_SET_ANGLE_DEG * trial
                )
                for k, separation in enumerate(separations)
            ]
        )
        injected = [
            Planet.from_offset(_PLANET_OVER_LIMIT * limit, *place)
            for limit, place in zip(limits, places, strict=True)
        ]
        again = search(with_planets(frames, injected))
        for planet in injected:
            angle = full_circle(planet.position_angle + detection.north)
            measured = measured_planet(again, planet.offset, frames[0].star_light)
            rows.append((planet.separation, angle, planet.contrast, *measured))
    separation, angles, true, *found, detected = np.array(rows, dtype=float).reshape(-1, 7).T
    return add_columns(
        QTable(meta={"strength": _PLANET_OVER_LIMIT}),
        [
            ("separation", separation, u.arcsec, ".3f", "from the star"),
            ("position_angle", angles, u.deg, ".1f", "as in the table of candidates"),
            ("injected", true, None, ".2e", "contrast"),
            ("contrast", found[0], None, ".2e", "of the candidate, or else measured at the place"),
            ("contrast_error", found[1], None, ".1e", "without the error of the star's flux"),
            ("snr", found[2], None, ".1f", "contrast over its error for a known position"),
            ("detected", detected.astype(bool), None, "", "whether there is such a candidate"),
        ],
    )


def with_planets(frames: Sequence[FrameFit], planets: Sequence[Planet]) -> tuple[Observation, ...]:
    """Add planets to the data of the target's fitted frames, without their photon noise.

    They have the wavefront and the flux of the fit; position angles are from +y of the first frame.
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
    detection: Detection, place: tuple[float, float], star_light: float
) -> MeasuredPlanet:
    """Measure a planet at a known place, x, y from the star in the first frame, arcsec.

    The contrast is relative to a star of this `FrameFit.star_light`; for an injected planet, of the
    fit with which it was rendered.
    """
    sources, factor = detection.sources, detection.error_factor
    unit = detection.fit.frames[0].star_light / star_light
    distances = np.hypot(*(sources.offsets.numpy() - place).T)
    if len(sources) and distances.min() < _SAME_ARCSEC:
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

    The first such place counter-clockwise from the angle; if there is none, the place at the angle.
    """
    places = _free_places(detection, separation, _PLACES_ON_CIRCLE, angle)
    return places[0] if len(places) else np.array(Planet(1.0, separation, angle).offset)


def _free_places(detection: Detection, separation: float, count: int, start: float) -> Image:
    """x, y of places at a separation, evenly spread from an angle on, that are free."""
    free = detection.has_limits & far_from(detection.grid, detection.sources.offsets, CLEAR)
    angles = np.radians(start) + 2 * np.pi * np.arange(count) / count
    places = separation * np.stack([-np.sin(angles), np.cos(angles)], axis=-1)
    return places[is_within(free, detection.grid, places)]


# Fraction of planets that a search finds, by contrast and separation.
#
# A contrast curve at 5 sigma says how bright a planet is whose S/N is 5 on average: half of them
# are found. Here planets of several contrasts are added to the frames, to first order: the maps of
# a search are linear in the data, so that the light of a planet changes them by its contrast times
# a map that is computed once for each place. Every map is then searched as if nothing were known of
# the planet. The true-positive fraction is as in Jensen-Clem et al., AJ 155, 19 (2018), for the
# false-positive fraction of the threshold.

_PLANETS_OVER_LIMIT = tuple(np.geomspace(0.4, 3.0, 12).tolist())
"""Contrasts over the limit with the small-sample correction."""


_PLANETS_AT_A_TIME = 64
"""Number of planets whose maps are computed at a time."""

_STATED_FRACTIONS = (0.5, 0.95)


def completeness(
    detection: Detection,
    *,
    separations: ArrayLike | None = None,
    strengths: Sequence[float] = _PLANETS_OVER_LIMIT,
    angles: int = 24,
    inner: float = 0.2,
    progress: bool = False,
) -> QTable:
    """Compute the fraction of planets that the search of a detection would find.

    Planets are as bright as a grid of contrasts, one at a time, at places that have limits and do
    not overlap with candidates. Their own photon noise is neglected, as is the change of the
    wavefront's linearisation: both are small near the limit.

    Parameters
    ----------
    detection : Detection
        With its fit and the linear model.
    separations : array or Quantity, optional
        arcsec; by default every second of the contrast curve from its second on.
    strengths : sequence of float
        Contrasts over the 5-sigma limit with the small-sample correction at the separation.
    angles : int
        Number of planets at every separation.
    inner : float
        Smallest separation of candidates, as in `detect`, arcsec.
    progress : bool
        Show a progress bar.

    Returns
    -------
    QTable
        A row for every separation and contrast: separation, contrast, completeness (the fraction
        found) and planets, the number of trials. `meta` has the threshold in sigmas, the
        probability "false_alarm" that noise has a candidate anywhere in the field, and the lists
        "separation_arcsec", "contrast_50" and "contrast_95" of `contrast_of_completeness`.

    Raises
    ------
    IncompatibleSetupError
        If the detection has no linear model, or no place is free.

    Examples
    --------
    >>> import pyklip_diffrender as dr
    >>> model = dr.nircam_coronagraph("F444W", monochromatic=4.5e-6, npix=128, fov_pixels=32)
    >>> opd = dr.wavefront.random_opd(1, npix=128)
    >>> frames = dr.simulate(model, dr.Scene(), opd, seed=3)
    >>> fit = dr.refine(model, frames, opd, settings=dr.FitSettings(cycles=6))
    >>> table = dr.detection.completeness(
    ...     dr.detect(fit), separations=[0.6], strengths=[0.2, 3.0], angles=4
    ... )
    >>> table["completeness"].tolist()
    [0.0, 1.0]
    """
    if detection.stored_fit is None:
        raise IncompatibleSetupError(
            "completeness: got a detection without its fit, expected one from detect or reduce"
        )
    searches = [_Searched.of(detection, inner, progress)]
    if detection.other is not None:
        searches.append(_Searched.of(detection.other, inner, progress))
    grid = detection.grid
    curve = detection.contrast_curve
    limit_at, limits = curve["separation"].value, np.asarray(curve["small_sample"])
    chosen = limit_at[1::2] if separations is None else curve_separations(grid, separations)
    places = [
        _free_places(detection, separation, angles, _GOLDEN_ANGLE_DEG * n)
        for n, separation in enumerate(chosen)
    ]
    count = sum(map(len, places)) * len(strengths)
    if not count:
        raise IncompatibleSetupError(
            f"separations: got {chosen.tolist()} arcsec, where no place is free of candidates"
        )
    rows = []
    with ProgressBar("completeness", count, shown=progress) as bar:
        for separation, offsets in zip(chosen, places, strict=True):
            if not len(offsets):
                continue
            limit = float(np.exp(np.interp(separation, limit_at, np.log(limits))))
            region = detection.of_other
            is_of_other = region is not None and is_within(region, grid, offsets).any()
            search = searches[int(is_of_other)]
            detected = search.found(limit * searches[0].star / search.star, strengths, offsets, bar)
            rows += [
                (separation, strength * limit, fraction, len(offsets))
                for strength, fraction in zip(strengths, detected.mean(axis=1), strict=True)
            ]
    at, contrasts, found, planets = np.array(rows, dtype=float).reshape(-1, 4).T
    table = add_columns(
        QTable(),
        [
            ("separation", at, u.arcsec, ".3f", "from the star"),
            ("contrast", contrasts, None, ".2e", "of the planets"),
            ("completeness", found, None, ".2f", "fraction of the planets that is found"),
            ("planets", planets.astype(int), None, "", "number of planets"),
        ],
    )
    table.meta = {
        "threshold": detection.threshold,
        "false_alarm": searches[0].significance.false_alarm(detection.threshold),
    }
    for fraction in _STATED_FRACTIONS:
        reached = contrast_of_completeness(table, fraction)
        table.meta["separation_arcsec"] = reached["separation"].value.tolist()
        table.meta[f"contrast_{100 * fraction:.0f}"] = np.asarray(reached["contrast"]).tolist()
    return table


def contrast_of_completeness(table: QTable, fraction: float) -> QTable:
    """Interpolate the contrast at which a fraction of planets is found.

    Parameters
    ----------
    table : QTable
        From `completeness`.
    fraction : float

    Returns
    -------
    QTable
        Separation and contrast; NaN where the contrasts of the table do not reach the fraction on
        either side.
    """
    rows = []
    for separation in np.unique(table["separation"]):
        part = table[table["separation"] == separation]
        order = np.argsort(part["contrast"])
        contrasts = np.log(np.asarray(part["contrast"])[order])
        # Of more light, more is found; chance may have it otherwise.
        fractions = np.maximum.accumulate(np.asarray(part["completeness"])[order])
        contrast = np.nan
        if fractions[0] <= fraction <= fractions[-1]:
            above = int(np.argmax(fractions >= fraction))
            low = max(above - 1, 0)
            step = fractions[above] - fractions[low]
            share = (fraction - fractions[low]) / step if step else 0.0
            contrast = np.exp(contrasts[low] + share * (contrasts[above] - contrasts[low]))
        rows.append((separation.to_value(u.arcsec), contrast))
    curve = QTable(rows=rows, names=("separation", "contrast"), dtype=[float, float])
    curve["separation"] = np.asarray(curve["separation"]) * u.arcsec
    return curve


@dataclass(frozen=True)
class _Searched:
    """The maps of a search, without its candidates, to which planets are added."""

    maps: Maps
    significance: Significance
    residual: Image  # (ny, nx), the numerator of the maps.
    sources: Tensor  # (k, 2), x, y of the candidates from the star, arcsec.
    threshold: float
    star: float  # Light of the star in the fit, see `FrameFit.star_light`.

    @classmethod
    def of(cls, detection: Detection, inner: float, progress: bool) -> _Searched:
        maps, known = Maps(detection.templates, progress), detection.sources
        return cls(
            maps,
            significance_of(maps, known.offsets, inner),
            maps.without(known),
            known.offsets,
            detection.threshold,
            detection.fit.frames[0].star_light,
        )

    def found(
        self, contrast: float, strengths: Sequence[float], offsets: Image, bar: ProgressBar
    ) -> NDArray[np.bool_]:
        """Whether planets are found, (strengths, places), of a contrast times their strengths."""
        detected = np.zeros((len(strengths), len(offsets)), dtype=bool)
        for start in range(0, len(offsets), _PLANETS_AT_A_TIME):
            part = offsets[start : start + _PLANETS_AT_A_TIME]
            changes = self.maps.response(torch.from_numpy(part))
            for n, (place, change) in enumerate(zip(part, changes, strict=True), start):
                for s, strength in enumerate(strengths):
                    detected[s, n] = self.finds(strength * contrast * change, place)
                    bar.update(1)
        return detected

    def finds(self, change: Image, place: Image) -> bool:
        """Whether the search has a candidate near a place if the numerator changes by an image."""
        snr = self.maps.snr(self.residual + change)
        everywhere = np.ones(snr.shape, dtype=bool)
        peaks = self.significance.significant_peaks(snr, self.sources, self.threshold, everywhere)
        reach, grid = SAME_SOURCE_LAMBDA_D * self.significance.resolution, self.significance.grid
        return any(np.hypot(*(grid[peak] - place)) < reach for peak, _ in peaks)
