"""Which sources of several epochs are one, and whether each moves with the star.

A source is *bound* and moves with the star by no more than an orbit allows, or it is in the
*background* and stays on the sky, or it is *neither*: seen at one epoch only. Places are offsets
from the star to the east and to the north, arcsec.

A bound source has the place x(t) = m + o(t), where m is any place and o is a Gaussian process whose
velocity has the standard deviation s in each direction. A Keplerian orbit turns back, so that its
covariance is the mean over angular frequencies w,

    <o(t) o(t')> = mean_w of s^2 / w^2 cos(w (t - t')).

A source in the background has x(t) = m + b(t) + v t with the known parallactic and proper motion b
of the star, reversed, and a small velocity v of its own. Both are Gaussian, so that the density of
the places of a source at several epochs, p(x_1 ... x_n), has a closed form.

Where one epoch has sources i and the next sources j, all one-to-one associations are compared. The
probability of an association is the product over its sources of

    A^(n - 1) p(x_1 ... x_n) q(fluxes) prod(u at the epochs where it was not seen),

relative to n sources that are not related and lie anywhere in the field of the area A. `q` compares
the fluxes in the same filter, and u is the likelihood of an epoch's map with the source at the
places that its motion predicts, over the likelihood without it. A source that is neither bound nor
in the background is not expected at any other epoch. A source of each kind is expected once in the
field. This is the multiple-hypothesis tracking of D. B. Reid, IEEE Trans. Automatic Control 24, 843
(1979).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from astropy import units as u
from astropy.coordinates import get_body_barycentric
from astropy.time import Time
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import block_diag
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.special import logsumexp

from pyklip_diffrender.detection.field import Image
from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.io.units import require_finite, to_number, to_unit

YEAR_DAYS = 365.25

_BACKGROUND_SPEED = 0.003
"""Standard deviation of the proper motion of a background source, arcsec per year: stars at a few
kpc. Galaxies have none."""

_ORBITAL_SPEED = 0.5
"""Standard deviation of the velocity of a companion in each direction on the sky, over the speed of
a circular orbit whose radius is its projected separation. It is 0.47 for orbits of any
orientation with eccentricities up to 0.9."""

_ORBITAL_FREQUENCIES = np.array([0.34, 0.69, 0.89, 0.99])
"""Angular frequencies of orbits, relative to a circular orbit whose radius is the projected
separation: (sin t)^1.5 at the middles of the quarters of the distribution of the angle t between
the line of sight and the companion."""

_L2_DISTANCE = 1.01
"""Distance of the telescope from the Sun over the distance of the Earth."""

_NEAREST_PARALLAX = 0.7685
"""Parallax of Proxima Centauri, the star nearest to the Sun, arcsec (Gaia DR3)."""

_FASTEST_PROPER_MOTION = 10.4
"""Proper motion of Barnard's star, the largest of all stars, arcsec per year (Gaia DR3)."""

_PLACE_VARIANCE_ARCSEC2 = 1e4
"""Variance of the place m, arcsec^2: much larger than any field."""

_LOG_FLUX_RANGE = math.log(1e3)
"""Logarithm of the ratio of the largest flux of sources to the smallest; log F is uniform."""

_SAME_SOURCE_LIKELIHOOD_RATIO = 1e-4
"""Likelihood of two sightings as one source over two sources, below which they are two."""

_MOST_ASSOCIATIONS = 2000
"""Associations that are kept while sightings are added, the most probable ones."""

_VERDICT_PROBABILITY = 0.99
"""Probability of a hypothesis from which it is stated as the verdict."""


@dataclass(frozen=True)
class Motion:
    """How places of sources move between epochs."""

    proper: tuple[float, float]  # Proper motion of the star to the east and north, arcsec per year.
    parallax: float = 0.0  # arcsec; 0 if it is not known.
    # Right ascension and declination of the star, degrees.
    coordinates: tuple[float, float] | None = None
    mass: float = 1.0  # of the star, solar masses

    def background(self, before: float, after: float) -> NDArray[np.float64]:
        """Displacement of a source that stays on the sky, beside the star, between two dates (MJD).

        Returns
        -------
        ndarray, (2,)
            To the east and north, arcsec.
        """
        moved = np.array(self.proper) * (after - before) / YEAR_DAYS
        if self.parallax > 0 and self.coordinates is not None:
            moved = moved + self.parallax * (self._factors(after) - self._factors(before))
        return -moved

    def _factors(self, mjd: float) -> NDArray[np.float64]:
        """Parallax factors to the east and north, (2,)."""
        earth = get_body_barycentric("earth", Time(mjd, format="mjd")).xyz.to_value("AU")
        ra, dec = np.deg2rad(self.coordinates or (0.0, 0.0))
        east = np.array([np.sin(ra), -np.cos(ra), 0.0])
        north = np.array([np.cos(ra) * np.sin(dec), np.sin(ra) * np.sin(dec), -np.cos(dec)])
        return _L2_DISTANCE * np.array([east @ earth, north @ earth])

    def orbital(self, separation: ArrayLike) -> NDArray[np.float64]:
        """Speed of a circular orbit at projected separations, arcsec per year; 0 if not known.

        A bound companion moves by at most the square root of two times this speed.
        """
        distance = np.maximum(np.asarray(separation, dtype=float), 1e-3)
        if self.parallax <= 0:
            return np.zeros_like(distance)
        au = distance / self.parallax
        return np.asarray(2 * math.pi * np.sqrt(self.mass / au) * self.parallax)


def checked_motion(
    proper: Any, parallax: Any, mass: Any = 1.0
) -> tuple[tuple[float, float] | None, float, float]:
    """Convert the motion of a star to arcsec per year, arcsec and solar masses.

    Two exact zeros, as in an empty proposal, are a proper motion that is not known (None), and so
    is a parallax of 0. IncompatibleSetupError for values that no star has.
    """
    if proper is not None:
        values = np.asarray(to_unit(_parsed(proper), "arcsec / yr", "proper_motion"), dtype=float)
        if values.shape != (2,):
            raise IncompatibleSetupError(
                f"proper_motion: got shape {values.shape}, expected two numbers, to the east and "
                "to the north"
            )
        require_finite(values, "proper_motion")
        speed = float(np.hypot(*values))
        if speed > _FASTEST_PROPER_MOTION:
            raise IncompatibleSetupError(
                f"proper_motion: got {speed:g} arcsec per year, and no star is faster than "
                f"{_FASTEST_PROPER_MOTION:g}. Catalogues have milliarcseconds per year: give "
                f"{values[0]:g} mas/yr and {values[1]:g} mas/yr, with the unit, if this is meant"
            )
        proper = (float(values[0]), float(values[1])) if values.any() else None
    angle = 0.0
    if parallax is not None:
        angle = to_number(_parsed(parallax), u.arcsec, "parallax", "not negative")
        if angle > _NEAREST_PARALLAX:
            raise IncompatibleSetupError(
                f"parallax: got {angle:g} arcsec, and no star has more than "
                f"{_NEAREST_PARALLAX:g}. Catalogues have milliarcseconds: give {angle:g} mas, with "
                "the unit, if this is meant"
            )
    return proper, angle, to_number(mass, u.solMass, "mass", "positive")


def _parsed(value: Any) -> Any:
    """Text such as "45 mas" as a Quantity; members of a sequence one by one."""
    if isinstance(value, str):
        try:
            quantity = u.Quantity(value)
        except (TypeError, ValueError) as error:
            raise IncompatibleSetupError(
                f"got {value!r}, expected a number with a unit, such as '45 mas' or '377 mas/yr'"
            ) from error
        return float(quantity) if quantity.unit == u.one else quantity
    return [_parsed(each) for each in value] if isinstance(value, list | tuple) else value


@dataclass(frozen=True)
class Hypotheses:
    """Probabilities of three hypotheses about a source, given its places at several epochs.

    Attributes
    ----------
    bound, background, neither : float
        Probabilities, if all three were equally probable before. A bound source moves by no more
        than an orbit allows; one in the background stays on the sky; the third is a source that
        is seen at one epoch, and at no other where the first two would have it.
    ln_ratio : float
        Logarithm of the evidence of the first over the evidence of the second.
    """

    bound: float
    background: float
    neither: float
    ln_ratio: float

    @property
    def verdict(self) -> str:
        """The hypothesis with a probability of 99 % or more, in words."""
        if self.bound >= _VERDICT_PROBABILITY:
            return "moves with the star"
        if self.background >= _VERDICT_PROBABILITY:
            return "stays on the sky: a source in the background"
        if self.neither >= _VERDICT_PROBABILITY:
            return "neither moves with the star nor stays on the sky"
        return "not decided"


@dataclass(frozen=True, eq=False)
class Sighting:
    """A source at one epoch."""

    epoch: int
    place: Image  # (2,)
    covariance: Image  # (2, 2), of the place, arcsec^2, with the errors beyond the noise.
    snr: float
    # Contrast and its error, with the error of the star's flux, by filter.
    fluxes: Mapping[str, tuple[float, float]]


Unseen = Callable[[int, Image, Image, Mapping[str, tuple[float, float]], frozenset[int]], float]
"""Logarithm of u for an epoch, a place (2,) with its covariance (2, 2), contrasts with their errors
by filter, and the sightings that are the source itself."""

Track = tuple[int, ...]
"""Numbers of the sightings of a source, in order of time."""

_KINDS = ("bound", "background", "neither")


@dataclass(frozen=True)
class Source:
    """Sightings that are most probably one source, and the hypotheses about its motion."""

    sightings: Track
    hypotheses: Hypotheses

    @property
    def kind(self) -> str:
        """The most probable hypothesis."""
        return max(_KINDS, key=lambda each: getattr(self.hypotheses, each))


class Association:
    """All one-to-one associations of sightings at several epochs.

    `dates` are the epochs' dates, MJD, `area` is the area of the field, arcsec^2, and `unseen`
    says what the map of an epoch without a sighting says of a source.
    """

    def __init__(
        self,
        sightings: Sequence[Sighting],
        dates: Sequence[float],
        motion: Motion,
        area: float,
        unseen: Unseen,
    ) -> None:
        self._sightings, self._motion, self._unseen = tuple(sightings), motion, unseen
        self._area = area
        self._years = (np.array(dates) - dates[0]) / YEAR_DAYS
        self._background = np.array([motion.background(dates[0], date) for date in dates])
        self._known: dict[Track, Image] = {}
        self._evidence: dict[Track, float] = {}

    def sources(self) -> list[Source]:
        """Sightings by source in the most probable association, with its hypotheses."""
        count = len(self._sightings)
        links = [
            (i, j)
            for i in range(count)
            for j in range(i)
            if self._sightings[i].epoch != self._sightings[j].epoch and self._may_be_one(i, j)
        ]
        first, second = np.array(links, dtype=int).reshape(-1, 2).T
        graph = coo_array((np.ones(len(links)), (first, second)), shape=(count, count))
        _, labels = connected_components(graph, directed=False)
        linked = graph.toarray() + graph.toarray().T > 0
        return [
            source
            for label in dict.fromkeys(labels.tolist())
            for source in self._of_group(np.flatnonzero(labels == label).tolist(), linked)
        ]

    def _may_be_one(self, i: int, j: int) -> bool:
        one, other = sorted((i, j), key=lambda k: self._sightings[k].epoch)
        return bool(logsumexp(self._seen((one, other))) > math.log(_SAME_SOURCE_LIKELIHOOD_RATIO))

    def _of_group(self, members: list[int], linked: NDArray[np.bool_]) -> Iterator[Source]:
        """Sources made of the sightings `members`, to which no other sighting can belong."""
        members = sorted(members, key=lambda k: self._sightings[k].epoch)
        # Each with the logarithm of its probability, as far as the sightings decide.
        kept: list[tuple[float, tuple[Track, ...]]] = [(0.0, ())]
        for k in members:
            epoch = self._sightings[k].epoch
            longer = [
                (
                    total - self._ln_seen(track) + self._ln_seen((*track, k)),
                    (*tracks[:n], (*track, k), *tracks[n + 1 :]),
                )
                for total, tracks in kept
                for n, track in enumerate(tracks)
                if self._sightings[track[-1]].epoch < epoch and linked[k, list(track)].any()
            ]
            alone = self._ln_seen((k,))
            kept = [*((total + alone, (*tracks, (k,))) for total, tracks in kept), *longer]
            if len(kept) > _MOST_ASSOCIATIONS:
                kept = sorted(kept, key=lambda each: -each[0])[:_MOST_ASSOCIATIONS]
        associations = [tracks for _, tracks in kept]
        totals = np.array([sum(logsumexp(self._logs(t)) for t in each) for each in associations])
        weights = np.exp(totals - totals.max())
        for track in associations[int(np.argmax(weights))]:
            brightest = max(track, key=lambda k: self._sightings[k].snr)
            total = np.zeros(len(_KINDS))
            for tracks, weight in zip(associations, weights, strict=True):
                logs = self._logs(next(each for each in tracks if brightest in each))
                total += weight * np.exp(logs - logsumexp(logs))
            bound, background, neither = (total / total.sum()).tolist()
            logs = self._logs(track)
            yield Source(track, Hypotheses(bound, background, neither, float(logs[0] - logs[1])))

    def _logs(self, track: Track) -> Image:
        """Logarithms of the evidence of the hypotheses for a source, (3,), without their prior."""
        if track not in self._known:
            logs = self._seen(track)
            own = [self._sightings[k] for k in track]
            seen = {each.epoch for each in own}
            fluxes = {name: weighted_mean(*pairs) for name, pairs in _by_filter(own).items()}
            for kind in range(2):
                for epoch in set(range(len(self._years))) - seen:
                    place, covariance = self.predicted(track, _KINDS[kind], epoch)
                    logs[kind] += self._unseen(epoch, place, covariance, fluxes, frozenset(track))
            self._known[track] = logs
        return self._known[track].copy()

    def _ln_seen(self, track: Track) -> float:
        """Logarithm of the part of the evidence of a source that comes from its sightings."""
        if track not in self._evidence:
            self._evidence[track] = float(logsumexp(self._seen(track)))
        return self._evidence[track]

    def _seen(self, track: Track) -> Image:
        """The logarithms, (3,), of the part of the evidence that comes from the sightings."""
        own = [self._sightings[k] for k in track]
        if len(own) == 1:
            return np.zeros(len(_KINDS))
        logs = np.full(len(_KINDS), -np.inf)
        places = np.concatenate([each.place for each in own])
        flux = _flux_evidence(own)
        for kind in range(2):
            mean, covariance = self._process(_KINDS[kind], own)
            epochs = [each.epoch for each in own]
            index = np.concatenate([[2 * e, 2 * e + 1] for e in epochs])
            full = covariance[np.ix_(index, index)] + block_diag(*(e.covariance for e in own))
            away = places - mean[index]
            _, size = np.linalg.slogdet(2 * math.pi * full)
            # The density of the places if m has the density 1, not the wide Gaussian's.
            density = -(away @ np.linalg.solve(full, away) + size) / 2
            density += math.log(2 * math.pi * _PLACE_VARIANCE_ARCSEC2)
            logs[kind] = density + (len(own) - 1) * math.log(self._area) + flux
        return logs

    def _process(self, kind: str, own: Sequence[Sighting]) -> tuple[Image, Image]:
        """Mean (2 epochs,) and covariance of the places of a source, east and north by turns."""
        years = self._years
        # The wide Gaussian is about the first place, so that nothing is lost in rounding.
        mean = np.tile(own[0].place, (len(years), 1))
        if kind == "background":
            mean = mean + self._background - self._background[own[0].epoch]
            kernel = _BACKGROUND_SPEED**2 * np.outer(years, years)
        else:
            separation = float(np.hypot(*own[0].place))
            circular = float(self._motion.orbital(separation))
            kernel = np.zeros((len(years), len(years)))
            if circular > 0:
                apart = years[:, None] - years
                for share in _ORBITAL_FREQUENCIES:
                    frequency = share * circular / max(separation, 1e-3)
                    kernel += (np.cos(frequency * apart) - 1) / frequency**2
                kernel *= (_ORBITAL_SPEED * circular) ** 2 / len(_ORBITAL_FREQUENCIES)
        return mean.ravel(), np.kron(kernel + _PLACE_VARIANCE_ARCSEC2, np.eye(2))

    def predicted(self, track: Track, kind: str, epoch: int) -> tuple[Image, Image]:
        """Place (2,) and its covariance (2, 2) of a source at an epoch, from its sightings."""
        own = [self._sightings[k] for k in track]
        mean, covariance = self._process(kind, own)
        index = np.concatenate([[2 * e.epoch, 2 * e.epoch + 1] for e in own])
        there = np.array([2 * epoch, 2 * epoch + 1])
        full = covariance[np.ix_(index, index)] + block_diag(*(each.covariance for each in own))
        cross = covariance[np.ix_(there, index)]
        gain = np.linalg.solve(full, cross.T).T
        away = np.concatenate([each.place for each in own]) - mean[index]
        left = covariance[np.ix_(there, there)] - gain @ cross.T
        return mean[there] + gain @ away, (left + left.T) / 2


def _by_filter(own: Sequence[Sighting]) -> dict[str, Image]:
    """Contrasts and their errors, (2, k), of the sightings by filter."""
    names = dict.fromkeys(name for each in own for name in each.fluxes)
    return {name: np.array([e.fluxes[name] for e in own if name in e.fluxes]).T for name in names}


def weighted_mean(values: Image, errors: Image) -> tuple[float, float]:
    """Mean of values (k,) with weights 1 / errors^2, and its error."""
    information = float((errors**-2.0).sum())
    return float((values / errors**2).sum()) / information, information**-0.5


def _flux_evidence(own: Sequence[Sighting]) -> float:
    """Logarithm of q: evidence of one flux in each filter, over the evidence of one flux each."""
    # With log F uniform, the prior of F is 1 / (F range). It is flat over the error of F, so that
    # the integral of the prior and of Gaussians F_i +- e_i is the prior at their mean times the
    # integral of their product.
    total = 0.0
    for values, errors in _by_filter(own).values():
        if len(values) == 1:
            continue
        mean, error = weighted_mean(values, errors)
        product = -(((values - mean) / errors) ** 2).sum() / 2 - np.log(errors).sum()
        product += math.log(error) - (len(values) - 1) * math.log(2 * math.pi) / 2
        alone = -np.log(np.maximum(values, errors) * _LOG_FLUX_RANGE).sum()
        total += float(product - math.log(max(mean, error) * _LOG_FLUX_RANGE) - alone)
    return total
