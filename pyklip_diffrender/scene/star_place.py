"""Place of a star in an image behind a mask, to half a pixel."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

Image = NDArray[np.float64]

_FIELD_RADIUS_ARCSEC = 2.5
"""Radius, arcsec, of the square in which the star is looked for."""

_LEAST_FIELD_ARCSEC = 1.2
"""Radius below which a frame is too small to judge."""

_SKY_ARCSEC = 3.0
"""arcsec from the star beyond which the background is measured."""

_SKY_PIXELS = 2000
"""Least number of pixels for the background; with fewer, it is the faintest fifth of all."""

_RING_ARCSEC, _FEWEST_RING_PIXELS = 1.8, 300
"""Distance, arcsec, and number of pixels of a ring about the star, whose darkest quarter is no
darker than the background."""

_INNER_LIGHT_ARCSEC, _OUTER_LIGHT_ARCSEC, _CONCENTRATED_LIGHT_RATIO = 1.0, 2.0, 5.0
"""Ratio of the light within 1 arcsec and beyond 2 arcsec above which an image shows a star."""

_SEEN_PIXEL_SNR = 3.0
"""S/N of the pixels that are looked at."""

_PATTERN_ARCSEC = 1.2
"""Radius, arcsec, of the star's light in which other sources count little, see
`center_of_pattern`."""

_LIGHT_CENTRES_ARCSEC = 0.05
"""Difference, arcsec, between the centres of all light and of the light near the star beyond which
another source contributes to them."""

_STAR_OFFSET_ARCSEC = 0.5
"""Largest distance, arcsec, of a star from its stated place at which its light can be told from
another source's."""


def stamp_about(
    data: Image, error: Image, valid: NDArray[np.bool_], center: Image, pixelscale: float
) -> tuple[Image, Image, Image] | None:
    """Cut the square (n, n) about a star out of an image (ny, nx), without the background.

    `center` is x, y of the star, (2,), `pixelscale` in arcsec. The result has the image, the
    distances from its middle in arcsec, and the noise; n is odd. None for images that reach less
    than 1.2 arcsec from the star.
    """
    x, y = np.round(center).astype(int)
    ny, nx = data.shape
    reach = min(int(_FIELD_RADIUS_ARCSEC / pixelscale), x, y, nx - 1 - x, ny - 1 - y)
    if reach * pixelscale < _LEAST_FIELD_ARCSEC or not valid.any():
        return None
    window = np.s_[y - reach : y + reach + 1, x - reach : x + reach + 1]
    rows, columns = np.indices((2 * reach + 1, 2 * reach + 1)) - reach
    distance = np.hypot(rows, columns) * pixelscale
    all_rows, all_columns = np.indices(data.shape)
    outside = valid & (np.hypot(all_columns - x, all_rows - y) * pixelscale > _SKY_ARCSEC)
    sky = data[outside]
    if len(sky) <= _SKY_PIXELS:
        sky = np.sort(data[valid])[: valid.sum() // 5 + 1]
    # A nebula or a neighbour may be brighter elsewhere than about the star.
    ring = data[window][valid[window] & (distance > _RING_ARCSEC)]
    level = float(np.median(sky))
    if ring.size > _FEWEST_RING_PIXELS:
        level = min(level, float(np.quantile(ring, 0.25)))
    image = np.where(valid[window], data[window] - level, np.nan)
    # A pixel that is missing in the core would move the centre of symmetry.
    return without_gaps(image), distance, error[window]


def without_gaps(image: Image) -> Image:
    """Replace NaN by the mean of the neighbours, weighted by a Gaussian of a pixel; else 0."""
    # As astropy.convolution.interpolate_replace_nans, which warns of gaps wider than its kernel.
    known = np.isfinite(image)
    weight = gaussian_filter(known.astype(float), 1.0, mode="constant")
    total = gaussian_filter(np.where(known, image, 0.0), 1.0, mode="constant")
    return np.where(known, image, total / np.where(weight > 0, weight, 1.0))


def center_of_symmetry(image: Image) -> Image:
    """x, y from the middle, (2,), in pixels, of the point about which an image is most symmetric.

    The image is (n, n) with n odd; negative pixels count as 0. The point is good to a tenth of a
    pixel for stars on real frames.
    """
    # The convolution of the image with itself at 2 c, sum over x of f(x) f(2 c - x), compares it
    # with itself turned by 180 degrees about c; it is largest where these are most alike.
    # Zeros around the image, so that the convolution is not periodic.
    size = 2 * len(image)
    transform = np.fft.rfft2(np.maximum(image, 0.0), (size, size))
    own = np.fft.irfft2(transform**2, (size, size))
    row, column = np.unravel_index(int(own.argmax()), own.shape)
    column_peak = column + parabola_vertex(own[row], int(column))
    row_peak = row + parabola_vertex(own[:, column], int(row))
    return np.array([column_peak, row_peak]) / 2 - len(image) // 2


def parabola_vertex(values: Image, peak: int) -> float:
    """Vertex of the parabola through a maximum and its neighbours, relative to the maximum."""
    # Through three neighbours l, m, h it is (l - h) / 2 (l - 2 m + h) from the middle one.
    low, middle, high = values[[peak - 1, peak, (peak + 1) % len(values)]]
    curvature = low - 2 * middle + high
    return float(0.5 * (low - high) / curvature) if curvature < 0 else 0.0


def center_of_pattern(image: Image, distance: Image) -> Image:
    """x, y from the middle, (2,), in pixels, of a star's pattern that another source may outshine.

    `image` and `distance` are (n, n), see `stamp_about`; pixels without a signal are 0.
    """
    # Square roots, within 1.2 arcsec of the middle: a point source is then a small part of the
    # light, and the star's pattern, which fills the field, most of it.
    near = np.where(distance < _PATTERN_ARCSEC, image, 0.0)
    return center_of_symmetry(np.sqrt(np.maximum(near, 0.0)))


def measured_offset(
    data: Image, error: Image, valid: NDArray[np.bool_], center: Image, pixelscale: float
) -> Image | None:
    """Offset of a star from its stated place, x, y in pixels, (2,); see `stamp_about`.

    None if the image is too small, shows no star, or also shows another source whose light cannot
    be told from the star's.
    """
    stamp = stamp_about(data, error, valid, center, pixelscale)
    if stamp is None:
        return None
    image, distance, noise = stamp
    inside, outside = image[distance < _INNER_LIGHT_ARCSEC], image[distance > _OUTER_LIGHT_ARCSEC]
    if not (inside.size and outside.size):
        return None
    if inside.mean() < _CONCENTRATED_LIGHT_RATIO * np.abs(outside.mean()):
        return None
    bright = np.where(image > _SEEN_PIXEL_SNR * noise, image, 0.0)
    if np.count_nonzero(bright) < 10:
        return None
    away = center_of_symmetry(bright)
    if np.hypot(*away) * pixelscale > _STAR_OFFSET_ARCSEC:
        return None
    rows, columns = np.indices(image.shape) - len(image) // 2
    about = np.hypot(columns - away[0], rows - away[1]) * pixelscale
    if np.hypot(*(center_of_pattern(bright, about) - away)) * pixelscale > _LIGHT_CENTRES_ARCSEC:
        return None
    # `stamp_about` has the nearest whole pixel in its middle.
    return np.asarray(np.round(center) + away - center)
