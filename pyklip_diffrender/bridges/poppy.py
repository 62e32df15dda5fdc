"""`from_poppy`: a differentiable system from a user's poppy `OpticalSystem`, and the way back."""

from __future__ import annotations

import copy
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any

import numpy as np
import poppy
import torch
from astropy import units as u
from astropy.io import fits
from numpy.typing import NDArray
from poppy.poppy_core import PlaneType
from poppy.sub_sampled_optics import Subapertures
from torch import Tensor

from pyklip_diffrender.arrays import Gain, OffsetDetector, OrientedPupil, PupilOptic
from pyklip_diffrender.bridges.sampling import (
    COMPACT_OPTICS,
    ImageSamples,
    MaskStack,
    complement_box,
    pupil_phasor,
)
from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.masks import BoxPart, FourierMask, MaskPart, SampledOcculter, SeparablePart
from pyklip_diffrender.optics import OpticalSystem
from pyklip_diffrender.orientation import Orientation
from pyklip_diffrender.planes import Plane
from pyklip_diffrender.psf_file import poppy_psf
from pyklip_diffrender.rotation import FreeRotation
from pyklip_diffrender.spectrum import Bandpass
from pyklip_diffrender.units import ARCSEC, native_float64, to_metres

__all__ = ["PoppySystem", "from_poppy", "opd_to_poppy"]

Array = NDArray[Any]

_SUPPORTED = (
    "pupil and image planes of any optic that gives a transmission and an OPD, coordinate "
    "inversions and rotations in pupils, and a Detector at the end"
)


_POPPY_OPTIONS = ("display_intermediates", "progressbar")


class PoppySystem(OpticalSystem):
    """What `from_poppy` makes: an `OpticalSystem` that keeps poppy's names and interface.

    Attributes
    ----------
    propagation : dict of str to str
        For every image plane, "compact" or "fft".
    frames : list of Orientation
        For every plane of poppy's, from its frame to the frame of this system's pupils.
    """

    propagation: dict[str, str]
    frames: list[Orientation]

    def plane(self, name: str) -> Any:
        """The plane of this name."""
        for plane in (self.entrance, *self.planes, self.detector):
            if plane.name == name:
                return plane
        names = [p.name for p in (self.entrance, *self.planes, self.detector)]
        raise KeyError(f"{name!r} is not a plane of this system; those are {names}")

    @property
    def trainable(self) -> dict[str, tuple[Tensor, Tensor]]:
        """The leaf tensors (OPD change in m, transmission factor) of every trainable plane."""
        return {
            plane.name: (plane.opd, plane.transmission)
            for plane in self.planes
            if isinstance(plane, PupilOptic)
            and plane.opd is not None
            and plane.transmission is not None
        }

    def calc_psf(  # type: ignore[override]  # As an OpticalSystem of poppy, not an Instrument.
        self,
        wavelength: Any = None,
        weight: Any = None,
        save_intermediates: bool = False,
        save_intermediates_what: str = "all",
        display: bool = False,
        return_intermediates: bool = False,
        return_final: bool = False,
        source: dict[str, Any] | None = None,
        normalize: str = "first",
        opd: Any = None,
        **options: Any,
    ) -> Any:
        """PSF as an HDUList, with the arguments and the keywords of poppy's `calc_psf`.

        Parameters
        ----------
        wavelength : Quantity, float (m) or sequence of them, optional
            Default: the wavelengths that the system was made for.
        weight : sequence of float, optional
            One per wavelength.
        source : dict, optional
            With "wavelengths" and "weights", in place of the two above.
        normalize : str
            "first", "last", "exit_pupil" or "none", as in poppy.
        return_intermediates, return_final : bool
            Also return a list of `poppy.Wavefront`: of every pupil plane and the detector, or of
            the detector. Summed over wavelengths as poppy does.
        opd, **options
            As in a call of the system; options of poppy's without a meaning here are dropped.
        save_intermediates, save_intermediates_what, display
            Taken for poppy's sake. Nothing is drawn; saving asks for `return_intermediates`.

        Returns
        -------
        HDUList, or (HDUList, list of Wavefront)
        """
        if save_intermediates:
            raise IncompatibleSetupError(
                "save_intermediates: this system writes no files on its own; take "
                "return_intermediates=True and call .writeto() on the wavefronts"
            )
        if source is not None:
            wavelength, weight = source["wavelengths"], source["weights"]
        system: Any = self
        if wavelength is not None:
            system = self.with_fidelity(wavelength=wavelength, weights=weight)
        parameters = {k: v for k, v in options.items() if k not in _POPPY_OPTIONS}
        hdus = poppy_psf(system, normalize, opd, **parameters)
        if not (return_intermediates or return_final):
            return hdus
        return hdus, intermediate_wavefronts(system, normalize, only_last=not return_intermediates)


def from_poppy(
    osys: poppy.OpticalSystem,
    wavelength: Any = 1e-6 * u.m,
    weights: Sequence[float] | None = None,
    *,
    propagation: str | Mapping[str, str] = "auto",
    occulter_sampling: float | None = None,
    trainable: Collection[str] = (),
    dtype: torch.dtype = torch.float64,
    device: str | torch.device = "cpu",
) -> PoppySystem:
    """Make a differentiable system of a poppy `OpticalSystem`.

    ``model()`` is the image that ``osys.calc_psf`` gives, binned to detector pixels; ``model(opd)``
    replaces the OPD of the first plane, in that plane's own frame; ``model.entrance.opd`` is the
    one it has. Source offsets of `osys` are kept, and `star_offset` adds to them.

    Parameters
    ----------
    osys : poppy.OpticalSystem
        Fraunhofer system of pupil, image and detector planes. It is not changed, and later
        changes to it do not reach the model.
    wavelength : Quantity, float (m) or sequence of them
        Where the optics are sampled.
    weights : sequence of float, optional
        One per wavelength; default equal.
    propagation : "auto", "compact", "fft", or mapping of plane name to one of these
        How to pass image planes: on the part of the image that the mask blocks, if that is
        bounded, or by FFTs padded as poppy's. "auto" takes the first where it can; what was taken
        is in ``model.propagation``.
    occulter_sampling : float, optional
        Lattice points per lambda/D in image planes; default ``osys.oversample``, with which the
        model and poppy agree to rounding either way.
    trainable : collection of str
        Names of pupil planes that get leaf tensors to train, see ``model.trainable``.
    dtype, device
        Of the computation.

    Raises
    ------
    IncompatibleSetupError
        For a plane that is not supported, by name, saying what is.
    """
    recipe = {k: v for k, v in locals().items() if k != "recipe"}
    recipe["osys"] = osys = copy.deepcopy(osys)
    return Converter(osys, recipe).system()


class Converter:
    """One pass over the planes of a poppy system.

    Parameters
    ----------
    osys : poppy.OpticalSystem
    recipe : dict
        Arguments of `from_poppy`.
    kinds : mapping of str to type, optional
        Names of pupil planes that are to be of a special kind of `PupilOptic`.
    """

    def __init__(
        self,
        osys: poppy.OpticalSystem,
        recipe: dict[str, Any],
        kinds: Mapping[str, type[PupilOptic]] | None = None,
    ) -> None:
        self.osys, self.recipe = osys, recipe
        self.kinds = kinds or {}
        self.dtype: torch.dtype = recipe["dtype"]
        self.device = torch.device(recipe["device"])
        wavelengths = np.atleast_1d(to_metres(recipe["wavelength"], "wavelength"))
        weights = recipe["weights"]
        given = np.ones(len(wavelengths)) if weights is None else native_float64(weights)
        self.bandpass = Bandpass(tuple(wavelengths.tolist()), tuple(np.atleast_1d(given).tolist()))
        self._check()
        first = osys.input_wavefront(wavelengths[0] * u.m)
        self.npix = int(first.wavefront.shape[0])
        self.diameter = float(first.diam.to_value(u.m))
        sampling = recipe["occulter_sampling"]
        self.sampling = float(osys.oversample if sampling is None else sampling)
        self.used: dict[str, str] = {}

    def _check(self) -> None:
        osys = self.osys
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
        if isinstance(osys, poppy.MatrixFTCoronagraph):
            raise IncompatibleSetupError(
                f"{osys.name}: poppy.MatrixFTCoronagraph samples its image planes in a way of its "
                "own; convert the OpticalSystem that it was made from"
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
            turning = plane.planetype in (PlaneType.rotation, PlaneType.inversion)
            if turning and previous.planetype == PlaneType.image:
                raise IncompatibleSetupError(
                    f"plane {plane.name!r} turns the field in the image plane {previous.name!r}, "
                    "where poppy moves it by one sample as well. Put it in front of that plane, "
                    "or behind the next pupil"
                )
            previous = plane

    def system(self) -> PoppySystem:
        """The converted system."""
        planes: list[Plane] = []
        after = self._turns_behind()
        centred = "array_center"
        stack: list[Any] = []
        for k, (optic, turn) in enumerate(zip(self.osys.planes, after, strict=True)):
            if k == 0 or optic is self.osys.planes[-1]:
                continue
            if optic.planetype == PlaneType.inversion:
                planes.append(Gain(optic.name))
            elif optic.planetype == PlaneType.rotation:
                whole = round(optic.angle / 90) * 90 == optic.angle
                angle = optic.angle * turn.sense * -1  # The system's frame is a mirror of poppy's.
                planes.append(
                    Gain(optic.name)
                    if whole
                    else FreeRotation(angle, self.npix, self.diameter, optic.name)
                )
            elif optic.planetype == PlaneType.pupil:
                plane, centred = self._pupil(optic, turn, centred, self._between_masks(k))
                planes.append(plane)
            elif self.osys.planes[k + 1].planetype == PlaneType.image:
                # Masks one behind the other in one image act as one.
                stack.append(optic)
                planes.append(Gain(optic.name))
            else:
                planes.append(self._image(MaskStack.of([*stack, optic]), turn, centred))
                stack = []
        system = PoppySystem(
            self._entrance(after[0]),
            planes,
            self._detector(),
            self.bandpass,
            recipe=self.recipe,
            remake=from_poppy,
        )
        system.propagation = self.used
        system.frames = [self._to_system(turn) for turn in after]
        return system

    def _turns_behind(self) -> list[Orientation]:
        """For every plane, all quarter turns and inversions that come after it."""
        turns, turn = [], Orientation()
        for optic in reversed(self.osys.planes):
            turns.append(turn)
            if optic.planetype == PlaneType.inversion:
                turn = Orientation.inversion(optic.axis).then(turn)
            elif optic.planetype == PlaneType.rotation and round(optic.angle / 90) * 90 == (
                optic.angle
            ):
                turn = Orientation.quarter_turns(round(optic.angle / 90)).then(turn)
        return turns[::-1]

    def _to_system(self, turn: Orientation) -> Orientation:
        """From the frame of a pupil plane to the system's, see `propagation`: y is inverted."""
        return turn.then(Orientation.inversion("y"))

    def _between_masks(self, index: int) -> bool:
        """Whether light beside the pupil, as a mask scatters it there, may reach another mask."""
        kinds = [plane.planetype for plane in self.osys.planes]
        return PlaneType.image in kinds[:index] and PlaneType.image in kinds[index:]

    def _wave(self, wavelength: float, padded: bool = False) -> poppy.Wavefront:
        wave = poppy.Wavefront(
            wavelength=wavelength * u.m,
            npix=self.npix,
            diam=self.diameter * u.m,
            oversample=self.osys.oversample,
        )
        if padded:
            wave.wavefront = np.ones((self.npix * self.osys.oversample,) * 2, dtype=complex)
            wave.ispadded = True
        return wave

    def _entrance(self, turn: Orientation) -> OrientedPupil:
        optic = self.osys.planes[0]
        shape = (self.npix, self.npix)
        amplitude, opds = None, {}
        for wavelength in self.bandpass.wavelengths:
            wave = self._wave(wavelength)
            phasor, opd = pupil_phasor(optic, wave)
            if amplitude is None:
                amplitude = np.broadcast_to(np.abs(phasor), shape)
            opds[wavelength] = np.broadcast_to(opd, shape)
        base = opds[self.bandpass.wavelengths[0]]
        chromatic = {
            w: torch.from_numpy(opd - base) for w, opd in opds.items() if (opd != base).any()
        }
        assert amplitude is not None
        r, theta = float(self.osys.source_offset_r), np.deg2rad(self.osys.source_offset_theta)
        pointing = complex(-r * np.sin(theta), r * np.cos(theta))
        return OrientedPupil(
            torch.from_numpy(native_float64(amplitude)),
            torch.from_numpy(native_float64(base)),
            self.diameter,
            self.dtype,
            self.device,
            optic.name,
            self._to_system(turn),
            (pointing.real, pointing.imag),
            chromatic,
            turned=self._free_turn(),
        )

    def _free_turn(self) -> float:
        """Rotation of the image by planes that turn by other than right angles, degrees."""
        total = 0.0
        sense = 1
        for optic in reversed(self.osys.planes):
            if optic.planetype == PlaneType.inversion and optic.axis != "both":
                sense = -sense
            elif optic.planetype == PlaneType.rotation and round(optic.angle / 90) * 90 != (
                optic.angle
            ):
                total += optic.angle * sense
        return total

    def _pupil(
        self, optic: Any, turn: Orientation, centred: str, padded: bool
    ) -> tuple[Plane, str]:
        phasors: dict[float, Tensor] = {}
        latest: Array | None = None
        for wavelength in self.bandpass.wavelengths:
            wave = self._wave(wavelength, padded)
            wave._image_centered = centred
            phasor, _ = pupil_phasor(optic, wave)
            if latest is not None and np.array_equal(phasor, latest):
                phasors[wavelength] = phasors[self.bandpass.wavelengths[len(phasors) - 1]]
            else:
                phasors[wavelength] = torch.from_numpy(
                    np.array(np.broadcast_to(phasor, wave.shape), dtype=np.complex128)
                )
            latest = phasor
        assert latest is not None
        trainable = optic.name in self.recipe["trainable"]
        # The last loop's wave says where the next image plane has its middle.
        if (
            not trainable
            and (latest.size == 1 or np.ptp(latest) == 0)
            and len({id(p) for p in phasors.values()}) == 1
        ):
            return Gain(optic.name, complex(latest.flat[0])), wave._image_centered
        plane = self.kinds.get(optic.name, PupilOptic)(
            phasors,
            self.npix,
            self.diameter,
            self.dtype,
            self.device,
            optic.name,
            self._to_system(turn),
            trainable,
        )
        return plane, wave._image_centered

    def _image(self, optic: Any, turn: Orientation, centred: str) -> Plane:
        if isinstance(optic, poppy.ScalarTransmission):
            return Gain(optic.name, complex(optic.transmission))
        wanted = self.recipe["propagation"]
        if not isinstance(wanted, str):
            wanted = wanted.get(optic.name, "auto")
        if wanted not in ("auto", "compact", "fft"):
            raise IncompatibleSetupError(
                f"propagation: got {wanted!r} for {optic.name!r}, expected 'auto', 'compact' or "
                "'fft'"
            )
        parts = None
        if wanted != "fft" and centred != "corner":
            parts = self._parts(optic, turn)
        if parts is None:
            if wanted == "compact":
                raise IncompatibleSetupError(
                    f"plane {optic.name!r} ({type(optic).__name__}) is not known to block a "
                    f"bounded part of the image only; those known are {COMPACT_OPTICS}. Use "
                    "propagation='fft'"
                )
            self.used[optic.name] = "fft"
            return self._fourier(optic, turn, centred)
        self.used[optic.name] = "compact"
        return SampledOcculter(parts, self.sampling, self.diameter, optic.name)

    def _parts(self, optic: Any, turn: Orientation) -> list[MaskPart] | None:
        spacing = max(self.bandpass.wavelengths) / self.diameter / self.sampling / ARCSEC
        found = complement_box(optic, margin=2 * spacing)
        if found is None:
            return None
        back = turn.inverse
        parts: list[MaskPart] = []
        for part in found:
            if part.box is None:
                along_x = _turned_factor(part.along_x, part.along_y, back, 0)
                along_y = _turned_factor(part.along_x, part.along_y, back, 1)
                parts.append(SeparablePart(along_x, along_y, self.sampling))
                continue
            left, right, bottom, top = part.box
            corners = turn.positions(torch.tensor([left, right]), torch.tensor([bottom, top]))
            box = (
                float(corners[0].min()),
                float(corners[0].max()),
                float(corners[1].min()),
                float(corners[1].max()),
            )
            parts.append(BoxPart(self._complement(part.optic, back), box))
        return parts

    def _complement(
        self, optic: Any, back: Orientation
    ) -> Callable[[Tensor, Tensor, float], Tensor]:
        diameter, oversample = self.diameter, self.osys.oversample

        def complement(x: Tensor, y: Tensor, wavelength: float) -> Tensor:
            local_x, local_y = back.positions(*torch.broadcast_tensors(x, y))
            crossed = back.matrix[0][0] == 0
            if crossed:  # Optics expect x to grow along the second axis of the array.
                local_x, local_y = local_x.T, local_y.T
            wave = ImageSamples(wavelength, diameter, oversample, local_x, local_y)
            blocked = torch.from_numpy(1 - np.asarray(optic.get_phasor(wave), dtype=complex))
            return blocked.T if crossed else blocked

        return complement

    def _fourier(self, optic: Any, turn: Orientation, centred: str) -> FourierMask:
        padding = self.sampling
        if padding != int(padding):
            raise IncompatibleSetupError(
                f"occulter_sampling: the FFT for {optic.name!r} takes a whole number, got {padding}"
            )
        count = self.npix * int(padding)
        diameter, oversample = self.diameter, self.osys.oversample
        to_system = self._to_system(turn)

        def transmission(wavelength: float) -> Tensor:
            middle = (count - 1) / 2 if centred == "corner" else count / 2
            axis = (torch.arange(count, dtype=torch.float64) - middle) * (
                wavelength / diameter / padding / ARCSEC
            )
            wave = ImageSamples(
                wavelength,
                diameter,
                oversample,
                axis[None, :].expand(count, count),
                axis[:, None].expand(count, count),
            )
            phasor = np.broadcast_to(np.asarray(optic.get_phasor(wave)), (count, count))
            return to_system.apply_to_lattice(torch.from_numpy(np.array(phasor, dtype=complex)))

        return FourierMask(transmission, int(padding), self.npix, diameter, optic.name)

    def _detector(self) -> OffsetDetector:
        detector = self.osys.planes[-1]
        scale = detector.pixelscale
        if not scale.unit.is_equivalent(u.arcsec / u.pix):
            raise IncompatibleSetupError(
                f"detector {detector.name!r}: got a pixel scale in '{scale.unit}', expected one "
                "that converts to 'arcsec / pix'"
            )
        arcsec = float(np.atleast_1d(scale.to_value(u.arcsec / u.pix))[0])
        shape = tuple(int(n) for n in detector.shape)
        samples = arcsec / detector.oversample
        offset = (0.0, 0.0) if detector.offset is None else tuple(detector.offset)
        return OffsetDetector(
            shape=(shape[0], shape[1]),
            pixelscale=(arcsec, arcsec),
            oversample=int(detector.oversample),
            dtype=self.dtype,
            device=self.device,
            name=detector.name,
            # poppy counts in its own samples, y first.
            centre=(float(offset[1]) * samples, float(offset[0]) * samples),
        )


def _turned_factor(
    along_x: Callable[[Tensor], Tensor] | None,
    along_y: Callable[[Tensor], Tensor] | None,
    back: Orientation,
    axis: int,
) -> Callable[[Tensor], Tensor] | None:
    """The factor of a separable part along one axis of the final image."""
    column = (back.matrix[0][axis], back.matrix[1][axis])
    factor, sign = (along_x, column[0]) if column[0] else (along_y, column[1])
    if factor is None:
        return None
    chosen = factor
    return lambda positions: chosen(sign * positions)


def intermediate_wavefronts(
    system: PoppySystem, normalize: str, only_last: bool
) -> list[poppy.Wavefront]:
    """Fields as poppy's own objects, one per plane, weighted and summed as poppy does.

    Image planes: the field behind the mask, on that part of the image where it was sampled.
    """
    if normalize.lower() != "first":
        raise IncompatibleSetupError(
            f"normalize={normalize!r}: intermediate wavefronts come with 'first' only"
        )
    summed: list[poppy.Wavefront] = []
    for wavelength, weight in zip(
        system.bandpass.wavelengths, system.bandpass.weights, strict=True
    ):
        for k, wave in enumerate(_wavefronts(system, wavelength, only_last)):
            wave.wavefront = wave.wavefront * weight
            if k == len(summed):
                summed.append(wave)
            elif summed[k].shape == wave.shape:
                summed[k].wavefront = summed[k].wavefront + wave.wavefront
            # Otherwise the samples of an image plane, which scale with the wavelength, differ
            # in number; those of the first wavelength are kept.
    return summed


def _wavefronts(system: PoppySystem, wavelength: float, only_last: bool) -> list[poppy.Wavefront]:
    values = system.values({})
    full = system.entrance.full
    found = []
    with torch.no_grad():
        wavefront = system.pupil_field(system.opd(None), wavelength, values)
        onto = system.windows(values)
        for k, plane in enumerate((system.entrance, *system.planes)):
            back = system.frames[k].inverse
            if isinstance(plane, SampledOcculter | FourierMask):
                field, spacing = plane.focal_sample(wavefront)
                wave = _wave_of(field, wavelength, full.diameter, spacing / ARCSEC)
                if isinstance(plane, FourierMask):
                    field = back.apply_to_lattice(field)
                else:
                    # On the image the inversion of y is undone, see `propagation`.
                    field = Orientation.inversion("y").then(back).apply(field)
                wave.wavefront = _numpy(field)
            if k > 0:
                wavefront = system.planes[k - 1].apply(wavefront, values, onto[k - 1])
            if not isinstance(plane, SampledOcculter | FourierMask):
                whole = back.apply(wavefront.grid.crop(wavefront.field, full)) * full.spacing
                wave = _wave_of(whole, wavelength, full.diameter, None)
            wave.location = f"after {plane.name}"
            found.append(wave)
        detector = system.detector
        final = detector.field(wavefront, values)
    scale = detector.pixelscale[0] / detector.oversample
    last = _wave_of(final, wavelength, full.diameter, scale)
    last.oversample = detector.oversample
    last.location = f"at {detector.name}"
    return [last] if only_last else [*found, last]


def _numpy(field: Tensor) -> Array:
    return np.asarray(field.cpu().numpy(), dtype=np.complex128)


def _wave_of(
    field: Tensor, wavelength: float, diameter: float, arcsec: float | None
) -> poppy.Wavefront:
    """A field in a pupil, or on an image with samples of a given size."""
    where = {} if arcsec is None else {"pixelscale": arcsec * u.arcsec / u.pix}
    wave = poppy.Wavefront(wavelength=wavelength * u.m, npix=1, diam=diameter * u.m, **where)
    wave.wavefront = _numpy(field)
    if arcsec is None:
        wave.pixelscale = diameter / len(field) * u.m / u.pix
    else:
        wave.fov = len(field) * arcsec * u.arcsec
    return wave


def opd_to_poppy(opd: Any, osys: poppy.OpticalSystem) -> poppy.OpticalSystem:
    """A copy of a poppy system whose first plane has another OPD.

    Parameters
    ----------
    opd : Tensor, Quantity or array, (npix, npix)
        m, frame of the first plane: for instance ``fit.opd``.
    osys : poppy.OpticalSystem
        Not changed.
    """
    changed = copy.deepcopy(osys)
    first = changed.planes[0]
    wave = changed.input_wavefront(1e-6 * u.m)
    transmission = np.array(np.broadcast_to(first.get_transmission(wave), wave.shape))
    values = to_metres(opd, "opd")
    if values.shape != transmission.shape:
        raise IncompatibleSetupError(
            f"opd: got shape {values.shape}, the first plane of {osys.name} has "
            f"{transmission.shape}"
        )
    replacement = poppy.ArrayOpticalElement(
        name=first.name,
        transmission=transmission,
        opd=values,
        pixelscale=wave.pixelscale,
        planetype=PlaneType.pupil,
    )
    replacement.pupil_diam = wave.diam
    changed.planes[0] = replacement
    return changed


def opd_to_hdus(opd: Any, diameter: float) -> fits.HDUList:
    """An OPD as poppy's and stpsf's readers take it: metres, with BUNIT and PUPLSCAL."""
    values = to_metres(opd, "opd")
    header = fits.Header()
    header["BUNIT"] = "m"
    header["PUPLDIAM"] = (diameter, "[m] side of the array")
    header["PUPLSCAL"] = (diameter / values.shape[-1], "[m / pixel]")
    header["CONTENTS"] = "OTE OPD, entrance pupil orientation"
    return fits.HDUList([fits.PrimaryHDU(values, header)])
