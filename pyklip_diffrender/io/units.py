"""Convert input to float64 arrays in SI units or arcsec, and check it; angles and rotations.

All input goes through these functions before it reaches torch, because `torch.as_tensor(1 * u.um)`
is 1.0, `torch.from_numpy` refuses big-endian arrays, and `numpy.asarray` drops the mask and the
unit of most containers. Inputs are never modified.
"""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Callable
from typing import Any, Literal, TypeVar

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

# Angles, and rotations of positions in a plane.

Angle = TypeVar("Angle", float, NDArray[np.float64])


def full_circle(degrees: Angle) -> Angle:
    """Return an angle from 0 to 360 degrees, the range of all position angles."""
    # Twice, because rounding makes 360 of a tiny negative angle.
    return degrees % 360 % 360


def half_circle(degrees: Angle) -> Angle:
    """Return a difference of two angles from -180 to 180 degrees, such as 1 for 0.5 and 359.5."""
    return (degrees + 180) % 360 - 180


def rotation_matrix(degrees: float) -> NDArray[np.float64]:
    """Return the matrix (2, 2) that rotates positions (x, y) counter-clockwise, from +x to +y.

    Columns of positions are multiplied by the matrix from the left, rows by its transpose from the
    right.
    """
    cosine, sine = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return np.array([[cosine, -sine], [sine, cosine]])


def east_and_north(degrees: float) -> NDArray[np.float64]:
    """Return the matrix (2, 2) from x, y of an image to offsets to the east and to the north.

    `degrees` is the position angle of the image's +y axis, east of north. The matrix is a
    reflection, because east is left of north.
    """
    return np.diag([-1.0, 1.0]) @ rotation_matrix(degrees)


# Convert input to float64 arrays in SI units or arcsec, and check it.

Bound = Literal["any", "not negative", "positive"]
"""Range of finite numbers for a value."""

_PLAUSIBLE_RMS = (1e-9, 2e-6)
"""Plausible rms of a wavefront of JWST, m."""

ARCSEC = float((1 * u.arcsec).to_value(u.rad))
"""One arcsecond in radians."""


def native_float64(value: Any) -> NDArray[np.float64]:
    """Copy of an array as contiguous, native-endian, writable float64 (masked values are NaN).

    Units are left out: `to_unit` converts them.
    """
    return _without_unit(value, "array")[0]


def _without_unit(value: Any, name: str) -> tuple[NDArray[np.float64], u.UnitBase | None]:
    """Values as float64, NaN where they are masked, and the unit, None if there is none.

    Taken are numbers, sequences also of quantities, tensors, numpy's and astropy's masked arrays,
    quantities, and columns of tables.
    """
    if isinstance(value, Tensor):
        value = value.detach().cpu().numpy()
    if isinstance(value, list | tuple):
        value = _of_members(value, name)
    if hasattr(value, "uncertainty"):  # NDData, of which `numpy.asarray` has no mask and no unit.
        raise IncompatibleSetupError(
            f"{name}: got {type(value).__name__}, expected an array: a Quantity, or a masked array"
        )
    unit = getattr(value, "unit", None) if isinstance(value, np.ndarray) else None
    mask = None
    if isinstance(value, np.ma.MaskedArray):
        mask, value = np.ma.getmaskarray(value), value.data
    elif hasattr(value, "unmasked"):  # astropy's Masked, also of a Quantity.
        mask, value = value.mask, value.unmasked
    try:
        plain = np.asarray(value)
    except ValueError as error:  # A list of lists of different lengths.
        raise ShapeError(f"{name}: got members of different shapes ({error})") from error
    if plain.dtype.kind in "cmM":
        kinds = {"c": "complex numbers", "m": "time differences", "M": "dates"}
        raise IncompatibleSetupError(
            f"{name}: got {kinds[plain.dtype.kind]} ({plain.dtype}), expected real numbers"
        )
    try:
        values = np.array(plain, dtype=np.float64, order="C")
    except (TypeError, ValueError) as error:
        raise IncompatibleSetupError(
            f"{name}: got {type(value).__name__} ({error}), expected real numbers"
        ) from error
    if mask is not None:
        values[mask] = np.nan
    return values, unit


def _of_members(value: list[Any] | tuple[Any, ...], name: str) -> Any:
    """One Quantity of a sequence with units; other sequences of numbers as they are."""
    if _some(value, lambda each: hasattr(each, "mask")):  # The array would not have it.
        raise IncompatibleSetupError(
            f"{name}: got a {type(value).__name__} with masked members, expected one masked array"
        )
    if not _some(value, lambda each: getattr(each, "unit", None) is not None):
        return [each.detach().cpu() if isinstance(each, Tensor) else each for each in value]
    try:
        return u.Quantity([u.Quantity(each) for each in value])
    except (TypeError, u.UnitsError) as error:
        raise UnitError(
            f"{name}: got members of different units ({error}), expected one unit for all, or none"
        ) from error
    except ValueError as error:
        raise ShapeError(f"{name}: got members of different shapes ({error})") from error


def _some(value: Any, has: Callable[[Any], bool]) -> bool:
    """Whether a member of a sequence, or of a sequence in it, has something."""
    return any(_some(v, has) for v in value) if isinstance(value, list | tuple) else has(value)


_SPELLINGS = {
    "Angstrom": "a aa ang angstrom angstroms",
    "um": "um micron microns micrometer micrometers micrometre micrometres",
    "nm": "nm nanometer nanometers nanometre nanometres",
    "cm": "cm", "m": "m", "s": "s sec", "erg": "erg ergs", "W": "w watt watts",
    "Hz": "hz hertz", "GHz": "ghz", "THz": "thz", "Jy": "jy jansky janskys",
    "photon": "ph photon photons",
    "erg s-1 cm-2 Angstrom-1": "flam", "erg s-1 cm-2 Hz-1": "fnu",
    "photon s-1 cm-2 Angstrom-1": "photlam", "photon s-1 cm-2 Hz-1": "photnu",
}  # fmt: skip
"""Units as files of spectra spell them, synphot's for example, in capitals or not."""

_SPELLED = {
    word: unit
    for unit, words in _SPELLINGS.items()
    for each in words.split()
    for word in (each, each.upper(), each.capitalize())
} | {"mjy": "mJy"}


def unit_of(text: str) -> u.UnitBase | None:
    """Unit in any spelling that files of spectra have; None if the text is no unit.

    "A" is Angstrom, "S" the second, and "4.4um" a value. UnitError for "MJY", mJy or MJy.
    """
    text = text.strip(" []")
    # Also without "mag": astropy's AB is a flux density, of magnitude 0.
    system = re.fullmatch(r"(?i)(?:mag)?[\s_]*\(?(ab|st)\)?[\s_]*(?:mag)?", text)
    if system:
        return u.ABmag if system[1].upper() == "AB" else u.STmag
    words = r"(?<![\d.])[^\W\d_]+"
    text = re.sub(words, lambda word: _SPELLED.get(word[0], word[0]), text)
    if re.search(r"\bMJY\b", text):
        raise UnitError(f"got the unit {text!r}, expected mJy or MJy, in upper and lower case")
    known = u.get_current_unit_registry().registry
    scaled = re.match(r"[\d.]", text) and not re.match(r"1[eE]|10[-+*^]", text)
    if scaled or not all(word in known for word in re.findall(words, text)):
        return None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", u.UnitsWarning)  # Warnings of several slashes.
        for form in ("generic", "fits"):
            unit = u.Unit(text, format=form, parse_strict="silent") if text else None
            if unit is not None and not isinstance(unit, u.UnrecognizedUnit):
                return unit
    return None


def to_mask(value: Any, name: str) -> NDArray[np.bool_]:
    """Copy of logical values, or of 0 and 1, which are False where they are masked.

    IncompatibleSetupError for something else.
    """
    values, unit = _without_unit(value, name)
    known = np.nan_to_num(values, nan=0.0)
    if unit is not None or not np.isin(known, (0.0, 1.0)).all():
        raise IncompatibleSetupError(f"{name}: got numbers, expected True or False for each pixel")
    return known == 1.0


def to_metres(value: Any, name: str) -> NDArray[np.float64]:
    """Convert a length to metres; see `to_unit`."""
    return to_unit(value, u.m, name)


def to_arcsec(value: Any, name: str) -> NDArray[np.float64]:
    """Convert an angle to arcsec; see `to_unit`."""
    return to_unit(value, u.arcsec, name)


def to_unit(value: Any, unit: str | u.UnitBase, name: str) -> NDArray[np.float64]:
    """Convert anything with a unit, or a sequence of it, to a unit; bare numbers already have it.

    `name` is the name of the value in messages. Values that are masked are NaN. UnitError if the
    unit does not convert, or only some values have one; IncompatibleSetupError for complex numbers,
    dates, and uncertainties that are no standard deviations.
    """
    values, own = _without_unit(value, name)
    if own is None:
        return values
    try:
        return np.asarray(own.to(unit, values))
    except u.UnitConversionError as error:
        raise UnitError(
            f"{name}: got the unit '{own}', expected one that converts to '{u.Unit(unit)}'"
        ) from error


def to_number(value: Any, unit: str | u.UnitBase, name: str, bound: Bound = "any") -> float:
    """Convert a single number or Quantity to a unit; bare numbers already have it.

    UnitError if the unit does not convert, ShapeError for an array or something that is no number,
    and see `require_bound`.
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
    """Convert text such as "2 GB", a Quantity or a positive number of bytes to bytes.

    UnitError for text that is not a number with a unit of memory; otherwise see `to_number`.
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
    """Convert two numbers or Quantities, or one for both, to a unit; see `to_number`."""
    array = to_unit(value, unit, name)
    if array.size not in (1, 2):
        raise ShapeError(f"{name}: got shape {array.shape}, expected one number or two")
    pair = np.broadcast_to(array.ravel(), (2,))
    x, y = (to_number(each, unit, name, bound) for each in pair)
    return x, y


def require_bound(number: float, name: str, bound: Bound, unit: str | u.UnitBase) -> None:
    """Raise NonFiniteError, or IncompatibleSetupError for a finite number out of its bound."""
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

    `stacklevel` is counted from this function; `small` also warns of an rms that is too small, but
    not of 0.
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
