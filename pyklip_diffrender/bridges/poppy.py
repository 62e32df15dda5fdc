"""`from_poppy`: make a differentiable system of a poppy `OpticalSystem`, and export wavefronts."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
import poppy
import torch
from astropy import units as u
from numpy.typing import NDArray
from poppy.poppy_core import PlaneType
from poppy.sub_sampled_optics import Subapertures
from torch import Tensor

from pyklip_diffrender.bridges.convert import Conversion
from pyklip_diffrender.bridges.image_masks import FourierMask, SampledOcculter
from pyklip_diffrender.bridges.sampled_planes import Orientation
from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.io.units import ARCSEC, to_metres
from pyklip_diffrender.optics.bandpass import Bandpass
from pyklip_diffrender.optics.grid import resample
from pyklip_diffrender.optics.planes import Detector, Values
from pyklip_diffrender.optics.system import REFUSED, OpticalSystem

Array = NDArray[Any]


def _wavefronts(
    system: PoppySystem, opd: Tensor, values: Values, wavelength: float, only_last: bool
) -> list[poppy.Wavefront]:
    full = system.entrance.full
    waves = []
    with torch.no_grad():
        wavefront = system.pupil_field(opd, wavelength, values)
        windows = system.windows(values)
        for k, plane in enumerate(system.planes[:-1]):
            to_poppy = system.frames[k].inverse
            if isinstance(plane, SampledOcculter | FourierMask):
                field, spacing = plane.focal_sample(wavefront)
                wave = _wave_of(field, wavelength, full.diameter, spacing / ARCSEC)
                if isinstance(plane, FourierMask):
                    field = to_poppy.apply_to_lattice(field)
                else:
                    # In the image, the inversion of y is undone.
                    field = Orientation.inversion("y").then(to_poppy).apply(field)
                wave.wavefront = _numpy(field)
            if k > 0:
                wavefront = system.between[k - 1].apply(wavefront, values, windows[k - 1])
            if not isinstance(plane, SampledOcculter | FourierMask):
                pupil = to_poppy.apply(wavefront.grid.crop(wavefront.field, full)) * full.spacing
                wave = _wave_of(pupil, wavelength, full.diameter, None)
            wave.location = f"after {plane.name}"
            waves.append(wave)
        detector = system.detector
        final = detector.field(wavefront, values)
    scale = detector.pixelscale[0] / detector.oversample
    last = _wave_of(final, wavelength, full.diameter, scale)
    last.oversample = detector.oversample
    last.location = f"at {detector.name}"
    return [last] if only_last else [*waves, last]


def _numpy(field: Tensor) -> Array:
    return np.asarray(field.cpu().numpy(), dtype=np.complex128)


def _wave_of(
    field: Tensor, wavelength: float, diameter: float, arcsec: float | None
) -> poppy.Wavefront:
    """A `poppy.Wavefront` of a field in a pupil, or in an image with samples of `arcsec`."""
    sampling = {} if arcsec is None else {"pixelscale": arcsec * u.arcsec / u.pix}
    wave = poppy.Wavefront(wavelength=wavelength * u.m, npix=1, diam=diameter * u.m, **sampling)
    wave.wavefront = _numpy(field)
    if arcsec is None:
        wave.pixelscale = diameter / len(field) * u.m / u.pix
    else:
        wave.fov = len(field) * arcsec * u.arcsec
    return wave


WRITTEN_BY_CALLER = (
    "this system writes no files of its own; pass return_intermediates=True and call .writeto() on "
    "the wavefronts"
)
"""Why `save_intermediates` is refused."""

_SUPPORTED = (
    "pupil and image planes of any optic with a transmission and an OPD, coordinate "
    "inversions and rotations in pupils, and a Detector at the end"
)


class PoppySystem(OpticalSystem):
    """An `OpticalSystem` made from an `OpticalSystem` of poppy; see `Conversion`."""

    _source: ClassVar[str] = "osys"
    """Argument that defines the system; all others are settings."""
    _refused: ClassVar[Mapping[str, str]] = {
        "save_intermediates": WRITTEN_BY_CALLER,
        "display_intermediates": "display=True draws the PSF alone; pass return_intermediates=True "
        "and call .display() on the wavefronts",
        **REFUSED,
    }
    _replaced: ClassVar[dict[str, tuple[str, ...]]] = {
        **OpticalSystem._replaced,
        "wavelength": ("weights",),
    }

    def __init__(
        self,
        conversion: Conversion,
        recipe: dict[str, Any],
        remake: Callable[..., OpticalSystem],
        detector: Detector | None = None,
    ) -> None:
        super().__init__(
            conversion.entrance,
            conversion.planes,
            detector or conversion.detector,
            conversion.bandpass,
            recipe={**recipe, "occulter_sampling": conversion.sampling},
            remake=remake,
        )
        self.propagation, self.frames = conversion.propagation, conversion.frames
        self._fixed = conversion.fixed

    @property
    def adjustable(self) -> frozenset[str]:
        """See `OpticalSystem.adjustable`.

        "occulter_sampling" is missing if a mask depends on poppy's sampling of the image
        (four-quadrant masks).
        """
        return frozenset({*self.recipe, "bandpass"} - {self._source, *self._fixed})

    def _band(self, bandpass: Bandpass) -> dict[str, Any]:
        """Arguments of `from_poppy` for a bandpass."""
        return {"wavelength": list(bandpass.wavelengths), "weights": list(bandpass.weights)}

    def at_wavelengths(self, bandpass: Bandpass) -> OpticalSystem:
        """See `OpticalSystem.at_wavelengths`; optics are evaluated at new wavelengths."""
        if set(bandpass.wavelengths) <= set(self.bandpass.wavelengths):
            return super().at_wavelengths(bandpass)
        return self._remade(self._band(bandpass))

    def _intermediates(
        self, normalize: str, opd: Any, parameters: Mapping[str, Any], only_last: bool
    ) -> list[poppy.Wavefront]:
        """Fields as `poppy.Wavefront`, one per plane, weighted and summed as poppy does.

        The field of an image plane is the field behind the mask on the sampled part of the image.
        `normalize` must be "first". With `only_last`, there is the field on the detector alone.
        """
        if normalize.lower() != "first":
            raise IncompatibleSetupError(
                f"normalize={normalize!r}: intermediate wavefronts come with 'first' only"
            )
        summed: list[poppy.Wavefront] = []
        tensor, values = self.opd(opd), self.values(parameters)
        for wavelength, weight in zip(
            self.bandpass.wavelengths, self.bandpass.weights, strict=True
        ):
            for k, wave in enumerate(_wavefronts(self, tensor, values, wavelength, only_last)):
                wave.wavefront = wave.wavefront * weight
                if k == len(summed):
                    summed.append(wave)
                elif summed[k].shape == wave.shape:
                    summed[k].wavefront = summed[k].wavefront + wave.wavefront
                # Otherwise an image plane, sampled in proportion to the wavelength, has another
                # number of samples; the field at the first wavelength is kept.
        return summed

    def display(self, **keywords: Any) -> None:
        """Draw all planes as poppy does, with the keywords of `display` of its optics."""
        self.recipe[self._source].display(**keywords)


def from_poppy(
    osys: poppy.OpticalSystem,
    wavelength: Any = 1e-6 * u.m,
    weights: Sequence[float] | None = None,
    *,
    propagation: str | Mapping[str, str] = "auto",
    occulter_sampling: float | None = None,
    npix: int | None = None,
    fov_pixels: int | tuple[int, int] | None = None,
    dtype: torch.dtype = torch.float64,
    device: str | torch.device = "cpu",
) -> PoppySystem:
    """Make a differentiable system of a poppy `OpticalSystem`.

    ``model()`` is the image of ``osys.calc_psf``, binned to detector pixels. ``model(opd)`` has
    another OPD of the first plane, in the frame of that plane, than ``model.entrance.opd``. Source
    offsets of `osys` are kept; `star_offset` is added.

    The result can be passed to `refine` and `detect` like any other system.

    Parameters
    ----------
    osys : poppy.OpticalSystem
        Fraunhofer system of pupil, image and detector planes. The conversion does not change the
        system, and later changes of the system do not affect the model.
    wavelength : Quantity, float (m) or sequence of them
        Wavelengths at which the optics are evaluated.
    weights : sequence of float, optional
        One per wavelength; default equal.
    propagation : "auto", "compact", "fft", or mapping of plane name to one of these
        Propagation through image planes. "compact" evaluates a mask only where light is blocked,
        which must be a bounded part of the image; "fft" uses FFTs padded as in poppy. "auto" is
        "compact" where possible; ``model.propagation`` records the choice.
    occulter_sampling : float, optional
        Samples per lambda/D in image planes. With the default, ``osys.oversample``, the model and
        poppy agree to rounding with either propagation. FFTs are padded by the next whole number.
    npix : int, optional
        Samples across the pupil, a divisor of the number in poppy, which is the default: sampled
        planes are averaged over blocks.
    fov_pixels : int or (ny, nx), optional
        Detector pixels; default as in the system's detector.
    dtype : torch.dtype
        torch.float64 or torch.float32.
    device : str or torch.device

    Returns
    -------
    PoppySystem

    Raises
    ------
    IncompatibleSetupError
        For a plane that is not supported, or a setting that does not fit.

    Examples
    --------
    >>> import poppy
    >>> import pyklip_diffrender as dr
    >>> osys = poppy.OpticalSystem("coronagraph", npix=64, oversample=2)
    >>> _ = osys.add_pupil(poppy.CircularAperture(radius=1.2))
    >>> _ = osys.add_image(poppy.CircularOcculter(radius=0.25, name="spot"))
    >>> _ = osys.add_pupil(poppy.CircularAperture(radius=1.0))
    >>> detector = osys.add_detector(pixelscale=0.05, fov_pixels=24, oversample=1)
    >>> model = dr.from_poppy(osys, wavelength=1.6e-6)
    >>> model.propagation
    {'spot': 'compact'}
    """
    recipe = {k: v for k, v in locals().items() if k != "osys"}
    check_supported(osys)
    return _from_private(osys=copy.deepcopy(osys), **recipe)


def _from_private(**recipe: Any) -> PoppySystem:
    """A system as by `from_poppy`, from an `osys` that is not shared with the caller."""
    return PoppySystem(Conversion(recipe["osys"], recipe), recipe, _from_private)


def opd_to_poppy(opd: Any, osys: poppy.OpticalSystem) -> poppy.OpticalSystem:
    """Copy a poppy system and replace the OPD of its first plane.

    Parameters
    ----------
    opd : Tensor, Quantity or array, (n, n)
        OPD in m, in the frame of the first plane; for example a refined wavefront. The map is
        resampled to the pixels of that plane.
    osys : poppy.OpticalSystem
        Not changed.

    Raises
    ------
    ShapeError
        If the map is not square.
    """
    changed = copy.deepcopy(osys)
    first = changed.planes[0]
    wave = changed.input_wavefront(1e-6 * u.m)
    replacement = poppy.ArrayOpticalElement(
        name=first.name,
        transmission=np.array(np.broadcast_to(first.get_transmission(wave), wave.shape)),
        opd=resample(to_metres(opd, "opd"), wave.shape[0]),
        pixelscale=wave.pixelscale,
        planetype=PlaneType.pupil,
    )
    replacement.pupil_diam = wave.diam
    changed.planes[0] = replacement
    return changed


def check_supported(osys: Any) -> None:
    """Raise `IncompatibleSetupError` for a poppy system that cannot be converted."""
    if isinstance(osys, poppy.FresnelOpticalSystem):
        raise IncompatibleSetupError(
            f"{osys.name}: Fresnel propagation is not supported. Supported are Fraunhofer "
            f"systems (poppy.OpticalSystem) of {_SUPPORTED}"
        )
    if not isinstance(osys, poppy.OpticalSystem):
        raise IncompatibleSetupError(
            f"from_poppy: got a {type(osys).__name__}, expected a poppy.OpticalSystem. For an "
            "Instrument, pass what its get_optical_system() returns, or use from_webbpsf"
        )
    if type(osys).propagate is not poppy.OpticalSystem.propagate:
        raise IncompatibleSetupError(
            f"{osys.name}: a {type(osys).__name__} does not propagate, or sample image planes, as "
            "a poppy.OpticalSystem does; convert the poppy.OpticalSystem from which it was made"
        )
    planes = list(osys.planes)
    if not planes or planes[0].planetype != PlaneType.pupil:
        raise IncompatibleSetupError(
            f"{osys.name}: the first plane must be a pupil, got "
            f"{planes[0] if planes else 'no planes'}. Supported are {_SUPPORTED}"
        )
    if not isinstance(planes[-1], poppy.Detector):
        raise IncompatibleSetupError(
            f"{osys.name}: the last plane must be a Detector, got {planes[-1]}. Add one with "
            "add_detector(pixelscale=, fov_pixels=)"
        )
    known = (PlaneType.pupil, PlaneType.image, PlaneType.rotation, PlaneType.inversion)
    previous = planes[0]
    for plane in planes[:-1]:
        if isinstance(plane, Subapertures) or plane.planetype not in known:
            raise IncompatibleSetupError(
                f"plane {plane.name!r} ({type(plane).__name__}, {plane.planetype}) is not "
                f"supported. Supported are {_SUPPORTED}"
            )
        if getattr(plane, "propagation_hint", None) == "MFT":
            raise IncompatibleSetupError(
                f"plane {plane.name!r} asks for a matrix transform on samples of its own "
                "(propagation_hint 'MFT'), which is not supported; remove the hint"
            )
        turning = plane.planetype in (PlaneType.rotation, PlaneType.inversion)
        if turning and previous.planetype == PlaneType.image:
            raise IncompatibleSetupError(
                f"plane {plane.name!r} turns the field in the image plane {previous.name!r}, "
                "where poppy moves the field by one sample as well. Put the turn in front of that "
                "plane, or behind the next pupil"
            )
        previous = plane
    if previous.planetype == PlaneType.image:
        raise IncompatibleSetupError(
            f"plane {previous.name!r}: between an image plane and the detector there must be a "
            "pupil plane, as in poppy. Add one, such as poppy.ScalarTransmission()"
        )
