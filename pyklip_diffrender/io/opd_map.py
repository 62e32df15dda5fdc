"""`OPDMap`: a wavefront map together with its origin."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from astropy.time import Time
from numpy.typing import NDArray

from pyklip_diffrender.io.html_repr import html_summary

__all__ = ["FLAT", "OPDMap"]

FLAT = "flat"
"""Word for a flat wavefront in place of a map."""


@dataclass(frozen=True)
class OPDMap:
    """A wavefront map together with its origin.

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
    """

    data: NDArray[np.float64] = field(repr=False)
    date: Time | None
    name: str
    sha256: str = field(repr=False)
    aperture: str = ""
    history: tuple[str, ...] = field(default=(), repr=False)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[np.float64]:
        return np.array(self.data, dtype=dtype)

    def _repr_html_(self) -> str:
        return html_summary(
            f"OPDMap {self.name}",
            {
                "Sensed (UTC)": None if self.date is None else self.date.isot[:19],
                "Sensed at": self.aperture or None,
                "Samples": " x ".join(map(str, self.shape)),
                "Standard deviation": f"{1e9 * self._inside.std():.1f} nm",
            },
        )

    @property
    def _inside(self) -> NDArray[np.float64]:
        """The values that are not 0; a single 0 if there are none."""
        values = self.data[self.data != 0]
        return values if len(values) else np.zeros(1)

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the map."""
        return self.data.shape

    def days_after(self, date: str | Time) -> float | None:
        """Days from `date` (UTC) to the sensing of the map; None if its date is not known."""
        return None if self.date is None else float((self.date - Time(date)).jd)

    def age(self, date: str | Time) -> str:
        """`days_after` in words, such as "3.2 days before"; empty if its date is not known."""
        days = self.days_after(date)
        return "" if days is None else f"{abs(days):.1f} days {'after' if days > 0 else 'before'}"
