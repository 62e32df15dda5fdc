"""Errors of a search: their factor, the significance of peaks, and the contrast curve.

Where the model does not explain its data to the noise, the S/N of a map scatters by more than 1.
The scatter grows with the star's light in the pixels of a planet, and what is left depends on the
separation. Both are fitted to the map itself,

    f^2 = (A + B q / 50) exp(g(log r)),

where q is the star's light over the noise, weighted with the image of the planet, and g a Gaussian
process. The fit also says how well f is known at each position: noise in units of the multiplied
errors follows Student's t, and the threshold of a search has to be higher.

In a single roll, compact structures of the detector pattern pass for planets. The S/N that they
have as planets, with errors that are not multiplied, is added to f in quadrature.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from astropy import units as u
from astropy.table import QTable
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import binary_dilation, convolve, map_coordinates, maximum_filter
from scipy.special import chdtri
from torch import Tensor

from pyklip_diffrender.detection.field import (
    Image,
    far_from,
    pixel_width,
    pixels_of,
    reaching,
    separation_of,
)
from pyklip_diffrender.detection.tails import (
    gaussian_sigmas,
    gaussian_tail,
    student_snr,
    student_tail,
)
from pyklip_diffrender.io.tables import add_columns
from pyklip_diffrender.refinement.residual import local_maxima

_SOURCE_RADIUS_ELEMENTS = 1.5
"""Resolution elements about a source whose S/N is not used: about the size of its image."""

_PIVOT_STAR_SNR = 50.0
"""Star over noise at which the two terms of the starlight are compared."""

_KNOTS = 8
"""Number of separations at which the Gaussian process g is represented, evenly in log r."""

_LENGTH_LOG_R = 1.0
"""Correlation length of g in log r: separations that differ by less than a factor of e share it."""

_SPREAD = 0.5
"""Prior standard deviation of g and of log A: f departs by a quarter from the law of starlight."""

_STARLIGHT = -1.0
_STARLIGHT_SPREAD = 1.0
"""Prior mean and standard deviation of log B: the term of the starlight matters where the star is
a hundred times the noise, and may be absent."""

CLIP = 4.0
"""Standard deviations at which S/N is clipped, so that sources that are not yet candidates do not
raise the threshold of others."""

_FITTED_PIXEL_STEP = 2
"""Distance between the rows, and the columns, of pixels to which the factor is fitted."""

_MEDIAN_SQUARE = float(chdtri(1, 0.5))
"""Median of the square of Gaussian noise."""

_FIT_STEPS = 30
"""Largest number of steps of the fit."""

_SETTLED_CHANGE = 1e-4
"""The fit ends when no parameter changes by more than this."""

_POSITIONS_PER_CIRCLE = 72
"""Positions per circle; the factor at a separation is their median."""


_STRUCTURES = 0.3
_STRUCTURES_ABOVE = 4.0
_STRUCTURES_FALL = 1.4
"""Peaks above an S/N of 4 that structures of the detector make in a single roll, and the decrease
of the S/N in which they become fewer by a factor of e. Eight rolls of G 7-34 and HIP 17695
(programme 1184), each reduced alone with a library without its star, have 4 peaks of either sign
above 4, two above 4.5 and none above 5, where noise at 1300 independent positions has 0.7, 0.07 and
0.006; four rolls of another star have two candidates, of 5.5 and 5.9, with 2.6 and 3.2 in both of
its rolls together. The numbers between and beyond follow an exponential through these few."""


def structures_in_single_roll(snr: ArrayLike) -> Image:
    """Probability that a structure of the detector makes a peak above an S/N anywhere in a roll."""
    number = _STRUCTURES * np.exp((_STRUCTURES_ABOVE - np.asarray(snr)) / _STRUCTURES_FALL)
    return np.asarray(-np.expm1(-number))


_COMPACT_SIGMAS = 4.0
"""Standard deviations by which the sum over a compact structure exceeds sums elsewhere."""


def compact_structures(pattern: Image, width: float) -> Image:
    """The part of a pattern, (ny, nx), that is in structures as compact as a point source.

    Errors of the flat field are independent from pixel to pixel. Where neighbours agree over the
    width of a point source, pixels, the star's image has light that the model lacks.
    """
    # Sums over the image of a point source, whose scatter comes from the flat field's errors.
    reach = math.ceil(width)
    steps = np.arange(-reach, reach + 1) ** 2
    squares = np.add.outer(steps, steps)
    point = np.exp(-4 * math.log(2) * squares / width**2)
    sums = convolve(pattern, point, mode="constant")
    scatter = math.sqrt(float(np.median(sums**2)) / _MEDIAN_SQUARE)
    peaks = (sums == maximum_filter(sums, size=2 * reach + 1)) & (sums > _COMPACT_SIGMAS * scatter)
    near = binary_dilation(peaks, squares <= width**2)
    return np.where(near, pattern, 0.0)


@dataclass(frozen=True)
class ErrorFactor:
    """Factor for errors at any position."""

    factors: Image  # (ny, nx), at the pixels of the first frame.
    # (ny, nx), degrees of freedom of Student's t, which noise follows in units of errors that were
    # multiplied by a measured factor. Infinity where the factor is not measured: the noise is then
    # Gaussian.
    freedom: Image
    grid: Image  # (ny, nx, 2), x, y of the pixels from the star, arcsec.

    @classmethod
    def constant(cls, factor: float) -> ErrorFactor:
        """Make a factor that is equal everywhere, for which no scatter was measured."""
        one = np.ones((1, 1))
        return cls(factor * one, np.inf * one, np.zeros((1, 1, 2)))

    def of(self, offsets: Tensor | Image) -> Image:
        """Factors at positions x, y from the star, (..., 2), arcsec."""
        return self._interpolated(self.factors, np.asarray(offsets))

    def at(self, separation: ArrayLike) -> Image:
        """Median of the factors at separations, arcsec."""
        return self._on_circles(self.factors, separation)

    def false_alarm(self, snr: ArrayLike, offsets: Tensor | Image) -> Image:
        """Probability that noise at one position exceeds an S/N of the multiplied errors."""
        return student_tail(snr, self._freedom_of(offsets))

    def threshold(self, sigmas: float, offsets: Tensor | Image) -> Image:
        """S/N that noise at a position exceeds as rarely as Gaussian noise exceeds `sigmas`."""
        return student_snr(sigmas, self._freedom_of(offsets))

    def threshold_at(self, sigmas: float, separation: ArrayLike) -> Image:
        """Threshold at separations, arcsec, from the median of the degrees of freedom."""
        freedom = _inverse(self._on_circles(1 / self.freedom, separation))
        return student_snr(sigmas, freedom)

    def _freedom_of(self, offsets: Tensor | Image) -> Image:
        # Interpolated as its inverse, which is finite.
        return _inverse(self._interpolated(1 / self.freedom, np.asarray(offsets)))

    def _interpolated(self, image: Image, offsets: Image) -> Image:
        """Values of an image at positions; beyond the grid, the nearest pixel's."""
        if image.size == 1:
            return np.full(offsets.shape[:-1], image[0, 0])
        columns, rows = np.moveaxis(pixels_of(self.grid, offsets), -1, 0)
        return np.asarray(map_coordinates(image, [rows, columns], order=1, mode="nearest"))

    def _on_circles(self, image: Image, separation: ArrayLike) -> Image:
        """Medians of an image on circles, as far as they are on the grid."""
        radius = np.asarray(separation, dtype=float)
        if image.size == 1:
            return np.full(radius.shape, image[0, 0])
        angle = np.linspace(0, 2 * np.pi, _POSITIONS_PER_CIRCLE, endpoint=False)
        circles = radius[..., None, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        values = self._interpolated(image, circles)
        columns, rows = np.moveaxis(pixels_of(self.grid, circles), -1, 0)
        ny, nx = image.shape
        inside = (rows >= 0) & (rows <= ny - 1) & (columns >= 0) & (columns <= nx - 1)
        # A circle around the whole field has the values of its corners.
        inside |= ~inside.any(axis=-1, keepdims=True)
        return np.asarray(np.nanmedian(np.where(inside, values, np.nan), axis=-1))

    @property
    def is_measured(self) -> bool:
        """Whether the factor follows the scatter of the S/N, and not chi-squared alone."""
        return bool(np.isfinite(self.freedom).any())

    @property
    def typical(self) -> float:
        """Median over the field."""
        return float(np.median(self.factors))


def _inverse(values: Image) -> Image:
    return np.divide(1.0, values, out=np.full_like(values, np.inf), where=values > 0)


@dataclass(frozen=True)
class ScatterModel:
    """Logarithm of f^2 at the pixels of a map as a function of a few parameters.

    These have independent Gaussian priors with mean 0 and standard deviation 1.
    """

    starlight: NDArray[np.float64]  # (n,), star over noise, in units of `_PIVOT_STAR_SNR`.
    rings: NDArray[np.float64]  # (n, knots), derivative of log f^2 by the parameters of g.

    @classmethod
    def of(cls, starlight: Image, distance: Image, inner: float) -> ScatterModel:
        """For pixels with a star over noise, at distances from the star, both (n,)."""
        logs = np.log(np.maximum(distance, inner) / inner)
        knots = np.linspace(0, max(logs.max(), _LENGTH_LOG_R), _KNOTS)
        covariance = _SPREAD**2 * _kernel(knots, knots) + 1e-6 * np.eye(_KNOTS)
        # Parameters are the values at the knots, made independent; g follows from them as the
        # mean of a Gaussian process does.
        rings = np.linalg.solve(np.linalg.cholesky(covariance), _SPREAD**2 * _kernel(knots, logs))
        return cls(np.maximum(starlight, 0) / _PIVOT_STAR_SNR, rings.T)

    def evaluate(self, parameters: NDArray[np.float64]) -> tuple[Image, Image]:
        """Return log f^2, (n,), and its derivatives, (n, parameters)."""
        # A is `quiet` and B q is `bright`: the change of log(A + B q) is the mean of the changes of
        # log A and log B, weighted with the two terms.
        quiet = np.exp(_SPREAD * parameters[0])
        bright = np.exp(_STARLIGHT + _STARLIGHT_SPREAD * parameters[1]) * self.starlight
        share = quiet / (quiet + bright)
        slopes = np.column_stack([_SPREAD * share, _STARLIGHT_SPREAD * (1 - share), self.rings])
        return np.log(quiet + bright) + self.rings @ parameters[2:], slopes

    def __getitem__(self, selected: NDArray[np.bool_]) -> ScatterModel:
        return ScatterModel(self.starlight[selected], self.rings[selected])

    def fit(
        self,
        squares: NDArray[np.float64],
        independent: float,
        start: NDArray[np.float64] | None = None,
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Most probable parameters and their covariance, from squares of the S/N, (n,).

        Each pixel counts for `independent` positions.
        """
        # Fisher scoring. A Gaussian S/N z of variance v = f^2 has the log-likelihood -(log v + z^2
        # / v) / 2, with the derivative (z^2 / v - 1) / 2 by log v and the information 1 / 2.
        # Squares are clipped in units of v.
        prior = np.eye(2 + self.rings.shape[1])
        if start is None:
            # From here clipping does not hide a scatter that is large everywhere.
            start = np.zeros(len(prior))
            start[0] = np.log(np.median(squares) / _MEDIAN_SQUARE) / _SPREAD
        parameters = start
        for _ in range(_FIT_STEPS):
            logs, slopes = self.evaluate(parameters)
            excess = np.minimum(squares * np.exp(-logs), CLIP**2) - 1
            curvature = independent / 2 * slopes.T @ slopes + prior
            gradient = independent / 2 * slopes.T @ excess - parameters
            step = np.linalg.solve(curvature, gradient)
            step *= min(1.0, 1.0 / float(np.abs(step).max()))
            parameters = parameters + step
            if np.abs(step).max() < _SETTLED_CHANGE:
                break
        return parameters, np.asarray(np.linalg.inv(curvature), dtype=float)


def _kernel(first: Image, second: Image) -> Image:
    return np.exp(-0.5 * ((first[:, None] - second) / _LENGTH_LOG_R) ** 2)


class Scatter:
    """Scatter of the S/N of a map away from sources.

    `starlight` (ny, nx) is star over noise, weighted with the image of a planet at the pixel, and
    `grid` (ny, nx, 2) x, y from the star, arcsec. Pixels within `inner` arcsec are ignored;
    `resolution` is lambda/D, arcsec. `independent` is the number of independent positions per
    pixel: one over the sum of the squared autocorrelation of the S/N.
    """

    def __init__(
        self, starlight: Image, grid: Image, inner: float, resolution: float, independent: float
    ) -> None:
        self.grid, self.resolution = grid, resolution
        self._independent = independent * _FITTED_PIXEL_STEP**2
        distance = separation_of(grid)
        # Neighbouring pixels say nearly the same.
        thinned = np.zeros(distance.shape, dtype=bool)
        thinned[::_FITTED_PIXEL_STEP, ::_FITTED_PIXEL_STEP] = True
        self._used = thinned & (distance >= inner) & np.isfinite(starlight)
        typical = np.median(starlight[self._used]) if self._used.any() else 0.0
        everywhere = np.nan_to_num(starlight, nan=float(typical))
        self._model = ScatterModel.of(everywhere.ravel(), distance.ravel(), inner)

    def factor(self, snr: Image, sources: Tensor | Image) -> ErrorFactor:
        """Factor for the errors of a map (ny, nx) with sources at x, y, (k, 2).

        Sources are left out with their surroundings.
        """
        fit = self._fit(snr, sources)
        if fit is None:
            return ErrorFactor.constant(1.0)
        factors, freedom = self._evaluate(self._model, *fit)
        return ErrorFactor(factors.reshape(snr.shape), freedom.reshape(snr.shape), self.grid)

    def judged(
        self, snr: Image, sources: Tensor | Image, pixels: Sequence[tuple[int, int]]
    ) -> Iterator[tuple[float, float]]:
        """Factor and degrees of freedom at pixels, each without the pixel and its surroundings."""
        start = self._fit(snr, sources)
        for pixel in pixels:
            left_out = np.concatenate([np.asarray(sources), self.grid[pixel][None]])
            fit = self._fit(snr, left_out, None if start is None else start[0])
            if fit is None:
                yield 1.0, np.inf
                continue
            index = np.zeros(snr.shape, dtype=bool)
            index[pixel] = True
            factors, freedom = self._evaluate(self._model[index.ravel()], *fit)
            yield float(factors[0]), float(freedom[0])

    def _fit(
        self, snr: Image, sources: Tensor | Image, start: NDArray[np.float64] | None = None
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
        """Parameters and their covariance; None if hardly any pixels are left."""
        away = far_from(self.grid, sources, _SOURCE_RADIUS_ELEMENTS * self.resolution)
        clear = self._used & np.isfinite(snr) & away
        if clear.sum() * self._independent < 1:
            return None
        return self._model[clear.ravel()].fit(snr[clear] ** 2, self._independent, start)

    @staticmethod
    def _evaluate(
        model: ScatterModel, parameters: NDArray[np.float64], covariance: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Factors and degrees of freedom, (n,): a variance known to a relative 2 / n is of n."""
        logs, slopes = model.evaluate(parameters)
        variance = ((slopes @ covariance) * slopes).sum(axis=1)
        return np.exp(logs / 2), 2 / variance


# Which peaks of a map of S/N are more than noise.

_MOST_POSITIONS_PER_SOURCE = 2.0
"""Largest number of independent positions that a source counts for."""

_MOST_JUDGED_PEAKS = 20
"""Largest number of peaks that are judged."""

Peak = tuple[int, int]


@dataclass(frozen=True)
class Significance:
    """Errors and thresholds of a map of S/N."""

    grid: Image  # (ny, nx, 2), x, y of the pixels from the star, arcsec.
    starlight: Image  # (ny, nx), star over noise, weighted with the image of a planet at the pixel.
    # (2 k + 1, 2 k + 1), autocorrelation of the S/N by distance in pixels, 1 in the middle.
    correlation: Image
    inner: float  # Smallest separation of a source, arcsec.
    resolution: float  # lambda/D, arcsec.
    least: float = 1.0  # Smallest factor by which errors are multiplied.
    # Whether the factor follows the scatter of the map. Otherwise it is `least`.
    measured: bool = True
    # (ny, nx), S/N of planets that structures of the detector may be taken for, before errors are
    # multiplied.
    structures: Image | float = 0.0

    def factor(self, snr: Image, sources: Tensor | Image) -> ErrorFactor:
        """Factor for the errors of a map with sources at x, y, (k, 2), arcsec."""
        if not self.measured:
            return ErrorFactor.constant(self.least)
        factor = self._scatter.factor(snr, sources)
        factors = np.hypot(np.maximum(factor.factors, self.least), self.structures)
        return replace(factor, factors=factors)

    @cached_property
    def _scatter(self) -> Scatter:
        independent = 1 / float((self.correlation**2).sum())
        return Scatter(self.starlight, self.grid, self.inner, self.resolution, independent)

    def next_peak(
        self, snr: Image, sources: Tensor | Image, threshold: float, allowed: NDArray[np.bool_]
    ) -> Peak | None:
        """Pixel of the highest peak that is significant, judged by the scatter without it.

        `snr` (ny, nx) is before errors are multiplied, with the known sources at x, y, (k, 2),
        removed. `threshold` is for Gaussian noise; where the scatter is measured, the S/N
        that Student's t exceeds as rarely takes its place.
        """
        peaks = self.significant_peaks(snr, sources, threshold, allowed)
        return next((peak for peak, _ in peaks), None)

    def significant_peaks(
        self, snr: Image, sources: Tensor | Image, threshold: float, allowed: NDArray[np.bool_]
    ) -> Iterator[tuple[Peak, float]]:
        """Peaks that are significant each on its own, and their significance; see `next_peak`.

        The significance is the number of standard deviations that Gaussian noise exceeds as rarely.
        """
        peaks = self.peaks(snr, sources, threshold, allowed)
        alone = (
            self._scatter.judged(snr, sources, peaks)
            if self.measured
            else itertools.repeat((self.least, math.inf))
        )
        structures = np.broadcast_to(self.structures, snr.shape)
        for peak, (scatter, freedom) in zip(peaks, alone, strict=False):
            height = float(snr[peak]) / math.hypot(max(scatter, self.least), structures[peak])
            sigmas = float(self.sigmas(height, freedom))
            if sigmas >= threshold:
                yield peak, sigmas

    def peaks(
        self, snr: Image, sources: Tensor | Image, threshold: float, allowed: NDArray[np.bool_]
    ) -> list[Peak]:
        """Peaks above a threshold that may be significant, the highest first; see `next_peak`."""
        factor = self.factor(snr, sources)
        # A source raises the scatter by which it is measured: it counts for a position or two.
        raised = np.sqrt(1 + _MOST_POSITIONS_PER_SOURCE * CLIP**2 / factor.freedom)
        scaled = raised * snr / factor.factors
        allowed = allowed & reaching(self.grid, self.inner)
        allowed &= far_from(self.grid, sources, pixel_width(self.grid))
        return local_maxima(scaled, allowed, threshold, size=3)[:_MOST_JUDGED_PEAKS]

    @staticmethod
    def sigmas(snr: ArrayLike, freedom: ArrayLike) -> Image:
        """Standard deviations that Gaussian noise exceeds as rarely as Student's t the S/N."""
        return gaussian_sigmas(student_tail(snr, freedom))

    def false_alarms(self, factor: ErrorFactor, snr: Image, offsets: Tensor | Image) -> Image:
        """Probabilities, (k,), that noise makes peaks of such S/N anywhere in the field.

        `snr` (k,) is with errors multiplied by the factor; `offsets` (k, 2) are x, y, arcsec.
        """
        sigmas = gaussian_sigmas(factor.false_alarm(snr, offsets))
        return np.array([self.false_alarm(float(each)) for each in sigmas])

    def false_alarm(self, sigmas: float) -> float:
        """Probability that Gaussian noise exceeds a number of standard deviations anywhere."""
        if not math.isfinite(sigmas):
            return 0.0
        # The number of maxima of a smooth field above a high level u is nearly its Euler
        # characteristic, whose expectation follows from the area N and the half perimeter of the
        # field, in pixels, and the curvature L of the autocorrelation (R. J. Adler and J. E.
        # Taylor, "Random Fields and Geometry", 2007, chapter 11):
        #
        #     N sqrt(det L) u exp(-u^2 / 2) / (2 pi)^(3/2)
        #         + (nx sqrt(L_xx) + ny sqrt(L_yy)) exp(-u^2 / 2) / (2 pi) + P(z > u).
        valid = np.isfinite(self.starlight) & (separation_of(self.grid) >= self.inner)
        # Negative second derivatives of the autocorrelation in the middle, per pixel^2.
        middle = self.correlation.shape[0] // 2
        slope, curvature = _derivatives(middle)
        across = -float(curvature @ self.correlation[middle])
        up = -float(curvature @ self.correlation[:, middle])
        mixed = -float(slope @ self.correlation @ slope)
        density = math.sqrt(max(across * up - mixed**2, 0.0))
        ny, nx = valid.shape
        edge = nx * math.sqrt(across) + ny * math.sqrt(up)
        falloff = math.exp(-(sigmas**2) / 2)
        expected = (
            valid.sum() * density * sigmas * falloff / (2 * math.pi) ** 1.5
            + edge * falloff / (2 * math.pi)
            + float(gaussian_tail(sigmas))
        )
        return -math.expm1(-expected)


def _derivatives(reach: int) -> tuple[Image, Image]:
    """Weights of samples -reach, ..., reach whose sums are the derivatives in the middle."""
    # First and second derivatives of a band-limited function, sampled at its Nyquist rate,
    # which is the sum of sinc functions sin(pi x) / (pi x): these have the slope (-1)^k / k and the
    # curvature -2 (-1)^k / k^2 at k, and -pi^2 / 3 in the middle.
    places = np.arange(-reach, reach + 1)
    away = np.where(places == 0, 1, places)
    signs = np.where(places % 2 == 0, 1.0, -1.0)
    slope = np.where(places == 0, 0.0, -signs / away)
    curvature = np.where(places == 0, -(math.pi**2) / 3, -2 * signs / away**2)
    return slope, curvature


# The contrast curve.

_LIMIT_SNR = 5.0
"""S/N of a contrast curve."""

_CURVE_COLUMNS = {
    "separation": (".3f", "from the star"),
    "contrast": (".2e", "median of the ring"),
    "delta_mag": (".2f", "magnitude difference of the median"),
    "lowest": (".2e", "of the ring"),
    "highest": (".2e", "of the ring"),
    "known_star": (".2e", "median if the image of the star were known"),
    "small_sample": (".2e", "median with the small-sample correction of measured errors"),
    "error_factor": (".2f", "by which errors were multiplied, included in all but known_star"),
    "flux_density": (".2e", "of the median, in the photometric calibration of the frames"),
}
"""Formats and descriptions of the columns."""


def contrast_table(
    separations: NDArray[np.float64],
    errors: list[NDArray[np.float64]],
    photon: list[NDArray[np.float64]],
    resolution: float,
    factor: ErrorFactor,
    star: float | None = None,
) -> QTable:
    """Make the table of a 5-sigma contrast curve; separations and lambda/D are in arcsec.

    `errors` are standard deviations of contrasts at the pixels of each ring, multiplied by the
    factor, and `photon` the same for a known star. With the star's flux density, Jy, there is a
    column of the median's flux density. `_CURVE_COLUMNS` describes the columns.
    """
    rows = []
    # Where errors were scaled to the scatter of the S/N, noise follows Student's t, with as many
    # degrees of freedom as positions told of the scatter. The small-sample limit is the one that it
    # exceeds as rarely as Gaussian noise exceeds 5 sigma. The limit for a known star is the photon
    # limit of a matched filter.
    corrections = factor.threshold_at(_LIMIT_SNR, separations) / _LIMIT_SNR
    for separation, error, photon_error, correction in zip(
        separations, errors, photon, corrections, strict=True
    ):
        if not len(error):
            continue
        limit = _LIMIT_SNR * np.asarray(error)
        middle = float(np.median(limit))
        bound = _LIMIT_SNR * float(np.median(photon_error))
        magnitude = -2.5 * math.log10(middle)
        rows.append(
            (separation, middle, magnitude, limit.min(), limit.max(), bound, middle * correction)
        )
    values = dict(zip(_CURVE_COLUMNS, np.array(rows, dtype=float).reshape(-1, 7).T, strict=False))
    values["error_factor"] = factor.at(values["separation"])
    if star is not None:
        values["flux_density"] = star * values["contrast"]
    units = {"separation": u.arcsec, "delta_mag": u.mag, "flux_density": u.Jy}
    curve = {name: each * units.get(name, 1) for name, each in values.items()}
    return curve_table(curve, {"sigmas": _LIMIT_SNR, "resolution_arcsec": resolution})


def curve_table(values: Mapping[str, Any], meta: Mapping[str, Any]) -> QTable:
    """Make the table of a contrast curve of its columns, whose units are their own."""
    columns = ((name, each, None, *_CURVE_COLUMNS[name]) for name, each in values.items())
    return add_columns(QTable(meta=meta), columns)
