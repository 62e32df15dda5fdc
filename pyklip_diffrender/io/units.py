"""Convert input to float64 arrays in SI units or arcsec, and check it.

All input goes through these functions before it reaches torch, because `torch.as_tensor(1 * u.um)`
is 1.0 and `torch.from_numpy` refuses big-endian arrays. Inputs are never modified.
"""

from __future__ import annotations

import warnings
from typing import Any, Literal

import numpy as np
from astropy import units as u
from numpy.typing import NDArray
from torch import Tensor

from pyklip_diffrender.errors import (
    DiffrenderWarning,
    IncompatibleSetupError,
    NonFiniteError,
    ShapeError,
    UnitError,
)

__all__ = [
    "ARCSEC",
    "Bound",
    "native_float64",
    "require_bound",
    "require_finite",
    "require_positive",
    "require_shape",
    "set_numbers",
    "to_arcsec",
    "to_metres",
    "to_number",
    "to_pair",
    "to_unit",
    "warn_of_rms",
]

Bound = Literal["any", "not negative", "positive"]
"""Which finite numbers a value may be."""

_PLAUSIBLE_RMS = (1e-9, 2e-6)
"""Plausible rms of a wavefront of JWST, m."""

ARCSEC = float((1 * u.arcsec).to_value(u.rad))
"""One arcsecond in radians."""


def native_float64(value: Any) -> NDArray[np.float64]:
    """Copy of an array as contiguous, native-endian, writable float64 (masked values are NaN)."""
    if isinstance(value, np.ma.MaskedArray):
        value = np.ma.filled(value.astype(np.float64), np.nan)
    elif isinstance(value, Tensor):
        value = value.detach().cpu().numpy()
    return np.array(value, dtype=np.float64, order="C")


def to_metres(value: Any, name: str) -> NDArray[np.float64]:
    """Convert a length to metres; see `to_unit`."""
    return to_unit(value, u.m, name)


def to_arcsec(value: Any, name: str) -> NDArray[np.float64]:
    """Convert an angle to arcsec; see `to_unit`."""
    return to_unit(value, u.arcsec, name)


def to_unit(value: Any, unit: str | u.UnitBase, name: str) -> NDArray[np.float64]:
    """Convert a Quantity, or a sequence of them, to a unit; bare numbers already have it.

    `name` is the name of the value in messages.

    Raises
    ------
    UnitError
        If the unit does not convert.
    """
    members = value if isinstance(value, list | tuple) else ()
    if isinstance(value, u.Quantity) or any(isinstance(m, u.Quantity) for m in members):
        value = u.Quantity(value)
        try:
            value = value.to_value(unit)
        except u.UnitConversionError as error:
            raise UnitError(
                f"{name}: got the unit '{value.unit}', expected one that converts to '{unit}'"
            ) from error
    return native_float64(value)


def to_number(value: Any, unit: str | u.UnitBase, name: str, bound: Bound = "any") -> float:
    """Convert a single number or Quantity to a unit; bare numbers already have it.

    Raises
    ------
    UnitError
        If the unit does not convert.
    ShapeError
        For an array, or something that is no number.
    NonFiniteError, IncompatibleSetupError
        For a number that is not finite, or out of bounds.
    """
    try:
        array = to_unit(value, unit, name)
    except (TypeError, ValueError) as error:
        if isinstance(error, UnitError):
            raise
        raise ShapeError(f"{name}: got {value!r}, expected a number") from error
    if array.size != 1:
        raise ShapeError(f"{name}: got shape {array.shape}, expected a single number")
    number = float(array.reshape(()))
    require_bound(number, name, bound, unit)
    return number


def to_bytes(value: Any, name: str) -> float:
    """Convert text such as "2 GB", a Quantity or a number of bytes to bytes.

    Raises
    ------
    UnitError
        For text that is not a number with a unit of memory, or another unit.
    ShapeError, NonFiniteError, IncompatibleSetupError
        See `to_number`; 0 is out of bounds.
    """
    if isinstance(value, str):
        try:
            value = u.Quantity(value)
        except (TypeError, ValueError) as error:
            raise UnitError(f"{name}: got {value!r}, expected memory such as '2 GB'") from error
    return to_number(value, u.byte, name, "positive")


def to_pair(
    value: Any, unit: str | u.UnitBase, name: str, bound: Bound = "any"
) -> tuple[float, float]:
    """Convert two numbers or Quantities, or one that stands for both, to a unit.

    Raises
    ------
    UnitError, ShapeError, NonFiniteError, IncompatibleSetupError
        As `to_number`.
    """
    array = to_unit(value, unit, name)
    if array.size not in (1, 2):
        raise ShapeError(f"{name}: got shape {array.shape}, expected one number or two")
    pair = np.broadcast_to(array.ravel(), (2,))
    x, y = (to_number(each, unit, name, bound) for each in pair)
    return x, y


def require_bound(
    number: float, name: str, bound: Bound, unit: str | u.UnitBase = u.dimensionless_unscaled
) -> None:
    """Check that a number is finite and within its bound.

    Raises
    ------
    NonFiniteError, IncompatibleSetupError
    """
    if not np.isfinite(number):
        raise NonFiniteError(f"{name}: got {number}, expected a finite number")
    if (bound == "positive" and not number > 0) or (bound == "not negative" and number < 0):
        expected = "a positive number" if bound == "positive" else "0 or more"
        raise IncompatibleSetupError(
            f"{name}: got {f'{number:g} {u.Unit(unit)}'.strip()}, expected {expected}"
        )


def require_positive(**values: float | None) -> None:
    """Raise `IncompatibleSetupError` for values that are not positive; None and inf pass."""
    for name, value in values.items():
        if value is not None and not value > 0:
            raise IncompatibleSetupError(f"{name}: got {value}, expected a positive number")


def set_numbers(instance: Any, **fields: tuple[str | u.UnitBase, Bound]) -> None:
    """Convert fields of a frozen dataclass to numbers in their units; see `to_number`."""
    for name, (unit, bound) in fields.items():
        object.__setattr__(instance, name, to_number(getattr(instance, name), unit, name, bound))


def require_shape(array: NDArray[Any], shape: tuple[int | None, ...], name: str, fix: str) -> None:
    """Raise `ShapeError` unless `array` has `shape`, in which None matches any length."""
    good = len(array.shape) == len(shape) and all(
        want is None or got == want for got, want in zip(array.shape, shape, strict=True)
    )
    if not good:
        expected = tuple("any" if n is None else n for n in shape)
        raise ShapeError(f"{name}: got shape {tuple(array.shape)}, expected {expected}. {fix}")


def require_finite(array: NDArray[Any], name: str, where: NDArray[np.bool_] | None = None) -> None:
    """Raise `NonFiniteError` with the number and the first index of values that are not finite."""
    bad = ~np.isfinite(array)
    if where is not None:
        bad &= where
    if bad.any():
        first = tuple(int(i) for i in np.argwhere(bad)[0])
        raise NonFiniteError(
            f"{name}: {int(bad.sum())} values are NaN or infinite, the first at index {first}. "
            "Replace them, or mask them where a mask is taken"
        )


def warn_of_rms(rms: float, name: str, stacklevel: int, *, small: bool = True) -> None:
    """Warn of a wavefront rms (m) that suggests another unit.

    Parameters
    ----------
    rms : float
    name : str
        Name of the wavefront in the message.
    stacklevel : int
        As in `warnings.warn`, counted from this function.
    small : bool
        Also warn of an rms that is too small, but not of 0.
    """
    low, high = _PLAUSIBLE_RMS
    if rms == 0 or (low if small else 0.0) < rms < high:
        return
    likely = [unit for unit in ("um", "nm", "mm") if low < rms * u.Unit(unit).to(u.m) < high]
    hint = f"; in {' or '.join(likely)} it would be plausible" if likely else ""
    warnings.warn(
        f"{name}: an rms of {rms:.3g} m inside the pupil is not plausible for JWST{hint}",
        DiffrenderWarning,
        stacklevel=stacklevel,
    )
