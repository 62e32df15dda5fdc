"""NIRCam's round coronagraph from embedded tables: no download needed."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import torch
from numpy.polynomial import Polynomial
from numpy.typing import ArrayLike
from scipy.special import j1
from torch import Tensor

from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.instrument.jwst import jwst_pupil, maskrnd_openings
from pyklip_diffrender.instrument.spectrum import filter_bandpass, filter_throughput
from pyklip_diffrender.io.files import embedded_table
from pyklip_diffrender.optics.bandpass import Bandpass
from pyklip_diffrender.optics.detector import Detector
from pyklip_diffrender.optics.grid import JWST_DIAMETER, samples_for_field
from pyklip_diffrender.optics.planes import (
    CompactOcculter,
    EntrancePupil,
    InternalAberration,
    LyotStop,
    Plane,
)
from pyklip_diffrender.optics.system import OpticalSystem
from pyklip_diffrender.optics.zernike import noll_indices

__all__ = [
    "MASK335R_RADIUS",
    "MASK335R_SIGMA",
    "NIRCAM_LW_PIXELSCALE",
    "SIAF_PIXELSCALE",
    "SIAF_SHEAR",
    "internal_wavefront_error",
    "mask335r_complement",
    "nircam_coronagraph",
]

NIRCAM_LW_PIXELSCALE = 0.062424185
"""arcsec per pixel, the square scale that stpsf 2.2.0 uses before distortion."""

SIAF_PIXELSCALE = (0.0620165, 0.0628319)
"""arcsec per pixel in x and y at the reference point of NRCA5_MASK335R (SIAF PRDOPSSOC-075)."""

SIAF_SHEAR = -0.0049
"""Growth of the ideal y with the ideal x on NRCA5_MASK335R, from the SIAF polynomial (the mean
over +-40 pixels about the reference point, PRDOPSSOC-075)."""

MASK335R_SIGMA = 3.2927866
"""Scale of the occulter's profile, per arcsec (stpsf 2.2.0)."""

_SECOND_ZERO_OF_J1 = 7.015586669815619

MASK335R_RADIUS = _SECOND_ZERO_OF_J1 / MASK335R_SIGMA
"""arcsec; the mask is clear beyond."""


def mask335r_complement(x: Tensor, y: Tensor) -> Tensor:
    """1 - t of MASK335R, where t = 1 - (2 J1(s) / s)^2 and s = sigma r up to J1's second zero.

    Computed directly, for 1 - t by subtraction loses its digits near the centre. Krist et al.,
    "The JWST/NIRCam coronagraph: mask design and fabrication", Proc. SPIE 7440 (2009).

    Parameters
    ----------
    x, y : Tensor
        arcsec, broadcast against each other.
    """
    s = MASK335R_SIGMA * torch.hypot(*torch.broadcast_tensors(x, y))
    safe = torch.where(s > 0, s, 1.0)
    jinc = torch.where(s > 0, 2 * torch.as_tensor(j1(safe.numpy())) / safe, 1.0)
    return torch.where(s < _SECOND_ZERO_OF_J1, jinc**2, 0.0)


# Wavelength dependence of the coronagraph optics, as in stpsf 2.2.0's class
# NIRCamFieldAndWavelengthDependentAberration: defocus of the long-wave camera (R. Telfer's
# design model, m rms of Noll 4) and tilt from the dispersion of the coronagraph's wedge
# (m rms of Noll 3), both in the exit pupil; polynomials in micron, lowest order first.
_FOCUS = Polynomial([1.641692934, 0.986462016, -1.100964635, 0.175718713]) / -1.09746e7
_WEDGE_TILT = Polynomial([12515.1242, -8683.2786, 1939.0256, -134.9596]) * 1e-9


class _Chromatic:
    """Focus and wedge tilt against wavelength, relative to a reference wavelength.

    In the exit pupil the OPD is ``- focus(lambda) Z4 + tilt(lambda) Z3``; y is inverted in the
    entrance pupil, which changes the sign of Z3.
    """

    def __init__(self, reference: float) -> None:
        self.reference = reference

    def __call__(self, wavelength: float) -> dict[int, float]:
        now, then = wavelength * 1e6, self.reference * 1e6
        return {
            3: float(-(_WEDGE_TILT(now) - _WEDGE_TILT(then))),
            4: float(-(_FOCUS(now) - _FOCUS(then))),
        }


def internal_wavefront_error(flip: bool = False) -> Tensor:
    """NIRCam's internal wavefront error near MASK335R, Noll coefficients in m, (36,).

    Parameters
    ----------
    flip : bool
        The tabulated map is in the exit pupil's orientation, y inverted with respect to the
        entrance pupil's. stpsf from 2.2.0 on flips the coronagraphic map vertically before it
        uses it; True does the same.

    Returns
    -------
    Tensor, (36,), float64
        For the entrance-pupil orientation used here.
    """
    exit_pupil = torch.tensor(_internal_zernikes(), dtype=torch.float64) * 1e-9
    if flip:
        return exit_pupil
    return exit_pupil * _parity_in_y(len(exit_pupil))


@lru_cache(maxsize=1)
def _internal_zernikes() -> tuple[float, ...]:
    """The tabulated coefficients, nm; reading the table takes longer than an image."""
    return tuple(embedded_table("nircam_si_zernikes")["coefficient"].tolist())


def _parity_in_y(count: int) -> Tensor:
    """-1 for the Zernikes that change sign with y (Noll sines: odd indices with m > 0)."""
    return torch.tensor(
        [-1.0 if noll_indices(j)[1] < 0 else 1.0 for j in range(1, count + 1)],
        dtype=torch.float64,
    )


@lru_cache(maxsize=4)
def _pupil(npix: int, segment_gap: float | None) -> Tensor:
    return jwst_pupil(npix, segment_gap)


def nircam_coronagraph(
    filter: str = "F444W",
    *,
    fov_pixels: int | tuple[int, int] | None = None,
    fov_arcsec: float | None = None,
    oversample: int = 1,
    monochromatic: float | None = None,
    nlambda: int = 9,
    source: float | tuple[ArrayLike, ArrayLike] = 5700.0,
    pixelscale: float | tuple[float, float] = NIRCAM_LW_PIXELSCALE,
    shear: float = 0.0,
    image_mask: str | None = "MASK335R",
    pupil_mask: str | None = "MASKRND",
    si_wfe: bool | ArrayLike = True,
    flip_si_wfe: bool = False,
    chromatic_reference: float | None = None,
    segment_gap: float | None = None,
    npix: int = 1024,
    occulter_sampling: float | None = None,
    route: str = "auto",
    dtype: torch.dtype = torch.float64,
    device: str | torch.device = "cpu",
) -> OpticalSystem:
    """NIRCam's MASK335R / MASKRND coronagraph as a differentiable system.

    Parameters
    ----------
    filter : str
        Long-wave filter. Its bandpass is used unless `monochromatic` is given.
    fov_pixels : int or (ny, nx), optional
        Detector pixels; default 80.
    fov_arcsec : float, optional
        In place of `fov_pixels`.
    oversample : int
        Samples per pixel along each axis; pixels are their mean. 1 samples pixel centres.
    monochromatic : float, optional
        A single wavelength, m.
    nlambda : int
        Wavelengths across the filter.
    source : float or (wavelengths, photons)
        Blackbody temperature in K, or a spectrum, see `spectrum.filter_bandpass`.
    pixelscale : float or (x, y)
        arcsec; `SIAF_PIXELSCALE` for real frames, whose pixels are not square on the sky.
    shear : float
        See `Detector`; `SIAF_SHEAR` for real frames.
    image_mask : "MASK335R" or None
        None leaves the occulter out (a planet far from the star).
    pupil_mask : "MASKRND" or None
    si_wfe : bool or (36,) array
        Include the instrument's internal wavefront error, or these Noll coefficients (m, exit
        pupil).
    flip_si_wfe : bool
        See `internal_wavefront_error`.
    chromatic_reference : float, optional
        Wavelength (m) at which the wedge tilt and the focus change are zero: default the mean
        wavelength, so that the star stays on the axis. stpsf has 3.35 um for the tilt.
    segment_gap : float, optional
        Width of the gaps between mirror segments, m; default that of the embedded outlines.
    npix : int
        Samples across the pupil.
    occulter_sampling : float, optional
        Cells per lambda/D in the occulter's disc: at least so many by the route "lattice" (2
        unless given), just so many by the route "planes" (4 unless given).
    route : "auto", "lattice" or "planes"
        See `OpticalSystem`.
    dtype : torch.dtype
        float64 or float32.
    device : str or torch.device

    Returns
    -------
    OpticalSystem

    Raises
    ------
    IncompatibleSetupError
        For a filter, mask or wavelength that does not go with this coronagraph, or a field so wide
        that the image of a pupil of `npix` samples repeats inside it.
    """
    recipe: dict[str, Any] = {k: v for k, v in locals().items() if k != "recipe"}
    if image_mask not in ("MASK335R", None) or pupil_mask not in ("MASKRND", None):
        raise IncompatibleSetupError(
            f"image_mask {image_mask!r} with pupil_mask {pupil_mask!r}: the embedded tables hold "
            "MASK335R (or None) and MASKRND (or None). Other masks come through from_webbpsf"
        )
    wavelengths, _ = filter_throughput(filter)
    if monochromatic is None:
        bandpass = filter_bandpass(filter, nlambda, source)
    else:
        low, high = float(wavelengths[0]), float(wavelengths[-1])
        if not low <= monochromatic <= high:
            raise IncompatibleSetupError(
                f"monochromatic: {monochromatic:.4g} m is outside {filter} ({low:.4g} to "
                f"{high:.4g} m). Wavelengths are in metres"
            )
        bandpass = Bandpass((float(monochromatic),), (1.0,))
    if dtype not in (torch.float32, torch.float64):
        raise IncompatibleSetupError(f"dtype: got {dtype}, expected torch.float32 or float64")

    scale = (pixelscale, pixelscale) if isinstance(pixelscale, int | float) else pixelscale
    shape = _field_of_view(fov_pixels, fov_arcsec, scale)
    field = max(shape[1] * scale[0], shape[0] * scale[1])
    needed = samples_for_field(field, min(bandpass.wavelengths))
    if npix < needed:
        raise IncompatibleSetupError(
            f"npix: got {npix} samples across the pupil, whose image repeats inside the field of "
            f"{field:.3g} arcsec; expected npix at least {needed}, or a smaller field"
        )
    where = torch.device(device)
    planes: list[Plane] = []
    if image_mask is not None:
        planes.append(
            CompactOcculter(
                mask335r_complement,
                MASK335R_RADIUS,
                occulter_sampling,
                JWST_DIAMETER,
                dtype,
                where,
                name=image_mask,
            )
        )
    if pupil_mask is not None:
        planes.append(
            LyotStop(maskrnd_openings(), npix, JWST_DIAMETER, dtype, where, name=pupil_mask)
        )
    if si_wfe is not False:
        coefficients = internal_wavefront_error(flip_si_wfe)
        if si_wfe is not True:
            given = torch.as_tensor(si_wfe, dtype=torch.float64)
            coefficients = given if flip_si_wfe else given * _parity_in_y(len(given))
        chromatic = _Chromatic(chromatic_reference or bandpass.mean_wavelength)
        planes.append(
            InternalAberration(
                coefficients, JWST_DIAMETER, dtype, where, chromatic, name="NIRCam internal WFE"
            )
        )
    return OpticalSystem(
        EntrancePupil(_pupil(npix, segment_gap).to(where), JWST_DIAMETER, dtype, name="JWST pupil"),
        planes,
        Detector(shape, scale, oversample, dtype, where, shear),
        bandpass,
        recipe=recipe,
        remake=nircam_coronagraph,
        route=route,
    )


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
