"""Factor by which the errors of a search are multiplied, as a function of separation."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats
from torch import Tensor

from pyklip_diffrender.detection.field import Image, far_from, separation_of

__all__ = ["ErrorFactor", "scatter_profile"]

_WINGS = 0.4
"""arcsec; closer to a candidate, its own light dominates the S/N."""

_WIDTH = 0.2
"""Half the width of the rings in which the scatter is measured, arcsec."""

_STEP = 0.1
"""Distance between rings, arcsec."""

_CLIP = 5.0
"""Standard deviations at which S/N is clipped, so that sources that are not yet candidates do not
raise their own threshold."""

_PRIOR = 20.0
"""Independent positions that the scatter of the whole field counts for in every ring. A ring at 0.4
arcsec has about 35, which leave its own standard deviation uncertain by 12 %."""

_AREA = 1.5
"""Resolution elements per independent position. The S/N of neighbouring positions correlates; the
posterior covariance of two rolls of G 7-34 and HIP 17695 gives 1.2 to 1.5 up to 0.7 arcsec from the
star, and 1.9 to 2.5 at 2 arcsec, where rings have more than a hundred positions in any case."""


@dataclass(frozen=True)
class ErrorFactor:
    """Factor for errors at any separation from the star, interpolated between rings.

    Attributes
    ----------
    separations : ndarray, (k,)
        Rings, arcsec, from the inside.
    factors : ndarray, (k,)
    freedom : ndarray, (k,)
        Degrees of freedom of Student's t, which noise follows in units of errors that were
        multiplied by a measured factor. Infinity where the factor is not measured: the noise is
        then Gaussian.
    """

    separations: NDArray[np.float64]
    factors: NDArray[np.float64]
    freedom: NDArray[np.float64]

    @classmethod
    def constant(cls, factor: float) -> ErrorFactor:
        """The same factor everywhere, which no scatter was measured for."""
        return cls(np.zeros(1), np.array([float(factor)]), np.array([np.inf]))

    def at(self, separation: ArrayLike) -> NDArray[np.float64]:
        """Factors at separations, arcsec; beyond the rings that of the nearest one."""
        return np.asarray(
            np.interp(np.asarray(separation, dtype=float), self.separations, self.factors)
        )

    def of(self, offsets: Tensor) -> NDArray[np.float64]:
        """Factors at positions x, y from the star, (k, 2), arcsec."""
        return self.at(separation_of(offsets.numpy().reshape(-1, 2)))

    def false_alarm(self, snr: ArrayLike, separation: ArrayLike) -> NDArray[np.float64]:
        """Probability that noise at one position exceeds an S/N of the multiplied errors."""
        return np.asarray(stats.t.sf(snr, self._freedom_at(separation)))

    def threshold(self, sigmas: float, separation: ArrayLike) -> NDArray[np.float64]:
        """S/N that noise exceeds as rarely as Gaussian noise exceeds `sigmas`."""
        return np.asarray(stats.t.isf(stats.norm.sf(sigmas), self._freedom_at(separation)))

    def _freedom_at(self, separation: ArrayLike) -> NDArray[np.float64]:
        # Interpolated as its inverse, which is finite.
        inverse = np.interp(np.asarray(separation, dtype=float), self.separations, 1 / self.freedom)
        return np.divide(1.0, inverse, out=np.full_like(inverse, np.inf), where=inverse > 0)

    @property
    def is_measured(self) -> bool:
        """Whether it follows the scatter of the S/N, and not chi-squared alone."""
        return len(self.factors) > 1

    @property
    def is_needed(self) -> bool:
        """Whether any errors are multiplied by more than 1."""
        return bool(self.factors.max() > 1)

    @property
    def typical(self) -> float:
        """Median over the rings."""
        return float(np.median(self.factors))

    def at_least(self, factor: float) -> ErrorFactor:
        """The larger of both everywhere."""
        return replace(self, factors=np.maximum(self.factors, factor))


def scatter_profile(
    snr: Image, grid: Image, offsets: Tensor, inner: float, resolution: float
) -> ErrorFactor:
    """Standard deviation of the S/N away from sources, by separation.

    Every ring has few independent positions, so that its variance is averaged with that of the
    whole field, which counts for `_PRIOR` of them. This is the posterior mean of a variance with a
    scaled inverse chi-squared prior. In units of its root, noise at another position follows
    Student's t, whose degrees of freedom are the sum of both counts.

    Parameters
    ----------
    snr : ndarray, (ny, nx)
    grid : ndarray, (ny, nx, 2)
        x, y of the pixels from the star, arcsec.
    offsets : Tensor, (k, 2)
        x, y of the sources.
    inner : float
        Pixels closer to the star than this are ignored, arcsec.
    resolution : float
        Size of a resolution element, arcsec.
    """
    distance = separation_of(grid)
    clear = (distance >= inner) & np.isfinite(snr) & far_from(grid, offsets, _WINGS)
    if not clear.any():
        return ErrorFactor.constant(1.0)
    pixel_area = abs(np.linalg.det([grid[1, 1] - grid[0, 1], grid[1, 1] - grid[1, 0]]))
    whole = _variance(snr[clear])
    separations = np.arange(inner, distance[clear].max() + _STEP, _STEP)
    variances, freedom = [], []
    for separation in separations:
        ring = clear & (np.abs(distance - separation) < _WIDTH)
        independent = ring.sum() * pixel_area / (_AREA * resolution**2)
        own = _variance(snr[ring]) if ring.any() else whole
        variances.append((independent * own + _PRIOR * whole) / (independent + _PRIOR))
        freedom.append(independent + _PRIOR)
    return ErrorFactor(separations, np.sqrt(variances), np.array(freedom))


def _variance(values: NDArray[np.float64]) -> float:
    """Clipped variance about 0."""
    deviation = 1.4826 * float(np.median(np.abs(values)))
    return float((np.clip(values, -_CLIP * deviation, _CLIP * deviation) ** 2).mean())
