"""Frames beyond the pixels on which the star was fitted: background, noise, and matched filter."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from astropy.stats import SigmaClip
from astropy.table import QTable
from numpy.typing import NDArray
from photutils.background import Background2D, MedianBackground
from photutils.psf import ImagePSF, PSFPhotometry
from scipy.ndimage import convolve, map_coordinates
from scipy.signal import fftconvolve

from pyklip_diffrender.detection.field import Image, separation_of
from pyklip_diffrender.detection.templates import pixel_grid
from pyklip_diffrender.refinement import FrameFit
from pyklip_diffrender.scene.observation import Observation

__all__ = ["WholeFrame"]

_FAR = 4.0
"""Separation of the source whose image is taken for all sources far from the star, arcsec. The
occulter takes less than a percent of its light."""

_KERNEL = 15
"""Side of that image, pixels."""

_FINE = 4
"""Positions per pixel, along x and y, at which it is rendered for photometry."""

_BOX = 32
"""Side of the boxes in which the background is estimated, pixels."""

_CORE = 2.0
"""arcsec; closer to the star its residual is no background."""

_OUTLIER = 5.0
"""Standard deviations by which a pixel is brighter than its neighbours allow if it is masked."""

_FITTED = 9
"""Side of the square in which a source is fitted, pixels."""


@dataclass(frozen=True, eq=False)
class WholeFrame:
    """A whole frame with the fitted star and the background removed.

    Attributes
    ----------
    fit : FrameFit
        Fit of the star in the pixels about it.
    observation : Observation
        The same observation, with all of its pixels.
    roll : float
        Rotation of the sky from the first frame to this one, degrees.
    """

    fit: FrameFit
    observation: Observation
    roll: float

    @cached_property
    def grid(self) -> Image:
        """x, y of all pixels from the star, (ny, nx, 2), arcsec."""
        center = self.observation.center[0]
        return pixel_grid(
            *self.fit.on_pixels(self.observation.shape, (float(center[0]), float(center[1])))
        )

    @cached_property
    def residual(self) -> Image:
        """Data without star and background, (ny, nx); 0 where masked."""
        combined = self.observation.combined()
        x, y = self.observation.center[0]
        star = self.fit.render(self.observation.shape, (float(x), float(y)), background=False)
        image = np.asarray(combined.data[0] - star)
        unused = ~combined.valid[0] | (separation_of(self.grid) < _CORE)
        ground = Background2D(
            np.where(combined.valid[0], image, 0.0),
            _BOX,
            mask=unused,
            exclude_percentile=90.0,
            sigma_clip=SigmaClip(sigma=3.0),
            bkg_estimator=MedianBackground(),
        ).background
        return np.where(combined.valid[0], image - ground, 0.0)

    @cached_property
    def sigma(self) -> Image:
        """Standard deviation of the noise, (ny, nx); inf where masked, and in outliers.

        An outlier is brighter than its neighbours allow: of all positions of a source, that in the
        middle of a pixel leaves the neighbours least of its light.
        """
        combined = self.observation.combined()
        sigma = np.where(combined.valid[0], combined.error[0], np.inf)
        middle = _KERNEL // 2
        cross = np.array([[0, 1, 0], [1, 0, 1], [0, 1, 0]]) / 4
        window = (slice(middle - 1, middle + 2),) * 2
        share = (self.kernel[window] * cross).sum() / self.kernel[middle, middle]
        allowed = np.maximum(convolve(self.residual, cross), 0.0) / share
        uncertain = _OUTLIER * combined.error[0] * math.sqrt(1 + 0.25 / share**2)
        return np.where(self.residual > allowed + uncertain, np.inf, sigma)

    def _source(self, x: float, y: float) -> Image:
        """Source of contrast 1 far from the star, x, y pixels right of and above the middle."""
        model, values = self.fit.on_pixels(_KERNEL)
        scale = np.array(model.detector.pixelscale)
        far = torch.tensor([_FAR, 0.0], dtype=torch.float64)
        values["star_offset"] = far
        values["detector_shift"] = torch.from_numpy(np.array([x, y]) * scale) - far
        with torch.no_grad():
            image = model(torch.from_numpy(np.ascontiguousarray(self.fit.opd)), **values)
        return np.asarray(self.fit.flux * image.double().cpu().numpy())

    @cached_property
    def kernel(self) -> Image:
        """Image of a source of contrast 1 in the middle of a square of pixels."""
        return self._source(0.0, 0.0)

    @cached_property
    def fine_image(self) -> ImagePSF:
        """The same for photutils, sampled more finely than the pixels."""
        fine = np.empty((_FINE * _KERNEL, _FINE * _KERNEL))
        middle = (_FINE - 1) / 2
        for row in range(_FINE):
            for column in range(_FINE):
                # A pixel right of the source's middle sees what a source to its left shows.
                moved = self._source((middle - column) / _FINE, (middle - row) / _FINE)
                fine[row::_FINE, column::_FINE] = moved
        return ImagePSF(fine, oversampling=_FINE)

    @cached_property
    def products(self) -> tuple[Image, Image]:
        """Template times data and template times template, over the variance, at every pixel.

        The template's mean is removed, so that a level that is constant over it does not matter.
        """
        weight = self.sigma**-2.0
        source = self.kernel[::-1, ::-1]
        flat = np.ones_like(source)

        def around(image: Image, kernel: Image) -> Image:
            return np.asarray(fftconvolve(image, kernel, mode="same"))

        total = np.maximum(around(weight, flat), 1e-300)
        mixed = around(weight, source)
        numerator = around(self.residual * weight, source)
        numerator -= around(self.residual * weight, flat) * mixed / total
        information = around(weight, source**2) - mixed**2 / total
        return numerator, np.maximum(information, 0.0)

    def pixels_of(self, offsets: Image) -> Image:
        """Columns and rows, (..., 2), of positions x, y from the star in the first frame."""
        origin = self.grid[0, 0]
        steps = np.stack([self.grid[0, 1] - origin, self.grid[1, 0] - origin], axis=1)
        return np.asarray((offsets @ self._turn.T - origin) @ np.linalg.inv(steps).T)

    def offsets_of(self, pixels: Image) -> Image:
        """x, y from the star in the first frame of columns and rows, (k, 2)."""
        origin = self.grid[0, 0]
        steps = np.stack([self.grid[0, 1] - origin, self.grid[1, 0] - origin], axis=1)
        return np.asarray((origin + pixels @ steps.T) @ self._turn)

    @property
    def _turn(self) -> NDArray[np.float64]:
        angle = math.radians(self.roll)
        return np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])

    def on_first(self, grid: Image) -> tuple[Image, Image]:
        """`products` at the positions of the first frame's pixels; 0 outside this frame."""
        if np.array_equal(grid, self.grid):
            return self.products
        x, y = np.moveaxis(self.pixels_of(grid), -1, 0)
        numerator, information = (
            map_coordinates(image, [y, x], order=3, mode="constant") for image in self.products
        )
        return np.where(information > 0, numerator, 0.0), np.maximum(information, 0.0)

    def photometry(self, offsets: Image, contrasts: Image) -> QTable:
        """Fit point sources, all together, starting from positions and contrasts.

        Returns
        -------
        QTable
            photutils' table, in the order of the sources; the flux is the contrast.
        """
        places = self.pixels_of(offsets)
        start = QTable({"x": places[:, 0], "y": places[:, 1], "flux": contrasts})
        fit = PSFPhotometry(self.fine_image, (_FITTED, _FITTED))
        error = np.where(np.isfinite(self.sigma), self.sigma, 0.0)
        masked = ~np.isfinite(self.sigma)
        return fit(self.residual, error=np.where(masked, 1.0, error), mask=masked,
                   init_params=start)  # fmt: skip
