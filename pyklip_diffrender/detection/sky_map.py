"""Maps on the sky of several searches: what epochs say of a source, and how often noise does.

Places are offsets from the star to the east and to the north, arcsec. Between the pixels of a
search, S/N is interpolated with splines: where the pixels are as large as those of F356W, it
differs from that of a template at the place by an rms of 0.13 or less.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from astropy.coordinates import get_body_barycentric
from astropy.time import Time
from numpy.polynomial import hermite_e
from numpy.typing import ArrayLike, NDArray
from scipy import optimize, stats
from scipy.ndimage import map_coordinates, spline_filter
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree
from scipy.special import gamma, logsumexp

from pyklip_diffrender.detection.field import (
    Image,
    Positions,
    pixel_width,
    pixels_of,
    separation_of,
)
from pyklip_diffrender.detection.search_result import Detection
from pyklip_diffrender.scene.admission import EPOCH

__all__ = [
    "LIGHT",
    "POSITION",
    "YEAR",
    "Family",
    "Hypotheses",
    "Motion",
    "SkyMap",
    "SkyStack",
    "common_grid",
    "date_of",
    "epochs_of",
    "hypotheses",
    "level_of",
    "maximum",
    "signal",
]


_ORDER = 5
"""Of the splines between pixels. S/N maps have no higher frequencies than images, whose pixels are
just small enough for them."""

LIGHT = 1.5
"""lambda/D from a source at which its light ends, and within which two peaks are one source."""


@dataclass(frozen=True, eq=False)
class SkyMap:
    """Maps of the flux of a point source at every place, and its error, from one reduction."""

    name: str
    filter: str
    mjd: float | None  # Epoch.
    north: float  # Position angle of the frame's +y axis, degrees east of north.
    grid: Image  # (ny, nx, 2), x, y of the pixels from the star on the frame, arcsec.
    snr: Image  # (ny, nx), contrast over its error; 0 where nothing is known.
    error: Image  # (ny, nx), standard deviation of the contrast; inf where nothing is known.
    noise: Image  # (ny, nx), the S/N without the candidates of this reduction.
    freedom: Image  # (ny, nx), degrees of freedom of Student's t, which the S/N of noise follows.
    resolution: float  # lambda/D, arcsec.
    star: float | None = None  # Flux density of the star, Jy.
    threshold: float = 5.0  # S/N of a candidate of the single search.
    # Whether it is of real frames of one roll, where structures of the detector pass for sources.
    single_roll: bool = False
    # (k, 4), east and north of the reduction's own candidates; what is to be added to the contrast
    # of the map there, and by what its error is to be multiplied, so that they are those of all
    # candidates fitted together.
    fitted: Image = field(default_factory=lambda: np.zeros((0, 4)))

    @classmethod
    def of(cls, detection: Detection, name: str) -> SkyMap:
        """Maps of a search, with the light of its own candidates only within 1.5 lambda/D of them.

        Farther away their side lobes would pass for sources.
        """
        factor, grid = detection.error_factor, detection.grid
        shape = grid.shape[:2]
        known = np.isfinite(detection.error) & (detection.error > 0)
        known &= np.isfinite(detection.snr)
        noise = np.where(known, np.nan_to_num(detection.residual_snr), 0.0)
        snr = np.where(known, np.nan_to_num(detection.snr), 0.0)
        resolution = float(detection.contrast_curve.meta["resolution_arcsec"])
        offsets = detection.sources.offsets.numpy()
        share = np.zeros(shape)
        for offset in offsets:
            # A smooth edge, because splines ring at sharp ones.
            steps = np.clip(2 * (LIGHT - separation_of(grid - offset) / resolution), 0, 1)
            share = np.maximum(share, (1 - np.cos(np.pi * steps)) / 2)
        plain = cls(
            name=name,
            filter=detection.observation.filter or "unknown",
            mjd=detection.sky.mjd,
            north=detection.sky.north or 0.0,
            grid=grid,
            snr=noise + share * (snr - noise),
            error=np.where(known, detection.error, np.inf),
            noise=noise,
            freedom=np.broadcast_to(factor.freedom, shape),
            resolution=resolution,
            star=detection.sky.star_jansky,
            threshold=detection.threshold,
            single_roll=detection.rolls == 1 and detection.observation.is_nircam,
        )
        places = plain.on_sky(offsets)
        snr_there, _, error_there = plain.at(places)
        own = detection.sources.detection_errors.numpy() * factor.of(offsets)
        inside = np.isfinite(error_there)
        error = np.where(inside, error_there, 1.0)
        missing = detection.sources.contrasts.numpy() - snr_there * error
        fitted = np.column_stack([places, missing, own / error])[inside]
        return replace(plain, fitted=fitted)

    def on_sky(self, offsets: Image) -> Image:
        """East and north of positions x, y from the star on the frame, (..., 2), arcsec."""
        return np.asarray(offsets @ self._turn.T)

    @cached_property
    def _turn(self) -> NDArray[np.float64]:
        """Matrix from x, y to east, north, which is its own inverse: a reflection."""
        return Positions(np.zeros((0, 2)), np.zeros((0, 2, 2)), self.north)._to_sky

    @cached_property
    def _splines(self) -> tuple[Image, Image]:
        """Coefficients of the S/N, and of the Gaussian standard deviations that are as rare."""
        sigmas = self.snr
        if np.isfinite(self.freedom).any():
            tail = stats.t.sf(np.abs(self.snr), self.freedom)
            # Beyond the smallest numbers Student's t does not differ from a Gaussian.
            equivalent = np.where(tail > 0, stats.norm.isf(tail), np.abs(self.snr))
            sigmas = np.copysign(equivalent, self.snr)
        first = spline_filter(self.snr, order=_ORDER)
        return first, first if sigmas is self.snr else spline_filter(sigmas, order=_ORDER)

    @cached_property
    def _information(self) -> Image:
        return np.where(np.isfinite(self.error), self.error, np.inf) ** -2.0

    def at(self, places: Image) -> tuple[Image, Image, Image]:
        """S/N, the same in Gaussian standard deviations, and error of the contrast at places.

        `places` (..., 2) are east and north of the star, arcsec; results are 0, 0 and inf outside.
        """
        shape = places.shape[:-1]
        columns, rows = pixels_of(self.grid, places.reshape(-1, 2) @ self._turn).T
        ny, nx = self.snr.shape
        edge = 1e-6
        inside = (rows >= -edge) & (rows <= ny - 1 + edge)
        inside &= (columns >= -edge) & (columns <= nx - 1 + edge)
        pixel = [rows, columns]
        information = map_coordinates(self._information, pixel, order=1, mode="nearest")
        known = inside & (information > 0)
        snr, sigmas = (
            np.where(
                known,
                map_coordinates(each, pixel, order=_ORDER, mode="mirror", prefilter=False),
                0.0,
            )
            for each in self._splines
        )
        error = np.where(known, np.where(known, information, 1.0) ** -0.5, np.inf)
        return snr.reshape(shape), sigmas.reshape(shape), error.reshape(shape)

    def fitted_at(self, place: Image) -> tuple[float, float, float]:
        """As `at`, at one place, (2,), with what a fit of the reduction's own candidate adds."""
        snr, sigmas, error = (float(each) for each in self.at(place))
        away = np.hypot(*(self.fitted[:, :2] - place).T)
        if not len(away) or away.min() > self.resolution / 2 or not math.isfinite(error):
            return snr, sigmas, error
        _, _, missing, ratio = self.fitted[int(np.argmin(away))]
        return (snr * error + float(missing)) / (error * float(ratio)), sigmas, error * float(ratio)

    @cached_property
    def curvature(self) -> NDArray[np.float64]:
        """Covariance of the gradient of noise of standard deviation 1, (2, 2), per arcsec^2."""
        # That is the curvature of the autocorrelation, to the east and to the north. Slopes are
        #
        #     f' = (f(-2 h) - 8 f(-h) + 8 f(h) - f(2 h)) / 12 h,
        #
        # and their mean squares are divided by that of the noise.
        spline = spline_filter(self.noise, order=_ORDER)
        used = np.isfinite(self.error) & (np.abs(self.noise) < 4)
        rows, columns = np.nonzero(used)
        step = 0.25

        def along(down: float, right: float) -> Image:
            values = [
                map_coordinates(
                    spline,
                    [rows + k * step * down, columns + k * step * right],
                    order=_ORDER,
                    mode="mirror",
                    prefilter=False,
                )
                for k in (-2, -1, 1, 2)
            ]
            change = values[0] - 8 * values[1] + 8 * values[2] - values[3]
            return np.asarray(change / (12 * step))

        slopes = np.stack([along(0, 1), along(1, 0)])
        per_pixel = slopes @ slopes.T / max(float((self.noise[used] ** 2).sum()), 1e-300)
        steps = np.stack([self.grid[0, 1] - self.grid[0, 0], self.grid[1, 0] - self.grid[0, 0]])
        inverse = np.linalg.inv(steps)
        return np.asarray(self._turn @ inverse @ per_pixel @ inverse.T @ self._turn.T)


@dataclass(frozen=True, eq=False)
class SkyStack:
    """Flux densities of several reductions at the same places, added by filter."""

    # As `SkyMap.at`, (filters, ...) each, of the flux in units of `scales`.
    snr: Image
    sigmas: Image
    error: Image
    curvature: Image  # (filters, 2, 2), as that of `SkyMap`.

    @classmethod
    def of(
        cls,
        maps: Sequence[SkyMap],
        filters: Sequence[str],
        scales: Mapping[str, float],
        places: Image,
        moves: Mapping[str, Image],
        *,
        fitted: bool = False,
    ) -> SkyStack:
        """Add maps at places, (..., 2), each moved by its own offset (2,).

        With `fitted`, at one place, what fits of candidates say is used, see `SkyMap.fitted_at`.
        """
        shape = (len(filters), *places.shape[:-1])
        information, snr, sigmas = np.zeros(shape), np.zeros(shape), np.zeros(shape)
        curvature = np.zeros((len(filters), 2, 2))
        for each in maps:
            # The mean flux with weights 1 / e^2 has the S/N sum(S/N_k / e_k) / sqrt(sum 1 / e_k^2).
            k = filters.index(each.filter)
            moved = places + moves[each.name]
            own_snr, own_sigmas, error = each.fitted_at(moved) if fitted else each.at(moved)
            root = 1 / (error * scales[each.name])
            information[k] += root**2
            snr[k] += root * own_snr
            sigmas[k] += root * own_sigmas
            curvature[k] += each.curvature / sum(other.filter == each.filter for other in maps)
        known = information > 0
        size = np.sqrt(np.where(known, information, 1.0))
        return cls(snr / size, sigmas / size, np.where(known, 1 / size, np.inf), curvature)

    def __getitem__(self, used: NDArray[np.bool_]) -> SkyStack:
        """The pixels that a mask selects, as one axis."""
        return replace(
            self, snr=self.snr[:, used], sigmas=self.sigmas[:, used], error=self.error[:, used]
        )

    @property
    def flux(self) -> Image:
        """Flux in every filter; 0 where it is not known."""
        return np.asarray(self.snr * np.where(np.isfinite(self.error), self.error, 0.0))

    def weights(self, spectra: Image) -> Image:
        """Directions of spectra (k, filters) in units of the errors, (k, filters, ...)."""
        extra = (1,) * (self.error.ndim - 1)
        raw = spectra.reshape(*spectra.shape, *extra) / self.error
        size = np.sqrt((raw**2).sum(axis=1, keepdims=True))
        return np.asarray(np.divide(raw, size, out=np.zeros_like(raw), where=size > 0))

    def amplitude_errors(self, spectra: Image) -> Image:
        """Standard deviations of the amplitudes of spectra, (k, ...)."""
        extra = (1,) * (self.error.ndim - 1)
        raw = spectra.reshape(*spectra.shape, *extra) / self.error
        information = (raw**2).sum(axis=1)
        return np.where(information > 0, information, np.nan) ** -0.5


def date_of(epoch: Sequence[SkyMap]) -> float:
    """Mean date of maps, MJD."""
    return float(np.mean([each.mjd for each in epoch]))


def epochs_of(maps: Sequence[SkyMap]) -> list[list[SkyMap]]:
    """Maps by epoch, in order of time."""
    epochs: list[list[SkyMap]] = []
    for each in sorted(maps, key=lambda m: m.mjd or 0.0):
        if epochs and (each.mjd or 0.0) - (epochs[-1][0].mjd or 0.0) <= EPOCH:
            epochs[-1].append(each)
        else:
            epochs.append([each])
    return epochs


def common_grid(maps: Sequence[SkyMap]) -> Image:
    """East and north of pixels as small as the smallest, over all fields, (n, n, 2)."""
    pixel = min(pixel_width(each.grid) for each in maps)
    reach = max(float(np.abs(each.on_sky(each.grid)).max()) for each in maps)
    count = math.ceil(reach / pixel)
    axis = pixel * np.arange(-count, count + 1)
    # The first axis goes north; east is to the left.
    return np.stack(np.meshgrid(axis[::-1], axis), axis=-1)


# What several epochs say of a source: it moves with the star, stays on the sky, or neither.

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
    """How places of sources move between epochs."""

    proper: tuple[float, float]  # Proper motion of the star to the east and north, arcsec per year.
    parallax: float = 0.0  # arcsec; 0 if it is not known.
    # Right ascension and declination of the star, degrees.
    coordinates: tuple[float, float] | None = None
    mass: float = 1.0  # Of the star, in solar masses.

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
    """Probabilities of three hypotheses about a source, given its places at several epochs.

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

    `maps` are of two epochs or more; `flux` has the contrast of the source by the name of the map,
    up to a common factor, and `place` (2,) east and north of the star at the epoch `reference`,
    MJD, arcsec.
    """
    place = np.asarray(place, dtype=float)
    # The likelihood of the data is integrated over the flux F, which is the same at all epochs,
    # over the place at the reference epoch, and over the places at the others that a hypothesis
    # allows. At a place, with numerator a and information b of the amplitude of the spectrum, it is
    # exp(F a - F^2 b / 2) times that without a source. A peak of S/N s in noise with the curvature
    # L is known to 1 / (s sqrt(L)) in each direction.
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
    """Logarithm of the likelihood of an epoch, averaged over places, (levels, places)."""
    # Importance sampling: with samples from a density q, the average of the likelihood over the
    # density p of places is the mean of likelihood p / q. Half of the samples are about the
    # expected place, half about the highest peak within its reach, and q is the mean of both
    # densities.
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
    """Place, (2,), and value of the nearest maximum of a function; the first step is in arcsec."""
    simplex = start + step * np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    result = optimize.minimize(
        lambda place: -height(place),
        start,
        method="Nelder-Mead",
        options={"initial_simplex": simplex, "xatol": 1e-5, "fatol": 1e-5},
    )
    return np.asarray(result.x), -float(result.fun)


# How often noise exceeds a level in a search over positions and spectra.
#
# A spectrum is a point on the unit sphere whose axes are the filters, in units of their errors. The
# number of maxima of noise over positions and spectra follows from the area and the edge of the
# field, and from the length and the area of the set of spectra on the sphere: R. J. Adler and J. E.
# Taylor, "Random Fields and Geometry" (2007), chapters 12 and 15. For spectra that are far apart,
# the sum of their trials is less, and is used instead.


class Family:
    """Spectra (k, filters) that are searched together; None for any without negative fluxes.

    The stack (filters, n) is at the pixels of the field, and `area` that of one, arcsec^2.
    """

    def __init__(self, spectra: Image | None, stack: SkyStack, area: float) -> None:
        self.spectra = spectra
        root = area * np.ones(stack.error.shape[1])
        if spectra is None:
            present = np.isfinite(stack.error)
            self._count = present.sum(axis=0)
            share = present / np.maximum(self._count, 1)
            self._areas = root * _size(share, stack.curvature)
            return
        weights = stack.weights(spectra)
        self._areas = root * np.stack([_size(each**2, stack.curvature) for each in weights])
        cosines = np.einsum("afn,bfn->abn", weights, weights)
        angles = np.arccos(np.clip(cosines, -1, 1))
        covered = np.isfinite(stack.error).any(axis=0)
        mean = angles[..., covered].mean(axis=-1) if covered.any() else angles.mean(axis=-1)
        # Equal spectra are no edges of a sparse graph, but have to be in the tree.
        tree = minimum_spanning_tree(mean + 1e-9)
        _, before = breadth_first_order(tree, 0, directed=False)
        self._edges = [(int(p), k, angles[p, k]) for k, p in enumerate(before) if p >= 0]

    def statistic(self, stack: SkyStack) -> Image:
        """Highest S/N of the family at every place of a stack, in Gaussian deviations, (...)."""
        if self.spectra is None:
            return np.asarray(np.sqrt((np.maximum(stack.sigmas, 0) ** 2).sum(axis=0)))
        weights = stack.weights(self.spectra)
        return np.asarray(np.einsum("kf...,f...->k...", weights, stack.sigmas).max(axis=0))

    def expected(self, level: float) -> float:
        """Upper bound of the expected number of maxima of noise above a level."""
        if self.spectra is None:
            total = 0.0
            for count in np.unique(self._count[self._count > 0]):
                area = self._areas[self._count == count].sum()
                share = float(np.mean(self._count == count))
                for d, size in enumerate(_orthant(int(count))):
                    edge = 2 * math.sqrt(area)
                    total += size * (
                        area * _density(d + 2, level)
                        + edge * _density(d + 1, level)
                        + share * _density(d, level)
                    )
            return total
        # The expected number is a sum over dimensions of the curvatures of the searched set times
        # the densities of the Euler characteristic. Those of the field are its area, half its
        # perimeter, as if it were a square, and 1; those of field times arc are their products with
        # the angle.
        zero, one, two, three = (_density(d, level) for d in range(4))
        area = self._areas[0].sum()
        total = area * two + 2 * math.sqrt(area) * one + zero
        for parent, child, angle in self._edges:
            both = (self._areas[parent] + self._areas[child]) / 2
            mean, edge = float(angle.mean()), 2 * math.sqrt(both.sum())
            # A spectrum adds what the arc to its neighbour adds, and no more than if it were alone.
            total += float(np.minimum(both * angle * three, self._areas[child] * two).sum())
            total += min(edge * mean * two, edge * one) + min(mean * one, zero)
        return float(total)


def _size(shares: Image, curvature: Image) -> Image:
    """Square root of the determinant of curvatures (filters, 2, 2) averaged with shares (f, n)."""
    mean = np.einsum("fn,fij->nij", shares, curvature)
    return np.sqrt(np.maximum(np.linalg.det(mean), 0))


def _density(dimension: int, level: float) -> float:
    """Density of the Euler characteristic of a Gaussian field above a level."""
    if dimension == 0:
        return float(stats.norm.sf(level))
    polynomial = hermite_e.hermeval(level, [0] * (dimension - 1) + [1])
    return float(polynomial * math.exp(-(level**2) / 2) / (2 * math.pi) ** ((dimension + 1) / 2))


def _orthant(count: int) -> NDArray[np.float64]:
    """Lipschitz-Killing curvatures of the sphere's part without negative coordinates, (count,)."""
    # The length of a vector of noise without its negative coordinates is chi of k degrees of
    # freedom with the probability C(count, k) / 2^count, and chi is the maximum over a whole
    # sphere.
    total = np.zeros(count)
    for k in range(1, count + 1):
        for d in range(k - 1, -1, -2):
            total[d] += math.comb(count, k) / 2**count * 2 * _lower(k - 1, d)
    return total


def _lower(dimension: int, d: int) -> float:
    """Half a Lipschitz-Killing curvature of the unit sphere of some dimension."""

    def surface(n: int) -> float:
        return float(2 * math.pi ** (n / 2) / gamma(n / 2))

    return math.comb(dimension, d) * surface(dimension + 1) / surface(dimension + 1 - d)


def level_of(families: Sequence[Family], alarms: float) -> float:
    """Level above which noise has so many maxima in searches of several fields."""

    def excess(level: float) -> float:
        return math.log(sum(each.expected(level) for each in families)) - math.log(alarms)

    return float(optimize.brentq(excess, 1.5, 30, xtol=1e-4))
