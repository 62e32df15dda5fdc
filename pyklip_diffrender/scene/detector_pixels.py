"""Undo the shifts of aligned frames, so that their pixels are those of the detector.

A flat-field error belongs to a pixel of the detector. spaceKLIP's alignment moves frames by
fractions of a pixel, by a Fourier shift, after which a pixel of the array is a mixture of pixels of
the detector, a different one in every frame. The shift is recorded and can be undone.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray
from scipy.ndimage import fourier_shift

from pyklip_diffrender.errors import IncompatibleSetupError, ShapeError
from pyklip_diffrender.instrument.masks import filter_shift, mask_center
from pyklip_diffrender.io.headers import header_number, header_text
from pyklip_diffrender.io.units import native_float64, require_finite

__all__ = ["SHIFTS", "first_pixel", "net_shifts", "recorded_shifts", "shift_frames"]

SHIFTS = ("IMSHIFTS", "CENTER_SHIFT", "ALIGN_SHIFT")
"""Extensions in which spaceKLIP records shifts: the first until release 2.1, the others since."""

_AT_CENTER = 0.01
"""Pixels within which a star is where a shift moves it."""

_PAD = 5
"""Rows and columns that are mirrored at every edge before a shift, as many as in the alignment."""


def recorded_shifts(
    hdus: fits.HDUList, center: NDArray[np.float64], shape: tuple[int, ...], name: str
) -> NDArray[np.float64] | None:
    """By how much spaceKLIP has shifted the frames of a file.

    Since release 2.2, CENTER_SHIFT moves the star to the centre of the array, and ALIGN_SHIFT
    aligns the frames with each other. Both are recorded before the frames are shifted.

    Parameters
    ----------
    hdus : HDUList
    center : ndarray, (2,)
        x, y of the star in the first frame, 0-indexed.
    shape : tuple of int
        Number of frames, rows and columns.
    name : str
        The file's, for messages.

    Returns
    -------
    ndarray, (frames, 2), or None
        x, y, pixels; None if the frames were not shifted.

    Raises
    ------
    ShapeError, NonFiniteError
        If there are not two finite numbers for every frame.
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
    if "CENTER_SHIFT" in shifts:
        middle = (np.array(shape[:0:-1]) - 1) / 2
        if (np.abs(center + shifts["CENTER_SHIFT"][0] - middle) < _AT_CENTER).all():
            return None  # The star is still where the shift starts.
    return np.asarray(sum(shifts.values()))


def net_shifts(
    shifts: Any, center: NDArray[np.float64], header: fits.Header, name: str
) -> NDArray[np.float64]:
    """How far the light of every frame is from where it fell on the detector.

    A file records by how much its frames were shifted, but not by how many whole pixels
    they were cut or padded afterwards. Those follow from the position of the star, which was within
    half a pixel of the centre of the mask.

    Parameters
    ----------
    shifts : array_like, (frames, 2)
        x, y, see `recorded_shifts`.
    center : ndarray, (frames, 2)
        x, y of the star in the array, 0-indexed.
    header : Header
        APERNAME and FILTER determine the position of the mask.
    name : str
        The file's, for messages.

    Returns
    -------
    ndarray, (frames, 2)
        x, y, pixels. Where the mask's place is not known, the fraction of a pixel alone.
    """
    moved = native_float64(shifts).reshape(len(center), 2)
    aperture, passband = header_text(header, "APERNAME", name), header_text(header, "FILTER", name)
    try:
        mask = np.add(mask_center(str(aperture)), filter_shift(str(passband)))
    except IncompatibleSetupError:
        return np.asarray(moved - np.round(moved))
    return np.asarray(moved + np.round(center - mask - moved))


def first_pixel(header: fits.Header, whole: NDArray[np.int64], name: str) -> tuple[int, int] | None:
    """Detector column and row, 0-indexed, of an array's first pixel.

    Parameters
    ----------
    header : Header
        SUBSTRT1 and SUBSTRT2 are the first column and row of the subarray, 1-indexed.
    whole : ndarray, (2,)
        Whole pixels, x and y, by which the frames have been moved since.
    name : str
        The file's, for messages.

    Returns
    -------
    tuple of int or None
        None if the header does not have them.
    """
    start = [header_number(header, key, name) for key in ("SUBSTRT1", "SUBSTRT2")]
    if None in start:
        return None
    column, row = (int(s) - 1 - int(w) for s, w in zip(start, whole, strict=True) if s is not None)
    return column, row


def shift_frames(frames: NDArray[np.float64], shifts: NDArray[np.float64]) -> NDArray[np.float64]:
    """Shift frames by fractions of a pixel with the Fourier transform.

    Parameters
    ----------
    frames : ndarray, (frames, ny, nx)
        Without NaN.
    shifts : ndarray, (frames, 2)
        x, y in pixels.

    Returns
    -------
    ndarray, (frames, ny, nx)
    """
    inner = slice(_PAD, -_PAD)
    shifted = np.empty_like(frames)
    for k, (frame, (x, y)) in enumerate(zip(frames, shifts, strict=True)):
        padded = np.pad(frame, _PAD, mode="reflect")
        moved = np.fft.ifft2(fourier_shift(np.fft.fft2(padded), (y, x))).real
        shifted[k] = moved[inner, inner]
    return shifted
