"""A star, its planets, and the photons that arrive from them.

The calibration follows appendix A of B. Y. Feng et al., "Exoplanet Imaging via Differentiable
Rendering" (2025): beta Pictoris, two hours, NIRCam F444W.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any

from astropy import units as u

from pyklip_diffrender.io.units import (
    ARCSEC,
    full_circle,
    set_numbers,
    to_arcsec,
    to_number,
    to_pair,
)

BETA_PICTORIS_W2 = 3.182
"""WISE W2 magnitude (4.6 um) of the paper's target."""

ALPHA_PICTORIS_W2 = 0.979
"""WISE W2 magnitude of the paper's reference star."""

PAPER_SEGMENT_GAP = 0.0
"""Width of the mirror's segment gaps, m, that reproduces the paper's photon levels. The paper used
the sampled pupil of webbpsf, which hardly resolves the true width of 7 mm. With it, light that
leaks through the coronagraph makes the star 1.5 times as bright."""

UNOCCULTED_PEAK = 3.71638e-3
"""Fraction of the light collected by the pupil that falls on the brightest pixel of the paper's
star, with the Lyot stop but without the occulter, at 4.5 um."""

_ZERO_POINT = 184.1
"""Flux density of magnitude 0 in F444W, Jy."""

_MJYSR_PER_CPS = 2.516
"""MJy/sr that make one count per second (PHOTMJSR of F444W behind MASK335R)."""

_GAIN = 1.82
"""Electrons per count."""

_QUANTUM_EFFICIENCY = 0.8
"""Electrons per photon."""

_PIXEL_AREA = (0.062424185 * ARCSEC) ** 2
"""Solid angle of a pixel, sr."""

_PEAK_FRACTION = 0.0148002
"""Fraction of a point source's calibrated flux that falls on its brightest pixel. The paper does
not state it; it follows from its other numbers, with its 1.0334e10 photons at contrast 1."""


@dataclass(frozen=True)
class Star:
    """A star and its exposure, in the calibration of the paper.

    Every value may be a Quantity.

    Attributes
    ----------
    w2_magnitude : float
        WISE W2, 4.6 um.
    exposure : float
        Seconds.

    Examples
    --------
    >>> from astropy import units as u
    >>> import pyklip_diffrender as dr
    >>> dr.Star(w2_magnitude=5.5, exposure=2 * u.h).exposure
    7200.0
    """

    w2_magnitude: float = BETA_PICTORIS_W2
    exposure: float = 7200.0

    def __post_init__(self) -> None:
        set_numbers(self, w2_magnitude=(u.mag, "any"), exposure=(u.s, "positive"))

    @property
    def peak_photons(self) -> float:
        """Photons in the brightest pixel of the unocculted star, the paper's contrast of 1."""
        flux = _ZERO_POINT * 10 ** (-0.4 * self.w2_magnitude)
        counts_per_second = flux * 1e-6 / _PIXEL_AREA * _PEAK_FRACTION / _MJYSR_PER_CPS
        return counts_per_second * self.exposure * _GAIN / _QUANTUM_EFFICIENCY

    @property
    def photons(self) -> float:
        """Photons that the star sends into the entrance pupil during the exposure."""
        return self.peak_photons / UNOCCULTED_PEAK


@dataclass(frozen=True)
class Planet:
    """A point source near the star.

    Every value may be a Quantity.

    Attributes
    ----------
    contrast : float
        Ratio of the planet's flux to the star's, before the coronagraph.
    separation : float
        arcsec.
    position_angle : float
        Degrees, counter-clockwise from +y of the image: east of north where north is up. Kept from
        0 to 360.

    Raises
    ------
    UnitError, NonFiniteError, IncompatibleSetupError
        For a value with a wrong unit, or a contrast or separation that is negative.

    Examples
    --------
    >>> from astropy import units as u
    >>> from pyklip_diffrender import Planet
    >>> Planet(1e-6, 600 * u.mas, 54 * u.deg)
    Planet(contrast=1e-06, separation=0.6, position_angle=54.0)
    """

    contrast: float
    separation: float
    position_angle: float = 0.0

    def __post_init__(self) -> None:
        set_numbers(
            self,
            contrast=("", "not negative"),
            separation=(u.arcsec, "not negative"),
            position_angle=(u.deg, "any"),
        )
        object.__setattr__(self, "position_angle", full_circle(self.position_angle))

    @classmethod
    def from_offset(cls, contrast: float, x: Any, y: Any) -> Planet:
        """Make a planet at x, y from the star (arcsec or Quantity, image orientation)."""
        x, y = float(to_arcsec(x, "x")), float(to_arcsec(y, "y"))
        return cls(contrast, math.hypot(x, y), math.degrees(math.atan2(-x, y)))

    def rotated(self, angle: Any) -> Planet:
        """Rotate the planet about the star by `angle` (degrees or Quantity), counter-clockwise."""
        return replace(self, position_angle=self.position_angle + to_number(angle, u.deg, "angle"))

    @property
    def offset(self) -> tuple[float, float]:
        """x, y relative to the star, arcsec, image orientation."""
        angle = math.radians(self.position_angle)
        return -self.separation * math.sin(angle), self.separation * math.cos(angle)


@dataclass(frozen=True)
class Scene:
    """A star, its planets, the background and the read noise.

    Every value may be a Quantity.

    Attributes
    ----------
    star : Star
    planets : tuple of Planet
    star_offset : tuple of float
        x, y of the star relative to the occulter, arcsec.
    read_noise : float
        Photons per pixel, Gaussian.
    background : float
        Photons per pixel.

    Examples
    --------
    >>> import pyklip_diffrender as dr
    >>> scene = dr.Scene(planets=(dr.Planet(1e-6, separation=0.6, position_angle=54),))
    >>> scene.star.exposure
    7200.0
    """

    star: Star = field(default_factory=Star)
    planets: tuple[Planet, ...] = ()
    star_offset: tuple[float, float] = (0.0, 0.0)
    read_noise: float = 42.0
    background: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "planets", tuple(self.planets))
        object.__setattr__(self, "star_offset", to_pair(self.star_offset, u.arcsec, "star_offset"))
        set_numbers(self, read_noise=(u.photon, "not negative"), background=(u.photon, "any"))
