"""Undo the shifts of aligned frames, so that they have the pixels of the detector.

A flat-field error belongs to a pixel of the detector. spaceKLIP's alignment moves frames by
fractions of a pixel, by a Fourier shift, after which a pixel of the array is a mixture of pixels of
the detector, a different one in every frame. The shift is recorded and can be undone.
"""

from __future__ import annotations

import logging
from typing import Any

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, fourier_shift, minimum_filter, uniform_filter

from pyklip_diffrender.errors import IncompatibleSetupError, ShapeError
from pyklip_diffrender.instrument.masks import detector_place, filter_shift
from pyklip_diffrender.io.headers import header_number, header_text
from pyklip_diffrender.io.units import native_float64, require_finite
from pyklip_diffrender.optics.grid import fft_convolve
from pyklip_diffrender.scene.exposure import bar_place, detector_of, image_mask
from pyklip_diffrender.scene.star_place import measured_offset

_log = logging.getLogger(__name__)

SHIFTS = ("IMSHIFTS", "CENTER_SHIFT", "ALIGN_SHIFT")
"""Extensions in which spaceKLIP records shifts: the first until release 2.1, the others since."""

_PAD_PIXELS = 5
"""Rows and columns that are mirrored at every edge before a shift, as many as in the alignment."""

_SIDE_PIXELS = 2048
"""Rows and columns of a detector."""

_STAR_FROM_MASK_PIXELS = 50.0
"""Pixels from the mask to a star, beyond which header and mask contradict each other: the start of
another subarray is hundreds of pixels away."""

_OVERHANG_PIXELS = 5
"""Pixels by which a shift may move an array over the edge of the detector."""

_REACH_PIXELS = 4
"""Pixels about a gap from which it is filled."""

_AUTOCORRELATION_SIGMA_PIXELS = 1.1
"""Standard deviation of the Gaussian autocorrelation of images in filled gaps, pixels, as for a
point source at 4 microns."""

_NUGGET_VARIANCE_RATIO = 1e-3
"""Noise of the pixels relative to the image's variance, which keeps the equations regular."""

_BESIDE_GAP_PIXELS = 2.3
"""Pixels from a gap within which known pixels are predicted, to see how good predictions are."""

_FILLED_VARIANCE_RATIO = 0.25
"""Largest variance that filled pixels may add, relative to the variance of the pixel."""

_MASKED_GAP_WEIGHT = 0.1
"""Squared weight of a gap above which a pixel is masked, however well it was filled."""

_MISPLACED_STAR_PIXELS = 0.3
"""Pixels between a star and its stated position beyond which the position may be wrong by a pixel:
the star is measured to a tenth of a pixel, and is within 0.2 pixel of the mask."""

_CROPPED_PIXELS = 32
"""Whole pixels beyond which frames were cropped, and not only aligned."""

SAME_PLACE_PIXELS = 0.02
"""Pixels within which two records state one place: the records agree to 0.001 in real files."""


def recorded_shifts(
    hdus: fits.HDUList, center: NDArray[np.float64], shape: tuple[int, ...], name: str
) -> NDArray[np.float64] | None:
    """Shifts of the frames of a file by spaceKLIP, (frames, 2), x, y in pixels, or None.

    `center` is x, y of the star in the first frame, 0-indexed, `shape` frames, rows and columns.
    ShapeError or NonFiniteError if there are not two finite numbers for every frame.
    """
    shifts = {}
    for key in SHIFTS:
        if key in hdus:
            data = hdus[key].data
            if np.shape(data) != (shape[0], 2):
                raise ShapeError(
                    f"{name}: {key}: got shape {np.shape(data)}, expected ({shape[0]}, 2), "
                    "x and y for every frame"
                )
            shifts[key] = native_float64(data)
            require_finite(shifts[key], f"{name}: {key}")
    if not shifts or "IMSHIFTS" in shifts:
        return shifts.get("IMSHIFTS")
    # Since release 2.2, CENTER_SHIFT moves the star to the centre of the array, and ALIGN_SHIFT
    # aligns the frames with each other. Both shifts are recorded before the frames are shifted.
    if "CENTER_SHIFT" in shifts:
        middle = (np.array(shape[:0:-1]) - 1) / 2
        if (np.abs(center + shifts["CENTER_SHIFT"][0] - middle) < SAME_PLACE_PIXELS).all():
            return None  # The star is still where the shift starts.
    return np.asarray(sum(shifts.values()))


def mask_place(header: fits.Header, name: str) -> NDArray[np.float64] | None:
    """Place of the mask's centre on the whole detector, x, y in pixels from 0, (2,).

    The place follows from DETECTOR, FILTER, and the mask in CORONMSK, APERNAME or SUBARRAY. None if
    the header does not say, or if the place was not measured.
    """
    detector, mask = detector_of(header, name), image_mask(header, name)
    if detector is None or mask is None:
        return None
    try:
        passband = header_text(header, "FILTER", name) or ""
        place = detector_place(mask, passband, bar_place(header, name))
        if place.header_detector != detector:
            return None
        return np.add(place.center, filter_shift(passband))
    except IncompatibleSetupError:
        return None


def net_shifts(
    shifts: NDArray[np.float64], star: NDArray[np.float64], mask: NDArray[np.float64] | None
) -> NDArray[np.float64]:
    """Distance of every frame's light from the detector's pixels that it fell on, (frames, 2).

    `shifts` and `star`, the place of the star in the array, are (frames, 2), `mask` is the place of
    the mask on the detector, (2,), all x, y in pixels. Without a mask, whole pixels are left out.
    """
    # A file records by how much its frames were shifted, but not by how many whole pixels they were
    # cut or padded afterwards, all alike. The whole pixels follow from the star, which was within
    # half a pixel of the mask's centre: star = mask + shift + whole pixels + less than a half.
    if mask is None:
        return np.asarray(shifts - np.round(shifts.mean(axis=0)))
    return np.asarray(shifts + np.round(np.median(star - mask - shifts, axis=0)))


def first_pixel(
    header: fits.Header, star: NDArray[np.float64], shape: tuple[int, ...], name: str
) -> tuple[int, int] | None:
    """Detector column and row, from 0, of the first pixel of an array that was not moved.

    `star` is x, y in the array, 0-indexed, (2,), and `shape` its rows and columns. SUBSTRT1 and
    SUBSTRT2 are the first column and row of the subarray, 1-indexed. None if the header does not
    say, or says what cannot be: an array off the detector, or a star away from the mask. The
    pattern of the flat field may show the place.
    """
    start = [header_number(header, key, name) for key in ("SUBSTRT1", "SUBSTRT2")]
    if None in start:
        return None
    column, row = (int(each or 0) - 1 for each in start)
    mask = mask_place(header, name)
    if header_text(header, "SUBARRAY", name) is None:
        mask = None  # A subarray that is not named may begin anywhere.
    away = 0.0 if mask is None else float(np.abs(np.add(star, (column, row)) - mask).max())
    if away > _STAR_FROM_MASK_PIXELS or not on_detector((column, row), shape):
        _log.warning(
            "%s: with SUBSTRT1 and SUBSTRT2 of %d and %d the star at (%.1f, %.1f) is not where the "
            "mask is on the detector; the place of the frames is not known",
            name, column + 1, row + 1, *star,
        )  # fmt: skip
        return None
    return column, row


def on_detector(first: tuple[int, int], shape: tuple[int, ...]) -> bool:
    """Whether an array is on the detector, up to a few pixels by which it may have been moved."""
    ends = np.add(first, shape[::-1])
    return bool(min(first) >= -_OVERHANG_PIXELS and ends.max() <= _SIDE_PIXELS + _OVERHANG_PIXELS)


def undo_shifts(
    data: NDArray[np.float64], error: NDArray[np.float64], shifts: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    """Shift frames (frames, ny, nx) with gaps by less than a pixel, without spreading the gaps.

    Gaps are not finite; errors of 0 or less are gaps, too. `shifts` are x, y in pixels,
    (frames, 2). The result has the frames, their errors, and the valid pixels, which are no gaps
    and do not depend on any.
    """
    # Rows and columns without any data were added to the image, and do not limit how well it is
    # known at its edge.
    rows, columns = (np.flatnonzero(np.isfinite(data).any(axis=axes)) for axes in ((0, 2), (0, 1)))
    if len(rows) and data.shape[1:] != (np.ptp(rows) + 1, np.ptp(columns) + 1):
        window = np.s_[:, rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
        parts = undo_shifts(data[window], error[window], shifts)
        whole = np.zeros_like(data), np.ones_like(data), np.zeros(data.shape, dtype=bool)
        for array, part in zip(whole, parts, strict=True):
            array[window] = part
        return whole
    # A Fourier shift makes every pixel depend on all pixels of its row and column. Gaps are filled
    # from their neighbours before it; how wrong that may be is added to the variance of the pixels
    # that depend on it, and pixels where it would be more than a quarter of the variance are
    # masked.
    missing = ~np.isfinite(data)
    unknown = ~(np.isfinite(error) & (error > 0))
    pairs = [filled(frame, gap) for frame, gap in zip(data, missing, strict=True)]
    moved = shift_frames(np.stack([frame for frame, _ in pairs]), shifts)
    leaked = _spread(np.stack([each for _, each in pairs]) ** 2, shifts)
    del pairs  # The pairs are as large as the frames.
    gaps = _spread((missing | unknown).astype(float), shifts)
    variance = shift_variances(error, ~unknown, shifts)
    valid = (leaked < _FILLED_VARIANCE_RATIO * variance) & (gaps < _MASKED_GAP_WEIGHT)
    return moved, np.sqrt(variance + leaked), valid


def shift_variances(
    error: NDArray[np.float64], known: NDArray[np.bool_], shifts: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Variances of shifted frames, (frames, ny, nx), from standard deviations before the shift.

    Errors have any value where not `known`; `shifts` are x, y in pixels, (frames, 2).
    """
    variance = np.empty_like(error)
    for k, (sigma, good) in enumerate(zip(error, known, strict=True)):
        variance[k] = 1.0 if not good.any() else _nearest(np.where(good, sigma, 1.0) ** 2, ~good)
    # Variances ring where a pixel has a much larger one than its neighbours; they are not allowed
    # below the smallest of the pixels around.
    least = np.stack([minimum_filter(each, 3, mode="nearest") for each in variance])
    return np.maximum(shift_frames(variance, shifts), least)


def filled(
    frame: NDArray[np.float64], gaps: NDArray[np.bool_]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Fill the gaps of an image (ny, nx), and say how well: the standard deviation, 0 elsewhere."""
    # The estimate is the best linear one for a random image with the resolution of the telescope
    # (kriging): with the covariance C of the neighbours v, of mean m, and c between them and the
    # gap, m + c C^-1 (v - m). How well each neighbour near the gap is predicted from the others,
    # without any further solution [C^-1 (v - m)]_i / [C^-1]_ii, says how good it is.
    doubt = np.zeros_like(frame)
    if not gaps.any() or gaps.all():
        return np.where(gaps, 0.0, frame), doubt
    image = _nearest(frame, gaps)
    rough = image - uniform_filter(image, 3, mode="nearest")
    typical = np.sqrt(uniform_filter(rough**2, 5, mode="nearest") * 25 / 16)
    doubt[gaps] = typical[gaps]
    for row, column in np.argwhere(gaps):
        window = np.s_[
            max(row - _REACH_PIXELS, 0) : row + _REACH_PIXELS + 1,
            max(column - _REACH_PIXELS, 0) : column + _REACH_PIXELS + 1,
        ]
        y, x = np.nonzero(~gaps[window])
        y, x = y + window[0].start - row, x + window[1].start - column
        near = np.hypot(x, y) < _REACH_PIXELS + 0.5
        y, x = y[near], x[near]
        # On all sides; what lies beyond the edge of a large gap is not interpolated.
        if min(x.max(initial=-9), y.max(initial=-9), -x.min(initial=9), -y.min(initial=9)) < 1:
            continue
        values = frame[y + row, x + column]
        distances = np.hypot(x - x[:, None], y - y[:, None])
        inverse = np.linalg.inv(_covariance(distances) + _NUGGET_VARIANCE_RATIO * np.eye(len(x)))
        mean = values.mean()
        excess = inverse @ (values - mean)
        image[row, column] = mean + _covariance(np.hypot(x, y)) @ excess
        left_out = (excess / np.diag(inverse))[np.hypot(x, y) < _BESIDE_GAP_PIXELS]
        doubt[row, column] = (
            np.sqrt((left_out**2).mean()) if len(left_out) else typical[row, column]
        )
    return image, doubt


def _covariance(distance: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(np.exp(-0.5 * (distance / _AUTOCORRELATION_SIGMA_PIXELS) ** 2))


def _nearest(image: NDArray[np.float64], gaps: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Replace gaps by the nearest other pixel."""
    if not gaps.any():
        return image
    places = distance_transform_edt(gaps, return_distances=False, return_indices=True)
    return np.asarray(image[tuple(places)])


def _spread(squares: NDArray[np.float64], shifts: NDArray[np.float64]) -> NDArray[np.float64]:
    """Variances after a shift of pixels that are independent of each other."""
    result = np.zeros_like(squares)
    for k, (variance, shift) in enumerate(zip(squares, shifts, strict=True)):
        if not variance.any():
            continue
        # A shifted pixel is the sum of k_j x_j, the kernel k being the shift of a single pixel, and
        # has the variance sum of k_j^2 v_j.
        kernel = np.zeros_like(variance)
        # Where `fft_convolve` has the origin of a kernel.
        kernel[(kernel.shape[0] - 1) // 2, (kernel.shape[1] - 1) // 2] = 1.0
        kernel = np.fft.ifft2(fourier_shift(np.fft.fft2(kernel), shift[::-1])).real ** 2
        result[k] = np.maximum(fft_convolve(variance, kernel), 0.0)
    return result


def shift_frames(frames: NDArray[np.float64], shifts: NDArray[np.float64]) -> NDArray[np.float64]:
    """Fourier-shift frames (frames, ny, nx), without NaN, by x, y in pixels, (frames, 2)."""
    inner = slice(_PAD_PIXELS, -_PAD_PIXELS)
    shifted = np.empty_like(frames)
    for k, (frame, (x, y)) in enumerate(zip(frames, shifts, strict=True)):
        padded = np.pad(frame, _PAD_PIXELS, mode="reflect")
        moved = np.fft.ifft2(fourier_shift(np.fft.fft2(padded), (y, x))).real
        shifted[k] = moved[inner, inner]
    return shifted


def _records_agree(arguments: dict[str, Any], left: NDArray[np.float64]) -> bool:
    """Whether shifts and the star's positions in the array and behind the mask are of one place.

    `left`, (frames, 2), is the star's position less the mask's and the shift. Frames are cropped by
    whole pixels; up to these, it is the star's position behind the mask.
    """
    if arguments.get("star_offset") is None:
        return False
    rest = left.mean(axis=0) - np.divide(arguments["star_offset"], arguments["pixelscale"])
    return bool(np.abs(rest - np.round(rest)).max() < SAME_PLACE_PIXELS)


def on_detector_pixels(
    arguments: dict[str, Any],
    center: NDArray[np.float64],
    shifts: NDArray[Any],
    *,
    is_measured: bool = True,
) -> dict[str, Any]:
    """Undo the shifts by which frames were aligned, up to whole pixels: the changed arguments.

    `arguments` come from `read_calints`; their arrays are overwritten. `center`, x, y of the
    star from 0, and `shifts`, x, y in pixels, are (frames, 2). With `is_measured` the star's
    position is compared with its light, unless the file's own records agree with each other.
    """
    name, header, frames = arguments["name"], arguments["header"], len(center)
    data, error, usable = (
        arguments[key].reshape(frames, *arguments[key].shape[-2:])
        for key in ("data", "error", "valid")
    )
    mask = None if arguments["center"] is None else mask_place(header, name)
    begin = np.zeros(2)
    if mask is not None:
        stated = [header_number(header, key, name) for key in ("SUBSTRT1", "SUBSTRT2")]
        if None in stated:
            # As if nothing had been cut; the place on the detector does not depend on it.
            begin = np.round((mask - center + shifts).mean(axis=0))
        else:
            begin = np.array([float(each or 0) - 1 for each in stated])
        mask = mask - begin
    # Light is `net` from the pixel that it fell on: whole pixels only move the array's place on the
    # detector, and the rest, net - pixels, is undone.
    net = net_shifts(shifts, center, mask)
    pixels = np.round(net.mean(axis=0))
    # The alignment leaves the flags where they were; a crop takes them along.
    cropped = np.abs(pixels).max() > _CROPPED_PIXELS
    right, up = (int(each) for each in (np.round(shifts.mean(axis=0)) if cropped else pixels))
    for k in range(frames):
        part = slice(k, k + 1)
        # In double precision: the shift adds up many pixels.
        shifted, sigma, good = undo_shifts(
            data[part].astype(float), error[part].astype(float), (pixels - net)[part]
        )
        good &= np.roll(usable[part], (up, right), axis=(1, 2))
        data[part], error[part] = np.where(good, shifted, 0.0), np.where(good, sigma, 1.0)
        usable[part] = good
    column, row = (int(each) for each in begin - pixels)
    sure = mask is not None and on_detector((column, row), data.shape[1:])
    agree = mask is not None and _records_agree(arguments, center - mask - shifts)
    if sure and is_measured and not agree:
        # The place has its whole pixels from the star's stated position.
        frame = data[0].astype(float), error[0].astype(float), usable[0]
        scale = float(np.mean(arguments["pixelscale"]))
        away = measured_offset(*frame, (center + pixels - net)[0], scale)
        if away is not None and np.abs(away).max() > _MISPLACED_STAR_PIXELS:
            _log.warning(
                "%s: the star is %.1f, %.1f pixels (x, y) from its stated position, so that the "
                "place of the frames on the detector is not known",
                name, *away,
            )  # fmt: skip
            sure = False
    return {
        "data": data,
        "error": error,
        "valid": usable,
        "center": center + pixels - net,
        "first_pixel": (column, row) if sure else None,
    }
