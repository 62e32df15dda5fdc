"""How much of a faint point source's light the subtraction leaves, from the linear model of a fit.

A source adds its image p to the data. Most of it is unlike anything that the wavefront can do to
the star, but some is fitted as starlight, and subtracted. To first order the unknowns of the fit
change by H^-1 G p, where G is the whitened Jacobian and H the curvature of the penalised
chi-squared (see `linear.model`), and the star by the image of that change.

Self-subtraction is larger in a source's wings than in its core, so that the fraction that is left
depends on how the source is measured. Here it is the fraction of the peak: 1 - g . change / g . p
with a Gaussian g of half the width of the source. `pyklip.fakes.gaussfit2d`, by which pyKLIP and
spaceKLIP measure injected sources, adapts its Gaussian to the narrower core that is left, and
agrees with this within 2 % (1 sigma) on NIRCam frames; a fit of the whole image would have about 18
% less.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from astropy.io import fits
from numpy.typing import NDArray
from scipy.interpolate import RegularGridInterpolator
from scipy.ndimage import map_coordinates

from pyklip_diffrender.io.keywords import set_keyword
from pyklip_diffrender.scene.observation import Observation

if TYPE_CHECKING:
    from pyklip_diffrender.detection.templates import Templates
    from pyklip_diffrender.optics.system import OpticalSystem
    from pyklip_diffrender.refinement import Refinement

__all__ = ["on_product", "throughput_map", "write_throughput"]

SPACING = 2
"""Pixels between the positions at which the throughput is computed; between them it is
interpolated."""

_DENSE = 5
"""Pixels about a companion of the fit within which every pixel is computed."""

_INNER = 15
"""Pixels about the star within which every pixel is computed: interpolation would err there by up
to 15 %."""

_CORE = 0.5
"""FWHM in lambda/D of the Gaussian with which a source's peak is measured."""

_BATCH = 256


def throughput_map(
    fit: Refinement, spacing: int = SPACING, inner: float = _INNER
) -> NDArray[np.float64]:
    """Fraction of a faint source's peak that is left, on the pixels of the fit's first frame.

    Companions of the fit are part of its model, so that no light at their places becomes star.

    Parameters
    ----------
    fit : Refinement
        With a linear model.
    spacing : int
        Pixels between the computed positions; next to the star and to companions every pixel is
        computed.
    inner : float
        Pixels about the star within which every pixel is computed.

    Returns
    -------
    ndarray, (ny, nx)
        For sources at the pixel centres; the mean of all frames of the fit.
    """
    from pyklip_diffrender.detection.templates import Templates

    templates = Templates(fit, fit.frames[0])
    ny, nx = fit.frames[0].model.detector.shape
    rows, columns = (np.unique(np.append(np.arange(0, n, spacing), n - 1)) for n in (ny, nx))
    y, x = np.meshgrid(rows, columns, indexing="ij")
    coarse = _at(fit, templates, y.ravel(), x.ravel()).reshape(y.shape)
    every = np.moveaxis(np.indices((ny, nx)), 0, -1)
    filled = np.asarray(RegularGridInterpolator((rows, columns), coarse)(every))
    pixel = math.sqrt(math.prod(fit.model.detector.pixelscale))
    dense = np.hypot(*templates.grid.transpose(2, 0, 1)) <= inner * pixel
    for _, *offset in fit.companions:
        dense |= np.hypot(*(templates.grid - offset).transpose(2, 0, 1)) <= _DENSE * pixel
    filled[dense] = _at(fit, templates, *np.nonzero(dense))
    return filled


def _at(
    fit: Refinement, templates: Templates, rows: NDArray[np.int64], columns: NDArray[np.int64]
) -> NDArray[np.float64]:
    """The throughput of sources at pixels of the first frame."""
    star = np.array([unknown.name != "companions" for unknown in fit.linear.unknowns])
    left = np.empty(len(rows))
    for start in range(0, len(rows), _BATCH):
        part = slice(start, start + _BATCH)
        images = templates.at_pixels(rows[part], columns[part])
        offsets = torch.from_numpy(templates.grid[rows[part], columns[part]])
        change = fit.linear.response(images)
        change[~star] = 0.0
        taken, total = np.zeros(len(offsets)), 0.0
        for k, image in images.items():
            core = _cores(fit.frames[k].model, templates.pixels_of(k, offsets))
            peak = np.einsum("kyx,kyx->k", core, image.numpy())
            share = np.einsum("kyx,kyx->k", core, fit.linear.frames[k].image(change).numpy())
            count = len(fit.frames[k].observation)
            # Where a frame does not show the source, nothing of it is taken.
            taken += count * np.divide(share, peak, out=np.zeros_like(share), where=peak > 0)
            total += count
        left[part] = 1 - taken / total
    return left


def _cores(model: OpticalSystem, places: NDArray[np.float64]) -> NDArray[np.float64]:
    """Gaussians narrower than an image of a source, about rows and columns (2, k): (k, ny, nx)."""
    detector = model.detector
    pixel = math.sqrt(math.prod(detector.pixelscale))
    fwhm = _CORE * model.resolution / pixel
    y, x = (
        np.exp(-4 * math.log(2) * ((np.arange(count) - place[:, None]) / fwhm) ** 2)
        for count, place in zip(detector.shape, places, strict=True)
    )
    return np.asarray(y[:, :, None] * x[:, None, :])


def on_product(
    image: NDArray[np.float64],
    center: NDArray[np.float64],
    shape: tuple[int, int],
    product_center: NDArray[np.float64],
    angle: float,
    flipx: bool = False,
) -> NDArray[np.float64]:
    """Turn a map the way pyKLIP turns frames; NaN beyond its edges.

    Parameters
    ----------
    image : ndarray, (ny, nx)
        Map on the pixels of the first frame.
    center, product_center : ndarray, (2,)
        x, y of the star there and in the product.
    shape : tuple of int
        Of the product.
    angle : float
        Degrees counter-clockwise by which pyKLIP turns the first frame.
    flipx : bool
        See `pyklip.klip.rotate`.
    """
    y, x = np.indices(shape)
    x, y = x - product_center[0], y - product_center[1]
    x = -x if flipx else x
    cosine, sine = math.cos(math.radians(angle)), math.sin(math.radians(angle))
    places = [-x * sine + y * cosine + center[1], x * cosine + y * sine + center[0]]
    return np.asarray(map_coordinates(image, places, order=1, cval=np.nan))


def write_throughput(
    path: Path,
    dataset: Any,
    maps: Sequence[NDArray[np.float64]],
    frames: Sequence[Observation],
    *,
    is_turned: bool,
) -> float:
    """Write maps of the throughput, on the pixels of the products, to a FITS file.

    Parameters
    ----------
    path : Path
    dataset : pyklip.instruments.Instrument.Data
        With the output of the reduction.
    maps : sequence of ndarray, (ny, nx)
        For every wavelength, on the pixels of the first frame.
    frames : sequence of Observation
        These frames.
    is_turned : bool
        Whether pyKLIP has turned north up.

    Returns
    -------
    median : float
        Over the fitted pixels.
    """
    turned = []
    center = np.asarray(dataset.output_centers[0], dtype=float)
    for k, (image, frame) in enumerate(zip(maps, frames, strict=True)):
        angle = frame.position_angle if is_turned else 0.0
        shape = dataset.output.shape[-2:]
        each = on_product(image, frame.center[0], shape, center, angle, dataset.flipx)
        each[np.isnan(dataset.output[0, :, k]).all(axis=0)] = np.inf
        turned.append(each)
    cube = np.array(turned)
    median = float(np.median(cube[np.isfinite(cube)]))
    cube = np.where(np.isnan(cube), 1.0, np.where(np.isinf(cube), np.nan, cube))
    cube = cube[0] if len(cube) == 1 else cube
    hdu = fits.PrimaryHDU(cube.astype(np.float32))
    hdu.header["BUNIT"] = ("", "fraction of a faint point source's peak")
    hdu.header["PSFCENTX"], hdu.header["PSFCENTY"] = center
    hdu.header["STARCENX"], hdu.header["STARCENY"] = center[0] + 1, center[1] + 1
    set_keyword(hdu.header, "DRTHSTEP", SPACING)
    hdu.header.add_comment(
        "Fraction of a faint point source's peak that the subtraction leaves, to first order in "
        "its light, before any high-pass filter. Computed at every DRTHSTEP pixels and next to "
        "the star and companions of the fit, interpolated elsewhere; 1 outside the fitted square. "
        "Detected companions that are in the model (DRKEPT) keep their light."
    )
    hdu.writeto(path)
    return median
