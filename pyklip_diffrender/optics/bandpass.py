"""A set of wavelengths and their weights."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from pyklip_diffrender.errors import ShapeError
from pyklip_diffrender.io.units import native_float64, to_metres


@dataclass(frozen=True)
class Bandpass:
    """A set of wavelengths (m) with weights, fractions of the detected photons that sum to 1."""

    wavelengths: tuple[float, ...]
    weights: tuple[float, ...]

    def __post_init__(self) -> None:
        if len(self.wavelengths) != len(self.weights) or not self.wavelengths:
            raise ShapeError(
                f"got {len(self.wavelengths)} wavelengths and {len(self.weights)} weights, "
                "expected equal numbers, at least one"
            )
        if min(self.wavelengths) <= 0 or min(self.weights) < 0 or sum(self.weights) <= 0:
            raise ValueError(
                "wavelengths must be positive, weights not negative and not all zero: got "
                f"{self.wavelengths} m with weights {self.weights}"
            )
        total = sum(self.weights)
        object.__setattr__(self, "weights", tuple(w / total for w in self.weights))

    @classmethod
    def of(cls, wavelengths: Any, weights: Any = None) -> Bandpass:
        """A bandpass of one or several wavelengths (Quantity or m), by default of equal weights."""
        waves = np.atleast_1d(to_metres(wavelengths, "wavelength"))
        shares = np.ones(len(waves)) if weights is None else native_float64(weights)
        return cls(tuple(waves.tolist()), tuple(np.atleast_1d(shares).tolist()))

    def thinned(self, count: int) -> Bandpass:
        """A bandpass with `count` of these wavelengths, evenly spread, that have all weights."""
        total = len(self.wavelengths)
        if count >= total:
            return self
        order = np.argsort(self.wavelengths)
        if count == 1:
            middle = int(np.abs(np.array(self.wavelengths) - self.mean_wavelength).argmin())
            return Bandpass((self.wavelengths[middle],), (1.0,))
        indices = np.sort(order[np.round(np.linspace(0, total - 1, count)).astype(int)])
        nodes = np.array(self.wavelengths)[indices]
        ascending = np.argsort(nodes)
        # The weight of an omitted wavelength goes to its two neighbours as in linear interpolation,
        # which preserves integrals of functions that are linear between them.
        shares = [
            np.interp(self.wavelengths, nodes[ascending], unit[ascending]) for unit in np.eye(count)
        ]
        weights = np.array(shares) @ np.array(self.weights)
        return Bandpass(tuple(nodes.tolist()), tuple(weights.tolist()))

    def condensed(self, count: int) -> Bandpass:
        """A bandpass with the `count` nodes of a Gauss quadrature as wavelengths.

        Sums of polynomials in the wavelength up to the order 2 count - 1 stay the same. Broad-band
        images of a point source are ten times as accurate as with `thinned`, but the nodes are not
        among the wavelengths of this bandpass.
        """
        if count >= len(self.wavelengths):
            return self
        weights, wavelengths = np.array(self.weights), np.array(self.wavelengths)
        scale = math.sqrt(weights @ (wavelengths - self.mean_wavelength) ** 2)
        x = (wavelengths - self.mean_wavelength) / scale
        # G. H. Golub and J. H. Welsch, "Calculation of Gauss quadrature rules", Math. Comp. 23, 221
        # (1969). With <f> = sum of w f(x) and norm_k = <p_k^2>, the recurrence is
        #
        #     p_k+1 = (x - a_k) p_k - b_k^2 p_k-1,
        #     a_k = <x p_k^2> / norm_k,   b_k^2 = norm_k / norm_k-1.
        #
        # Nodes are the eigenvalues of the symmetric matrix with a_k on the diagonal and b_k beside
        # it, weights the squared first components of its eigenvectors.
        # Recurrence of the polynomials that are orthogonal under these weights.
        matrix = np.zeros((count, count))
        before, polynomial, norm = np.zeros_like(x), np.ones_like(x), 1.0
        for k in range(count):
            matrix[k, k] = weights @ (x * polynomial**2) / norm
            following = (x - matrix[k, k]) * polynomial
            if k:
                following -= matrix[k, k - 1] ** 2 * before
            before, polynomial = polynomial, following
            norm, last = weights @ polynomial**2, norm
            if k + 1 < count:
                matrix[k, k + 1] = matrix[k + 1, k] = math.sqrt(norm / last)
        nodes, vectors = np.linalg.eigh(matrix)
        nodes = self.mean_wavelength + scale * nodes
        return Bandpass(tuple(nodes.tolist()), tuple((vectors[0] ** 2).tolist()))

    @property
    def width(self) -> float:
        """Longest minus shortest wavelength, as a fraction of the mean."""
        return (max(self.wavelengths) - min(self.wavelengths)) / self.mean_wavelength

    @property
    def mean_wavelength(self) -> float:
        """Photon-weighted mean wavelength, m."""
        return float(np.dot(self.wavelengths, self.weights))
