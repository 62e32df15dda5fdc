"""From frames to the sky: orientation, epoch and photometric scale of a detection."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from astropy.time import Time
from numpy.typing import NDArray

from pyklip_diffrender.detection.field import Image
from pyklip_diffrender.io.geometry import full_circle
from pyklip_diffrender.refinement import Refinement, jansky_per_unit, star_flux_error

__all__ = ["Positions", "Sky"]


@dataclass(frozen=True)
class Sky:
    """Relation of the frames of a detection to the sky.

    Attributes
    ----------
    north : float or None
        Position angle of the first frame's +y axis, degrees east of north; None if not known.
    mjd : float or None
        Mean of the target's mid-exposures, UTC; None if no frame has a date.
    star : (float, float) or None
        Flux density of the star, as a catalogue states it or else as fitted, and its standard
        deviation, Jy; None where the frames have no photometric calibration. The error is that of
        the diffracted light or of the catalogue, without that of the calibration.
    """

    north: float | None = None
    mjd: float | None = None
    star: tuple[float, float] | None = None

    @classmethod
    def of(cls, fits: Sequence[Refinement], scatter: float = 1.0) -> Sky:
        """Of the frames of the target, with errors multiplied by `scatter`."""
        first = fits[0].frames[0].observation
        frames = [f for fit in fits for f in fit.frames if not f.observation.reference]
        # Where the middle of an exposure is not known, its beginning is near enough for an orbit.
        dates = [
            f.observation.date if f.observation.mid_date is None else f.observation.mid_date
            for f in frames
        ]
        known = [date.mjd for date in dates if date is not None]
        star = None
        # Unknown scales become NaN.
        scales = np.array([jansky_per_unit(frame) for frame in frames], dtype=float)
        if np.isfinite(scales).all():
            flux = np.mean(scales * [frame.flux for frame in frames])
            error = scatter * np.mean(scales * [frame.errors["flux"][0] for frame in frames])
            untied = np.mean([star_flux_error(fit) for fit in fits])
            # As the catalogue states it, because the star follows within a fraction of its error.
            stated = [each for fit in fits if (each := fit.catalogue_flux) is not None]
            value = np.mean(stated) if len(stated) == len(fits) else flux
            star = (float(value), float(np.hypot(error, untied * flux)))
        return cls(
            first.north,
            float(np.mean(known)) if known else None,
            star,
        )

    @property
    def star_jansky(self) -> float | None:
        """Flux density of the star alone."""
        return None if self.star is None else self.star[0]

    @property
    def facts(self) -> dict[str, float | str]:
        """Epoch and star, as far as they are known, for headers."""
        known = {"epoch": self.date, "star_flux_density_jy": self.star_jansky}
        return {name: value for name, value in known.items() if value is not None}

    @property
    def date(self) -> str | None:
        """The epoch in words, to the second."""
        return None if self.mjd is None else Time(self.mjd, format="mjd").isot[:19]


@dataclass(frozen=True)
class Positions:
    """Positions relative to the star with their covariances, on the first frame and on the sky.

    Attributes
    ----------
    offsets : ndarray, (k, 2)
        x, y on the first frame, arcsec.
    covariance : ndarray, (k, 2, 2)
        Of x and y, arcsec^2.
    north : float
        Position angle of +y, degrees east of north.
    """

    offsets: Image
    covariance: Image
    north: float = 0.0

    @property
    def separation(self) -> Image:
        """Separation, arcsec, (k,)."""
        return np.asarray(np.hypot(*self.offsets.T))

    @property
    def frame_angle(self) -> Image:
        """Angle from +y of the first frame, counter-clockwise, degrees, (k,)."""
        x, y = self.offsets.T
        return full_circle(np.asarray(np.rad2deg(np.arctan2(-x, y))))

    @property
    def position_angle(self) -> Image:
        """Position angle, degrees east of north, (k,)."""
        return full_circle(self.frame_angle + self.north)

    @property
    def on_sky(self) -> Image:
        """Offsets to the east (dRA cos Dec) and to the north (dDec), arcsec, (k, 2)."""
        return self.offsets @ self._to_sky.T

    @property
    def _to_sky(self) -> NDArray[np.float64]:
        """Matrix from x, y to east, north: a reflection, because east is left of north."""
        sine, cosine = np.sin(np.deg2rad(self.north)), np.cos(np.deg2rad(self.north))
        return np.array([[-cosine, sine], [sine, cosine]])

    @property
    def sky_covariance(self) -> Image:
        """Covariance of the offsets to the east and to the north, arcsec^2, (k, 2, 2)."""
        turn = self._to_sky
        return np.asarray(turn @ self.covariance @ turn.T)

    @property
    def polar_covariance(self) -> Image:
        """Covariance of separation and position angle, arcsec and degrees, (k, 2, 2)."""
        radial = self.offsets / self.separation[:, None]
        # The position angle grows counter-clockwise, from +y towards -x.
        tangential = np.stack([-radial[:, 1], radial[:, 0]], axis=1)
        degrees = np.rad2deg(tangential / self.separation[:, None])
        jacobian = np.stack([radial, degrees], axis=1)
        return np.asarray(jacobian @ self.covariance @ jacobian.transpose(0, 2, 1))


def deviations_and_correlation(covariance: Image) -> tuple[Image, Image, Image]:
    """Standard deviations and correlation of pairs, (k,) each, from covariances (k, 2, 2)."""
    first, second = np.sqrt(covariance[:, 0, 0]), np.sqrt(covariance[:, 1, 1])
    with np.errstate(invalid="ignore"):
        return first, second, covariance[:, 0, 1] / (first * second)
