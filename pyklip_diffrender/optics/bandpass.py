"""A set of wavelengths and their weights."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pyklip_diffrender.errors import ShapeError

__all__ = ["Bandpass"]


@dataclass(frozen=True)
class Bandpass:
    """A set of wavelengths with weights that sum to 1.

    Attributes
    ----------
    wavelengths : tuple of float
        m.
    weights : tuple of float
        Fraction of the detected photons at each wavelength.
    """

    wavelengths: tuple[float, ...]
    weights: tuple[float, ...]

    def __post_init__(self) -> None:
        if len(self.wavelengths) != len(self.weights) or not self.wavelengths:
            raise ShapeError(
                f"got {len(self.wavelengths)} wavelengths and {len(self.weights)} weights, "
                "expected as many of one as of the other, and at least one"
            )
        if min(self.wavelengths) <= 0 or min(self.weights) < 0 or sum(self.weights) <= 0:
            raise ValueError(
                "wavelengths must be positive, weights not negative and not all zero: got "
                f"{self.wavelengths} m with weights {self.weights}"
            )
        total = sum(self.weights)
        object.__setattr__(self, "weights", tuple(w / total for w in self.weights))

    @property
    def mean_wavelength(self) -> float:
        """Photon-weighted mean wavelength, m."""
        return float(np.dot(self.wavelengths, self.weights))
