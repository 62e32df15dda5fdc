"""Convolution of images with kernels that are as large as they are."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft2, next_fast_len, rfft2

Image = NDArray[np.float64]


def fft_convolve(images: Image, kernel: Image, *, full: bool = False) -> Image:
    """Convolve images, (..., ny, nx), with a kernel, (my, mx); zero beyond their edges.

    The result has the size of the images, or, if `full`, every pixel that light gets to,
    (..., ny + my - 1, nx + mx - 1). A kernel is about its pixel (my - 1) // 2, (mx - 1) // 2.
    """
    # As scipy.signal.fftconvolve, whose import loads all of scipy.stats.
    sides = np.array(images.shape[-2:]), np.array(kernel.shape)
    ny, nx = sides[0] + sides[1] - 1
    padded = (next_fast_len(int(ny), real=True), next_fast_len(int(nx), real=True))
    result = irfft2(rfft2(images, padded) * rfft2(kernel, padded), padded)[..., :ny, :nx]
    if not full:
        y, x = (sides[1] - 1) // 2
        result = result[..., y : y + sides[0][0], x : x + sides[0][1]]
    return np.ascontiguousarray(result)
