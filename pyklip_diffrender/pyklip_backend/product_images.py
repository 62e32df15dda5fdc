"""The images that products carry in place of the frames minus their star."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray

from pyklip_diffrender.errors import IncompatibleSetupError

if TYPE_CHECKING:
    from torch import Tensor

    from pyklip_diffrender.detection.maps import Maps
    from pyklip_diffrender.imaging import SkyModel
    from pyklip_diffrender.pyklip_backend.backend_settings import DiffrenderSettings
    from pyklip_diffrender.pyklip_backend.subtract import Subtraction
    from pyklip_diffrender.refinement import FrameFit

__all__ = ["IMAGES", "ProductImages", "image_of"]

IMAGES = ("cleaned", "flux", "subtracted")

Image = NDArray[np.float64]

_BATCH = 320
"""Number of images of planets that are rendered at a time."""


def image_of(settings: DiffrenderSettings, subtraction: Subtraction) -> str:
    """Return which image the products carry.

    Parameters
    ----------
    settings : DiffrenderSettings
    subtraction : Subtraction

    Raises
    ------
    IncompatibleSetupError
        If the image that is asked for needs a linear model, and there is none.
    """
    fitted = bool(subtraction.pointings)
    real = fitted and all(
        part.result.frames[part.index].observation.is_nircam for part in subtraction.pointings
    )
    image = settings.image or ("cleaned" if real else "subtracted")
    if image != "subtracted" and not fitted:
        raise IncompatibleSetupError(
            f"image: {image!r} needs the linear model of a fit, which a subtractor of "
            "your own does not have. Use image='subtracted'"
        )
    return image


class ProductImages:
    """Images of what is not star in the fitted frames of one wavelength.

    Parameters
    ----------
    subtraction : Subtraction
        With the fits of its pointings.
    """

    def __init__(self, subtraction: Subtraction) -> None:
        self.pointings = subtraction.pointings
        self.fits = list(dict.fromkeys(part.result for part in self.pointings))
        self._disk = None if subtraction.reduction is None else subtraction.reduction.disk

    @cached_property
    def sky(self) -> SkyModel:
        """The model of the sky."""
        # Takes a second to import.
        from pyklip_diffrender.imaging import SkyModel

        return SkyModel(self.fits)

    @cached_property
    def maps(self) -> Maps:
        """Inner products of the data with planets."""
        from pyklip_diffrender.detection.groups import groups_of
        from pyklip_diffrender.detection.maps import Maps

        return Maps(groups_of(self.fits))

    @cached_property
    def _peaks(self) -> Image:
        """Peaks of planets of contrast 1 at the pixels of the first frame, (ny, nx)."""
        templates, shape = self.maps.groups[0][1], self.maps.shape
        rows, columns = (axis.ravel() for axis in np.indices(shape))
        peaks = []
        for start in range(0, len(rows), _BATCH):
            row, column = rows[start : start + _BATCH], columns[start : start + _BATCH]
            images = templates.at_pixels(row, column)
            first = images[min(images)].double().numpy()
            peaks.append(first[np.arange(len(row)), row, column])
        return np.concatenate(peaks).reshape(shape)

    @cached_property
    def _extended(self) -> Image | None:
        """The disk as the estimate of the sky would show it, which is made from frames without."""
        disk = self._disk
        if disk is None or not len(disk.offsets):
            return None
        angle = self.fits[0].frames[0].observation.position_angle
        away = disk.offsets[:, None] - self.maps.grid.reshape(-1, 2)
        pixels = np.hypot(*np.moveaxis(away, -1, 0)).argmin(axis=1)
        peaks = disk.contrasts * self._peaks.ravel()[pixels]
        return self.sky.of_sources(disk.offsets, peaks, angle)

    def put_into(self, residuals: Image, image: str, added: Image | None = None) -> None:
        """Replace the fitted square of frames, (n, Ny, Nx), by an image of the sky, in place.

        Parameters
        ----------
        residuals : ndarray, (n, Ny, Nx)
            Frames minus their star.
        image : {"cleaned", "flux"}
        added : ndarray, (n, Ny, Nx), optional
            Light in copies of the frames that those of the fit do not have.
        """
        sky = self._cleaned(added) if image == "cleaned" else self._flux(added)
        for part in self.pointings:
            fit = part.result
            if image == "cleaned":
                in_frame = self.sky.in_frame(sky, self.fits.index(fit), part.index)
            else:
                in_frame = self._on_frame(sky, fit.frames[part.index])
            pasted = part.paste(in_frame, part.window)
            frames = residuals[part.pointing.frames]
            # Pixels without a value have none in the image either.
            shown = np.isfinite(pasted) & np.isfinite(frames)
            residuals[part.pointing.frames] = np.where(shown, pasted, frames)

    def _added(self, added: Image) -> list[dict[int, Tensor]]:
        """Light in copies of the frames by frame of each fit, (1, ny, nx)."""
        light: list[dict[int, Tensor]] = [{} for _ in self.fits]
        for part in self.pointings:
            group, k = self.fits.index(part.result), part.index
            image = torch.from_numpy(part.mean_light(added))
            known = part.result.linear.frames[k].weight > 0
            light[group][k] = torch.where(known, image, 0.0)[None]
        return light

    def _cleaned(self, added: Image | None) -> Image:
        """Posterior mean of the sky, north up."""
        light: list[dict[int, Tensor]] = [dict(each) for each in self.sky.light()]
        if added is not None:
            for images, more in zip(light, self._added(added), strict=True):
                for k, image in more.items():
                    images[k] = images[k] + image
        rest = np.asarray(self.sky.estimate(light)[0])
        return rest if self._extended is None else rest + self._extended

    def _flux(self, added: Image | None) -> Image:
        """Peak of a point source at each pixel of the first frame, with the star marginalised."""
        numerator = self.maps.numerator
        if added is not None:
            numerator = numerator + self.maps.change(self._added(added))[0]
        known = self.maps.information > 0
        contrast = np.divide(
            numerator, self.maps.information, out=np.zeros_like(numerator), where=known
        )
        peaks = np.asarray(contrast * self._peaks)
        if self._extended is None:
            return peaks
        return peaks + self.sky.in_frame(self._extended, 0, min(self.maps.groups[0][1].frames))

    def _on_frame(self, flux: Image, frame: FrameFit) -> Image:
        """A map of the first frame on the pixels of a frame."""
        from pyklip_diffrender.detection.field import pixels_of
        from pyklip_diffrender.imaging.interpolation import interpolation_matrix

        first = self.maps.groups[0][1].origin
        offsets = first.observation.turned(frame.grid.reshape(-1, 2), frame.observation)
        matrix = interpolation_matrix(pixels_of(first.grid, offsets), flux.shape)
        return np.asarray(matrix @ flux.ravel()).reshape(frame.grid.shape[:2])
