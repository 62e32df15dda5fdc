"""`OpticalSystem`: a differentiable coronagraph whose numerical settings can be changed."""

from __future__ import annotations

import copy
import datetime
import os
import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
import torch
from astropy.io import fits
from astropy.io.fits.verify import VerifyWarning
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from pyklip_diffrender import drawing
from pyklip_diffrender._version import __version__
from pyklip_diffrender.errors import IncompatibleSetupError, ShapeError
from pyklip_diffrender.io.files import require_new, write_fits
from pyklip_diffrender.io.headers import set_keyword
from pyklip_diffrender.io.units import ARCSEC, require_finite, to_metres, to_unit, warn_of_rms
from pyklip_diffrender.optics.bandpass import Bandpass
from pyklip_diffrender.optics.fast_path import LatticeRoute, PlaneWaves
from pyklip_diffrender.optics.grid import PupilGrid, resample
from pyklip_diffrender.optics.planes import (
    CompactOcculter,
    Detector,
    EntrancePupil,
    Plane,
    Values,
    Wavefront,
)
from pyklip_diffrender.parameters import parameter

# Threads of torch in processes that are made by a fork.

_registered = False


def one_thread_after_fork() -> None:
    """Let forked children of this process compute with one thread."""
    # A fork copies the state of the thread pool of OpenMP, but not its threads: a child of a
    # process that has computed with several threads, such as a worker of `multiprocessing.Pool`,
    # would wait for them forever. One thread needs no pool. Children may not raise the number
    # again.
    global _registered
    if not _registered and hasattr(os, "register_at_fork"):
        os.register_at_fork(after_in_child=lambda: torch.set_num_threads(1))
        _registered = True


# How many arrays to compute at a time.

_CPU_BYTES = 3e6
"""Bytes of one array of a batch on the CPU. Batches of three times the size may take twice as long:
the C library returns their memory to the operating system, which has to clear it for the next."""

_GPU_BYTES = 1e8
"""Bytes of one array of a batch on an accelerator, which needs many arrays at a time to be busy;
not measured."""


def batch_of(size: int, dtype: torch.dtype, device: torch.device) -> int:
    """Return how many arrays of `size` elements to compute at a time, at least 1."""
    available = _CPU_BYTES if device.type == "cpu" else _GPU_BYTES
    return max(1, int(available / (size * dtype.itemsize)))


# `Propagation`: the image of a star from the wavefront, through the planes of a coronagraph.
#
# At every wavelength the entrance pupil converts the OPD to a field, the planes propagate it
# linearly, and the detector samples it. The image is the weighted sum of the intensities.

Value = Tensor | ArrayLike | float

_ON_AXIS = (0.0, 0.0)

one_thread_after_fork()


class Propagation:
    """The path of light through a coronagraph; see `OpticalSystem` for the arguments."""

    def __init__(
        self,
        entrance: EntrancePupil,
        planes: Sequence[Plane],
        detector: Detector,
        bandpass: Bandpass,
        route: str = "auto",
        defaults: Mapping[str, Value] | None = None,
    ) -> None:
        self.entrance = entrance
        self.planes = tuple(planes)
        self.detector = detector
        self.bandpass = bandpass
        self._lattice = self._choose_route(route)
        if defaults and "star_offset" in defaults:
            raise IncompatibleSetupError(
                "defaults: star_offset belongs to a source; give it in the call, or move the "
                "optical axis with detector_shift"
            )
        self.defaults: dict[str, Tensor] = {}
        self.defaults = self.values(defaults or {})

    def _choose_route(self, route: str) -> LatticeRoute | None:
        if route not in ("auto", "lattice", "planes"):
            raise IncompatibleSetupError(
                f"route: got {route!r}, expected 'auto', 'lattice' or 'planes'"
            )
        if route == "planes":
            return None
        if not LatticeRoute.serves(self.planes):
            if route == "auto":
                return None
            raise IncompatibleSetupError(
                "route 'lattice': the planes are not one round occulter between factors in "
                "pupils; use 'auto' or 'planes'"
            )
        lattice = LatticeRoute(self.planes, self.detector)
        return lattice if route == "lattice" or lattice.pays(self.bandpass.wavelengths) else None

    @property
    def route(self) -> str:
        """How light gets to the detector: "lattice" or "planes"."""
        return "planes" if self._lattice is None else "lattice"

    @property
    def npix(self) -> int:
        """Samples across the pupil array."""
        return self.entrance.full.npix

    @property
    def diameter(self) -> float:
        """Side of the pupil array, m."""
        return self.entrance.full.diameter

    @property
    def resolution(self) -> float:
        """lambda/D at the mean wavelength, arcsec."""
        return self.bandpass.mean_wavelength / self.diameter / ARCSEC

    @property
    def dtype(self) -> torch.dtype:
        """Real type of the computation."""
        return self.entrance.dtype

    @property
    def device(self) -> torch.device:
        """Device of the computation."""
        return self.detector.device

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the parameters that this system takes besides the OPD."""
        between = [name for plane in self.planes for name in plane.parameters]
        return (*self.entrance.parameters, *between, *self.detector.parameters)

    def opd(self, opd: Value | None) -> Tensor:
        """Check an OPD and bring it to the system's device: (..., npix, npix) in m.

        Arrays, Quantities and maps with another number of pixels across the pupil are resampled,
        see `grid.resample`. Tensors keep their values, so that gradients flow, and must have the
        system's own size. None stands for the system's own wavefront, which is flat unless it was
        made with one. ShapeError for a map that is not square or a tensor of another size,
        UnitError for a Quantity that is not a length, NonFiniteError for values that are not
        finite; a warning for an array whose rms inside the pupil is that of a wavefront in another
        unit.
        """
        if opd is None and self.entrance.opd is not None:
            return self.entrance.opd
        if opd is None:
            return torch.zeros(self.npix, self.npix, dtype=self.dtype, device=self.device)
        if isinstance(opd, str | os.PathLike):
            raise TypeError(f"opd: got the path {opd!r}; read it first, with read_opd(path)")
        if isinstance(opd, Tensor):
            if opd.shape[-2:] != (self.npix, self.npix):
                raise ShapeError(
                    f"opd: got a tensor of shape {tuple(opd.shape)}, expected (..., {self.npix}, "
                    f"{self.npix}). Tensors are not resampled, because gradients may flow through "
                    f"them: pass opd.numpy(), or make the system with npix={opd.shape[-1]}"
                )
            return opd.to(self.device)
        array = to_metres(opd, "opd")
        require_finite(array, "opd (NaN is only allowed outside the pupil; set it to 0)")
        array = resample(array, self.npix)
        lit = self.entrance.lit.cpu().numpy()
        # Maps and Quantities have units. A small rms is fine: a mode of 1 pm, for example.
        if isinstance(opd, np.ndarray) and lit.any():
            rms = float(array[..., lit].std(axis=-1).max())
            warn_of_rms(rms, "opd", stacklevel=5, small=False)
        return torch.from_numpy(array).to(self.device)

    def values(self, parameters: Mapping[str, Value | None]) -> dict[str, Tensor]:
        """Check named parameter values and make them float64 tensors, (components,) each.

        Quantities are converted to the unit of the parameter table (UnitError if they are of
        another kind). Parameters that are missing or None get the system's `defaults`, if it has
        them. TypeError for a name that this system does not take, ShapeError for a wrong number of
        components.
        """
        checked = dict(self.defaults)
        for name, value in parameters.items():
            if value is None:
                continue
            if name not in self.parameters:
                raise TypeError(f"{name!r} is not a parameter of this system: {self.parameters}")
            if not isinstance(value, Tensor):
                value = to_unit(value, parameter(name).unit, name)
                require_finite(value, name)
            tensor = torch.as_tensor(value, dtype=torch.float64).to(self.device)
            tensor = tensor.reshape(1) if tensor.ndim == 0 else tensor
            if tensor.shape[-1] != parameter(name).size:
                raise ShapeError(
                    f"{name}: got {tensor.shape[-1]} components, expected {parameter(name).size}"
                )
            checked[name] = tensor
        return checked

    def pupil_field(self, opd: Tensor, wavelength: float, values: Values) -> Wavefront:
        """The field behind the entrance pupil, the only step that is not linear."""
        return self.entrance.field(opd, wavelength, values.get("star_offset"))

    def windows(self, values: Values) -> list[PupilGrid]:
        """For every plane, the pupil window that it must pass on, given the planes behind it."""
        needed = self.entrance.full
        passed: list[PupilGrid] = []
        for plane in reversed(self.planes):
            passed.append(needed)
            # A mask acts on all the light in front of it, not only on what is needed behind.
            needed = plane.window(values) or (self.entrance.full if plane.focal else needed)
        return passed[::-1]

    def propagate(self, wavefront: Wavefront, values: Values) -> Tensor:
        """Field on the detector's samples from the field behind the entrance pupil; linear."""
        if self._lattice is not None:
            return self._lattice.field(wavefront, values, self.windows(values))
        return self.detector.field(self.behind_planes(wavefront, values), values)

    def behind_planes(self, wavefront: Wavefront, values: Values) -> Wavefront:
        """The wavefront behind the last plane, one plane after the other."""
        for plane, onto in zip(self.planes, self.windows(values), strict=True):
            wavefront = plane.apply(wavefront, values, onto)
        return wavefront

    def plane_waves(self, wavefront: Wavefront, values: Values, reach: int) -> PlaneWaves | None:
        """Prepare the propagation of a field behind the entrance pupil times plane waves.

        Waves have up to `reach` cycles across the pupil array along an axis. None where that is not
        faster than `propagate`.
        """
        if self._lattice is None:
            return None
        return self._lattice.plane_waves(wavefront, values, self.windows(values), reach)

    @property
    def _last_occulter(self) -> int:
        """Number of planes up to the last occulter."""
        return max((k + 1 for k, plane in enumerate(self.planes) if plane.focal), default=0)

    @property
    def parameters_behind(self) -> frozenset[str]:
        """Names of the parameters of the planes behind the last occulter, and of the detector."""
        behind = {n for plane in self.planes[self._last_occulter :] for n in plane.parameters}
        before = {n for plane in self.planes[: self._last_occulter] for n in plane.parameters}
        names = behind | set(self.detector.parameters)
        return frozenset(names - before - set(self.entrance.parameters))

    def behind_occulter(self, wavefront: Wavefront, values: Values) -> Wavefront:
        """Propagate from behind the entrance pupil to the pupil behind the last occulter.

        Together with `to_detector` this is `propagate`. It is slower, but what it returns does not
        depend on `parameters_behind`.
        """
        windows = self.windows(values)
        if self._lattice is not None:
            return self._lattice.behind_occulter(wavefront, values, windows)
        for plane, onto in zip(self.planes[: self._last_occulter], windows, strict=False):
            wavefront = plane.apply(wavefront, values, onto)
        return wavefront

    def to_detector(self, wavefront: Wavefront, values: Values) -> Tensor:
        """Field on the detector's samples from that in the pupil behind the last occulter."""
        first = self._last_occulter
        for plane, onto in zip(self.planes[first:], self.windows(values)[first:], strict=True):
            wavefront = plane.apply(wavefront, values, onto)
        return self.detector.field(wavefront, values)

    def transmission(self, opd: Value | None = None, **parameters: Value) -> float:
        """Fraction of the collected light of a source far from the occulter that is detected.

        It is that of the planes in pupils, such as the Lyot stop, at the mean wavelength.
        """
        open_path = copy.copy(self)
        open_path.planes = tuple(each for each in self.planes if not each.focal)
        values = self.values(parameters)
        with torch.no_grad():
            wavefront = self.pupil_field(self.opd(opd), self.bandpass.mean_wavelength, values)
            wavefront = open_path.behind_planes(wavefront, values)
        power = wavefront.field.abs().double().square().sum(dim=(-2, -1))
        return float(power * wavefront.grid.spacing**2)

    def field(self, opd: Tensor, wavelength: float, values: Values) -> Tensor:
        """Complex field on the detector's samples, (..., ny, nx), for an OPD from `opd`."""
        return self.propagate(self.pupil_field(opd, wavelength, values), values)

    def fields(self, opd: Value | None = None, **parameters: Value) -> list[Tensor]:
        """Complex field on the detector's samples at each wavelength, each (..., ny, nx)."""
        tensor, values = self.opd(opd), self.values(parameters)
        return [self.field(tensor, wavelength, values) for wavelength in self.bandpass.wavelengths]

    def image_of(
        self, fields: Sequence[Tensor], values: Values, weights: Tensor | None = None
    ) -> Tensor:
        """Image (..., ny, nx) from the `fields` at all wavelengths.

        Of the `values` only the detector's matter; `weights` (wavelengths,) replace the bandpass's.
        """
        spectrum = self.bandpass.weights if weights is None else weights
        intensity = torch.zeros((), dtype=self.dtype, device=self.device)
        for field, weight in zip(fields, spectrum, strict=True):
            intensity = intensity + weight * (field.real**2 + field.imag**2)
        return self.detector.image(intensity, values)

    def __call__(
        self,
        opd: Value | None = None,
        star_offset: Value = _ON_AXIS,
        *,
        weights: Tensor | None = None,
        **parameters: Value,
    ) -> Tensor:
        """Image of a point source.

        Parameters
        ----------
        opd : Tensor, Quantity or array, (..., npix, npix), optional
            OTE OPD in entrance-pupil orientation; bare numbers are metres.
        star_offset : (..., 2)
            x, y of the source in arcsec, image orientation. Batches broadcast against `opd`.
        weights : Tensor, (wavelengths,), optional
            Replace the weights of the bandpass.
        **parameters
            Any of `self.parameters`, in the units of the parameter table.

        Returns
        -------
        Tensor, (..., ny, nx)
            Light per detector pixel as a fraction of the light that the entrance pupil collects.
        """
        if star_offset is not _ON_AXIS:  # Explicit zeros are kept, for their derivative.
            parameters["star_offset"] = star_offset
        return self.image_of(self.fields(opd, **parameters), self.values(parameters), weights)

    def debug(
        self, opd: Value | None = None, wavelength: float | None = None, **parameters: Value
    ) -> dict[str, Tensor]:
        """The field at every named plane, in order.

        Pupil planes: the field behind the plane on its window of the pupil. Occulters: the field in
        front of the mask, on its cells ("... focus"), then the field back in the pupil. The
        detector: the field on its samples.
        """
        tensor, values = self.opd(opd), self.values(parameters)
        wavelength = wavelength or self.bandpass.wavelengths[0]
        wavefront = self.pupil_field(tensor, wavelength, values)
        fields = {self.entrance.name: wavefront.field}
        for plane, onto in zip(self.planes, self.windows(values), strict=True):
            if isinstance(plane, CompactOcculter):
                fields[f"{plane.name} focus"] = plane.focal_field(wavefront)
            wavefront = plane.apply(wavefront, values, onto)
            fields[plane.name] = wavefront.field
        # As in a call, which may take another route than the planes above.
        fields[self.detector.name] = self.field(tensor, wavelength, values)
        return fields


# PSFs in the form that poppy and stpsf give them: HDULists with their extensions and keywords.

Array = NDArray[np.float64]

_NORMALIZATIONS = ("first", "last", "exit_pupil", "none")


def _samples(system: Propagation, normalize: str, opd: Any, parameters: dict[str, Any]) -> Array:
    """Light on the detector's samples, before binning, (oversample ny, oversample nx).

    `normalize` says what adds up to 1 at every wavelength: the light behind the "first" plane, on
    the "last", or in the "exit_pupil"; with "none" the field is 1 where the pupil is clear.
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
                light = light / _exit_light(system, tensor, wavelength, parameters)
            elif kind == "none":
                light = light * system.entrance.total
            total = total + weight * light.double().cpu().numpy()
    return np.asarray(total, dtype=np.float64)


def _exit_light(
    system: Propagation, opd: Tensor, wavelength: float, parameters: dict[str, Any]
) -> Tensor:
    """Share of the light that reaches the last pupil."""
    values = system.values(parameters)
    wavefront = system.behind_planes(system.pupil_field(opd, wavelength, values), values)
    light: Tensor = (wavefront.field.abs() ** 2).sum() * wavefront.grid.spacing**2
    return light


def _propagations(system: Propagation) -> str:
    """For systems made from poppy's, how each image plane is passed."""
    used = getattr(system, "propagation", None) or {}
    return ", ".join(f"{name}: {kind}" for name, kind in used.items()) or "compact"


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
    set_keyword(header, "DRPROP", _propagations(system))
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

    `setup` is `OpticalSystem.setup`, `sampling` the cells per lambda/D on the occulter, for the
    header; see `_samples` for `normalize`.
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
    """Raise for keywords of poppy's or stpsf's that are set and that a system cannot serve."""
    for name, reason in reasons.items():
        # An input wavefront is an array of numbers, without a truth value.
        if given[name] is not None and given[name] is not False:
            raise IncompatibleSetupError(f"{name}={given[name]!r}: {reason}")


def require_one_sampling(common: int | None, detector: int | None, fft: int | None) -> None:
    """Raise if the oversampling of detector and image planes is given twice, as stpsf does."""
    if None not in (common, detector, fft):
        raise IncompatibleSetupError(
            "give oversample, or detector_oversample with fft_oversample, not all three"
        )


def save(hdus: fits.HDUList, outfile: str | os.PathLike[str] | None, overwrite: bool) -> None:
    """Write a PSF, unless `outfile` is None; ExistingFileError if it must not be replaced."""
    if outfile is None:
        return
    require_new([outfile], overwrite)
    hdus[0].header["FILENAME"] = (os.path.basename(outfile), "Name of this file")
    with warnings.catch_warnings():
        # Some of stpsf's comments are longer than a card.
        warnings.filterwarnings("ignore", "Card is too long", VerifyWarning)
        write_fits(hdus, outfile)


# `OpticalSystem`: a differentiable coronagraph whose numerical settings can be changed.

_REFUSED = {
    "save_intermediates": "this system writes no files of its own; debug(opd) returns the field at "
    "every plane",
    "return_intermediates": "this system has no poppy.Wavefront objects, as systems of from_poppy "
    "and from_webbpsf have; debug(opd) returns the field at every plane",
    "add_distortion": "distortion and charge diffusion are modelled by from_webbpsf only; leave it "
    "out for OVERSAMP and DET_SAMP alone",
}
"""Keywords of stpsf's `calc_psf` that `OpticalSystem.calc_psf` does not serve, and why."""

_BAND = ("monochromatic", "nlambda", "source", "wavelength")
"""Settings that determine the wavelengths."""


class OpticalSystem(Propagation):
    """A coronagraph: entrance pupil, the planes behind it, detector.

    Call it with an OPD to get the image of a star; everything is differentiable in torch.

    Parameters
    ----------
    entrance : EntrancePupil
    planes : sequence of Plane
        The planes in between, in order. Each is linear in the field.
    detector : Detector
    bandpass : Bandpass
        Wavelengths and weights.
    recipe : mapping, optional
        The arguments that the system was made with, for provenance and for `with_fidelity`.
    remake : callable, optional
        Makes another system from the arguments in `recipe`, some of them changed.
    route : "auto", "lattice" or "planes"
        How light gets to the detector: by a convolution on cells that fit the detector, which
        needs a single compact occulter between pupils, or plane by plane, which always works.
        "auto" takes the first if possible, unless the detector is very fine.
    defaults : mapping of str to value, optional
        Values of named parameters for calls that do not give them, in the units of the parameter
        table: the alignment of the instrument, or the result of an earlier fit. Not
        ``star_offset``, which belongs to a source and not to the instrument.

    Attributes
    ----------
    defaults : dict of str to Tensor
    maker : callable or None
        `remake`.

    Raises
    ------
    IncompatibleSetupError
        For the route "lattice" with planes that it does not support, and for a default
        ``star_offset``.
    TypeError, ShapeError, UnitError
        For defaults that `values` refuses.

    Examples
    --------
    >>> import pyklip_diffrender as dr
    >>> model = dr.nircam_coronagraph("F444W", monochromatic=4.5e-6, npix=128, fov_pixels=32)
    >>> opd = dr.random_opd(1, npix=128)
    >>> model.parameters[:2]
    ('star_offset', 'lyot_shift')
    >>> star = model(opd.data, star_offset=(0.01, 0.0))
    >>> star.shape
    torch.Size([32, 32])
    """

    _replaced: ClassVar[dict[str, tuple[str, ...]]] = {
        "fov_pixels": ("fov_arcsec",),
        "fov_arcsec": ("fov_pixels",),
        "nlambda": ("monochromatic",),
        "source": ("monochromatic",),
    }
    """For a setting, the alternatives to it, which are dropped when it is given."""

    def __init__(
        self,
        entrance: EntrancePupil,
        planes: Sequence[Plane],
        detector: Detector,
        bandpass: Bandpass,
        recipe: dict[str, Any] | None = None,
        remake: Callable[..., OpticalSystem] | None = None,
        route: str = "auto",
        defaults: Mapping[str, Value] | None = None,
    ) -> None:
        super().__init__(entrance, planes, detector, bandpass, route, defaults)
        self.recipe = dict(recipe or {})
        self.maker = remake
        self._other_bandpass: Bandpass | None = None

    def __repr__(self) -> str:
        names = ", ".join(
            [self.entrance.name, *(plane.name for plane in self.planes), self.detector.name]
        )
        waves = len(self.bandpass.wavelengths)
        return (
            f"<OpticalSystem: {names}; {self.npix} px pupil, {waves} wavelength"
            f"{'s' if waves > 1 else ''} about {self.bandpass.mean_wavelength * 1e6:.2f} um, "
            f"{self.detector.shape[1]} x {self.detector.shape[0]} px>"
        )

    @property
    def setup(self) -> dict[str, str]:
        """The instrument setup that the system models; empty if it is not an instrument.

        Names in the spelling of stpsf under "filter", "image_mask", "pupil_mask" and "module".
        """
        names = ("filter", "image_mask", "pupil_mask", "module")
        return {name: self.recipe[name] for name in names if self.recipe.get(name)}

    @property
    def adjustable(self) -> frozenset[str]:
        """Names of the settings that `with_fidelity` can change.

        "npix", "dtype", "occulter_sampling", "fov_pixels" and "bandpass" (a `Bandpass`) have the
        same names in all systems that can change them. The other names are arguments of the
        function that made the system. A system made directly from planes can only change its
        bandpass, and not even that if its planes were sampled at certain wavelengths.
        """
        names = set(self.recipe) if self.maker is not None else set()
        return frozenset(names if self._is_sampled else {*names, "bandpass"})

    def with_fidelity(self, **changes: Any) -> OpticalSystem:
        """Return a copy of the system with other numerical settings, such as ``npix=256``.

        Parameters
        ----------
        **changes
            Settings in `adjustable`. Alternatives are dropped: ``fov_pixels`` replaces
            ``fov_arcsec``, ``nlambda`` replaces ``monochromatic``. A setting that keeps its value
            is always accepted.

        Raises
        ------
        IncompatibleSetupError
            For a setting that this system cannot change, or an invalid value.
        """
        refused = [
            name
            for name, value in changes.items()
            if name not in self.adjustable and value is not self.recipe.get(name)
        ]
        if refused:
            raise IncompatibleSetupError(
                f"{', '.join(refused)}: {self!r} cannot change that; it can change "
                f"{', '.join(sorted(self.adjustable)) or 'nothing'}. Make a second system with "
                "the settings you want"
            )
        changes = {name: value for name, value in changes.items() if name in self.adjustable}
        bandpass = changes.pop("bandpass", None)
        if bandpass is None and changes.keys().isdisjoint(_BAND):
            bandpass = self._other_bandpass
        system = self._remade(changes) if changes else self
        return system if bandpass is None else system.at_wavelengths(bandpass)

    def at_wavelengths(self, bandpass: Bandpass) -> OpticalSystem:
        """Return a copy of the system with another bandpass.

        The planes and their cached results are shared. `with_fidelity` of the result keeps the
        bandpass.

        Parameters
        ----------
        bandpass : Bandpass
            Any wavelengths if "bandpass" is in `adjustable`, otherwise a selection of the
            system's own.

        Raises
        ------
        IncompatibleSetupError
            For wavelengths at which the planes were not sampled.
        """
        if bandpass == self.bandpass:
            return self
        known = set(bandpass.wavelengths) <= set(self.bandpass.wavelengths)
        if not known and self._is_sampled:
            raise IncompatibleSetupError(
                f"bandpass: got the wavelengths {bandpass.wavelengths} m, but planes of {self!r} "
                f"were sampled at {self.bandpass.wavelengths} m"
            )
        other = copy.copy(self)
        other.bandpass = other._other_bandpass = bandpass
        return other

    @property
    def _is_sampled(self) -> bool:
        """Whether planes are known only at the wavelengths of the bandpass."""
        return self.entrance.sampled or any(plane.sampled for plane in self.planes)

    def _remade(self, changes: Mapping[str, Any]) -> OpticalSystem:
        """Another system from the same recipe with some changes."""
        assert self.maker is not None  # Otherwise its arguments are not adjustable.
        dropped = {
            other: None
            for name in changes
            for other in self._replaced.get(name, ())
            if other in self.recipe and other not in changes
        }
        return self.maker(**{**self.recipe, **dropped, **changes})

    def calc_psf(
        self,
        outfile: str | os.PathLike[str] | None = None,
        source: Any = None,
        nlambda: int | None = None,
        monochromatic: float | None = None,
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
        add_distortion: bool = False,
        crop_psf: bool = True,
        opd: Value | None = None,
        **parameters: Value,
    ) -> fits.HDUList:
        """PSF as an HDUList, with the arguments of `calc_psf` of poppy's and stpsf's instruments.

        Arguments that are not given keep the values that the system was made with.

        Parameters
        ----------
        source : float, Quantity, (wavelengths, photons) or mapping, optional
            Temperature (K) or spectrum of the star, or "wavelengths" (m) and "weights" of the PSF.
        oversample, detector_oversample, fft_oversample : int, optional
            Samples per pixel, and per lambda/D on the occulter; the first sets both.
        outfile : path, optional
            Write the result there.
        display : bool
            Draw the PSF in a new figure of matplotlib, on a logarithmic scale.
        normalize : str
            "first", "last", "exit_pupil" or "none", as in poppy.
        save_intermediates, return_intermediates, add_distortion
            Refused with a pointer to what does the same.
        crop_psf
            Without effect, as in stpsf where there is no distortion.
        opd, **parameters
            As in a call of the system.

        Returns
        -------
        HDUList
            Extensions OVERSAMP and DET_SAMP.

        Raises
        ------
        IncompatibleSetupError
            For a keyword of stpsf's that this system does not serve, with the reason, and for a
            setting that it cannot change.
        """
        refuse_keywords(_REFUSED, locals())
        require_one_sampling(oversample, detector_oversample, fft_oversample)
        bandpass = None
        if isinstance(source, Mapping):
            # As stpsf: wavelengths and weights of the PSF, in place of a spectrum and a filter.
            bandpass = Bandpass(*(tuple(source[name]) for name in ("wavelengths", "weights")))
        changes = {
            "bandpass": bandpass,
            "source": source if bandpass is None else None,
            "nlambda": nlambda,
            "monochromatic": monochromatic,
            "fov_arcsec": fov_arcsec,
            "fov_pixels": fov_pixels,
            "oversample": oversample if detector_oversample is None else detector_oversample,
            "occulter_sampling": oversample if fft_oversample is None else fft_oversample,
        }
        system = self.with_fidelity(**{k: v for k, v in changes.items() if v is not None})
        sampling = system.recipe.get("occulter_sampling")
        hdus = instrument_psf(system, system.setup, sampling, normalize, opd, **parameters)
        save(hdus, outfile, overwrite)
        if display:
            system.draw_psf(hdus, parameters)
        return hdus

    def draw_psf(self, hdus: fits.HDUList, parameters: Mapping[str, Value]) -> None:
        """Draw the oversampled image of a PSF in a new figure, for poppy's ``display=True``."""
        (ax,) = drawing.axes_for(None, 1)
        self._draw_image(ax, hdus[0].data, self.values(parameters), "PSF")

    def _draw_image(self, ax: Any, light: Array, values: Values, title: str) -> None:
        """Draw light on the detector's pixels or on its samples."""
        x, y = (
            axis.detach().reshape(count, -1).mean(dim=1).cpu().numpy() / ARCSEC
            for axis, count in zip(self.detector.axes(values), light.shape[::-1], strict=True)
        )
        drawing.star_image(
            ax, light, np.stack(np.meshgrid(x, y), axis=-1), drawing.light_norm(light),
            bar="fraction of the star's light",
            title=f"{title}, {1e6 * self.bandpass.mean_wavelength:.2f} um",
        )  # fmt: skip
        ax.set_xlabel("x from the optical axis (arcsec)")
        ax.set_ylabel("y from the optical axis (arcsec)")

    def plot(self, ax: Any = None, *, opd: Value | None = None) -> NDArray[Any]:
        """Draw the entrance pupil, the wavefront error, the light in the last pupil and the image.

        The light in the last pupil and the image are those of a star on the optical axis, in
        logarithmic scale.

        Parameters
        ----------
        ax : four Axes, optional
            Default those of a new figure.
        opd : Tensor, Quantity or array, (npix, npix), optional
            As in a call of the system.

        Returns
        -------
        ndarray of Axes, (4,)
        """
        pupil, phase, last, image = axes = drawing.axes_for(ax, 4)
        mean = self.bandpass.mean_wavelength
        wavelength = min(self.bandpass.wavelengths, key=lambda each: abs(each - mean))
        with torch.no_grad():
            checked, values = self.opd(opd), self.values({})
            wavefront = self.pupil_field(checked, wavelength, values)
            first = self._amplitude(wavefront)
            last_pupil = self.behind_planes(wavefront, values)
            behind = (self._amplitude(last_pupil) / first.max()) ** 2
            light = self(checked).double().cpu().numpy()
            map_ = 1e9 * checked.real.double().cpu().numpy()
        width = self.entrance.full.diameter
        map_ = np.where(self.entrance.lit.cpu().numpy(), map_, np.nan)
        drawing.pupil_image(
            pupil, first / first.max(), width, bar="amplitude", title=self.entrance.name
        )
        drawing.wavefront_map(phase, map_, width, title="wavefront error")
        drawing.pupil_image(
            last, behind, width, bar="light, 1 in the first pupil",
            title="light in the last pupil", logarithmic=True,
        )  # fmt: skip
        self._draw_image(image, light, values, "star on the axis")
        return np.array(axes)

    def _amplitude(self, wavefront: Wavefront) -> NDArray[np.float64]:
        """Amplitude of a wavefront on the whole pupil array."""
        whole = wavefront.grid.crop(wavefront.field.abs(), self.entrance.full)
        return np.asarray(whole.double().cpu().numpy())
