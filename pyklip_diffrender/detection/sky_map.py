"""Maps of point sources on the sky about the star, from the searches of single reductions.

Places are offsets from the star to the east and to the north, arcsec. Between the pixels of a
search, S/N is interpolated with splines: where the pixels are as large as those of F356W, it
differs from that of a template at the place by an rms of 0.13 or less.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.ndimage import map_coordinates, spline_filter

from pyklip_diffrender.detection.field import Image, pixel_width, pixels_of, separation_of
from pyklip_diffrender.detection.search_result import Detection
from pyklip_diffrender.detection.sky import Positions
from pyklip_diffrender.scene.admission import EPOCH

__all__ = ["LIGHT", "SkyMap", "SkyStack", "common_grid", "date_of", "epochs_of"]

_ORDER = 5
"""Of the splines between pixels. S/N maps have no higher frequencies than images, whose pixels are
just small enough for them."""

LIGHT = 1.5
"""lambda/D from a source at which its light ends, and within which two peaks are one source."""


@dataclass(frozen=True, eq=False)
class SkyMap:
    """What one reduction says of point sources at every place.

    Attributes
    ----------
    name : str
    filter : str
    mjd : float or None
        Epoch.
    north : float
        Position angle of the frame's +y axis, degrees east of north.
    grid : ndarray, (ny, nx, 2)
        x, y of the pixels from the star on the frame, arcsec.
    snr : ndarray, (ny, nx)
        Contrast over its error; 0 where nothing is known.
    error : ndarray, (ny, nx)
        Standard deviation of the contrast; inf where nothing is known.
    noise : ndarray, (ny, nx)
        The S/N without the candidates of this reduction.
    freedom : ndarray, (ny, nx)
        Degrees of freedom of Student's t, which the S/N of noise follows.
    resolution : float
        lambda/D, arcsec.
    star : float or None
        Flux density of the star, Jy.
    threshold : float
        S/N of a candidate of the single search.
    fitted : ndarray, (k, 4)
        East and north of the reduction's own candidates; what is to be added to the contrast of the
        map there, and by what its error is to be multiplied, so that they are those of all
        candidates fitted together.
    """

    name: str
    filter: str
    mjd: float | None
    north: float
    grid: Image
    snr: Image
    error: Image
    noise: Image
    freedom: Image
    resolution: float
    star: float | None = None
    threshold: float = 5.0
    fitted: Image = field(default_factory=lambda: np.zeros((0, 4)))

    @classmethod
    def of(cls, detection: Detection, name: str) -> SkyMap:
        """Maps of a search, with the light of its own candidates only within 1.5 lambda/D of them.

        Farther away their side lobes would pass for sources.
        """
        factor, grid = detection.error_factor, detection.grid
        shape = grid.shape[:2]
        known = np.isfinite(detection.error) & (detection.error > 0)
        known &= np.isfinite(detection.snr)
        noise = np.where(known, np.nan_to_num(detection.residual_snr), 0.0)
        snr = np.where(known, np.nan_to_num(detection.snr), 0.0)
        resolution = float(detection.contrast_curve.meta["resolution_arcsec"])
        offsets = detection.sources.offsets.numpy()
        share = np.zeros(shape)
        for offset in offsets:
            # A smooth edge, because splines ring at sharp ones.
            steps = np.clip(2 * (LIGHT - separation_of(grid - offset) / resolution), 0, 1)
            share = np.maximum(share, (1 - np.cos(np.pi * steps)) / 2)
        plain = cls(
            name=name,
            filter=detection.observation.filter or "unknown",
            mjd=detection.sky.mjd,
            north=detection.sky.north or 0.0,
            grid=grid,
            snr=noise + share * (snr - noise),
            error=np.where(known, detection.error, np.inf),
            noise=noise,
            freedom=np.broadcast_to(factor.freedom, shape),
            resolution=resolution,
            star=detection.sky.star_jansky,
            threshold=detection.threshold,
        )
        places = plain.on_sky(offsets)
        snr_there, _, error_there = plain.at(places)
        own = detection.sources.detection_errors.numpy() * factor.of(offsets)
        inside = np.isfinite(error_there)
        error = np.where(inside, error_there, 1.0)
        missing = detection.sources.contrasts.numpy() - snr_there * error
        fitted = np.column_stack([places, missing, own / error])[inside]
        return replace(plain, fitted=fitted)

    def on_sky(self, offsets: Image) -> Image:
        """East and north of positions x, y from the star on the frame, (..., 2), arcsec."""
        return np.asarray(offsets @ self._turn.T)

    @cached_property
    def _turn(self) -> NDArray[np.float64]:
        """Matrix from x, y to east, north, which is its own inverse: a reflection."""
        return Positions(np.zeros((0, 2)), np.zeros((0, 2, 2)), self.north)._to_sky

    @cached_property
    def _splines(self) -> tuple[Image, Image]:
        """Coefficients of the S/N, and of the Gaussian standard deviations that are as rare."""
        sigmas = self.snr
        if np.isfinite(self.freedom).any():
            tail = stats.t.sf(np.abs(self.snr), self.freedom)
            # Beyond the smallest numbers Student's t does not differ from a Gaussian.
            equivalent = np.where(tail > 0, stats.norm.isf(tail), np.abs(self.snr))
            sigmas = np.copysign(equivalent, self.snr)
        first = spline_filter(self.snr, order=_ORDER)
        return first, first if sigmas is self.snr else spline_filter(sigmas, order=_ORDER)

    @cached_property
    def _information(self) -> Image:
        return np.where(np.isfinite(self.error), self.error, np.inf) ** -2.0

    def at(self, places: Image) -> tuple[Image, Image, Image]:
        """S/N, the same in Gaussian standard deviations, and error of the contrast at places.

        Parameters
        ----------
        places : ndarray, (..., 2)
            East and north of the star, arcsec.

        Returns
        -------
        snr, sigmas, error : ndarray, (...)
            0, 0 and inf outside the map.
        """
        shape = places.shape[:-1]
        columns, rows = pixels_of(self.grid, places.reshape(-1, 2) @ self._turn).T
        ny, nx = self.snr.shape
        edge = 1e-6
        inside = (rows >= -edge) & (rows <= ny - 1 + edge)
        inside &= (columns >= -edge) & (columns <= nx - 1 + edge)
        pixel = [rows, columns]
        information = map_coordinates(self._information, pixel, order=1, mode="nearest")
        known = inside & (information > 0)
        snr, sigmas = (
            np.where(
                known,
                map_coordinates(each, pixel, order=_ORDER, mode="mirror", prefilter=False),
                0.0,
            )
            for each in self._splines
        )
        error = np.where(known, np.where(known, information, 1.0) ** -0.5, np.inf)
        return snr.reshape(shape), sigmas.reshape(shape), error.reshape(shape)

    def fitted_at(self, place: Image) -> tuple[float, float, float]:
        """As `at`, at one place, (2,), with what a fit of the reduction's own candidate adds."""
        snr, sigmas, error = (float(each) for each in self.at(place))
        away = np.hypot(*(self.fitted[:, :2] - place).T)
        if not len(away) or away.min() > self.resolution / 2 or not math.isfinite(error):
            return snr, sigmas, error
        _, _, missing, ratio = self.fitted[int(np.argmin(away))]
        return (snr * error + float(missing)) / (error * float(ratio)), sigmas, error * float(ratio)

    @cached_property
    def curvature(self) -> NDArray[np.float64]:
        """Covariance of the gradient of noise of standard deviation 1, (2, 2), per arcsec^2.

        That is the curvature of the autocorrelation, to the east and to the north.
        """
        spline = spline_filter(self.noise, order=_ORDER)
        used = np.isfinite(self.error) & (np.abs(self.noise) < 4)
        rows, columns = np.nonzero(used)
        step = 0.25

        def along(down: float, right: float) -> Image:
            values = [
                map_coordinates(
                    spline,
                    [rows + k * step * down, columns + k * step * right],
                    order=_ORDER,
                    mode="mirror",
                    prefilter=False,
                )
                for k in (-2, -1, 1, 2)
            ]
            change = values[0] - 8 * values[1] + 8 * values[2] - values[3]
            return np.asarray(change / (12 * step))

        slopes = np.stack([along(0, 1), along(1, 0)])
        per_pixel = slopes @ slopes.T / max(float((self.noise[used] ** 2).sum()), 1e-300)
        steps = np.stack([self.grid[0, 1] - self.grid[0, 0], self.grid[1, 0] - self.grid[0, 0]])
        inverse = np.linalg.inv(steps)
        return np.asarray(self._turn @ inverse @ per_pixel @ inverse.T @ self._turn.T)


@dataclass(frozen=True, eq=False)
class SkyStack:
    """Flux densities of several reductions at the same places, added by filter.

    Attributes
    ----------
    snr, sigmas, error : ndarray, (filters, ...)
        As `SkyMap.at`, of the flux in units of `scales`.
    curvature : ndarray, (filters, 2, 2)
    """

    snr: Image
    sigmas: Image
    error: Image
    curvature: Image

    @classmethod
    def of(
        cls,
        maps: Sequence[SkyMap],
        filters: Sequence[str],
        scales: Mapping[str, float],
        places: Image,
        moves: Mapping[str, Image],
        *,
        fitted: bool = False,
    ) -> SkyStack:
        """Add maps at places, (..., 2), each moved by its own offset (2,).

        With `fitted`, at one place, what fits of candidates say is used, see `SkyMap.fitted_at`.
        """
        shape = (len(filters), *places.shape[:-1])
        information, snr, sigmas = np.zeros(shape), np.zeros(shape), np.zeros(shape)
        curvature = np.zeros((len(filters), 2, 2))
        for each in maps:
            k = filters.index(each.filter)
            moved = places + moves[each.name]
            own_snr, own_sigmas, error = each.fitted_at(moved) if fitted else each.at(moved)
            root = 1 / (error * scales[each.name])
            information[k] += root**2
            snr[k] += root * own_snr
            sigmas[k] += root * own_sigmas
            curvature[k] += each.curvature / sum(other.filter == each.filter for other in maps)
        known = information > 0
        size = np.sqrt(np.where(known, information, 1.0))
        return cls(snr / size, sigmas / size, np.where(known, 1 / size, np.inf), curvature)

    def __getitem__(self, used: NDArray[np.bool_]) -> SkyStack:
        """The pixels that a mask selects, as one axis."""
        return replace(
            self, snr=self.snr[:, used], sigmas=self.sigmas[:, used], error=self.error[:, used]
        )

    @property
    def flux(self) -> Image:
        """Flux in every filter; 0 where it is not known."""
        return np.asarray(self.snr * np.where(np.isfinite(self.error), self.error, 0.0))

    def weights(self, spectra: Image) -> Image:
        """Directions of spectra (k, filters) in units of the errors, (k, filters, ...)."""
        extra = (1,) * (self.error.ndim - 1)
        raw = spectra.reshape(*spectra.shape, *extra) / self.error
        size = np.sqrt((raw**2).sum(axis=1, keepdims=True))
        return np.asarray(np.divide(raw, size, out=np.zeros_like(raw), where=size > 0))

    def amplitude_errors(self, spectra: Image) -> Image:
        """Standard deviations of the amplitudes of spectra, (k, ...)."""
        extra = (1,) * (self.error.ndim - 1)
        raw = spectra.reshape(*spectra.shape, *extra) / self.error
        information = (raw**2).sum(axis=1)
        return np.where(information > 0, information, np.nan) ** -0.5


def date_of(epoch: Sequence[SkyMap]) -> float:
    """Mean date of maps, MJD."""
    return float(np.mean([each.mjd for each in epoch]))


def epochs_of(maps: Sequence[SkyMap]) -> list[list[SkyMap]]:
    """Maps by epoch, in order of time."""
    epochs: list[list[SkyMap]] = []
    for each in sorted(maps, key=lambda m: m.mjd or 0.0):
        if epochs and (each.mjd or 0.0) - (epochs[-1][0].mjd or 0.0) <= EPOCH:
            epochs[-1].append(each)
        else:
            epochs.append([each])
    return epochs


def common_grid(maps: Sequence[SkyMap]) -> Image:
    """East and north of pixels as small as the smallest, over all fields, (n, n, 2)."""
    pixel = min(pixel_width(each.grid) for each in maps)
    reach = max(float(np.abs(each.on_sky(each.grid)).max()) for each in maps)
    count = math.ceil(reach / pixel)
    axis = pixel * np.arange(-count, count + 1)
    # The first axis goes north; east is to the left.
    return np.stack(np.meshgrid(axis[::-1], axis), axis=-1)
