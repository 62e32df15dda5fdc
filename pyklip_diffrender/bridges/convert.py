"""Convert the planes of a poppy `OpticalSystem`, one by one, to planes of this package."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import poppy
import torch
from astropy import units as u
from numpy.typing import NDArray
from poppy.poppy_core import PlaneType
from torch import Tensor

from pyklip_diffrender.bridges.image_masks import (
    COMPACT_OPTICS,
    BoxPart,
    FourierMask,
    ImageSamples,
    MaskPart,
    MaskStack,
    Part,
    SampledOcculter,
    SeparablePart,
    complement_box,
    padded_pupil,
    pupil_phasor,
)
from pyklip_diffrender.bridges.sampled_planes import (
    FreeRotation,
    Gain,
    MovableStop,
    Orientation,
    OrientedPupil,
    PupilOptic,
    free_turn,
    is_quarter_turn,
    turns_behind,
)
from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.io.units import ARCSEC, native_float64
from pyklip_diffrender.optics.bandpass import Bandpass
from pyklip_diffrender.optics.grid import PupilGrid
from pyklip_diffrender.optics.planes import Detector, Plane

Array = NDArray[Any]


class Conversion:
    """The planes of a poppy system, which passes `check_supported`, as planes of this package.

    `recipe` has the arguments of `from_poppy`, and `kinds` subclasses of `PupilOptic` for pupil
    planes, by name. IncompatibleSetupError for settings that do not fit the system.
    """

    def __init__(
        self,
        osys: poppy.OpticalSystem,
        recipe: dict[str, Any],
        kinds: Mapping[str, type[PupilOptic]] | None = None,
    ) -> None:
        self.osys, self.recipe, self.kinds = osys, recipe, kinds or {}
        self.dtype: torch.dtype = recipe["dtype"]
        self.device = torch.device(recipe["device"])
        self.bandpass = Bandpass.of(recipe["wavelength"], recipe["weights"])
        first = osys.input_wavefront(self.bandpass.wavelengths[0] * u.m)
        self.sampled = int(first.wavefront.shape[0])
        """Samples across the pupil at which poppy's optics are evaluated."""
        self.npix = int(recipe["npix"] or self.sampled)
        if self.npix < 1 or self.sampled % self.npix:
            raise IncompatibleSetupError(
                f"npix: got {self.npix}, expected a divisor of the {self.sampled} samples that "
                "poppy has across the pupil, because planes are averaged over whole blocks"
            )
        self.block = self.sampled // self.npix
        self.diameter = float(first.diam.to_value(u.m))
        # Samples per lambda/D in image planes.
        sampling = float(recipe["occulter_sampling"] or osys.oversample)
        # A whole number of samples across the image of the pupil array, rounding aside.
        self.sampling = math.ceil(self.npix * sampling - 1e-9) / self.npix
        # For every image plane, "compact" or "fft".
        self.propagation: dict[str, str] = {}
        # Settings that are part of the system, and cannot be changed.
        self.fixed: set[str] = set()
        self._has_stop = False
        # Changes from the frame of each plane of poppy to the frame of the system's pupils.
        turns = turns_behind(osys.planes)
        self.frames = [self._to_system(turn) for turn in turns]
        self.planes = self._convert_planes(turns)
        self.entrance = self._entrance()
        self.detector = self._detector()

    def _convert_planes(self, turns: list[Orientation]) -> list[Plane]:
        """All planes between the entrance pupil and the detector, in order."""
        planes: list[Plane] = []
        centred = "array_center"
        stack: list[Any] = []
        # Whether a mask has scattered light beyond the pupil array and no aperture held it back.
        scattered = False
        pupil = PupilGrid.full(self.npix, self.diameter)
        for k in range(1, len(self.osys.planes) - 1):
            optic, turn = self.osys.planes[k], turns[k]
            if optic.planetype == PlaneType.inversion:
                planes.append(Gain(optic.name))
            elif optic.planetype == PlaneType.rotation:
                angle = -optic.angle * turn.sense  # The system's frame mirrors the frame of poppy.
                # poppy rotates the pupil array alone, without the light beyond it.
                planes.append(
                    Gain(optic.name, edge=pupil)
                    if is_quarter_turn(optic)
                    else FreeRotation(angle, self.npix, self.diameter, optic.name)
                )
                scattered = False
            elif optic.planetype == PlaneType.pupil:
                plane, centred = self._pupil(k, centred)
                window = plane.window({})
                scattered &= window is None or window.intersection(pupil) != window
                planes.append(plane)
            elif self.osys.planes[k + 1].planetype == PlaneType.image:
                # Successive masks in one image act as one.
                stack.append(optic)
                planes.append(Gain(optic.name))
            else:
                mask = MaskStack.of([*stack, optic])
                plane = self._image(mask, turn, centred, scattered)
                scattered |= plane.focal
                planes.append(plane)
                stack = []
        return planes

    def _to_system(self, turn: Orientation) -> Orientation:
        """Change from the frame of a pupil plane to the system's frame, where y is inverted."""
        return turn.then(Orientation.inversion("y"))

    def _between_masks(self, index: int) -> bool:
        """Whether a plane lies between masks, where light scattered beyond the pupil matters.

        Uniform image planes are no masks. Behind the last mask, poppy cuts off scattered light.
        """
        masks = [
            plane.planetype == PlaneType.image and not isinstance(plane, poppy.ScalarTransmission)
            for plane in self.osys.planes
        ]
        return any(masks[:index]) and any(masks[index:])

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

    def _entrance(self) -> OrientedPupil:
        optic = self.osys.planes[0]
        shape = (self.sampled, self.sampled)
        opds: dict[float, Array] = {}
        for wavelength in self.bandpass.wavelengths:
            phasor, opd = pupil_phasor(optic, self._wave(wavelength))
            if not opds:
                amplitude = np.broadcast_to(np.abs(phasor), shape)
            opds[wavelength] = self._averaged(np.broadcast_to(opd, shape))
        # Calls without an OPD have the OPD at the first wavelength. The differences from this OPD
        # at other wavelengths are added in every call.
        base = opds[self.bandpass.wavelengths[0]]
        # poppy counts the angle of a source from +y, counter-clockwise.
        r, theta = float(self.osys.source_offset_r), np.deg2rad(self.osys.source_offset_theta)
        return OrientedPupil(
            torch.from_numpy(native_float64(self._averaged(amplitude))),
            torch.from_numpy(native_float64(base)),
            self.diameter,
            self.dtype,
            self.device,
            optic.name,
            self.frames[0],
            pointing=(float(-r * np.sin(theta)), float(r * np.cos(theta))),
            chromatic={
                w: torch.from_numpy(opd - base) for w, opd in opds.items() if (opd != base).any()
            },
            turned=free_turn(self.osys.planes),
            collected=float((amplitude**2).sum()) / self.block**2,
        )

    def _averaged(self, array: Array) -> Array:
        """Block means of an array that extends equally far beyond the pupil on all sides."""
        if self.block == 1:
            return array
        border = (len(array) - self.sampled) // 2
        dropped = border % self.block
        count = self.npix + 2 * (border // self.block)
        window = slice(dropped, dropped + count * self.block)
        blocks = array[window, window].reshape(count, self.block, count, self.block)
        return np.asarray(blocks.mean(axis=(1, 3)))

    def _pupil(self, index: int, centred: str) -> tuple[Plane, str]:
        """A pupil plane, and where poppy centres the next image."""
        optic, padded = self.osys.planes[index], self._between_masks(index)
        phasors: dict[float, Tensor] = {}
        latest: Array | None = None
        for wavelength in self.bandpass.wavelengths:
            wave = self._wave(wavelength, padded)
            wave._image_centered = centred
            phasor, _ = pupil_phasor(optic, wave)
            if latest is None or not np.array_equal(phasor, latest):
                averaged = self._averaged(np.broadcast_to(phasor, wave.shape))
                tensor = torch.from_numpy(np.array(averaged, dtype=np.complex128))
            phasors[wavelength], latest = tensor, phasor
        assert latest is not None
        centred = wave._image_centered
        uniform = latest.size == 1 or np.ptp(latest) == 0
        if uniform and len({id(p) for p in phasors.values()}) == 1:
            return Gain(optic.name, complex(latest.flat[0])), centred
        # The first stop behind a mask becomes a `MovableStop`.
        kind = self.kinds.get(optic.name, PupilOptic)
        behind_mask = any(p.planetype == PlaneType.image for p in self.osys.planes[:index])
        if kind is PupilOptic and behind_mask and not self._has_stop:
            # An optic with a constant amplitude is not a stop.
            self._has_stop = bool(np.ptp(np.abs(latest)) > 1e-9)
            kind = MovableStop if self._has_stop else PupilOptic
        plane = kind(
            phasors,
            self.npix,
            self.diameter,
            self.dtype,
            self.device,
            optic.name,
            self.frames[index],
        )
        return plane, centred

    def _image(self, optic: Any, turn: Orientation, centred: str, scattered: bool) -> Plane:
        """An image plane; `scattered` if light beyond the pupil array reaches it."""
        if isinstance(optic, poppy.ScalarTransmission):
            return Gain(optic.name, complex(optic.transmission))
        if (self.sampled * self.osys.oversample) % 2:
            raise IncompatibleSetupError(
                f"plane {optic.name!r}: poppy places masks half a sample off the axis if the image "
                f"has an odd number of samples, here {self.sampled} x {self.osys.oversample}; use "
                "an even npix or oversample"
            )
        way = self.recipe["propagation"]
        if not isinstance(way, str):
            way = way.get(optic.name, "auto")
        if way not in ("auto", "compact", "fft"):
            raise IncompatibleSetupError(
                f"propagation: got {way!r} for {optic.name!r}, expected 'auto', 'compact' or 'fft'"
            )
        parts = None if way == "fft" or centred == "corner" else self._parts(optic, turn)
        if parts is None and way == "compact":
            raise IncompatibleSetupError(
                f"plane {optic.name!r} ({type(optic).__name__}) is not known to block only a "
                f"bounded part of the image; those known are {COMPACT_OPTICS}. Use "
                "propagation='fft'"
            )
        if parts is None:
            self.propagation[optic.name] = "fft"
            return self._fourier(optic, turn, centred)
        self.propagation[optic.name] = "compact"
        grid = padded_pupil(self.npix, self.diameter, self.sampling if scattered else 1)
        return SampledOcculter(parts, self.sampling, self.diameter, optic.name, grid)

    def _parts(self, optic: Any, turn: Orientation) -> list[MaskPart] | None:
        spacing = max(self.bandpass.wavelengths) / self.diameter / self.sampling / ARCSEC
        mask_parts = complement_box(optic, margin=2 * spacing)
        if mask_parts is None:
            return None
        to_plane = turn.inverse
        parts: list[MaskPart] = []
        for part in mask_parts:
            if part.box is None:
                along_x, along_y = (_turned_factor(part, to_plane, axis) for axis in (0, 1))
                parts.append(SeparablePart(along_x, along_y, self.sampling))
                continue
            low, high, bottom, top = part.box
            x, y = turn.positions(torch.tensor([low, high]), torch.tensor([bottom, top]))
            box = (float(x.min()), float(x.max()), float(y.min()), float(y.max()))
            parts.append(BoxPart(self._complement(part.optic, to_plane), box))
        return parts

    def _complement(
        self, optic: Any, to_plane: Orientation
    ) -> Callable[[Tensor, Tensor, float], Tensor]:
        diameter, oversample = self.diameter, self.osys.oversample

        def complement(x: Tensor, y: Tensor, wavelength: float) -> Tensor:
            local_x, local_y = to_plane.positions(*torch.broadcast_tensors(x, y))
            transposed = to_plane.matrix[0][0] == 0
            if transposed:  # Optics expect x to grow along the second axis of the array.
                local_x, local_y = local_x.T, local_y.T
            wave = ImageSamples(wavelength, diameter, oversample, local_x, local_y)
            blocked = torch.from_numpy(1 - np.asarray(optic.get_phasor(wave), dtype=complex))
            return blocked.T if transposed else blocked

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

    def _detector(self) -> Detector:
        detector = self.osys.planes[-1]
        scale = detector.pixelscale
        if not scale.unit.is_equivalent(u.arcsec / u.pix):
            raise IncompatibleSetupError(
                f"detector {detector.name!r}: got a pixel scale in '{scale.unit}', expected one "
                "that converts to 'arcsec / pix'"
            )
        arcsec = float(np.atleast_1d(scale.to_value(u.arcsec / u.pix))[0])
        pixels = self.recipe["fov_pixels"]
        shape = np.broadcast_to(detector.shape if pixels is None else pixels, 2)
        if min(shape) < 1:
            raise IncompatibleSetupError(f"fov_pixels: got {pixels}, expected at least 1")
        samples = arcsec / detector.oversample
        offset = (0.0, 0.0) if detector.offset is None else tuple(detector.offset)
        return Detector(
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
    part: Part, to_plane: Orientation, axis: int
) -> Callable[[Tensor], Tensor] | None:
    """The factor of a separable part along one axis of the final image."""
    # Turns are by right angles, so that an axis of the image is, up to the sign, an axis of the
    # plane: one element of the column of the matrix is not 0.
    column = (to_plane.matrix[0][axis], to_plane.matrix[1][axis])
    factor, sign = (part.along_x, column[0]) if column[0] else (part.along_y, column[1])
    return None if factor is None else lambda positions: factor(sign * positions)
