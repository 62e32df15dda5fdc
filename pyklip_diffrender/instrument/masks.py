"""JWST's mirror, and NIRCam's Lyot stops and masks: outlines, profiles, and places on detectors."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Self

import numpy as np
import torch
from numpy.polynomial import Polynomial
from scipy.special import j1
from torch import Tensor

from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.io.files import embedded_table
from pyklip_diffrender.optics.grid import STAR_RADIUS, PupilGrid, polygon_coverage, widen_polygon

# The primary mirror and the Lyot stops, from embedded tables of their outlines. Orientation:
# entrance pupil, x along +V2 and y along +V3 (see `pyklip_diffrender.optics.grid`).

LYOT_STOPS = ("MASKRND", "MASKBAR")
"""The Lyot stops, in both channels."""

TABULATED_GAP = 7.68e-3
"""Distance between neighbouring segments of the embedded outlines, m."""


def _polygons(table: str, label: str, **where: str) -> dict[str, Tensor]:
    rows = embedded_table(table)
    for column, value in where.items():
        rows = rows[rows[column] == value]
    polygons = {}
    for name in dict.fromkeys(str(value) for value in rows[label]):
        chosen = rows[rows[label].astype(str) == name]
        polygons[name] = torch.from_numpy(
            np.stack([np.array(chosen["v2"]), np.array(chosen["v3"])], axis=1).astype(np.float64)
        )
    return polygons


@lru_cache(maxsize=1)
def jwst_segments() -> dict[str, Tensor]:
    """Outlines of the 18 primary-mirror segments, (vertices, 2) in m, by name."""
    return _polygons("jwst_primary_polygons", "name", kind="segment")


@lru_cache(maxsize=2)
def lyot_openings(stop: str) -> list[Tensor]:
    """Outlines of the 14 openings of one of `LYOT_STOPS`, (vertices, 2) in m at the primary."""
    return list(_polygons(f"nircam_{stop.lower()}_openings", "opening").values())


@lru_cache(maxsize=4)
def _mirror_coverage(grid: PupilGrid) -> Tensor:
    return polygon_coverage(list(jwst_segments().values()), grid)


def is_jwst_pupil(lit: Tensor, diameter: float) -> bool:
    """Whether an aperture is JWST's primary mirror, up to struts and gaps.

    `lit` are the samples that transmit light, (npix, npix); `diameter` is the array's side, m.
    """
    mirror = _mirror_coverage(PupilGrid.full(len(lit), diameter))
    lit, full = lit.cpu(), mirror > 0.99
    # Struts and gaps cover at most 4 % of the mirror. A round pupil that fills as much of it has at
    # least 2 % of its light elsewhere, with 64 samples or more.
    inside = int((lit & (mirror > 0)).sum()) > 0.99 * int(lit.sum())
    return inside and int((lit & full).sum()) > 0.95 * int(full.sum())


@lru_cache(maxsize=4)
def jwst_pupil(npix: int, segment_gap: float | None = None) -> Tensor:
    """Amplitude transmission of JWST's entrance pupil, (npix, npix) over 6.603464 m, float64.

    The transmission is the covered fraction of a pixel's area. `segment_gap` is the width of the
    gaps between the segments, m, by default 7.7 mm as in the embedded outlines.
    """
    # Struts of the secondary mirror as designed, stpsf's pupil "RevW". A map of 1024 samples and
    # these outlines differ by 0.1 to 0.2 %.
    # Where struts cross segment edges inside a pixel, the product of coverages is approximate, so
    # small arrays are averages of a fine one.
    fine = npix * max(1, -(-1024 // npix))
    grid = PupilGrid.full(fine)
    outlines = list(jwst_segments().values())
    if segment_gap is not None:
        # A gap becomes narrower by twice as much as each of the edges beside it moves outwards.
        growth = (TABULATED_GAP - segment_gap) / 2
        outlines = [widen_polygon(outline, growth) for outline in outlines]
    # Outlines without gaps overlap by up to a tenth of a millimetre where three of them meet.
    amplitude = polygon_coverage(outlines, grid).clamp(max=1.0)
    for strut in _polygons("jwst_primary_polygons", "name", kind="strut").values():
        amplitude = amplitude * (1 - polygon_coverage([strut], grid))
    return amplitude.reshape(npix, fine // npix, npix, fine // npix).mean(dim=(1, 3))


# The masks in the image.

_SECOND_ZERO_OF_J1 = 7.015586669815619

SHORT_WAVE = ("F182M", "F187N", "F200W", "F210M", "F212N")
LONG_WAVE = (
    "F250M", "F277W", "F300M", "F322W2", "F335M", "F356W", "F360M", "F410M", "F430M", "F444W",
    "F460M", "F480M",
)  # fmt: skip
FILTERS = SHORT_WAVE + LONG_WAVE
"""Filters that go with a Lyot stop. Filters of both channels go with every mask, because the two
channels take their frames at once."""


@dataclass(frozen=True)
class RoundMask:
    """A round occulter."""

    name: str
    sigma: float  # scale of the profile, per arcsec (stpsf 2.2.0, NIRCam_BandLimitedCoron)

    stop = "MASKRND"
    """Lyot stop that is made for the mask."""

    @property
    def radius(self) -> float:
        """Radius beyond which the mask is clear, arcsec."""
        return _SECOND_ZERO_OF_J1 / self.sigma

    @property
    def reach(self) -> tuple[float, float]:
        """Half the sides of the square beyond which the mask is clear, arcsec."""
        return self.radius, self.radius

    def complement(self, x: Tensor, y: Tensor) -> Tensor:
        """Amplitude that the mask removes, 1 - t, at x, y (broadcast) from its centre in arcsec."""
        # t = 1 - (2 J1(s) / s)^2 with s = sigma r up to the second zero of J1, and 1 beyond (Krist
        # et al., "The JWST/NIRCam coronagraph: mask design and fabrication", Proc. SPIE 7440,
        # 2009). 1 - t is computed directly, because by subtraction it loses its digits near the
        # centre.
        s = self.sigma * torch.hypot(*torch.broadcast_tensors(x, y))
        safe = torch.where(s > 0, s, 1.0)
        jinc = torch.where(s > 0, 2 * torch.as_tensor(j1(safe.numpy())) / safe, 1.0)
        return torch.where(s < _SECOND_ZERO_OF_J1, jinc**2, 0.0)


@dataclass(frozen=True)
class BarMask:
    """A bar of 20 arcsec along x that becomes wider in its middle part, a wedge."""

    name: str
    widens: int  # towards +x (1) or -x (-1), in the image
    # sigma, per arcsec, of the half width of the bar in lambda/D (stpsf 2.2.0, class
    # NIRCam_BandLimitedCoron).
    scale: Polynomial
    offset: float = 0.0  # x of the star from the middle of the bar, arcsec
    longest: float | None = None  # modelled up to this x from the star, arcsec; None is all

    stop = "MASKBAR"
    """Lyot stop that is made for the mask."""

    @property
    def reach(self) -> tuple[float, float]:
        """Half the sides of the rectangle about the star beyond which the mask is clear, arcsec."""
        # The mask is clear from s = sigma |y| = 2 pi on, which is farthest out where the bar is
        # widest.
        x = min(_HALF_BAR_ARCSEC + abs(self.offset), self.longest or math.inf)
        widest = self._width(torch.tensor([-x, x], dtype=torch.float64) + self.offset).max()
        return x, 2 * math.pi / float(self.scale(float(widest)))

    def complement(self, x: Tensor, y: Tensor) -> Tensor:
        """Amplitude that the mask removes, 1 - t, at x, y (broadcast) from the star in arcsec."""
        # t = 1 - (sin(s) / s)^2 with s = sigma(x) |y| up to 2 pi, and 1 beyond, and beyond the ends
        # of the bar (Krist et al., see `RoundMask`).
        x, y = torch.broadcast_tensors(x, y)
        on_bar = x + self.offset
        s = torch.as_tensor(self.scale(self._width(on_bar).numpy())) * y.abs()
        inside = (s < 2 * math.pi) & (on_bar.abs() <= _HALF_BAR_ARCSEC) & (x.abs() <= self.reach[0])
        return torch.where(inside, torch.sinc(s / math.pi) ** 2, 0.0)

    def _width(self, on_bar: Tensor) -> Tensor:
        """Half width at half maximum, lambda/D, at places along the bar, arcsec from its middle."""
        narrow, wide = _BAR_HALF_WIDTHS_LAMBDA_D
        along = 0.5 + self.widens * on_bar / (2 * _HALF_WEDGE_ARCSEC)
        return (narrow + (wide - narrow) * along).clamp(narrow, wide)

    def at(self, offset: float, longest: float | None = None) -> Self:
        """Return the mask with the star at another place, arcsec from the middle of the bar."""
        return replace(self, offset=offset, longest=longest)


_HALF_BAR_ARCSEC = 10.0
"""Half the length of a bar, arcsec."""

BEYOND_MASK_ARCSEC = (1.2, 1.2)
"""x, y from the star, arcsec, where the transmission of every mask is above 0.9: bars extend along
x."""

_HALF_WEDGE_ARCSEC = 7.5
"""Half the length of the part in which its width changes, arcsec."""

_BAR_HALF_WIDTHS_LAMBDA_D = (2.0, 6.0)
"""Half width at half maximum of the narrow and of the wide end, lambda/D."""

# Highest power first, as in stpsf.
_SHORT_BAR = (
    2.01210737e-04, -7.18758337e-03, 1.12381516e-01, -1.00877701e00, 5.72538509e00,
    -2.12943497e01, 5.18745152e01, -7.97815606e01, 7.02728734e01,
)  # fmt: skip
_LONG_BAR = (
    9.16195583e-05, -3.27354831e-03, 5.11960734e-02, -4.59674047e-01, 2.60963397e00,
    -9.70881273e00, 2.36585911e01, -3.63978587e01, 3.20703511e01,
)  # fmt: skip

MASKS: dict[str, RoundMask | BarMask] = {
    mask.name: mask
    for mask in (
        RoundMask("MASK210R", 5.253),
        RoundMask("MASK335R", 3.2927866),
        RoundMask("MASK430R", 2.58832),
        BarMask("MASKSWB", 1, Polynomial(_SHORT_BAR[::-1])),
        BarMask("MASKLWB", -1, Polynomial(_LONG_BAR[::-1])),
    )
}
"""The masks of `nircam_coronagraph` by name."""


FIELD = 20.2
"""Side of the square about a mask in which sources are seen past it, arcsec. The field is 20 arcsec
wide (JWST user documentation, "NIRCam Coronagraphic Occulting Masks and Lyot Stops") and the
subarrays SUB320 and SUB640 hold it; a frame of the whole detector shows other masks beyond."""


@dataclass(frozen=True)
class DetectorPlace:
    """Where a mask is imaged on a detector, and the pixels there."""

    mask: str
    # Place along a bar: a filter, for its fiducial, or "NARROW"; "-" is the middle.
    place: str
    # As SIAF names it: NRCA2 or NRCA4 (short wave), NRCA5 (long wave).
    detector: str
    # x, y of the mask on the full detector in F335M (short wave: F210M), pixels of the science
    # frame counted from 0 at the middle of the first one. In another filter add `filter_shift`.
    center: tuple[float, float]
    siaf_pixelscale: tuple[float, float]  # x, y, arcsec per pixel (SIAF, PRDOPSSOC-075)
    # Growth of the ideal y with the ideal x, from the SIAF polynomial: the mean over +-40 pixels.
    siaf_shear: float
    offset: float  # x of the place from the middle of a bar, arcsec

    @property
    def pixelscale(self) -> float:
        """Scale in arcsec per pixel, the square scale that stpsf 2.2.0 uses before distortion."""
        return sum(self.siaf_pixelscale) / 2

    def period(self, bar_reach: float | None = None) -> float:
        """Least period of the star's image, arcsec, for a copy of it not to touch a bar.

        For `bar_reach` see `nircam_coronagraph`.
        """
        # The copy of the star, of a radius of its own, one period away is then beyond the end of
        # the bar.
        mask = MASKS[self.mask]
        if isinstance(mask, RoundMask):
            return 0.0
        return mask.at(self.offset, bar_reach).reach[0] + STAR_RADIUS

    @property
    def header_detector(self) -> str:
        """The detector as headers name it (DETECTOR)."""
        return self.detector.replace("5", "LONG")

    @property
    def short_wave(self) -> bool:
        """Whether the detector is one of the short-wave channel."""
        return not self.detector.endswith("5")


@lru_cache(maxsize=1)
def _places() -> dict[tuple[str, str, bool], DetectorPlace]:
    places = (
        DetectorPlace(
            str(row["mask"]),
            str(row["place"]),
            str(row["detector"]),
            (float(row["x"]) - 1, float(row["y"]) - 1),
            (float(row["x_scale"]), float(row["y_scale"])),
            float(row["shear"]),
            float(row["offset"]),
        )
        for row in embedded_table("nircam_masks")
    )
    return {(each.mask, each.place, each.short_wave): each for each in places}


def is_short_wave(filter: str) -> bool:
    """Whether a filter is one of the short-wave channel.

    IncompatibleSetupError for a filter that does not go with the coronagraph.
    """
    if filter.upper() not in FILTERS:
        raise IncompatibleSetupError(
            f"filter: got {filter!r}, expected one that goes with the coronagraph: "
            f"{', '.join(SHORT_WAVE)} (short wave) or {', '.join(LONG_WAVE)} (long wave)"
        )
    return filter.upper() in SHORT_WAVE


def is_wide_band(filter: str) -> bool:
    """Whether a filter's band is wide, a quarter of its wavelength, and not medium or narrow."""
    return filter.upper().rstrip("2").endswith("W")


def require_mask(mask: str) -> RoundMask | BarMask:
    """Return the mask of this name; IncompatibleSetupError if it is not one of `MASKS`."""
    if mask not in MASKS:
        raise IncompatibleSetupError(
            f"image_mask: got {mask!r}, expected None or one of {', '.join(MASKS)}"
        )
    return MASKS[mask]


def detector_place(mask: str | None, filter: str, place: str | None = None) -> DetectorPlace:
    """Place of a mask on the detector in a filter, and the pixels there.

    Without a mask, the place belongs to the mask that is made for the filter's channel
    (MASK210R or MASK335R). `place` is the star's along a bar: a filter of its channel, for the
    fiducial of that filter, "NARROW", or "-", the middle; default the fiducial of `filter`, or the
    middle if it has none. The detectors belong to module A, with which JWST observes.
    IncompatibleSetupError for an unknown mask, filter or place.
    """
    short_wave = is_short_wave(filter)
    if mask is None:
        mask = "MASK210R" if short_wave else "MASK335R"
    require_mask(mask)
    places = _places()
    own = filter.upper() if (mask, filter.upper(), short_wave) in places else "-"
    key = (mask, own if place is None else place.upper(), short_wave)
    if key not in places:
        known = dict.fromkeys(each.place for each in places.values() if each.mask == mask)
        raise IncompatibleSetupError(
            f"bar_place: got {place!r}, expected a place along {mask}: {', '.join(known)}"
        )
    return places[key]


def stop_is_measured(mask: str | None, short_wave: bool) -> bool:
    """Whether the alignment of the Lyot stop of a mask was measured in flight."""
    # The alignment of MASKRND, the stop of all masks but the bars, was measured in the long-wave
    # channel.
    return not short_wave and not isinstance(MASKS.get(mask or ""), BarMask)


def mask_of_header(value: object) -> str:
    """Return the name of an image mask, as ``CORONMSK`` has it, without the module: MASK335R.

    Headers name NIRCam's module with the mask: MASKA335R.
    """
    return re.sub(r"^MASK[AB](?=\d|[LS]WB)", "MASK", str(value).strip().upper())


@lru_cache(maxsize=1)
def _shifts() -> dict[str, tuple[float, float]]:
    table = embedded_table("nircam_filter_shifts")
    return {str(row["filter"]): (float(row["x"]), float(row["y"])) for row in table}


def filter_shift(name: str) -> tuple[float, float]:
    """Shift of the image of the mask, and of the sky with it, from its place in F335M.

    x, y in pixels of the filter's channel, science frame; short-wave filters are relative to F210M.
    IncompatibleSetupError for a filter whose shift was not measured.
    """
    shifts = _shifts()
    if name.upper() not in shifts:
        raise IncompatibleSetupError(
            f"filter: the image shift was measured for {', '.join(shifts)}, not for {name!r}"
        )
    return shifts[name.upper()]
