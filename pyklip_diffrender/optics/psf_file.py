"""PSFs as poppy and stpsf give them: HDULists with their extensions and keywords."""

from __future__ import annotations

import datetime
import os
import warnings
from typing import Any, Protocol

import numpy as np
import torch
from astropy.io import fits
from astropy.io.fits.verify import VerifyWarning
from numpy.typing import NDArray
from torch import Tensor

from pyklip_diffrender import __version__
from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.io.files import write_fits

__all__ = ["NORMALIZATIONS", "bin_down", "normalised_samples", "poppy_psf", "recipe_psf", "save"]

Array = NDArray[np.float64]

NORMALIZATIONS = ("first", "last", "exit_pupil", "none")


class System(Protocol):
    """What is needed of an optical system, see `optics.OpticalSystem`."""

    entrance: Any
    planes: tuple[Any, ...]
    detector: Any
    bandpass: Any
    recipe: dict[str, Any]

    def opd(self, opd: Any) -> Tensor:
        """OPD as a tensor."""

    def values(self, given: dict[str, Any]) -> dict[str, Tensor]:
        """Parameters as tensors."""

    def pupil_field(self, opd: Tensor, wavelength: float, values: Any) -> Any:
        """Field behind the entrance pupil."""

    def windows(self, values: Any) -> list[Any]:
        """Windows of the planes."""


def normalised_samples(system: System, normalize: str, opd: Any = None, **parameters: Any) -> Array:
    """Light on the detector's samples, before binning, in one of poppy's normalisations.

    Parameters
    ----------
    normalize : str
        What adds up to 1 at every wavelength: the light behind the "first" plane, on the "last",
        in the "exit_pupil"; or "none", for a field of 1 where the pupil is clear.

    Returns
    -------
    ndarray, (oversample ny, oversample nx)
    """
    if normalize.lower() not in NORMALIZATIONS:
        raise IncompatibleSetupError(
            f"normalize: got {normalize!r}, expected one of {', '.join(NORMALIZATIONS)}"
        )
    kind = normalize.lower()
    total = np.zeros(())
    with torch.no_grad():
        tensor, values = system.opd(opd), system.values(parameters)
        for wavelength, weight in zip(
            system.bandpass.wavelengths, system.bandpass.weights, strict=True
        ):
            wavefront = system.pupil_field(tensor, wavelength, values)
            for plane, onto in zip(system.planes, system.windows(values), strict=True):
                wavefront = plane.apply(wavefront, values, onto)
            light = system.detector.field(wavefront, values).abs() ** 2
            if kind == "last":
                light = light / light.sum()
            elif kind == "exit_pupil":
                light = light / ((wavefront.field.abs() ** 2).sum() * wavefront.grid.spacing**2)
            elif kind == "none":
                light = light * system.entrance.total
            total = total + weight * light.double().cpu().numpy()
    return np.asarray(total, dtype=np.float64)


def _propagations(system: System) -> str:
    used = getattr(system, "propagation", None)
    if used:
        return ", ".join(f"{name}: {kind}" for name, kind in used.items())
    return "compact"


def _header(system: System, normalize: str, header: fits.Header) -> None:
    detector, entrance = system.detector, system.entrance
    scale = detector.pixelscale[0] / detector.oversample
    waves, weights = system.bandpass.wavelengths, system.bandpass.weights
    diameter = entrance.full.diameter
    header["PLANE1"] = "Wavefront Intensity"
    header["WAVELEN"] = (
        float(np.dot(waves, weights)), "Weighted mean wavelength in meters"
    )  # fmt: skip
    header["DIFFLMT"] = (
        float(np.rad2deg(waves[0] / diameter) * 3600),
        "Diffraction limit lambda/D in arcsec",
    )
    header["OVERSAMP"] = (detector.oversample, "Oversampling factor for FFTs in computation")
    header["DET_SAMP"] = (detector.oversample, "Oversampling factor for MFT to detector plane")
    header["PIXELSCL"] = (scale, "Scale in arcsec/pix (after oversampling)")
    ny, nx = detector.shape
    if ny == nx:
        header["FOV"] = (nx * detector.pixelscale[0], "Field of view in arcsec (full array)")
    else:
        header["FOV_X"] = (
            nx * detector.pixelscale[0], "Field of view in arcsec (full array), X direction"
        )  # fmt: skip
        header["FOV_Y"] = (
            ny * detector.pixelscale[1], "Field of view in arcsec (full array), Y direction"
        )  # fmt: skip
        header["PIXUNIT"] = "arcsecond"
    header["NWAVES"] = (len(waves), "Number of wavelengths used in calculation")
    for k, (wave, weight) in enumerate(zip(waves, weights, strict=True)):
        header[f"WAVE{k}"] = (wave, f"Wavelength {k}")
        header[f"WGHT{k}"] = (weight, f"Wavelength weight {k}")
    header["FFTTYPE"] = ("matrix Fourier", "Algorithm for FFTs: numpy or fftw")
    header["NORMALIZ"] = (normalize, "PSF normalization method")
    header["DRVERS"] = (__version__, "pyklip_diffrender version")
    header["DRPROP"] = (_propagations(system), "Propagation through image planes")
    header["DRPREC"] = (str(entrance.dtype).removeprefix("torch."), "Floating point precision")
    header.add_history(f"Created by pyklip_diffrender {__version__}")


def poppy_psf(
    system: System, normalize: str = "first", opd: Any = None, **parameters: Any
) -> fits.HDUList:
    """What `poppy.OpticalSystem.calc_psf` returns: one oversampled image."""
    hdu = fits.PrimaryHDU(normalised_samples(system, normalize, opd, **parameters))
    _header(system, normalize, hdu.header)
    return fits.HDUList([hdu])


def bin_down(image: Array, factor: int) -> Array:
    """Sum blocks of `factor` by `factor` samples."""
    ny, nx = image.shape
    return image.reshape(ny // factor, factor, nx // factor, factor).sum(axis=(1, 3))


def recipe_psf(
    system: System,
    normalize: str = "first",
    outfile: str | os.PathLike[str] | None = None,
    overwrite: bool = True,
    opd: Any = None,
    **parameters: Any,
) -> fits.HDUList:
    """What `poppy.Instrument.calc_psf` returns: the samples, and the pixels they fall into.

    Parameters
    ----------
    opd, **parameters
        Of the call of the system.

    Returns
    -------
    HDUList
        Extensions OVERSAMP and DET_SAMP.
    """
    factor = system.detector.oversample
    primary = fits.PrimaryHDU(normalised_samples(system, normalize, opd, **parameters))
    header = primary.header
    _header(system, normalize, header)
    header["EXTNAME"] = ("OVERSAMP", "This extension is oversampled.")
    now = datetime.datetime.now(datetime.UTC)
    header["DATE"] = (f"{now:%Y-%m-%dT%H:%M:%S}", "Date of calculation")
    for name, (argument, comment) in _RECIPE_KEYWORDS.items():
        value = system.recipe.get(argument)
        if value is not None and not isinstance(value, tuple):
            header[name] = (value, comment)
    if "filter" in system.recipe:
        header["INSTRUME"] = ("NIRCam", "Instrument")
    header["PUPILOPD"] = ("NONE - perfect telescope! " if opd is None else "OPD of the call",
                          "Pupil OPD source")  # fmt: skip
    detector = fits.ImageHDU(bin_down(primary.data, factor), header.copy())
    detector.header["EXTNAME"] = "DET_SAMP"
    detector.header["OVERSAMP"] = (1, "These data are rebinned to detector pixels")
    detector.header["CALCSAMP"] = (factor, "This much oversampling used in calculation")
    detector.header["PIXELSCL"] *= factor
    hdus = fits.HDUList([primary, detector])
    save(hdus, outfile, overwrite)
    return hdus


_RECIPE_KEYWORDS = {
    "FILTER": ("filter", "Filter name"),
    "CORONMSK": ("image_mask", "Image plane mask"),
    "PUPIL": ("pupil_mask", "Pupil plane mask"),
    "OVERSAMP": ("occulter_sampling", "Oversampling factor for FFTs in computation"),
}


def save(hdus: fits.HDUList, outfile: str | os.PathLike[str] | None, overwrite: bool) -> None:
    """Write a PSF if a file is asked for.

    Raises
    ------
    FileExistsError
        If it is there and must not be overwritten.
    """
    if outfile is None:
        return
    if os.path.exists(outfile) and not overwrite:
        raise FileExistsError(f"{outfile} exists; pass overwrite=True, or another outfile")
    hdus[0].header["FILENAME"] = (os.path.basename(outfile), "Name of this file")
    with warnings.catch_warnings():
        # Some comments of stpsf's are longer than a card.
        warnings.filterwarnings("ignore", "Card is too long", VerifyWarning)
        write_fits(hdus, outfile)
