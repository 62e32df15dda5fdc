"""Image-plane masks of any shape, and poppy's optics evaluated at chosen positions.

All masks sample the image on the same lattice, multiples of ``lambda / diameter / sampling`` about
the axis. The light that a mask removes is computed only where the mask is not clear. The three
methods differ in speed; the results agree to rounding.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import poppy
import torch
from astropy import units as u
from numpy.typing import NDArray
from poppy.poppy_core import PlaneType
from scipy.fft import next_fast_len
from scipy.special import jn_zeros
from torch import Tensor

from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.io.units import ARCSEC
from pyklip_diffrender.optics.grid import PupilGrid
from pyklip_diffrender.optics.planes import (
    Cache,
    CompactOcculter,
    MatrixFourier,
    Plane,
    Position,
    Values,
    Wavefront,
    cached,
)

Box = tuple[float, float, float, float]
"""Lower x, upper x, lower y, upper y in arcsec."""


def _lattice(low: float, high: float, spacing: float, limit: float) -> Tensor:
    """Multiples of `spacing` that cover an interval, all in radians.

    The image of a sampled pupil repeats outside the range from ``-limit`` to `limit`, where light
    must not be removed a second time.
    """
    edge = round(limit / spacing)
    first = max(math.floor(low / spacing), -edge)
    last = min(math.ceil(high / spacing), edge - 1)
    return torch.arange(first, last + 1, dtype=torch.float64) * spacing


def padded_pupil(npix: int, diameter: float, padding: float) -> PupilGrid:
    """The pupil array with `padding` times as many samples, as in an FFT."""
    size = round(npix * padding)
    # poppy pads by whole samples on both sides, with the odd one, if any, at the end.
    first = -((size - npix) // 2)
    return PupilGrid(npix, diameter, (first, first + size), (first, first + size))


class BoxPart:
    """A part that is clear outside a box: two matrix transforms on the lattice inside it.

    `complement` maps x (1, columns) and y (rows, 1), in arcsec, image orientation, and a wavelength
    in m to ``1 - t``.
    """

    def __init__(self, complement: Callable[[Tensor, Tensor, float], Tensor], box: Box) -> None:
        self.complement, self.box = complement, box
        self._cells: Cache[tuple[float, float, float], tuple[Tensor, Tensor, Tensor]] = Cache()
        self._transforms: Cache[tuple[float, float, PupilGrid, torch.dtype], MatrixFourier] = (
            Cache()
        )

    def cells(self, wavefront: Wavefront, spacing: float) -> tuple[Tensor, Tensor, Tensor]:
        """Positions x (columns,), y (rows,) in radians, and ``1 - t`` (rows, columns)."""
        wavelength = wavefront.wavelength
        limit = wavelength / (2 * wavefront.grid.spacing)

        def make() -> tuple[Tensor, Tensor, Tensor]:
            left, right, bottom, top = (edge * ARCSEC for edge in self.box)
            x = _lattice(left, right, spacing, limit)
            y = _lattice(bottom, top, spacing, limit)
            return x, y, self.complement(x[None, :] / ARCSEC, y[:, None] / ARCSEC, wavelength)

        return self._cells.kept((wavelength, spacing, limit), make)

    def _transform(self, wavefront: Wavefront, spacing: float, grid: PupilGrid) -> MatrixFourier:
        device, dtype = wavefront.field.device, wavefront.field.dtype

        def make() -> MatrixFourier:
            x, y, _ = self.cells(wavefront, spacing)
            return MatrixFourier(grid, x.to(device), y.to(device), wavefront.wavelength, dtype)

        return self._transforms.kept((wavefront.wavelength, spacing, grid, dtype), make)

    def focal_field(self, wavefront: Wavefront, spacing: float) -> Tensor:
        """Field in front of the mask on the cells of the box."""
        return self._transform(wavefront, spacing, wavefront.grid).forward(wavefront.field)

    def removed(self, wavefront: Wavefront, spacing: float, onto: PupilGrid) -> Tensor:
        """Field to subtract on the window `onto`; `spacing` of the lattice in radians."""
        blocked = self.cells(wavefront, spacing)[2].to(wavefront.field)
        removed = self.focal_field(wavefront, spacing) * blocked
        return self._transform(wavefront, spacing, onto).inverse(removed, spacing**2)


class SeparablePart:
    """A part ``f(x) g(y)`` that may reach to the end of the image: one convolution per axis.

    `along_x` and `along_y` map positions in arcsec, image orientation, to the factor of ``1 - t``,
    or are None for 1; `sampling` is in lattice points per lambda/diameter.
    """

    def __init__(
        self,
        along_x: Callable[[Tensor], Tensor] | None,
        along_y: Callable[[Tensor], Tensor] | None,
        sampling: float,
    ) -> None:
        self.along_x, self.along_y, self.sampling = along_x, along_y, sampling
        self._spectra: Cache[tuple[str, float, PupilGrid, PupilGrid, torch.dtype], Tensor] = Cache()

    def _spectrum(self, axis: str, wavefront: Wavefront, spacing: float, onto: PupilGrid) -> Tensor:
        """Transform of the kernel from the window in front to the one behind, along one axis."""

        def make() -> Tensor:
            grid = wavefront.grid
            factor = self.along_x if axis == "x" else self.along_y
            assert factor is not None
            # As in an FFT of the pupil padded by `sampling`, the lattice ends at npix / 2
            # lambda/diameter.
            count = round(grid.npix * self.sampling)
            index = torch.arange(count) - count // 2
            values = factor(index * spacing / ARCSEC).to(torch.float64)
            # Pupil samples at a distance d are coupled by the d-th Fourier coefficient of the
            # factor; the sign of the exponent is as in `MatrixFourier`, opposite in y.
            coefficients = torch.fft.fft(torch.fft.ifftshift(values)) / count
            if axis == "y":
                coefficients = coefficients.conj()
            before, behind = (w.columns if axis == "x" else w.rows for w in (grid, onto))
            distance = torch.arange(behind[0] - before[1] + 1, behind[1] - before[0])
            spectrum = torch.fft.fft(coefficients[distance % count], next_fast_len(len(distance)))
            return spectrum.to(wavefront.field.device, wavefront.field.dtype)

        key = (axis, wavefront.wavelength, wavefront.grid, onto, wavefront.field.dtype)
        return self._spectra.kept(key, make)

    def _convolved(
        self, field: Tensor, axis: str, wavefront: Wavefront, spacing: float, onto: PupilGrid
    ) -> Tensor:
        # For n samples in front and m behind there are n + m - 1 distances, beginning with the
        # distance from the last sample in front to the first sample behind. An FFT of that length
        # wraps around, but not in the elements n - 1 to n + m - 2 of the convolution, which are the
        # samples behind.
        spectrum = self._spectrum(axis, wavefront, spacing, onto)
        dim = -1 if axis == "x" else -2
        first = field.shape[dim] - 1
        size = onto.shape[1] if axis == "x" else onto.shape[0]
        shaped = spectrum if axis == "x" else spectrum[:, None]
        product = torch.fft.fft(field, len(spectrum), dim=dim) * shaped
        return torch.fft.ifft(product, dim=dim).narrow(dim, first, size)

    def removed(self, wavefront: Wavefront, spacing: float, onto: PupilGrid) -> Tensor:
        """See `BoxPart`."""
        field, grid = wavefront.field, wavefront.grid
        if self.along_y is None:
            field = grid.crop(field, replace(onto, columns=grid.columns))
        else:
            field = self._convolved(field, "y", wavefront, spacing, onto)
        if self.along_x is None:
            return replace(grid, rows=onto.rows).crop(field, onto)
        return self._convolved(field, "x", wavefront, spacing, onto)


MaskPart = BoxPart | SeparablePart
"""A part of a mask, which changes the field in the pupil behind the mask."""


class SampledOcculter(Plane):
    """A mask that is clear except for its parts, which share a lattice.

    Complements of the parts add up; `sampling` is in lattice points per lambda / `diameter`. `grid`
    is the window with all the light in front of the mask: the pupil array, or the padded pupil
    array if a mask scatters light beyond the pupil array and no aperture holds it back.
    """

    focal = True

    def __init__(
        self,
        parts: Sequence[MaskPart],
        sampling: float,
        diameter: float,
        name: str,
        grid: PupilGrid,
    ) -> None:
        if sampling < 1:
            raise IncompatibleSetupError(
                f"{name}: got {sampling} cells per lambda/D, expected at least 1 (below that the "
                "cells alias the pupil onto itself; 2 to 8 is usual)"
            )
        self.name, self.parts = name, tuple(parts)
        self.sampling, self.diameter, self.grid = sampling, diameter, grid

    def window(self, values: Values) -> PupilGrid:
        """See `Plane`: the mask acts on all the light in front of it."""
        return self.grid

    def _spacing(self, wavelength: float) -> float:
        return wavelength / self.diameter / self.sampling

    def focal_sample(self, wavefront: Wavefront) -> tuple[Tensor, float]:
        """The field behind the mask inside the first box, and the lattice's spacing (radians)."""
        spacing = self._spacing(wavefront.wavelength)
        for part in self.parts:
            if isinstance(part, BoxPart):
                field = part.focal_field(wavefront, spacing) * spacing
                blocked = part.cells(wavefront, spacing)[2]
                return field * (1 - blocked.to(field)), spacing
        raise IncompatibleSetupError(f"{self.name} has no part in a box, so no sample of its focus")

    def compact(
        self, wavelength: float, dtype: torch.dtype, device: torch.device
    ) -> CompactOcculter | None:
        """The first part as a `CompactOcculter`, without the other parts.

        None if the first part has no box, or changes the phase of the light.
        """
        part = self.parts[0]
        if not isinstance(part, BoxPart):
            return None
        left, right, bottom, top = part.box
        # `CompactOcculter` has a real transmission.
        x = torch.linspace(left, right, 65, dtype=torch.float64)
        y = torch.linspace(bottom, top, 65, dtype=torch.float64)
        if bool((part.complement(x[None, :], y[:, None], wavelength).imag != 0).any()):
            return None

        def complement(x: Tensor, y: Tensor) -> Tensor:
            return part.complement(x, y, wavelength).real

        radius = max(map(abs, part.box))
        return CompactOcculter(
            complement, radius, self.sampling, self.diameter, dtype, device, self.name
        )

    def apply(self, wavefront: Wavefront, values: Values, onto: PupilGrid) -> Wavefront:
        """Subtract the light that each part removes."""
        field = wavefront.grid.crop(wavefront.field, onto)
        for part in self.parts:
            field = field - part.removed(wavefront, self._spacing(wavefront.wavelength), onto)
        return replace(wavefront, field=field, grid=onto)


class FourierMask(Plane):
    """A mask of any kind by FFTs of the padded pupil, as in poppy.

    `transmission` maps a wavelength (m) to the complex amplitude transmission on the lattice,
    (n, n) with n = npix times `padding`, the axis at sample n // 2, in the frame of the pupil
    transform with positive exponents in x and y. `padding` is in lattice points per lambda /
    diameter.
    """

    focal = True

    def __init__(
        self,
        transmission: Callable[[float], Tensor],
        padding: int,
        npix: int,
        diameter: float,
        name: str,
    ) -> None:
        self.name = name
        self.transmission, self.padding = transmission, padding
        self.grid = padded_pupil(npix, diameter, padding)
        self._latest: Cache[torch.dtype, tuple[Position, Tensor]] = Cache()

    def window(self, values: Values) -> PupilGrid:
        """The padded pupil, because light outside the pupil reaches the next mask."""
        return self.grid

    def _lattice_transmission(self, wavefront: Wavefront) -> Tensor:
        def make() -> Tensor:
            lattice = torch.fft.ifftshift(self.transmission(wavefront.wavelength))
            return lattice.to(wavefront.field)

        # Only the latest wavelength is stored: with eight points per lambda/D it takes a gigabyte.
        position = (("wavelength", wavefront.wavelength),)
        return cached(self._latest, wavefront.field.dtype, position, make)

    def focal_sample(self, wavefront: Wavefront) -> tuple[Tensor, float]:
        """The field behind the mask on the whole lattice, and its spacing (radians)."""
        field = wavefront.grid.crop(wavefront.field, self.grid) * wavefront.grid.spacing
        image = torch.fft.ifft2(field, norm="ortho") * self._lattice_transmission(wavefront)
        spacing = wavefront.wavelength / wavefront.grid.diameter / self.padding
        return torch.fft.fftshift(image), spacing

    def apply(self, wavefront: Wavefront, values: Values, onto: PupilGrid) -> Wavefront:
        """Transform, multiply, transform back."""
        lattice = self._lattice_transmission(wavefront)
        field = wavefront.grid.crop(wavefront.field, self.grid)
        field = torch.fft.fft2(torch.fft.ifft2(field) * lattice)
        return replace(wavefront, field=self.grid.crop(field, onto), grid=onto)


Array = NDArray[Any]

COMPACT_OPTICS = (
    "NIRCam_BandLimitedCoron, CircularOcculter, BarOcculter, CircularPhaseMask, and any optic "
    "with an attribute 'occulter_box' (half width in arcsec, or (y, x) of them)"
)


class ImageSamples(poppy.Wavefront):
    """A wavefront without a field, on which optics are evaluated at given image positions.

    `x` and `y`, (rows, columns), are in arcsec, equally spaced; wavelength and diameter are in m.
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
        # Only the shape of the field is used, so that the field needs no memory.
        self.wavefront = np.broadcast_to(np.complex128(1), tuple(x.shape))
        self.planetype = PlaneType.image
        self._last_transform_type = "FFT"
        self._positions = (y, x)

    def coordinates(self) -> tuple[Array, Array]:
        """Copies of y and x, because optics shift and rotate them in place."""
        return self._positions[0].numpy().copy(), self._positions[1].numpy().copy()


class MaskStack:
    """Several optics of poppy in one image plane."""

    def __init__(self, optics: list[Any]) -> None:
        self.optics = optics
        self.name = optics[-1].name

    @classmethod
    def of(cls, optics: list[Any]) -> Any:
        """A stack of masks, or the mask itself if there is only one."""
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
    """A part of a mask's complement: an optic inside a box, or a product along the axes."""

    box: Box | None = None  # where `optic` is not clear, arcsec, frame of the plane
    optic: Any = None
    # Factors of 1 - t where there is no box; None is 1 everywhere.
    along_x: Callable[[Tensor], Tensor] | None = None
    along_y: Callable[[Tensor], Tensor] | None = None


def complement_box(optic: Any, margin: float) -> list[Part] | None:
    """Parts of an image-plane optic that are not clear; None if these parts have no bounds.

    `margin` (arcsec) is added for anti-aliased edges.
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

    def side(y: Tensor) -> Tensor:
        """Rows that only the side of the holder covers."""
        return ((y - y0 > -11.5) & ~(y - y0 > 10)).double()

    parts = [
        Part(along_x=squares(large), along_y=_between(-10.0, -5.0, y0)),
        Part(along_x=squares(small), along_y=_between(8.0, 10.0, y0)),
        Part(along_y=rows),
    ]
    if edge is not None:
        parts.append(Part(along_x=held, along_y=side))
    return parts
