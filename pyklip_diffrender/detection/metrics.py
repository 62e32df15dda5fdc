"""Figures of merit on a subtracted image, as the paper and as statisticians define them."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

__all__ = ["annulus_snr", "aperture_sum", "psnr", "star_model_error", "throughput"]

Image = NDArray[np.float64]


def _distance(shape: tuple[int, ...], position: tuple[float, float]) -> Image:
    y, x = np.indices(shape)
    return np.hypot(x - position[0], y - position[1])


def aperture_sum(image: Image, position: tuple[float, float], radius: float) -> float:
    """Sum over the pixels whose centres lie within `radius` pixels of `position` (x, y)."""
    return float(image[_distance(image.shape, position) <= radius].sum())


def annulus_snr(
    image: Image,
    position: tuple[float, float],
    center: tuple[float, float],
    radius: float = 1.5,
    half_width: float = 1.5,
) -> float:
    """Signal in an aperture over the scatter of the annulus around the star, the paper's SNR.

    Parameters
    ----------
    image : ndarray, (ny, nx)
        Star-subtracted.
    position : tuple of float
        x, y of the planet, pixels.
    center : tuple of float
        x, y of the star.
    radius : float
        Of the aperture about the planet, pixels.
    half_width : float
        Of the annulus about the star, pixels.

    Returns
    -------
    float
        (mean in the aperture - mean of the annulus) / (standard deviation of the annulus's
        pixels / sqrt(pixels in the aperture)); the annulus leaves the aperture out. The paper
        compares methods by it. It is no significance: light of a bright planet outside the
        aperture counts as scatter, so that it saturates near 30, and it knows nothing of lost
        planet light (see `throughput`).
    """
    near = (_distance(image.shape, position) <= radius) & np.isfinite(image)
    separation = math.dist(position, center)
    ring = np.abs(_distance(image.shape, center) - separation) <= half_width
    background = image[ring & ~near & np.isfinite(image)]
    signal = image[near].mean() - background.mean()
    return float(signal / background.std() * math.sqrt(near.sum()))


def throughput(
    image: Image,
    planet: Image,
    noise: Image,
    position: tuple[float, float],
    radius: float = 3.0,
) -> float:
    """Share of a known planet that a subtraction kept: its matched-filter amplitude.

    Parameters
    ----------
    image : ndarray
        Star-subtracted, with the planet.
    planet : ndarray
        What the planet alone would look like.
    noise : ndarray
        Standard deviation of every pixel.
    position : tuple of float
        x, y of the planet.
    radius : float
        Pixels taken about the planet.
    """
    near = (_distance(image.shape, position) <= radius) & np.isfinite(image)
    weight = planet[near] / noise[near] ** 2
    return float((weight * image[near]).sum() / (weight * planet[near]).sum())


def star_model_error(
    model: Image,
    truth: Image,
    noise: Image,
    center: tuple[float, float],
    inner: float,
    outer: float,
) -> float:
    """Rms of (model - true star) / noise over an annulus between two radii in pixels."""
    distance = _distance(truth.shape, center)
    ring = (distance >= inner) & (distance <= outer)
    return float(np.sqrt(np.mean(((model - truth) / noise)[ring] ** 2)))


def psnr(image: Image, reference: Image, position: tuple[float, float], size: int = 11) -> float:
    """Peak signal-to-noise ratio in dB over `size` x `size` pixels about `position` (x, y)."""
    x, y = (round(c - (size - 1) / 2) for c in position)
    window = (slice(max(y, 0), y + size), slice(max(x, 0), x + size))
    error = float(np.mean((image[window] - reference[window]) ** 2))
    if error == 0:
        return math.inf
    return 10 * math.log10(float(reference[window].max()) ** 2 / error)
