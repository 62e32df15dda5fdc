"""The detector of a user's stpsf instrument, as effects on torch images."""

from __future__ import annotations

import copy
import warnings
from typing import Any

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.optics.detector_effects import (
    Effect,
    GaussianBlur,
    LinearResampling,
    PixelCrosstalk,
)
from pyklip_diffrender.optics.rotation import SplineRotation

__all__ = ["stpsf_effects"]

Array = NDArray[np.float64]

DEFAULT_JITTER = 0.007
"""arcsec; what poppy takes for Gaussian jitter without a width."""


def stpsf_effects(
    instrument: Any,
    *,
    shape: tuple[int, int],
    oversample: int,
    fft_oversample: int,
    pixelscale: float,
    distortion: bool,
) -> tuple[tuple[Effect, ...], tuple[Effect, ...]]:
    """What stpsf does to the samples of the image, and to the pixels after binning.

    Parameters
    ----------
    instrument : stpsf.NIRCam
    shape : tuple of int
        Pixels (ny, nx).
    oversample, fft_oversample : int
        Of the detector and of the image planes.
    pixelscale : float
        arcsec per pixel.
    distortion : bool
        Go on to DET_DIST; else stop at DET_SAMP, which has the jitter alone.
    """
    scale = pixelscale / oversample
    on_samples: list[Effect] = []
    jitter = instrument.options.get("jitter")
    if jitter is not None:
        if jitter.lower() != "gaussian":
            raise IncompatibleSetupError(
                f"options['jitter']: {jitter!r} is not supported, 'gaussian' and None are"
            )
        sigma = instrument.options.get("jitter_sigma")
        on_samples.append(GaussianBlur((DEFAULT_JITTER if sigma is None else sigma) / scale))
    if not distortion:
        return tuple(on_samples), ()
    header = _header(instrument, shape, oversample, fft_oversample, scale)
    aperture = instrument.siaf.apertures[header["APERNAME"].upper()]
    samples = (shape[0] * oversample, shape[1] * oversample)
    on_samples.append(SplineRotation(aperture.V3IdlYAngle, samples))
    on_samples.append(_distortion(aperture, header, samples, scale))
    diffusion = _charge_diffusion(instrument, header)
    if diffusion:
        on_samples.append(GaussianBlur(diffusion / scale))
    on_pixels: list[Effect] = []
    if instrument.options.get("add_ipc", True):
        on_pixels += [PixelCrosstalk(kernel) for kernel in _crosstalk(instrument, header)]
    return tuple(on_samples), tuple(on_pixels)


def _header(
    instrument: Any, shape: tuple[int, int], oversample: int, fft_oversample: int, scale: float
) -> Any:
    """The keywords that stpsf's own detector functions read."""
    data = np.zeros((shape[0] * oversample, shape[1] * oversample))
    hdus = fits.HDUList([fits.PrimaryHDU(data)])
    hdus[0].header["OVERSAMP"] = fft_oversample
    hdus[0].header["PIXELSCL"] = scale
    options = {"fft_oversample": fft_oversample, "detector_oversample": oversample}
    copy.copy(instrument)._get_fits_header(hdus, {**instrument.options, **options})
    return hdus[0].header


def _distortion(
    aperture: Any, header: Any, samples: tuple[int, int], scale: float
) -> LinearResampling:
    """From ideal coordinates to the pixels of the science frame (stpsf/distortion.py)."""
    x0, y0 = header["DET_X"], header["DET_Y"]
    x0_ideal, y0_ideal = aperture.sci_to_idl(x0, y0)
    half_y, half_x = ((n - 1) / 2 for n in samples)
    x, y = np.meshgrid(
        np.linspace(-half_x, half_x, samples[1]), np.linspace(-half_y, half_y, samples[0])
    )
    to_x, to_y = aperture.convert(
        x / (aperture.XSciScale / scale) + x0, y / (aperture.YSciScale / scale) + y0, "sci", "idl"
    )
    return LinearResampling(
        (to_y - y0_ideal) / scale + half_y, (to_x - x0_ideal) / scale + half_x, samples
    )


def _charge_diffusion(instrument: Any, header: Any) -> float:
    """Standard deviation in arcsec."""
    from stpsf import constants

    sigma = instrument.options.get("charge_diffusion_sigma")
    if sigma is None:
        table = constants.INSTRUMENT_DETECTOR_CHARGE_DIFFUSION_DEFAULT_PARAMETERS
        sigma = table[f"NIRCAM_{header['CHANNEL'][0]}W"]
    return float(sigma)


def _crosstalk(instrument: Any, header: Any) -> list[Array]:
    """Kernels of the interpixel capacitance and of the post-pixel coupling."""
    from stpsf import detectors

    with warnings.catch_warnings():
        # stpsf 2.2 leaves the two files open.
        warnings.filterwarnings("ignore", "unclosed file", ResourceWarning)
        kernels, _ = detectors.get_detector_ipc_model(instrument.name, header)
    return [np.asarray(kernel.array, dtype=np.float64) for kernel in kernels]
