"""Stars as headers describe them: names, coordinates and proper motion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from astropy.io import fits

from pyklip_diffrender.io.headers import card_error, header_number, header_text
from pyklip_diffrender.io.names import same_name

__all__ = ["CatalogueStar", "proper_motion", "star_of"]

_COORDINATES: tuple[tuple[str, str], ...] = (("TARG_RA", "TARG_DEC"), ("RA_REF", "DEC_REF"))
"""Cards of the star's coordinates, and of where the telescope pointed."""

_SAME_PLACE = 5.0
"""arcsec between the coordinates of one star in two headers. They may be those of a catalogue's
epoch in one, and of the exposure in the other."""

_SAME_POINTING = 60.0
"""arcsec between the coordinates of one star if its names agree, or if one of the two is where the
telescope pointed."""


@dataclass(frozen=True)
class CatalogueStar:
    """A star as a header describes it.

    Attributes
    ----------
    names : tuple of str
        The proposer's (TARGPROP) and the catalogue's (TARGNAME), where stated.
    coordinates : tuple of float or None
        Right ascension and declination, degrees.
    pointing : bool
        Whether these are the coordinates at which the telescope pointed, for want of the star's.
    """

    names: tuple[str, ...] = ()
    coordinates: tuple[float, float] | None = None
    pointing: bool = False

    @property
    def is_known(self) -> bool:
        """Whether the header says which star it is."""
        return bool(self.names or self.coordinates)

    def is_called(self, name: str) -> bool:
        """Whether one of the names is this one, in any spelling."""
        return any(same_name(name, each) for each in self.names)

    def separation(self, other: CatalogueStar) -> float | None:
        """Arcsec between the coordinates of two headers; None if one has none."""
        if self.coordinates is None or other.coordinates is None:
            return None
        (a, d), (b, e) = np.deg2rad([self.coordinates, other.coordinates])
        # The haversine formula, which keeps its digits at small angles.
        half = np.sin((e - d) / 2) ** 2 + np.cos(d) * np.cos(e) * np.sin((b - a) / 2) ** 2
        return float(np.rad2deg(2 * np.arcsin(np.sqrt(np.clip(half, 0, 1)))) * 3600)

    def is_same(self, other: CatalogueStar) -> bool:
        """Whether two headers describe one star: coordinates decide, names where there are none."""
        alike = any(other.is_called(name) for name in self.names)
        apart = self.separation(other)
        if apart is None:
            return alike
        coarse = alike or self.pointing or other.pointing
        return apart < (_SAME_POINTING if coarse else _SAME_PLACE)


def star_of(header: fits.Header, name: str) -> CatalogueStar:
    """Read which star a header names, and where it is."""
    names = [header_text(header, key, name) for key in ("TARGPROP", "TARGNAME")]
    for keys in _COORDINATES:
        place = [header_number(header, key, name) for key in keys]
        # Files without a target have zeros.
        if None not in place and any(place):
            ra, dec = (float(each or 0.0) for each in place)
            if not -90 <= dec <= 90:
                raise card_error(name, keys[1], dec, "a declination in degrees")
            return CatalogueStar(tuple(filter(None, names)), (ra, dec), keys != _COORDINATES[0])
    return CatalogueStar(tuple(filter(None, names)))


def proper_motion(header: fits.Header, name: str) -> tuple[float, float] | None:
    """Proper motion of the star, arcsec per year (MU_RA, which includes cos Dec, and MU_DEC)."""
    east, north = (header_number(header, key, name) for key in ("MU_RA", "MU_DEC"))
    return None if east is None or north is None else (east, north)
