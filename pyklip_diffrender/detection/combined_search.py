"""One search over the filters, arms and epochs of a star.

Every reduction says of every position what the flux of a point source is, and its error, with all
unknowns of the star marginalised. Different fits share no unknowns, so a source with the spectrum s
(flux densities s_f in the filters) has the amplitude and the S/N

    a = sum(s_f F_f / e_f^2) / sum(s_f^2 / e_f^2),    S/N = a sqrt(sum(s_f^2 / e_f^2)),

where F_f and e_f are the flux density in a filter and its error: those of the joint likelihood of
all frames. The spectrum is not known, and the highest S/N of a family of spectra has more trials
than that of one, see `Family`. In what follows, places are offsets from the star to the east and to
the north, arcsec.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from astropy import units as u
from astropy.time import Time
from numpy.typing import NDArray

from pyklip_diffrender.detection.combined_result import (
    FREE,
    Combination,
    CombinedSource,
    candidates_table,
    limits_table,
    scales_of,
    star_of_filter,
    unmoved,
)
from pyklip_diffrender.detection.error_factor import structures_in_single_roll
from pyklip_diffrender.detection.field import Image, separation_of
from pyklip_diffrender.detection.search_result import Detection
from pyklip_diffrender.detection.sky_map import (
    LIGHT,
    POSITION,
    YEAR,
    Family,
    Hypotheses,
    Motion,
    SkyMap,
    SkyStack,
    common_grid,
    date_of,
    epochs_of,
    hypotheses,
    level_of,
    maximum,
    signal,
)
from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.instrument.spectrum import PlanetSpectra, planet_spectra, star_flux_density
from pyklip_diffrender.io.units import (
    half_circle,
    require_positive,
    to_arcsec,
    to_number,
    to_unit,
)
from pyklip_diffrender.refinement import Status
from pyklip_diffrender.refinement.residual import local_maxima
from pyklip_diffrender.scene.exposure import common_motion, star_of

__all__ = ["combine"]

Spectra = str | os.PathLike[str] | Sequence[str | os.PathLike[str]]

_SHIFTS = 300
"""Largest number of orbital motions for which the epochs are added."""

_UNLISTED = 9.0
"""Chi-squared by which free fluxes have to be better than all listed spectra to be preferred."""

_BELOW = 0.7
"""Standard deviations by which the highest pixel of a peak may be lower than the peak."""

_NOT_CALIBRATED = tuple(each.name for each in Status if not each.calibrated)


def combine(
    reductions: Sequence[Any],
    *,
    spectra: Spectra = ("blackbody", "flat", FREE),
    star: str | os.PathLike[str] | None = None,
    proper_motion: Any = None,
    parallax: Any = None,
    mass: float = 1.0,
    threshold: float | None = None,
    inner: float = 0.2,
) -> Combination:
    """Search the filters, arms and epochs of a star together.

    At every position the fluxes of the reductions and their errors are combined for each spectrum
    of a family. The highest S/N of a family has more trials than that of one spectrum, and the
    threshold is higher, so that a combined search has as many false candidates as a single one.

    At several epochs, each is searched, and all of them are added as if sources moved with the
    star, by no more than an orbit, and as if they stayed on the sky. For every candidate three
    hypotheses are compared; see `Hypotheses`.

    Parameters
    ----------
    reductions : sequence of Reduction, Detection or path
        A path is that of a folder with the products of a reduction, of which ``detection.fits`` is
        read. Those whose fit does not explain its data are left out, as are those of frames that
        another reduction has.
    spectra : str, path, or sequence of them
        "blackbody" (150 to 1,500 K), "flat" (the same flux density per frequency in all filters),
        the file of a table of spectra (see `planet_spectra`), and "free": any fluxes that are
        not negative.
    star : path or str, optional
        Spectrum or spectral type of the star, see `star_flux_density`, for frames without
        photometric calibration. With it or with calibrated frames, spectra are of flux densities.
        Without either, the only spectrum beside "free" is the star's own, with the same contrast
        in all filters.
    proper_motion : (2,) or Quantity, optional
        Of the star, to the east (with cos Dec) and to the north, arcsec per year. Default that of
        the header (MU_RA, MU_DEC). Needed for several epochs.
    parallax : float or Quantity, optional
        Of the star, arcsec. Without it, parallax and orbital motion are neglected.
    mass : float
        Of the star, in solar masses, for the reach of orbits.
    threshold : float, optional
        S/N of a candidate in a search of one filter. Default the largest of the reductions.
    inner : float or Quantity
        Smallest separation of candidates, arcsec.

    Returns
    -------
    Combination

    Raises
    ------
    IncompatibleSetupError
        For fewer than two reductions that can be used, with the reason for each that cannot; for
        reductions of different stars; for several epochs without a proper motion; for spectra that
        do not cover a filter.
    CorruptFileError
        If a product or a table of spectra cannot be read.

    Examples
    --------
    Of folders with the products of reductions, which the package does not contain:

    >>> import pyklip_diffrender as dr
    >>> both = dr.combine(["products/F356W", "products/F444W"])  # doctest: +SKIP
    >>> print(both.candidates["separation", "spectrum", "snr", "verdict"])  # doctest: +SKIP
    """
    inner = float(to_arcsec(inner, "inner"))
    require_positive(threshold=threshold, inner=inner, mass=mass)
    detections = _named([_as_detection(each) for each in reductions])
    _require_one_star(detections)
    maps, left_out = _usable(detections, star)
    target = next(iter(detections.values())).observation.target if detections else "unknown"
    if len(maps) < 2:
        reasons = "; ".join(f"{name}: {reason}" for name, reason in left_out)
        raise IncompatibleSetupError(
            f"combine: got {len(detections)} reductions of {target}, of which {len(maps)} can be "
            f"used; expected two or more{f' ({reasons})' if reasons else ''}"
        )
    filters = tuple(dict.fromkeys(each.filter for each in maps))
    requests = [spectra] if isinstance(spectra, str | os.PathLike) else list(spectra)
    family, free, unit, remarks = _spectra(requests, filters, maps)
    motion = None
    if len(epochs_of(maps)) > 1:
        motion = _motion(detections, proper_motion, parallax, mass)
        if motion.parallax <= 0:
            remarks.append(
                "The star's parallax is not known: it is neglected, and so are orbits; a bound "
                "source is one that does not move. Give parallax= (--parallax)"
            )
    level = threshold or max(each.threshold for each in maps)
    searcher = _Searcher(maps, family, motion, free=free, unit=unit, threshold=level, inner=inner)
    sources = searcher.sources()
    stack = searcher.stack(searcher.unmoved, searcher.grid)
    snr = np.einsum("kf...,f...->k...", stack.weights(family.flux), stack.snr)
    names = [f"{searcher.unmoved.name}, {each}" for each in ("spectra", FREE)]
    limit = next(searcher.thresholds[name] for name in names if name in searcher.thresholds)
    return Combination(
        target=target,
        maps=maps,
        left_out=(*left_out, *family.left_out),
        spectra=family,
        free=free,
        unit=unit,
        threshold=level,
        thresholds=searcher.thresholds,
        expected_false_candidates=searcher.alarms_of_single_search(),
        candidates=candidates_table(
            sources,
            filters,
            searcher.stars,
            jansky=unit == "Jy",
            dated=maps[0].mjd is not None,
        ),
        limits=limits_table(stack, family, searcher.stars, searcher.grid, level=limit, inner=inner),
        grid=searcher.grid,
        snr=np.where(np.isfinite(stack.error).any(axis=0), snr, np.nan),
        motion=motion,
        remarks=(*remarks, *searcher.remarks),
    )


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
    """A peak of a search: place, orbital motion, family of spectra and significance."""

    search: _Search
    move: int
    family: str
    place: Image
    sigmas: float
    false_alarm: float

    @property
    def preference(self) -> float:
        """Chi-squared of the source, by which one of its peaks is chosen; less for free fluxes.

        They always fit better, and stand for a spectrum that is not listed.
        """
        return self.sigmas**2 - (_UNLISTED if self.family == FREE else 0.0)

    def seen_at(self) -> dict[str, Image]:
        """East and north by the name of the map."""
        moves = self.search.moves[self.move]
        return {each.name: self.place + moves[each.name] for each in self.search.maps}


def _in_one_roll(maps: tuple[SkyMap, ...]) -> bool:
    """Whether all maps have one orientation, so that structures of the detector do not turn."""
    turned = [abs(half_circle(each.north - maps[0].north)) for each in maps]
    return all(each.single_roll for each in maps) and max(turned) < 1


class _Searcher:
    """The parts of `combine` that share the maps."""

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
        self.area = float(np.prod(np.abs(self.grid[1, 1] - self.grid[0, 0])))
        self.distance = separation_of(self.grid)
        self.remarks: list[str] = []
        self.thresholds: dict[str, float] = {}
        self.searches = self._searches()

    def stack(
        self, search: _Search, places: Image, move: int = 0, *, fitted: bool = False
    ) -> SkyStack:
        """The maps of a search at places."""
        filters, moves = self.spectra.filters, search.moves[move]
        return SkyStack.of(search.maps, filters, self.scales, places, moves, fitted=fitted)

    def sources(self) -> list[CombinedSource]:
        """Candidates, the least probable false alarm first."""
        alarms = self.alarms_of_single_search() / len(self.searches)
        peaks = [peak for each in self.searches for peak in self._peaks(each, alarms)]
        kept: list[_Peak] = []
        for peak in sorted(peaks, key=lambda each: -each.preference):
            if not any(self._is_same(peak, other) for other in kept):
                kept.append(peak)
        kept.sort(key=lambda each: (each.false_alarm, -each.sigmas))
        return [self._measured(peak) for peak in kept]

    @property
    def unmoved(self) -> _Search:
        """The search of all maps, unmoved by its first motion."""
        return next(each for each in self.searches if len(each.maps) == len(self.maps))

    def _searches(self) -> list[_Search]:
        """Every epoch alone, and all of them together, with the star and fixed on the sky."""
        epochs = epochs_of(self.maps)
        if self.motion is None:
            date = date_of(self.maps) if self.maps[0].mjd is not None else math.nan
            return [_Search("all filters", self.maps, (unmoved(self.maps),), (0.0,), date)]
        searches = [
            _Search(
                Time(date_of(each), format="mjd").isot[:10],
                tuple(each),
                (unmoved(each),),
                (0.0,),
                date_of(each),
            )
            for each in epochs
        ]
        first = date_of(epochs[0])
        dates = {each.name: date_of([each]) for each in self.maps}
        fixed = {name: self.motion.background(first, date) for name, date in dates.items()}
        velocities = self._velocities(date_of(epochs[-1]) - first)
        moved = tuple(
            {name: v * (date - first) / YEAR for name, date in dates.items()} for v in velocities
        )
        speeds = tuple(float(np.hypot(*v)) for v in velocities)
        return [
            *searches,
            _Search("all epochs, with the star", self.maps, moved, speeds, first),
            _Search("all epochs, on the sky", self.maps, (fixed,), (0.0,), first),
        ]

    def _velocities(self, days: float) -> list[Image]:
        """Orbital motions, (2,) each, arcsec per year, half lambda/D apart at the last epoch."""
        motion, years = self.motion, days / YEAR
        # Velocities on a square lattice within the speed of a parabolic orbit at the inner
        # separation.
        fastest = 0.0 if motion is None else math.sqrt(2) * float(motion.orbital(self.inner))
        step = self.resolution / 2 / years
        reach = int(fastest / step)
        if math.pi * reach**2 > _SHIFTS:
            self.remarks.append(
                f"Orbits may move a source by {fastest * years:.2f} arcsec between the epochs, too "
                "far to add the epochs for every motion: they were added unmoved. The hypotheses "
                "allow the motion"
            )
            reach = 0
        axis = step * np.arange(-reach, reach + 1)
        inside = [np.array([x, y]) for x in axis for y in axis if math.hypot(x, y) <= fastest]
        return sorted(inside or [np.zeros(2)], key=lambda v: float(np.hypot(*v)))

    def alarms_of_single_search(self) -> float:
        """Expected number of false candidates of a search of one filter, mean over the maps."""
        counts = []
        for each in self.maps:
            stack = self.stack(_Search("", (each,), (unmoved([each]),), (0.0,), 0.0), self.grid)
            used = self._used(stack)
            spectrum = np.array([[name == each.filter for name in self.spectra.filters]], float)
            counts.append(Family(spectrum, stack[used], self.area).expected(self.threshold))
        return float(np.mean(counts))

    def _used(self, stack: SkyStack, speed: float = 0.0) -> NDArray[np.bool_]:
        """Pixels of the grid that are searched, with orbital motion only where it is possible."""
        used = np.isfinite(stack.error).any(axis=0) & (self.distance >= self.inner)
        if speed > 0 and self.motion is not None:
            used &= speed <= math.sqrt(2) * self.motion.orbital(self.distance)
        return np.asarray(used)

    def _families(self, stack: SkyStack) -> dict[str, Image | None]:
        """Spectra to search, by the name of their family; one is enough for a single filter."""
        most = int(np.isfinite(stack.error).sum(axis=0).max(initial=0))
        listed: dict[str, Image | None] = {}
        if len(self.spectra.names):
            listed["spectra"] = self.spectra.flux
        if self.free and (most > 1 or not listed):
            listed[FREE] = None
        return listed

    def _peaks(self, search: _Search, alarms: float) -> list[_Peak]:
        """Significant peaks of a search that may have so many false alarms."""
        stacks = {}
        members: dict[str, list[tuple[int, Family, NDArray[np.bool_]]]] = {}
        for move, speed in enumerate(search.speeds):
            stack = self.stack(search, self.grid, move)
            used = self._used(stack, speed)
            if used.any():
                stacks[move] = stack
                for name, spectra in self._families(stack).items():
                    family = Family(spectra, stack[used], self.area)
                    members.setdefault(name, []).append((move, family, used))
        # All searches and families share the false alarms of a single search equally: the level is
        # that at which noise has so many maxima over all motions of this search, with spectra of
        # this family. A peak anywhere else would have counted as well, so that its probability is
        # multiplied by the trials.
        trials = len(self.searches) * len(members)
        peaks = []
        for name, parts in members.items():
            families = [family for _, family, _ in parts]
            level = level_of(families, alarms / len(members))
            self.thresholds[f"{search.name}, {name}"] = level
            for move, family, used in parts:
                image = family.statistic(stacks[move])
                for peak in local_maxima(image, used, level - _BELOW, size=3):
                    place, sigmas = self._refined(search, move, family, self.grid[peak])
                    if sigmas >= level and np.hypot(*place) >= self.inner:
                        expected = trials * sum(each.expected(sigmas) for each in families)
                        alarm = -math.expm1(-expected)
                        if _in_one_roll(search.maps):
                            # Filters of one channel share the pixels of the detector.
                            structure = float(structures_in_single_roll(sigmas))
                            alarm = 1 - (1 - alarm) * (1 - structure)
                        peaks.append(_Peak(search, move, name, place, sigmas, alarm))
        return peaks

    def _refined(
        self, search: _Search, move: int, family: Family, start: Image
    ) -> tuple[Image, float]:
        """Place and significance of a peak, at the maximum between the pixels."""

        def significance(place: Image) -> float:
            return float(family.statistic(self.stack(search, place, move)))

        place, height = maximum(significance, start, math.sqrt(self.area) / 2)
        if np.hypot(*(place - start)) > 2 * math.sqrt(self.area):
            return start, significance(start)
        return place, height

    def _is_same(self, peak: _Peak, other: _Peak) -> bool:
        """Whether two peaks are of one source: at one place in any map that both have."""
        mine, yours = peak.seen_at(), other.seen_at()
        return any(
            np.hypot(*(mine[name] - yours[name])) < LIGHT * self.resolution
            for name in mine.keys() & yours.keys()
        )

    def _measured(self, peak: _Peak) -> CombinedSource:
        """Spectrum, fluxes, error of the position, and hypotheses of a candidate."""
        fluxes = self.stack(peak.search, peak.place, peak.move, fitted=True)
        best, snr, chi2 = FREE, 0.0, math.nan
        shape = np.maximum(fluxes.flux, 0.0)
        if len(self.spectra.names):
            # With S/N z_f in the filters and the direction w of a spectrum, the S/N of the spectrum
            # is w . z, and chi-squared of the fluxes about it is |z|^2 - (w . z)^2.
            values = fluxes.weights(self.spectra.flux) @ fluxes.snr
            k = int(np.argmax(values))
            chi2 = float((fluxes.snr**2).sum() - values[k] ** 2)
            if peak.family != FREE:
                best, snr, shape = self.spectra.names[k], float(values[k]), self.spectra.flux[k]
        if best == FREE:
            snr = float(np.sqrt((np.maximum(fluxes.snr, 0) ** 2).sum()))
        # The chi-squared of a peak of S/N z in noise of curvature L grows by z^2 d L d at the
        # distance d.
        share = fluxes.snr**2 / max(float((fluxes.snr**2).sum()), 1e-300)
        curvature = max(snr, 1.0) ** 2 * np.einsum("f,fij->ij", share, fluxes.curvature)
        return CombinedSource(
            place=peak.place,
            covariance=np.linalg.inv(curvature) + POSITION**2 * np.eye(2),
            mjd=peak.search.reference,
            search=peak.search.name,
            sigmas=peak.sigmas,
            false_alarm=peak.false_alarm,
            spectrum=best,
            snr=snr,
            chi2=chi2,
            fluxes=fluxes,
            hypotheses=None if self.motion is None else self._compared(peak, shape, self.motion),
        )

    def _compared(self, peak: _Peak, shape: Image, motion: Motion) -> Hypotheses:
        """Hypotheses on the motion of a candidate with fluxes in the filters, (filters,)."""
        contrasts = {
            each.name: float(shape[self.spectra.filters.index(each.filter)])
            / self.scales[each.name]
            for each in self.maps
        }
        seen_at = peak.seen_at()
        # The place is best known at the epoch with the highest S/N.
        epochs = [each for each in epochs_of(self.maps) if each[0].name in seen_at]
        best = max(epochs, key=lambda each: signal(each, contrasts, seen_at[each[0].name]))
        place = seen_at[best[0].name]
        return hypotheses(self.maps, contrasts, place, date_of(best), motion)


def _as_detection(reduction: Any) -> Detection:
    if isinstance(reduction, str | os.PathLike):
        return Detection.read(reduction)
    detection = getattr(reduction, "detection", reduction)
    if not isinstance(detection, Detection):
        raise IncompatibleSetupError(
            f"combine: got a {type(reduction).__name__}, expected a Reduction, a Detection, or a "
            "folder with the products of a reduction"
        )
    return detection


def _named(detections: Sequence[Detection]) -> dict[str, Detection]:
    """Detections by filter and date, numbered where these are equal."""
    named: dict[str, Detection] = {}
    for each in detections:
        parts = [each.observation.filter or "unknown", (each.sky.date or "")[:10]]
        name = plain = " ".join(filter(None, parts))
        number = 1
        while name in named:
            number += 1
            name = f"{plain} ({number})"
        named[name] = each
    return named


def _require_one_star(detections: Mapping[str, Detection]) -> None:
    observations = [each.observation for each in detections.values()]
    for other in observations[1:]:
        first = observations[0]
        one, two = (star_of(each.header, each.name) for each in (first, other))
        # Headers of simulated frames name no star.
        if one.is_known and two.is_known and not one.is_same(two):
            raise IncompatibleSetupError(
                f"combine: got reductions of {first.target} and {other.target}, expected those of "
                "one star"
            )


def _usable(
    detections: Mapping[str, Detection], star: str | os.PathLike[str] | None
) -> tuple[tuple[SkyMap, ...], tuple[tuple[str, str], ...]]:
    """Maps of the reductions that can be combined, and the others with the reason."""
    maps, left_out = [], []
    shown: dict[tuple[str | None, float, str] | None, str] = {}
    dated = any(each.sky.mjd is not None for each in detections.values())
    for name, detection in detections.items():
        status = str(detection.provenance["status"])
        frames = _frames(detection)
        reason = ""
        if status in _NOT_CALIBRATED:
            reason = f"its fit does not explain its data ({status}), so that its errors are wrong"
        elif detection.sky.north is None:
            reason = "its frames have no position angle"
        elif detection.observation.filter is None:
            reason = "its frames have no filter"
        elif dated and detection.sky.mjd is None:
            reason = "its frames have no date, and others have"
        elif not np.isfinite(detection.error).any():
            reason = "it has no errors"
        elif frames in shown:
            reason = f"its frames are those of {shown[frames]}"
        if reason:
            left_out.append((name, reason))
            continue
        if frames is not None:
            shown[frames] = name
        each = SkyMap.of(detection, name)
        if each.star is None and star is not None:
            each = replace(each, star=float(star_flux_density(star, each.filter).value))
        maps.append(each)
    return tuple(maps), tuple(left_out)


def _frames(detection: Detection) -> tuple[str | None, float, str] | None:
    """Filter, date and first file of what was searched; None if the frames have no date."""
    mjd, observation = detection.sky.mjd, detection.observation
    return None if mjd is None else (observation.filter, mjd, observation.name)


def _spectra(
    requests: Sequence[Any], filters: tuple[str, ...], maps: Sequence[SkyMap]
) -> tuple[PlanetSpectra, bool, str, list[str]]:
    """Spectra, whether fluxes are free as well, the unit of fluxes, and remarks."""
    if not requests:
        raise IncompatibleSetupError(
            'spectra: got none, expected "blackbody", "flat", "free", or a table of spectra'
        )
    free = FREE in requests
    listed = [each for each in requests if each != FREE]
    if len(filters) == 1:
        return PlanetSpectra(("one filter",), filters, np.ones((1, 1))), False, "contrast", []
    if all(each.star is not None for each in maps):
        return planet_spectra(listed, filters), free, "Jy", []
    # Mistakes in the request are errors in any case.
    planet_spectra(listed, filters)
    unknown = ", ".join(each.name for each in maps if each.star is None)
    remark = (
        f"The star's flux density is not known ({unknown}), so that contrasts are not converted to "
        "those of a planet's spectrum: the listed spectra are replaced by the star's own, the same "
        "contrast in all filters. Give the star's spectrum with star= (--star-sed)"
    )
    own = PlanetSpectra(("as the star",), filters, np.ones((1, len(filters))))
    return own, free, "contrast", [remark]


def _motion(detections: Mapping[str, Detection], proper: Any, parallax: Any, mass: float) -> Motion:
    """Motion of the star, from the arguments or the headers."""
    observations = [each.observation for each in detections.values()]
    if proper is None:
        proper = common_motion((each.header, each.name) for each in observations)
    if proper is None:
        raise IncompatibleSetupError(
            "combine: got reductions of several epochs, and no header has the star's proper motion "
            "(MU_RA, MU_DEC). Give proper_motion= (--proper-motion), or combine the reductions of "
            "each epoch alone"
        )
    east, north = np.asarray(to_unit(proper, "arcsec / yr", "proper_motion"), dtype=float)
    stars = [star_of(each.header, each.name).coordinates for each in observations]
    return Motion(
        (float(east), float(north)),
        0.0 if parallax is None else to_number(parallax, u.arcsec, "parallax", "not negative"),
        next((each for each in stars if each is not None), None),
        mass,
    )
