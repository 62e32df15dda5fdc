"""`from_webbpsf`: make a system of an stpsf (webbpsf) NIRCam object, and export wavefronts."""

from __future__ import annotations

import os
from collections.abc import Collection, Mapping
from typing import Any, ClassVar

import numpy as np
import torch
from astropy import units as u
from astropy.io import fits

from pyklip_diffrender.bridges.convert import Conversion
from pyklip_diffrender.bridges.intermediates import intermediate_wavefronts
from pyklip_diffrender.bridges.poppy import PoppySystem, check_supported, refuse_saving
from pyklip_diffrender.bridges.sampled_planes import AberrationOptic
from pyklip_diffrender.bridges.stpsf_instrument import (
    band,
    data_errors,
    kernel_files_left_open,
    oversampling,
    private_copy,
    with_effects,
)
from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.io.keywords import set_keyword
from pyklip_diffrender.io.units import to_metres, to_number
from pyklip_diffrender.optics.bandpass import Bandpass
from pyklip_diffrender.optics.grid import resample
from pyklip_diffrender.optics.psf_file import poppy_psf, save
from pyklip_diffrender.optics.system import OpticalSystem
from pyklip_diffrender.wavefront.map_files import check_opd, opd_to_hdus

__all__ = ["WebbSystem", "from_webbpsf", "opd_to_webbpsf"]


class WebbSystem(PoppySystem):
    """A `PoppySystem` made from an stpsf instrument by `from_webbpsf`.

    Attributes
    ----------
    instrument : stpsf.NIRCam
        The model's own copy, as of its conversion.
    si_wfe_flipped : bool or None
        Whether the map of the instrument's internal wavefront error is flipped vertically, as
        stpsf does from 2.2.0 on; None without one.
    """

    instrument: Any
    si_wfe_flipped: bool | None
    _sources: ClassVar[tuple[str, ...]] = ("nircam", "trainable")
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

    def calc_psf(  # type: ignore[override]  # An instrument's arguments, not an OpticalSystem's.
        self,
        outfile: str | os.PathLike[str] | None = None,
        source: Any = None,
        nlambda: int | None = None,
        monochromatic: Any = None,
        fov_arcsec: float | None = None,
        fov_pixels: int | tuple[int, int] | None = None,
        oversample: int | None = None,
        detector_oversample: int | None = None,
        fft_oversample: int | None = None,
        overwrite: bool = True,
        display: bool = False,
        save_intermediates: bool = False,
        return_intermediates: bool = False,
        normalize: str = "first",
        add_distortion: bool = True,
        crop_psf: bool = True,
        opd: Any = None,
        **parameters: Any,
    ) -> Any:
        """PSF as an HDUList, with the arguments, extensions and keywords of stpsf's `calc_psf`.

        Arguments that are not given keep the values that the system was made with. The image is
        this system's; stpsf itself then adds jitter, distortion, detector effects and header.

        Parameters
        ----------
        opd, **parameters
            As in a call of the system, for the PSF of a refined wavefront.
        display, save_intermediates
            Accepted for compatibility with stpsf; nothing is drawn, and saving is refused.

        Returns
        -------
        HDUList, or (HDUList, list of poppy.Wavefront)
            OVERSAMP, DET_SAMP, OVERDIST and DET_DIST, the last two with `add_distortion`.
        """
        refuse_saving(save_intermediates)
        arguments = {
            "source": source,
            "nlambda": nlambda,
            "monochromatic": monochromatic,
            "fov_arcsec": fov_arcsec,
            "fov_pixels": fov_pixels,
            "oversample": oversample,
            "detector_oversample": detector_oversample,
            "fft_oversample": fft_oversample,
        }
        changes = {name: value for name, value in arguments.items() if value is not None}
        system: Any = self.with_fidelity(**changes)
        result = poppy_psf(system, normalize, opd, **parameters)
        instrument = system.instrument
        options = {
            **instrument.options,
            "add_distortion": add_distortion,
            "crop_psf": crop_psf,
            "detector_oversample": system.detector.oversample,
            "fft_oversample": oversampling(system.recipe)[0],
        }
        with kernel_files_left_open():
            instrument._apply_jitter(result, options)
            instrument._get_fits_header(result, options)
            instrument._calc_psf_format_output(result, options)
        if system.si_wfe_flipped is not None:
            for hdu in result:
                set_keyword(hdu.header, "DRSIFLIP", system.si_wfe_flipped)
        save(result, outfile, overwrite)
        if return_intermediates:
            return result, intermediate_wavefronts(
                system, system.frames, normalize, only_last=False
            )
        return result


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
    trainable: Collection[str] = (),
    dtype: torch.dtype = torch.float64,
    device: str | torch.device = "cpu",
) -> WebbSystem:
    """Make a differentiable system of a configured `stpsf.NIRCam` (or `webbpsf.NIRCam`).

    The system has the instrument's filter, masks, options (source offset, pupil shift and
    rotation, shift of the occulter, ND squares, jitter), pixel scale, OPD and internal wavefront
    errors with their field dependence. ``model()`` is stpsf's DET_SAMP, or DET_DIST with
    `add_distortion`; ``model(opd)`` replaces the whole OPD of the telescope, and
    ``model.entrance.opd`` is the one it has.

    The result can be passed to `refine` and `detect` like any other system.

    Parameters
    ----------
    nircam : stpsf.NIRCam
        Not changed; later changes to it do not affect the model.
    fov_pixels, fov_arcsec, oversample, detector_oversample, fft_oversample, monochromatic,
    nlambda, source
        As in stpsf's `calc_psf`, with its defaults.
    bandpass : Bandpass, optional
        Wavelengths and weights, in place of `monochromatic`, `nlambda` and `source`.
    add_distortion : bool
        Include the effects in stpsf's DET_DIST: rotation, distortion, charge diffusion, IPC, PPC.
    flip_si_wfe : bool, optional
        Whether to flip the coronagraph's internal wavefront error vertically; default as in the
        installed stpsf, which flips it from 2.2.0 on. See ``model.si_wfe_flipped``.
    propagation, occulter_sampling, npix, trainable, dtype, device
        See `from_poppy`; the default sampling is `fft_oversample`, the default `npix` that of
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
    # Before stpsf adds the field dependence, which is not blank outside the pupil.
    original = getattr(first, "_opd_original", first.opd)
    check_opd(np.asarray(original), np.asarray(first.amplitude), "pupilopd")
    aberrations = _aberrations(osys)
    flipped = None if aberrations is None else _set_flip(aberrations, flip_si_wfe)
    conversion = Conversion(
        osys,
        # The field of view is already that of the detector.
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
    """Flip the map of internal aberrations if wanted; return whether it is now flipped."""
    flipped = bool(getattr(plane, "_is_OPD_flipped_for_NRC_coron", False))
    if flip is None or flip == flipped:
        return flipped
    # The map alone: focus and tilt, which depend on the wavelength, are added to it later.
    plane.opd = plane.opd[::-1].copy()
    return flip


def opd_to_webbpsf(opd: Any, nircam: Any) -> fits.HDUList:
    """A refined wavefront in the form of ``nircam.pupilopd``.

    stpsf adds the telescope's field dependence to `pupilopd`; it is subtracted here, so that the
    telescope as a whole has the given OPD at the position of `nircam`.

    Parameters
    ----------
    opd : Tensor, Quantity or array, (n, n)
        m, entrance-pupil orientation; for example a refined wavefront. It is resampled to the
        pixels of ``nircam.pupil``.
    nircam : stpsf.NIRCam
        Not changed. Set its ``pupilopd`` to the result.

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
