"""Read JWST stage-2 coronagraphic files, as the pipeline or spaceKLIP write them."""

from __future__ import annotations

import logging
import warnings
from typing import Any

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from pyklip_diffrender.errors import (
    CorruptFileError,
    DiffrenderWarning,
    NoValidPixelsError,
    UnitError,
)
from pyklip_diffrender.io.headers import header_number, header_text, merged_header
from pyklip_diffrender.io.units import native_float64
from pyklip_diffrender.scene.archive_names import detector_of
from pyklip_diffrender.scene.detector_pixels import (
    SHIFTS,
    first_pixel,
    mask_place,
    net_shifts,
    on_detector,
    recorded_shifts,
    undo_shifts,
)
from pyklip_diffrender.scene.exposure import beginning, middle, position_angle
from pyklip_diffrender.scene.integrations import Judgement, empty_integrations
from pyklip_diffrender.scene.star_place import measured_offset

_log = logging.getLogger(__name__)

__all__ = [
    "BAD_PIXEL_BITS",
    "BEHIND_THE_MASK",
    "dither",
    "on_detector_pixels",
    "read_calints",
    "without_empty",
]

BAD_PIXEL_BITS = 1 | 2 | 512 | 1024
"""JWST data-quality bits that take a pixel out of the fit: DO_NOT_USE, SATURATED, NON_SCIENCE,
DEAD. A jump (4) that the ramp fit has repaired, or a hot pixel (2048) that was dark-subtracted,
may be good; where it is not, the pipeline sets DO_NOT_USE as well."""

BEHIND_THE_MASK = 0.1
"""Largest dither, arcsec, that leaves a star behind the mask; small-grid dithers are of 0.02."""

_SCALES = (0.031, 0.063)
"""arcsec of a pixel of NIRCam's short-wave and long-wave detectors, to 2 %."""

_MISPLACED = 0.3
"""Pixels of a star from its stated position beyond which that may be wrong by a pixel: the star is
measured to a tenth of a pixel, and is within 0.2 pixel of the mask."""

_CROPPED = 32
"""Whole pixels beyond which frames were cropped, and not only aligned."""


def read_calints(hdus: fits.HDUList, name: str) -> tuple[dict[str, Any], NDArray[Any] | None]:
    """Read an open calints file; see `Observation.from_fits`.

    Parameters
    ----------
    hdus : HDUList
    name : str
        The file's.

    Returns
    -------
    arguments : dict
        Arguments of `Observation.from_arrays`.
    shifts : ndarray, (frames, 2), or None
        By how much spaceKLIP has shifted the frames, see `recorded_shifts`.
    """
    if "SCI" not in hdus:
        raise CorruptFileError(
            f"{name}: no SCI extension, only {[h.name for h in hdus]}; expected a JWST calints file"
        )
    science = hdus["SCI"]
    header = merged_header(hdus[0].header, science.header, name)
    for hdu in hdus:
        if hdu.name in ("SCI", "ERR", "DQ") and not hdu.is_image:
            raise CorruptFileError(f"{name}: {hdu.name} is a table, not an image")
        if hdu.name in ("SCI", "ERR", "DQ") and hdu.data is None:
            raise CorruptFileError(f"{name}: {hdu.name} has no data, so no frames")
    data = native_float64(science.data)
    if "ERR" not in hdus:
        raise CorruptFileError(f"{name}: no ERR extension; the fit needs errors")
    error = native_float64(hdus["ERR"].data)
    if "DQ" in hdus:
        quality = np.asarray(hdus["DQ"].data)
        if quality.dtype.kind not in "iu":
            raise CorruptFileError(
                f"{name}: DQ holds {quality.dtype.name}, expected integers (flags)"
            )
    else:
        warnings.warn(
            f"{name}: no DQ extension; only NaN pixels are masked",
            DiffrenderWarning,
            stacklevel=3,
        )
        quality = np.zeros(data.shape, dtype=np.uint32)
    mask = hdus["MASKOFFS"].data if "MASKOFFS" in hdus else None
    details = _details(header, 1 if data.ndim == 2 else len(data), name)
    frames = data.reshape(-1, *data.shape[-2:]).shape
    shifts = recorded_shifts(hdus, np.asarray(details["center"], float), frames, name)
    # A star whose position is stated was moved, unless the file has shifts not yet applied.
    records = any(key in hdus for key in SHIFTS)
    moved = "STARCENX" in header and not records
    arguments = {
        "data": data,
        "error": error,
        "valid": (quality.astype(np.uint32) & BAD_PIXEL_BITS) == 0,
        **details,
    }
    if mask is not None:
        # spaceKLIP records the star's position minus the mask's, in pixels, for every integration.
        offset = native_float64(mask).reshape(-1, 2).mean(axis=0) * arguments["pixelscale"]
        arguments["star_offset"] = (float(offset[0]), float(offset[1]))
    elif not moved and not records:
        offset = dither(header, name)
        if offset is not None:
            arguments["star_offset"] = offset
            if arguments["center"] is not None:
                arguments["center"] += np.divide(offset, arguments["pixelscale"])
    if shifts is None and not moved and data.ndim > 1:  # Other shapes are refused with the frames.
        ny, nx = data.shape[-2:]
        star = arguments["center"]
        if star is None:
            star = np.array([nx - 1, ny - 1]) / 2
        arguments["first_pixel"] = first_pixel(header, star, (ny, nx), name)
    return arguments, shifts


def without_empty(
    arguments: dict[str, Any], shifts: NDArray[Any] | None
) -> tuple[dict[str, Any], NDArray[Any] | None, Judgement | None]:
    """Leave integrations out that have no usable pixels; see `read_calints` for the arguments.

    The last value says which are kept; None for all.
    """
    stacks = [np.asarray(arguments[key]) for key in ("data", "error", "valid")]
    data, error, valid = (each[None] if each.ndim == 2 else each for each in stacks)
    if data.ndim != 3 or not data.shape == error.shape == valid.shape:
        return arguments, shifts, None
    usable = valid & np.isfinite(data) & np.isfinite(error) & (error > 0)
    judgement = empty_integrations(data, usable)
    if judgement.kept.all():
        return arguments, shifts, None
    name, remarks = arguments["name"], judgement.remarks
    if not judgement.kept.any():
        raise NoValidPixelsError(f"{name}: {'; '.join(remarks)}. Look at its SCI, ERR and DQ")
    for remark in remarks:
        _log.warning("%s: %s", name, remark)
    kept = judgement.kept
    changed = {"data": data[kept], "error": error[kept], "valid": valid[kept]}
    if arguments["position_angles"] is not None:
        changed["position_angles"] = arguments["position_angles"][kept]
    return arguments | changed, None if shifts is None else shifts[kept], judgement


def dither(header: fits.Header, name: str) -> tuple[float, float] | None:
    """Read the position of a dithered star relative to the mask.

    Dithers on a small grid (XOFFSET, YOFFSET) move the star behind the mask, and on the detector,
    from the position that CRPIX states.

    Parameters
    ----------
    header : Header
    name : str
        The file's, for messages.

    Returns
    -------
    tuple of float or None
        x, y, arcsec; None without a dither, or with one that takes the star off the mask.
    """
    x, y = (header_number(header, key, name) or 0.0 for key in ("XOFFSET", "YOFFSET"))
    return (x, y) if 0 < np.hypot(x, y) < BEHIND_THE_MASK else None


def _details(header: fits.Header, frames: int, name: str) -> dict[str, Any]:
    """Arguments of `Observation.from_arrays` that the merged header determines."""

    def number(key: str, default: float) -> float:
        value = header_number(header, key, name)
        return default if value is None else value

    unit = header_text(header, "BUNIT", name)
    if unit is None:
        raise UnitError(f"{name}: SCI has no BUNIT; expected one such as 'MJy/sr'")
    star = [
        number(key, number(fallback, np.nan)) for key, fallback in
        (("STARCENX", "CRPIX1"), ("STARCENY", "CRPIX2"))
    ]  # fmt: skip
    angle = position_angle(header, name)
    area = number("PIXAR_A2", 0.0)
    if area == 0:
        raise UnitError(f"{name}: the header has no PIXAR_A2 (pixel area, arcsec^2)")
    if area < 0:
        raise CorruptFileError(
            f"{name}: PIXAR_A2 is {area}, expected a pixel area in arcsec^2, such as 0.0039. "
            "Correct the header, or fetch the file again"
        )
    detector = detector_of(header, name) or ""
    if detector.startswith("NRC"):
        usual = _SCALES[detector.endswith(("LONG", "5"))]
        if not 0.9 < area**0.5 / usual < 1.1:
            raise CorruptFileError(
                f"{name}: by PIXAR_A2 a pixel is {area**0.5:.3g} arcsec wide, and {usual:g} in "
                f"{detector}. Correct the header, or fetch the file again"
            )
    return {
        "unit": unit,
        "pixelscale": area**0.5,
        "center": None if np.isnan(star).any() else np.array(star) - 1,
        "filter": header_text(header, "FILTER", name),
        "date": beginning(header, name),
        "mid_date": middle(header, name),
        "position_angles": None if angle is None else np.full(frames, angle),
        "name": name,
        "header": header,
    }


def on_detector_pixels(
    arguments: dict[str, Any], center: NDArray[np.float64], shifts: NDArray[Any]
) -> dict[str, Any]:
    """Undo the shifts by which frames were aligned, up to whole pixels.

    Parameters
    ----------
    arguments : dict
        See `read_calints`.
    center : ndarray, (frames, 2)
        x, y of the star, 0-indexed.
    shifts : ndarray, (frames, 2)
        x, y in pixels.

    Returns
    -------
    dict
        The attributes of the observation that change.
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
    net = net_shifts(shifts, center, mask)
    pixels = np.round(net.mean(axis=0))
    shifted, sigma, good = undo_shifts(data, error, pixels - net)
    # The alignment leaves the flags where they were; a crop takes them along.
    cropped = np.abs(pixels).max() > _CROPPED
    right, up = (int(each) for each in (np.round(shifts.mean(axis=0)) if cropped else pixels))
    good &= np.roll(usable, (up, right), axis=(1, 2))
    column, row = (int(each) for each in begin - pixels)
    sure = mask is not None and on_detector((column, row), data.shape[1:])
    if sure:
        # The whole pixels of the place are those of the star's stated position.
        frame = shifted[0], sigma[0], good[0]
        scale = float(np.mean(arguments["pixelscale"]))
        away = measured_offset(*frame, (center + pixels - net)[0], scale)
        if away is not None and np.abs(away).max() > _MISPLACED:
            _log.warning(
                "%s: the star is %.1f, %.1f pixels (x, y) from its stated position, so that the "
                "place of the frames on the detector is not known",
                name, *away,
            )  # fmt: skip
            sure = False
    return {
        "data": np.where(good, shifted, 0.0),
        "error": np.where(good, sigma, 1.0),
        "valid": good,
        "center": center + pixels - net,
        "first_pixel": (column, row) if sure else None,
    }
