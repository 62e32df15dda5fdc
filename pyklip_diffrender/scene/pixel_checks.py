"""Judge frames by their pixels: a star behind the mask, as bright as in the other frames.

Headers may be wrong, or say too little. What is tested here takes a tenth of a second, and decides
nothing that a fit could decide better: only what is wrong by a factor, or by much more than the
pointing of the telescope.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from astropy import units as u
from numpy.typing import NDArray
from scipy.ndimage import convolve, shift
from scipy.stats import median_abs_deviation

from pyklip_diffrender.scene.observation import Observation
from pyklip_diffrender.scene.star_place import center_of_symmetry, stamp_about

__all__ = [
    "brightness",
    "copies",
    "why_no_star",
    "why_odd_unit",
    "why_other_brightness",
    "why_turned",
]

Image = NDArray[np.float64]

_CORE = 1.0
"""Radius, arcsec, in which the light of a star behind a mask is summed."""

_BEHIND = 0.5
"""Largest distance, arcsec, of the pattern's centre of symmetry from where the star should be. It
is measured to half a pixel; stars are put behind the mask to .02 arcsec, and headers may be wrong
by a few pixels. Half of a star's light passes a mask at 0.4 to 0.8 arcsec from its centre."""

_POSITIVE = 0.5
"""Least share of light that is positive: 1 for a star, 0 where it was subtracted."""

_FACTOR = 1.5
"""Ratio of brightness between frames of one star that has another cause than the star's position
behind the mask. The ratio of rolls was at most 1.05 for the real stars at hand."""

_COPY = 0.95
"""Correlation of the noise of two frames above which they are one. Flat-field errors correlate the
frames of different stars by up to 0.6."""

_ENOUGH = 2000
"""Least number of pixels for a correlation or a scatter."""

_FAR = 3.0
"""arcsec from the star beyond which pixels show mostly noise."""

_SCATTER = (1e-3, 20.0)
"""Plausible scatter far from the star, MJy/sr, for exposures of a second to a day."""

_SPECKLES = 1.5
"""Radius, arcsec, in which the diffraction patterns of frames are compared."""

_TURNED = 0.1
"""Gain in correlation above which frames are not of one orientation. Real frames of one filter
correlate by 0.99, mirrored or turned ones by 0.2 to 0.7."""

_ALIKE = 0.8
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

_NEIGHBOURS = np.array([[0, 1, 0], [1, 0, 1], [0, 1, 0]]) / 4.0


def why_no_star(observation: Observation) -> str:
    """Why these cannot be frames of a star behind the mask; empty if they can.

    The diffraction pattern of a star is nearly symmetric about the star, see
    `pyklip_diffrender.scene.star_place.center_of_symmetry`.

    Parameters
    ----------
    observation : Observation
        Frames that are too small (1.2 arcsec about the star) are not judged.
    """
    stamp = _stamp(observation)
    if stamp is None:
        return ""
    image, distance, noise = stamp
    core = distance < _CORE
    bright = np.abs(image) > 3 * noise
    if np.count_nonzero(bright & core) < 10:
        return (
            f"no light of a star within {_CORE:g} arcsec of where the header has the star (CRPIX "
            "or STARCEN). Look at the frames, and correct the position"
        )
    light = np.where(bright, image, 0.0)
    share = float(light[core].sum() / np.abs(light[core]).sum())
    if share < _POSITIVE:
        return (
            f"the light around the star's position is as much negative as positive ({share:.0%} "
            "remain): the star was subtracted. Use frames before the subtraction (calints)"
        )
    away = center_of_symmetry(light)
    x, y = away * observation.pixelscale
    if np.hypot(x, y) > _BEHIND:
        return (
            f"its light is centred {np.hypot(x, y):.1f} arcsec from the star's position ({x:+.1f} "
            f"in x, {y:+.1f} in y), expected less than {_BEHIND:g}: the star is not behind the "
            "mask, or the position (CRPIX or STARCEN) is wrong"
        )
    return ""


def brightness(observation: Observation) -> float:
    """Light within 1 arcsec of the star, in the frames' unit; NaN for frames that are too small."""
    stamp = _stamp(observation)
    return np.nan if stamp is None else float(stamp[0][stamp[1] < _CORE].sum())


def why_other_brightness(observations: Sequence[Observation]) -> dict[int, str]:
    """Find frames of a star that are much brighter or fainter than the others.

    Parameters
    ----------
    observations : sequence of Observation
        Of one star and set-up.

    Returns
    -------
    dict of int to str
        Reason by index. Where half of the frames or more have one, nothing says which are right.
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
        if not 1 / _FACTOR < ratio < _FACTOR:
            reasons[int(k)] = (
                f"its star is {ratio:.3g} times as bright as in the other frames of the star. A "
                "unit (BUNIT) or a factor is probably wrong, or the star is not behind the mask"
            )
    return reasons


def why_turned(observations: Sequence[Observation]) -> dict[int, str]:
    """Find frames whose pixels are mirrored or turned, unlike those of most others.

    The telescope, and with it the star's diffraction pattern, has one orientation on the detector.

    Parameters
    ----------
    observations : sequence of Observation
        Of one set-up. Frames that are too small are not compared.

    Returns
    -------
    dict of int to str
        Reason by index. Where half of the frames or more have one, nothing says which are right.
    """
    patterns = {k: each for k, each in enumerate(map(_pattern, observations)) if each is not None}
    different: dict[int, list[str]] = {k: [] for k in patterns}
    for k, pattern in patterns.items():
        for j in patterns:
            operation = _turn(pattern, patterns[j])
            if j != k and operation:
                different[k].append(operation)
    return {
        k: f"its pixels are {operations[0]}: the diffraction pattern of the star is that of the "
        "other frames when this is undone. Use the file as MAST delivers it"
        for k, operations in different.items()
        if 2 * len(operations) > len(patterns) - 1
    }


def _pattern(observation: Observation) -> Image | None:
    """Square root of the image with the star in the middle."""
    stamp = _stamp(observation)
    if stamp is None:
        return None
    image, _, noise = stamp
    x, y = center_of_symmetry(np.where(np.abs(image) > 3 * noise, image, 0.0))
    image = shift(image, (-y, -x), order=1)
    reach, middle = int(_SPECKLES / np.mean(observation.pixelscale)), len(image) // 2
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
    return best if likenesses[best] > max(_ALIKE, likeness(pattern) + _TURNED) else ""


def why_odd_unit(observation: Observation) -> str:
    """Why frames cannot be in the unit that they state; empty if they can.

    Parameters
    ----------
    observation : Observation
        Only frames in MJy/sr with 2000 pixels far from the star are judged.
    """
    difference, usable = _noise(observation, clipped=False)
    if usable.sum() < _ENOUGH or observation.unit != u.MJy / u.sr:
        return ""
    # A pixel less the mean of four.
    scatter = float(median_abs_deviation(difference[usable], scale="normal")) / 1.25**0.5
    low, high = _SCATTER
    if low < scatter < high:
        return ""
    return (
        f"far from the star its pixels scatter by {scatter:.2g} MJy/sr, expected {low:g} to "
        f"{high:g}. BUNIT is probably wrong, or the pixels were multiplied by a factor"
    )


def copies(observations: Sequence[Observation]) -> dict[int, int]:
    """Find observations that show the same pixels as an earlier one, whatever their headers say.

    Noise far from the star is compared, so that copies in another unit, or with a few other pixels,
    are seen as such. Frames with fewer than 2000 pixels of noise are not compared.

    Returns
    -------
    dict of int to int
        Index of the copy, and of what it is a copy of.
    """
    noise = [_noise(each) for each in observations]
    result: dict[int, int] = {}
    for k, (values, usable) in enumerate(noise):
        for j in range(k):
            others, too = noise[j]
            if j in result or others.shape != values.shape:
                continue
            both = usable & too
            if both.sum() < _ENOUGH:
                continue
            if np.corrcoef(values[both], others[both])[0, 1] > _COPY:
                result[k] = j
                break
    return result


def _mean(observation: Observation) -> tuple[Image, Image, NDArray[np.bool_]]:
    combined = observation if len(observation) == 1 else observation.combined()
    return combined.data[0], combined.error[0], combined.valid[0]


def _stamp(observation: Observation) -> tuple[Image, Image, Image] | None:
    """Image about the star, distances from it (arcsec), and noise; None for small frames."""
    data, error, valid = _mean(observation)
    return stamp_about(
        data, error, valid, observation.center.mean(axis=0), float(np.mean(observation.pixelscale))
    )


def _noise(observation: Observation, *, clipped: bool = True) -> tuple[Image, NDArray[np.bool_]]:
    """Differences from neighbouring pixels, clipped, and which of them are far from the star."""
    data, _, valid = _mean(observation)
    difference = data - convolve(data, _NEIGHBOURS, mode="nearest")
    rows, columns = np.indices(data.shape)
    x, y = observation.center.mean(axis=0)
    far = np.hypot(columns - x, rows - y) * float(np.mean(observation.pixelscale)) > _FAR
    usable = valid & far
    typical = float(np.median(np.abs(difference[usable]))) if usable.any() else 0.0
    if typical > 0 and clipped:
        difference = np.clip(difference / typical, -6, 6)
    return difference, usable
