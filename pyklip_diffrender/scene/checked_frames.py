"""Checks of the arrays and numbers that an observation is made of."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from astropy import units as u
from numpy.typing import NDArray

from pyklip_diffrender.errors import (
    IncompatibleSetupError,
    NoValidPixelsError,
    ShapeError,
    UnitError,
)
from pyklip_diffrender.io.units import (
    native_float64,
    require_finite,
    require_shape,
    to_arcsec,
    to_pair,
    to_unit,
)

__all__ = ["checked_frames", "selected"]


def checked_frames(
    data: Any,
    error: Any,
    *,
    valid: Any = None,
    unit: str | u.UnitBase = "photon",
    pixelscale: float | tuple[float, float],
    center: Any = None,
    **details: Any,
) -> dict[str, Any]:
    """Return the attributes of an `Observation`, checked, in its units, and copied.

    The arguments are those of `Observation.from_arrays`, which says what is raised.
    """
    name = details.get("name", "observation")
    try:
        unit = u.Unit(unit)
    except (ValueError, TypeError) as reason:
        raise UnitError(
            f"{name}: got the unit {unit!r}, expected an astropy unit such as 'MJy/sr'"
        ) from reason
    values = to_unit(data, unit, f"{name}: data")
    values = values[None] if values.ndim == 2 else values
    if values.ndim != 3 or values.size == 0:
        raise ShapeError(f"{name}: data: got shape {np.shape(data)}, expected ([frames,] ny, nx)")
    sigma = to_unit(error, unit, f"{name}: error")
    sigma = sigma[None] if sigma.ndim == 2 else sigma
    require_shape(sigma, values.shape, f"{name}: error", "Give one error for every pixel")
    good = np.isfinite(values) & np.isfinite(sigma) & (sigma > 0)
    if valid is not None:
        mask = np.asarray(valid, dtype=bool)
        mask = mask[None] if mask.ndim == 2 else mask
        require_shape(mask, values.shape, f"{name}: valid", "Give one value for every pixel")
        good &= mask
    empty = np.flatnonzero(~good.any(axis=(1, 2)))
    if len(empty):
        raise NoValidPixelsError(
            f"{name}: all {values[0].size} pixels of frame {int(empty[0])} are masked, not "
            "finite or without an error. Look at its DQ"
        )
    if details.get("star_offset") is not None:
        details["star_offset"] = to_pair(details["star_offset"], u.arcsec, "star_offset")
    if details.get("position_angles") is not None:
        angles = to_unit(details["position_angles"], u.deg, "position_angles")
        details["position_angles"] = _spread(angles, (len(values),), f"{name}: position_angles")
    frames, ny, nx = values.shape
    position = native_float64([(nx - 1) / 2, (ny - 1) / 2] if center is None else center)
    require_finite(position, f"{name}: center")
    scale = _spread(to_arcsec(pixelscale, "pixelscale"), (2,), f"{name}: pixelscale")
    if not (np.isfinite(scale) & (scale > 0)).all():
        raise IncompatibleSetupError(
            f"{name}: pixelscale: got {pixelscale}, expected a positive number of arcsec per "
            "pixel, such as 0.0624"
        )
    return {
        "data": np.where(good, values, 0.0),
        "error": np.where(good, sigma, 1.0),
        "valid": good,
        "unit": unit,
        "pixelscale": (float(scale[0]), float(scale[1])),
        "center": _spread(position, (frames, 2), f"{name}: center"),
        **details,
    }


def selected(frames: Mapping[str, Any], which: NDArray[np.intp]) -> dict[str, Any]:
    """The attributes of an `Observation` that change if frames are selected by their indices."""
    names = ("data", "error", "valid", "center", "position_angles")
    ratios = frames.get("noise_ratios", ())
    return {
        **{name: frames[name][which] for name in names if frames[name] is not None},
        "noise_ratios": tuple(ratios[k] for k in which) if ratios else (),
    }


def _spread(array: NDArray[np.float64], shape: tuple[int, ...], name: str) -> NDArray[np.float64]:
    """Copy of an array, repeated to a shape."""
    try:
        return np.broadcast_to(array, shape).copy()
    except ValueError as error:
        raise ShapeError(f"{name}: got shape {array.shape}, expected {shape}") from error
