"""`OpticalSystem`: the ordered planes of a coronagraph as one differentiable function."""

from __future__ import annotations

import copy
import os
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from pyklip_diffrender.errors import IncompatibleSetupError, ShapeError
from pyklip_diffrender.io.units import require_finite, to_metres, to_unit, warn_of_rms
from pyklip_diffrender.optics.bandpass import Bandpass
from pyklip_diffrender.optics.detector import Detector
from pyklip_diffrender.optics.fast.path import LatticeRoute
from pyklip_diffrender.optics.grid import PupilGrid, resample
from pyklip_diffrender.optics.planes import (
    CompactOcculter,
    EntrancePupil,
    Plane,
    Values,
    Wavefront,
)
from pyklip_diffrender.optics.psf_file import instrument_psf
from pyklip_diffrender.optics.sampled_planes import OrientedPupil, PupilOptic
from pyklip_diffrender.parameters import parameter

__all__ = ["OpticalSystem"]

Value = Tensor | ArrayLike | float

_ON_AXIS = (0.0, 0.0)

_BAND = ("monochromatic", "nlambda", "source", "wavelength")
"""Settings that decide the wavelengths."""


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
        The arguments that the system was made with, for provenance and for `with_fidelity`.
    remake : callable, optional
        Takes the arguments of `recipe`, some of them changed, and makes another system.
    route : "auto", "lattice" or "planes"
        How light gets to the detector: by convolution on cells that fit the detector (`cells`),
        which is for one round occulter between pupils, or plane by plane, which is for all.
        "auto" takes the first where it can be had and the detector is not very fine.
    defaults : mapping of str to value, optional
        Values at which named parameters stand where a call does not give them, in the units of
        the parameter table: how the instrument is aligned, or what an earlier fit has found. Not
        ``star_offset``, which belongs to a source and not to the instrument.

    Attributes
    ----------
    defaults : dict of str to Tensor

    Raises
    ------
    IncompatibleSetupError
        For the route "lattice" through planes that it does not take, and for a default
        ``star_offset``.
    TypeError, ShapeError, UnitError
        For defaults that `values` refuses.
    """

    _replaced: ClassVar[dict[str, tuple[str, ...]]] = {
        "fov_pixels": ("fov_arcsec",),
        "fov_arcsec": ("fov_pixels",),
        "nlambda": ("monochromatic",),
        "source": ("monochromatic",),
    }
    """For a setting, those that say the same in other words and are dropped when it is given."""

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
        self.entrance = entrance
        self.planes = tuple(planes)
        self.detector = detector
        self.bandpass = bandpass
        self.recipe = dict(recipe or {})
        self._remake = remake
        self._other_bandpass: Bandpass | None = None
        if route not in ("auto", "lattice", "planes"):
            raise IncompatibleSetupError(
                f"route: got {route!r}, expected 'auto', 'lattice' or 'planes'"
            )
        self._lattice: LatticeRoute | None = None
        if route != "planes" and LatticeRoute.serves(self.planes):
            lattice = LatticeRoute(self.planes, detector)
            if route == "lattice" or lattice.pays(bandpass.wavelengths):
                self._lattice = lattice
        if route == "lattice" and self._lattice is None:
            raise IncompatibleSetupError(
                "route 'lattice': the planes are not one round occulter between factors in "
                "pupils; use 'auto' or 'planes'"
            )
        if defaults and "star_offset" in defaults:
            raise IncompatibleSetupError(
                "defaults: star_offset belongs to a source; give it in the call, or move the "
                "optical axis with detector_shift"
            )
        self.defaults: dict[str, Tensor] = {}
        self.defaults = self.values(defaults or {})

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
    def route(self) -> str:
        """How light gets to the detector: "lattice" or "planes"."""
        return "planes" if self._lattice is None else "lattice"

    @property
    def maker(self) -> Callable[..., OpticalSystem] | None:
        """The function that makes this system from its recipe; None if there is none."""
        return self._remake

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

    @property
    def setup(self) -> dict[str, str]:
        """What the system is a model of, as far as it knows.

        Names in the spelling of stpsf under "filter", "image_mask", "pupil_mask" and "module";
        empty for a system that is not an instrument's.
        """
        names = ("filter", "image_mask", "pupil_mask")
        setup = {name: self.recipe[name] for name in names if self.recipe.get(name)}
        # The embedded masks are those of NIRCam's module A.
        return {**setup, "module": "A"} if "image_mask" in setup else setup

    @property
    def adjustable(self) -> frozenset[str]:
        """Names of the settings that `with_fidelity` can change.

        What a fit makes cheaper has the same name in every system that can change it: "npix",
        "dtype", "occulter_sampling", "fov_pixels" and "bandpass" (a `Bandpass`). The other names
        are arguments of the function that made the system. A system put together from planes can
        change its bandpass only, and not even that if its planes were sampled for some
        wavelengths.
        """
        names = set(self.recipe) if self._remake is not None else set()
        return frozenset(names if self._is_sampled else {*names, "bandpass"})

    def with_fidelity(self, **changes: Any) -> OpticalSystem:
        """The same system with other numerical settings, such as ``npix=256``.

        Parameters
        ----------
        **changes
            Settings by name, out of `adjustable`. One that says the same in other words is
            dropped: ``fov_pixels`` takes the place of ``fov_arcsec``, ``nlambda`` that of
            ``monochromatic``. Settings that keep their value are accepted for all systems.

        Raises
        ------
        IncompatibleSetupError
            For a setting that this system cannot change, or a value that it does not take.
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
        made = self._remade(changes) if changes else self
        return made if bandpass is None else made.at_wavelengths(bandpass)

    def at_wavelengths(self, bandpass: Bandpass) -> OpticalSystem:
        """The same system with another bandpass.

        Its planes are shared, with all that they have computed so far. Systems that
        `with_fidelity` makes of the result have the other bandpass, too.

        Parameters
        ----------
        bandpass : Bandpass
            Any wavelengths if "bandpass" is in `adjustable`; otherwise some of those that the
            system has.

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
        """Whether planes are known at the wavelengths of the bandpass only."""
        planes = (self.entrance, *self.planes)
        return any(isinstance(plane, OrientedPupil | PupilOptic) for plane in planes)

    def _remade(self, changes: Mapping[str, Any]) -> OpticalSystem:
        """Another system from the same recipe with some changes."""
        assert self._remake is not None  # Otherwise its arguments are not adjustable.
        dropped = {
            other: None
            for name in changes
            for other in self._replaced.get(name, ())
            if other in self.recipe and other not in changes
        }
        return self._remake(**{**self.recipe, **dropped, **changes})

    def opd(self, opd: Value | None) -> Tensor:
        """Check an OPD and bring it to the system's device: (..., npix, npix) in m.

        Arrays, Quantities and maps that sample the pupil with another number of pixels are
        resampled, see `grid.resample`. Tensors pass through unchanged in value, so that gradients
        flow, and must have the system's own size. None is the system's own wavefront, flat unless
        it came with one.

        Raises
        ------
        ShapeError
            For a map that is not square, or a tensor of another size.
        UnitError, NonFiniteError
            For a Quantity that is not a length, or values that are not finite.

        Warns
        -----
        DiffrenderWarning
            For an array whose rms inside the pupil is that of a wavefront in another unit.
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
        self._warn_of_unit(opd, array)
        return torch.from_numpy(array).to(self.device)

    def _warn_of_unit(self, given: Any, array: NDArray[np.float64]) -> None:
        """Warn of an array in nanometres; maps know their unit, and fits move tensors."""
        lit = self.entrance.lit.cpu().numpy()
        if isinstance(given, np.ndarray) and lit.any():
            # A small rms is fair: somebody may ask what a mode of 1 pm does.
            rms = float(array[..., lit].std(axis=-1).max())
            warn_of_rms(rms, "opd", stacklevel=6, small=False)

    def values(self, given: Mapping[str, Value | None]) -> dict[str, Tensor]:
        """Check named parameter values and make them float64 tensors, (components,) each.

        Quantities are converted to the unit of the parameter table. Parameters that are not
        given, or are None, stand at the system's `defaults`, where it has them.

        Raises
        ------
        TypeError
            For a name that this system does not take.
        ShapeError
            For a wrong number of components.
        UnitError
            For a Quantity of another kind.
        """
        checked = dict(self.defaults)
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
        return self.entrance.field(opd, wavelength, values.get("star_offset"))

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
        windows = self.windows(values)
        if self._lattice is not None:
            return self._lattice.field(wavefront, values, windows)
        for plane, onto in zip(self.planes, windows, strict=True):
            wavefront = plane.apply(wavefront, values, onto)
        return self.detector.field(wavefront, values)

    def _field(self, opd: Tensor, wavelength: float, values: Values) -> Tensor:
        found = None
        if self._lattice is not None:
            windows = self.windows(values)
            found = self._lattice.star(self.entrance, opd, wavelength, values, windows)
        if found is None:
            found = self.propagate(self.pupil_field(opd, wavelength, values), values)
        return found

    def fields(self, opd: Value | None = None, **parameters: Value) -> list[Tensor]:
        """Complex field on the detector's samples at each wavelength, each (..., ny, nx)."""
        tensor, values = self.opd(opd), self.values(parameters)
        return [self._field(tensor, wavelength, values) for wavelength in self.bandpass.wavelengths]

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
            In place of the bandpass's weights.
        **parameters
            Any of `self.parameters`, in the units of the parameter table.

        Returns
        -------
        Tensor, (..., ny, nx)
            Light per detector pixel as a fraction of what the entrance pupil collects.
        """
        given = dict(parameters)
        if star_offset is not _ON_AXIS:  # Who passes zeros may want their derivative.
            given["star_offset"] = star_offset
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
        system = self.with_fidelity(**{k: v for k, v in changes.items() if v is not None})
        hdus = instrument_psf(system, normalize, outfile, overwrite, opd, **parameters)
        if return_intermediates:
            return hdus, system.debug(opd, None, **parameters)
        return hdus

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
        from pyklip_diffrender import plotting

        return plotting.plot_system(self, ax, opd=opd)

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
        # As in a call, which may take another route than the planes above.
        found[self.detector.name] = self._field(tensor, wavelength, values)
        return found
