"""Judge frames by their pixels: a star behind the mask, as bright as in the other frames.

Headers may be wrong, or say too little. What is tested here takes a tenth of a second, and decides
nothing that a fit could decide better: only what is wrong by a factor, or by much more than the
pointing of the telescope.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from astropy import units as u
from astropy.stats import mad_std
from numpy.typing import NDArray
from scipy.ndimage import convolve, gaussian_filter, map_coordinates, shift, uniform_filter

from pyklip_diffrender.errors import DiffrenderError
from pyklip_diffrender.scene.integrations import NEIGHBOURS, dark_pixels
from pyklip_diffrender.scene.observation import Observation
from pyklip_diffrender.scene.simulation import images_of_stars
from pyklip_diffrender.scene.star_place import (
    center_of_pattern,
    center_of_symmetry,
    parabola_vertex,
    stamp_about,
)

Image = NDArray[np.float64]

_CORE_ARCSEC = 1.0
"""Radius, arcsec, in which the light of a star behind a mask is summed."""

_EDGE_ARCSEC = 0.2
"""Half of the width, arcsec, of the edge of the circle in which light is summed."""

_SYMMETRY_OFFSET_ARCSEC = 0.5
"""Largest distance, arcsec, of the pattern's centre of symmetry from where the star should be. This
is measured to half a pixel; stars are put behind the mask to .02 arcsec, and headers may be wrong
by a few pixels. Half of a star's light passes a mask at 0.4 to 0.8 arcsec from its centre."""

_PATTERN_OFFSET_ARCSEC = 0.25
"""Largest distance, arcsec, of the centre of the star's pattern, see `center_of_pattern`, from
where the star should be. The distance was at most 0.06 with sources that leave the pattern visible,
and 0.33 to 0.6 for real frames moved by 24 pixels, of which the field contains a part."""

_OTHER_SOURCE_FROM_ARCSEC = 0.35
"""Distance, arcsec, from the star beyond which another source is looked for."""

_POINT_SOURCE_ARCSEC = 0.8
"""Radius, arcsec, in which light is compared with the image of a point source."""

_POINT_SOURCE_CORRELATION = 0.79
"""Least correlation of the square roots of light and point source. The correlation was 0.88 to 0.98
for sources that hide the star in real frames, and at most 0.75 for stars behind the mask."""

_SYMMETRIC_LIGHT_SHARE = 0.7
"""Share of the light of a point source that is symmetric about it, as far as it is used."""

_STAR_LIKE_CONTRAST = 0.12
"""Contrast above which a source that hides the star is taken for the star itself. The contrast was
at most 0.1 for sources of 0.1 beside real stars, and 0.14 or more for a star 1.5 arcsec off the
mask; a displacement of 1.2 arcsec and less cannot be told from such a source."""

_JUDGED_RADIUS_ARCSEC, _VALID_PIXELS_SHARE = 2.0, 0.75
"""Radius, arcsec, and the least share of valid pixels within it. The share is 0.999 in real frames,
and 0.5 after a Fourier shift of errors with an outlier, which rings through the whole frame."""

_POSITIVE_LIGHT_SHARE = 0.5
"""Least share of light that is positive: 1 for a star, 0 where it was subtracted."""

_BRIGHTNESS_RATIO = 1.5
"""Ratio of brightness between frames of one star that has another cause than the star's position
behind the mask. The ratio of rolls was at most 1.05 for the real stars at hand."""

_FEWEST_PIXELS = 2000
"""Least number of pixels for a scatter."""

_NOISE_FROM_ARCSEC = 3.0
"""arcsec from the star beyond which pixels show mostly noise."""

_PLAUSIBLE_SCATTER_MJY_SR = (1e-3, 20.0)
"""Plausible scatter far from the star, MJy/sr, for exposures of a second to a day."""

_COMPARED_SPECKLES_ARCSEC = 1.5
"""Radius, arcsec, in which the diffraction patterns of frames are compared."""

_TURNED_GAIN = 0.1
"""Gain in correlation above which frames are not of one orientation. Real frames of one filter
correlate by 0.99, mirrored or turned ones by 0.2 to 0.7."""

_SINGLE_SOURCE_ARCSEC = 0.15
"""Distance, arcsec, between the centres of all light and of the star's pattern beyond which another
source contributes to the light."""

_ALIKE_CORRELATION = 0.8
"""Least correlation of a pattern with another when it is turned back."""

_SYMMETRIES: dict[str, Callable[[Image], Image]] = {
    "mirrored left to right": lambda image: image[:, ::-1],
    "mirrored upside down": lambda image: image[::-1],
    "turned by 180 degrees": lambda image: image[::-1, ::-1],
    "turned by 90 degrees": np.rot90,
    "turned by 270 degrees": lambda image: np.rot90(image, 3),
    "transposed": np.transpose,
    "transposed and turned by 180 degrees": lambda image: image[::-1, ::-1].T,
}


def why_few_pixels(observation: Observation) -> str:
    """Why the pixels about the star's position say nothing about the star; empty if they do."""
    ny, nx = observation.shape
    x, y = observation.mean_center
    if not (-0.5 <= x < nx - 0.5 and -0.5 <= y < ny - 0.5):
        return (
            f"the star's position, pixel ({x:.1f}, {y:.1f}) from 0, is not in the frame of {nx} x "
            f"{ny} pixels: CRPIX or STARCEN is wrong, or the star was cut off"
        )
    share = float(_mean(observation)[2][_distance(observation) < _JUDGED_RADIUS_ARCSEC].mean())
    if share >= _VALID_PIXELS_SHARE:
        return ""
    return (
        f"{share:.0%} of the pixels within {_JUDGED_RADIUS_ARCSEC:g} arcsec of the star are valid, "
        f"expected {_VALID_PIXELS_SHARE:.0%} or more: the others are flagged in DQ, not finite, or "
        "have an ERR that is not positive. A shift by Fourier transform spreads NaN, and an "
        "outlier of ERR, over the frame; use the file from before the shift (calints)"
    )


def not_judged(observation: Observation) -> str:
    """Remark on frames that are too small to judge, see `why_no_star`; empty for others."""
    if _stamp(observation) is not None:
        return ""
    return (
        "the frame reaches less than 1.2 arcsec from the star: whether a star is there, and how "
        "bright it is, was not checked"
    )


def why_no_star(observation: Observation) -> str:
    """Why these cannot be frames of a star behind the mask; empty if they can.

    Frames are compared with the model where another source hides the star. Frames that are too
    small (1.2 arcsec about the star) are not judged.
    """
    stamp = _stamp(observation)
    if stamp is None:
        return ""
    image, distance, noise = stamp
    core = distance < _CORE_ARCSEC
    bright = np.abs(image) > 3 * noise
    if np.count_nonzero(bright & core) < 10:
        return (
            f"no light of a star within {_CORE_ARCSEC:g} arcsec of where the header has the star: "
            "the position (CRPIX or STARCEN) is wrong, the star is not behind the mask, or the "
            f"exposure is too short. {_INSIST}"
        )
    light = np.where(bright, image, 0.0)
    share = float(light[core].sum() / np.abs(light[core]).sum())
    if share < _POSITIVE_LIGHT_SHARE:
        return (
            f"the light around the star's position is as much negative as positive ({share:.0%} "
            "remain): the star was subtracted, or the background was subtracted with a neighbour "
            f"in it. Use frames before the subtraction (calints). {_INSIST}"
        )
    # The diffraction pattern of a star is nearly symmetric about the star. Where another source is
    # so bright that the centre of all light is elsewhere, the pattern about the star's position
    # decides, in which a point source is a small part. Where the source hides the pattern, too, it
    # is compared with the model's image of a point source. What does not look like one is a star's
    # pattern in the wrong place. A source is the star itself, off the mask, if there is less light
    # behind the mask than a star ten times as bright as the source would leave there.
    scale = observation.pixelscale
    away = center_of_symmetry(light) * scale
    if np.hypot(*away) <= _SYMMETRY_OFFSET_ARCSEC:
        return ""
    if np.hypot(*(center_of_pattern(light, distance) * scale)) <= _PATTERN_OFFSET_ARCSEC:
        return ""
    contrast = _contrast_of_source(observation)
    if contrast < _STAR_LIKE_CONTRAST:
        return ""
    x, y = away
    what = (
        "does not look like a star's companion or neighbour"
        if np.isinf(contrast)
        else f"would be a source of at least {contrast:.2g} times the flux of a star there"
    )
    return (
        f"its light is centred {np.hypot(x, y):.1f} arcsec from the star's position ({x:+.1f} "
        f"in x, {y:+.1f} in y), expected less than {_SYMMETRY_OFFSET_ARCSEC:g}, and {what}: the "
        "position (CRPIX or STARCEN) is wrong, the star is not behind the mask, or something "
        f"brighter than the star behind the mask (a star, a galaxy) is in the field. {_INSIST}"
    )


_INSIST = (
    "Look at the frames. If the star is behind the mask, give its place in the file with the "
    "option star, x and y in pixels from 0"
)


def _contrast_of_source(observation: Observation) -> float:
    """Least contrast of the brightest point source beside the star; infinite if it is not one."""
    try:
        star, source = images_of_stars(observation, _CORE_ARCSEC, _POINT_SOURCE_ARCSEC)
    except DiffrenderError:
        return np.inf
    scale = float(np.mean(observation.pixelscale))
    data, _, valid = _mean(observation)
    image = np.where(valid, data - float(np.quantile(data[valid], 0.25)), 0.0)
    rows, columns = np.indices(image.shape)
    distance = _distance(observation)
    outside = distance > _OTHER_SOURCE_FROM_ARCSEC
    peak = _peak(np.where(outside, gaussian_filter(image, 1.0), -np.inf))
    if _likeness(image, peak, source, _peak(source), scale) < _POINT_SOURCE_CORRELATION:
        return np.inf
    # A point source is symmetric about its peak, other light need not be: the smaller one of two
    # opposite pixels has what the source may account for.
    mirrored = map_coordinates(
        image, [2 * peak[1] - rows, 2 * peak[0] - columns], order=1, mode="constant"
    )
    symmetric = np.clip(np.minimum(image, mirrored), 0.0, None)
    # What may be light of the star: the model of the source's wings is not perfect.
    left = uniform_filter(image - _SYMMETRIC_LIGHT_SHARE * symmetric, 3)
    behind = distance < _SYMMETRY_OFFSET_ARCSEC / 2
    # Fluxes in units of the model's star: at most `most` for the star behind the mask, `flux` for
    # the source outside it.
    most = max(float(left[behind].max()), 0.0) / float(uniform_filter(star, 3).max())
    own = float(uniform_filter(image, 3)[tuple(np.round(peak[::-1]).astype(int))])
    flux = own / float(uniform_filter(source, 3).max())
    return flux / most if most > 0 else np.inf


def _peak(image: Image) -> Image:
    """x, y of the brightest pixel, to a fraction of a pixel where it is not at the edge."""
    row, column = np.unravel_index(int(image.argmax()), image.shape)
    place = np.array([column, row], dtype=float)
    for axis, (values, k) in enumerate(((image[row], column), (image[:, column], row))):
        if 0 < k < len(values) - 1 and np.isfinite(values[k - 1 : k + 2]).all():
            place[axis] += parabola_vertex(values, int(k))
    return place


def _likeness(image: Image, place: Image, other: Image, there: Image, scale: float) -> float:
    """Correlation of the square roots of two images about two points, within 0.8 arcsec."""
    reach = int(_POINT_SOURCE_ARCSEC / scale)
    rows, columns = np.indices((2 * reach + 1, 2 * reach + 1)) - reach
    disk = np.hypot(rows, columns) <= reach
    roots = [
        np.sqrt(np.maximum(map_coordinates(
            values, [y + rows[disk], x + columns[disk]], order=1, mode="nearest"
        ), 0.0))
        for values, (x, y) in ((image, place), (other, there))
    ]  # fmt: skip
    return float(np.corrcoef(*roots)[0, 1]) if np.ptp(roots[0]) > 0 else 0.0


def brightness(observation: Observation) -> float:
    """Light within 1 arcsec of the star, in the frames' unit; NaN for frames that are too small."""
    stamp = _stamp(observation)
    if stamp is None:
        return np.nan
    # The edge is soft and moves with the star by fractions of a pixel, so that a neighbour on it
    # counts alike in all rolls.
    image = stamp[0]
    center = observation.mean_center
    x, y = center - np.round(center)
    rows, columns = np.indices(image.shape) - len(image) // 2
    distance = np.hypot(columns - x, rows - y) * float(np.mean(observation.pixelscale))
    weight = np.clip((_CORE_ARCSEC + _EDGE_ARCSEC - distance) / (2 * _EDGE_ARCSEC), 0.0, 1.0)
    return float((image * weight).sum())


def why_other_brightness(observations: Sequence[Observation]) -> dict[int, str]:
    """Find frames of a star, in one set-up, that are much brighter or fainter than the others.

    The result has reasons by index. Where half of the frames or more have one, nothing says which
    are right.
    """
    light = np.array([brightness(each) for each in observations])
    known = np.flatnonzero(np.isfinite(light) & (light > 0))
    reasons: dict[int, str] = {}
    if len(known) < 2:
        return reasons
    middle = float(np.median(light[known]))
    for k in known:
        # Of two, each is compared with the other.
        other = middle if len(known) > 2 else float(light[known].sum() - light[k])
        ratio = float(light[k]) / other
        if not 1 / _BRIGHTNESS_RATIO < ratio < _BRIGHTNESS_RATIO:
            reasons[int(k)] = (
                f"its star is {ratio:.3g} times as bright as in the other frames of the star. A "
                "unit (BUNIT) or a factor is probably wrong, or the star is not behind the mask"
            )
    return reasons


def why_turned(observations: Sequence[Observation]) -> dict[int, str]:
    """Find frames of one set-up whose pixels are mirrored or turned, unlike most other frames.

    The result has reasons by index. Where half of the frames or more have one, nothing says which
    are right. Frames that are too small, or that show another source as bright as the star behind
    the mask, which turns with the sky, are not compared.
    """
    # The telescope, and with it the star's diffraction pattern, has one orientation on the
    # detector.
    patterns = {k: each for k, each in enumerate(map(_pattern, observations)) if each is not None}
    different: dict[int, list[str]] = {k: [] for k in patterns}
    for k, pattern in patterns.items():
        for j in patterns:
            operation = _turn(pattern, patterns[j])
            if j != k and operation:
                different[k].append(operation)
    return {
        k: f"its pixels are {operations[0]}: once this is undone, the star's diffraction pattern "
        "is as in the other frames. Use the file as MAST delivers it"
        for k, operations in different.items()
        if 2 * len(operations) > len(patterns) - 1
    }


def _pattern(observation: Observation) -> Image | None:
    """Square root of the image with the star in the middle."""
    stamp = _stamp(observation)
    if stamp is None:
        return None
    image, _, noise = stamp
    scale = float(np.mean(observation.pixelscale))
    light = np.where(np.abs(image) > 3 * noise, image, 0.0)
    x, y = center_of_symmetry(light)
    if np.hypot(x, y) * scale > _SYMMETRY_OFFSET_ARCSEC:
        return None
    rows, columns = np.indices(image.shape) - len(image) // 2
    about = center_of_pattern(light, np.hypot(columns - x, rows - y) * scale)
    if np.hypot(*(about - (x, y))) * scale > _SINGLE_SOURCE_ARCSEC:
        return None
    image = shift(image, (-y, -x), order=1)
    reach, middle = int(_COMPARED_SPECKLES_ARCSEC / scale), len(image) // 2
    window = slice(max(middle - reach, 0), middle + reach + 1)
    image = image[window, window]
    return np.sign(image) * np.sqrt(np.abs(image))


def _turn(pattern: Image, other: Image) -> str:
    """Rotation or flip that takes one pattern to the other, in words; empty for none."""
    if pattern.shape != other.shape:
        return ""

    def likeness(image: Image) -> float:
        return float(np.corrcoef(image.ravel(), other.ravel())[0, 1])

    likenesses = {name: likeness(undo(pattern)) for name, undo in _SYMMETRIES.items()}
    best = max(likenesses, key=lambda name: likenesses[name])
    least = max(_ALIKE_CORRELATION, likeness(pattern) + _TURNED_GAIN)
    return best if likenesses[best] > least else ""


def why_odd_unit(observation: Observation) -> str:
    """Why frames cannot be in the unit that they state; empty if they can.

    Only frames in MJy/sr with 2000 pixels far from the star are judged.
    """
    data, _, valid = _mean(observation)
    usable = valid & (_distance(observation) > _NOISE_FROM_ARCSEC)
    if usable.sum() < _FEWEST_PIXELS or observation.unit != u.MJy / u.sr:
        return ""
    dark = dark_pixels(data, usable)
    difference = data - convolve(data, NEIGHBOURS, mode="nearest")
    # A pixel less the mean of four has the variance 1 + 1/4.
    scatter = float(mad_std(difference[dark])) / 1.25**0.5
    low, high = _PLAUSIBLE_SCATTER_MJY_SR
    if low < scatter < high:
        return ""
    return (
        f"far from the star, where the frame is darkest, its pixels scatter by {scatter:.2g} "
        f"MJy/sr, expected {low:g} to {high:g}. BUNIT is probably wrong, the pixels were "
        "multiplied by a factor, or a crowded field or a nebula leaves no dark part of the frame"
    )


def _mean(observation: Observation) -> tuple[Image, Image, NDArray[np.bool_]]:
    combined = observation if len(observation) == 1 else observation.combined()
    return combined.data[0], combined.error[0], combined.valid[0]


def _distance(observation: Observation) -> Image:
    """Distances of pixels from the star, (ny, nx), arcsec."""
    rows, columns = np.indices(observation.shape)
    x, y = observation.mean_center
    return np.asarray(np.hypot(columns - x, rows - y) * float(np.mean(observation.pixelscale)))


def _stamp(observation: Observation) -> tuple[Image, Image, Image] | None:
    """Image about the star, distances from it (arcsec), and noise; None for small frames."""
    data, error, valid = _mean(observation)
    return stamp_about(
        data, error, valid, observation.mean_center, float(np.mean(observation.pixelscale))
    )
