"""The planes of a poppy `OpticalSystem`, one by one, as planes of ours."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import poppy
import torch
from astropy import units as u
from numpy.typing import NDArray
from poppy.poppy_core import PlaneType
from torch import Tensor

from pyklip_diffrender.bridges.sampling import (
    COMPACT_OPTICS,
    ImageSamples,
    MaskStack,
    complement_box,
    pupil_phasor,
)
from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.io.units import ARCSEC, native_float64, to_metres
from pyklip_diffrender.optics.bandpass import Bandpass
from pyklip_diffrender.optics.masks import (
    BoxPart,
    FourierMask,
    MaskPart,
    SampledOcculter,
    SeparablePart,
)
from pyklip_diffrender.optics.orientation import Orientation
from pyklip_diffrender.optics.planes import Plane
from pyklip_diffrender.optics.rotation import FreeRotation
from pyklip_diffrender.optics.sampled_planes import (
    Gain,
    MovableStop,
    OffsetDetector,
    OrientedPupil,
    PupilOptic,
)

__all__ = ["Converted", "Converter"]

Array = NDArray[Any]


@dataclass(frozen=True)
class Converted:
    """A poppy system as planes of ours.

    Attributes
    ----------
    entrance, planes, detector, bandpass
        The arguments of an `OpticalSystem`.
    propagation : dict of str to str
        For every image plane, "compact" or "fft".
    frames : list of Orientation
        For every plane of poppy's, from its frame to the frame of the system's pupils.
    sampling : float
        Samples per lambda/D in image planes.
    fixed : frozenset of str
        Settings that cannot be changed without making it another system.
    """

    entrance: OrientedPupil
    planes: list[Plane]
    detector: OffsetDetector
    bandpass: Bandpass
    propagation: dict[str, str]
    frames: list[Orientation]
    sampling: float
    fixed: frozenset[str]


class Converter:
    """One pass over the planes of a poppy system.

    Parameters
    ----------
    osys : poppy.OpticalSystem
        One that `poppy.check_supported` lets pass.
    recipe : dict
        Arguments of `from_poppy`.
    kinds : mapping of str to type, optional
        Names of pupil planes that become a special kind of `PupilOptic`. The first stop behind a
        mask always becomes a `MovableStop`, unless it is trainable.

    Raises
    ------
    IncompatibleSetupError
        For settings that do not fit the system.
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
        first = osys.input_wavefront(wavelengths[0] * u.m)
        self.sampled = int(first.wavefront.shape[0])
        """Samples across the pupil where poppy's optics are evaluated."""
        self.npix = int(recipe["npix"] or self.sampled)
        if self.npix < 1 or self.sampled % self.npix:
            raise IncompatibleSetupError(
                f"npix: got {self.npix}, expected a divisor of the {self.sampled} samples that "
                "poppy has across the pupil, because planes are averaged over whole blocks"
            )
        self.block = self.sampled // self.npix
        self.diameter = float(first.diam.to_value(u.m))
        sampling = float(recipe["occulter_sampling"] or osys.oversample)
        # A whole number of samples across the image of the pupil array, rounding aside.
        self.sampling = math.ceil(self.npix * sampling - 1e-9) / self.npix
        self.used: dict[str, str] = {}
        self.has_stop = False
        self.fixed: set[str] = {"npix", "device"} if recipe["trainable"] else set()

    def convert(self) -> Converted:
        """Go through the planes in order."""
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
                plane, centred = self._pupil(k, turn, centred)
                planes.append(plane)
            elif self.osys.planes[k + 1].planetype == PlaneType.image:
                # Masks one behind the other in one image act as one.
                stack.append(optic)
                planes.append(Gain(optic.name))
            else:
                planes.append(self._image(MaskStack.of([*stack, optic]), turn, centred))
                stack = []
        return Converted(
            self._entrance(after[0]),
            planes,
            self._detector(),
            self.bandpass,
            self.used,
            [self._to_system(turn) for turn in after],
            self.sampling,
            frozenset(self.fixed),
        )

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
            npix=self.sampled,
            diam=self.diameter * u.m,
            oversample=self.osys.oversample,
        )
        if padded:
            wave.wavefront = np.ones((self.sampled * self.osys.oversample,) * 2, dtype=complex)
            wave.ispadded = True
        return wave

    def _entrance(self, turn: Orientation) -> OrientedPupil:
        optic = self.osys.planes[0]
        shape = (self.sampled, self.sampled)
        amplitude, opds = None, {}
        for wavelength in self.bandpass.wavelengths:
            wave = self._wave(wavelength)
            phasor, opd = pupil_phasor(optic, wave)
            if amplitude is None:
                amplitude = np.broadcast_to(np.abs(phasor), shape)
            opds[wavelength] = self._averaged(np.broadcast_to(opd, shape))
        base = opds[self.bandpass.wavelengths[0]]
        chromatic = {
            w: torch.from_numpy(opd - base) for w, opd in opds.items() if (opd != base).any()
        }
        assert amplitude is not None
        r, theta = float(self.osys.source_offset_r), np.deg2rad(self.osys.source_offset_theta)
        pointing = complex(-r * np.sin(theta), r * np.cos(theta))
        return OrientedPupil(
            torch.from_numpy(native_float64(self._averaged(amplitude))),
            torch.from_numpy(native_float64(base)),
            self.diameter,
            self.dtype,
            self.device,
            optic.name,
            self._to_system(turn),
            (pointing.real, pointing.imag),
            chromatic,
            turned=self._free_turn(),
            collected=float((amplitude**2).sum()) / self.block**2,
        )

    def _averaged(self, array: Array) -> Array:
        """Mean over the blocks of an array that reaches equally far on all sides of the pupil."""
        if self.block == 1:
            return array
        beside = (len(array) - self.sampled) // 2
        dropped = beside % self.block
        count = self.npix + 2 * (beside // self.block)
        kept = slice(dropped, dropped + count * self.block)
        blocks = array[kept, kept].reshape(count, self.block, count, self.block)
        return np.asarray(blocks.mean(axis=(1, 3)))

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

    def _pupil(self, index: int, turn: Orientation, centred: str) -> tuple[Plane, str]:
        optic, padded = self.osys.planes[index], self._between_masks(index)
        phasors: dict[float, Tensor] = {}
        latest: Array | None = None
        for wavelength in self.bandpass.wavelengths:
            wave = self._wave(wavelength, padded)
            wave._image_centered = centred
            phasor, _ = pupil_phasor(optic, wave)
            if latest is not None and np.array_equal(phasor, latest):
                phasors[wavelength] = phasors[self.bandpass.wavelengths[len(phasors) - 1]]
            else:
                whole = np.broadcast_to(phasor, wave.shape)
                phasors[wavelength] = torch.from_numpy(
                    np.array(self._averaged(whole), dtype=np.complex128)
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
        kind = self.kinds.get(optic.name, PupilOptic)
        behind_mask = any(p.planetype == PlaneType.image for p in self.osys.planes[:index])
        if kind is PupilOptic and behind_mask and not (self.has_stop or trainable):
            # An optic that leaves the amplitude alone is not a stop.
            self.has_stop = bool(np.ptp(np.abs(latest)) > 1e-9)
            kind = MovableStop if self.has_stop else PupilOptic
        plane = kind(
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
        padding = math.ceil(self.sampling)
        if centred == "corner":
            # The planes around such a mask shift the image by half of poppy's own sample.
            self.fixed.add("occulter_sampling")
            if padding != self.osys.oversample:
                raise IncompatibleSetupError(
                    f"occulter_sampling: {optic.name!r} is aligned to poppy's own samples of the "
                    f"image, {self.osys.oversample} per lambda/D; got {padding}"
                )
        count = self.npix * padding
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

        return FourierMask(transmission, padding, self.npix, diameter, optic.name)

    def _detector(self) -> OffsetDetector:
        detector = self.osys.planes[-1]
        scale = detector.pixelscale
        if not scale.unit.is_equivalent(u.arcsec / u.pix):
            raise IncompatibleSetupError(
                f"detector {detector.name!r}: got a pixel scale in '{scale.unit}', expected one "
                "that converts to 'arcsec / pix'"
            )
        arcsec = float(np.atleast_1d(scale.to_value(u.arcsec / u.pix))[0])
        wanted = self.recipe["fov_pixels"]
        shape = tuple(np.broadcast_to(detector.shape if wanted is None else wanted, 2).tolist())
        if min(shape) < 1:
            raise IncompatibleSetupError(f"fov_pixels: got {wanted}, expected at least 1")
        samples = arcsec / detector.oversample
        offset = (0.0, 0.0) if detector.offset is None else tuple(detector.offset)
        return OffsetDetector(
            shape=(int(shape[0]), int(shape[1])),
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
