"""`from_webbpsf`: make a system of an stpsf (webbpsf) NIRCam object, and export wavefronts."""

from __future__ import annotations

import copy
import os
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any, ClassVar

import numpy as np
import torch
from astropy import units as u
from astropy.io import fits
from numpy.typing import NDArray

from pyklip_diffrender.bridges.convert import Conversion
from pyklip_diffrender.bridges.poppy import WRITTEN_BY_CALLER, PoppySystem, check_supported
from pyklip_diffrender.bridges.sampled_planes import AberrationOptic, SplineRotation
from pyklip_diffrender.errors import CorruptFileError, IncompatibleSetupError
from pyklip_diffrender.io.headers import set_keyword
from pyklip_diffrender.io.units import to_metres, to_number
from pyklip_diffrender.optics.bandpass import Bandpass
from pyklip_diffrender.optics.grid import resample
from pyklip_diffrender.optics.planes import (
    ChainDetector,
    Detector,
    Effect,
    GaussianBlur,
    LinearResampling,
    PixelCrosstalk,
)
from pyklip_diffrender.optics.system import (
    InstrumentSystem,
    OpticalSystem,
    poppy_psf,
    require_one_sampling,
)
from pyklip_diffrender.wavefront.opd_map import check_opd, opd_to_hdus

Array = NDArray[np.float64]

_JITTER_ARCSEC = 0.007
"""Width of Gaussian jitter where none is given, arcsec (poppy's default)."""


def private_copy(nircam: Any) -> Any:
    """A copy of an instrument, which shares data but no settings with the original."""
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

    `recipe` has "oversample", "fft_oversample" and "detector_oversample", each an int or None.
    """
    common, fine, pixels = (
        recipe[name] for name in ("oversample", "fft_oversample", "detector_oversample")
    )
    require_one_sampling(common, pixels, fine)
    if common is None and fine is None and pixels is None:
        common = 4
    image, detector = common if fine is None else fine, common if pixels is None else pixels
    if image is None or detector is None:
        raise IncompatibleSetupError(
            f"fft_oversample={fine}, detector_oversample={pixels}: give both, or oversample"
        )
    return int(image), int(detector)


def band(instrument: Any, recipe: Mapping[str, Any]) -> tuple[list[float], list[float]]:
    """Wavelengths (m) and weights of a `Bandpass`, otherwise by stpsf.

    `recipe` has "bandpass", "monochromatic", "nlambda" and "source", each possibly None.
    IncompatibleSetupError for a wavelength that the instrument's channel does not pass.
    """
    bandpass: Bandpass | None = recipe["bandpass"]
    if bandpass is not None:
        wavelengths, weights = bandpass.wavelengths, bandpass.weights
    else:
        monochromatic = recipe["monochromatic"]
        if monochromatic is not None:
            monochromatic = float(to_metres(monochromatic, "monochromatic"))
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
    return waves, [float(w) for w in np.atleast_1d(weights)]


@contextmanager
def data_errors() -> Iterator[None]:
    """Replace errors of stpsf about missing files by an error with the folder of its data."""
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
    """Silence warnings about files of detector kernels, which stpsf 2.2 leaves open."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "unclosed file", ResourceWarning)
        yield


def with_effects(
    detector: Detector, instrument: Any, fft_oversample: int, distortion: bool
) -> ChainDetector:
    """A detector with the effects of an instrument: up to DET_DIST, or jitter only.

    IncompatibleSetupError for a kind of jitter that is not supported.
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
        on_samples.append(GaussianBlur((_JITTER_ARCSEC if sigma is None else sigma) / scale))
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
    """Header keywords that the detector functions of stpsf read."""
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


class WebbSystem(PoppySystem, InstrumentSystem):
    """A `PoppySystem` made from an stpsf instrument by `from_webbpsf`."""

    instrument: Any  # private copy of the instrument, as of the conversion
    # Whether the map of the instrument's internal wavefront error is flipped vertically, as in
    # stpsf from 2.2.0 on; None without a map.
    si_wfe_flipped: bool | None
    _source: ClassVar[str] = "nircam"
    _refused: ClassVar[Mapping[str, str]] = {"save_intermediates": WRITTEN_BY_CALLER}
    _replaced: ClassVar[dict[str, tuple[str, ...]]] = {
        **PoppySystem._replaced,
        "monochromatic": ("bandpass",),
        "nlambda": ("bandpass", "monochromatic"),
        "source": ("bandpass", "monochromatic"),
        "oversample": ("detector_oversample", "fft_oversample", "occulter_sampling"),
        "fft_oversample": ("occulter_sampling",),
    }

    @property
    def setup(self) -> dict[str, str]:
        """See `OpticalSystem.setup`."""
        names = ("filter", "image_mask", "pupil_mask", "module")
        return {name: v for name in names if (v := getattr(self.instrument, name))}

    def _band(self, bandpass: Bandpass) -> dict[str, Any]:
        """Arguments of `from_webbpsf` for a bandpass."""
        return {"bandpass": bandpass}

    def _remade(self, changes: Mapping[str, Any]) -> OpticalSystem:
        if {"fft_oversample", "detector_oversample"} <= changes.keys():
            changes = {"oversample": None, **changes}
        if changes.keys().isdisjoint(("bandpass", "monochromatic", "nlambda", "source")):
            # So that stpsf does not compute the wavelengths again.
            changes = {"bandpass": self.bandpass, **changes}
        return super()._remade(changes)

    def _changes(self, given: dict[str, Any]) -> dict[str, Any]:
        """Arguments of `calc_psf`, which are settings of `from_webbpsf`."""
        return given

    def _extensions(
        self,
        normalize: str,
        opd: Any,
        parameters: Mapping[str, Any],
        options: Mapping[str, Any],
    ) -> fits.HDUList:
        """The PSF of this system with the jitter, distortion, detector and header of stpsf."""
        result = poppy_psf(self, normalize, opd, **parameters)
        instrument = self.instrument
        options = {
            **instrument.options,
            **options,
            "detector_oversample": self.detector.oversample,
            "fft_oversample": oversampling(self.recipe)[0],
        }
        with kernel_files_left_open():
            instrument._apply_jitter(result, options)
            instrument._get_fits_header(result, options)
            instrument._calc_psf_format_output(result, options)
        if self.si_wfe_flipped is not None:
            for hdu in result:
                set_keyword(hdu.header, "DRSIFLIP", self.si_wfe_flipped)
        return result

    def display(self, **keywords: Any) -> None:
        """Draw all planes as stpsf does, which takes no keywords."""
        private_copy(self.instrument).display(**keywords)


def from_webbpsf(
    nircam: Any,
    *,
    fov_pixels: int | tuple[int, int] | None = None,
    fov_arcsec: float | None = None,
    oversample: int | None = None,
    detector_oversample: int | None = None,
    fft_oversample: int | None = None,
    monochromatic: Any = None,
    nlambda: int | None = None,
    source: Any = None,
    bandpass: Bandpass | None = None,
    add_distortion: bool = False,
    flip_si_wfe: bool | None = None,
    propagation: str | Mapping[str, str] = "auto",
    occulter_sampling: float | None = None,
    npix: int | None = None,
    dtype: torch.dtype = torch.float64,
    device: str | torch.device = "cpu",
) -> WebbSystem:
    """Make a differentiable system of a configured `stpsf.NIRCam` (or `webbpsf.NIRCam`).

    The system has the instrument's filter, masks, options (source offset, pupil shift and
    rotation, shift of the occulter, ND squares, jitter), pixel scale, OPD and internal wavefront
    errors with their field dependence. ``model()`` is stpsf's DET_SAMP, or DET_DIST with
    `add_distortion`. ``model(opd)`` has another OPD of the whole telescope than
    ``model.entrance.opd``.

    The result can be passed to `refine` and `detect` like any other system.

    Parameters
    ----------
    nircam : stpsf.NIRCam
        Instrument, which is not changed. Later changes of the instrument do not affect the model.
    fov_pixels, fov_arcsec, oversample, detector_oversample, fft_oversample, monochromatic,
    nlambda, source
        As in stpsf's `calc_psf`, with the same defaults.
    bandpass : Bandpass, optional
        Wavelengths and weights, in place of `monochromatic`, `nlambda` and `source`.
    add_distortion : bool
        Include the effects in stpsf's DET_DIST: rotation, distortion, charge diffusion, IPC, PPC.
    flip_si_wfe : bool, optional
        Whether the coronagraph's internal wavefront error is flipped vertically; default as in the
        installed stpsf: flipped from 2.2.0 on. See ``model.si_wfe_flipped``.
    propagation, occulter_sampling, npix, dtype, device
        See `from_poppy`; the default sampling is `fft_oversample`, the default `npix` as in
        ``nircam.pupil``.

    Returns
    -------
    WebbSystem

    Raises
    ------
    IncompatibleSetupError
        For another instrument, a mask that is not supported, or a wavelength outside the channel.
    CorruptFileError
        If a file of stpsf's data is missing.

    Examples
    --------
    This needs stpsf and its data files:

    >>> import stpsf  # doctest: +SKIP
    >>> nircam = stpsf.NIRCam()  # doctest: +SKIP
    >>> nircam.filter, nircam.image_mask, nircam.pupil_mask = (  # doctest: +SKIP
    ...     "F335M", "MASK335R", "MASKRND"
    ... )
    >>> model = dr.from_webbpsf(nircam, nlambda=5, fov_pixels=80)  # doctest: +SKIP
    """
    if fov_arcsec is not None:
        fov_arcsec = to_number(fov_arcsec, u.arcsec, "fov_arcsec", "positive")
    recipe = {k: v for k, v in locals().items() if k != "recipe"}
    if getattr(nircam, "name", None) != "NIRCam" or not hasattr(nircam, "get_optical_system"):
        raise IncompatibleSetupError(
            f"from_webbpsf: got {nircam!r}, expected an stpsf.NIRCam or webbpsf.NIRCam. For other "
            "instruments pass what get_optical_system() returns to from_poppy"
        )
    instrument = private_copy(nircam)
    recipe["nircam"] = instrument
    sampling, samples = oversampling(recipe)
    wavelengths, weights = band(instrument, recipe)
    with data_errors():
        osys = instrument.get_optical_system(
            fft_oversample=sampling,
            detector_oversample=samples,
            fov_arcsec=fov_arcsec or instrument._get_default_fov(),
            fov_pixels=fov_pixels,
            options=instrument.options,
        )
    check_supported(osys)
    first = osys.planes[0]
    # The map without the field dependence, which is not blank outside the pupil.
    original = getattr(first, "_opd_original", first.opd)
    check_opd(np.asarray(original), np.asarray(first.amplitude), "pupilopd")
    aberrations = _aberrations(osys)
    flipped = None if aberrations is None else _set_flip(aberrations, flip_si_wfe)
    conversion = Conversion(
        osys,
        # The detector of `osys` already has the field of view.
        {**recipe, "wavelength": wavelengths, "weights": weights, "fov_pixels": None},
        {} if aberrations is None else {aberrations.name: AberrationOptic},
    )
    with data_errors():
        detector = with_effects(conversion.detector, instrument, sampling, add_distortion)
    system = WebbSystem(conversion, recipe, from_webbpsf, detector)
    system.instrument, system.si_wfe_flipped = instrument, flipped
    return system


def _aberrations(osys: Any) -> Any:
    """The plane of the internal wavefront error, or None."""
    for plane in osys.planes:
        if any(c.__name__ == "WebbFieldDependentAberration" for c in type(plane).__mro__):
            return plane
    return None


def _set_flip(plane: Any, flip: bool | None) -> bool:
    """Flip the map of internal aberrations if wanted; return whether the map is now flipped."""
    flipped = bool(getattr(plane, "_is_OPD_flipped_for_NRC_coron", False))
    if flip is None or flip == flipped:
        return flipped
    # Only the map is flipped. Focus and tilt, which depend on the wavelength, are added later.
    plane.opd = plane.opd[::-1].copy()
    return flip


def opd_to_webbpsf(opd: Any, nircam: Any) -> fits.HDUList:
    """A refined wavefront in the form of ``nircam.pupilopd``.

    stpsf adds the telescope's field dependence to `pupilopd`. This function subtracts the field
    dependence, so that the whole telescope has the given OPD at the position of `nircam`.

    Parameters
    ----------
    opd : Tensor, Quantity or array, (n, n)
        OPD in m, in entrance-pupil orientation; for example a refined wavefront. The map is
        resampled to the pixels of ``nircam.pupil``.
    nircam : stpsf.NIRCam
        Instrument, which is not changed. Set ``nircam.pupilopd`` to the result.

    Returns
    -------
    HDUList

    Raises
    ------
    UnitError, NonFiniteError, ShapeError
        For a map that cannot be a wavefront in metres.
    CorruptFileError
        If a file of stpsf's data is missing.
    """
    instrument = private_copy(nircam)
    with data_errors():
        amplitude = np.asarray(instrument._get_telescope_pupil_and_aberrations().amplitude)
    values = resample(to_metres(opd, "opd"), len(amplitude))
    check_opd(values, amplitude, "opd")
    hdus = opd_to_hdus(values)
    instrument.pupilopd = hdus
    with data_errors():
        added = np.asarray(instrument._get_telescope_pupil_and_aberrations().opd) - values
    hdus[0].data = values - added
    return hdus
