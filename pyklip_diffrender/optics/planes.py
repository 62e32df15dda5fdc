"""The planes of a coronagraph, from the pupil to the detector, and the transforms in between.

The whole propagation, with xi, eta positions in the pupil (m), x, y angles on the sky (radians),
F the transform from the pupil to the sky (`optics.planes`), and all fields in the orientation of
the entrance pupil:

    E0 = A exp(2 pi i OPD / lambda) exp(-2 pi i (x0 xi - y0 eta) / lambda)     `EntrancePupil`
    E1 = F^-1[t F[E0]] = E0 - F^-1[(1 - t) F[E0]]                            `CompactOcculter`
    E2 = L E1                                                                       `LyotStop`
    E3 = exp(2 pi i W / lambda) E2                                        `InternalAberration`
    Ed = F[E3],   I = sum over lambda of w |Ed|^2                  `Detector`, `OpticalSystem`

A is the amplitude of the telescope's pupil, (x0, y0) the star, t the real amplitude transmission of
the mask, L the stop, W the aberration behind the stop, w the weight of a wavelength. The mask
changes light only within its disc, where 1 - t is not zero: F[E0] is computed only there, as a
matrix product (R. Soummer et al., Opt. Express 15, 15935, 2007). Everything behind E0 is linear,
so that the adjoint of E0 -> Ed is
g -> (1 - F^-1 (1 - t) F) L exp(-2 pi i W / lambda) F^-1 g.

With S = L exp(2 pi i W / lambda), the last four lines are one, Ed = F[S E0] - F[S] * (1 - t) F[E0],
where * is a convolution of small arrays: `optics.fast_path` computes that.

A plane maps one `Wavefront` to the next. Values of free parameters are passed by name; a plane uses
the parameters that are named in its attribute `parameters`.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Hashable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Self, TypeVar

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor
from torch.autograd.forward_ad import unpack_dual

from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.io.units import ARCSEC, native_float64
from pyklip_diffrender.optics.grid import (
    PupilGrid,
    polygon_coverage,
    transform_polygons,
    zernike_basis,
)

# Distinguish differentiated tensors from constants, whose results may be cached.

Key = TypeVar("Key", bound=Hashable)
Made = TypeVar("Made")

Position = tuple[tuple[str, float], ...]
"""Named values as plain numbers, as a key for results computed from them."""


class Cache(dict[Key, Made]):
    """Constants by key, each made once. Copies by `pickle` and `copy.deepcopy` are empty.

    Nothing is stored within a transform of `torch.func`, which wraps all results: wrapped tensors
    cannot be copied or written after the transform has ended.
    """

    def kept(self, key: Key, make: Callable[[], Made]) -> Made:
        """The constant for a key, which `make` makes if the key is new."""
        made = self.get(key)
        if made is None:
            self[key] = made = make()
        return made

    def __setitem__(self, key: Key, made: Made) -> None:
        if has_memory(torch.zeros(()) + 0):
            super().__setitem__(key, made)

    def __reduce__(self) -> tuple[type[Cache[Key, Made]], tuple[()]]:
        return type(self), ()


def has_memory(tensor: Tensor) -> bool:
    """Whether a tensor is not wrapped by a transform of `torch.func`, nor a dual number.

    Tensors in reverse mode by `backward` or `torch.autograd.grad` are not wrapped.
    """
    try:
        tensor.data_ptr()
    except RuntimeError:
        return False  # A wrapper without memory of its own.
    return unpack_dual(tensor).tangent is None


def position_of(values: Mapping[str, Tensor], names: Iterable[str]) -> Position | None:
    """Values of the named parameters, or None if a parameter is being differentiated.

    Names without a value are omitted.
    """
    position = []
    for name in sorted(set(names) & set(values)):
        value = values[name]
        if not has_memory(value) or (value.requires_grad and torch.is_grad_enabled()):
            return None
        position += [(name, number) for number in value.flatten().tolist()]
    return tuple(position)


def cached(
    store: Cache[Key, tuple[Position, Made]],
    key: Key,
    position: Position | None,
    make: Callable[[], Made],
) -> Made:
    """The stored result for a key if it was made at the same position, else a new result.

    Only the latest result for each key is stored. Nothing is stored while differentiating (position
    None, see `position_of`), nor within a transform of `torch.func`, see `Cache`.
    """
    if position is None:
        return make()
    latest = store.get(key)  # Read only once: another thread may replace it at any moment.
    if latest is None or latest[0] != position:
        store[key] = latest = (position, make())
    return latest[1]


# Fraunhofer propagation between pupil and image by matrix products has the convention, with x, y
# angles on the image (radians, image orientation as in stpsf) and xi, eta positions in the
# entrance-pupil orientation (m),
#
#     E(x, y) = 1/lambda  sum  E(xi, eta) exp(+2 pi i (x xi - y eta) / lambda) d_xi d_eta
#
# The minus sign is the inversion in y between the JWST entrance and exit pupils. |E|^2 is then
# light per steradian, and sums over the image and over the pupil are equal (Parseval). A source at
# (x0, y0) has the pupil phase -2 pi (x0 xi - y0 eta) / lambda.


def centred(grid: PupilGrid) -> PupilGrid:
    """The window with rows and columns added so that it is symmetric about the axis."""
    row, column = (max(stop, grid.npix - start) for start, stop in (grid.rows, grid.columns))
    return replace(grid, rows=(grid.npix - row, row), columns=(grid.npix - column, column))


def kernel(image: Tensor, pupil: Tensor, wavelength: float, sign: int) -> Tensor:
    """``exp(sign 2 pi i image pupil / wavelength)``, (image, pupil), in double precision."""
    turns = image[:, None] * pupil[None, :] / wavelength
    # Whole turns are dropped before the cosine, to keep the phase small for any field.
    angle = sign * 2 * math.pi * (turns - torch.round(turns.detach()))
    return torch.complex(torch.cos(angle), torch.sin(angle))


def tilt_phases(offset: Tensor, grid: PupilGrid, wavelength: float) -> tuple[Tensor, Tensor]:
    """Pupil phase of a source off the axis, as a sum of a function of x and one of y.

    `offset` is (..., 2), x, y of the source on the image in radians; the phases are (..., columns)
    and (..., rows), in radians, each within half a turn.
    """
    x_turns = -offset[..., 0:1] * grid.x.to(offset.device) / wavelength
    y_turns = offset[..., 1:2] * grid.y.to(offset.device) / wavelength
    return tuple(2 * math.pi * (t - torch.round(t.detach())) for t in (x_turns, y_turns))  # type: ignore[return-value]


class MatrixFourier:
    """The Fourier transform between one pupil window and one set of image positions.

    `x` (columns,) and `y` (rows,) are image positions in radians, float64, and may require
    gradients; `wavelength` is in m. With `shear`, the true y of pixel (i, j) is
    ``y[i] + shear x[j]``.
    """

    def __init__(
        self,
        grid: PupilGrid,
        x: Tensor,
        y: Tensor,
        wavelength: float,
        dtype: torch.dtype = torch.complex128,
        shear: float = 0.0,
    ) -> None:
        # The matrices are built once, in double precision, and cast; forward and inverse are two
        # matrix products each (R. Soummer et al., "Fast computation of Lyot-style coronagraph
        # propagation", Opt. Express 15, 15935, 2007). The large product is the one along y.
        self.grid = grid
        pupil_x, pupil_y = grid.x.to(x.device), grid.y.to(x.device)
        self._columns = kernel(x, pupil_x, wavelength, +1).to(dtype).T.contiguous()
        self._rows = kernel(y, pupil_y, wavelength, -1).to(dtype)
        self._shear = (
            kernel(shear * x, pupil_y, wavelength, -1).T.contiguous().to(dtype) if shear else None
        )
        self._scale = grid.spacing**2 / wavelength
        self._inverse_scale = 1 / wavelength

    def forward(self, field: Tensor) -> Tensor:
        """Pupil field (..., rows, columns), per m, to image field (..., y, x), per radian."""
        # Along x first, so that every column can have its own shift in y.
        columns = self._scale * (field @ self._columns)
        return self._rows @ (columns if self._shear is None else columns * self._shear)

    def inverse(self, field: Tensor, cell: float) -> Tensor:
        """Image field (..., y, x) on cells of solid angle `cell` (sr), back to the pupil."""
        columns = (cell * self._inverse_scale) * (self._rows.mH @ field)
        return (columns if self._shear is None else columns * self._shear.conj()) @ self._columns.mH


Values = Mapping[str, Tensor]


@dataclass(frozen=True)
class Wavefront:
    """A monochromatic field on a window of the pupil."""

    field: Tensor  # (..., rows, columns), square root of light per m^2; 1 in the whole pupil
    wavelength: float  # m
    grid: PupilGrid


class Plane(ABC):
    """A plane of an `OpticalSystem` behind the entrance pupil; linear in the field."""

    name: str
    # Names of the free parameters of this plane.
    parameters: tuple[str, ...] = ()
    # True for a mask in a focus, False for an optic in a pupil.
    focal: bool = False
    # True if the plane multiplies each sample of the field in the pupil by a factor that does not
    # depend on the field.
    pointwise: bool = False
    # True if the plane is known only at the wavelengths for which it was made.
    sampled: bool = False

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.name!r}, {'image' if self.focal else 'pupil'} plane>"

    def window(self, values: Values) -> PupilGrid | None:
        """Window of the pupil that this plane passes on; None for the whole pupil."""
        return None

    def compact(
        self, wavelength: float, dtype: torch.dtype, device: torch.device
    ) -> CompactOcculter | None:
        """A compact occulter that acts as this plane at a wavelength; None if there is none."""
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

    `amplitude` is the transmission, (npix, npix), float64, in entrance-pupil orientation,
    `diameter` the side of the array in m, `dtype` the real type of the computation.
    """

    parameters: tuple[str, ...] = ("star_offset",)
    sampled: bool = False
    """True if the pupil is known only at the wavelengths for which it was made."""
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
        # The amplitude is scaled so that the pupil collects 1: sum of A^2 d_xi d_eta = 1.
        power = (amplitude**2).sum() * full.spacing**2
        self.amplitude = full.crop(amplitude / torch.sqrt(power), self.grid).to(dtype)
        self.lit = amplitude > 0
        """Samples that transmit light, (npix, npix)."""

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.name!r}, {self.full.npix} px pupil>"

    def on_window(self, maps: Tensor) -> Tensor:
        """OPD maps (..., npix, npix) on the samples of the field, (..., rows, columns)."""
        return self.full.crop(maps, self.grid)

    def field(self, opd: Tensor, wavelength: float, star_offset: Tensor | None) -> Wavefront:
        """The field behind the pupil, for an OPD (..., npix, npix) in m and a wavelength in m.

        An imaginary part of the OPD is absorption: the amplitude is exp(-2 pi Im / wavelength).
        `star_offset` is (..., 2) in arcsec, image orientation, or None on the axis.
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

    The openings are outlines (vertices, 2) in m at the primary, entrance-pupil orientation;
    `diameter` is the side of the pupil array in m, and `lyot_shift` a fraction of it.
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
        # Rasterised anew at every position, so that the image is a smooth function of shift and
        # rotation with the true derivative.
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

    `coefficients` is (36,), Noll order, m rms, entrance-pupil orientation; `chromatic` maps a
    wavelength (m) to additional coefficients {Noll index: m}.
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

    `complement` maps angles (x, y) in arcsec to the amplitude 1 - t, which vanishes beyond `radius`
    (arcsec; two numbers are half the sides of a rectangle). The mask is sampled in `sampling`
    cells, by default 4, per lambda / `diameter`.
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
        # The field behind the mask, back in the pupil, is E - F^-1[(1 - t) F[E]], so that only the
        # square about the disc, or the rectangle, is ever sampled. `complement` computes 1 - t
        # directly in double precision: from t it would lose digits by cancellation.
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


@dataclass(repr=False)
class Detector:
    """The pixel array."""

    shape: tuple[int, int]  # (ny, nx) pixels
    pixelscale: tuple[float, float]  # x, y, arcsec per pixel
    # Samples per pixel along each axis. The value of a pixel is the mean of its samples times the
    # area of the pixel: with one sample, the intensity at the centre of the pixel.
    oversample: int
    dtype: torch.dtype
    device: torch.device
    shear: float = 0.0  # increase of y with x on the sky, arcsec per arcsec
    name: str = "detector"
    centre: tuple[float, float] = (0.0, 0.0)  # x, y of the array's middle, arcsec
    parameters: tuple[str, ...] = ("detector_shift", "blur")
    # Not copied by `dataclasses.replace`, because a changed detector has other transforms.
    _transforms: Cache[tuple[float, PupilGrid], MatrixFourier] = field(
        default_factory=Cache, init=False, repr=False, compare=False
    )

    def __repr__(self) -> str:
        (ny, nx), scale = self.shape, self.pixelscale[0]
        return f"<{type(self).__name__} {self.name!r}, {nx} x {ny} px of {scale:.4g} arcsec>"

    def axes(self, values: Values) -> tuple[Tensor, Tensor]:
        """Sample positions x, y on the image relative to the optical axis, radians."""
        axes = []
        shift = values.get("detector_shift")
        for k, (count, scale) in enumerate(zip(self.shape[::-1], self.pixelscale, strict=True)):
            samples = count * self.oversample
            index = torch.arange(samples, dtype=torch.float64, device=self.device)
            axis = (index - (samples - 1) / 2) * (scale / self.oversample)
            if shift is not None:
                axis = axis - shift[..., k].to(self.device)
            axes.append(axis * ARCSEC + self.centre[k] * ARCSEC)
        return axes[0], axes[1]

    def field(self, wavefront: Wavefront, values: Values) -> Tensor:
        """Field on the samples, (..., oversample ny, oversample nx), |field|^2 per sample."""

        def make() -> MatrixFourier:
            return MatrixFourier(
                wavefront.grid,
                *self.axes(values),
                wavefront.wavelength,
                self.dtype.to_complex(),
                self.shear,
            )

        # The transform to a shifted detector holds for one shift, which may need a derivative.
        key = (wavefront.wavelength, wavefront.grid)
        moved = "detector_shift" in values
        transform = make() if moved else self._transforms.kept(key, make)
        return self.per_sample * transform.forward(wavefront.field)

    @property
    def per_sample(self) -> float:
        """Square root of the solid angle of a sample, radians: field on the sample per radian."""
        return math.sqrt(self.pixelscale[0] * self.pixelscale[1]) * ARCSEC / self.oversample

    def image(self, intensity: Tensor, values: Values) -> Tensor:
        """Pixel values (..., ny, nx) from the intensity on the samples: blur, then binning."""
        return self._binned(self._blurred(intensity, values))

    def _blurred(self, intensity: Tensor, values: Values) -> Tensor:
        """Samples with a free blur, if any."""
        if "blur" in values:
            for axis, scale in ((-1, self.pixelscale[0]), (-2, self.pixelscale[1])):
                sigma = values["blur"].reshape(()) * (self.oversample / scale)
                intensity = _blur(intensity, sigma, axis)
        return intensity

    def _binned(self, intensity: Tensor) -> Tensor:
        """Pixels of samples."""
        if self.oversample == 1:
            return intensity
        ny, nx = self.shape
        k = self.oversample
        return intensity.reshape(*intensity.shape[:-2], ny, k, nx, k).sum(dim=(-3, -1))


def _blur(image: Tensor, sigma: Tensor, axis: int) -> Tensor:
    """Gaussian convolution along one axis (-1 or -2), mirrored at the edges; `sigma` in samples."""
    # Below half a sample a sampled Gaussian is a poor filter. Its transform exp(-2 (pi sigma f)^2),
    # cut at the Nyquist frequency, is exact for a well-sampled image. The kernel at a lag l is the
    # integral of exp(-2 (pi sigma f)^2) cos(2 pi f l) over |f| < 1/2, by the midpoint rule.
    reach = 16
    frequency = (torch.arange(64, dtype=torch.float64, device=image.device) + 0.5) / 128
    gain = torch.exp(-2 * (math.pi * sigma.to(image.device) * frequency) ** 2)
    lag = torch.arange(-reach, reach + 1, dtype=torch.float64, device=image.device)
    kernel = (gain * torch.cos(2 * math.pi * frequency * lag[:, None])).mean(dim=1)
    matrix = mirrored_convolution(kernel / kernel.sum(), image.shape[axis]).to(image.dtype)
    return image @ matrix.T if axis == -1 else matrix @ image


def mirrored_convolution(kernel: Tensor, count: int) -> Tensor:
    """Matrix (count, count) of the convolution with a symmetric kernel, mirrored at the edges."""
    # Mirrored about the outer border of the edge pixel, with a period of 2 count: the sample before
    # sample 0 is sample 0 again, and sample count - 1 follows itself (scipy's "reflect").
    reach, device = len(kernel) // 2, kernel.device
    lag = torch.arange(-reach, reach + 1, device=device)
    folded = (torch.arange(count, device=device)[:, None] + lag) % (2 * count)
    mirrored = torch.where(folded < count, folded, 2 * count - 1 - folded)
    matrix = torch.zeros(count, count, dtype=torch.float64, device=device)
    return matrix.scatter_add(1, mirrored, kernel.expand(count, -1))


# Detector effects are linear, differentiable torch functions. They follow the numerics of stpsf,
# with kernels cut as in scipy, so that chains of effects agree with stpsf to rounding.

Effect = Callable[[Tensor], Tensor]


class GaussianBlur:
    """Convolution with a Gaussian of `sigma` samples as in `scipy.ndimage.gaussian_filter`.

    The kernel is sampled and ends at four standard deviations, rounded to whole samples: widths
    below an eighth of a sample have no effect. The image is mirrored at its edges. A tensor `sigma`
    may require gradients.
    """

    def __init__(self, sigma: float | Tensor) -> None:
        self.sigma = torch.as_tensor(sigma, dtype=torch.float64)

    def _matrix(self, count: int, like: Tensor) -> Tensor:
        reach = int(4 * float(self.sigma.detach()) + 0.5)
        if reach == 0:
            # As in scipy, the image is unchanged, and so the derivative must be zero.
            return torch.eye(count, dtype=like.dtype, device=like.device)
        lag = torch.arange(-reach, reach + 1, dtype=torch.float64)
        kernel = torch.exp(-0.5 * (lag / self.sigma.cpu()) ** 2)
        kernel = kernel / kernel.sum()
        return mirrored_convolution(kernel, count).to(like.device, like.dtype)

    def __call__(self, image: Tensor) -> Tensor:
        """Blur (..., rows, columns)."""
        down = self._matrix(image.shape[-2], image)
        across = self._matrix(image.shape[-1], image)
        return down @ image @ across.T


class LinearResampling:
    """Bilinear interpolation of images of `shape`, zero outside the image.

    `rows` and `columns`, (ny, nx), are the position in the image of each sample of the result.
    """

    def __init__(self, rows: ArrayLike, columns: ArrayLike, shape: tuple[int, int]) -> None:
        y, x = native_float64(rows), native_float64(columns)
        inside = (y >= 0) & (y <= shape[0] - 1) & (x >= 0) & (x <= shape[1] - 1)
        top = np.clip(np.floor(y), 0, shape[0] - 2).astype(np.int64)
        left = np.clip(np.floor(x), 0, shape[1] - 2).astype(np.int64)
        down, right = y - top, x - left
        # The value at (top + d, left + r) is the sum of four neighbours with weights (1 - d) or d
        # times (1 - r) or r: one pair of flat indices and weights for each.
        self._taps = [
            (
                torch.from_numpy((top + i) * shape[1] + left + j),
                torch.from_numpy(
                    np.where(inside, (down if i else 1 - down) * (right if j else 1 - right), 0.0)
                ),
            )
            for i in (0, 1)
            for j in (0, 1)
        ]

    def __call__(self, image: Tensor) -> Tensor:
        """Resample (..., rows, columns)."""
        flat = image.flatten(-2)
        total = torch.zeros((), dtype=image.dtype, device=image.device)
        for index, weight in self._taps:
            total = total + flat[..., index.to(image.device)] * weight.to(image)
        return total


class PixelCrosstalk:
    """Convolution of pixels with a small `kernel` (odd, odd), scaled to sum 1 (IPC, PPC).

    The kernel is the distribution of the signal of the middle pixel. There is no signal beyond the
    edges.
    """

    def __init__(self, kernel: ArrayLike) -> None:
        values = native_float64(kernel)
        self.kernel = torch.from_numpy(values / values.sum())

    def __call__(self, image: Tensor) -> Tensor:
        """Convolve (..., rows, columns)."""
        # Torch correlates, so the kernel is flipped.
        turned = self.kernel.flip(0, 1).to(image)[None, None]
        padding = (self.kernel.shape[0] // 2, self.kernel.shape[1] // 2)
        images = image.reshape(-1, 1, *image.shape[-2:])
        return torch.nn.functional.conv2d(images, turned, padding=padding).reshape(image.shape)


@dataclass(repr=False)
class ChainDetector(Detector):
    """A detector with effects, in order, before and after the samples are binned to pixels."""

    on_samples: tuple[Effect, ...] = ()
    on_pixels: tuple[Effect, ...] = ()

    def image(self, intensity: Tensor, values: Values) -> Tensor:
        """See `Detector.image`; a free blur comes before the other effects."""
        intensity = self._blurred(intensity, values)
        for effect in self.on_samples:
            intensity = effect(intensity)
        image = self._binned(intensity)
        for effect in self.on_pixels:
            image = effect(image)
        return image
