"""`OPDMap`: a wavefront map together with its origin."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from astropy.time import Time
from numpy.typing import NDArray

__all__ = ["OPDMap"]


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

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the map."""
        return self.data.shape

    def days_after(self, date: str | Time) -> float | None:
        """Days from `date` (UTC) to the sensing of the map; None if its date is not known."""
        return None if self.date is None else float((self.date - Time(date)).jd)
