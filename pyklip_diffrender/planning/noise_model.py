"""The noise of a scene, the expected drift of its wavefront, and what a fit leaves of an error."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from pyklip_diffrender.errors import NoValidPixelsError, ShapeError
from pyklip_diffrender.linear.mode_fields import NANOMETRE
from pyklip_diffrender.optics.grid import PupilGrid
from pyklip_diffrender.planning.choice import ModelError
from pyklip_diffrender.scene.objects import Scene
from pyklip_diffrender.scene.observation import Observation
from pyklip_diffrender.wavefront.bases import Basis
from pyklip_diffrender.wavefront.priors import WavefrontPrior

__all__ = ["Drift", "NoiseModel", "RidgeResidual", "least_squares"]


def least_squares(columns: Sequence[Tensor], data: Tensor) -> tuple[list[float], Tensor]:
    """Best-fitting coefficients of columns of any scale, and the residual."""
    design = torch.stack(list(columns), dim=1)
    length = torch.linalg.vector_norm(design, dim=0).clamp(min=1e-300)
    design = design / length
    solution = torch.linalg.lstsq(design, data[:, None]).solution[:, 0]
    return (solution / length).tolist(), data - design @ solution


@dataclass(frozen=True)
class NoiseModel:
    """The image of a star and its noise.

    Attributes
    ----------
    image : Tensor, (ny, nx), float64
        The star at flux 1.
    flux : float
        Light collected by the pupil, in the unit of the noise.
    sigma : Tensor, (ny, nx)
        Standard deviation of every pixel.
    valid : Tensor of bool, (ny, nx)
    residual : Tensor, (ny, nx), or None
        Data minus star and background, if there are data.
    """

    image: Tensor
    flux: float
    sigma: Tensor
    valid: Tensor
    residual: Tensor | None = None

    @classmethod
    def of(cls, subject: Scene | Observation, image: Tensor, share: float = 0.0) -> NoiseModel:
        """Noise of a scene to be simulated, or of frames.

        A scene has photon noise of star and background, and read noise. Frames have their own
        errors, and the flux is that of the best fit of the image.

        Parameters
        ----------
        subject : Scene or Observation
        image : Tensor, (ny, nx)
            The star at flux 1.
        share : float
            Model error as a fraction of the star, added to the noise in quadrature.

        Raises
        ------
        ShapeError, NoValidPixelsError
        """
        residual = None
        if isinstance(subject, Scene):
            flux = subject.star.photons
            sigma = torch.sqrt(flux * image + subject.background + subject.read_noise**2)
            valid = torch.ones_like(image, dtype=torch.bool)
        else:
            if subject.shape != tuple(image.shape):
                raise ShapeError(
                    f"{subject.name}: got {subject.shape} pixels, expected the model's "
                    f"{tuple(image.shape)}"
                )
            frame = subject.combined()
            data, sigma, valid = (
                torch.from_numpy(array[0]).to(image.device)
                for array in (frame.data, frame.error, frame.valid)
            )
            if not bool(valid.any()):
                raise NoValidPixelsError(f"{subject.name}: all pixels are masked")
            # Equal weights, because those of photon noise would rely on the faint pixels only.
            columns = [image[valid], torch.ones_like(image[valid])]
            (flux, level), _ = least_squares(columns, data[valid])
            residual = data - flux * image - level
            flux = max(flux, 0.0)
        return cls(image, flux, torch.hypot(sigma, share * flux * image), valid, residual)

    def in_sigma(self, change: Tensor) -> Tensor:
        """Change of the image at flux 1, (..., ny, nx), in units of the noise; 0 if masked."""
        return torch.where(self.valid, self.flux * change / self.sigma, 0.0)

    def unexplained(self, change: Tensor) -> Tensor:
        """As `in_sigma`, without what a change of flux and background would explain.

        These two are free in every fit.
        """
        columns = [self.in_sigma(self.image)[self.valid], 1 / self.sigma[self.valid]]
        residual = torch.zeros_like(self.image)
        residual[self.valid] = least_squares(columns, self.in_sigma(change)[self.valid])[1]
        return residual

    def error(self, whitened: Tensor) -> ModelError:
        """Size of an image in units of the noise, over the valid pixels."""
        inside = whitened[self.valid].abs()
        return ModelError(float(inside.square().mean().sqrt()), float(inside.max()))


class Drift:
    """Changes of the wavefront drawn from its prior.

    Parameters
    ----------
    prior : WavefrontPrior
    basis : Basis
        All modes.
    seed : int

    Attributes
    ----------
    deviation : Tensor, (modes,)
        Prior standard deviations, nm.
    """

    def __init__(self, prior: WavefrontPrior, basis: Basis, seed: int) -> None:
        self.basis, self.seed = basis, seed
        scales = [prior.scales[name] for name in self.basis.groups]
        per_mode = torch.tensor(scales, dtype=torch.float64)[self.basis.group_index]
        self.deviation = per_mode * prior.shape(self.basis)

    def count(self, cycles: float) -> int:
        """Number of modes up to a spatial frequency."""
        return int((self.basis.frequencies <= cycles).sum())

    def opd(self, which: int, cycles: float, grid: PupilGrid) -> Tensor:
        """Draw number `which`, with its modes up to a spatial frequency, (npix, npix), m."""
        # Plans with different seeds need independent draws.
        generator = torch.Generator().manual_seed(1000 * self.seed + which)
        unit = torch.randn(len(self.basis), generator=generator, dtype=torch.float64)
        drawn = torch.where(self.basis.frequencies <= cycles, self.deviation * unit, 0.0)
        return self.basis.opd(drawn * NANOMETRE, grid)


class RidgeResidual:
    """The residual of an error after a linear fit of wavefront modes with their prior.

    Parameters
    ----------
    slopes : Tensor, (modes, ny, nx), float64
        Change of the image for one prior standard deviation of each mode, in units of the noise;
        0 where masked.
    """

    def __init__(self, slopes: Tensor) -> None:
        self._slopes = slopes.flatten(1)
        self._curvature = self._slopes @ self._slopes.T

    def residual(self, whitened: Tensor, modes: int) -> Tensor:
        """Residual of an error, (ny, nx) in units of the noise, after a fit of the first modes."""
        rows, flat = self._slopes[:modes], whitened.flatten()
        system = self._curvature[:modes, :modes] + torch.eye(len(rows)).to(rows)
        solution = torch.linalg.solve(system, rows @ flat)
        return (flat - solution @ rows).reshape(whitened.shape)
