"""`Propagation`: the image of a star from the wavefront, through the planes of a coronagraph."""

from __future__ import annotations

import copy
import os
from collections.abc import Mapping, Sequence

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from pyklip_diffrender.errors import IncompatibleSetupError, ShapeError
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

# A fork copies the state of the thread pool of OpenMP, but not its threads: a child of a process
# that has computed with several threads, such as a worker of `multiprocessing.Pool`, would wait for
# them forever. One thread needs no pool. Children may not raise the number again.
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=lambda: torch.set_num_threads(1))


_CPU_ARRAY_BYTES = 3e6
"""Bytes of an array of a batch on the CPU. Arrays of three times the size may take twice as long:
the C library returns the memory to the operating system, which has to clear it for the next."""

_GPU_ARRAY_BYTES = 1e8
"""Bytes of an array of a batch on an accelerator, which is busy only with many arrays at a time.
The number was not measured."""


def batch_of(size: int, dtype: torch.dtype, device: torch.device) -> int:
    """Number of arrays of `size` elements to compute at a time, at least 1."""
    available = _CPU_ARRAY_BYTES if device.type == "cpu" else _GPU_ARRAY_BYTES
    return max(1, int(available / (size * dtype.itemsize)))


# At every wavelength the entrance pupil converts the OPD to a field, the planes propagate this
# field linearly, and the detector samples it. The image is the weighted sum of the intensities.

Value = Tensor | ArrayLike | float

_ON_AXIS = (0.0, 0.0)


class Propagation:
    """The path of light through a coronagraph; see `OpticalSystem` for the arguments."""

    def __init__(
        self,
        entrance: EntrancePupil,
        between: Sequence[Plane],
        detector: Detector,
        bandpass: Bandpass,
        route: str = "auto",
        defaults: Mapping[str, Value] | None = None,
    ) -> None:
        self.entrance = entrance
        self.between = tuple(between)
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
        if not LatticeRoute.serves(self.between):
            if route == "auto":
                return None
            raise IncompatibleSetupError(
                "route 'lattice': the planes are not one round occulter between factors in "
                "pupils; use 'auto' or 'planes'"
            )
        lattice = LatticeRoute(self.between, self.detector)
        return lattice if route == "lattice" or lattice.pays(self.bandpass.wavelengths) else None

    @property
    def route(self) -> str:
        """Propagation to the detector, "lattice" or "planes"."""
        return "planes" if self._lattice is None else "lattice"

    @property
    def planes(self) -> tuple[EntrancePupil | Plane | Detector, ...]:
        """All planes, from the entrance pupil to the detector."""
        return (self.entrance, *self.between, self.detector)

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
        return tuple(name for plane in self.planes for name in plane.parameters)

    def opd(self, opd: Value | None) -> Tensor:
        """An OPD on the system's device, checked: (..., npix, npix) in m.

        Arrays, Quantities and maps with another number of pixels across the pupil are resampled,
        see `grid.resample`. Tensors keep their values, so that gradients flow, and must have the
        size of the system's pupil. None stands for the wavefront with which the system was made,
        otherwise a flat one. ShapeError for a map that is not square or a tensor of another size,
        UnitError for a Quantity that is not a length, NonFiniteError for values that are not
        finite; a warning for an array whose rms inside the pupil suggests another unit.
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
        """Values of named parameters, checked, as float64 tensors, (components,) each.

        Quantities are converted to the unit of the parameter table (UnitError for a Quantity of
        another kind). Parameters that are missing or None have the values in `defaults`, if any.
        TypeError for a name that this system does not take, ShapeError for a wrong number of
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
        """Pupil windows that the planes must pass on to the planes behind them, in order."""
        needed = self.entrance.full
        passed: list[PupilGrid] = []
        for plane in reversed(self.between):
            passed.append(needed)
            # A mask acts on all the light in front of it, not only on the light needed behind.
            needed = plane.window(values) or (self.entrance.full if plane.focal else needed)
        return passed[::-1]

    def propagate(self, wavefront: Wavefront, values: Values) -> Tensor:
        """Field on the detector's samples from the field behind the entrance pupil; linear."""
        if self._lattice is not None:
            return self._lattice.field(wavefront, values, self.windows(values))
        return self.detector.field(self.behind_planes(wavefront, values), values)

    def behind_planes(
        self, wavefront: Wavefront, values: Values, first: int = 0, last: int | None = None
    ) -> Wavefront:
        """The wavefront behind the last plane, or some of the planes, one after the other."""
        windows = self.windows(values)
        for plane, onto in zip(self.between[first:last], windows[first:last], strict=True):
            wavefront = plane.apply(wavefront, values, onto)
        return wavefront

    def plane_waves(self, wavefront: Wavefront, values: Values, reach: int) -> PlaneWaves | None:
        """Propagation of a field behind the entrance pupil times plane waves.

        Waves have up to `reach` cycles across the pupil array along an axis. None where `propagate`
        is as fast.
        """
        if self._lattice is None:
            return None
        return self._lattice.plane_waves(wavefront, values, self.windows(values), reach)

    @property
    def _last_occulter(self) -> int:
        """Number of planes up to the last occulter."""
        return max((k + 1 for k, plane in enumerate(self.between) if plane.focal), default=0)

    @property
    def parameters_behind(self) -> frozenset[str]:
        """Names of the parameters of the planes behind the last occulter, and of the detector."""
        behind = {n for plane in self.between[self._last_occulter :] for n in plane.parameters}
        before = {n for plane in self.between[: self._last_occulter] for n in plane.parameters}
        names = behind | set(self.detector.parameters)
        return frozenset(names - before - set(self.entrance.parameters))

    def behind_occulter(self, wavefront: Wavefront, values: Values) -> Wavefront:
        """Propagate from behind the entrance pupil to the pupil behind the last occulter.

        This and `to_detector` make `propagate` in two steps, which are slower; the wavefront in
        between does not depend on `parameters_behind`.
        """
        if self._lattice is not None:
            return self._lattice.behind_occulter(wavefront, values, self.windows(values))
        return self.behind_planes(wavefront, values, last=self._last_occulter)

    def to_detector(self, wavefront: Wavefront, values: Values) -> Tensor:
        """Field on the detector's samples from the field in the pupil behind the last occulter."""
        behind = self.behind_planes(wavefront, values, first=self._last_occulter)
        return self.detector.field(behind, values)

    def transmission(self, opd: Value | None = None, **parameters: Value) -> float:
        """Fraction of the collected light of a source far from the occulter that is detected.

        Only planes in pupils, such as the Lyot stop, absorb light of such a source. The fraction is
        for the mean wavelength.
        """
        open_path = copy.copy(self)
        open_path.between = tuple(each for each in self.between if not each.focal)
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

        Of the `values`, only the parameters of the detector matter. `weights` (wavelengths,)
        replace the weights of the bandpass.
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
        """The field at every plane, by the plane's name, in order.

        Pupil planes have the field behind the plane, on the plane's window of the pupil. Occulters
        have the field in front of the mask, on the cells of the mask ("... focus"), and the field
        in the next pupil. The detector has the field on its samples.
        """
        tensor, values = self.opd(opd), self.values(parameters)
        wavelength = wavelength or self.bandpass.wavelengths[0]
        wavefront = self.pupil_field(tensor, wavelength, values)
        fields = {self.entrance.name: wavefront.field}
        for plane, onto in zip(self.between, self.windows(values), strict=True):
            if isinstance(plane, CompactOcculter):
                fields[f"{plane.name} focus"] = plane.focal_field(wavefront)
            wavefront = plane.apply(wavefront, values, onto)
            fields[plane.name] = wavefront.field
        # As in a call, which may take another route than the planes above.
        fields[self.detector.name] = self.field(tensor, wavelength, values)
        return fields
