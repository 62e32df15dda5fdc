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

    from pyklip_diffrender.imaging import SkyModel
    from pyklip_diffrender.pyklip_backend.settings import DiffrenderSettings
    from pyklip_diffrender.pyklip_backend.subtract import Subtraction

__all__ = ["IMAGES", "ProductImages", "image_of"]

IMAGES = ("cleaned", "subtracted")

Image = NDArray[np.float64]


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
    image = settings.image or "subtracted"
    if image != "subtracted" and not fitted:
        raise IncompatibleSetupError(
            f"image: {image!r} needs the linear model of a fit, which a subtractor of "
            "your own does not have. Use image='subtracted'"
        )
    return image


class ProductImages:
    """The sky in the fitted frames of one wavelength.

    Parameters
    ----------
    subtraction : Subtraction
        With the fits of its pointings.
    """

    def __init__(self, subtraction: Subtraction) -> None:
        self.pointings = subtraction.pointings
        self.fits = list(dict.fromkeys(part.result for part in self.pointings))

    @cached_property
    def sky(self) -> SkyModel:
        """The model of the sky."""
        # Takes a second to import.
        from pyklip_diffrender.imaging import SkyModel

        return SkyModel(self.fits)

    def put_into(self, residuals: Image, added: Image | None = None) -> None:
        """Replace the fitted square of frames, (n, Ny, Nx), by the cleaned image, in place.

        Parameters
        ----------
        residuals : ndarray, (n, Ny, Nx)
            Frames minus their star.
        added : ndarray, (n, Ny, Nx), optional
            Light in copies of the frames that those of the fit do not have.
        """
        sky = self._cleaned(added)
        for part in self.pointings:
            here = self.sky.in_frame(sky, self.fits.index(part.result), part.index)
            pasted = part.paste(here, part.window)
            frames = residuals[part.pointing.frames]
            # Pixels without a value have none in the image either.
            shown = np.isfinite(pasted) & np.isfinite(frames)
            residuals[part.pointing.frames] = np.where(shown, pasted, frames)

    def _cleaned(self, added: Image | None) -> Image:
        light: list[dict[int, Tensor]] = [dict(each) for each in self.sky.light()]
        if added is not None:
            for part in self.pointings:
                group, k = self.fits.index(part.result), part.index
                image = torch.from_numpy(part.mean_light(added))
                known = self.sky.groups[group][0].frames[k].weight > 0
                light[group][k] = light[group][k] + torch.where(known, image, 0.0)
        return np.asarray(self.sky.estimate(light)[0])
