"""Evaluate poppy's optics at chosen positions."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import poppy
import torch
from astropy import units as u
from numpy.typing import NDArray
from poppy.poppy_core import PlaneType
from scipy.special import jn_zeros
from torch import Tensor

from pyklip_diffrender.bridges.image_masks import Box

__all__ = ["COMPACT_OPTICS", "ImageSamples", "MaskStack", "Part", "complement_box", "pupil_phasor"]

Array = NDArray[Any]

COMPACT_OPTICS = (
    "NIRCam_BandLimitedCoron, CircularOcculter, BarOcculter, CircularPhaseMask, and any optic "
    "with an attribute 'occulter_box' (half width in arcsec, or (y, x) of them)"
)


class ImageSamples(poppy.Wavefront):
    """A wavefront without a field, at given image positions, on which optics are evaluated.

    Parameters
    ----------
    wavelength, diameter : float
        m.
    oversample : int
    x, y : Tensor, (rows, columns)
        arcsec, equally spaced.
    """

    def __init__(
        self, wavelength: float, diameter: float, oversample: int, x: Tensor, y: Tensor
    ) -> None:
        spacing = abs(float(x[0, 1] - x[0, 0]))
        super().__init__(
            wavelength=wavelength * u.m,
            npix=1,
            diam=diameter * u.m,
            oversample=oversample,
            pixelscale=spacing * u.arcsec / u.pix,
        )
        # Only its shape is used, so it needs no memory.
        self.wavefront = np.broadcast_to(np.complex128(1), tuple(x.shape))
        self.planetype = PlaneType.image
        self._last_transform_type = "FFT"
        self._positions = (y, x)

    def coordinates(self) -> tuple[Array, Array]:
        """Copies of y and x, because optics shift and rotate them in place."""
        return self._positions[0].numpy().copy(), self._positions[1].numpy().copy()


class MaskStack:
    """Several masks in one image plane.

    Parameters
    ----------
    optics : list of poppy.OpticalElement
    """

    def __init__(self, optics: list[Any]) -> None:
        self.optics = optics
        self.name = optics[-1].name

    @classmethod
    def of(cls, optics: list[Any]) -> Any:
        """A stack, or the mask itself if there is only one."""
        return optics[0] if len(optics) == 1 else cls(optics)

    def get_phasor(self, wave: poppy.Wavefront) -> Array:
        """Product of the transmissions."""
        product = np.ones(wave.shape, dtype=np.complex128)
        for optic in self.optics:
            product = product * np.asarray(optic.get_phasor(wave))
        return product


def pupil_phasor(optic: Any, wave: poppy.Wavefront) -> tuple[Array, Array]:
    """Complex transmission and OPD (m) of a pupil optic, arrays of the wave's shape or scalars.

    Some optics tilt the given wave instead of returning an OPD; the tilt then is part of the
    transmission.
    """
    phasor = np.asarray(optic.get_phasor(wave), dtype=np.complex128)
    changed = np.asarray(wave.wavefront)
    if (changed != 1).any():
        phasor = phasor * changed
    opd = np.asarray(optic.get_opd(wave), dtype=np.float64)
    if opd.size == 1:
        opd = opd.reshape(())
    elif opd.shape != phasor.shape:
        # poppy resampled the optic to the wave, so only its phase is known.
        opd = np.angle(phasor) * wave.wavelength.to_value(u.m) / (2 * np.pi)
    return (phasor.reshape(()) if phasor.size == 1 else phasor), opd


@dataclass(frozen=True)
class Part:
    """A part of a mask's complement: an optic inside a box, or a product along the axes.

    Attributes
    ----------
    box : Box or None
        Extent of the part of `optic` that is not clear, arcsec, frame of the plane.
    optic : object
        Evaluated inside the box.
    along_x, along_y : callable or None
        Factors of ``1 - t`` where there is no box; None is 1 everywhere.
    """

    box: Box | None = None
    optic: Any = None
    along_x: Callable[[Tensor], Tensor] | None = None
    along_y: Callable[[Tensor], Tensor] | None = None


def complement_box(optic: Any, margin: float) -> list[Part] | None:
    """The parts of an image-plane optic that are not clear, or None if they have no bounds.

    Parameters
    ----------
    optic : poppy.OpticalElement
    margin : float
        arcsec to add for anti-aliased edges.
    """
    if isinstance(optic, MaskStack):
        parts = [complement_box(mask, margin) for mask in optic.optics]
        boxes = [part[0].box for part in parts if part is not None and len(part) == 1]
        bounded = [box for box in boxes if box is not None]
        if len(bounded) < len(parts):
            return None
        left, right, bottom, top = zip(*bounded, strict=True)
        return [Part((min(left), max(right), min(bottom), max(top)), optic)]
    if getattr(optic, "rotation", 0) or any(hasattr(optic, f"inclination_{axis}") for axis in "xy"):
        return None
    if type(optic).__name__ == "NIRCam_BandLimitedCoron":
        return _nircam_parts(optic)
    half = _half_widths(optic, margin)
    return None if half is None else [Part(_around(_shift(optic), *half), optic)]


def _half_widths(optic: Any, margin: float) -> tuple[float, float] | None:
    """Half the extent in x and y, arcsec, of an optic that is clear outside."""
    box = getattr(optic, "occulter_box", None)
    if box is not None:
        y, x = np.broadcast_to(np.asarray(box, dtype=float), (2,))
        return float(x), float(y)
    if isinstance(optic, poppy.CircularOcculter) and optic.radius_outer == 0:
        radius = optic.radius_inner.to_value(u.arcsec) + margin
        return radius, radius
    if isinstance(optic, poppy.optics.CircularPhaseMask):
        radius = optic.radius.to_value(u.arcsec) + margin
        return radius, radius
    if isinstance(optic, poppy.BarOcculter):
        return (
            optic.width.to_value(u.arcsec) / 2 + margin,
            optic.height.to_value(u.arcsec) / 2 + margin,
        )
    return None


def _shift(optic: Any) -> tuple[float, float]:
    values = []
    for axis in "xy":
        value = getattr(optic, f"shift_{axis}", None) or 0.0
        values.append(value.to_value(u.arcsec) if isinstance(value, u.Quantity) else float(value))
    return values[0], values[1]


def _around(centre: tuple[float, float], half_x: float, half_y: float) -> Box:
    x, y = centre
    return (x - half_x, x + half_x, y - half_y, y + half_y)


def _between(low: float, high: float, offset: float) -> Callable[[Tensor], Tensor]:
    """1 strictly between two positions, as stpsf cuts its squares."""
    return lambda p: ((p - offset > low) & (p - offset < high)).double()


def _nircam_parts(optic: Any) -> list[Part]:
    """NIRCam's occulters: the mask itself, then what stpsf draws around it.

    Squares, holder and glass edge have sharp edges along the axes and do not overlap, so their
    complements add up.
    """
    bare = copy.copy(optic)
    bare.nd_squares = False
    x0, y0 = _shift(optic)
    if optic.kind == "nircamcircular":
        radius = float(jn_zeros(1, 2)[1]) / optic.sigma
        parts = [Part(_around((x0, y0), radius, radius), bare)]
    else:
        # A bar of 20 arcsec, clear beyond s = 2 pi; s grows most slowly where it is widest.
        x0 -= float(optic.bar_offset or 0.0)
        wide = ImageSamples(
            1e-6,
            1.0,
            1,
            torch.linspace(x0 - 10, x0 + 10, 401, dtype=torch.float64)[None, :].expand(401, 401),
            torch.linspace(y0, y0 + 20, 401, dtype=torch.float64)[:, None].expand(401, 401),
        )
        rows = np.flatnonzero((bare.get_transmission(wide) < 1).any(axis=1))
        half = (rows[-1] + 2) * 20 / 400
        parts = [Part(_around((x0, y0), 10.0, half), bare)]
    if not optic.nd_squares:
        return parts
    side = (optic.module, optic.name)
    if side in (("A", "MASKLWB"), ("B", "MASK210R")):
        large, small, edge = ((5.0, 10.0), (-12.5, -7.5)), ((8.0, 10.0), (-11.0, -9.0)), (10.0, 1)
    elif side in (("A", "MASK210R"), ("B", "MASKSWB")):
        large, small, edge = ((7.5, 12.5), (-10.0, -5.0)), ((9.0, 11.0), (-10.0, -8.0)), (-10.0, -1)
    else:
        large, small, edge = ((7.5, 12.5), (-12.5, -7.5)), ((9.0, 11.0), (-11.0, -9.0)), None
    return parts + _surroundings(x0, y0, large, small, edge)


def _surroundings(
    x0: float,
    y0: float,
    large: tuple[tuple[float, float], ...],
    small: tuple[tuple[float, float], ...],
    edge: tuple[float, int] | None,
) -> list[Part]:
    """Squares of optical density 3, the opaque holder, the edge of the glass."""
    density = 1 - float(np.sqrt(1e-3))

    def held(x: Tensor) -> Tensor:
        """1 along x where the side of the holder is."""
        if edge is None:
            return torch.zeros_like(x)
        return (((x - x0) - edge[0]) * edge[1] > 0).double()

    def squares(spans: tuple[tuple[float, float], ...]) -> Callable[[Tensor], Tensor]:
        def along_x(x: Tensor) -> Tensor:
            inside = sum(_between(*span, x0)(x) for span in spans)
            # The holder is drawn over the squares.
            return density * torch.as_tensor(inside) * (1 - held(x))

        return along_x

    def rows(y: Tensor) -> Tensor:
        return (y - y0 > 10).double() + 0.3 * _between(-13.0, -11.5, y0)(y)

    parts = [
        Part(along_x=squares(large), along_y=_between(-10.0, -5.0, y0)),
        Part(along_x=squares(small), along_y=_between(8.0, 10.0, y0)),
        Part(along_y=rows),
    ]
    if edge is not None:
        parts.append(Part(along_x=held, along_y=lambda y: _side(y - y0)))
    return parts


def _side(y: Tensor) -> Tensor:
    """Rows that only the side of the holder covers."""
    return ((y > -11.5) & ~(y > 10)).double()
