"""Images of the sky about the star with north up, of all frames together."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from astropy.convolution import Gaussian2DKernel, interpolate_replace_nans
from astropy.io import fits
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from pyklip_diffrender.detection import Detection, combine_frames, image_hdu
from pyklip_diffrender.imaging import SkyModel
from pyklip_diffrender.io.files import replacing
from pyklip_diffrender.io.geometry import rotation_matrix
from pyklip_diffrender.io.keywords import fits_unit
from pyklip_diffrender.reduction.reduction_result import Reduction
from pyklip_diffrender.scene.product_headers import primary_hdu, world_coordinates

__all__ = ["SkyImages"]

Image = NDArray[np.float64]


class SkyImages:
    """Images with north up, or with the orientation of the first frame where north is not known.

    Parameters
    ----------
    reduction : Reduction

    Attributes
    ----------
    grid : ndarray, (n, n, 2)
        x, y of the pixels from the star, arcsec; y is north and x is west.
    """

    def __init__(self, reduction: Reduction) -> None:
        self.detection: Detection = reduction.detection
        self._disk = reduction.disk
        self._templates = self.detection.groups[0][1]
        observation = self.detection.observation
        self.oriented = observation.position_angles is not None
        self._half = max(observation.shape) // 2
        y, x = np.mgrid[-self._half : self._half + 1, -self._half : self._half + 1]
        self.grid = np.sqrt(np.prod(observation.pixelscale)) * np.stack([x, y], axis=-1)
        self.to_sky = rotation_matrix(self.detection.north)

    @cached_property
    def combined(self) -> tuple[Image, Image]:
        """Mean of the frames minus the star, and its standard deviation, in the frames' unit."""
        images, errors = {}, {}
        lights: Sequence[Any] = [0.0] * len(self._templates.frames)
        if self._disk is not None:
            lights = self._disk.light
        # Frames of reference stars may be among those that were fitted.
        for (k, frame), light in zip(self._templates.frames.items(), lights, strict=True):
            subtracted = self.detection.subtracted[k]
            filled = interpolate_replace_nans(subtracted, Gaussian2DKernel(1.0))
            images[k] = np.nan_to_num(filled) + light
            error = frame.observation.combined().error[0]
            errors[k] = np.where(np.isfinite(subtracted), error, np.inf)
        return combine_frames(self._templates, images, errors, self.grid @ self.to_sky)

    @cached_property
    def posterior_mean(self) -> tuple[Image, Image]:
        """Light of neither star nor detector, and its standard deviation, in the frames' unit.

        See `imaging.sky_model`. Point sources have 0.4 to 1 of their peak, least close to the star,
        and no side lobes.
        """
        model = SkyModel(self.detection.fits)
        middle = slice(model.center - self._half, model.center + self._half + 1)
        mean, error = (image[middle, middle] for image in (model.estimate()[0], model.error()))
        return mean, error * self.detection.error_factor.of(self.grid @ self.to_sky)

    @cached_property
    def throughput(self) -> Image:
        """Fraction of the light of a faint source that `combined` has, by a matched filter.

        The fit of the star takes the rest. By linear theory it is the ratio of what the frames say
        of the source's flux with the star marginalised, and with the star known; the light of a
        candidate, which is fitted with the star, is in the image as a whole.
        """
        detection = self.detection
        error = detection.error / detection.error_factor.of(detection.grid)
        return self.turned((detection.photon_error / error) ** 2)

    @property
    def has_disk(self) -> bool:
        """Whether extended light was fitted, which the combined image has and the others lack."""
        return self._disk is not None

    def turned(self, on_frame: Image) -> Image:
        """Interpolate an image on the pixels of the first frame."""
        offsets = torch.from_numpy((self.grid @ self.to_sky).reshape(-1, 2))
        places = self._templates.pixels_of(min(self._templates.frames), offsets)
        values = map_coordinates(on_frame, places, order=1, cval=np.nan)
        return np.asarray(values.reshape(self.grid.shape[:2]))

    def write(self, path: Path) -> Path:
        """Write all images to a FITS file with a world coordinate system."""
        detection = self.detection
        unit = fits_unit(detection.observation.unit)
        mean, error = self.combined
        sky, sky_error = self.posterior_mean
        images = {
            "COMBINED": (mean, unit),
            "COMBINED_ERROR": (error, unit),
            "THROUGHPUT": (self.throughput, ""),
            "POSTERIOR_MEAN": (sky, unit),
            "POSTERIOR_MEAN_ERROR": (sky_error, unit),
            "CONTRAST": (self.turned(detection.contrast), ""),
            "CONTRAST_ERROR": (self.turned(detection.error), ""),
            "SNR": (self.turned(detection.snr), ""),
        }
        wcs = world_coordinates(self.grid @ self.to_sky, detection.observation)
        first = primary_hdu(detection.observation, detection.provenance, detection.sky.mjd)
        hdus = [image_hdu(image, name, unit, wcs) for name, (image, unit) in images.items()]
        with replacing(path) as temporary:
            fits.HDUList([first, *hdus]).writeto(temporary, overwrite=True, checksum=True)
        return path
