"""Read JWST stage-2 coronagraphic files, as the pipeline or spaceKLIP write them."""

from __future__ import annotations

import logging
import os
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from pyklip_diffrender.errors import (
    CorruptFileError,
    DiffrenderWarning,
    IncompatibleSetupError,
    NoValidPixelsError,
    UnitError,
)
from pyklip_diffrender.io.files import read_image
from pyklip_diffrender.io.headers import card_error, header_number, header_text, merged_header
from pyklip_diffrender.io.units import ARCSEC, native_float64
from pyklip_diffrender.scene.aligned_frames import SHIFTS, first_pixel, recorded_shifts
from pyklip_diffrender.scene.exposure import beginning, detector_of, middle, position_angle
from pyklip_diffrender.scene.integrations import (
    Judgement,
    compressed,
    empty_integrations,
    usable_pixels,
)

_log = logging.getLogger(__name__)

BAD_PIXEL_BITS = 1 | 2 | 512 | 1024
"""JWST data-quality bits that take a pixel out of the fit: DO_NOT_USE, SATURATED, NON_SCIENCE,
DEAD. A jump (4) that the ramp fit has repaired, or a hot pixel (2048) that was dark-subtracted,
may be good; where it is not, the pipeline sets DO_NOT_USE as well."""

BEHIND_THE_MASK = 0.1
"""Largest dither, arcsec, that leaves a star behind the mask; small-grid dithers are of 0.02."""

_PIXEL_SCALES_ARCSEC = (0.031, 0.063)
"""arcsec of a pixel of NIRCam's short-wave and long-wave detectors, to 2 %."""


def _checked_place(
    star: tuple[float, float], shape: tuple[int, ...], name: str
) -> NDArray[np.float64]:
    """The place of a star, x, y from 0, which is inside the frame."""
    place = np.array(star, dtype=float)
    (ny, nx), (x, y) = shape, place
    if not (-0.5 <= x <= nx - 0.5 and -0.5 <= y <= ny - 0.5):
        raise IncompatibleSetupError(
            f"{name}: star: got x, y = {x:g}, {y:g}, expected a place in its {nx} x {ny} pixels, "
            "counted from 0"
        )
    return place


def read_calints(
    hdus: fits.HDUList,
    path: str | os.PathLike[str],
    *,
    compact: bool = False,
    star: tuple[float, float] | None = None,
) -> tuple[dict[str, Any], NDArray[Any] | None]:
    """Read an open calints file: arguments of `Observation.from_arrays`, and `recorded_shifts`.

    The images of `hdus`, from `open_fits`, need not be read. `star` is the star's x, y in pixels
    from 0, in place of what the header says. `compact` keeps pixels and errors in single precision
    if the file has them so.
    """
    name = Path(path).name
    if "SCI" not in hdus:
        raise CorruptFileError(
            f"{name}: no SCI extension, only {[h.name for h in hdus]}; expected a JWST calints file"
        )
    science = hdus["SCI"]
    header = merged_header(hdus[0].header, science.header, name)
    for hdu in hdus:
        if hdu.name in ("SCI", "ERR", "DQ") and not hdu.is_image:
            raise CorruptFileError(f"{name}: {hdu.name} is a table, not an image")
        if hdu.name in ("SCI", "ERR", "DQ") and not hdu.shape:
            raise CorruptFileError(f"{name}: {hdu.name} has no data, so no frames")
    # With the mask, pixels and errors in single precision take three quarters of the file's size.
    single = compact and science.header["BITPIX"] == -32
    as_float = single_precision if single else native_float64
    data = read_image(science, path, as_float)
    if "ERR" not in hdus:
        raise CorruptFileError(f"{name}: no ERR extension; the fit needs errors")
    error = read_image(hdus["ERR"], path, as_float)
    if "DQ" in hdus:
        valid = read_image(hdus["DQ"], path, lambda flags: unflagged(flags, name))
    else:
        warnings.warn(
            f"{name}: no DQ extension; only NaN pixels are masked",
            DiffrenderWarning,
            stacklevel=3,
        )
        valid = np.ones(data.shape, dtype=bool)
    mask = hdus["MASKOFFS"].data if "MASKOFFS" in hdus else None
    details = _details(header, 1 if data.ndim == 2 else len(data), name)
    if star is not None:
        details["center"] = _checked_place(star, data.shape[-2:], name)
    frames = data.reshape(-1, *data.shape[-2:]).shape
    shifts = recorded_shifts(hdus, np.asarray(details["center"], float), frames, name)
    # A star whose position is stated was moved, unless the file has shifts not yet applied.
    records = any(key in hdus for key in SHIFTS)
    moved = "STARCENX" in header and not records
    arguments = {"data": data, "error": error, "valid": valid, **details}
    if mask is not None:
        # spaceKLIP records the star's position minus the mask's, in pixels, for every integration.
        offset = native_float64(mask).reshape(-1, 2).mean(axis=0) * arguments["pixelscale"]
        arguments["star_offset"] = (float(offset[0]), float(offset[1]))
    elif not moved and not records:
        offset = dither(header, name)
        if offset is not None:
            arguments["star_offset"] = offset
            if arguments["center"] is not None and star is None:
                arguments["center"] += np.divide(offset, arguments["pixelscale"])
    if shifts is None and not moved and data.ndim > 1:  # Other shapes are refused with the frames.
        ny, nx = data.shape[-2:]
        place = arguments["center"]
        if place is None:
            place = np.array([nx - 1, ny - 1]) / 2
        arguments["first_pixel"] = first_pixel(header, place, (ny, nx), name)
    return arguments, shifts


def single_precision(image: Any) -> NDArray[np.float32]:
    """Copy of an image of a file in single precision, in the machine's byte order."""
    return np.array(image, dtype=np.float32, order="C")


def unflagged(flags: Any, name: str, bits: int = BAD_PIXEL_BITS) -> NDArray[np.bool_]:
    """Pixels without one of these flags, (ny, nx)."""
    flags = np.asarray(flags)
    if flags.dtype.kind not in "iu":
        raise CorruptFileError(f"{name}: DQ holds {flags.dtype.name}, expected integers (flags)")
    return (flags.astype(np.uint32) & bits) == 0


def without_empty(
    arguments: dict[str, Any], shifts: NDArray[Any] | None
) -> tuple[dict[str, Any], NDArray[Any] | None, Judgement | None]:
    """Leave integrations out that have no usable pixels; see `read_calints` for the arguments.

    The last value says which integrations are kept; None for all.
    """
    arrays = [np.asarray(arguments[key]) for key in ("data", "error", "valid")]
    data, error, valid = (each[None] if each.ndim == 2 else each for each in arrays)
    if data.ndim != 3 or not data.shape == error.shape == valid.shape:
        return arguments, shifts, None
    judgement = empty_integrations(data, map(usable_pixels, data, error, valid))
    if judgement.kept.all():
        return arguments, shifts, None
    name, remarks = arguments["name"], judgement.remarks
    if not judgement.kept.any():
        raise NoValidPixelsError(f"{name}: {'; '.join(remarks)}. Look at its SCI, ERR and DQ")
    for remark in remarks:
        _log.warning("%s: %s", name, remark)
    kept = judgement.kept
    stacks = {"data": data, "error": error, "valid": valid}
    changed = {key: compressed(stack, kept) for key, stack in stacks.items()}
    if arguments["position_angles"] is not None:
        changed["position_angles"] = arguments["position_angles"][kept]
    return arguments | changed, None if shifts is None else shifts[kept], judgement


def dither(header: fits.Header, name: str) -> tuple[float, float] | None:
    """x, y of a dithered star from the mask, arcsec; None without a dither, or off the mask."""
    # Dithers on a small grid (XOFFSET, YOFFSET) move the star behind the mask, and on the detector,
    # from the position that CRPIX states.
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
    if area <= 0:
        expected = "the area of a pixel in arcsec^2, such as 0.0039"
        raise card_error(name, "PIXAR_A2", area or None, expected)
    solid, by_area = number("PIXAR_SR", 0.0), area * ARCSEC**2
    if solid and not 0.9 < solid / by_area < 1.1:
        raise card_error(name, "PIXAR_SR", solid, f"about {by_area:.3g} sr, by PIXAR_A2")
    detector = detector_of(header, name) or ""
    if detector.startswith("NRC"):
        usual = _PIXEL_SCALES_ARCSEC[detector.endswith(("LONG", "5"))]
        if not 0.9 < area**0.5 / usual < 1.1:
            expected = f"about {usual**2:.2g} arcsec^2, the area of a pixel of {detector}"
            raise card_error(name, "PIXAR_A2", area, expected)
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
