"""Detector effects as linear, differentiable torch functions: blur, geometry, crosstalk.

Each follows the numerics of stpsf, with kernels cut as in scipy, so that chains of them agree with
stpsf to rounding.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from pyklip_diffrender.errors import ShapeError
from pyklip_diffrender.io.units import native_float64
from pyklip_diffrender.optics.detector import Detector, mirrored_convolution
from pyklip_diffrender.optics.planes import Values

__all__ = ["ChainDetector", "Effect", "GaussianBlur", "LinearResampling", "PixelCrosstalk"]

Effect = Callable[[Tensor], Tensor]


class GaussianBlur:
    """Convolution with a Gaussian as in `scipy.ndimage.gaussian_filter`.

    The kernel is sampled and ends at four standard deviations, rounded to whole samples: widths
    below an eighth of a sample have no effect. The image is mirrored at its edges.

    Parameters
    ----------
    sigma : float or Tensor, ()
        Standard deviation in samples. A tensor may require gradients.
    """

    def __init__(self, sigma: float | Tensor) -> None:
        self.sigma = torch.as_tensor(sigma, dtype=torch.float64)

    def _matrix(self, count: int, like: Tensor) -> Tensor:
        reach = int(4 * float(self.sigma.detach()) + 0.5)
        if reach == 0:
            # As in scipy, the image is unchanged, and so the derivative must be zero.
            return torch.eye(count, dtype=like.dtype, device=like.device)
        lag = torch.arange(-reach, reach + 1, dtype=torch.float64)
        kernel = torch.exp(-0.5 * (lag / self.sigma.cpu()) ** 2)
        kernel = kernel / kernel.sum()
        return mirrored_convolution(kernel, count).to(like.device, like.dtype)

    def __call__(self, image: Tensor) -> Tensor:
        """Blur (..., rows, columns)."""
        down = self._matrix(image.shape[-2], image)
        across = self._matrix(image.shape[-1], image)
        return down @ image @ across.T


class LinearResampling:
    """Bilinear interpolation at given positions, zero outside the image.

    Parameters
    ----------
    rows, columns : array_like, (ny, nx)
        Position in the image of each sample of the result, in samples.
    shape : tuple of int
        Shape of the image.
    """

    def __init__(self, rows: ArrayLike, columns: ArrayLike, shape: tuple[int, int]) -> None:
        y, x = native_float64(rows), native_float64(columns)
        inside = (y >= 0) & (y <= shape[0] - 1) & (x >= 0) & (x <= shape[1] - 1)
        top = np.clip(np.floor(y), 0, shape[0] - 2).astype(np.int64)
        left = np.clip(np.floor(x), 0, shape[1] - 2).astype(np.int64)
        down, right = y - top, x - left
        self._taps = [
            (
                torch.from_numpy((top + i) * shape[1] + left + j),
                torch.from_numpy(
                    np.where(inside, (down if i else 1 - down) * (right if j else 1 - right), 0.0)
                ),
            )
            for i in (0, 1)
            for j in (0, 1)
        ]
        self.shape = shape

    def __call__(self, image: Tensor) -> Tensor:
        """Resample (..., rows, columns)."""
        if image.shape[-2:] != self.shape:
            raise ShapeError(f"image: got {tuple(image.shape[-2:])}, made for {self.shape}")
        flat = image.flatten(-2)
        total = torch.zeros((), dtype=image.dtype, device=image.device)
        for index, weight in self._taps:
            total = total + flat[..., index.to(image.device)] * weight.to(image)
        return total


class PixelCrosstalk:
    """Convolution of pixels with a small kernel of sum 1, zero beyond the edges (IPC, PPC).

    Parameters
    ----------
    kernel : array_like, (odd, odd)
        Distribution of the signal of the middle pixel.
    """

    def __init__(self, kernel: ArrayLike) -> None:
        values = native_float64(kernel)
        if values.ndim != 2 or values.shape[0] % 2 == 0 or values.shape[1] % 2 == 0:
            raise ShapeError(f"kernel: got shape {values.shape}, expected two odd lengths")
        self.kernel = torch.from_numpy(values / values.sum())

    def __call__(self, image: Tensor) -> Tensor:
        """Convolve (..., rows, columns)."""
        # Torch correlates, so the kernel is flipped.
        turned = self.kernel.flip(0, 1).to(image)[None, None]
        padding = (self.kernel.shape[0] // 2, self.kernel.shape[1] // 2)
        images = image.reshape(-1, 1, *image.shape[-2:])
        return torch.nn.functional.conv2d(images, turned, padding=padding).reshape(image.shape)


@dataclass
class ChainDetector(Detector):
    """A detector with effects, before and after the samples are binned to pixels.

    Attributes
    ----------
    on_samples, on_pixels : tuple of Effect
        In order.
    """

    on_samples: tuple[Effect, ...] = ()
    on_pixels: tuple[Effect, ...] = ()

    def image(self, intensity: Tensor, values: Values) -> Tensor:
        """See `Detector.image`; a free blur comes before the other effects."""
        if "blur" in values:
            # Blur the samples without binning them.
            shape, oversample = self.shape, self.oversample
            fine = Detector(
                (shape[0] * oversample, shape[1] * oversample),
                (self.pixelscale[0] / oversample, self.pixelscale[1] / oversample),
                1,
                self.dtype,
                self.device,
            )
            intensity = fine.image(intensity, {"blur": values["blur"]})
        for effect in self.on_samples:
            intensity = effect(intensity)
        image = super().image(intensity, {k: v for k, v in values.items() if k != "blur"})
        for effect in self.on_pixels:
            image = effect(image)
        return image
