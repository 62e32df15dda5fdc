"""PSFs as HDULists with the extensions and keywords of poppy and stpsf."""

from __future__ import annotations

import datetime
import os
import warnings
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from astropy.io import fits
from astropy.io.fits.verify import VerifyWarning
from numpy.typing import NDArray

from pyklip_diffrender._version import __version__
from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.io.files import require_new, write_fits
from pyklip_diffrender.io.headers import set_keyword
from pyklip_diffrender.optics.propagation import Propagation

Array = NDArray[np.float64]

_NORMALIZATIONS = ("first", "last", "exit_pupil", "none")


def _samples(system: Propagation, normalize: str, opd: Any, parameters: dict[str, Any]) -> Array:
    """Light on the detector's samples, before binning, (oversample ny, oversample nx).

    `normalize` names the plane where the light adds up to 1 at every wavelength: "first", "last" or
    "exit_pupil". With "none" the field is 1 where the pupil is clear.
    """
    kind = normalize.lower()
    if kind not in _NORMALIZATIONS:
        raise IncompatibleSetupError(
            f"normalize: got {normalize!r}, expected one of {', '.join(_NORMALIZATIONS)}"
        )
    # Light adds up to 1 behind the entrance pupil, which is poppy's "first".
    total = np.zeros(())
    with torch.no_grad():
        tensor = system.opd(opd)
        for field, wavelength, weight in zip(
            system.fields(tensor, **parameters),
            system.bandpass.wavelengths,
            system.bandpass.weights,
            strict=True,
        ):
            light = field.abs() ** 2
            if kind == "last":
                light = light / light.sum()
            elif kind == "exit_pupil":
                # Share of the light that reaches the last pupil.
                values = system.values(parameters)
                wavefront = system.pupil_field(tensor, wavelength, values)
                wavefront = system.behind_planes(wavefront, values)
                power = (wavefront.field.abs() ** 2).sum() * wavefront.grid.spacing**2
                light = light / power
            elif kind == "none":
                light = light * system.entrance.total
            total = total + weight * light.double().cpu().numpy()
    return np.asarray(total, dtype=np.float64)


def _header(system: Propagation, normalize: str, header: fits.Header) -> None:
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
    set_keyword(header, "DRVERS", __version__)
    # How a system that was made from poppy's propagates through each image plane.
    used = getattr(system, "propagation", {})
    propagations = ", ".join(f"{name}: {kind}" for name, kind in used.items())
    set_keyword(header, "DRPROP", propagations or "compact")
    set_keyword(header, "DRPREC", str(entrance.dtype).removeprefix("torch."))
    header.add_history(f"Created by pyklip_diffrender {__version__}")


def poppy_psf(
    system: Propagation, normalize: str = "first", opd: Any = None, **parameters: Any
) -> fits.HDUList:
    """The return value of `poppy.OpticalSystem.calc_psf`: one oversampled image; see `_samples`."""
    hdu = fits.PrimaryHDU(_samples(system, normalize, opd, parameters))
    _header(system, normalize, hdu.header)
    return fits.HDUList([hdu])


def instrument_psf(
    system: Propagation,
    setup: Mapping[str, str],
    sampling: float | None,
    normalize: str = "first",
    opd: Any = None,
    **parameters: Any,
) -> fits.HDUList:
    """The return value of `poppy.Instrument.calc_psf`: extensions OVERSAMP (samples) and DET_SAMP.

    `setup` is `OpticalSystem.setup`, `sampling` the number of cells per lambda/D on the occulter,
    for the header; see `_samples` for `normalize`.
    """
    factor = system.detector.oversample
    primary = fits.PrimaryHDU(_samples(system, normalize, opd, parameters))
    header = primary.header
    _header(system, normalize, header)
    header["EXTNAME"] = ("OVERSAMP", "This extension is oversampled.")
    now = datetime.datetime.now(datetime.UTC)
    header["DATE"] = (f"{now:%Y-%m-%dT%H:%M:%S}", "Date of calculation")
    for name, (key, comment) in _SETUP_KEYWORDS.items():
        if key in setup:
            header[name] = (setup[key], comment)
    if sampling is not None:
        header["OVERSAMP"] = (sampling, "Oversampling factor for FFTs in computation")
    if "filter" in setup:
        header["INSTRUME"] = ("NIRCam", "Instrument")
    header["PUPILOPD"] = ("NONE - perfect telescope! " if opd is None else "OPD of the call",
                          "Pupil OPD source")  # fmt: skip
    ny, nx = system.detector.shape
    pixels = primary.data.reshape(ny, factor, nx, factor).sum(axis=(1, 3))
    detector = fits.ImageHDU(pixels, header.copy())
    detector.header["EXTNAME"] = "DET_SAMP"
    detector.header["OVERSAMP"] = (1, "These data are rebinned to detector pixels")
    detector.header["CALCSAMP"] = (factor, "This much oversampling used in calculation")
    detector.header["PIXELSCL"] *= factor
    return fits.HDUList([primary, detector])


_SETUP_KEYWORDS = {
    "FILTER": ("filter", "Filter name"),
    "CORONMSK": ("image_mask", "Image plane mask"),
    "PUPIL": ("pupil_mask", "Pupil plane mask"),
}


def refuse_keywords(reasons: Mapping[str, str], given: Mapping[str, Any]) -> None:
    """Raise IncompatibleSetupError for a keyword of poppy or stpsf that a system cannot serve."""
    for name, reason in reasons.items():
        # An input wavefront is an array of numbers, without a truth value.
        if given[name] is not None and given[name] is not False:
            raise IncompatibleSetupError(f"{name}={given[name]!r}: {reason}")


def require_one_sampling(common: int | None, detector: int | None, fft: int | None) -> None:
    """Raise IncompatibleSetupError, as stpsf does, if an oversampling is given twice."""
    if None not in (common, detector, fft):
        raise IncompatibleSetupError(
            "give oversample, or detector_oversample with fft_oversample, not all three"
        )


def save(hdus: fits.HDUList, outfile: str | os.PathLike[str] | None, overwrite: bool) -> None:
    """Write a PSF, unless `outfile` is None; ExistingFileError unless `overwrite` is True."""
    if outfile is None:
        return
    require_new([outfile], overwrite)
    hdus[0].header["FILENAME"] = (os.path.basename(outfile), "Name of this file")
    with warnings.catch_warnings():
        # Some of stpsf's comments are longer than a card.
        warnings.filterwarnings("ignore", "Card is too long", VerifyWarning)
        write_fits(hdus, outfile)
