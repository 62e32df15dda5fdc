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
    require_finite,
    require_shape,
    to_arcsec,
    to_mask,
    to_pair,
    to_unit,
)

__all__ = ["checked_frames", "checked_stacks", "mask_unusable", "selected", "usable_pixels"]


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
    unit = _unit(unit, name)
    frames = checked_stacks(
        to_unit(data, unit, f"{name}: data"),
        to_unit(error, unit, f"{name}: error"),
        valid=None if valid is None else to_mask(valid, f"{name}: valid"),
        unit=unit,
        pixelscale=pixelscale,
        center=center,
        **details,
    )
    mask_unusable(frames)
    return frames


def _unit(unit: Any, name: str) -> u.UnitBase:
    try:
        return u.Unit(unit)
    except (ValueError, TypeError) as reason:
        raise UnitError(
            f"{name}: got the unit {unit!r}, expected an astropy unit such as 'MJy/sr'"
        ) from reason


def usable_pixels(
    data: NDArray[Any], error: NDArray[Any], valid: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Valid pixels of a frame, (ny, nx), that are finite and have an error."""
    return np.asarray(valid & np.isfinite(data) & np.isfinite(error) & (error > 0))


def mask_unusable(frames: Mapping[str, Any], valid: NDArray[np.bool_] | None = None) -> None:
    """Set data to 0, errors to 1 and valid to False where pixels cannot be used, in place.

    The arrays of `frames`, and `valid`, which says what else is not to be used, are
    (frames, ny, nx). Frame by frame, which takes no memory.
    """
    for k, (data, error, good) in enumerate(
        zip(frames["data"], frames["error"], frames["valid"], strict=True)
    ):
        good &= usable_pixels(data, error, good if valid is None else valid[k])
        data[~good], error[~good] = 0.0, 1.0


def checked_stacks(
    data: NDArray[Any],
    error: NDArray[Any],
    *,
    valid: NDArray[np.bool_] | None = None,
    unit: str | u.UnitBase,
    pixelscale: float | tuple[float, float],
    center: Any = None,
    **details: Any,
) -> dict[str, Any]:
    """Return the attributes of an `Observation`, checked, with the caller's own arrays.

    `mask_unusable` sets what cannot be used to the values that an `Observation` has there.
    """
    name = details.get("name", "observation")
    unit = _unit(unit, name)
    values = data[None] if data.ndim == 2 else data
    if values.ndim != 3 or values.size == 0:
        raise ShapeError(f"{name}: data: got shape {np.shape(data)}, expected ([frames,] ny, nx)")
    sigma = error[None] if error.ndim == 2 else error
    require_shape(sigma, values.shape, f"{name}: error", "Give one error for every pixel")
    mask = np.ones(values.shape, dtype=bool) if valid is None else valid
    mask = mask[None] if mask.ndim == 2 else mask
    require_shape(mask, values.shape, f"{name}: valid", "Give one value for every pixel")
    for k, each in enumerate(map(usable_pixels, values, sigma, mask)):
        if not each.any():
            raise NoValidPixelsError(
                f"{name}: all {each.size} pixels of frame {k} are masked, not "
                "finite or without an error. Look at its DQ"
            )
    if details.get("star_offset") is not None:
        details["star_offset"] = to_pair(details["star_offset"], u.arcsec, "star_offset")
    if details.get("position_angles") is not None:
        angles = to_unit(details["position_angles"], u.deg, "position_angles")
        details["position_angles"] = _spread(angles, (len(values),), f"{name}: position_angles")
    frames, ny, nx = values.shape
    middle = [(nx - 1) / 2, (ny - 1) / 2]
    position = to_unit(middle if center is None else center, u.pix, f"{name}: center")
    require_finite(position, f"{name}: center")
    scale = _spread(to_arcsec(pixelscale, "pixelscale"), (2,), f"{name}: pixelscale")
    if not (np.isfinite(scale) & (scale > 0)).all():
        raise IncompatibleSetupError(
            f"{name}: pixelscale: got {pixelscale}, expected a positive number of arcsec per "
            "pixel, such as 0.0624"
        )
    return {
        "data": values,
        "error": sigma,
        "valid": mask,
        "unit": unit,
        "pixelscale": (float(scale[0]), float(scale[1])),
        "center": _spread(position, (frames, 2), f"{name}: center"),
        **details,
    }


def selected(frames: Mapping[str, Any], which: NDArray[np.intp]) -> dict[str, Any]:
    """The attributes of an `Observation` that change if frames are selected by their indices."""
    names = ("data", "error", "valid", "center", "position_angles")
    counted = {name: frames.get(name, ()) for name in ("noise_ratios", "integrations")}
    return {
        **{name: frames[name][which] for name in names if frames[name] is not None},
        **{name: tuple(each[k] for k in which) if each else () for name, each in counted.items()},
    }


def _spread(array: NDArray[np.float64], shape: tuple[int, ...], name: str) -> NDArray[np.float64]:
    """Copy of an array, repeated to a shape."""
    try:
        return np.broadcast_to(array, shape).copy()
    except ValueError as error:
        raise ShapeError(f"{name}: got shape {array.shape}, expected {shape}") from error
