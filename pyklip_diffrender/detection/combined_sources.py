"""Sources in the maps of several reductions: searched, associated over epochs, and measured."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
from astropy.time import Time
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from pyklip_diffrender.detection.association import (
    YEAR_DAYS,
    Association,
    Hypotheses,
    Motion,
    Sighting,
    weighted_mean,
)
from pyklip_diffrender.detection.combined_result import (
    FREE,
    CombinedSource,
    scales_of,
    star_of_filter,
    unmoved,
)
from pyklip_diffrender.detection.error_factor import structures_in_single_roll
from pyklip_diffrender.detection.field import Image, separation_of
from pyklip_diffrender.detection.sky_map import (
    LIGHT,
    POSITION,
    Family,
    MapSource,
    SkyMap,
    SkyStack,
    common_grid,
    date_of,
    epochs_of,
    level_of,
    ln_likelihood_ratio,
    maximum,
)
from pyklip_diffrender.instrument.spectrum import PlanetSpectra
from pyklip_diffrender.io.units import half_circle
from pyklip_diffrender.refinement.residual import local_maxima

_MOST_MOTIONS = 300
"""Largest number of orbital motions for which the epochs are added."""

_TWO_SOURCES_CHI2 = 20.0
"""Chi-squared of two degrees of freedom (5e-5) of two places at one epoch that are two sources."""

_WITH_STAR, _ON_SKY = "all epochs, with the star", "all epochs, on the sky"
"""Names of the searches in which all epochs are added."""

_UNLISTED_SPECTRUM_CHI2 = 9.0
"""Chi-squared by which free fluxes have to be better than all listed spectra to be preferred."""

_PEAK_PIXEL_SIGMAS = 0.7
"""Standard deviations by which the highest pixel of a peak may be lower than the peak."""


@dataclass(frozen=True, eq=False)
class _Search:
    """One way to add maps: an epoch alone, or all with the motion of a hypothesis."""

    name: str
    maps: tuple[SkyMap, ...]
    # Offsets, (2,), by the name of the map; several for different orbital motions.
    moves: tuple[dict[str, Image], ...]
    # Largest part of `moves` that is orbital, arcsec per year, which limits the separation.
    speeds: tuple[float, ...]
    reference: float  # Epoch of the places, MJD.


@dataclass(frozen=True, eq=False)
class _Peak:
    """A peak of a search: its place, the number of its orbital motion, and its significance."""

    place: Image  # (2,)
    move: int
    sigmas: float
    preference: float  # see `_preference`


class _Value(NamedTuple):
    """S/N and error of a source at a place of a map."""

    snr: float
    sigmas: float  # The S/N in Gaussian standard deviations.
    error: float  # Error of the contrast; inf where nothing is known.


@dataclass(frozen=True, eq=False)
class _Seen:
    """A source as one epoch shows it, or the sum of all epochs."""

    sighting: Sighting
    place: Image  # (2,), best known, at the date `mjd`.
    covariance: Image  # (2, 2), arcsec^2
    mjd: float
    values: dict[str, _Value]  # By map.
    # Where its light is in maps from which it was not removed, by map.
    light: dict[str, Image]
    known: bool = False  # as a candidate of a single search


@dataclass(frozen=True, eq=False)
class _Group:
    """Sightings of one source, with the hypotheses on its motion."""

    parts: list[_Seen]
    values: dict[str, _Value]  # By map, of all epochs at which its place is known.
    kind: str | None = None  # The most probable hypothesis.
    hypotheses: Hypotheses | None = None


def _in_one_roll(maps: tuple[SkyMap, ...]) -> bool:
    """Whether all maps have one orientation, so that structures of the detector do not turn."""
    turned = [abs(half_circle(each.north - maps[0].north)) for each in maps]
    return all(each.single_roll for each in maps) and max(turned) < 1


class SourceSearch:
    """Searches of the maps of several reductions, and the sources that they show."""

    def __init__(
        self,
        maps: tuple[SkyMap, ...],
        spectra: PlanetSpectra,
        motion: Motion | None,
        *,
        free: bool,
        unit: str,
        threshold: float,
        inner: float,
    ) -> None:
        self.maps, self.spectra, self.motion, self.free = maps, spectra, motion, free
        self.threshold, self.inner = threshold, inner
        self.scales = scales_of(maps, unit)
        self.stars = {name: star_of_filter(maps, name, self.scales) for name in spectra.filters}
        self.resolution = min(each.resolution for each in maps)
        self.grid = common_grid(maps)
        self.pixel_area = float(np.prod(np.abs(self.grid[1, 1] - self.grid[0, 0])))
        self.distance = separation_of(self.grid)
        self.remarks: list[str] = []
        # Maps without the candidates of the single searches, which are fitted there.
        self.residuals = {each.name: each.residual for each in maps}
        self.epochs = epochs_of(maps) if motion is not None else [list(maps)]
        self.dates = [
            date_of(each) if maps[0].mjd is not None else math.nan for each in self.epochs
        ]
        self.single, self.together = self._searches()
        self.families = {
            (search.name, name): family
            for search in self.searches
            for name, family in self._families(search).items()
        }
        self.counts = Counter(search for search, _ in self.families)
        # All searches and families share the false alarms of a single search equally: a level is
        # that at which noise has so many maxima over all motions of a search, with spectra of a
        # family.
        alarms = self.alarms_of_single_search() / len(self.searches)
        self.levels = {
            (search, name): level_of([family], alarms / self.counts[search])
            for (search, name), family in self.families.items()
        }

    @property
    def thresholds(self) -> dict[str, float]:
        """Levels by the names of the search and of the family of spectra."""
        return {f"{search}, {name}": level for (search, name), level in self.levels.items()}

    @property
    def searches(self) -> list[_Search]:
        """Every epoch alone, and all of them together, with the star and fixed on the sky."""
        return [*self.single, *self.together]

    @property
    def unmoved(self) -> _Search:
        """The search of all maps, unmoved by its first motion."""
        return next(each for each in self.searches if len(each.maps) == len(self.maps))

    def _searches(self) -> tuple[list[_Search], list[_Search]]:
        """Searches of each epoch, and of all epochs together."""
        if self.motion is None:
            every = _Search("all filters", self.maps, (unmoved(self.maps),), (0.0,), self.dates[0])
            return [every], []
        single = [
            _Search(Time(date, format="mjd").isot[:10], tuple(maps), (unmoved(maps),), (0.0,), date)
            for date, maps in zip(self.dates, self.epochs, strict=True)
        ]
        first = self.dates[0]
        dates = {each.name: date_of([each]) for each in self.maps}
        fixed = {name: self.motion.background(first, date) for name, date in dates.items()}
        velocities = self._velocities(self.dates[-1] - first)
        moved = tuple(
            {name: v * (date - first) / YEAR_DAYS for name, date in dates.items()}
            for v in velocities
        )
        speeds = tuple(float(np.hypot(*v)) for v in velocities)
        return single, [
            _Search(_WITH_STAR, self.maps, moved, speeds, first),
            _Search(_ON_SKY, self.maps, (fixed,), (0.0,), first),
        ]

    def _velocities(self, days: float) -> list[Image]:
        """Orbital motions, (2,) each, arcsec per year, half lambda/D apart at the last epoch."""
        motion, years = self.motion, days / YEAR_DAYS
        # Velocities on a square lattice within the speed of a parabolic orbit at the inner
        # separation.
        fastest = 0.0 if motion is None else math.sqrt(2) * float(motion.orbital(self.inner))
        step = self.resolution / 2 / years
        reach = int(fastest / step)
        if math.pi * reach**2 > _MOST_MOTIONS:
            self.remarks.append(
                f"Orbits may move a source by {fastest * years:.2f} arcsec between the epochs, too "
                "far to add the epochs for every motion: they were added unmoved. The hypotheses "
                "allow the motion"
            )
            reach = 0
        axis = step * np.arange(-reach, reach + 1)
        inside = [np.array([x, y]) for x in axis for y in axis if math.hypot(x, y) <= fastest]
        return sorted(inside or [np.zeros(2)], key=lambda v: float(np.hypot(*v)))

    def stack(
        self,
        search: _Search,
        places: Image,
        move: int = 0,
        maps: Mapping[str, SkyMap] | None = None,
    ) -> SkyStack:
        """The maps of a search at places; `maps` replaces them by name."""
        used = [each if maps is None else maps[each.name] for each in search.maps]
        moves = search.moves[move]
        return SkyStack.of(used, self.spectra.filters, self.scales, places, moves)

    def alarms_of_single_search(self) -> float:
        """Expected number of false candidates of a search of one filter, mean over the maps."""
        counts = []
        for each in self.maps:
            stack = self.stack(_Search("", (each,), (unmoved([each]),), (0.0,), 0.0), self.grid)
            used = self._used(stack)
            spectrum = np.array([[name == each.filter for name in self.spectra.filters]], float)
            family = Family(spectrum, stack[used], self.pixel_area)
            counts.append(family.expected(self.threshold))
        return float(np.mean(counts))

    def _used(self, stack: SkyStack, speed: float = 0.0) -> NDArray[np.bool_]:
        """Pixels of the grid that are searched, with orbital motion only where it is possible."""
        used = np.isfinite(stack.error).any(axis=0) & (self.distance >= self.inner)
        if speed > 0 and self.motion is not None:
            used &= speed <= math.sqrt(2) * self.motion.orbital(self.distance)
        return np.asarray(used)

    def _families(self, search: _Search) -> dict[str, Family]:
        """Families of spectra by name; one is enough for a single filter."""
        stack = self.stack(search, self.grid)
        most = int(np.isfinite(stack.error).sum(axis=0).max(initial=0))
        listed: dict[str, Image | None] = {}
        if len(self.spectra.names):
            listed["spectra"] = self.spectra.flux
        if self.free and (most > 1 or not listed):
            listed[FREE] = None
        # Every motion that is possible at a pixel adds the maxima of another sum of the maps.
        motions = np.sum([self._used(stack, speed) for speed in search.speeds], axis=0)
        used = motions > 0
        area = self.pixel_area * motions[used]
        return {name: Family(spectra, stack[used], area) for name, spectra in listed.items()}

    def sources(self) -> list[CombinedSource]:
        """Candidates, the least probable false alarm first."""
        seen = [each for k, maps in enumerate(self.epochs) for each in self._known(k, maps)]
        for k, search in enumerate(self.single):
            near = [each.sighting.place for each in seen if each.sighting.epoch == k]
            seen += [
                self._seen_at(k, search, peak)
                for peak in self._peaks(search, self.residuals)
                if not any(self._are_near(peak.place, place) for place in near)
            ]
        if self.together:
            seen += self._in_sums(seen)
        found = [self._measured(group) for group in self._groups(seen)]
        sources = [each for each in found if each is not None]
        return sorted(sources, key=lambda each: (each.false_alarm, -each.sigmas))

    def _known(self, number: int, maps: Sequence[SkyMap]) -> list[_Seen]:
        """Candidates of the single searches of an epoch, by source."""
        groups: list[dict[str, MapSource]] = []
        for each in maps:
            # One to one.
            cost = np.array([
                [min(self._apart(own, other) for other in group.values()) for group in groups]
                for own in each.sources
            ]).reshape(len(each.sources), len(groups))  # fmt: skip
            rows, columns = linear_sum_assignment(np.minimum(cost, _TWO_SOURCES_CHI2))
            taken = {
                int(row): groups[column]
                for row, column in zip(rows, columns, strict=True)
                if cost[row, column] < _TWO_SOURCES_CHI2
            }
            for k, own in enumerate(each.sources):
                if k not in taken:
                    taken[k] = {}
                    groups.append(taken[k])
                taken[k][each.name] = own
        return [self._as_seen(number, maps, group) for group in groups]

    def _apart(self, one: MapSource, other: MapSource) -> float:
        """Chi-squared of the difference of two places at one epoch, of two degrees of freedom.

        Less for places nearer than half of lambda/D, because a source that only one of two maps
        resolves has two places there, and one between them in the other map.
        """
        away = one.place - other.place
        chi2 = float(away @ np.linalg.solve(one.covariance + other.covariance, away))
        return min(chi2, _TWO_SOURCES_CHI2 * float(np.hypot(*away)) / (self.resolution / 2))

    def _as_seen(self, number: int, maps: Sequence[SkyMap], own: Mapping[str, MapSource]) -> _Seen:
        """Sighting of a candidate of some of the maps of an epoch."""
        information = [np.linalg.inv(each.covariance) for each in own.values()]
        covariance = np.linalg.inv(np.sum(information, axis=0))
        place = covariance @ np.sum(
            [i @ each.place for i, each in zip(information, own.values(), strict=True)], axis=0
        )
        values = {each.name: _value(self.residuals[each.name], place) for each in maps}
        fluxes = _fluxes(maps, values)
        light = {each.name: place for each in maps if each.name not in own}
        for each in maps:
            if each.name in own:
                source = own[each.name]
                values[each.name] = _Value(source.snr, source.sigmas, source.error)
                fluxes[each.name] = source.flux
        sighting = Sighting(number, place, covariance, _snr(values), _by_filter(maps, fluxes))
        return _Seen(sighting, place, covariance, self.dates[number], values, light, known=True)

    def _seen_at(self, number: int, search: _Search, peak: _Peak) -> _Seen:
        """Sighting of a peak of the search of an epoch."""
        values = {each.name: _value(self.residuals[each.name], peak.place) for each in search.maps}
        covariance = _covariance(search.maps, values)
        fluxes = _by_filter(search.maps, _fluxes(search.maps, values))
        sighting = Sighting(number, peak.place, covariance, _snr(values), fluxes)
        light = dict.fromkeys(values, peak.place)
        return _Seen(sighting, peak.place, covariance, search.reference, values, light)

    def _in_sums(self, seen: Sequence[_Seen]) -> list[_Seen]:
        """Sources that only the sums of the epochs show."""
        maps = {
            name: each.without([other.light[name] for other in seen if name in other.light])
            for name, each in self.residuals.items()
        }
        found: list[_Seen] = []
        peaks = [(peak, search) for search in self.together for peak in self._peaks(search, maps)]
        for peak, search in sorted(peaks, key=lambda each: -each[0].preference):
            moves = search.moves[peak.move]
            light = {each.name: peak.place + moves[each.name] for each in search.maps}
            if any(self._shows(other, light) for other in [*seen, *found]):
                continue
            values = {name: _value(maps[name], place) for name, place in light.items()}
            # Its motion is compared from the epoch at which it is brightest.
            parts = [{each.name: values[each.name] for each in epoch} for epoch in self.epochs]
            best = int(np.argmax([_snr(part) for part in parts]))
            own = [maps[each.name] for each in self.epochs[best]]
            start = light[own[0].name]
            place, _ = maximum(partial(_snr_at, own), start, self.resolution / 8)
            sighting = Sighting(
                best,
                place if self._are_near(place, start) else start,
                _covariance(own, values),
                _snr(parts[best]),
                _by_filter(own, _fluxes(own, values)),
            )
            covariance = _covariance(search.maps, values)
            found.append(_Seen(sighting, peak.place, covariance, search.reference, values, light))
        return found

    def _are_near(self, one: Image, other: Image) -> bool:
        """Whether two peaks of one map are of one source."""
        return bool(np.hypot(*(one - other)) < LIGHT * self.resolution)

    def _shows(self, seen: _Seen, light: Mapping[str, Image]) -> bool:
        """Whether a source is where the light of another is in any map."""
        places = {each.name: seen.sighting.place for each in self.epochs[seen.sighting.epoch]}
        places |= seen.light
        return any(self._are_near(places[name], light[name]) for name in places.keys() & light)

    def _peaks(self, search: _Search, maps: Mapping[str, SkyMap]) -> list[_Peak]:
        """Significant peaks of a search of `maps`, one for each source, the highest first."""
        peaks: list[_Peak] = []
        for move, speed in enumerate(search.speeds):
            stack = self.stack(search, self.grid, move, maps)
            used = self._used(stack, speed)
            for (name, kind), family in self.families.items():
                if name != search.name or not used.any():
                    continue
                level = self.levels[name, kind]
                image = family.statistic(stack)
                for pixel in local_maxima(image, used, level - _PEAK_PIXEL_SIGMAS, size=3):
                    place = self._highest(search, move, family, self.grid[pixel], maps)
                    sigmas = float(family.statistic(self.stack(search, place, move, maps)))
                    if sigmas >= level and np.hypot(*place) >= self.inner:
                        peaks.append(_Peak(place, move, sigmas, _preference(sigmas, kind)))
        kept: list[_Peak] = []
        for peak in sorted(peaks, key=lambda each: -each.preference):
            if not any(self._are_near(peak.place, other.place) for other in kept):
                kept.append(peak)
        return kept

    def _highest(
        self,
        search: _Search,
        move: int,
        family: Family,
        start: Image,
        maps: Mapping[str, SkyMap],
    ) -> Image:
        """The place where the S/N of the best spectrum of a family is highest, (2,)."""
        # The significance has its maximum elsewhere, if the degrees of freedom change with place.
        spectrum = family.best(self.stack(search, start, move, maps))
        place, _ = maximum(
            lambda place: family.snr(self.stack(search, place, move, maps), spectrum),
            start,
            math.sqrt(self.pixel_area) / 2,
        )
        is_far = np.hypot(*(place - start)) > 2 * math.sqrt(self.pixel_area)
        return start if is_far else place

    def _groups(self, seen: Sequence[_Seen]) -> list[_Group]:
        """Sightings grouped by source, with the hypotheses on the motion."""
        if self.motion is None:
            return [_Group([each], each.values) for each in seen]
        cleaned: dict[tuple[str, frozenset[int]], SkyMap] = {}

        def without_others(name: str, own: frozenset[int]) -> SkyMap:
            if (name, own) not in cleaned:
                others = (each.light for k, each in enumerate(seen) if k not in own)
                light = [each[name] for each in others if name in each]
                cleaned[name, own] = self.residuals[name].without(light)
            return cleaned[name, own]

        def unseen(
            epoch: int,
            place: Image,
            covariance: Image,
            fluxes: Mapping[str, tuple[float, float]],
            own: frozenset[int],
        ) -> float:
            maps = [without_others(each.name, own) for each in self.epochs[epoch]]
            return ln_likelihood_ratio(maps, place, covariance, fluxes, self.resolution)

        errors = [self.stack(each, self.grid).error for each in self.single]
        inside = np.isfinite(np.concatenate(errors)).any(axis=0)
        area = self.pixel_area * float(inside.sum())
        sightings = [each.sighting for each in seen]
        association = Association(sightings, self.dates, self.motion, area, unseen)
        groups = []
        for source in association.sources():
            parts = [seen[k] for k in source.sightings]
            values = {name: value for each in parts for name, value in each.values.items()}
            for epoch, maps in enumerate(self.epochs):
                if source.kind == "neither" or all(each.name in values for each in maps):
                    continue
                # The map counts where the motion predicts the place well.
                place, covariance = association.predicted(source.sightings, source.kind, epoch)
                if math.sqrt(np.linalg.eigvalsh(covariance)[-1]) < self.resolution / 4:
                    own = frozenset(source.sightings)
                    for each in maps:
                        values[each.name] = _value(without_others(each.name, own), place)
            groups.append(_Group(parts, values, source.kind, source.hypotheses))
        return groups

    def _measured(self, group: _Group) -> CombinedSource | None:
        """Spectrum, fluxes and significance of a source; None if it is below all levels."""
        values = group.values
        found = self._most_significant(values, group.kind)
        if found is None:
            if any(each.known for each in group.parts):
                self.remarks.append(self._below(group.parts))
            return None
        search, family, sigmas = found
        # A peak in any other search, or with a spectrum of another family, would have counted, too.
        trials = len(self.searches) * self.counts[search.name]
        expected = trials * self.families[search.name, family].expected(sigmas)
        alarm = -math.expm1(-expected)
        if _in_one_roll(search.maps):
            # Filters of one channel share the pixels of the detector.
            structure = float(structures_in_single_roll(sigmas))
            alarm = 1 - (1 - alarm) * (1 - structure)
        fluxes = self._stacked(values, [each for each in self.maps if each.name in values])
        best, snr, chi2 = FREE, 0.0, math.nan
        if len(self.spectra.names):
            # With S/N z_f in the filters and the direction w of a spectrum, the S/N of the spectrum
            # is w . z, and chi-squared of the fluxes about it is |z|^2 - (w . z)^2.
            heights = fluxes.weights(self.spectra.flux) @ fluxes.snr
            k = int(np.argmax(heights))
            chi2 = float((fluxes.snr**2).sum() - heights[k] ** 2)
            if family != FREE:
                best, snr = self.spectra.names[k], float(heights[k])
        if best == FREE:
            snr = float(np.sqrt((np.maximum(fluxes.snr, 0) ** 2).sum()))
        place = min(group.parts, key=lambda each: float(np.trace(each.covariance)))
        return CombinedSource(
            place=place.place,
            covariance=place.covariance,
            mjd=place.mjd,
            search=search.name,
            sigmas=sigmas,
            false_alarm=alarm,
            spectrum=best,
            snr=snr,
            chi2=chi2,
            fluxes=fluxes,
            hypotheses=group.hypotheses,
            sightings=tuple(
                (self.dates[each.sighting.epoch], each.sighting.place, each.sighting.covariance)
                for each in group.parts
            ),
        )

    def _most_significant(
        self, values: Mapping[str, _Value], kind: str | None
    ) -> tuple[_Search, str, float] | None:
        """Search, family of spectra and significance with which a source is above a level."""
        wrong = {"bound": _ON_SKY, "background": _WITH_STAR}.get(str(kind))
        best, found = -math.inf, None
        for search in self.searches:
            maps = [each for each in search.maps if each.name in values]
            # Sums are worth their trials only for what is seen at several epochs.
            if search.name == wrong or not maps or (
                search in self.together and len(epochs_of(maps)) < 2
            ):  # fmt: skip
                continue
            stack = self._stacked(values, maps)
            for (name, family), level in self.levels.items():
                if name != search.name:
                    continue
                sigmas = float(self.families[name, family].statistic(stack))
                if sigmas >= level and _preference(sigmas, family) > best:
                    best, found = _preference(sigmas, family), (search, family, sigmas)
        return found

    def _stacked(self, values: Mapping[str, _Value], maps: Sequence[SkyMap]) -> SkyStack:
        """Values of a source, added by filter."""
        return SkyStack.of_values(maps, self.spectra.filters, self.scales, values)

    def _below(self, group: Sequence[_Seen]) -> str:
        """Remark about a candidate of a single search that the combined search lacks."""
        best = max(group, key=lambda each: each.sighting.snr)
        separation, names = float(np.hypot(*best.place)), ", ".join(best.values)
        return (
            f"A candidate of a single search at {separation:.2f} arcsec ({names}), with a combined "
            f"S/N of {best.sighting.snr:.1f}, is below the threshold of the combined search, which "
            "has more trials"
        )


def _value(each: SkyMap, place: Image) -> _Value:
    return _Value(*(float(value) for value in each.at(place)))


def _fluxes(maps: Sequence[SkyMap], values: Mapping[str, _Value]) -> dict[str, tuple[float, float]]:
    """Contrasts with errors by the name of the map, where they are known."""
    known = {each.name: values[each.name] for each in maps}
    return {
        name: (value.snr * value.error, value.error)
        for name, value in known.items()
        if math.isfinite(value.error)
    }


def _by_filter(
    maps: Sequence[SkyMap], fluxes: Mapping[str, tuple[float, float]]
) -> dict[str, tuple[float, float]]:
    """Weighted means of contrasts with errors by filter, and the errors of the means."""
    means = {}
    for filter in dict.fromkeys(each.filter for each in maps if each.name in fluxes):
        pairs = [fluxes[e.name] for e in maps if e.name in fluxes and e.filter == filter]
        means[filter] = weighted_mean(*np.array(pairs).T)
    return means


def _covariance(maps: Sequence[SkyMap], values: Mapping[str, _Value]) -> Image:
    """Covariance of the place of a peak, (2, 2), arcsec^2."""
    # Chi-squared of a peak of S/N z in noise of curvature L grows by z^2 d L d at a distance d.
    curvature = np.sum([max(values[e.name].snr, 0.0) ** 2 * e.curvature for e in maps], axis=0)
    return np.asarray(np.linalg.inv(curvature) + POSITION**2 * np.eye(2))


def _snr(values: Mapping[str, _Value]) -> float:
    """Root of the summed squares of the positive S/N."""
    return math.sqrt(sum(max(each.snr, 0.0) ** 2 for each in values.values()))


def _snr_at(maps: Sequence[SkyMap], place: Image) -> float:
    """Root of the summed squares of the positive S/N of maps at a place, (2,)."""
    return _snr({each.name: _value(each, place) for each in maps})


def _preference(sigmas: float, family: str) -> float:
    """Chi-squared of a source, by which one of its peaks is chosen; less for free fluxes.

    Free fluxes always fit better, and stand for a spectrum that is not listed.
    """
    return sigmas**2 - (_UNLISTED_SPECTRUM_CHI2 if family == FREE else 0.0)
