"""The same coronagraph by the paper's recipe, by prysm and by HCIPy, on the same arrays.

Each returns a function from an OPD to an image, with everything that does not depend on the OPD
done beforehand. Their transforms have the other sign in x, so that arrays are mirrored once.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from importlib import import_module
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from benchmarks.speed.setting import WAVELENGTH, Arrays, Setting, coarse_steps, rendered
from pyklip_diffrender.instrument.masks import MASKS
from pyklip_diffrender.io.units import ARCSEC
from pyklip_diffrender.linear.response import downsample
from pyklip_diffrender.optics.grid import PupilGrid
from pyklip_diffrender.optics.planes import kernel

Array = NDArray[np.float64]
Image = Callable[[], Array]

ADAM_STEPS, LEARNING_RATE = 1000, 1e-11


def paper_recipe(arrays: Arrays, device: str, pad: int = 2) -> Callable[[Tensor], Tensor]:
    """The renderer of Feng et al. 2025, section III, as their text has it.

    Complex double precision, an FFT of the padded pupil to the occulter and back, and on to the
    detector's pixels, which the FFT's samples do not fit, by a matrix transform as in webbpsf.
    All is differentiated by autograd. Of the text's "1024 x 1024" the padding is not stated.

    Parameters
    ----------
    arrays : Arrays
    device : str
    pad : int
        Samples per lambda/D on the occulter.
    """
    npix = len(arrays.amplitude)
    size = pad * npix
    axis = torch.fft.fftfreq(size, dtype=torch.float64) * size * (WAVELENGTH / arrays.diameter)
    angle = axis / pad / ARCSEC
    mask = (1 - MASKS["MASK335R"].complement(angle[None, :], angle[:, None])).to(device)
    amplitude = torch.from_numpy(arrays.amplitude).to(device)
    stop = torch.from_numpy(arrays.stop).to(device)
    grid = PupilGrid.full(npix, arrays.diameter)
    pixels = (torch.arange(arrays.pixels) - (arrays.pixels - 1) / 2).double() * arrays.pixel
    rows = kernel(pixels, grid.y, WAVELENGTH, -1).to(device)
    columns = kernel(pixels, grid.x, WAVELENGTH, +1).T.contiguous().to(device)
    # Light per pixel of a pupil whose field is per metre.
    scale = grid.spacing**2 / WAVELENGTH * arrays.pixel

    def image(opd: Tensor) -> Tensor:
        field = amplitude * torch.exp(2j * torch.pi / WAVELENGTH * opd)
        focus = torch.fft.fft2(field, s=(size, size))
        pupil = torch.fft.ifft2(focus * mask)[:npix, :npix]
        intensity: Tensor = (scale * (rows @ (pupil * stop) @ columns)).abs().square()
        return intensity

    return image


def adam(
    image: Callable[[Tensor], Tensor], start: Tensor, setting: Setting
) -> Callable[[], Tensor]:
    """The fit of the paper: a function that takes an Adam step and returns the wavefront."""
    data = torch.from_numpy(setting.observation.data[0]).to(setting.device)
    opd = start.clone().requires_grad_()
    optimiser = torch.optim.Adam([opd], lr=LEARNING_RATE)

    def step() -> Tensor:
        optimiser.zero_grad()
        (setting.scene.star.photons * image(opd) - data).abs().mean().backward()
        optimiser.step()
        return opd

    return step


def star_after_adam(setting: Setting) -> Tensor:
    """The fine image after all steps, taken with the change of a fine image on fewer samples."""
    coarse = coarse_steps(setting.model, setting.measured, setting.coarse[1])
    small = downsample(setting.measured, coarse.npix)
    step = adam(coarse, small, setting)
    for _ in range(20 if setting.quick else ADAM_STEPS):
        opd = step()
    factor = setting.npix // coarse.npix
    change = (opd.detach() - small).repeat_interleave(factor, 0).repeat_interleave(factor, 1)
    return rendered(setting.model, setting.measured + change)


def load(name: str) -> Any:
    """Import an optional library.

    Raises
    ------
    ImportError
        If it, or something that it needs, is not installed.
    """
    with warnings.catch_warnings():
        # prysm 0.21 imports pkg_resources, which says that it will go.
        warnings.simplefilter("ignore")
        return import_module(name)


def _mirrored(array: NDArray[Any]) -> NDArray[Any]:
    return np.ascontiguousarray(array[:, ::-1])


def prysm_image(arrays: Arrays) -> Image:
    """prysm: Babinet's principle with its matrix Fourier transforms.

    Raises
    ------
    ImportError
    """
    propagation = load("prysm.propagation")
    npix, cells = len(arrays.amplitude), arrays.cells
    amplitude, stop, opd = (_mirrored(a) for a in (arrays.amplitude, arrays.stop, arrays.opd))
    axis = torch.from_numpy((np.arange(cells) - cells // 2) * (arrays.cell / ARCSEC))
    blocked = MASKS["MASK335R"].complement(axis[None, :], axis[:, None]).numpy()
    # prysm has mm in pupils and microns in images and for the wavelength; a focal length of 1 m.
    spacing, focal, wave = arrays.diameter / npix * 1e3, 1e3, WAVELENGTH * 1e6
    cell, pixel = arrays.cell * 1e6, arrays.pixel * 1e6
    # Its return to the pupil is not normalised for a round trip (prysm 0.21).
    blocked = blocked * (arrays.cell * arrays.diameter / WAVELENGTH)
    # prysm puts a sample on the axis, the detector has the corner of four pixels there.
    middle = (-pixel / 2, -pixel / 2)

    def image() -> Array:
        field = amplitude * np.exp((2j * np.pi / WAVELENGTH) * opd)
        focus = propagation.focus_fixed_sampling(field, spacing, focal, wave, cell, cells)
        returned = propagation.unfocus_fixed_sampling(
            focus * blocked, cell, focal, wave, spacing, npix
        )
        field_on_detector = propagation.focus_fixed_sampling(
            stop * (field - returned), spacing, focal, wave, pixel, arrays.pixels, shift=middle
        )
        return np.asarray(field_on_detector.real**2 + field_on_detector.imag**2)

    return image


def hcipy_image(arrays: Arrays) -> Image:
    """HCIPy: its LyotCoronagraph, for a mask that is clear outside its array.

    Raises
    ------
    ImportError
    """
    hcipy = load("hcipy")
    npix, cells = len(arrays.amplitude), arrays.cells
    pupil = hcipy.make_pupil_grid(npix, arrays.diameter)
    focus = hcipy.make_uniform_grid([cells, cells], [cells * arrays.cell] * 2)
    pixels = hcipy.make_uniform_grid([arrays.pixels] * 2, [arrays.pixels * arrays.pixel] * 2)
    x, y = (torch.from_numpy(np.asarray(axis)) / ARCSEC for axis in (focus.x, focus.y))
    mask = hcipy.Field(1 - MASKS["MASK335R"].complement(x, y).numpy(), focus)
    amplitude, stop, opd = (
        hcipy.Field(_mirrored(a).ravel(), pupil)
        for a in (arrays.amplitude, arrays.stop, arrays.opd)
    )
    coronagraph = hcipy.LyotCoronagraph(pupil, mask, hcipy.Apodizer(stop), focal_length=1)
    detector = hcipy.FraunhoferPropagator(pupil, pixels, focal_length=1)

    def image() -> Array:
        field = amplitude * np.exp((2j * np.pi / WAVELENGTH) * opd)
        wavefront = detector(coronagraph(hcipy.Wavefront(field, WAVELENGTH)))
        return np.asarray(wavefront.power.shaped)

    return image
