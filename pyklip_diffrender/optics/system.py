"""`OpticalSystem`: a differentiable coronagraph whose numerical settings can be changed."""

from __future__ import annotations

import copy
import os
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
import torch
from astropy.io import fits
from numpy.typing import NDArray

from pyklip_diffrender import drawing
from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.io.units import ARCSEC
from pyklip_diffrender.optics.bandpass import Bandpass
from pyklip_diffrender.optics.planes import Detector, EntrancePupil, Plane, Values, Wavefront
from pyklip_diffrender.optics.propagation import Propagation, Value
from pyklip_diffrender.optics.psf_hdus import (
    Array,
    instrument_psf,
    refuse_keywords,
    require_one_sampling,
    save,
)

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
