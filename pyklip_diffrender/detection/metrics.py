"""Figures of merit of a star-subtracted image.

Apertures consist of the whole pixels whose centres are inside or on the edge. Positions are x, y in
pixels, with (0, 0) at the centre of the first pixel.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from photutils.aperture import CircularAnnulus, CircularAperture

Image = NDArray[np.float64]
Position = tuple[float, float]


def _circle(position: Position, radius: float) -> CircularAperture:
    # Imported where it is used, because reductions, which do not need it, start sooner.
    from photutils.aperture import CircularAperture

    # photutils leaves out centres that lie exactly on an outer edge.
    return CircularAperture(position, np.nextafter(radius, np.inf))


def _ring(center: Position, inner: float, outer: float) -> CircularAperture | CircularAnnulus:
    from photutils.aperture import CircularAnnulus

    if inner <= 0:  # photutils has no annulus without a hole.
        return _circle(center, outer)
    return CircularAnnulus(center, inner, np.nextafter(outer, np.inf))


def _inside(aperture: Any, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Mask of the pixels of an image that are in an aperture."""
    inside = aperture.to_mask(method="center").to_image(shape)
    return np.zeros(shape, dtype=bool) if inside is None else inside > 0


def annulus_snr(
    image: Image,
    position: Position,
    center: Position,
    radius: float = 1.5,
    half_width: float = 1.5,
) -> float:
    """Signal in an aperture over the scatter of the annulus around the star, the paper's SNR.

    Parameters
    ----------
    image : ndarray, (ny, nx)
        Star-subtracted. Pixels that are not finite are left out.
    position : tuple of float
        x, y of the planet, pixels.
    center : tuple of float
        x, y of the star.
    radius : float
        Radius of the aperture about the planet, pixels.
    half_width : float
        Half of the width of the annulus about the star, pixels.

    Returns
    -------
    float
        (mean in the aperture - mean of the annulus) / (standard deviation of the annulus's
        pixels / sqrt(pixels in the aperture)), where the annulus excludes the aperture. The paper
        compares methods by it. It is not a significance: the light of a bright planet outside the
        aperture counts as scatter, so that the value saturates near 30, and lost planet light
        (see `throughput`) has no effect on it.
    """
    from photutils.aperture import ApertureStats

    circle = _circle(position, radius)
    separation = math.dist(position, center)
    ring = _ring(center, separation - half_width, separation + half_width)
    planet = ApertureStats(image, circle, sum_method="center")
    around = ApertureStats(image, ring, mask=_inside(circle, image.shape), sum_method="center")
    signal = planet.mean - around.mean
    return float(signal / around.std * np.sqrt(planet.center_aper_area.value))


def throughput(
    image: Image,
    planet: Image,
    noise: Image,
    position: Position,
    radius: float = 3.0,
) -> float:
    """Fraction of a known planet's light that a subtraction retained, by a matched filter.

    Parameters
    ----------
    image : ndarray, (ny, nx)
        Star-subtracted, with the planet. Pixels that are not finite are left out.
    planet : ndarray, (ny, nx)
        Image of the planet alone.
    noise : ndarray, (ny, nx)
        Standard deviation of every pixel.
    position : tuple of float
        x, y of the planet.
    radius : float
        Pixels taken about the planet.
    """
    close = _inside(_circle(position, radius), image.shape) & np.isfinite(image)
    weight = planet[close] / noise[close] ** 2
    return float((weight * image[close]).sum() / (weight * planet[close]).sum())


def star_model_error(
    model: Image,
    truth: Image,
    noise: Image,
    center: Position,
    inner: float,
    outer: float,
) -> float:
    """Rms of (model - true star) / noise over an annulus between two radii in pixels."""
    ring = _inside(_ring(center, inner, outer), truth.shape)
    return float(np.sqrt(np.mean(((model - truth) / noise)[ring] ** 2)))
