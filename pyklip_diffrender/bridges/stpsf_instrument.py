"""Read the settings and the detector of an stpsf instrument without changing it."""

from __future__ import annotations

import copy
import os
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np
from astropy import units as u
from astropy.io import fits
from numpy.typing import NDArray

from pyklip_diffrender.bridges.rotation import SplineRotation
from pyklip_diffrender.errors import CorruptFileError, DiffrenderWarning, IncompatibleSetupError
from pyklip_diffrender.io.units import to_metres
from pyklip_diffrender.optics.bandpass import Bandpass
from pyklip_diffrender.optics.detector import Detector
from pyklip_diffrender.optics.detector_effects import (
    ChainDetector,
    Effect,
    GaussianBlur,
    LinearResampling,
    PixelCrosstalk,
)

__all__ = [
    "band",
    "data_errors",
    "kernel_files_left_open",
    "oversampling",
    "private_copy",
    "with_effects",
]

Array = NDArray[np.float64]

_JITTER = 0.007
"""Width of Gaussian jitter where none is given, arcsec (poppy's default)."""


def private_copy(nircam: Any) -> Any:
    """Copy an instrument; the copy shares its data but none of its settings."""
    instrument = copy.copy(nircam)
    instrument.options = dict(nircam.options)
    if hasattr(instrument.pupil, "v2v3"):
        # As stpsf's calc_psf does: the telescope's wavefront depends on the field position.
        instrument.pupil = copy.deepcopy(instrument.pupil)
        position = instrument._tel_coords().to(u.arcsec)
        if instrument.pupil.v2v3 is None or not (instrument.pupil.v2v3 == position).all():
            instrument.pupil.v2v3 = position
            instrument.pupil.update_opd()
    return instrument


def oversampling(recipe: Mapping[str, Any]) -> tuple[int, int]:
    """Oversampling of the image planes and of the detector, by stpsf's rules.

    Parameters
    ----------
    recipe : mapping
        With "oversample", "fft_oversample" and "detector_oversample", each an int or None.
    """
    common, fine, pixels = (
        recipe[name] for name in ("oversample", "fft_oversample", "detector_oversample")
    )
    if None not in (common, fine, pixels):
        raise IncompatibleSetupError(
            "give oversample, or detector_oversample with fft_oversample, not all three"
        )
    if common is None and fine is None and pixels is None:
        common = 4
    image, detector = common if fine is None else fine, common if pixels is None else pixels
    if image is None or detector is None:
        raise IncompatibleSetupError(
            f"fft_oversample={fine}, detector_oversample={pixels}: give both, or oversample"
        )
    return int(image), int(detector)


def band(instrument: Any, recipe: Mapping[str, Any]) -> tuple[list[float], list[float]]:
    """Wavelengths (m) and weights: those of a `Bandpass`, otherwise the choice of stpsf.

    Parameters
    ----------
    instrument : stpsf.NIRCam
    recipe : mapping
        With "bandpass", "monochromatic", "nlambda" and "source", each possibly None.

    Raises
    ------
    IncompatibleSetupError
        For a wavelength that the instrument's channel does not pass.

    Warns
    -----
    DiffrenderWarning
        For a single wavelength outside the filter.
    """
    bandpass: Bandpass | None = recipe["bandpass"]
    monochromatic = None
    if bandpass is not None:
        wavelengths, weights = bandpass.wavelengths, bandpass.weights
    else:
        if recipe["monochromatic"] is not None:
            monochromatic = float(to_metres(recipe["monochromatic"], "monochromatic"))
        with data_errors():
            wavelengths, weights = instrument._get_weights(
                source=recipe["source"], nlambda=recipe["nlambda"], monochromatic=monochromatic
            )
    waves = [float(w) for w in np.atleast_1d(wavelengths)]
    try:
        instrument._validate_config(wavelengths=waves)
    except RuntimeError as error:
        raise IncompatibleSetupError(
            f"wavelengths {min(waves):.4g} to {max(waves):.4g} m with {instrument.filter}: "
            f"{error}. Wavelengths are in metres"
        ) from error
    if monochromatic is not None:
        _warn_outside(instrument, monochromatic)
    return waves, [float(w) for w in np.atleast_1d(weights)]


def _warn_outside(instrument: Any, wavelength: float) -> None:
    """Warn of a wavelength outside the filter, which stpsf accepts silently."""
    path = instrument._filters[instrument.filter].filename
    if not os.path.exists(path):
        return  # stpsf needs the curve only for broadband PSFs.
    table = fits.getdata(path, 1)
    used = np.asarray(table["THROUGHPUT"], dtype=float)
    passed = np.asarray(table["WAVELENGTH"], dtype=float)[used > 1e-3 * used.max()] * 1e-10
    if not passed.min() <= wavelength <= passed.max():
        warnings.warn(
            f"monochromatic: {wavelength:.4g} m is outside {instrument.filter} ({passed.min():.4g} "
            f"to {passed.max():.4g} m); the filter only names the PSF",
            DiffrenderWarning,
            stacklevel=4,
        )


@contextmanager
def data_errors() -> Iterator[None]:
    """Replace stpsf's errors about missing files by one that names its data directory."""
    try:
        yield
    except (FileNotFoundError, OSError, RuntimeError) as error:
        if isinstance(error, CorruptFileError):
            raise
        raise CorruptFileError(
            f"stpsf could not read its data ({error}). STPSF_PATH is "
            f"{os.environ.get('STPSF_PATH')!r}; it must hold the complete stpsf data files, see "
            "https://stpsf.readthedocs.io/en/latest/installation.html"
        ) from error


@contextmanager
def kernel_files_left_open() -> Iterator[None]:
    """Silence warnings about the detector kernel files that stpsf 2.2 leaves open."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "unclosed file", ResourceWarning)
        yield


def with_effects(
    detector: Detector, instrument: Any, fft_oversample: int, distortion: bool
) -> ChainDetector:
    """A detector with the effects of an instrument: all up to DET_DIST, or jitter only.

    Raises
    ------
    IncompatibleSetupError
        For a kind of jitter that is not supported.
    """
    oversample, shape = detector.oversample, detector.shape
    scale = detector.pixelscale[0] / oversample
    on_samples: list[Effect] = []
    jitter = instrument.options.get("jitter")
    if jitter is not None:
        if jitter.lower() != "gaussian":
            raise IncompatibleSetupError(
                f"options['jitter']: {jitter!r} is not supported, 'gaussian' and None are"
            )
        sigma = instrument.options.get("jitter_sigma")
        on_samples.append(GaussianBlur((_JITTER if sigma is None else sigma) / scale))
    on_pixels: list[Effect] = []
    if distortion:
        header = _header(instrument, shape, oversample, fft_oversample, scale)
        aperture = instrument.siaf.apertures[header["APERNAME"].upper()]
        samples = (shape[0] * oversample, shape[1] * oversample)
        on_samples.append(SplineRotation(aperture.V3IdlYAngle, samples))
        on_samples.append(_distortion(aperture, header, samples, scale))
        diffusion = _charge_diffusion(instrument, header)
        if diffusion:
            on_samples.append(GaussianBlur(diffusion / scale))
        if instrument.options.get("add_ipc", True):
            on_pixels += [PixelCrosstalk(kernel) for kernel in _crosstalk(instrument, header)]
    return ChainDetector(
        shape=shape,
        pixelscale=detector.pixelscale,
        oversample=oversample,
        dtype=detector.dtype,
        device=detector.device,
        name=detector.name,
        on_samples=tuple(on_samples),
        on_pixels=tuple(on_pixels),
    )


def _header(
    instrument: Any, shape: tuple[int, int], oversample: int, fft_oversample: int, scale: float
) -> Any:
    """The header keywords that stpsf's own detector functions read."""
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
    """Resampling from ideal coordinates to science-frame pixels (stpsf/distortion.py)."""
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
    """Standard deviation of the charge diffusion, arcsec."""
    from stpsf import constants

    sigma = instrument.options.get("charge_diffusion_sigma")
    if sigma is None:
        table = constants.INSTRUMENT_DETECTOR_CHARGE_DIFFUSION_DEFAULT_PARAMETERS
        sigma = table[f"NIRCAM_{header['CHANNEL'][0]}W"]
    return float(sigma)


def _crosstalk(instrument: Any, header: Any) -> list[Array]:
    """Kernels of the interpixel capacitance and of the post-pixel coupling."""
    from stpsf import detectors

    with kernel_files_left_open():
        kernels, _ = detectors.get_detector_ipc_model(instrument.name, header)
    return [np.asarray(kernel.array, dtype=np.float64) for kernel in kernels]
