"""A frame of the target beyond the fitted pixels: background, noise, and matched filter."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import torch
from astropy.stats import SigmaClip, mad_std
from astropy.table import QTable
from astropy.utils.exceptions import AstropyUserWarning
from numpy.typing import NDArray
from scipy.ndimage import convolve, map_coordinates, uniform_filter
from torch import Tensor

from pyklip_diffrender.detection.field import (
    Image,
    pixels_of,
    separation_of,
)
from pyklip_diffrender.io.units import rotation_matrix
from pyklip_diffrender.optics.grid import fft_convolve
from pyklip_diffrender.optics.planes import Detector
from pyklip_diffrender.parameters import parameter
from pyklip_diffrender.refinement import FrameFit, Refinement
from pyklip_diffrender.refinement.forward import pixel_grid
from pyklip_diffrender.scene.objects import Planet
from pyklip_diffrender.scene.observation import Observation, Window

if TYPE_CHECKING:
    from photutils.psf import ImagePSF

EDGE = 16
"""Pixels within the last valid rows and columns that are not searched: templates are cut off there,
and light scattered by the edge of the occulters' substrate appears in the first rows of every
frame."""

_FAR_SOURCE_ARCSEC = 4.0
"""y from the star, arcsec, of the source whose image all sources far from the star have. The mask
takes less than a percent of its light: bars extend along x."""

_MATCHED_FILTER_PIXELS = 15
"""Side of that image in the matched filter, pixels."""

REACH = 81
"""Side of the image that is subtracted for a source: it has side lobes far from its middle."""

_PER_PIXEL = 4
"""Positions per pixel, along x and y, at which it is rendered for photometry."""

_BACKGROUND_BOX_PIXELS = 32
"""Side of the boxes in which the background is estimated, pixels."""

_STAR_ARCSEC = 2.0
"""arcsec; closer to the star its residual is no background."""

_OUTLIER_SIGMAS = 5.0
"""Standard deviations by which a pixel is brighter than its neighbours allow if it is masked."""

_NOT_CONVERGED = 8
"""Flag of photutils for a fit that has not converged."""

_FIT_PIXELS = 9
"""Side of the square in which a source is fitted, pixels."""


@dataclass(frozen=True, eq=False)
class WholeFrame:
    """A whole frame with the fitted star and the background removed."""

    fit: FrameFit  # Fit of the star in the pixels about it.
    observation: Observation  # The whole frame, of which the fit has a part.
    roll: float  # Rotation of the sky from the first frame to this one, degrees.
    # (k, 3), contrast, and x, y from the star in the first frame, of the sources that were found in
    # the fitted pixels. They are removed as well.
    candidates: Image = field(default_factory=lambda: np.zeros((0, 3)))

    @cached_property
    def grid(self) -> Image:
        """x, y of all pixels from the star, (ny, nx, 2), arcsec."""
        return pixel_grid(*self.fit.on_pixels(self.observation.shape, self._center))

    @property
    def _center(self) -> tuple[float, float]:
        x, y = self.observation.center[0]
        return float(x), float(y)

    @cached_property
    def _bounds(self) -> tuple[tuple[int, int], tuple[int, int]]:
        """First and last column, and row, with at least half of their pixels valid."""
        valid = self.observation.combined().valid[0]
        lines = [np.flatnonzero(valid.mean(axis=axis) >= 0.5) for axis in (0, 1)]
        columns, rows = ((int(k[0]), int(k[-1])) if len(k) else (0, -1) for k in lines)
        return columns, rows

    def searches(self, offsets: Image) -> NDArray[np.bool_]:
        """Whether positions x, y from the star in the first frame, (..., 2), are searched."""
        pixels = self.pixels_of(np.asarray(offsets, dtype=float))
        # Half a pixel further, their centres are still nearest to a searched pixel.
        inside = [
            (pixels[..., k] >= first + EDGE - 0.5) & (pixels[..., k] <= last - EDGE + 0.5)
            for k, (first, last) in enumerate(self._bounds)
        ]
        return np.asarray(inside[0] & inside[1])

    @cached_property
    def stars(self) -> Image:
        """Image of the star and of the candidates, without background, (ny, nx)."""
        shape, center = self.observation.shape, self._center
        image = self.fit.render(shape, center, background=False)
        star = self.fit.values.get("star_offset", np.zeros(2))
        for contrast, *offset in self.candidates:
            x, y = star + self._turn @ offset
            image += contrast * self.fit.render(shape, center, background=False, source=(x, y))
        return image

    @cached_property
    def residual(self) -> Image:
        """Data without star, candidates and background, (ny, nx); 0 where masked."""
        # Imported where it is used, because it imports matplotlib.
        from photutils.background import Background2D, MedianBackground

        combined = self.observation.combined()
        image = np.asarray(combined.data[0] - self.stars)
        separation = separation_of(self.grid)
        # In a small frame, its outer part is used.
        core = min(_STAR_ARCSEC, 0.7 * float(separation[combined.valid[0]].max()))
        unused = ~combined.valid[0] | (separation < core)
        ground = Background2D(
            np.where(combined.valid[0], image, 0.0),
            _BACKGROUND_BOX_PIXELS,
            mask=unused,
            exclude_percentile=90.0,
            sigma_clip=SigmaClip(sigma=3.0),
            bkg_estimator=MedianBackground(),
        ).background
        return np.where(combined.valid[0], image - ground, 0.0)

    @cached_property
    def sigma(self) -> Image:
        """Standard deviation of the noise, (ny, nx); inf where masked, and in outliers."""
        combined = self.observation.combined()
        sigma = np.where(combined.valid[0], combined.error[0], np.inf)
        middle = _MATCHED_FILTER_PIXELS // 2
        cross = np.array([[0, 1, 0], [1, 0, 1], [0, 1, 0]]) / 4
        window = (slice(middle - 1, middle + 2),) * 2
        # An outlier is brighter than its neighbours allow: a source in
        # the middle of a pixel leaves the neighbours least of its light, a mean of `share` of the
        # peak. A pixel may therefore have the mean of its neighbours over `share`, whose variance
        # is the variance of a pixel over 4 share^2.
        share = (self.kernel[window] * cross).sum() / self.kernel[middle, middle]
        allowed = np.maximum(convolve(self.residual, cross), 0.0) / share
        uncertain = _OUTLIER_SIGMAS * combined.error[0] * math.sqrt(1 + 0.25 / share**2)
        # Residuals of the star are sharper than sources, too.
        outlier = (self.residual > allowed + uncertain) & (separation_of(self.grid) > _STAR_ARCSEC)
        return np.where(outlier, np.inf, sigma)

    def _source(self, size: int, x: float = 0.0, y: float = 0.0) -> Image:
        """Source of contrast 1 far from the star, x, y pixels right of and above the middle."""
        model, values = self.fit.on_pixels(size)
        scale = np.array(model.detector.pixelscale)
        far = torch.tensor([0.0, _FAR_SOURCE_ARCSEC], dtype=torch.float64)
        values["star_offset"] = far
        values["detector_shift"] = torch.from_numpy(np.array([x, y]) * scale) - far
        with torch.no_grad():
            image = model(self.fit.opd_for(model), **values)
        return np.asarray(self.fit.flux * image.double().cpu().numpy())

    @cached_property
    def kernel(self) -> Image:
        """Image of a source of contrast 1 in the middle of a square of pixels."""
        return self._source(_MATCHED_FILTER_PIXELS)

    @cached_property
    def _fine(self) -> Image:
        """The kernel, larger and sampled more finely than the pixels."""
        fine = np.empty((_PER_PIXEL * REACH, _PER_PIXEL * REACH))
        middle = (_PER_PIXEL - 1) / 2
        for row in range(_PER_PIXEL):
            for column in range(_PER_PIXEL):
                # A pixel right of the source's middle sees what a source to its left shows.
                moved = self._source(
                    REACH, (middle - column) / _PER_PIXEL, (middle - row) / _PER_PIXEL
                )
                fine[row::_PER_PIXEL, column::_PER_PIXEL] = moved
        return fine

    @cached_property
    def fine_image(self) -> ImagePSF:
        """The fine image as a model for photutils."""
        from photutils.psf import ImagePSF

        return ImagePSF(self._fine, oversampling=_PER_PIXEL)

    @cached_property
    def correlation(self) -> Image:
        """Autocorrelation of the S/N of noise, by distance in pixels."""
        image = fft_convolve(self.kernel, self.kernel[::-1, ::-1], full=True)
        middle, reach = _MATCHED_FILTER_PIXELS - 1, _MATCHED_FILTER_PIXELS // 2
        near = slice(middle - reach, middle + reach + 1)
        return np.asarray(image[near, near] / image[middle, middle])

    @cached_property
    def starlight(self) -> Image:
        """Star over noise, averaged with the squared S/N that a source has in each pixel."""
        weight, squares = self.sigma**-2.0, self.kernel[::-1, ::-1] ** 2
        ratio = np.where(weight > 0, self.stars / self.sigma, 0.0)
        light, total = (fft_convolve(each, squares) for each in (weight * ratio, weight))
        return np.asarray(np.maximum(light, 0) / np.maximum(total, 1e-300))

    def products(self, image: Image) -> tuple[Image, Image]:
        """Template times image and template times template, over the variance, at every pixel."""
        weight = self.sigma**-2.0
        # The template's weighted mean m is removed, so that a level that is constant over it does
        # not matter: sum w d (t - m) and sum w (t - m)^2 with m = sum w t / sum w.
        source = self.kernel[::-1, ::-1]
        flat = np.ones_like(source)

        def around(values: Image, kernel: Image) -> Image:
            return fft_convolve(values, kernel)

        total = np.maximum(around(weight, flat), 1e-300)
        mixed = around(weight, source)
        numerator = around(image * weight, source)
        numerator -= around(image * weight, flat) * mixed / total
        information = around(weight, source**2) - mixed**2 / total
        return numerator, np.maximum(information, 0.0)

    def pixels_of(self, offsets: Image) -> Image:
        """Columns and rows, (..., 2), of positions x, y from the star in the first frame."""
        return pixels_of(self.grid, offsets @ self._turn.T)

    def offsets_of(self, pixels: Image) -> Image:
        """x, y from the star in the first frame of columns and rows, (k, 2)."""
        origin = self.grid[0, 0]
        steps = np.stack([self.grid[0, 1] - origin, self.grid[1, 0] - origin], axis=1)
        return np.asarray((origin + pixels @ steps.T) @ self._turn)

    @property
    def _turn(self) -> NDArray[np.float64]:
        return rotation_matrix(self.roll)

    def window_about(self, offset: Image, size: int) -> tuple[slice, slice]:
        """Rows and columns of a square of pixels about x, y from the star in the first frame."""
        middle = np.rint(self.pixels_of(offset)).astype(int)[::-1]
        begin, end = np.maximum(middle - size // 2, 0), np.maximum(middle + size // 2 + 1, 0)
        return slice(begin[0], end[0]), slice(begin[1], end[1])

    def gaussian(self, window: tuple[slice, slice]) -> Callable[[Image, Image], Image]:
        """Images of sources of contrast 1 with the shape of a Gaussian, in a window of pixels.

        The function takes x, y from the star in the first frame, (2,), arcsec, and the covariance
        of the Gaussian, (2, 2), arcsec^2 along the axes of the first frame; 0 for a point source.
        """
        ny, nx = self.observation.shape
        rows, columns = np.arange(ny)[window[0]], np.arange(nx)[window[1]]
        # Twice as wide as the window, so that its copies on all sides are not seen.
        beyond = max(0, REACH - 2 * max(len(rows), len(columns)) - 1) // 2 * _PER_PIXEL
        fine = self._fine[beyond:-beyond, beyond:-beyond] if beyond else self._fine
        side = len(fine)
        # Cycles per pixel, along rows and columns.
        ky, kx = (
            np.fft.fftfreq(side, 1 / _PER_PIXEL)[:, None],
            np.fft.rfftfreq(side, 1 / _PER_PIXEL),
        )
        # The middle is between two samples.
        middle = (side - 1) / 2 / _PER_PIXEL
        transform = np.fft.rfft2(fine) * np.exp(2j * np.pi * middle * (kx + ky))
        origin = self.pixels_of(np.zeros(2))
        to_pixels = (self.pixels_of(np.eye(2)) - origin).T

        def image(offset: Image, covariance: Image) -> Image:
            x, y = self.pixels_of(offset)
            # The transform of a Gaussian of covariance S is exp(-2 pi^2 k S k), and a shift is
            # a phase.
            (xx, xy), (_, yy) = 2 * np.pi**2 * to_pixels @ covariance @ to_pixels.T
            smoothed = np.exp(-(xx * kx**2 + yy * ky**2 + 2 * xy * kx * ky))
            along_x, along_y = (
                np.exp(-2j * np.pi * k * (place - round(place))) for k, place in ((kx, x), (ky, y))
            )
            moved = np.fft.irfft2(transform * smoothed * along_x * along_y, s=fine.shape)
            samples = [_PER_PIXEL * (p - round(q)) % side for p, q in ((rows, y), (columns, x))]
            return np.asarray(moved[np.ix_(*samples)])

        return image

    def on_first(self, grid: Image, images: Sequence[Image]) -> list[Image]:
        """Images of this frame at the positions of the first frame's pixels; 0 outside it.

        So are they where the last of the images is not positive after the interpolation.
        """
        if np.array_equal(grid, self.grid):
            return list(images)
        x, y = np.moveaxis(self.pixels_of(grid), -1, 0)
        moved = [map_coordinates(each, [y, x], order=3, mode="constant") for each in images]
        return [np.where(moved[-1] > 0, each, 0.0) for each in moved]

    def light(self, offsets: Image, contrasts: Image) -> Image:
        """Image of point sources at x, y from the star in the first frame, (ny, nx)."""
        total = np.zeros(self.observation.shape)
        ny, nx = total.shape
        for (x, y), contrast in zip(self.pixels_of(offsets), contrasts, strict=True):
            half = REACH // 2
            rows = slice(max(round(y) - half, 0), min(round(y) + half + 1, ny))
            columns = slice(max(round(x) - half, 0), min(round(x) + half + 1, nx))
            if rows.start < rows.stop and columns.start < columns.stop:
                row, column = np.mgrid[rows, columns]
                total[rows, columns] += self.fine_image.evaluate(column, row, contrast, x, y)
        return total

    def photometry(
        self, image: Image, offset: Image, contrast: float
    ) -> tuple[Image, Image, float] | None:
        """Fit a point source to an image, starting from its position and contrast.

        Values and errors (3,) are contrast, and x, y from the star in the first frame, arcsec; the
        third result is the reduced chi-squared. None if the source is not where this frame is
        searched, before or after the fit, or if that fails.
        """
        from photutils.psf import PSFPhotometry

        x, y = self.pixels_of(offset)
        if not self.searches(offset) or np.isinf(self.sigma[round(y), round(x)]):
            return None
        start = QTable({"x": [x], "y": [y], "flux": [contrast]})
        unused = np.isinf(self.sigma)
        with warnings.catch_warnings():
            # Of a fit that has not converged, which its flags say as well.
            warnings.simplefilter("ignore", AstropyUserWarning)
            fitted = PSFPhotometry(self.fine_image, (_FIT_PIXELS, _FIT_PIXELS))(
                image, error=np.where(unused, 1.0, self.sigma), mask=unused, init_params=start
            )[0]
        if fitted["flags"] & _NOT_CONVERGED:
            return None
        place = self.offsets_of(np.array([fitted["x_fit"], fitted["y_fit"]], dtype=float))
        values = np.array([fitted["flux_fit"], *place], dtype=float)
        scale = self.fit.model.detector.pixelscale
        variances = np.array([fitted["x_err"], fitted["y_err"]], dtype=float) ** 2
        # Along the axes of the first frame, from which this one may be rolled.
        turned = self._turn.T**2 @ (variances * np.square(scale))
        errors = np.array([fitted["flux_err"], *np.sqrt(turned)], dtype=float)
        usable = np.isfinite(values).all() and (errors > 0).all() and self.searches(place)
        return (values, errors, float(fitted["reduced_chi2"])) if usable else None


# Bright sources beyond the fitted pixels, whose light inside them would keep a fit from converging.

_EDGE_MODEL_ERROR_SIGMAS = 0.5
"""Error of the model at the edges of the fitted pixels, in standard deviations of the noise, above
which a pixel is left out. A source of 0.01 of the star's flux at 3.2 arcsec left four false
candidates there, and one of 0.1 at 1.5 arcsec residuals of four standard deviations."""

_BRIGHTNESS_RATIO, _OUTER_BRIGHTNESS_RATIO, _OUTER_FROM_ARCSEC = 0.2, 0.03, 3.0
"""Brightness of pixels beyond the fitted ones, relative to the brightest of these, from which there
may be such a source, near the star and from a separation on, arcsec. One of 1e-3 of the star's flux
has about 0.2, and one of 7e-5 has 0.045; without one, frames of three stars have up to 0.024."""

_BEYOND_SOURCE_SNR = 50.0
"""Smallest S/N of such a source. The search of whole frames finds the fainter ones."""

_SEEN_LIGHT_SNR = 10.0
"""Smallest S/N of its light in all fitted pixels together: a source of 7e-5 at 3.4 arcsec
was a candidate of S/N 9 there."""

_SAME_ARCSEC = 0.2
"""arcsec between the places of a source in two frames that were aligned roughly."""

_MOST_BEYOND_SOURCES = 5
"""Largest number of such sources in a frame."""

_LEFT_LIGHT_RATIO = 0.3
"""Largest part of a point source's light, in absolute values, that its fit leaves."""

_RIM_PIXELS = 8
"""Pixels beyond the fitted ones from which even faint sources disturb the fit."""

_RIM_SOURCE_SIGMAS = 6.0
"""Smallest S/N of a source there, in standard deviations of the S/N between the sources, at least
1. Without sources, it is 2 in frames of G 7-34, and the highest of 5,600 S/N is 4.4 times that."""

_EDGE_LIGHT_SNR = 5.0
"""Smallest S/N of its light in all fitted pixels of a frame."""

_RIM_SOURCE_CHI2 = 4.0
"""Largest reduced chi-squared of a faint source there: side lobes of another one have 15 to 22, and
stars 1.5 to 2."""


def _pixels_inside(whole: Observation, cut: Observation) -> tuple[slice, slice]:
    """Rows and columns of a whole frame that the fit takes."""
    column, row = np.rint(whole.center[0] - cut.center[0]).astype(int)
    ny, nx = cut.shape
    return slice(row, row + ny), slice(column, column + nx)


def has_bright_pixels_beyond(whole: Observation, cut: Observation) -> bool:
    """Whether a frame may have a bright source beyond the pixels of its cutout."""
    combined = whole.combined()
    valid = combined.valid[0]
    if not valid.any():
        return False
    image = np.where(valid, combined.data[0] - np.median(combined.data[0][valid]), 0.0)
    smooth = uniform_filter(image, 3)
    inside = _pixels_inside(whole, cut)
    x, y = np.indices(smooth.shape)[::-1] - whole.center[0][:, None, None]
    scale_x, scale_y = whole.pixelscale
    away = np.hypot(scale_x * x, scale_y * y)
    share = np.where(away > _OUTER_FROM_ARCSEC, _OUTER_BRIGHTNESS_RATIO, _BRIGHTNESS_RATIO)
    share[away <= _STAR_ARCSEC] = np.inf  # Here the star is the brightest itself.
    share[inside] = np.inf
    outside = smooth > share * smooth[inside].max()
    return bool(outside[EDGE:-EDGE, EDGE:-EDGE].any())


def without_blurred_edges(whole: Observation, cut: Observation) -> Observation:
    """A cutout of a frame without pixels at its edges into which light from beyond them blurs.

    The model of a cutout has no light beyond its edges, and is mirrored there before it is blurred.
    """
    combined = whole.combined()
    # Pixels that are not valid have the mean of those beside them.
    share = uniform_filter(combined.valid[0].astype(float), 3)
    around = uniform_filter(np.where(combined.valid[0], combined.data[0], 0.0), 3)
    around = np.divide(around, share, out=np.zeros_like(around), where=share > 0)
    image = torch.from_numpy(np.where(combined.valid[0], combined.data[0], around))
    sigma = torch.tensor([parameter("blur").start], dtype=image.dtype)

    def blurred(pixels: Tensor) -> Image:
        """Blurred, and mirrored at the edges."""
        ny, nx = pixels.shape
        detector = Detector((ny, nx), whole.pixelscale, 1, pixels.dtype, pixels.device)
        return detector.image(pixels, {"blur": sigma}).numpy()

    y, x = (each.start for each in _pixels_inside(whole, cut))
    (ny, nx), (rows, columns) = cut.shape, whole.shape
    # The cutout may reach beyond the frame, where it is masked.
    inside = np.s_[max(y, 0) : min(y + ny, rows), max(x, 0) : min(x + nx, columns)]
    difference = blurred(image)[inside] - blurred(image[inside])
    wrong = np.zeros(cut.shape, dtype=bool)
    within = np.s_[max(-y, 0) : min(rows - y, ny), max(-x, 0) : min(columns - x, nx)]
    wrong[within] = np.abs(difference) > _EDGE_MODEL_ERROR_SIGMAS * combined.error[0][inside]
    return replace(cut, valid=cut.valid & ~wrong)


def sources_beyond(
    fits: Sequence[FrameFit], wholes: Sequence[Observation], cuts: Sequence[Observation]
) -> tuple[list[Planet], list[Image]]:
    """Bright point sources beyond the fitted pixels, and their light in these pixels, by frame.

    The sources are in the orientation of the first frame. Rough fits of the star do for their
    light, for which only the wavefront counts; contrasts are as wrong as the flux of the star.
    """
    planets: list[Planet] = []
    lights = []
    for fit, whole, cut in zip(fits, wholes, cuts, strict=True):
        frame, inside = WholeFrame(fit, whole, 0.0), _pixels_inside(whole, cut)
        noise = np.where(cut.combined().valid[0], cut.combined().error[0], np.inf)
        light = np.zeros(cut.shape)
        for source in _point_sources(frame, inside):
            own = frame.light(source[None, 1:], source[:1])[inside]
            if np.linalg.norm(own / noise) < _SEEN_LIGHT_SNR:
                continue
            light += own
            planet = Planet.from_offset(*source.tolist()).rotated(-whole.roll_from(wholes[0]))
            if all(math.dist(planet.offset, each.offset) > _SAME_ARCSEC for each in planets):
                planets.append(planet)
        lights.append(light)
    return planets, lights


def sources_at_edges(fit: Refinement, wholes: Sequence[Observation]) -> list[Planet]:
    """Point sources a few pixels beyond the fitted ones, whose light inside them was not fitted.

    They are in the orientation of the first frame. `wholes` are the frames before they were cut.
    """
    first, sources = fit.frames[0].observation, list[Planet]()
    for fitted, whole in zip(fit.frames, wholes, strict=True):
        cut, whole = fitted.observation, whole.combined()
        size = max(cut.shape) + 2 * (EDGE + _RIM_PIXELS)
        part = whole.within(Window.about(whole.center[0], (size, size)))
        inside, noise = _pixels_inside(part, cut), cut.combined()
        frame = WholeFrame(fitted, part, cut.roll_from(first), fit.companions)
        for values in _point_sources(frame, inside, at_edges=True):
            own = frame.light(values[None, 1:], values[:1])[inside] / noise.error[0]
            planet = Planet.from_offset(*values.tolist())
            is_new = all(math.dist(planet.offset, each.offset) > _SAME_ARCSEC for each in sources)
            if is_new and np.linalg.norm(own[noise.valid[0]]) > _EDGE_LIGHT_SNR:
                sources.append(planet)
    return sources


def _point_sources(
    frame: WholeFrame, inside: tuple[slice, slice], *, at_edges: bool = False
) -> list[Image]:
    """Contrast, x and y of point sources beyond the fitted pixels, the brightest first.

    They are bright, or, at the edges of the fitted pixels, above the noise.
    """
    allowed = frame.searches(frame.grid)
    allowed[inside] = False
    sources: list[Image] = []
    if not allowed.any():
        return sources
    image, least = frame.residual, _BEYOND_SOURCE_SNR
    while allowed.any() and len(sources) < _MOST_BEYOND_SOURCES:
        numerator, information = frame.products(image)
        snr = np.zeros_like(numerator)
        np.divide(numerator, np.sqrt(information), snr, where=allowed & (information > 0))
        if at_edges and not sources:
            least = _RIM_SOURCE_SIGMAS * max(float(mad_std(snr[allowed])), 1.0)
        row, column = np.unravel_index(snr.argmax(), snr.shape)
        if snr[row, column] < least:
            break
        place = frame.offsets_of(np.array([column, row]))
        window = frame.window_about(place, _FIT_PIXELS)
        # Its lobes are not looked at again.
        lobes = _SAME_ARCSEC if at_edges else _STAR_ARCSEC
        allowed &= separation_of(frame.grid - frame.grid[row, column]) > lobes
        contrast = float(numerator[row, column] / information[row, column])
        fitted = frame.photometry(image, place, contrast)
        if fitted is None:
            continue
        values, _, chi2 = fitted
        left = image - frame.light(values[None, 1:], values[:1])
        is_point = np.abs(left[window]).sum() < _LEFT_LIGHT_RATIO * np.abs(image[window]).sum()
        if is_point or (at_edges and chi2 < _RIM_SOURCE_CHI2):
            image = left
            sources.append(values)
    return sources
