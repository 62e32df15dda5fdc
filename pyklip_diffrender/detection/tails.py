"""Tails of the normal and of Student's t distribution, and their inverses.

They are from `scipy.special`, because `scipy.stats` takes long to import.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import special

Image = NDArray[np.float64]


def gaussian_tail(sigmas: ArrayLike) -> Image:
    """Probability that Gaussian noise exceeds a number of standard deviations."""
    return np.asarray(special.ndtr(-np.asarray(sigmas, dtype=float)))


def gaussian_sigmas(probability: ArrayLike) -> Image:
    """Standard deviations that Gaussian noise exceeds with a probability."""
    return np.asarray(-special.ndtri(probability))


def student_tail(snr: ArrayLike, freedom: ArrayLike) -> Image:
    """Probability that Student's t of some degrees of freedom exceeds an S/N."""
    return np.asarray(special.stdtr(freedom, -np.asarray(snr, dtype=float)))


def student_snr(sigmas: ArrayLike, freedom: ArrayLike) -> Image:
    """S/N that Student's t exceeds as rarely as Gaussian noise exceeds `sigmas`."""
    return np.asarray(-special.stdtrit(freedom, gaussian_tail(sigmas)))
