"""poppy and stpsf as they come, plain FFTs, for the benchmark to compare with."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.instrument.masks import MASKS

Array = NDArray[np.float64]


def plain_poppy(
    amplitude: Array,
    opd: Array,
    stop: NDArray[np.complex128],
    *,
    diameter: float,
    wavelength: float,
    pixelscale: float,
    fov_pixels: int,
    oversample: int,
) -> Callable[[], Array]:
    """MASK335R between two pupils by poppy: a function that calculates the image.

    Parameters
    ----------
    amplitude, opd, stop : ndarray, (npix, npix)
        Entrance-pupil orientation; the OPD in m.
    diameter, wavelength : float
        m.
    pixelscale : float
        arcsec.
    fov_pixels : int
    oversample : int
        Samples per lambda/D on the occulter.
    """
    import poppy
    import torch
    from astropy import units as u
    from poppy.accel_math import ensure_not_on_gpu, xp

    class Occulter(poppy.optics.AnalyticImagePlaneElement):
        def get_transmission(self, wave: Any) -> Array:
            on_cpu = map(ensure_not_on_gpu, self.get_coordinates(wave))
            y, x = (torch.from_numpy(np.asarray(a)) for a in on_cpu)
            return xp.asarray((1 - MASKS["MASK335R"].complement(x, y)).numpy())

    def optic(name: str, transmission: NDArray[Any], path: NDArray[Any]) -> Any:
        # As the exit pupil has them: y inverted.
        return poppy.ArrayOpticalElement(
            name=name,
            transmission=transmission[::-1],
            opd=path[::-1],
            pixelscale=diameter / len(opd) * u.m / u.pixel,
            planetype=poppy.poppy_core.PlaneType.pupil,
        )

    system = poppy.OpticalSystem(oversample=oversample, npix=len(opd), verbose=False)
    system.pupil_diameter = diameter * u.m
    system.add_pupil(optic("pupil", amplitude / amplitude.max(), opd))
    system.add_image(Occulter(name="MASK335R"))
    path = np.angle(stop) * (wavelength / (2 * np.pi))
    system.add_pupil(optic("stop", np.abs(stop), path))
    system.add_detector(pixelscale=pixelscale, fov_pixels=fov_pixels, oversample=1)

    def image() -> Array:
        hdus = system.calc_psf(wavelength=wavelength * u.m, normalize="first")
        return np.asarray(hdus[0].data, dtype=np.float64)

    return image


def plain_stpsf(folder: Path, npix: int = 1024) -> Any:
    """NIRCam of stpsf behind MASK335R, without the ND squares.

    Parameters
    ----------
    folder : Path
        Its data directory, which the environment variable STPSF_PATH names as well.
    npix : int
        Samples across the pupil.

    Raises
    ------
    IncompatibleSetupError
        If the directory lacks what is needed.
    """
    pupil = folder / f"jwst_pupil_RevW_npix{npix}.fits.gz"
    if not pupil.is_file() or not (folder / "NIRCam" / "filters.tsv").is_file():
        raise IncompatibleSetupError(
            f"stpsf's data: {folder.name} has no {pupil.name} or no NIRCam/filters.tsv"
        )
    import stpsf

    instrument = stpsf.NIRCam()
    instrument.filter = "F444W"
    instrument.image_mask, instrument.pupil_mask = "MASK335R", "MASKRND"
    instrument.pupil = str(pupil)
    instrument.options["nd_squares"] = False
    return instrument
