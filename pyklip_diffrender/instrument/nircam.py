"""NIRCam's coronagraph from embedded tables, without downloads."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from numbers import Integral
from typing import Any

import torch
from astropy import units as u
from numpy.polynomial import Polynomial
from numpy.typing import ArrayLike
from torch import Tensor

from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.instrument.masks import (
    LYOT_STOPS,
    BarMask,
    DetectorPlace,
    detector_place,
    jwst_pupil,
    lyot_openings,
    require_mask,
)
from pyklip_diffrender.instrument.spectrum import filter_bandpass, filter_throughput
from pyklip_diffrender.io.files import embedded_table
from pyklip_diffrender.io.units import Bound, require_shape, to_metres, to_number, to_pair
from pyklip_diffrender.optics.bandpass import Bandpass
from pyklip_diffrender.optics.grid import JWST_DIAMETER, noll_indices, samples_for_field
from pyklip_diffrender.optics.planes import (
    CompactOcculter,
    Detector,
    EntrancePupil,
    InternalAberration,
    LyotStop,
    Plane,
)
from pyklip_diffrender.optics.propagation import Value
from pyklip_diffrender.optics.system import InstrumentSystem
from pyklip_diffrender.parameters import OPTICAL_PARAMETERS

# NIRCam's internal wavefront error behind the Lyot stop, and its dependence on wavelength.
#
# Tables are in the orientation of the exit pupil, in which y is inverted. Functions return the
# orientation of the entrance pupil.

# Dependence on wavelength as in stpsf 2.2.0's NIRCamFieldAndWavelengthDependentAberration: defocus
# of the camera (R. Telfer's design model, m rms of Noll 4) and tilt from the dispersion of the
# coronagraph's wedge (m rms of Noll 3), both in the exit pupil; polynomials in micron, lowest
# order first, for the (short, long) wave channel.
_FOCUS = (
    Polynomial(
        [-59.64330811, 265.843112, -465.9818413, 415.9031962, -201.5444129, 50.62919436,
         -5.169185169]
    ) / -1.09746e7,
    Polynomial([1.641692934, 0.986462016, -1.100964635, 0.175718713]) / -1.09746e7,
)  # fmt: skip
_WEDGE_TILT = (
    Polynomial([3240.7584, -1620.3792]) * 1e-9,
    Polynomial([12515.1242, -8683.2786, 1939.0256, -134.9596]) * 1e-9,
)
_TABULATED_WAVELENGTHS_MICRON = (2.12, 3.23)
"""Wavelengths of the tabulated wavefront error, micron."""


class ChromaticAberration:
    """Focus and wedge tilt in addition to the tabulated wavefront error.

    The tilt is zero at the wavelength `reference`, m.
    """

    def __init__(self, reference: float, short_wave: bool = False) -> None:
        self.reference, self.short_wave = reference, short_wave

    def __call__(self, wavelength: float) -> dict[int, float]:
        """Coefficients to add at a wavelength (m): Noll index to m rms."""
        # In the exit pupil the additional OPD is -(focus(lambda) - focus(tabulated)) Z4 +
        # (tilt(lambda) - tilt(reference)) Z3; y is inverted in the entrance pupil, which changes
        # the sign of Z3.
        channel = 0 if self.short_wave else 1
        focus, tilt = _FOCUS[channel], _WEDGE_TILT[channel]
        return {
            3: float(-(tilt(wavelength * 1e6) - tilt(self.reference * 1e6))),
            4: float(-(focus(wavelength * 1e6) - focus(_TABULATED_WAVELENGTHS_MICRON[channel]))),
        }


def internal_wavefront_error(
    mask: str = "MASK335R", flip: bool = True, *, short_wave: bool = False
) -> Tensor:
    """NIRCam's internal wavefront error at a mask: Noll coefficients in m, (36,), float64.

    The coefficients are in entrance-pupil orientation, of the map flipped vertically; with `flip`
    False, of the map in the tabulated orientation of the exit pupil, as in stpsf before 2.2.0.
    """
    # stpsf flips the map from 2.2.0 on, because that matches images in flight better. The flip
    # cancels the inversion of y between exit and entrance pupil.
    exit_pupil = torch.tensor(_table(mask, short_wave), dtype=torch.float64) * 1e-9
    return exit_pupil if flip else exit_pupil * parity_in_y(len(exit_pupil))


@lru_cache(maxsize=4)
def _table(mask: str, short_wave: bool) -> tuple[float, ...]:
    """The tabulated coefficients, nm; cached because reading them takes longer than an image."""
    channel = "SW" if short_wave else "LW"
    return tuple(embedded_table("nircam_si_zernikes")[f"{channel} {mask}"].tolist())


def parity_in_y(count: int) -> Tensor:
    """-1 for the Zernikes that change sign with y (the sines), otherwise 1."""
    return torch.tensor(
        [-1.0 if noll_indices(j)[1] < 0 else 1.0 for j in range(1, count + 1)],
        dtype=torch.float64,
    )


NIRCAM_LW_PIXELSCALE = 0.062424185
"""arcsec per pixel at MASK335R, the square scale that stpsf 2.2.0 uses before distortion."""

FLIGHT_ALIGNMENT: dict[str, Any] = {"lyot_shift": (-0.0127, 0.0068), "lyot_rotation": 0.567}
"""Alignment of the stop MASKRND in flight in the long-wave channel, for the argument `defaults`.

The shift is a fraction of the pupil's diameter, the rotation in degrees, both as the parameters of
`OpticalSystem`, in entrance-pupil orientation. K. Lawson's values for frames behind MASK335R, of
stpsf's options: pupil_shift_x -0.01347, pupil_shift_y -0.00762, pupil_rotation -0.567 deg
(github.com/kdlawson/Winnie, commit dbc7ca8). stpsf's pupil is upside down there, which changes the
signs of y and of the rotation, and poppy cuts shifts to whole samples of 1/1024. stpsf 2.2.0 itself
has the stop aligned. Alignment-only fits of this package to one frame each of three stars gave
shifts of -0.0109 to -0.0121 and 0.0040 to 0.0054 and rotations of 0.39 to 0.54 deg.
"""


def nircam_coronagraph(
    filter: str = "F444W",
    *,
    fov_pixels: int | tuple[int, int] | None = None,
    fov_arcsec: float | None = None,
    oversample: int = 1,
    monochromatic: float | None = None,
    nlambda: int = 9,
    source: float | tuple[ArrayLike, ArrayLike] = 5700.0,
    pixelscale: float | tuple[float, float] | None = None,
    shear: float = 0.0,
    image_mask: str | None = "MASK335R",
    bar_place: str | None = None,
    pupil_mask: str | None = "auto",
    segment_gap: float | None = None,
    si_wfe: bool | ArrayLike = True,
    flip_si_wfe: bool = True,
    chromatic_reference: float | None = None,
    defaults: Mapping[str, Value] | None = None,
    npix: int = 1024,
    occulter_sampling: float | None = None,
    bar_reach: float | None = None,
    route: str = "auto",
    dtype: torch.dtype = torch.float64,
    device: str | torch.device = "cpu",
) -> InstrumentSystem:
    """NIRCam's coronagraph as a differentiable system.

    Lengths, angles and temperatures may be Quantities.

    Parameters
    ----------
    filter : str
        Filter of the short-wave channel (F182M, F187N, F200W, F210M, F212N) or of the long-wave
        channel (F250M to F480M), which decides on the detector. Its bandpass is used unless
        `monochromatic` is given.
    fov_pixels : int or (ny, nx), optional
        Detector pixels; default 80.
    fov_arcsec : float, optional
        Field of view in place of `fov_pixels`.
    oversample : int
        Samples per pixel along each axis; pixels are their mean. 1 samples pixel centres.
    monochromatic : float, optional
        A single wavelength, m.
    nlambda : int
        Wavelengths across the filter.
    source : float or (wavelengths, photons)
        Blackbody temperature in K, or a spectrum, see `spectrum.filter_bandpass`.
    pixelscale : float or (x, y), optional
        arcsec; default the square scale of stpsf at the mask. For real frames, whose pixels are
        not square on the sky, ``detector_place(mask, filter).siaf_pixelscale``.
    shear : float
        See `Detector`; for real frames, ``detector_place(mask, filter).siaf_shear``.
    image_mask : str or None
        "MASK210R", "MASK335R", "MASK430R", or the bars "MASKSWB" and "MASKLWB", each with the
        filters of both channels, or None for no occulter (a planet far from the star).
    bar_place : str, optional
        Where along a bar the star is: at the fiducial of a filter, such as "F460M", at the
        "NARROW" end, or in the middle, "-". Default the fiducial of `filter`, or the middle if
        `filter` is of the other channel.
    pupil_mask : "auto", "MASKRND", "MASKBAR" or None
        Lyot stop; "auto" is the stop of the mask.
    segment_gap : float, optional
        Width of the gaps between mirror segments, m; default as in the embedded outlines.
    si_wfe : bool or (36,) array
        Include the instrument's internal wavefront error at the mask, or Noll coefficients for it
        (m, orientation of the exit pupil, for a wavelength of 3.23 um; short wave 2.12 um).
    flip_si_wfe : bool
        See `internal_wavefront_error`.
    chromatic_reference : float, optional
        Wavelength (m) at which the wedge's tilt is zero. Default the mean wavelength, so that the
        star is on the axis; in stpsf 3.35 um (short wave 2.10 um).
    defaults : mapping of str to value, optional
        Values of parameters for calls that do not give them, such as `FLIGHT_ALIGNMENT`; see
        `OpticalSystem`.
    npix : int
        Samples across the pupil.
    occulter_sampling : float, optional
        Cells per lambda/D in the occulter's disc: the minimum for the route "lattice" (default 2),
        the exact number for the route "planes" (default 4).
    bar_reach : float, optional
        Distance from the star up to which a bar is modelled, arcsec; default all of it. With 4
        arcsec, images of 56 pixels in F210M change by 5e-4 of their peak.
    route : "auto", "lattice" or "planes"
        See `OpticalSystem`.
    dtype : torch.dtype
        float64 or float32.
    device : str or torch.device

    Returns
    -------
    InstrumentSystem

    Raises
    ------
    IncompatibleSetupError
        For an incompatible filter, mask or wavelength, or a field so wide that the image of a pupil
        of `npix` samples repeats inside it.

    Examples
    --------
    >>> import pyklip_diffrender as dr
    >>> model = dr.nircam_coronagraph("F444W", monochromatic=4.5e-6, npix=128, fov_pixels=24)
    >>> tuple(model().shape)
    (24, 24)
    """
    recipe = _in_plain_numbers(dict(locals()))
    place = detector_place(image_mask, filter, bar_place)
    if pupil_mask == "auto":
        recipe["pupil_mask"] = require_mask(place.mask).stop
    _require_supported(recipe)
    bandpass = _bandpass(recipe)
    detector = _detector(place, recipe)
    _require_samples(npix, place.period(bar_reach) if image_mask else 0.0, detector, bandpass)
    amplitude = jwst_pupil(npix, recipe["segment_gap"]).to(detector.device)
    return InstrumentSystem(
        EntrancePupil(amplitude, JWST_DIAMETER, dtype, name="JWST pupil"),
        _planes(place, bandpass, recipe),
        detector,
        bandpass,
        recipe=recipe,
        remake=nircam_coronagraph,
        route=route,
        defaults=defaults,
    )


def _in_plain_numbers(recipe: dict[str, Any]) -> dict[str, Any]:
    """The arguments with lengths in m, angles in arcsec and temperatures in K."""
    bounds: tuple[tuple[str, u.UnitBase, Bound], ...] = (
        ("monochromatic", u.m, "positive"),
        ("fov_arcsec", u.arcsec, "positive"),
        ("segment_gap", u.m, "not negative"),
        ("bar_reach", u.arcsec, "positive"),
        ("chromatic_reference", u.m, "positive"),
    )
    for name in ("npix", "nlambda", "oversample"):
        value = recipe[name]
        whole = isinstance(value, Integral) and not isinstance(value, bool)
        if value is not None and not (whole and value >= 1):
            raise IncompatibleSetupError(
                f"{name}: got {value!r}, expected a whole number, 1 or more"
            )
    recipe["shear"] = to_number(recipe["shear"], "", "shear")
    for name, unit, bound in bounds:
        if recipe[name] is not None:
            recipe[name] = to_number(recipe[name], unit, name, bound)
    if recipe["pixelscale"] is not None:
        recipe["pixelscale"] = to_pair(recipe["pixelscale"], u.arcsec, "pixelscale", "positive")
    if callable(recipe["source"]):
        raise IncompatibleSetupError(
            f"source: got a {type(recipe['source']).__name__}, expected a temperature in K or "
            "wavelengths and photons; of a spectrum of synphot, "
            "source=(spectrum.waveset, spectrum(spectrum.waveset))"
        )
    if not isinstance(recipe["source"], tuple):
        recipe["source"] = to_number(recipe["source"], u.K, "source", "positive")
    if not isinstance(recipe["si_wfe"], bool | Tensor):
        recipe["si_wfe"] = to_metres(recipe["si_wfe"], "si_wfe")
        require_shape(recipe["si_wfe"], (36,), "si_wfe", "Noll coefficients from piston on")
    recipe["defaults"] = dict(recipe["defaults"] or {})  # The caller may change theirs.
    unknown = sorted(set(recipe["defaults"]) - {each.name for each in OPTICAL_PARAMETERS})
    if unknown:
        raise IncompatibleSetupError(
            f"defaults: got {', '.join(unknown)}, expected some of "
            f"{', '.join(each.name for each in OPTICAL_PARAMETERS)}"
        )
    return recipe


def _require_supported(recipe: Mapping[str, Any]) -> None:
    if recipe["pupil_mask"] not in (None, *LYOT_STOPS):
        raise IncompatibleSetupError(
            f"pupil_mask: got {recipe['pupil_mask']!r}, expected 'auto', 'MASKRND', 'MASKBAR' or "
            "None"
        )
    if recipe["dtype"] not in (torch.float32, torch.float64):
        raise IncompatibleSetupError(
            f"dtype: got {recipe['dtype']}, expected torch.float32 or float64"
        )


def _bandpass(recipe: Mapping[str, Any]) -> Bandpass:
    name, monochromatic = recipe["filter"], recipe["monochromatic"]
    if monochromatic is None:
        return filter_bandpass(name, recipe["nlambda"], recipe["source"])
    wavelengths, _ = filter_throughput(name)
    low, high = float(wavelengths[0]), float(wavelengths[-1])
    if not low <= monochromatic <= high:
        raise IncompatibleSetupError(
            f"monochromatic: {monochromatic:.4g} m is outside {name} ({low:.4g} to "
            f"{high:.4g} m). Wavelengths are in metres"
        )
    return Bandpass((monochromatic,), (1.0,))


def _detector(place: DetectorPlace, recipe: Mapping[str, Any]) -> Detector:
    scale = to_pair(recipe["pixelscale"] or place.pixelscale, u.arcsec, "pixelscale")
    shape = _field_of_view(recipe["fov_pixels"], recipe["fov_arcsec"], scale)
    return Detector(
        shape,
        scale,
        recipe["oversample"],
        recipe["dtype"],
        torch.device(recipe["device"]),
        recipe["shear"],
    )


def _require_samples(npix: int, period: float, detector: Detector, bandpass: Bandpass) -> None:
    (ny, nx), (x, y) = detector.shape, detector.pixelscale
    field = max(nx * x, ny * y, period)
    needed = samples_for_field(field, min(bandpass.wavelengths))
    if npix < needed:
        raise IncompatibleSetupError(
            f"npix: got {npix} samples across the pupil, whose image repeats inside the field of "
            f"{field:.3g} arcsec; expected npix at least {needed}, or a smaller field"
        )


def _planes(place: DetectorPlace, bandpass: Bandpass, recipe: Mapping[str, Any]) -> list[Plane]:
    """The planes between the entrance pupil and the detector: occulter, stop, aberration."""
    dtype, device = recipe["dtype"], torch.device(recipe["device"])
    planes: list[Plane] = []
    if recipe["image_mask"] is not None:
        mask, sampling = require_mask(place.mask), recipe["occulter_sampling"]
        if isinstance(mask, BarMask):
            mask = mask.at(place.offset, recipe["bar_reach"])
        planes.append(
            CompactOcculter(
                mask.complement, mask.reach, sampling, JWST_DIAMETER, dtype, device, mask.name
            )
        )
    if recipe["pupil_mask"] is not None:
        planes.append(
            LyotStop(
                lyot_openings(recipe["pupil_mask"]),
                recipe["npix"],
                JWST_DIAMETER,
                dtype,
                device,
                recipe["pupil_mask"],
            )
        )
    if recipe["si_wfe"] is not False:
        reference = recipe["chromatic_reference"] or bandpass.mean_wavelength
        planes.append(
            InternalAberration(
                _internal_coefficients(place, recipe["si_wfe"], recipe["flip_si_wfe"]),
                JWST_DIAMETER,
                dtype,
                device,
                ChromaticAberration(reference, place.short_wave),
                name="NIRCam internal WFE",
            )
        )
    return planes


def _internal_coefficients(place: DetectorPlace, si_wfe: bool | ArrayLike, flip: bool) -> Tensor:
    if si_wfe is True:
        return internal_wavefront_error(place.mask, flip, short_wave=place.short_wave)
    coefficients = torch.as_tensor(si_wfe, dtype=torch.float64)
    return coefficients if flip else coefficients * parity_in_y(len(coefficients))


def _field_of_view(
    pixels: int | tuple[int, int] | None, arcsec: float | None, scale: tuple[float, float]
) -> tuple[int, int]:
    if pixels is not None and arcsec is not None:
        raise IncompatibleSetupError("give fov_pixels or fov_arcsec, not both")
    if arcsec is not None:
        return max(1, round(arcsec / scale[1])), max(1, round(arcsec / scale[0]))
    if pixels is None:
        return 80, 80
    shape = (pixels, pixels) if isinstance(pixels, int) else tuple(pixels)
    if min(shape) < 1:
        raise IncompatibleSetupError(f"fov_pixels: got {pixels}, expected at least 1")
    return shape[0], shape[1]
