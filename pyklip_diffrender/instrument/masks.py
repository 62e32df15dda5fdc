"""NIRCam's round coronagraph masks: profile, filters, pixel scales, places on the detector."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from scipy.special import j1
from torch import Tensor

from pyklip_diffrender.errors import IncompatibleSetupError

__all__ = [
    "ROUND_MASKS",
    "RoundMask",
    "filter_shift",
    "mask_center",
    "mask_of_header",
    "require_mask_and_filter",
]

_SECOND_ZERO_OF_J1 = 7.015586669815619

SHORT_WAVE = ("F182M", "F187N", "F200W", "F210M", "F212N")
LONG_WAVE = (
    "F250M", "F277W", "F300M", "F322W2", "F335M", "F356W", "F360M", "F410M", "F430M", "F444W",
    "F460M", "F480M",
)  # fmt: skip


@dataclass(frozen=True)
class RoundMask:
    """A round occulter of NIRCam's module A and its channel.

    Its amplitude transmission is ``t = 1 - (2 J1(s) / s)^2`` with ``s = sigma r`` up to the second
    zero of J1, and 1 beyond (Krist et al., "The JWST/NIRCam coronagraph: mask design and
    fabrication", Proc. SPIE 7440, 2009).

    Attributes
    ----------
    name : str
    sigma : float
        Scale of the profile, per arcsec (stpsf 2.2.0, class ``NIRCam_BandLimitedCoron``).
    filters : tuple of str
        Filters of its channel.
    pixelscale : float
        arcsec per pixel, the square scale that stpsf 2.2.0 uses before distortion.
    siaf_pixelscale : tuple of float
        arcsec per pixel in x and y at the reference point of the mask's aperture (SIAF,
        PRDOPSSOC-075).
    siaf_shear : float
        Growth of the ideal y with the ideal x, from the SIAF polynomial: the mean over +-40
        pixels about the reference point.
    """

    name: str
    sigma: float
    filters: tuple[str, ...]
    pixelscale: float
    siaf_pixelscale: tuple[float, float]
    siaf_shear: float

    @property
    def short_wave(self) -> bool:
        """Whether the mask belongs to the short-wave channel."""
        return self.filters is SHORT_WAVE

    @property
    def radius(self) -> float:
        """Radius beyond which the mask is clear, arcsec."""
        return _SECOND_ZERO_OF_J1 / self.sigma

    def complement(self, x: Tensor, y: Tensor) -> Tensor:
        """Amplitude that the mask removes, 1 - t.

        It is computed directly, because 1 - t by subtraction loses its digits near the centre.

        Parameters
        ----------
        x, y : Tensor
            Angles from the centre of the mask, arcsec, broadcast against each other.
        """
        s = self.sigma * torch.hypot(*torch.broadcast_tensors(x, y))
        safe = torch.where(s > 0, s, 1.0)
        jinc = torch.where(s > 0, 2 * torch.as_tensor(j1(safe.numpy())) / safe, 1.0)
        return torch.where(s < _SECOND_ZERO_OF_J1, jinc**2, 0.0)


ROUND_MASKS = {
    mask.name: mask
    for mask in (
        RoundMask("MASK210R", 5.253, SHORT_WAVE, 0.030673395, (0.03053298, 0.03081381), -0.0074),
        RoundMask("MASK335R", 3.2927866, LONG_WAVE, 0.062424185, (0.0620165, 0.0628319), -0.0049),
        RoundMask("MASK430R", 2.58832, LONG_WAVE, 0.06247122, (0.06205534, 0.0628871), -0.0010),
    )
}
"""The masks of `nircam_coronagraph` by name."""


def require_mask_and_filter(mask: str | None, name: str) -> RoundMask:
    """Check a combination of image mask and filter, and return the mask.

    Parameters
    ----------
    mask : str or None
        Image mask. None gives the usual mask of the filter's channel (MASK210R or MASK335R), for
        its geometry.
    name : str
        Filter, in any case.

    Raises
    ------
    IncompatibleSetupError
        For an unknown mask or filter, and for a mask with a filter of the other channel.
    """
    legal = "; ".join(f"{m.name} with {', '.join(m.filters)}" for m in ROUND_MASKS.values())
    if mask is not None and mask not in ROUND_MASKS:
        raise IncompatibleSetupError(
            f"image_mask: got {mask!r}, expected None or one of the round masks: {legal}. Bar "
            "masks come through from_webbpsf"
        )
    for candidate in (mask,) if mask else ("MASK210R", "MASK335R"):
        if name.upper() in ROUND_MASKS[candidate].filters:
            return ROUND_MASKS[candidate]
    raise IncompatibleSetupError(
        f"filter: got {name!r} with image mask {mask!r}, which do not go together. Legal "
        f"combinations are {legal}"
    )


def mask_of_header(value: object) -> str:
    """Return the name of an image mask, as ``CORONMSK`` has it, without the module: MASK335R.

    Headers name NIRCam's module A with the mask: MASKA335R.
    """
    return str(value).strip().upper().replace("MASKA", "MASK")


# J. Leisenring's measurements in flight, as in spaceKLIP's resources crpix_jarron.json and
# filter_shifts_jarron.json (commit 07eaf7d); the centres count from 1.
_CENTERS = {
    "NRCA2_MASK210R": (321.8, 331.5),
    "NRCA2_FULL_MASK210R": (712.8, 1516.5),
    "NRCA5_MASK335R": (150.2, 174.6),
    "NRCA5_FULL_MASK335R": (641.2, 1675.6),
    "NRCA5_MASK430R": (151.3, 175.2),
    "NRCA5_FULL_MASK430R": (964.3, 1676.2),
    "NRCA5_MASKLWB": (151.3, 175.2),
}
_SHIFTS = {
    "F182M": (-0.071, -1.365),
    "F187N": (-0.108, -1.216),
    "F200W": (2.543, 4.119),
    "F210M": (0.0, 0.0),
    "F212N": (0.037, 0.344),
    "F250M": (0.056, -2.038),
    "F300M": (0.086, -0.526),
    "F322W2": (0.198, -0.583),
    "F335M": (0.0, 0.0),
    "F356W": (0.783, -0.159),
    "F360M": (0.204, -0.087),
    "F410M": (0.209, -0.132),
    "F430M": (0.196, -0.182),
    "F444W": (0.177, -0.205),
    "F460M": (0.237, -0.766),
    "F480M": (0.226, -0.899),
}


def mask_center(aperture: str) -> tuple[float, float]:
    """Where a mask's centre is imaged on the detector in F335M (short wave: F210M).

    Parameters
    ----------
    aperture : str
        Aperture as SIAF names it, such as "NRCA5_MASK335R", the 320 x 320 subarray, or
        "NRCA5_FULL_MASK335R", the full detector.

    Returns
    -------
    tuple of float
        x, y in pixels of the science frame, counted from 0 at the middle of the first pixel.
        SIAF and FITS (``CRPIX``) count from 1. In another filter add `filter_shift`.

    Raises
    ------
    IncompatibleSetupError
        For an aperture that is not in the table.
    """
    if aperture not in _CENTERS:
        raise IncompatibleSetupError(
            f"aperture: got {aperture!r}, expected one of {', '.join(_CENTERS)}"
        )
    x, y = _CENTERS[aperture]
    return x - 1, y - 1


def filter_shift(name: str) -> tuple[float, float]:
    """How far the image of the mask, and of the sky with it, lies from where it is in F335M.

    The filters' substrates and the coronagraph's wedge displace the image by up to two pixels.

    Parameters
    ----------
    name : str
        Filter. Those of the short-wave channel are relative to F210M.

    Returns
    -------
    tuple of float
        x, y in pixels of the filter's channel, science frame.

    Raises
    ------
    IncompatibleSetupError
        For a filter whose shift was not measured.
    """
    if name.upper() not in _SHIFTS:
        raise IncompatibleSetupError(
            f"filter: the image shift was measured for {', '.join(_SHIFTS)}, not for {name!r}"
        )
    return _SHIFTS[name.upper()]
