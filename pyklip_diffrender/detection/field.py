"""The field of view of a detection: where pixels are relative to the star, and on the sky."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from astropy.time import Time
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from pyklip_diffrender.errors import IncompatibleSetupError, ShapeError
from pyklip_diffrender.instrument.spectrum import vega_flux_density
from pyklip_diffrender.io.units import (
    east_and_north,
    full_circle,
    require_finite,
    to_arcsec,
    to_unit,
)
from pyklip_diffrender.refinement import Refinement, jansky_per_unit, star_flux_error

Image = NDArray[np.float64]


def separation_of(grid: Image) -> Image:
    """Separation of pixels from the star, (ny, nx), from their x, y, (ny, nx, 2)."""
    return np.asarray(np.hypot(grid[..., 0], grid[..., 1]))


def far_from(grid: Image, offsets: Tensor | Image, distance: float) -> NDArray[np.bool_]:
    """Pixels that are at least `distance` from all positions (k, 2), (ny, nx)."""
    far = np.ones(grid.shape[:2], dtype=bool)
    for offset in np.asarray(offsets):
        far &= separation_of(grid - offset) >= distance
    return far


def reaching(grid: Image, inner: float) -> NDArray[np.bool_]:
    """Pixels that reach beyond a separation, arcsec, though their centre may be within it.

    A source beyond it has its maximum in one of them.
    """
    return np.asarray(separation_of(grid) >= inner - pixel_width(grid) / math.sqrt(2))


def pixel_width(grid: Image) -> float:
    """Mean width of a pixel along x, arcsec."""
    return float(np.abs(np.diff(grid[:, :, 0], axis=1)).mean())


def pixels_of(grid: Image, offsets: Image) -> Image:
    """Columns and rows, (..., 2), of positions x, y from the star on a regular grid."""
    origin = grid[0, 0]
    steps = np.stack([grid[0, 1] - origin, grid[1, 0] - origin], axis=1)
    return np.asarray((offsets - origin) @ np.linalg.inv(steps).T)


def is_within(region: NDArray[np.bool_], grid: Image, offsets: Image) -> NDArray[np.bool_]:
    """Whether the pixels nearest to positions (k, 2), arcsec, are in a region (ny, nx)."""
    nearest = np.rint(pixels_of(grid, offsets)).astype(int)
    columns, rows = np.clip(nearest, 0, np.array(region.shape[::-1]) - 1).T
    return np.asarray(region[rows, columns])


def places_of(
    offsets: ArrayLike | None,
    separation: ArrayLike | None,
    position_angle: ArrayLike | None,
    north: float,
) -> ArrayLike:
    """x, y from the star, (k, 2), of positions that are stated in one of two ways.

    `north` is the position angle of the +y axis. Raises `IncompatibleSetupError` for both ways
    together, or for one of separation and position angle alone, `ShapeError` for numbers of them
    that differ, and `NonFiniteError` or `UnitError`.
    """
    given = {
        "offsets": offsets, "separation": separation, "position_angle": position_angle,
    }  # fmt: skip
    names = [name for name, value in given.items() if value is not None]
    if names == ["offsets"]:
        assert offsets is not None
        return offsets
    if names != ["separation", "position_angle"]:
        raise IncompatibleSetupError(
            f"measure: got {' and '.join(names) or 'no position'}, expected either offsets (x, y) "
            "or separation and position_angle"
        )
    polar = to_arcsec(separation, "separation"), to_unit(position_angle, "deg", "position_angle")
    for values, name in zip(polar, names, strict=True):
        require_finite(values, name)
    if (polar[0] < 0).any():
        raise IncompatibleSetupError(
            f"separation: got {polar[0].min():g} arcsec, expected 0 or more. The opposite side of "
            "the star has a position angle that differs by 180 deg"
        )
    try:
        distance, angle = np.broadcast_arrays(*map(np.atleast_1d, polar))
    except ValueError as error:
        shapes = " and ".join(str(each.shape) for each in polar)
        raise ShapeError(
            f"separation, position_angle: got shapes {shapes}, expected one of each for every place"
        ) from error
    turned = np.deg2rad(angle - north)
    return np.stack([-distance * np.sin(turned), distance * np.cos(turned)], axis=-1)


def require_inside(offsets: Image, grid: Image) -> None:
    """Raise `IncompatibleSetupError` for positions (k, 2) outside the field.

    Raises `NonFiniteError` for positions that are not finite.
    """
    require_finite(offsets, "offsets")
    # Pixels have an extent; half a diagonal beyond their centres is still on the detector.
    pixel = np.hypot(*(grid[1, 1] - grid[0, 0])) if min(grid.shape[:2]) > 1 else 0.0
    reach = separation_of(grid).max() + pixel / 2
    distance = separation_of(offsets)
    if (distance > reach).any():
        x, y = offsets[np.argmax(distance)]
        raise IncompatibleSetupError(
            f"offsets: got ({x:.4g}, {y:.4g}) arcsec, {distance.max():.4g} arcsec from the star; "
            f"the corners of the field are within {reach:.3g} arcsec. Give x and y from the star "
            "in arcsec, or with their unit, such as [[-485, 353]] * u.mas"
        )


def curve_separations(grid: Image, separations: ArrayLike | None) -> Image:
    """Separations of a contrast curve, arcsec; default every 0.1 from 0.2 to the nearest edge.

    Raises `IncompatibleSetupError` for a separation that is not positive.
    """
    if separations is None:
        x, y = np.abs(grid[..., 0]), np.abs(grid[..., 1])
        edge = min(x[:, 0].min(), x[:, -1].min(), y[0].min(), y[-1].min())
        return np.arange(0.2, edge + 1e-9, 0.1)
    values = np.atleast_1d(to_arcsec(separations, "separations"))
    if not (values > 0).all():
        raise IncompatibleSetupError(
            f"separations: got {values.tolist()} arcsec, expected positive numbers"
        )
    return values


def ring_pixels(
    grid: Image, separations: Image, most: int
) -> list[tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """Rows and columns of at most `most` pixels at each separation, evenly spread in angle.

    `grid` (ny, nx, 2) and separations are in arcsec; empty where the ring is not on the detector.
    """
    radius = separation_of(grid)
    angle = np.arctan2(grid[..., 0], grid[..., 1])
    half_width = pixel_width(grid) / 2
    rings = []
    for separation in separations:
        rows, columns = np.nonzero(np.abs(radius - separation) <= half_width)
        order = np.argsort(angle[rows, columns])
        if len(order) > most:
            order = order[np.linspace(0, len(order), most, endpoint=False).astype(int)]
        rings.append((rows[order], columns[order]))
    return rings


# From frames to the sky: orientation, epoch and photometric scale of a detection.


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
        deviation, Jy; None where the frames have no photometric calibration. The error
        includes the fit or the catalogue, but not the photometric calibration.
    vega : float or None
        Flux density of Vega magnitude 0 in the filter, Jy; None if it is not known.
    """

    north: float | None = None
    mjd: float | None = None
    star: tuple[float, float] | None = None
    vega: float | None = None

    @classmethod
    def of(cls, fit: Refinement, scatter: float = 1.0) -> Sky:
        """Relation of the target's frames to the sky, with errors multiplied by `scatter`."""
        first = fit.frames[0].observation
        frames = [each for each in fit.frames if not each.observation.reference]
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
            # As the catalogue states it, because the star follows within a fraction of its error.
            value = flux if fit.catalogue_flux is None else fit.catalogue_flux
            star = (float(value), float(np.hypot(error, star_flux_error(fit) * flux)))
        return cls(
            first.north,
            float(np.mean(known)) if known else None,
            star,
            vega_flux_density(first.filter),
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
    """Positions relative to the star with their covariances, on the first frame and on the sky."""

    offsets: Image  # (k, 2), x, y on the first frame, arcsec.
    covariance: Image  # (k, 2, 2), of x and y, arcsec^2.
    north: float = 0.0  # Position angle of +y, degrees east of north.

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
        return self.offsets @ east_and_north(self.north).T

    @property
    def sky_covariance(self) -> Image:
        """Covariance of the offsets to the east and to the north, arcsec^2, (k, 2, 2)."""
        turn = east_and_north(self.north)
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
