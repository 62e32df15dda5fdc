"""The pixel array: sampling of the field, and pixel values from the samples."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import torch
from torch import Tensor

from pyklip_diffrender.io.units import ARCSEC
from pyklip_diffrender.optics.differentiation import Cache
from pyklip_diffrender.optics.fourier import MatrixFourier
from pyklip_diffrender.optics.grid import PupilGrid
from pyklip_diffrender.optics.planes import Values, Wavefront

__all__ = ["Detector", "mirrored_convolution"]


@dataclass
class Detector:
    """The pixel array.

    Attributes
    ----------
    shape : tuple of int
        (ny, nx) detector pixels.
    pixelscale : tuple of float
        (x, y) arcsec per pixel.
    oversample : int
        Samples per pixel along each axis; a pixel's value is the mean of its samples times the
        pixel's area, so with 1 it is the intensity at the pixel's centre.
    shear : float
        Increase of y with x on the sky, arcsec per arcsec (0 for square axes).
    centre : tuple of float
        x, y of the middle of the array on the image, arcsec.
    """

    shape: tuple[int, int]
    pixelscale: tuple[float, float]
    oversample: int
    dtype: torch.dtype
    device: torch.device
    shear: float = 0.0
    name: str = "detector"
    centre: tuple[float, float] = (0.0, 0.0)
    parameters: tuple[str, ...] = ("detector_shift", "blur")
    # Not copied by `dataclasses.replace`, because a changed detector has other transforms.
    _transforms: Cache[tuple[float, PupilGrid], MatrixFourier] = field(
        default_factory=Cache, init=False, repr=False, compare=False
    )

    def axes(self, values: Values) -> tuple[Tensor, Tensor]:
        """Sample positions x, y on the image relative to the optical axis, radians."""
        axes = []
        shift = values.get("detector_shift")
        for k, (count, scale) in enumerate(zip(self.shape[::-1], self.pixelscale, strict=True)):
            samples = count * self.oversample
            index = torch.arange(samples, dtype=torch.float64, device=self.device)
            axis = (index - (samples - 1) / 2) * (scale / self.oversample)
            if shift is not None:
                axis = axis - shift[..., k].to(self.device)
            axes.append(axis * ARCSEC + self.centre[k] * ARCSEC)
        return axes[0], axes[1]

    def field(self, wavefront: Wavefront, values: Values) -> Tensor:
        """Field on the samples, (..., oversample ny, oversample nx), |field|^2 per sample."""

        def make() -> MatrixFourier:
            return MatrixFourier(
                wavefront.grid,
                *self.axes(values),
                wavefront.wavelength,
                self.dtype.to_complex(),
                self.shear,
            )

        key = (wavefront.wavelength, wavefront.grid)
        moved = "detector_shift" in values
        transform = make() if moved else self._transforms.kept(key, make)
        return self.per_sample * transform.forward(wavefront.field)

    @property
    def per_sample(self) -> float:
        """Square root of a sample's solid angle, radians: the field on it per field per radian."""
        return math.sqrt(self.pixelscale[0] * self.pixelscale[1]) * ARCSEC / self.oversample

    def image(self, intensity: Tensor, values: Values) -> Tensor:
        """Pixel values (..., ny, nx) from the intensity on the samples: blur, then binning."""
        if "blur" in values:
            for axis, scale in ((-1, self.pixelscale[0]), (-2, self.pixelscale[1])):
                sigma = values["blur"].reshape(()) * (self.oversample / scale)
                intensity = _blur(intensity, sigma, axis)
        if self.oversample == 1:
            return intensity
        ny, nx = self.shape
        k = self.oversample
        return intensity.reshape(*intensity.shape[:-2], ny, k, nx, k).sum(dim=(-3, -1))


def _blur(image: Tensor, sigma: Tensor, axis: int) -> Tensor:
    """Band-limited Gaussian convolution along one axis, mirrored at the edges.

    Below half a sample a sampled Gaussian is a poor filter; its transform, cut at the Nyquist
    frequency, is exact for a well-sampled image.
    """
    reach = 16
    frequency = (torch.arange(64, dtype=torch.float64, device=image.device) + 0.5) / 128
    gain = torch.exp(-2 * (math.pi * sigma.to(image.device) * frequency) ** 2)
    lag = torch.arange(-reach, reach + 1, dtype=torch.float64, device=image.device)
    kernel = (gain * torch.cos(2 * math.pi * frequency * lag[:, None])).mean(dim=1)
    matrix = mirrored_convolution(kernel / kernel.sum(), image.shape[axis]).to(image.dtype)
    return image @ matrix.T if axis == -1 else matrix @ image


def mirrored_convolution(kernel: Tensor, count: int) -> Tensor:
    """Matrix (count, count) of the convolution with a symmetric kernel, mirrored at the edges."""
    reach, device = len(kernel) // 2, kernel.device
    lag = torch.arange(-reach, reach + 1, device=device)
    folded = (torch.arange(count, device=device)[:, None] + lag) % (2 * count)
    mirrored = torch.where(folded < count, folded, 2 * count - 1 - folded)
    matrix = torch.zeros(count, count, dtype=torch.float64, device=device)
    return matrix.scatter_add(1, mirrored, kernel.expand(count, -1))
