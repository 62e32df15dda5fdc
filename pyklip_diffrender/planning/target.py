"""What is seen: the star's brightness, the noise of every pixel, which pixels count."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from pyklip_diffrender.errors import NoValidPixelsError, ShapeError
from pyklip_diffrender.planning.choice import Error
from pyklip_diffrender.scene.objects import Scene
from pyklip_diffrender.scene.observation import Observation

__all__ = ["Target"]


@dataclass(frozen=True)
class Target:
    """A star to be modelled to within its noise.

    Attributes
    ----------
    image : Tensor, (ny, nx), float64
        The star at flux 1.
    flux : float
        Light that the pupil collects, in the unit of the noise.
    sigma : Tensor, (ny, nx)
        Standard deviation of every pixel.
    valid : Tensor of bool, (ny, nx)
    residual : Tensor, (ny, nx), or None
        Data less star and background, where there are data.
    """

    image: Tensor
    flux: float
    sigma: Tensor
    valid: Tensor
    residual: Tensor | None = None

    @classmethod
    def of_scene(cls, scene: Scene, image: Tensor) -> Target:
        """A simulated star: photon noise of star and background, and read noise.

        Parameters
        ----------
        scene : Scene
        image : Tensor, (ny, nx)
            The star at flux 1.
        """
        flux = scene.star.photons
        sigma = torch.sqrt(flux * image + scene.background + scene.read_noise**2)
        return cls(image, flux, sigma, torch.ones_like(image, dtype=torch.bool))

    @classmethod
    def of_observation(cls, observation: Observation, image: Tensor) -> Target:
        """A star in frames: their errors, and the flux at which the image fits them best.

        Raises
        ------
        ShapeError, NoValidPixelsError
        """
        if observation.shape != tuple(image.shape):
            raise ShapeError(
                f"{observation.name}: got {observation.shape} pixels, the model has "
                f"{tuple(image.shape)}"
            )
        combined = observation.combined()
        data = torch.from_numpy(combined.data[0]).to(image.device)
        valid = torch.from_numpy(combined.valid[0]).to(image.device)
        if not bool(valid.any()):
            raise NoValidPixelsError(f"{observation.name}: all pixels are masked")
        sigma = torch.from_numpy(combined.error[0]).to(image.device)
        # Equal weights: those of photon noise would trust the faint pixels only.
        design = torch.stack([image[valid] / image.max(), torch.ones_like(image[valid])], dim=1)
        solution = torch.linalg.lstsq(design, data[valid][:, None]).solution[:, 0]
        flux, level = float(solution[0] / image.max()), float(solution[1])
        return cls(image, max(flux, 0.0), sigma, valid, data - flux * image - level)

    def allowing(self, share: float) -> Target:
        """With a share of the star that the model may miss, in quadrature with the noise."""
        return replace(self, sigma=torch.hypot(self.sigma, share * self.flux * self.image))

    def in_sigma(self, change: Tensor) -> Tensor:
        """A change of the image at flux 1, (..., ny, nx), in units of the noise; 0 if masked."""
        return torch.where(self.valid, self.flux * change / self.sigma, 0.0)

    def unexplained(self, change: Tensor) -> Tensor:
        """As `in_sigma`, less what another flux and a background would explain.

        Every fit has these two free; nothing else is taken off.
        """
        whitened = self.in_sigma(change)[self.valid]
        design = torch.stack(
            [self.in_sigma(self.image)[self.valid], 1 / self.sigma[self.valid]], dim=1
        )
        design = design / torch.linalg.vector_norm(design, dim=0).clamp(min=1e-300)
        solution = torch.linalg.lstsq(design, whitened[:, None]).solution
        left = torch.zeros_like(self.image)
        left[self.valid] = whitened - (design @ solution)[:, 0]
        return left

    def error(self, whitened: Tensor) -> Error:
        """Size of what `in_sigma` or `unexplained` gave."""
        inside = whitened[self.valid].abs()
        return Error(float(inside.square().mean().sqrt()), float(inside.max()))

    @property
    def excess(self) -> float:
        """Mean square of the residual in units of the noise, less 1; 0 without data."""
        if self.residual is None:
            return 0.0
        inside = (self.residual / self.sigma)[self.valid]
        return max(0.0, float(np.square(inside.cpu().numpy()).mean()) - 1.0)
