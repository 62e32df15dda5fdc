"""Maps on the sky of several searches, their sums, and how often noise exceeds a level.

Places are offsets from the star to the east and to the north, arcsec. Between the pixels of a
search, S/N is interpolated with splines: where the pixels are as large as in F356W, it
differs from the S/N of a template at the place by an rms of 0.13 or less.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.polynomial import hermite_e
from numpy.typing import ArrayLike, NDArray
from scipy import optimize
from scipy.ndimage import map_coordinates, spline_filter
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree
from scipy.special import gamma, logsumexp

from pyklip_diffrender.detection.field import (
    Image,
    pixel_width,
    pixels_of,
    separation_of,
)
from pyklip_diffrender.detection.search_result import Detection
from pyklip_diffrender.detection.tails import gaussian_sigmas, gaussian_tail, student_tail
from pyklip_diffrender.io.units import east_and_north
from pyklip_diffrender.scene.admission import EPOCH

_SPLINE_ORDER = 5
"""Order of the splines between pixels. S/N maps have no higher frequencies than images, whose
pixels are just small enough for them."""

LIGHT = 1.5
"""lambda/D from a source at which its light ends, and within which two peaks are one source."""

POSITION = 0.003
"""Error of positions of different reductions beyond the noise, arcsec: orientation, distortion, and
where the star is behind the mask."""


@dataclass(frozen=True, eq=False)
class MapSource:
    """A candidate of the search that made a map."""

    place: Image  # (2,), east and north of the star, arcsec.
    covariance: Image  # (2, 2), of the place, arcsec^2, with `POSITION`.
    snr: float
    sigmas: float  # The S/N in Gaussian standard deviations.
    error: float  # Error of the contrast, for a known image and a known flux of the star.
    flux: tuple[float, float]  # Contrast and its error, with all that is not known.


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
    sources: tuple[MapSource, ...] = ()

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
        return replace(plain, sources=tuple(plain._own(detection)))

    def _own(self, detection: Detection) -> Iterator[MapSource]:
        """Candidates of the search itself."""
        for row in detection.candidates:
            place = np.array([row["delta_ra"].value, row["delta_dec"].value])
            deviations = np.array([row["delta_ra_error"].value, row["delta_dec_error"].value])
            covariance = np.diag(deviations**2)
            covariance[0, 1] = covariance[1, 0] = (
                np.nan_to_num(row["radec_corr"]) * deviations[0] * deviations[1]
            )
            snr, contrast = float(row["snr"]), float(row["contrast"])
            error = abs(contrast / snr)
            yield MapSource(
                place,
                covariance + POSITION**2 * np.eye(2),
                snr,
                float(_gaussian(np.array(snr), self._freedom_at(place))),
                error,
                (contrast, max(float(row["contrast_error"]), error)),
            )

    @property
    def residual(self) -> SkyMap:
        """The maps without the light of the candidates."""
        return replace(self, snr=self.noise)

    def without(self, places: Sequence[Image]) -> SkyMap:
        """Maps without peaks at places (2,), which have the shape of the noise's correlation."""
        snr, sky = self.snr.copy(), self.on_sky(self.grid)
        # The image of a source in a map of S/N is the autocorrelation of its noise, and that is
        # exp(-d L d / 2) with the curvature L.
        for place in places:
            away = sky - place
            shape = np.exp(-np.einsum("...i,ij,...j", away, self.curvature, away) / 2)
            snr = snr - float(self.at(place)[0]) * shape
        return replace(self, snr=snr)

    def on_sky(self, offsets: Image) -> Image:
        """East and north of positions x, y from the star on the frame, (..., 2), arcsec."""
        return np.asarray(offsets @ self._turn.T)

    @cached_property
    def _turn(self) -> NDArray[np.float64]:
        """Matrix from x, y to east, north, which is its own inverse: a reflection."""
        return east_and_north(self.north)

    @cached_property
    def _splines(self) -> tuple[Image, ...]:
        """Coefficients of the S/N, and of the Gaussian standard deviations if they differ."""
        first = spline_filter(self.snr, order=_SPLINE_ORDER)
        if not np.isfinite(self.freedom).any():
            return (first,)
        return first, spline_filter(_gaussian(self.snr, self.freedom), order=_SPLINE_ORDER)

    def _freedom_at(self, place: Image) -> float:
        """Degrees of freedom in the pixel of a place, (2,)."""
        columns, rows = np.rint(pixels_of(self.grid, place @ self._turn)).astype(int)
        ny, nx = self.freedom.shape
        return float(self.freedom[np.clip(rows, 0, ny - 1), np.clip(columns, 0, nx - 1)])

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
        values = [
            np.where(
                known,
                map_coordinates(each, pixel, order=_SPLINE_ORDER, mode="mirror", prefilter=False),
                0.0,
            )
            for each in self._splines
        ]
        snr, sigmas = values[0], values[-1]
        error = np.where(known, np.where(known, information, 1.0) ** -0.5, np.inf)
        return snr.reshape(shape), sigmas.reshape(shape), error.reshape(shape)

    @cached_property
    def curvature(self) -> NDArray[np.float64]:
        """Covariance of the gradient of noise of standard deviation 1, (2, 2), per arcsec^2."""
        # It is the curvature of the autocorrelation, to the east and to the north. Slopes are
        #
        #     f' = (f(-2 h) - 8 f(-h) + 8 f(h) - f(2 h)) / 12 h,
        #
        # and their mean squares are divided by the mean square of the noise.
        spline = spline_filter(self.noise, order=_SPLINE_ORDER)
        used = np.isfinite(self.error) & (np.abs(self.noise) < 4)
        rows, columns = np.nonzero(used)
        step = 0.25

        def along(down: float, right: float) -> Image:
            values = [
                map_coordinates(
                    spline,
                    [rows + k * step * down, columns + k * step * right],
                    order=_SPLINE_ORDER,
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
    curvature: Image  # (filters, 2, 2), as in `SkyMap`.

    @classmethod
    def of(
        cls,
        maps: Sequence[SkyMap],
        filters: Sequence[str],
        scales: Mapping[str, float],
        places: Image,
        moves: Mapping[str, Image],
    ) -> SkyStack:
        """Add maps at places, (..., 2), each moved by its own offset (2,)."""
        values = {each.name: each.at(places + moves[each.name]) for each in maps}
        return cls.of_values(maps, filters, scales, values)

    @classmethod
    def of_values(
        cls,
        maps: Sequence[SkyMap],
        filters: Sequence[str],
        scales: Mapping[str, float],
        values: Mapping[str, tuple[ArrayLike, ArrayLike, ArrayLike]],
    ) -> SkyStack:
        """Add what maps say, as `SkyMap.at` does, (...) each, by the name of the map."""
        shape = (len(filters), *np.shape(next(iter(values.values()))[0]))
        information, snr, sigmas = np.zeros(shape), np.zeros(shape), np.zeros(shape)
        curvature = np.zeros((len(filters), 2, 2))
        for each in maps:
            # The mean flux with weights 1 / e^2 has the S/N sum(S/N_k / e_k) / sqrt(sum 1 / e_k^2).
            k = filters.index(each.filter)
            own_snr, own_sigmas, error = (np.asarray(value) for value in values[each.name])
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


def _gaussian(snr: Image, freedom: ArrayLike) -> Image:
    """Gaussian standard deviations that are as rare as an S/N, which follows Student's t."""
    height, freedom = np.abs(snr), np.asarray(freedom, dtype=float)
    with np.errstate(divide="ignore"):
        exact = gaussian_sigmas(student_tail(height, freedom))
    # Beyond the smallest numbers, within 0.01: D. L. Wallace, Annals of Mathematical Statistics 30,
    # 1121 (1959).
    few = np.where(np.isfinite(freedom), freedom, 1.0)
    rare = (8 * few + 1) / (8 * few + 3) * np.sqrt(few * np.log1p(height**2 / few))
    rare = np.where(np.isfinite(freedom), rare, height)
    return np.asarray(np.copysign(np.where(np.isfinite(exact), exact, rare), snr))


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


_FINEST, _COARSEST = 33, 201
"""Smallest and largest number of places on a side of the square over which a likelihood is
integrated."""


def ln_likelihood_ratio(
    maps: Sequence[SkyMap],
    place: Image,
    covariance: Image,
    fluxes: Mapping[str, tuple[float, float]],
    resolution: float,
) -> float:
    """Logarithm of the likelihood of maps with a source, over the likelihood without it.

    The source is at a place (2,) with a covariance (2, 2), arcsec^2, and `fluxes` are its contrast
    and the error by filter; filters in which they are not known say nothing. `resolution` is
    lambda/D, arcsec. Outside the field both likelihoods are one.
    """
    # A map with the S/N z and the error e of the contrast has, with a source of the flux F, the
    # likelihood exp(a F - b F^2 / 2) relative to none, a = z / e, b = 1 / e^2. With F = f +- s,
    #
    #     log integral = (2 a f + a^2 s^2 - b f^2) / (2 (1 + b s^2)) - log(1 + b s^2) / 2,
    #
    # and its exponential is averaged over the places.
    shown = [each for each in maps if each.filter in fluxes]
    if not shown:
        return 0.0
    squares, axes = np.linalg.eigh(covariance)
    deviations = np.sqrt(np.maximum(squares, 0))
    side = np.clip(math.ceil(8 * deviations.max() / (resolution / 6)), _FINEST, _COARSEST)
    steps = np.linspace(-4, 4, int(side))
    standard = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    places = place + (standard * deviations) @ axes.T
    weights = np.exp(-(standard**2).sum(axis=1) / 2)
    logs = np.zeros(len(places))
    for name in dict.fromkeys(each.filter for each in shown):
        flux, error = fluxes[name]
        a, b = np.zeros(len(places)), np.zeros(len(places))
        for each in shown:
            if each.filter == name:
                snr, _, own = each.at(places)
                a += snr / own
                b += own**-2.0
        spread = 1 + b * error**2
        logs += (2 * a * flux + (a * error) ** 2 - b * flux**2) / (2 * spread) - np.log(spread) / 2
    return float(logsumexp(logs, b=weights / weights.sum()))


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

    The stack (filters, n) is at the pixels of the field, and `area` is the area of a pixel, or of
    each (n,), arcsec^2, times the number of maps of noise that are searched there.
    """

    def __init__(self, spectra: Image | None, stack: SkyStack, area: float | Image) -> None:
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

    def best(self, stack: SkyStack) -> int:
        """The number of the most significant spectrum at a place; 0 for free fluxes."""
        if self.spectra is None:
            return 0
        return int(np.argmax(stack.weights(self.spectra) @ stack.sigmas))

    def snr(self, stack: SkyStack, number: int) -> float:
        """S/N of a spectrum, or of free fluxes, at a place."""
        if self.spectra is None:
            return float(np.sqrt((np.maximum(stack.snr, 0) ** 2).sum()))
        return float(stack.weights(self.spectra[[number]])[0] @ stack.snr)

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
        # the densities of the Euler characteristic. Curvatures of the field are its area, half its
        # perimeter, as if it were a square, and 1; for field times arc, these times the angle.
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
        return float(gaussian_tail(level))
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
