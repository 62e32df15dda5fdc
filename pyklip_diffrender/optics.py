"""`OpticalSystem`: the ordered planes of a coronagraph as one differentiable function."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from pyklip_diffrender.detector import Detector
from pyklip_diffrender.errors import ShapeError
from pyklip_diffrender.geometry import PupilGrid
from pyklip_diffrender.parameters import parameter
from pyklip_diffrender.planes import (
    CompactOcculter,
    EntrancePupil,
    Plane,
    Values,
    Wavefront,
)
from pyklip_diffrender.psf_file import recipe_psf
from pyklip_diffrender.spectrum import Bandpass
from pyklip_diffrender.units import require_finite, require_shape, to_metres, to_unit

__all__ = ["OpticalSystem"]

Value = Tensor | ArrayLike | float


class OpticalSystem:
    """A coronagraph: entrance pupil, planes behind it, detector.

    Call it with an OPD to get the image of a star; everything is differentiable in torch.

    Parameters
    ----------
    entrance : EntrancePupil
    planes : sequence of Plane
        What lies between, in order. Each is linear in the field.
    detector : Detector
    bandpass : Bandpass
        Wavelengths and weights.
    recipe : mapping, optional
        What the system was made from, for provenance and for `with_fidelity`.
    remake : callable, optional
        Makes the same system from a changed recipe.
    """

    def __init__(
        self,
        entrance: EntrancePupil,
        planes: Sequence[Plane],
        detector: Detector,
        bandpass: Bandpass,
        recipe: dict[str, Any] | None = None,
        remake: Callable[..., OpticalSystem] | None = None,
    ) -> None:
        self.entrance = entrance
        self.planes = tuple(planes)
        self.detector = detector
        self.bandpass = bandpass
        self.recipe = dict(recipe or {})
        self._remake = remake

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
    def npix(self) -> int:
        """Samples across the pupil array."""
        return self.entrance.full.npix

    @property
    def diameter(self) -> float:
        """Side of the pupil array, m."""
        return self.entrance.full.diameter

    @property
    def dtype(self) -> torch.dtype:
        """Real type of the computation."""
        return self.entrance.dtype

    @property
    def device(self) -> torch.device:
        """Where the computation runs."""
        return self.detector.device

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the parameters that this system takes besides the OPD."""
        between = [name for plane in self.planes for name in plane.parameters]
        return (*self.entrance.parameters, *between, *self.detector.parameters)

    def with_fidelity(self, **changes: Any) -> Self | OpticalSystem:
        """The same system with other numerical settings, such as ``npix=256``.

        Parameters
        ----------
        **changes
            Arguments of the function that made this system.
        """
        if self._remake is None:
            raise TypeError(
                "this system was put together from planes and has no recipe to change; make a "
                "second one with the settings you want"
            )
        return self._remake(**{**self.recipe, **changes})

    def opd(self, opd: Value | None) -> Tensor:
        """Check an OPD and bring it to the system's device: (..., npix, npix) in m.

        None is the system's own wavefront, flat unless it came with one. Tensors pass through
        unchanged in value, so that gradients flow; everything else goes through the unit gate.
        """
        if opd is None and self.entrance.opd is not None:
            return self.entrance.opd
        if opd is None:
            return torch.zeros(self.npix, self.npix, dtype=self.dtype, device=self.device)
        if not isinstance(opd, Tensor):
            array = to_metres(opd, "opd")
            if array.ndim < 2:
                raise ShapeError(f"opd: got shape {array.shape}, expected (..., npix, npix)")
            require_finite(array, "opd (NaN is only allowed outside the pupil; set it to 0)")
            opd = torch.from_numpy(array)
        if opd.shape[-2:] != (self.npix, self.npix):
            require_shape(
                np.empty(opd.shape[-2:]),
                (self.npix, self.npix),
                "opd",
                f"This system samples the pupil with {self.npix} pixels: make it with "
                f"npix={opd.shape[-1]}, or resample the map with opd.resample",
            )
        return opd.to(self.device)

    def values(self, given: Mapping[str, Value | None]) -> dict[str, Tensor]:
        """Check named parameter values and make them float64 tensors, (components,) each.

        Quantities are converted to the unit of the parameter table.

        Raises
        ------
        TypeError
            For a name that this system does not take.
        ShapeError
            For a wrong number of components.
        UnitError
            For a Quantity of another kind.
        """
        checked = {}
        for name, value in given.items():
            if value is None:
                continue
            if name not in self.parameters:
                raise TypeError(f"{name!r} is not a parameter of this system: {self.parameters}")
            if not isinstance(value, Tensor):
                value = to_unit(value, parameter(name).unit, name)
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
        offset = values.get("star_offset")
        if offset is None:
            offset = torch.zeros(2, dtype=torch.float64, device=self.device)
        return self.entrance.field(opd, wavelength, offset)

    def windows(self, values: Values) -> list[PupilGrid]:
        """For every plane, the pupil window that it should hand on, given what follows it."""
        needed = self.entrance.full
        handed: list[PupilGrid] = []
        for plane in reversed(self.planes):
            handed.append(needed)
            needed = plane.window(values) or needed
        return handed[::-1]

    def propagate(self, wavefront: Wavefront, values: Values) -> Tensor:
        """Field on the detector's samples from the field behind the entrance pupil; linear."""
        for plane, onto in zip(self.planes, self.windows(values), strict=True):
            wavefront = plane.apply(wavefront, values, onto)
        return self.detector.field(wavefront, values)

    def fields(self, opd: Value | None = None, **parameters: Value) -> list[Tensor]:
        """Complex field on the detector's samples at each wavelength, each (..., ny, nx)."""
        tensor, values = self.opd(opd), self.values(parameters)
        return [
            self.propagate(self.pupil_field(tensor, wavelength, values), values)
            for wavelength in self.bandpass.wavelengths
        ]

    def __call__(
        self,
        opd: Value | None = None,
        star_offset: Value = (0.0, 0.0),
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
            In place of the bandpass's weights.
        **parameters
            Any of `self.parameters`, in the units of the parameter table.

        Returns
        -------
        Tensor, (..., ny, nx)
            Light per detector pixel as a fraction of what the entrance pupil collects.
        """
        given = {"star_offset": star_offset, **parameters}
        return self.image_of(self.fields(opd, **given), self.values(given), weights)

    def image_of(
        self, fields: Sequence[Tensor], values: Values, weights: Tensor | None = None
    ) -> Tensor:
        """Image from the fields at all wavelengths; arguments as in a call.

        Parameters
        ----------
        fields : sequence of Tensor
            What `fields` returns.
        values : mapping of str to Tensor
            What `values` returns; the detector's parameters matter here.
        weights : Tensor, (wavelengths,), optional
        """
        spectrum = self.bandpass.weights if weights is None else weights
        intensity = torch.zeros((), dtype=self.dtype, device=self.device)
        for field, weight in zip(fields, spectrum, strict=True):
            intensity = intensity + weight * (field.real**2 + field.imag**2)
        return self.detector.image(intensity, values)

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
        return_intermediates: bool = False,
        normalize: str = "first",
        opd: Value | None = None,
        **parameters: Value,
    ) -> Any:
        """PSF as an HDUList, with the arguments of `calc_psf` of poppy's and webbpsf's instruments.

        Arguments that are not given are those that the system was made with.

        Parameters
        ----------
        oversample, detector_oversample, fft_oversample : int, optional
            Samples per pixel, and per lambda/D on the occulter; the first sets both.
        outfile : path, optional
            Write the result there.
        display : bool
            Taken for poppy's sake; nothing is drawn.
        return_intermediates : bool
            Return (HDUList, `debug` of the first wavelength).
        normalize : str
            "first", "last", "exit_pupil" or "none", as in poppy.
        opd, **parameters
            As in a call of the system.

        Returns
        -------
        HDUList
            Extensions OVERSAMP and DET_SAMP.
        """
        samples = detector_oversample if detector_oversample is not None else oversample
        sampling = fft_oversample if fft_oversample is not None else oversample
        changes = {
            "source": source,
            "nlambda": nlambda,
            "monochromatic": monochromatic,
            "fov_arcsec": fov_arcsec,
            "fov_pixels": fov_pixels,
            "oversample": samples,
            "occulter_sampling": sampling,
        }
        changes = {name: value for name, value in changes.items() if value is not None}
        system: OpticalSystem = self
        if changes:
            # One way of giving a size or a band takes the place of the other.
            for name, rival in (
                ("fov_pixels", "fov_arcsec"),
                ("fov_arcsec", "fov_pixels"),
                ("nlambda", "monochromatic"),
                ("source", "monochromatic"),
            ):
                if name in changes and rival not in changes:
                    changes[rival] = None
            system = self.with_fidelity(**changes)
        hdus = recipe_psf(system, normalize, outfile, overwrite, opd, **parameters)
        if return_intermediates:
            return hdus, system.debug(opd, None, **parameters)
        return hdus

    def debug(
        self, opd: Value | None = None, wavelength: float | None = None, **parameters: Value
    ) -> dict[str, Tensor]:
        """The field at every named plane, in order.

        Returns
        -------
        dict of str to Tensor
            Pupil planes: the field behind the plane on its window of the pupil. Occulters: the
            field in front of the mask, on its cells ("... focus"), then back in the pupil.
            The detector: the field on its samples.
        """
        tensor, values = self.opd(opd), self.values(parameters)
        wavelength = wavelength or self.bandpass.wavelengths[0]
        wavefront = self.pupil_field(tensor, wavelength, values)
        found = {self.entrance.name: wavefront.field}
        for plane, onto in zip(self.planes, self.windows(values), strict=True):
            if isinstance(plane, CompactOcculter):
                found[f"{plane.name} focus"] = plane.focal_field(wavefront)
            wavefront = plane.apply(wavefront, values, onto)
            found[plane.name] = wavefront.field
        found[self.detector.name] = self.detector.field(wavefront, values)
        return found
