"""Which peaks of a map of S/N are more than noise."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from torch import Tensor

from pyklip_diffrender.detection.error_factor import CLIP, ErrorFactor, Scatter
from pyklip_diffrender.detection.field import Image, far_from, pixel_width, separation_of
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
        return next(self.significant_peaks(snr, sources, threshold, allowed), None)

    def significant_peaks(
        self, snr: Image, sources: Tensor | Image, threshold: float, allowed: NDArray[np.bool_]
    ) -> Iterator[Peak]:
        """All such peaks, each judged as if it were the only one; see `next_peak`."""
        factor = self.factor(snr, sources)
        # A source raises the scatter by which it is measured: it counts for a position or two.
        raised = np.sqrt(1 + _POSITIONS * CLIP**2 / factor.freedom)
        scaled = raised * snr / factor.factors
        allowed = allowed & (separation_of(self.grid) >= self.inner)
        allowed &= far_from(self.grid, sources, pixel_width(self.grid))
        for peak in local_maxima(scaled, allowed, threshold, size=3)[:_JUDGED]:
            place = self.grid[peak][None]
            factor = self.factor(snr, np.concatenate([np.asarray(sources), place]))
            if snr[peak] >= factor.of(place)[0] * factor.threshold(threshold, place)[0]:
                yield peak

    def false_alarm(self, sigmas: float) -> float:
        """Probability that Gaussian noise exceeds a number of standard deviations anywhere.

        The number of maxima of a smooth field above a high level is nearly its Euler
        characteristic, whose expectation follows from the area and the edge of the field and the
        curvature of the autocorrelation: R. J. Adler and J. E. Taylor, "Random Fields and
        Geometry" (2007), chapter 11.
        """
        valid = np.isfinite(self.starlight) & (separation_of(self.grid) >= self.inner)
        # Second derivatives of the autocorrelation, per pixel^2.
        middle = self.correlation.shape[0] // 2
        row, column = self.correlation[middle], self.correlation[:, middle]
        across, up = (2 * _curvature(each, middle) for each in (row, column))
        diagonal = np.diagonal(self.correlation)
        other = np.diagonal(self.correlation[:, ::-1])
        mixed = (_curvature(diagonal, middle) - _curvature(other, middle)) / 2
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


def _curvature(profile: Image, middle: int) -> float:
    """Half the negative second derivative at the middle, from values within two pixels."""
    # 1 - c x^2 + d x^4 through the values at one and two pixels.
    first = 1 - (profile[middle - 1] + profile[middle + 1]) / 2
    second = 1 - (profile[middle - 2] + profile[middle + 2]) / 2
    return float((16 * first - second) / 12)
