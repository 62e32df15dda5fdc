"""Undo the shifts of aligned frames, so that their pixels are those of the detector.

A flat-field error belongs to a pixel of the detector. spaceKLIP's alignment moves frames by
fractions of a pixel (IMSHIFTS), by a Fourier shift, after which a pixel of the array is a mixture
of pixels of the detector, a different one in every frame. The shift is known and can be undone.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray
from scipy.ndimage import fourier_shift

from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.instrument.masks import filter_shift, mask_center
from pyklip_diffrender.io.headers import header_number, header_text
from pyklip_diffrender.io.units import native_float64

__all__ = ["first_pixel", "net_shifts", "shift_frames"]

_PAD = 5
"""Rows and columns that are mirrored at every edge before a shift, as many as in the alignment."""


def net_shifts(
    shifts: Any, center: NDArray[np.float64], header: fits.Header, name: str
) -> NDArray[np.float64]:
    """How far the light of every frame is from where it fell on the detector.

    A file records by how much its frames were shifted (IMSHIFTS), but not by how many whole pixels
    they were cut or padded afterwards. Those follow from the position of the star, which was within
    half a pixel of the centre of the mask.

    Parameters
    ----------
    shifts : array_like, (frames, 2)
        x, y of IMSHIFTS, pixels.
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
