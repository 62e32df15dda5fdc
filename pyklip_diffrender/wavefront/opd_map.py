"""`OPDMap`: an OPD map together with its origin, checks that it is plausible, and export."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from astropy import units as u
from astropy.io import fits
from astropy.time import Time
from numpy.typing import NDArray

from pyklip_diffrender.errors import DiffrenderWarning, UnitError
from pyklip_diffrender.io.headers import fits_text
from pyklip_diffrender.io.units import require_finite, to_metres
from pyklip_diffrender.optics.grid import JWST_DIAMETER

FLAT = "flat"
"""Word for a flat wavefront in place of a map."""


@dataclass(frozen=True)
class OPDMap:
    """An OPD map together with its origin.

    Attributes
    ----------
    data : ndarray, (npix, npix), float64
        m, OTE entrance-pupil orientation; 0 where the file has no value.
    date : Time or None
        When the wavefront was sensed.
    name : str
        Name of the file, or of the function that made the map.
    sha256 : str
        Hash of the file, or of the data.
    aperture : str
        Field point at which the wavefront was sensed, empty if unknown.
    history : tuple of str
        Processing steps on reading.
    path : Path or None
        File that the map was read from.
    """

    data: NDArray[np.float64] = field(repr=False)
    date: Time | None
    name: str
    sha256: str = field(repr=False)
    aperture: str = ""
    history: tuple[str, ...] = field(default=(), repr=False)
    path: Path | None = field(default=None, repr=False)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[np.float64]:
        return np.array(self.data, dtype=dtype)

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the map."""
        return self.data.shape

    def days_after(self, date: str | Time) -> float | None:
        """Days from `date` (UTC) to the sensing of the map; None if the map has no date."""
        return None if self.date is None else float((self.date - Time(date)).jd)

    def age(self, date: str | Time) -> str:
        """Text for `days_after`, such as "3.2 days before"; empty if the map has no date."""
        days = self.days_after(date)
        return "" if days is None else f"{abs(days):.1f} days {'after' if days > 0 else 'before'}"


def length_unit(unit: str | u.UnitBase) -> u.UnitBase | None:
    """The unit of a map; None if it is not one of length."""
    # STScI writes "meters", "microns".
    spelled = unit.strip().rstrip("s").lower() if isinstance(unit, str) else unit
    known = u.Unit(spelled, parse_strict="silent")
    return known if known.is_equivalent(u.m) else None


# Plausibility checks of OPD maps, and their export as HDULists for poppy and stpsf.

Array = NDArray[np.float64]

LARGEST_RMS = 2e-5
"""m; with a worse wavefront a telescope makes no image in the infrared."""

_ORIENTATIONS: dict[str, Any] = {
    "as it is": lambda a: a,
    "upside down": np.flipud,
    "left to right": np.fliplr,
    "turned by 180 deg": lambda a: a[::-1, ::-1],
}


def check_opd(opd: Array, amplitude: Array, name: str) -> None:
    """Check the size of a map's values (m) and the position of its blank samples.

    Both arrays are (npix, npix); `amplitude` is the pupil's in the orientation that the map should
    have. NonFiniteError if a value inside the pupil is not finite, UnitError if the values are too
    large to be in metres; a warning if the blank samples match the pupil better after a flip or a
    rotation by 180 degrees.
    """
    inside = amplitude > 0
    require_finite(opd, name, inside)
    rms = float(np.std(opd[inside])) if inside.any() else 0.0
    if rms > LARGEST_RMS:
        raise UnitError(
            f"{name}: {rms:.3g} m rms inside the pupil, more than several wavelengths. Maps must "
            "be in metres; maps of the wavefront-sensing software are in microns. Give the map as "
            "a Quantity, or set BUNIT in the file"
        )
    filled = (opd != 0) & np.isfinite(opd)
    if filled.all() or not filled.any():
        return
    mismatch = {turn: float(np.mean(act(filled) != inside)) for turn, act in _ORIENTATIONS.items()}
    best = min(mismatch, key=lambda turn: mismatch[turn])
    if mismatch[best] < 0.5 * mismatch["as it is"]:
        warnings.warn(
            f"{name}: its blank samples match the pupil {best} ({mismatch[best]:.1%} of the "
            f"samples differ, against {mismatch['as it is']:.1%} as it is). Maps must have the "
            "orientation of the entrance pupil, row 0 at the bottom (-V3)",
            DiffrenderWarning,
            stacklevel=3,
        )


def opd_to_hdus(opd: Any) -> fits.HDUList:
    """An OPD (npix, npix), in m, as an HDUList that poppy and stpsf read, for ``nircam.pupilopd``.

    The header has BUNIT, PUPLSCAL, and the origin of an `OPDMap`.
    """
    values = to_metres(opd, "opd")
    header = fits.Header()
    header["BUNIT"] = "m"
    header["PUPLDIAM"] = (JWST_DIAMETER, "[m] side of the array")
    header["PUPLSCAL"] = (JWST_DIAMETER / values.shape[-1], "[m / pixel]")
    header["CONTENTS"] = "OTE OPD, entrance pupil orientation"
    if isinstance(opd, OPDMap):
        header["OPDFILE"] = (fits_text(opd.name), "Origin of the map")
        if opd.aperture:
            header["APERNAME"] = (opd.aperture, "Sensing field point")
        if opd.date is not None:
            header["DATE-OBS"], header["TIME-OBS"] = opd.date.isot.split("T")
        for line in opd.history:
            header.add_history(fits_text(line))
    return fits.HDUList([fits.PrimaryHDU(values, header)])
