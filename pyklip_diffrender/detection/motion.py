"""What several epochs say of a source: it moves with the star, stays on the sky, or neither."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from astropy.coordinates import get_body_barycentric
from astropy.time import Time
from numpy.typing import ArrayLike, NDArray
from scipy import optimize
from scipy.special import logsumexp

from pyklip_diffrender.detection.field import Image, separation_of
from pyklip_diffrender.detection.sky_map import SkyMap, date_of, epochs_of

__all__ = ["POSITION", "YEAR", "Hypotheses", "Motion", "hypotheses", "maximum", "signal"]

POSITION = 0.003
"""Error of positions of different reductions beyond that of the noise, arcsec: orientation,
distortion, and where the star is behind the mask."""

_WANDER = 0.003
"""Standard deviation of a background source's own proper motion, arcsec per year: that of stars
at a few kpc. Galaxies have none."""

YEAR = 365.25
"""Days."""

_L2 = 1.01
"""Distance of the telescope from the Sun over that of the Earth."""

_CLEAR = 0.99
"""Probability of a hypothesis from which it is stated as the verdict."""

_SAMPLES = 600
"""Number of places about the expected one, and about the highest peak within its reach."""


@dataclass(frozen=True)
class Motion:
    """How places of sources move between epochs.

    Attributes
    ----------
    proper : (float, float)
        Proper motion of the star to the east and north, arcsec per year.
    parallax : float
        arcsec; 0 if it is not known.
    coordinates : (float, float) or None
        Right ascension and declination of the star, degrees.
    mass : float
        Of the star, in solar masses.
    """

    proper: tuple[float, float]
    parallax: float = 0.0
    coordinates: tuple[float, float] | None = None
    mass: float = 1.0

    def background(self, before: float, after: float) -> NDArray[np.float64]:
        """How far a source at infinity moves from the star between two dates (MJD), (2,), arcsec.

        It is opposite to the star's proper motion and parallax.
        """
        moved = np.array(self.proper) * (after - before) / YEAR
        if self.parallax > 0 and self.coordinates is not None:
            moved = moved + self.parallax * (self._factors(after) - self._factors(before))
        return -moved

    def _factors(self, mjd: float) -> NDArray[np.float64]:
        """Parallax factors to the east and north, (2,)."""
        earth = get_body_barycentric("earth", Time(mjd, format="mjd")).xyz.to_value("AU") * _L2
        ra, dec = np.deg2rad(self.coordinates or (0.0, 0.0))
        east = np.array([np.sin(ra), -np.cos(ra), 0.0])
        north = np.array([np.cos(ra) * np.sin(dec), np.sin(ra) * np.sin(dec), -np.cos(dec)])
        return np.array([east @ earth, north @ earth])

    def orbital(self, separation: ArrayLike) -> NDArray[np.float64]:
        """Speed of a circular orbit at projected separations, arcsec per year; 0 if not known.

        A bound companion moves by at most the square root of two times that.
        """
        distance = np.maximum(np.asarray(separation, dtype=float), 1e-3)
        if self.parallax <= 0:
            return np.zeros_like(distance)
        au = distance / self.parallax
        return np.asarray(2 * math.pi * np.sqrt(self.mass / au) * self.parallax)


@dataclass(frozen=True)
class Hypotheses:
    """What is said of a source by the epochs.

    Attributes
    ----------
    bound, background, neither : float
        Probabilities, if all three were equally probable before. A bound source moves by no more
        than an orbit allows; one in the background stays on the sky; the third is of a source that
        does neither, or is seen at one epoch only.
    ln_ratio : float
        Logarithm of the evidence of the first over that of the second.
    """

    bound: float
    background: float
    neither: float
    ln_ratio: float

    @property
    def verdict(self) -> str:
        """The hypothesis with a probability of 99 % or more, in words."""
        if self.bound >= _CLEAR:
            return "moves with the star"
        if self.background >= _CLEAR:
            return "stays on the sky: a source in the background"
        if self.neither >= _CLEAR:
            return "neither moves with the star nor stays on the sky"
        return "not decided"


def hypotheses(
    maps: Sequence[SkyMap],
    flux: Mapping[str, float],
    place: ArrayLike,
    reference: float,
    motion: Motion,
    *,
    seed: int = 0,
) -> Hypotheses:
    """Compare three hypotheses on the motion of a source, with its flux marginalised.

    The likelihood of the data is integrated over the flux, which is the same at all epochs, over
    the place at the reference epoch, and over the places at the others that a hypothesis allows.

    Parameters
    ----------
    maps : sequence of SkyMap
        Of two epochs or more.
    flux : mapping of str to float
        Contrast of the source by the name of the map, up to a common factor: its spectrum.
    place : (2,)
        East and north of the star at the reference epoch, arcsec.
    reference : float
        That epoch, MJD.
    motion : Motion
    seed : int
        Of the places at which the integrals are evaluated.

    Returns
    -------
    Hypotheses
    """
    place = np.asarray(place, dtype=float)
    epochs = epochs_of(maps)
    nearest = min(epochs, key=lambda each: abs(date_of(each) - reference))
    own, others = nearest, [each for each in epochs if each is not nearest]
    here_a, here_b = _evidence_terms(own, flux, place)
    snr = max(float(here_a / np.sqrt(here_b)) if here_b > 0 else 0.0, 1.0)
    curvature = float(np.mean([np.trace(each.curvature) / 2 for each in own]))
    width = 1 / (snr * math.sqrt(curvature))
    steps = width * np.linspace(-4, 4, 17)
    places = place + np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    a, b = _evidence_terms(own, flux, places)
    highest = (snr + 6) / max(float(here_b), 1e-300) ** 0.5
    levels = highest * (np.arange(120) + 0.5) / 120
    # (levels, places); the flux prior is the same for all hypotheses.
    first = levels[:, None] * a - levels[:, None] ** 2 * b / 2
    logs = {"bound": first, "background": first, "neither": first}
    rng = np.random.default_rng(seed)
    for epoch in others:
        date = date_of(epoch)
        years = abs(date - date_of(own)) / YEAR
        orbital = float(motion.orbital(np.hypot(*place))) / math.sqrt(2)
        spreads = {
            "bound": (np.zeros(2), math.hypot(orbital * years, math.sqrt(2) * POSITION)),
            "background": (
                motion.background(date_of(own), date),
                math.hypot(_WANDER * years, math.sqrt(2) * POSITION),
            ),
        }
        for name, (moved, spread) in spreads.items():
            logs[name] = logs[name] + _at_other_epoch(
                epoch, flux, levels, places, place + moved, moved, spread, width, rng
            )
        logs["neither"] = logs["neither"] + _anywhere(epoch, flux, levels)[:, None]
    evidence = {name: float(logsumexp(each)) for name, each in logs.items()}
    norm = float(logsumexp(list(evidence.values())))
    probabilities = {name: math.exp(each - norm) for name, each in evidence.items()}
    return Hypotheses(**probabilities, ln_ratio=evidence["bound"] - evidence["background"])


def _at_other_epoch(
    epoch: Sequence[SkyMap],
    flux: Mapping[str, float],
    levels: Image,
    places: Image,
    centre: Image,
    moved: Image,
    spread: float,
    width: float,
    rng: np.random.Generator,
) -> Image:
    """Logarithm of the likelihood of an epoch, averaged over the places that are allowed there.

    Importance sampling: half of the samples are about the expected place, half about the highest
    peak within its reach.

    Returns
    -------
    ndarray, (levels, places)
    """
    wide = math.hypot(spread, width)
    samples = centre + wide * rng.normal(size=(_SAMPLES, 2))
    a, b = _evidence_terms(epoch, flux, samples)
    snr = np.divide(a, np.sqrt(b), out=np.zeros_like(a), where=b > 0)
    near = separation_of(samples - centre) < 3.5 * wide
    peak = samples[int(np.argmax(np.where(near, snr, -np.inf)))]
    peak, height = maximum(lambda place: signal(epoch, flux, place), peak, width)
    height = max(height, 1.0)
    curvature = float(np.mean([np.trace(each.curvature) / 2 for each in epoch]))
    narrow = 1.2 / (height * math.sqrt(curvature))
    samples = np.concatenate([samples, peak + narrow * rng.normal(size=(_SAMPLES, 2))])
    a, b = _evidence_terms(epoch, flux, samples)
    log_density = np.logaddexp(
        _log_normal(samples - centre, wide), _log_normal(samples - peak, narrow)
    ) - math.log(2)
    light = levels[:, None] * a - levels[:, None] ** 2 * b / 2
    prior = _log_normal(places[:, None] + moved - samples, spread) - log_density
    # exp of a sum, by a product of matrices that are scaled to their largest element.
    top, most = light.max(axis=1, keepdims=True), prior.max(axis=1, keepdims=True)
    mean = np.exp(light - top) @ np.exp(prior - most).T / len(samples)
    return np.asarray(np.log(np.maximum(mean, 1e-300)) + top + most.T)


def _log_normal(away: Image, deviation: float) -> Image:
    square = (away**2).sum(axis=-1) / deviation**2
    return np.asarray(-square / 2 - math.log(2 * math.pi * deviation**2))


def _anywhere(epoch: Sequence[SkyMap], flux: Mapping[str, float], levels: Image) -> Image:
    """Logarithm of the likelihood of an epoch where the source is absent, or at any place, (l,).

    Either has the probability one half.
    """
    grid = epoch[0].on_sky(epoch[0].grid)
    a, b = _evidence_terms(epoch, flux, grid[::2, ::2].reshape(-1, 2))
    light = levels[:, None] * a - levels[:, None] ** 2 * b / 2
    return np.asarray(np.logaddexp(0.0, logsumexp(light, axis=1) - math.log(len(a))) - math.log(2))


def _evidence_terms(
    epoch: Sequence[SkyMap], flux: Mapping[str, float], places: Image
) -> tuple[Image, Image]:
    """Numerator and information of the amplitude of a spectrum at places, (...) each."""
    a, b = np.zeros(places.shape[:-1]), np.zeros(places.shape[:-1])
    for each in epoch:
        snr, _, error = each.at(places)
        a += flux[each.name] * snr / error
        b += (flux[each.name] / error) ** 2
    return a, b


def signal(epoch: Sequence[SkyMap], flux: Mapping[str, float], place: Image) -> float:
    """S/N of a source with fluxes by the name of the map, at a place, (2,)."""
    a, b = _evidence_terms(epoch, flux, place)
    return float(a / np.sqrt(b)) if b > 0 else 0.0


def maximum(height: Callable[[Image], float], start: Image, step: float) -> tuple[Image, float]:
    """Place, (2,), and value of the nearest maximum of a function of the place.

    Parameters
    ----------
    height : callable
    start : ndarray, (2,)
    step : float
        First step, arcsec.
    """
    simplex = start + step * np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    result = optimize.minimize(
        lambda place: -height(place),
        start,
        method="Nelder-Mead",
        options={"initial_simplex": simplex, "xatol": 1e-5, "fatol": 1e-5},
    )
    return np.asarray(result.x), -float(result.fun)
