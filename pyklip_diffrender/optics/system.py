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
from numpy.typing import NDArray

from pyklip_diffrender import drawing
from pyklip_diffrender._version import __version__
from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.io.files import require_new, write_fits
from pyklip_diffrender.io.headers import set_keyword
from pyklip_diffrender.io.units import ARCSEC
from pyklip_diffrender.optics.bandpass import Bandpass
from pyklip_diffrender.optics.planes import Detector, EntrancePupil, Plane, Values, Wavefront
from pyklip_diffrender.optics.propagation import Propagation, Value

_DEBUG = "debug(opd) returns the field at every plane"
_NO_WAVEFRONTS = (
    "this system has no poppy.Wavefront objects, as systems of from_poppy and from_webbpsf have; "
    f"{_DEBUG}"
)

REFUSED = {
    "progressbar": "a PSF of this system is not made in steps that take long; leave it out",
    "inwave": "the entrance pupil makes the field of this system; give a wavefront as opd, and the "
    "place of the source as star_offset",
}
"""Keywords of `calc_psf` of poppy's `OpticalSystem` that no system serves, and why."""

_BAND_SETTINGS = ("monochromatic", "nlambda", "source", "wavelength")
"""Settings that determine the wavelengths."""


# PSFs as HDULists with the extensions and keywords of poppy and stpsf.

Array = NDArray[np.float64]

_NORMALIZATIONS = ("first", "last", "exit_pupil", "none")


_SETUP_KEYWORDS = {
    "FILTER": ("filter", "Filter name"),
    "CORONMSK": ("image_mask", "Image plane mask"),
    "PUPIL": ("pupil_mask", "Pupil plane mask"),
}


def _samples(system: Propagation, normalize: str, opd: Any, parameters: dict[str, Any]) -> Array:
    """Light on the detector's samples, before binning, (oversample ny, oversample nx).

    `normalize` names the plane where the light adds up to 1 at every wavelength: "first", "last" or
    "exit_pupil". With "none" the field is 1 where the pupil is clear.
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
                # Share of the light that reaches the last pupil.
                values = system.values(parameters)
                wavefront = system.pupil_field(tensor, wavelength, values)
                wavefront = system.behind_planes(wavefront, values)
                power = (wavefront.field.abs() ** 2).sum() * wavefront.grid.spacing**2
                light = light / power
            elif kind == "none":
                light = light * system.entrance.total
            total = total + weight * light.double().cpu().numpy()
    return np.asarray(total, dtype=np.float64)


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
    # How a system that was made from poppy's propagates through each image plane.
    used = getattr(system, "propagation", {})
    propagations = ", ".join(f"{name}: {kind}" for name, kind in used.items())
    set_keyword(header, "DRPROP", propagations or "compact")
    set_keyword(header, "DRPREC", str(entrance.dtype).removeprefix("torch."))
    header.add_history(f"Created by pyklip_diffrender {__version__}")


def poppy_psf(
    system: Propagation, normalize: str = "first", opd: Any = None, **parameters: Any
) -> fits.HDUList:
    """The return value of `poppy.OpticalSystem.calc_psf`: one oversampled image; see `_samples`."""
    hdu = fits.PrimaryHDU(_samples(system, normalize, opd, parameters))
    _header(system, normalize, hdu.header)
    return fits.HDUList([hdu])


def refuse_keywords(reasons: Mapping[str, str], given: Mapping[str, Any]) -> None:
    """Raise IncompatibleSetupError for a keyword of poppy or stpsf that a system cannot serve."""
    for name, reason in reasons.items():
        # An input wavefront is an array of numbers, without a truth value.
        if given[name] is not None and given[name] is not False:
            raise IncompatibleSetupError(f"{name}={given[name]!r}: {reason}")


def require_one_sampling(common: int | None, detector: int | None, fft: int | None) -> None:
    """Raise IncompatibleSetupError, as stpsf does, if an oversampling is given twice."""
    if None not in (common, detector, fft):
        raise IncompatibleSetupError(
            "give oversample, or detector_oversample with fft_oversample, not all three"
        )


def save(hdus: fits.HDUList, outfile: str | os.PathLike[str] | None, overwrite: bool) -> None:
    """Write a PSF, unless `outfile` is None; ExistingFileError unless `overwrite` is True."""
    if outfile is None:
        return
    require_new([outfile], overwrite)
    hdus[0].header["FILENAME"] = (os.path.basename(outfile), "Name of this file")
    with warnings.catch_warnings():
        # Some of stpsf's comments are longer than a card.
        warnings.filterwarnings("ignore", "Card is too long", VerifyWarning)
        write_fits(hdus, outfile)


class OpticalSystem(Propagation):
    """A coronagraph: the entrance pupil, the planes behind it and the detector.

    Call it with an OPD to get the image of a star; everything is differentiable in torch.

    Parameters
    ----------
    entrance : EntrancePupil
    between : sequence of Plane
        The planes in between, in order. Each is linear in the field.
    detector : Detector
    bandpass : Bandpass
        Wavelengths and weights.
    recipe : mapping, optional
        Arguments with which the system was made, for provenance and for `with_fidelity`.
    remake : callable, optional
        Function that makes another system from the arguments in `recipe`, some of them changed.
    route : "auto", "lattice" or "planes"
        Propagation to the detector: by a convolution on cells that fit the detector ("lattice"),
        which needs a single compact occulter between pupils, or plane by plane ("planes"), which
        always works. "auto" is "lattice" if possible, unless the detector is very fine.
    defaults : mapping of str to value, optional
        Values of parameters, by name, for calls without these parameters, in the units of the
        parameter table: the alignment of the instrument, or the result of an earlier fit. A
        ``star_offset``, which belongs to a source and not to the instrument, is not allowed.

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
    >>> opd = dr.wavefront.random_opd(1, npix=128)
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
    """Alternatives to a setting, which are dropped when the setting is given."""

    def __init__(
        self,
        entrance: EntrancePupil,
        between: Sequence[Plane],
        detector: Detector,
        bandpass: Bandpass,
        recipe: dict[str, Any] | None = None,
        remake: Callable[..., OpticalSystem] | None = None,
        route: str = "auto",
        defaults: Mapping[str, Value] | None = None,
    ) -> None:
        super().__init__(entrance, between, detector, bandpass, route, defaults)
        self.recipe = dict(recipe or {})
        self.maker = remake
        self._other_bandpass: Bandpass | None = None

    def __repr__(self) -> str:
        names = ", ".join(plane.name for plane in self.planes)
        waves = len(self.bandpass.wavelengths)
        return (
            f"<{type(self).__name__}: {names}; {self.npix} px pupil, {waves} wavelength"
            f"{'s' if waves > 1 else ''} about {self.bandpass.mean_wavelength * 1e6:.2f} um, "
            f"{self.detector.shape[1]} x {self.detector.shape[0]} px>"
        )

    @property
    def setup(self) -> dict[str, str]:
        """Setup of the instrument; empty if the system is not an instrument.

        The keys "filter", "image_mask" and "pupil_mask", and "module" of stpsf's instruments, have
        names as stpsf spells them.
        """
        names = ("filter", "image_mask", "pupil_mask")
        return {name: self.recipe[name] for name in names if self.recipe.get(name)}

    @property
    def adjustable(self) -> frozenset[str]:
        """Names of the settings that `with_fidelity` can change.

        "npix", "dtype", "occulter_sampling", "fov_pixels" and "bandpass" (a `Bandpass`) have these
        names in all systems where they can be changed. The other names are arguments of the
        function that made the system. Of a system made directly from planes, only the bandpass can
        be changed, unless the planes were sampled at certain wavelengths.
        """
        names = set(self.recipe) if self.maker is not None else set()
        return frozenset(names if self._is_sampled else {*names, "bandpass"})

    def with_fidelity(self, **changes: Any) -> OpticalSystem:
        """Return a copy of the system with other numerical settings, such as ``npix=256``.

        Parameters
        ----------
        **changes
            Settings in `adjustable`. Alternatives are dropped: ``fov_pixels`` replaces
            ``fov_arcsec``, ``nlambda`` replaces ``monochromatic``. A setting with an unchanged
            value is always accepted.

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
                f"{', '.join(refused)}: cannot be changed in {self!r}. Settings that can be "
                f"changed are {', '.join(sorted(self.adjustable)) or 'none'}. Make a second system "
                "with the settings you want"
            )
        changes = {name: value for name, value in changes.items() if name in self.adjustable}
        bandpass = changes.pop("bandpass", None)
        if bandpass is None and changes.keys().isdisjoint(_BAND_SETTINGS):
            bandpass = self._other_bandpass
        system = self._remade(changes) if changes else self
        return system if bandpass is None else system.at_wavelengths(bandpass)

    def at_wavelengths(self, bandpass: Bandpass) -> OpticalSystem:
        """Return a copy of the system with another bandpass.

        Both systems share the planes and the cached results of the planes. `with_fidelity` of the
        copy keeps the bandpass.

        Parameters
        ----------
        bandpass : Bandpass
            Any wavelengths if "bandpass" is in `adjustable`, otherwise a selection of the
            wavelengths of this system.

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
        return self.entrance.sampled or any(plane.sampled for plane in self.between)

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

    _refused: ClassVar[Mapping[str, str]] = {
        "save_intermediates": f"this system writes no files of its own; {_DEBUG}",
        "return_intermediates": _NO_WAVEFRONTS,
        "return_final": _NO_WAVEFRONTS,
        "display_intermediates": f"display=True draws the PSF alone; {_DEBUG}",
        **REFUSED,
    }
    """Keywords of `calc_psf` that this system does not serve, and why."""

    def calc_psf(
        self,
        wavelength: Any = None,
        weight: Any = None,
        save_intermediates: bool = False,
        save_intermediates_what: str = "all",
        display: bool = False,
        return_intermediates: bool = False,
        return_final: bool = False,
        source: Mapping[str, Any] | None = None,
        normalize: str = "first",
        display_intermediates: bool = False,
        progressbar: bool = False,
        inwave: Any = None,
        opd: Value | None = None,
        **parameters: Value,
    ) -> Any:
        """PSF as an HDUList, with the arguments of `calc_psf` of poppy's `OpticalSystem`.

        Parameters
        ----------
        wavelength : Quantity, float (m) or sequence of them, optional
            By default, the wavelengths of the system.
        weight : sequence of float, optional
            Weights of the wavelengths. By default equal if there is a `wavelength`, otherwise as in
            the system.
        source : dict, optional
            "wavelengths" and "weights", in place of the two arguments above.
        normalize : str
            "first", "last", "exit_pupil" or "none", as in poppy.
        return_intermediates, return_final : bool
            Also return a list of `poppy.Wavefront`, for every plane or for the detector alone,
            summed over wavelengths as in poppy. Only systems of `from_poppy` have these objects.
        display : bool
            Draw the PSF in a new figure of matplotlib, on a logarithmic scale.
        opd, **parameters
            As in a call of the system.
        save_intermediates, display_intermediates, progressbar, inwave
            Refused with a pointer to what does the same.
        save_intermediates_what
            Without effect, as in poppy where no intermediate planes are saved.

        Returns
        -------
        HDUList, or (HDUList, list of Wavefront)

        Raises
        ------
        IncompatibleSetupError
            For a keyword that this system does not serve, with the reason, for wavelengths at which
            the planes are not known, and for an unknown `normalize`.
        """
        refuse_keywords(self._refused, locals())
        if source is not None:
            wavelength, weight = source["wavelengths"], source["weights"]
        system: Any = self
        if wavelength is not None or weight is not None:
            waves = self.bandpass.wavelengths if wavelength is None else wavelength
            system = self.at_wavelengths(Bandpass.of(waves, weight))
        wavefronts = None
        if return_intermediates or return_final:  # Systems without these have refused them.
            only_last = not return_intermediates
            wavefronts = system._intermediates(normalize, opd, parameters, only_last)
        hdus = poppy_psf(system, normalize, opd, **parameters)
        if display:
            system._draw_psf(hdus, parameters)
        return hdus if wavefronts is None else (hdus, wavefronts)

    def describe(self) -> str:
        """A table of all planes, one per line, for ``print``; poppy's `describe` prints itself."""
        return "\n\t".join(map(repr, (self, *self.planes)))

    def display(self, **keywords: Any) -> None:
        """Draw the system in a new figure, as `plot` does.

        Parameters
        ----------
        **keywords
            Keywords of `display` of poppy's optics, for systems of `from_poppy`, which draw all
            their planes as poppy does. Other systems refuse them.

        Raises
        ------
        IncompatibleSetupError
            For keywords if the planes are not poppy's.
        """
        if keywords:
            given = ", ".join(f"{name}={value!r}" for name, value in keywords.items())
            raise IncompatibleSetupError(
                f"{given}: the planes of this system are no optics of poppy; plot(ax, opd=...) "
                "takes the axes to draw in and a wavefront"
            )
        self.plot()

    def _draw_psf(self, hdus: fits.HDUList, parameters: Mapping[str, Value]) -> None:
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

        The last two are for a star on the optical axis, on a logarithmic scale.

        Parameters
        ----------
        ax : four Axes, optional
            By default, the axes of a new figure.
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
        drawing.opd_map(phase, map_, width, title="wavefront error")
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


class InstrumentSystem(OpticalSystem):
    """An `OpticalSystem` that is used as an instrument of stpsf; see `nircam_coronagraph`."""

    _refused: ClassVar[Mapping[str, str]] = {
        "save_intermediates": f"this system writes no files of its own; {_DEBUG}",
        "return_intermediates": _NO_WAVEFRONTS,
        "add_distortion": "distortion and charge diffusion are modelled by from_webbpsf only; "
        "leave it out for OVERSAMP and DET_SAMP alone",
    }

    def calc_psf(  # type: ignore[override]  # An instrument of stpsf is no OpticalSystem of poppy.
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
        add_distortion: bool | None = None,
        crop_psf: bool = True,
        opd: Value | None = None,
        **parameters: Value,
    ) -> Any:
        """PSF as an HDUList, with the arguments of `calc_psf` of stpsf's instruments.

        Arguments that are not given keep the values that the system was made with.

        Parameters
        ----------
        source : float, Quantity, (wavelengths, photons) or mapping, optional
            Temperature (K) or spectrum of the star, or "wavelengths" (m) and "weights" of the PSF.
        oversample, detector_oversample, fft_oversample : int, optional
            Samples per pixel, and per lambda/D on the occulter; `oversample` sets both.
        outfile : path, optional
            Write the result there.
        display : bool
            Draw the PSF in a new figure of matplotlib, on a logarithmic scale.
        normalize : str
            "first", "last", "exit_pupil" or "none", as in poppy.
        add_distortion : bool, optional
            Add extensions OVERDIST and DET_DIST; the default in systems of `from_webbpsf`, which
            alone have these extensions.
        crop_psf : bool
            As in stpsf; without effect where there is no distortion.
        return_intermediates : bool
            Also return a list of `poppy.Wavefront`, one per plane. Only systems of `from_webbpsf`
            have these objects.
        save_intermediates
            Refused with a pointer to what does the same.
        opd, **parameters
            As in a call of the system.

        Returns
        -------
        HDUList, or (HDUList, list of poppy.Wavefront)
            Extensions OVERSAMP and DET_SAMP, and perhaps OVERDIST and DET_DIST.

        Raises
        ------
        IncompatibleSetupError
            For a keyword of stpsf that this system does not serve, with the reason, and for a
            setting that cannot be changed.
        """
        refuse_keywords(self._refused, locals())
        require_one_sampling(oversample, detector_oversample, fft_oversample)
        changes = self._changes(
            {
                "source": source,
                "nlambda": nlambda,
                "monochromatic": monochromatic,
                "fov_arcsec": fov_arcsec,
                "fov_pixels": fov_pixels,
                "oversample": oversample,
                "detector_oversample": detector_oversample,
                "fft_oversample": fft_oversample,
            }
        )
        system: Any = self.with_fidelity(**{k: v for k, v in changes.items() if v is not None})
        wavefronts = None
        if return_intermediates:
            wavefronts = system._intermediates(normalize, opd, parameters, only_last=False)
        options = {"add_distortion": add_distortion is not False, "crop_psf": crop_psf}
        hdus = system._extensions(normalize, opd, parameters, options)
        save(hdus, outfile, overwrite)
        if display:
            system._draw_psf(hdus, parameters)
        return hdus if wavefronts is None else (hdus, wavefronts)

    def _changes(self, given: dict[str, Any]) -> dict[str, Any]:
        """Arguments of `calc_psf` as settings of this system."""
        common, source = given["oversample"], given["source"]
        pixels, fine = given.pop("detector_oversample"), given.pop("fft_oversample")
        given["oversample"] = common if pixels is None else pixels
        given["occulter_sampling"] = common if fine is None else fine
        if isinstance(source, Mapping):
            # As stpsf: wavelengths and weights of the PSF, in place of a spectrum and a filter.
            given["source"] = None
            given["bandpass"] = Bandpass.of(source["wavelengths"], source["weights"])
        return given

    def _extensions(
        self,
        normalize: str,
        opd: Value | None,
        parameters: Mapping[str, Value],
        options: Mapping[str, Any],
    ) -> fits.HDUList:
        """The PSF with the extensions and keywords of stpsf, for two of its `options`."""
        factor = self.detector.oversample
        (primary,) = poppy_psf(self, normalize, opd, **parameters)
        header = primary.header
        header["EXTNAME"] = ("OVERSAMP", "This extension is oversampled.")
        now = datetime.datetime.now(datetime.UTC)
        header["DATE"] = (f"{now:%Y-%m-%dT%H:%M:%S}", "Date of calculation")
        setup = self.setup
        for name, (key, comment) in _SETUP_KEYWORDS.items():
            if key in setup:
                header[name] = (setup[key], comment)
        sampling = self.recipe.get("occulter_sampling")
        if sampling is not None:
            header["OVERSAMP"] = (sampling, "Oversampling factor for FFTs in computation")
        if "filter" in setup:
            header["INSTRUME"] = ("NIRCam", "Instrument")
        header["PUPILOPD"] = ("NONE - perfect telescope! " if opd is None else "OPD of the call",
                              "Pupil OPD source")  # fmt: skip
        ny, nx = self.detector.shape
        pixels = primary.data.reshape(ny, factor, nx, factor).sum(axis=(1, 3))
        detector = fits.ImageHDU(pixels, header.copy())
        detector.header["EXTNAME"] = "DET_SAMP"
        detector.header["OVERSAMP"] = (1, "These data are rebinned to detector pixels")
        detector.header["CALCSAMP"] = (factor, "This much oversampling used in calculation")
        detector.header["PIXELSCL"] *= factor
        return fits.HDUList([primary, detector])
