"""Factor by which the errors of a search are multiplied, as a function of separation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
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
arcsec has about 30, which leave its own standard deviation uncertain by 13 %."""


@dataclass(frozen=True)
class ErrorFactor:
    """Factor for errors at any separation from the star, interpolated between rings.

    Attributes
    ----------
    separations : ndarray, (k,)
        Rings, arcsec, from the inside.
    factors : ndarray, (k,)
    """

    separations: NDArray[np.float64]
    factors: NDArray[np.float64]

    @classmethod
    def constant(cls, factor: float) -> ErrorFactor:
        """The same factor everywhere."""
        return cls(np.zeros(1), np.array([float(factor)]))

    def at(self, separation: ArrayLike) -> NDArray[np.float64]:
        """Factors at separations, arcsec; beyond the rings that of the nearest one."""
        return np.asarray(
            np.interp(np.asarray(separation, dtype=float), self.separations, self.factors)
        )

    def of(self, offsets: Tensor) -> NDArray[np.float64]:
        """Factors at positions x, y from the star, (k, 2), arcsec."""
        return self.at(separation_of(offsets.numpy().reshape(-1, 2)))

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
        return ErrorFactor(self.separations, np.maximum(self.factors, factor))


def scatter_profile(
    snr: Image, grid: Image, offsets: Tensor, inner: float, resolution: float
) -> ErrorFactor:
    """Standard deviation of the S/N away from sources, by separation.

    Every ring has few independent positions, so that its variance is averaged with that of the
    whole field, which counts for `_PRIOR` of them.

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
    factors = []
    for separation in separations:
        ring = clear & (np.abs(distance - separation) < _WIDTH)
        independent = ring.sum() * pixel_area / resolution**2
        own = _variance(snr[ring]) if ring.any() else whole
        factors.append((independent * own + _PRIOR * whole) / (independent + _PRIOR))
    return ErrorFactor(separations, np.sqrt(factors))


def _variance(values: NDArray[np.float64]) -> float:
    """Clipped variance about 0."""
    deviation = 1.4826 * float(np.median(np.abs(values)))
    return float((np.clip(values, -_CLIP * deviation, _CLIP * deviation) ** 2).mean())
