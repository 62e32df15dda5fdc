"""The scene that all rows share: the paper's, with wavefronts from the embedded generator."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from benchmarks.speed.case import Accuracy
from benchmarks.stpsf_data import nircam
from pyklip_diffrender.bridges import from_webbpsf
from pyklip_diffrender.instrument.masks import MASKS
from pyklip_diffrender.instrument.nircam import NIRCAM_LW_PIXELSCALE, nircam_coronagraph
from pyklip_diffrender.io.units import ARCSEC
from pyklip_diffrender.linear.response import downsample
from pyklip_diffrender.optics.grid import PupilGrid
from pyklip_diffrender.optics.system import OpticalSystem
from pyklip_diffrender.scene.objects import PAPER_SEGMENT_GAP, Planet, Scene
from pyklip_diffrender.scene.observation import Observation
from pyklip_diffrender.scene.simulation import simulate
from pyklip_diffrender.wavefront.opd import random_drift, random_opd

sys.path.append(str(Path(__file__).parents[2] / "examples" / "paper"))
from coarse import coarse_steps as coarse_steps

Array = NDArray[np.float64]

WAVELENGTH = 4.5e-6
HOURS = 40.0
CELLS = 4
"""Samples per lambda/D on the occulter, of the codes that are compared with."""


def rendered(model: OpticalSystem, opd: Tensor) -> Tensor:
    """The image of the star, for a wavefront on the fine grid."""
    with torch.no_grad():
        return model(downsample(opd, model.npix))


@dataclass(frozen=True)
class Arrays:
    """The model as arrays on the full grids, for other codes.

    Attributes
    ----------
    amplitude : ndarray, (npix, npix)
        Of the entrance pupil; it collects 1.
    stop : ndarray, (npix, npix), complex
        All that follows the occulter.
    opd : ndarray, (npix, npix)
        m.
    diameter : float
        Of the arrays, m.
    cell, pixel : float
        On the occulter and on the detector, radians.
    cells, pixels : int
        Along one axis; enough cells for the occulter's disc.
    """

    amplitude: Array
    stop: NDArray[np.complex128]
    opd: Array
    diameter: float
    cell: float
    pixel: float
    cells: int
    pixels: int


@dataclass(frozen=True)
class Setting:
    """What all rows are measured on.

    Attributes
    ----------
    quick : bool
        A coarse pupil and a small field: to see whether everything runs.
    device : str
        Of this package and the paper's recipe; the other codes run on the processor.
    """

    quick: bool = False
    device: str = "cpu"

    @property
    def npix(self) -> int:
        """Samples across the fine pupil."""
        return 128 if self.quick else 1024

    @property
    def fov(self) -> int:
        """Pixels along a side of the image."""
        return 24 if self.quick else 80

    @property
    def coarse(self) -> tuple[int, ...]:
        """Pupil samples of the coarse models."""
        return (32, 64) if self.quick else (128, 256, 512)

    @cached_property
    def stpsf(self) -> tuple[Any, dict[str, Any]] | None:
        """stpsf's NIRCam behind MASK335R, without the ND squares, and arguments of its calc_psf.

        None without stpsf or its data, which the environment variable STPSF_PATH names.
        """
        named = os.environ.get("STPSF_PATH", "")
        if not named or find_spec("stpsf") is None:
            return None
        # Absolute, because stpsf joins some of its paths with it twice.
        folder = Path(named).resolve()
        os.environ["STPSF_PATH"] = str(folder)
        instrument = nircam(folder, npix=1024, nd_squares=False)
        return instrument, {
            "monochromatic": WAVELENGTH, "fov_pixels": self.fov, "detector_oversample": 1,
            "add_distortion": False,
        }  # fmt: skip

    @cached_property
    def model(self) -> OpticalSystem:
        """The package's model as it comes, 1024 samples unless quick."""
        return nircam_coronagraph(
            "F444W",
            monochromatic=WAVELENGTH,
            fov_pixels=self.fov,
            segment_gap=PAPER_SEGMENT_GAP,
            npix=self.npix,
            device=self.device,
        )

    @cached_property
    def host_model(self) -> OpticalSystem:
        """The same on the processor."""
        return self.model.with_fidelity(device="cpu")

    @cached_property
    def measured(self) -> Tensor:
        """The wavefront that is known, m."""
        return torch.from_numpy(random_opd(1, npix=self.npix).data).to(self.device)

    @cached_property
    def opd(self) -> Tensor:
        """The true one, 40 hours later, m."""
        change = random_drift(1001, HOURS, npix=self.npix).data
        return self.measured + torch.from_numpy(change).to(self.device)

    @cached_property
    def converged(self) -> OpticalSystem:
        """Plane by plane, the occulter on 16 cells per lambda/D (8 if quick)."""
        return self.host_model.with_fidelity(
            route="planes", occulter_sampling=8.0 if self.quick else 16.0
        )

    @cached_property
    def truth(self) -> Array:
        """The converged image, (ny, nx)."""
        with torch.no_grad():
            return self.converged(self.opd.cpu()).numpy()

    @cached_property
    def scene(self) -> Scene:
        """The paper's: beta Pictoris for two hours, and a planet."""
        return Scene(planets=(Planet(1e-6, 0.6, 54.0),))

    @cached_property
    def star(self) -> Array:
        """Photons that are expected from the star."""
        return self.scene.star.photons * self.truth

    @cached_property
    def noise(self) -> Array:
        """Standard deviation of a pixel, photons."""
        return np.sqrt(self.star + self.scene.read_noise**2)

    @cached_property
    def observation(self) -> Observation:
        """One frame with its noise."""
        return simulate(self.host_model, self.scene, self.opd.cpu(), seed=1)

    def judge(self, image: Tensor | Array) -> Accuracy:
        """Errors of an image of the star: largest over the peak, and rms over the noise."""
        value = image.detach().cpu().numpy() if isinstance(image, Tensor) else image
        difference = value.astype(np.float64) - self.truth
        sigma = self.scene.star.photons * difference / self.noise
        return Accuracy(
            float(np.abs(difference).max() / self.truth.max()), float(np.sqrt((sigma**2).mean()))
        )

    @cached_property
    def arrays(self) -> Arrays:
        """The model for other codes."""
        model = self.host_model
        full = PupilGrid.full(self.npix, model.diameter)
        entrance = model.entrance
        stop = model.pupil_field(torch.zeros(self.npix, self.npix), WAVELENGTH, {})
        # Divided by what came in, the planes behind the occulter are what they do to a 1.
        stop = type(stop)(torch.ones(full.shape, dtype=torch.complex128), WAVELENGTH, full)
        for plane, window in zip(model.between[1:], model.windows({})[1:], strict=True):
            stop = plane.apply(stop, {}, window)
        cell = WAVELENGTH / model.diameter / CELLS
        return Arrays(
            amplitude=entrance.grid.crop(entrance.amplitude, full).numpy(),
            stop=stop.grid.crop(stop.field, full).numpy(),
            opd=self.opd.cpu().numpy(),
            diameter=model.diameter,
            cell=cell,
            pixel=NIRCAM_LW_PIXELSCALE * ARCSEC,
            cells=2 * int(np.ceil(MASKS["MASK335R"].radius * ARCSEC / cell)) + 2,
            pixels=self.fov,
        )


def of_stpsf(setting: Setting, cells: float) -> Callable[[], Tensor]:
    """This package's image of stpsf's arrays, with so many cells of the occulter per lambda/D."""
    assert setting.stpsf is not None
    instrument, call = setting.stpsf
    model = from_webbpsf(instrument, fft_oversample=4, occulter_sampling=cells, **call)
    return partial(rendered, model, model.opd(None))
