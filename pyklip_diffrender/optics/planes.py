"""The planes of a coronagraph: pupils, the compact occulter, internal aberrations.

The whole propagation, with xi, eta positions in the pupil (m), x, y angles on the sky (radians),
F the transform from the pupil to the sky (`optics.fourier`), and all fields in the orientation of
the entrance pupil:

    E0 = A exp(2 pi i OPD / lambda) exp(-2 pi i (x0 xi - y0 eta) / lambda)     `EntrancePupil`
    E1 = F^-1[t F[E0]] = E0 - F^-1[(1 - t) F[E0]]                            `CompactOcculter`
    E2 = L E1                                                                       `LyotStop`
    E3 = exp(2 pi i W / lambda) E2                                        `InternalAberration`
    Ed = F[E3],   I = sum over lambda of w |Ed|^2                  `Detector`, `OpticalSystem`

A is the amplitude of the telescope's pupil, (x0, y0) the star, t the real amplitude transmission of
the mask, L the stop, W the aberration behind it, w the weight of a wavelength. The mask changes
light only within its disc, where 1 - t is not zero: F[E0] is needed only there, and computed as a
matrix product (R. Soummer et al., Opt. Express 15, 15935, 2007). Everything behind E0 is linear,
so that the adjoint of E0 -> Ed is
g -> (1 - F^-1 (1 - t) F) L exp(-2 pi i W / lambda) F^-1 g.

With S = L exp(2 pi i W / lambda), the last four lines are one, Ed = F[S E0] - F[S] * (1 - t) F[E0],
where * is a convolution of small arrays: `optics.fast` computes that.

A plane maps one `Wavefront` to the next. Values of free parameters are passed by name; a plane uses
those that it declares in `parameters`.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Self

import torch
from torch import Tensor

from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.io.units import ARCSEC
from pyklip_diffrender.optics.differentiation import Cache, Position, cached, position_of
from pyklip_diffrender.optics.fourier import MatrixFourier, tilt_phases
from pyklip_diffrender.optics.grid import PupilGrid, polygon_coverage, transform_polygons
from pyklip_diffrender.optics.zernike import zernike_basis

__all__ = [
    "CompactOcculter",
    "EntrancePupil",
    "InternalAberration",
    "LyotStop",
    "Plane",
    "Values",
    "Wavefront",
    "phase_factor",
]

Values = Mapping[str, Tensor]


@dataclass(frozen=True)
class Wavefront:
    """A monochromatic field on a window of the pupil.

    Attributes
    ----------
    field : Tensor, (..., rows, columns), complex
        Square root of light per m^2; the whole pupil collects 1.
    wavelength : float
        m.
    grid : PupilGrid
        The window of the samples.
    """

    field: Tensor
    wavelength: float
    grid: PupilGrid


class Plane(ABC):
    """A plane of an `OpticalSystem` behind the entrance pupil; linear in the field.

    Attributes
    ----------
    name : str
    parameters : tuple of str
        Names of the free parameters that it uses.
    focal : bool
        True for a mask in a focus, False for an optic in a pupil.
    pointwise : bool
        True if it multiplies each sample of the field in the pupil by a factor that does not
        depend on the field, and that no gradient has to reach except by `parameters`.
    sampled : bool
        True if it is known only at the wavelengths that it was made for.
    """

    name: str
    parameters: tuple[str, ...] = ()
    focal: bool = False
    pointwise: bool = False
    sampled: bool = False

    def window(self, values: Values) -> PupilGrid | None:
        """Return the part of the pupil that this plane passes on; None for all of it."""
        return None

    def compact(
        self, wavelength: float, dtype: torch.dtype, device: torch.device
    ) -> CompactOcculter | None:
        """Return a focal mask as one compact occulter at a wavelength; None if it is not one."""
        return None

    @abstractmethod
    def apply(self, wavefront: Wavefront, values: Values, onto: PupilGrid) -> Wavefront:
        """Propagate; `onto` is the window that the planes behind need."""


def phase_factor(opd: Tensor, wavelength: float, dtype: torch.dtype) -> Tensor:
    """``exp(2 pi i OPD / wavelength)``, from float64 to a real type `dtype`."""
    phase = ((2 * math.pi / wavelength) * opd).to(dtype)
    return torch.polar(torch.ones_like(phase), phase)


class EntrancePupil:
    """The aperture where the wavefront enters: transmission, OPD and direction of the source.

    Parameters
    ----------
    amplitude : Tensor, (npix, npix), float64
        Amplitude transmission, entrance-pupil orientation.
    diameter : float
        Side of the array, m.
    dtype : torch.dtype
        Real type of the computation.
    """

    parameters: tuple[str, ...] = ("star_offset",)
    sampled: bool = False
    """True if it is known only at the wavelengths that it was made for."""
    opd: Tensor | None = None
    """The OPD for calls without one, (npix, npix) in m; None for a flat wavefront."""

    def __init__(
        self, amplitude: Tensor, diameter: float, dtype: torch.dtype, name: str = "entrance pupil"
    ) -> None:
        self.name = name
        self.dtype = dtype
        full = PupilGrid.full(amplitude.shape[-1], diameter)
        self.full = full
        self.grid = full.around(amplitude)
        self.total = float((amplitude**2).sum())
        power = (amplitude**2).sum() * full.spacing**2
        self.amplitude = full.crop(amplitude / torch.sqrt(power), self.grid).to(dtype)
        self.lit = amplitude > 0
        """Samples that transmit light, (npix, npix)."""

    def on_window(self, maps: Tensor) -> Tensor:
        """OPD maps (..., npix, npix) on the samples of the field, (..., rows, columns)."""
        return self.full.crop(maps, self.grid)

    def field(self, opd: Tensor, wavelength: float, star_offset: Tensor | None) -> Wavefront:
        """The field behind the pupil.

        Parameters
        ----------
        opd : Tensor, (..., npix, npix)
            m. An imaginary part is absorption: the amplitude is exp(-2 pi Im / wavelength).
        wavelength : float
            m.
        star_offset : Tensor, (..., 2), or None
            arcsec, image orientation; None on the axis.
        """
        opd = self.on_window(opd)
        wavenumber = 2 * math.pi / wavelength
        amplitude = self.amplitude
        if opd.is_complex():
            amplitude = amplitude * torch.exp(-wavenumber * opd.imag).to(self.dtype)
            opd = opd.real
        phase = wavenumber * opd.to(self.dtype)
        if star_offset is not None:
            x, y = tilt_phases(star_offset * ARCSEC, self.grid, wavelength)
            phase = phase + (x[..., None, :] + y[..., :, None]).to(self.dtype)
        # torch.polar takes 1.6 times as long (1024 x 1024, two cores).
        field = torch.complex(amplitude * torch.cos(phase), amplitude * torch.sin(phase))
        return Wavefront(field, wavelength, self.grid)


class LyotStop(Plane):
    """A stop made of polygonal openings that can be shifted and turned, exactly.

    The openings are rasterised at every position (`polygon_coverage`), so that the image is a
    smooth function of shift and rotation with the true derivative.

    Parameters
    ----------
    openings : list of Tensor, each (vertices, 2)
        Outlines in m at the primary, entrance-pupil orientation.
    npix : int
        Samples across the full pupil array.
    diameter : float
        Side of the full array, m; `lyot_shift` is a fraction of it.
    """

    parameters = ("lyot_shift", "lyot_rotation")
    pointwise = True
    margin = 0.06
    """Room for shifts and rotations around the openings, as a fraction of the diameter."""

    def __init__(
        self,
        openings: list[Tensor],
        npix: int,
        diameter: float,
        dtype: torch.dtype,
        device: torch.device,
        name: str = "Lyot stop",
    ) -> None:
        self.name = name
        self.openings = openings
        self.diameter = diameter
        self.dtype, self.device = dtype, device
        full = PupilGrid.full(npix, diameter)
        # Only these two windows occur, because other results are cached for each window.
        self._tight = full.around(polygon_coverage(openings, full))
        self._wide = self._tight.widened(self.margin * diameter)
        self._latest: Cache[PupilGrid, tuple[Position, Tensor]] = Cache()

    def window(self, values: Values) -> PupilGrid:
        return self._tight if set(self.parameters).isdisjoint(values) else self._wide

    def amplitude(self, values: Values) -> Tensor:
        """Transmission on the window, (rows, columns)."""
        position, grid = position_of(values, self.parameters), self.window(values)
        return cached(self._latest, grid, position, lambda: self._coverage(values, grid))

    def _coverage(self, values: Values, grid: PupilGrid) -> Tensor:
        zero = torch.zeros(2, dtype=torch.float64)
        shift = values.get("lyot_shift", zero).cpu() * self.diameter
        rotation = torch.deg2rad(values.get("lyot_rotation", zero[:1]).cpu()).reshape(())
        moved = transform_polygons(self.openings, shift, rotation)
        return polygon_coverage(moved, grid).to(self.device, self.dtype)

    def apply(self, wavefront: Wavefront, values: Values, onto: PupilGrid) -> Wavefront:
        grid = self.window(values)
        field = wavefront.grid.crop(wavefront.field, grid) * self.amplitude(values)
        return replace(wavefront, field=field, grid=grid)


class InternalAberration(Plane):
    """Wavefront error of the instrument behind the Lyot stop, in Zernikes on the pupil's disc.

    Parameters
    ----------
    coefficients : Tensor, (36,)
        Noll order, m rms, entrance-pupil orientation.
    chromatic : callable, optional
        Wavelength (m) to additional coefficients {Noll index: m}.
    """

    parameters = ("si_zernikes",)
    pointwise = True

    def __init__(
        self,
        coefficients: Tensor,
        diameter: float,
        dtype: torch.dtype,
        device: torch.device,
        chromatic: Callable[[float], dict[int, float]] | None = None,
        name: str = "internal aberration",
    ) -> None:
        self.name = name
        self.coefficients = coefficients.to(device, torch.float64)
        self.diameter = diameter
        self.dtype = dtype
        self.chromatic = chromatic
        self._bases: Cache[PupilGrid, Tensor] = Cache()
        self._phasors: Cache[tuple[PupilGrid, float], Tensor] = Cache()

    def _basis(self, grid: PupilGrid) -> Tensor:
        def make() -> Tensor:
            basis = zernike_basis(len(self.coefficients), grid.x, grid.y, self.diameter / 2)
            return basis.to(self.coefficients.device)

        return self._bases.kept(grid, make)

    def opd(self, wavelength: float, grid: PupilGrid, values: Values) -> Tensor:
        """OPD on the window, (rows, columns), m, float64."""
        coefficients = self.coefficients
        if self.chromatic is not None:
            extra = torch.zeros_like(coefficients)
            for noll, value in self.chromatic(wavelength).items():
                extra[noll - 1] = value
            coefficients = coefficients + extra
        if "si_zernikes" in values:
            coefficients = coefficients + values["si_zernikes"]
        return torch.tensordot(coefficients, self._basis(grid), dims=1)

    def apply(self, wavefront: Wavefront, values: Values, onto: PupilGrid) -> Wavefront:
        def make() -> Tensor:
            opd = self.opd(wavefront.wavelength, wavefront.grid, values)
            return phase_factor(opd, wavefront.wavelength, self.dtype)

        key = (wavefront.grid, wavefront.wavelength)
        phasor = make() if "si_zernikes" in values else self._phasors.kept(key, make)
        return replace(wavefront, field=wavefront.field * phasor)


class CompactOcculter(Plane):
    """A focal-plane mask whose complement 1 - t is zero outside a disc or a rectangle.

    The field behind it, back in the pupil, is E - F^-1[(1 - t) F[E]]. Only the square about the
    disc, or the rectangle, is ever sampled, in cells of ``1 / sampling`` of lambda/D.

    Parameters
    ----------
    complement : callable
        From angles (x, y) in arcsec to the amplitude 1 - t, computed directly in double precision
        because 1 - t from t would lose digits by cancellation.
    radius : float or (x, y)
        arcsec; `complement` vanishes beyond. Two numbers are half the sides of a rectangle.
    sampling : float, optional
        Cells per lambda / `diameter`; default 4.
    """

    focal = True

    def __init__(
        self,
        complement: Callable[[Tensor, Tensor], Tensor],
        radius: float | tuple[float, float],
        sampling: float | None,
        diameter: float,
        dtype: torch.dtype,
        device: torch.device,
        name: str = "occulter",
    ) -> None:
        if sampling is not None and sampling < 1:
            raise IncompatibleSetupError(
                f"occulter_sampling: got {sampling} cells per lambda/D, expected at least 1 "
                "(below that the cells alias the pupil onto itself; 2 to 4 is usual)"
            )
        self.name = name
        self.complement, self.sampling = complement, sampling
        self.reach = radius if isinstance(radius, tuple) else (radius, radius)
        self.radius = max(self.reach)
        self.diameter = diameter
        self.dtype, self.device = dtype, device
        self._cells: Cache[float, tuple[Tensor, Tensor, Tensor]] = Cache()
        self._transforms: Cache[tuple[float, PupilGrid], MatrixFourier] = Cache()

    def compact(self, wavelength: float, dtype: torch.dtype, device: torch.device) -> Self:
        return self

    def cells(self, wavelength: float) -> tuple[Tensor, Tensor, Tensor]:
        """Cell positions along x and along y (radians), and 1 - t on the cells."""

        def make() -> tuple[Tensor, Tensor, Tensor]:
            spacing = wavelength / self.diameter / (self.sampling or 4.0)
            counts = [math.ceil(half * ARCSEC / spacing) for half in self.reach]
            x, y = (torch.arange(-n, n + 1, dtype=torch.float64) * spacing for n in counts)
            complement = self.complement(x[None, :] / ARCSEC, y[:, None] / ARCSEC)
            return x, y, complement.to(self.device, self.dtype)

        return self._cells.kept(wavelength, make)

    def _transform(self, wavelength: float, grid: PupilGrid) -> MatrixFourier:
        def make() -> MatrixFourier:
            x, y = (axis.to(self.device) for axis in self.cells(wavelength)[:2])
            return MatrixFourier(grid, x, y, wavelength, self.dtype.to_complex())

        return self._transforms.kept((wavelength, grid), make)

    def focal_field(self, wavefront: Wavefront) -> Tensor:
        """The field in front of the mask, on the cells."""
        return self._transform(wavefront.wavelength, wavefront.grid).forward(wavefront.field)

    def apply(self, wavefront: Wavefront, values: Values, onto: PupilGrid) -> Wavefront:
        """E - F^-1[(1 - t) F[E]] on the window `onto`."""
        axis, _, complement = self.cells(wavefront.wavelength)
        cell = float(axis[1] - axis[0]) ** 2
        blocked = complement * self.focal_field(wavefront)
        removed = self._transform(wavefront.wavelength, onto).inverse(blocked, cell)
        field = wavefront.grid.crop(wavefront.field, onto) - removed
        return replace(wavefront, field=field, grid=onto)
