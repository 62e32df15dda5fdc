"""How often noise exceeds a level in a search over positions and spectra.

A spectrum is a point on the unit sphere whose axes are the filters, in units of their errors. The
number of maxima of noise over positions and spectra follows from the area and the edge of the
field, and from the length and the area of the set of spectra on the sphere: R. J. Adler and J. E.
Taylor, "Random Fields and Geometry" (2007), chapters 12 and 15. For spectra that are far apart, the
sum of their trials is less, and is used instead.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.polynomial import hermite_e
from numpy.typing import NDArray
from scipy import optimize, stats
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree
from scipy.special import gamma

from pyklip_diffrender.detection.field import Image
from pyklip_diffrender.detection.sky_map import SkyStack

__all__ = ["Family", "level_of"]


class Family:
    """Spectra that are searched together: those of a list, or any without negative fluxes.

    Parameters
    ----------
    spectra : ndarray, (k, filters), or None
        None for free fluxes.
    stack : SkyStack
        At the pixels of the field, (filters, n).
    area : float
        Of a pixel, arcsec^2.
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
    """Lipschitz-Killing curvatures of the part of a sphere without negative coordinates, (count,).

    The length of a vector of noise without its negative coordinates is chi of k degrees of freedom
    with the probability C(count, k) / 2^count, and chi is the maximum over a whole sphere.
    """
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
