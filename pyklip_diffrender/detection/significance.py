"""Which peaks of a map of S/N are more than noise."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats
from torch import Tensor

from pyklip_diffrender.detection.error_factor import CLIP, ErrorFactor, Scatter
from pyklip_diffrender.detection.field import (
    Image,
    far_from,
    pixel_width,
    reaching,
    separation_of,
)
from pyklip_diffrender.refinement.companions import local_maxima

__all__ = ["Significance"]

_POSITIONS = 2.0
"""Largest number of independent positions that a source counts for."""

_JUDGED = 20
"""Largest number of peaks that are judged."""

Peak = tuple[int, int]


@dataclass(frozen=True)
class Significance:
    """Errors and thresholds of a map of S/N.

    Attributes
    ----------
    grid : ndarray, (ny, nx, 2)
        x, y of the pixels from the star, arcsec.
    starlight : ndarray, (ny, nx)
        Star over noise, weighted with the image of a planet at the pixel.
    correlation : ndarray, (2 k + 1, 2 k + 1)
        Autocorrelation of the S/N by distance in pixels, 1 in the middle.
    inner : float
        Smallest separation of a source, arcsec.
    resolution : float
        lambda/D, arcsec.
    least : float
        Smallest factor by which errors are multiplied.
    measured : bool
        Whether the factor follows the scatter of the map. Otherwise it is `least`.
    """

    grid: Image
    starlight: Image
    correlation: Image
    inner: float
    resolution: float
    least: float = 1.0
    measured: bool = True

    def factor(self, snr: Image, sources: Tensor | Image) -> ErrorFactor:
        """Factor for the errors of a map with sources at x, y, (k, 2), arcsec."""
        if not self.measured:
            return ErrorFactor.constant(self.least)
        return self._scatter.factor(snr, sources).at_least(self.least)

    @cached_property
    def _scatter(self) -> Scatter:
        independent = 1 / float((self.correlation**2).sum())
        return Scatter(self.starlight, self.grid, self.inner, self.resolution, independent)

    def next_peak(
        self, snr: Image, sources: Tensor | Image, threshold: float, allowed: NDArray[np.bool_]
    ) -> Peak | None:
        """Pixel of the highest peak that is significant, judged by the scatter without it.

        Parameters
        ----------
        snr : ndarray, (ny, nx)
            Before errors are multiplied, with the known sources removed.
        sources : Tensor or ndarray, (k, 2)
            x, y of the known sources.
        threshold : float
            S/N in Gaussian noise; where the scatter is measured, Student's t has it exceeded as
            rarely.
        allowed : ndarray of bool, (ny, nx)
        """
        peaks = self.significant_peaks(snr, sources, threshold, allowed)
        return next((peak for peak, _ in peaks), None)

    def significant_peaks(
        self, snr: Image, sources: Tensor | Image, threshold: float, allowed: NDArray[np.bool_]
    ) -> Iterator[tuple[Peak, float]]:
        """Peaks that are significant each on its own, and their significance in sigmas.

        The significance is the number of standard deviations that Gaussian noise exceeds as rarely.
        See `next_peak`.
        """
        factor = self.factor(snr, sources)
        # A source raises the scatter by which it is measured: it counts for a position or two.
        raised = np.sqrt(1 + _POSITIONS * CLIP**2 / factor.freedom)
        scaled = raised * snr / factor.factors
        allowed = allowed & reaching(self.grid, self.inner)
        allowed &= far_from(self.grid, sources, pixel_width(self.grid))
        peaks = local_maxima(scaled, allowed, threshold, size=3)[:_JUDGED]
        alone = (
            self._scatter.judged(snr, sources, peaks)
            if self.measured
            else itertools.repeat((self.least, math.inf))
        )
        for peak, (scatter, freedom) in zip(peaks, alone, strict=False):
            height = float(snr[peak]) / max(scatter, self.least)
            sigmas = float(self.sigmas(height, freedom))
            if sigmas >= threshold:
                yield peak, sigmas

    @staticmethod
    def sigmas(snr: ArrayLike, freedom: ArrayLike) -> Image:
        """Standard deviations that Gaussian noise exceeds as rarely as Student's t the S/N."""
        return np.asarray(stats.norm.isf(stats.t.sf(snr, freedom)))

    def false_alarms(self, factor: ErrorFactor, snr: Image, offsets: Tensor | Image) -> Image:
        """Probabilities that noise makes peaks of such S/N anywhere in the field, (k,).

        Parameters
        ----------
        factor : ErrorFactor
            By which the errors are multiplied.
        snr : ndarray, (k,)
            With multiplied errors.
        offsets : Tensor or ndarray, (k, 2)
            x, y, arcsec.
        """
        sigmas = stats.norm.isf(factor.false_alarm(snr, offsets))
        return np.array([self.false_alarm(float(each)) for each in sigmas])

    def false_alarm(self, sigmas: float) -> float:
        """Probability that Gaussian noise exceeds a number of standard deviations anywhere.

        The number of maxima of a smooth field above a high level is nearly its Euler
        characteristic, whose expectation follows from the area and the edge of the field and the
        curvature of the autocorrelation: R. J. Adler and J. E. Taylor, "Random Fields and
        Geometry" (2007), chapter 11.
        """
        if not math.isfinite(sigmas):
            return 0.0
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
            + float(stats.norm.sf(sigmas))
        )
        return -math.expm1(-expected)


def _derivatives(reach: int) -> tuple[Image, Image]:
    """Weights of samples -reach, ..., reach whose sums are the derivatives in the middle.

    First and second derivatives of a function without frequencies beyond those of its samples,
    which is the sum of sinc functions.
    """
    places = np.arange(-reach, reach + 1)
    away = np.where(places == 0, 1, places)
    signs = np.where(places % 2 == 0, 1.0, -1.0)
    slope = np.where(places == 0, 0.0, -signs / away)
    curvature = np.where(places == 0, -(math.pi**2) / 3, -2 * signs / away**2)
    return slope, curvature
