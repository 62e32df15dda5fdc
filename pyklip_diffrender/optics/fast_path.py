"""A faster propagation through a coronagraph with one compact occulter, with the same results."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from scipy.fft import next_fast_len
from torch import Tensor
from torch.nn.functional import pad

from pyklip_diffrender.io.units import ARCSEC
from pyklip_diffrender.optics.grid import PupilGrid
from pyklip_diffrender.optics.planes import (
    Cache,
    CompactOcculter,
    Detector,
    MatrixFourier,
    Plane,
    Position,
    Values,
    Wavefront,
    cached,
    centred,
    kernel,
    position_of,
    tilt_phases,
)

# An occulter by convolution on a lattice aligned with the detector's samples.
#
# Notation: E is the field in the pupil in front of the occulter, t the occulter's transmission, L
# the product of all planes behind it, F the transform from the pupil to the sky, * a convolution.
# Behind the occulter the field in the pupil is E - F^-1[(1 - t) F[E]] (`planes`). Behind L, on the
# detector,
#
#     A = F[L (E - F^-1[(1 - t) F[E]])]
#       = F[L E] - F[L] * ((1 - t) F[E])                   a product in the pupil is a convolution
#     A(x) = F[L E](x) - (cell / lambda) sum_c F[L](x - c) (1 - t)(c) F[E](c),
#
# summed over the cells c, of solid angle `cell`, within the reach of the mask. The terms:
#
#   F[L E](x)      matrix transform to the detector's samples             `LatticeRoute.field`
#   F[E](c)        matrix transform to the cells                          `OcculterLattice.focus`
#   (1 - t)(c)     times cell / lambda, once for all                      `OcculterLattice.blocked`
#   F[L](x - c)    matrix transform to all differences, once for a stop   `OcculterLattice.kernel`
#   sum_c          product of FFTs                                        `OcculterLattice.convolve`
#
# Differences. Along each axis let the samples be s apart and the cells h. Either s = h n (`cells` n
# per sample: the mask needs finer cells than the detector) or h = s p (`phases` p: the detector is
# oversampled). In the first case all x - c are multiples of h, and every n-th point of the
# convolution is a sample: its spectrum is folded n times before the inverse FFT. In the second case
# the samples of equal index modulo p form a lattice of spacing h of their own, each with a kernel
# of its own. Shear makes y depend on x and is part of the matrix transforms, so that pixels may be
# rectangular and sheared.
#
# Wrapping. The FFTs need as many points as there are differences x - c, about twice the detector's.
# With fewer points, the largest differences, of samples at one edge from cells at the opposite one,
# are taken for smaller differences on the other side. Little light is on the outer cells, and
# little is diffracted so far: fields change by 1e-4 (F444W behind MASK335R, 80 x 80 pixels, 128
# points rather than 160), and take two thirds of the time. That is enough for derivatives and for
# the templates of planets, which change by 5e-5, but not for the star.
#
# Sampling. The sum over cells equals the integral if the spectrum of 1 - t vanishes at the
# frequencies that alias onto the band of F[E] F[L], up to (D_E + D_L) / 2 lambda < D / lambda. The
# spectrum of a mask with an edge does not vanish, and is cut off on a lattice
# `_MASK_POINTS_PER_CELL` times finer, by a windowed sinc (`_Axis.band_limiting`), before the mask
# is sampled; a change of 1 - t outside the band does not change A. The propagation plane by plane
# samples the mask directly.

DEFAULT_SAMPLING = 2.0
"""Cells per lambda/D by default. The error is 4e-9 of the star's peak at 4.5 um."""

_MASK_POINTS_PER_CELL = 4
"""Points per cell, along each axis, at which the mask is sampled before it is band-limited."""

_BAND_EDGE_CYCLES_PER_CELL = 0.06
"""Width of the edge of the band, cycles per cell. With at least 2 cells per lambda/D, the band of
the pupils (0.87 D / lambda) is well below the edge and the band that aliases onto it well above."""

_MASK_MARGIN_CELLS = 4
"""Number of cells of the band-limited mask beyond its edge."""

_UNWRAPPED_CELL_SHARE = 0.6
"""Share of the cells along an axis, in the middle, whose differences to all samples are never
wrapped."""


@dataclass(frozen=True)
class _Axis:
    """Cells and samples along one axis."""

    samples: int  # of the detector
    phases: int  # samples per cell, where samples are finer; each has its own kernel
    cells: int  # cells per sample, where cells are finer
    half: int  # cells are numbered from -half to half
    spacing: float  # between cells, radians
    wrapped: bool  # whether the largest differences may be wrapped

    @classmethod
    def fit(
        cls,
        samples: int,
        step: float,
        oversample: int,
        finest: float,
        reach: float,
        wrapped: bool,
    ) -> _Axis:
        """Choose the coarsest aligned cells that are at most `finest` radians wide.

        A pixel has a whole number of cells, so that its centre is on the lattice as well.
        """
        phases = max(
            (k for k in range(1, oversample + 1) if oversample % k == 0 and k * step <= finest),
            default=1,
        )
        cells = math.ceil(step / finest - 1e-9) if phases == 1 else 1
        spacing = step * phases / cells
        half = math.ceil(reach / spacing) + _MASK_MARGIN_CELLS
        return cls(samples, phases, cells, half, spacing, wrapped)

    @property
    def positions(self) -> Tensor:
        """Positions of the cells, radians, float64."""
        return torch.arange(-self.half, self.half + 1, dtype=torch.float64) * self.spacing

    @property
    def count(self) -> int:
        """Samples of one phase."""
        return self.samples // self.phases

    @property
    def period(self) -> int:
        """Period of the convolution, in steps between samples of one phase."""
        # There are (count - 1) cells + 2 half + 1 differences x - c. If they may be wrapped, only
        # the differences from the middle cells have to be unique.
        cells = math.ceil(_UNWRAPPED_CELL_SHARE * 2 * self.half) if self.wrapped else 2 * self.half
        needed = (self.count - 1) * self.cells + cells + 1
        return int(next_fast_len(math.ceil(needed / self.cells)))

    @property
    def differences(self) -> range:
        """Differences of samples of a phase from cells, from the first sample and cell, in cells.

        If there are more than fit in a period, the outer differences are left out.
        """
        every = range(-2 * self.half, (self.count - 1) * self.cells + 1)
        excess = max(0, len(every) - self.period * self.cells)
        return every[excess // 2 : len(every) - (excess + 1) // 2]

    def angles(self, first: Tensor) -> Tensor:
        """Differences, radians, for a phase whose first sample is at `first`."""
        span = self.differences
        offsets = torch.arange(span.start, span.stop, dtype=torch.float64) + self.half
        return first + (offsets * self.spacing).to(first.device)

    def band_limiting(self) -> Tensor:
        """Matrix from the mask on a finer lattice to the band-limited mask on the cells."""
        last = (self.half - _MASK_MARGIN_CELLS) * _MASK_POINTS_PER_CELL
        fine = torch.arange(-last, last + 1, dtype=torch.float64) / _MASK_POINTS_PER_CELL
        cells = torch.arange(-self.half, self.half + 1, dtype=torch.float64)
        distance = cells[:, None] - fine
        # sinc passes the frequencies below half a cycle per cell. The window, whose transform is
        # proportional to exp(-(f / _BAND_EDGE_CYCLES_PER_CELL)^2), rounds the edge of the band and
        # makes the sum converge.
        window = torch.exp(-((math.pi * _BAND_EDGE_CYCLES_PER_CELL * distance) ** 2))
        return torch.sinc(distance) * window / _MASK_POINTS_PER_CELL


def _axes(
    occulter: CompactOcculter,
    detector: Detector,
    wavelength: float,
    sampling: float,
    wrapped: bool = False,
) -> tuple[_Axis, _Axis]:
    """Cells and samples along x and y."""
    finest = wavelength / occulter.diameter / sampling
    half_x, half_y = occulter.reach
    shear = abs(detector.shear)
    reaches = (half_x * (1 + shear), half_y + half_x * shear)
    k = detector.oversample
    x, y = (
        _Axis.fit(count * k, scale * ARCSEC / k, k, finest, reach * ARCSEC, wrapped)
        for count, scale, reach in zip(
            detector.shape[::-1], detector.pixelscale, reaches, strict=True
        )
    )
    return x, y


def finest_spacing(
    occulter: CompactOcculter, detector: Detector, wavelength: float, sampling: float
) -> float:
    """The smaller spacing of the aligned cells (radians), `sampling` or more per lambda/D."""
    return min(axis.spacing for axis in _axes(occulter, detector, wavelength, sampling))


class OcculterLattice:
    """The cells of an occulter at one wavelength (m), and their convolution to the detector.

    `sampling` is the smallest number of cells per lambda/D. With `wrapped`, the largest differences
    may be wrapped, see the comment at the beginning of this module.
    """

    def __init__(
        self,
        occulter: CompactOcculter,
        detector: Detector,
        wavelength: float,
        sampling: float,
        *,
        wrapped: bool = False,
    ) -> None:
        self.shear, self.wavelength = detector.shear, wavelength
        self.x, self.y = _axes(occulter, detector, wavelength, sampling, wrapped)
        x, y = (
            torch.arange(-n, n + 1, dtype=torch.float64)
            * (axis.spacing / _MASK_POINTS_PER_CELL / ARCSEC)
            for axis in (self.x, self.y)
            for n in [(axis.half - _MASK_MARGIN_CELLS) * _MASK_POINTS_PER_CELL]
        )
        # 1 - t on the cells, (cells in y, cells in x), times the factor that turns the sum over
        # cells into the field on a sample.
        mask = occulter.complement(x[None, :], y[:, None] + self.shear * x[None, :])
        mask = self.y.band_limiting() @ mask @ self.x.band_limiting().T
        scale = self.x.spacing * self.y.spacing / wavelength * detector.per_sample
        self.blocked = (scale * mask).to(detector.device, detector.dtype)
        self._transforms: Cache[tuple[Any, ...], MatrixFourier] = Cache()

    def _transform(self, wavefront: Wavefront, x: Tensor, y: Tensor) -> MatrixFourier:
        def make() -> MatrixFourier:
            device, dtype = wavefront.field.device, wavefront.field.dtype
            return MatrixFourier(
                wavefront.grid, x.to(device), y.to(device), self.wavelength, dtype, self.shear
            )

        key = (wavefront.grid, float(x[0]), len(x), float(y[0]), len(y))
        return self._transforms.kept(key, make)

    def focus(self, wavefront: Wavefront) -> Tensor:
        """Field in front of the mask, on the cells, (..., cells in y, cells in x)."""
        transform = self._transform(wavefront, self.x.positions, self.y.positions)
        return transform.forward(wavefront.field)

    def to_pupil(self, light: Tensor, wavefront: Wavefront) -> Tensor:
        """Field of light on the cells, back in the pupil on the grid of a wavefront.

        The light is `focus` times `blocked` per sample of the detector.
        """
        # The light has the factor cell / lambda of the inverse transform already: `cell` is set to
        # lambda.
        transform = self._transform(wavefront, self.x.positions, self.y.positions)
        return transform.inverse(light, self.wavelength)

    def kernel(self, stop: Wavefront, axes: Sequence[Tensor]) -> Tensor:
        """Transform of the kernel of the convolution, (phases in y, phases in x, n, m).

        `stop` is the product of all planes behind the occulter, `axes` the sample positions x, y,
        radians.
        """
        size = [axis.period * axis.cells for axis in (self.y, self.x)]
        rows = []
        for b in range(self.y.phases):
            for a in range(self.x.phases):
                x = self.x.angles(axes[0][a])
                y = self.y.angles(axes[1][b])
                values = self._transform(stop, x, y).forward(stop.field)
                values = pad(values, (0, size[1] - len(x), 0, size[0] - len(y)))
                starts = (self.y.differences.start, self.x.differences.start)
                rows.append(values.roll(starts, dims=(-2, -1)))
        kernels = torch.stack(rows).unflatten(0, (self.y.phases, self.x.phases))
        # Folding the spectrum makes its inverse transform larger by this factor.
        return torch.fft.fft2(kernels) / (self.x.cells * self.y.cells)

    def convolve(self, light: Tensor, kernel: Tensor) -> Tensor:
        """Field on the samples, (..., samples in y and x), of the light that the mask removes.

        The light is ``focus`` times ``blocked``, (..., cells in y, cells in x), and `kernel` the
        result of the method of that name.
        """
        x, y = self.x, self.y
        spectrum = torch.fft.fft2(light, s=(y.cells * y.period, x.cells * x.period))
        product = spectrum[..., None, None, :, :] * kernel
        if x.cells * y.cells > 1:
            # Every n-th sample of an inverse transform is the inverse of the folded spectrum.
            shape = (y.cells, y.period, x.cells, x.period)
            product = product.unflatten(-1, shape[2:]).unflatten(-3, shape[:2]).sum(dim=(-4, -2))
        field = torch.fft.ifft2(product)[..., : y.count, : x.count]
        if x.phases * y.phases == 1:
            return field[..., 0, 0, :, :]
        # (phase y, phase x, y, x) to (y, phase y, x, phase x)
        field = field.movedim((-4, -3), (-3, -1))
        return field.reshape(*light.shape[:-2], y.samples, x.samples)


# Propagation of a field times plane waves, as in the derivatives with respect to Fourier modes.
#
# A plane wave with f whole cycles across the pupil array, of side D, moves the image by f lambda/D
# along each axis. The transform of the field times the wave is therefore the transform of the field
# at shifted positions. The two matrix products of the transform factor: the first, along x, depends
# on the cycles along x alone, and is computed once for all waves.
#
# The second, along y, is real and serves two waves. With the even and odd parts E and O of the
# first product about the middle row of the pupil, and f = fy lambda/D,
#
#   A(y; fx, fy) = C - i S,    C, S = sum over eta > 0 of E cos k (y - f) eta, O sin k (y - f) eta.
#
# If y and f change their signs, C stays and S changes its sign: A(-y; fx, -fy) = C + i S.


class ShiftedTransforms:
    """Fourier transforms of a field times plane waves, of up to `reach` cycles along an axis.

    `x` and `y` are image positions in radians, float64, those along y symmetric about 0.
    """

    def __init__(
        self, wavefront: Wavefront, x: Tensor, y: Tensor, shear: float, reach: int
    ) -> None:
        wavelength, grid = wavefront.wavelength, centred(wavefront.grid)
        field = wavefront.grid.crop(wavefront.field, grid)
        self._reach = reach
        pupil_x, pupil_y = grid.x.to(x.device), grid.y.to(x.device)
        shifts = torch.arange(-reach, reach + 1, dtype=torch.float64, device=x.device)
        shifts = shifts * (wavelength / grid.diameter)
        columns = kernel((x + shifts[:, None]).flatten(), pupil_x, wavelength, +1)
        along_x = (field @ columns.to(field.dtype).T).unflatten(-1, (-1, len(x)))
        if shear:
            turned = kernel(shear * x, pupil_y, wavelength, -1).T
            along_x = along_x * turned.to(field.dtype)[:, None, :]
        along_x = (grid.spacing**2 / wavelength) * along_x.movedim(1, 0)
        even, odd = _fold(along_x)
        # Real and imaginary parts side by side, for products with real matrices.
        self._even, self._odd = (
            torch.view_as_real(each.contiguous()).flatten(-2) for each in (even, -1j * odd)
        )
        # Rows for waves with fy >= 0.
        upper = (y - shifts[reach:, None]).flatten()
        rows = kernel(upper, pupil_y[len(pupil_y) // 2 :], wavelength, +1)
        rows = rows.unflatten(0, (-1, len(y)))
        self._cosine, self._sine = (
            each.to(field.real.dtype).contiguous() for each in (rows.real, rows.imag)
        )

    def at(self, fx: int, fy: slice) -> Tensor:
        """Transforms for waves of +-fx whole cycles along x and +-fy along y, (2, 2, waves, y, x).

        `fy` is a slice of the numbers 0 to `reach`. The transforms are per radian; the first axis
        is the sign of fx, the second the sign of fy.
        """
        cosine, sine = self._cosine[fy].flatten(0, 1), self._sine[fy].flatten(0, 1)
        shape = (-1, self._cosine.shape[1], self._even.shape[-1] // 2, 2)
        transforms = []
        for column in (self._reach + fx, self._reach - fx):
            even, odd = (
                torch.view_as_complex((rows @ parts[column]).view(shape))
                for rows, parts in ((cosine, self._even), (sine, self._odd))
            )
            transforms += [even + odd, (even - odd).flip(-2)]
        return torch.stack(transforms).unflatten(0, (2, 2))


def _fold(field: Tensor) -> tuple[Tensor, Tensor]:
    """Even and odd parts along axis -2 on the half at and above zero, as sums over +-."""
    half = field.shape[-2] // 2
    upper, lower = field[..., half:, :], field[..., :half, :].flip(-2)
    if field.shape[-2] % 2:
        # The middle is its own mirror image, which counts once and has no odd part.
        middle, above = upper[..., :1, :], upper[..., 1:, :]
        return (
            torch.cat([middle, above + lower], dim=-2),
            torch.cat([torch.zeros_like(middle), above - lower], dim=-2),
        )
    return upper + lower, upper - lower


@dataclass(frozen=True)
class PlaneWaves:
    """Fields on the detector of a field in the entrance pupil times plane waves."""

    direct: ShiftedTransforms  # from the pupil to the detector, without the occulter
    focus: ShiftedTransforms  # to the cells of the occulter
    blocked: Tensor  # see `OcculterLattice`
    per_sample: float
    onwards: Callable[[Tensor], Tensor]  # from the light on the cells to the detector

    def fields(self, fx: int, fy: slice) -> Tensor:
        """Fields for waves exp(2 pi i (+-fx xi +- fy eta) / D), (2, 2, waves, ny, nx).

        See `ShiftedTransforms.at` for parameters and axes.
        """
        removed = self.onwards(self.focus.at(fx, fy).mul_(self.blocked))
        return self.direct.at(fx, fy).mul_(self.per_sample).sub_(removed)


# The propagation consists of ordinary torch operations, which have derivatives of all kinds.


class LatticeRoute:
    """Propagation through planes with one compact occulter (see `serves`) by `OcculterLattice`."""

    def __init__(self, planes: Sequence[Plane], detector: Detector) -> None:
        self.planes, self.detector = tuple(planes), detector
        found = [(k, p) for k, p in enumerate(planes) if isinstance(p, CompactOcculter)]
        ((self._place, self.occulter),) = found
        # Smallest number of cells per lambda/D.
        self.sampling = self.occulter.sampling or DEFAULT_SAMPLING
        behind = planes[self._place + 1 :]
        self._moving = {name for plane in behind for name in plane.parameters} | {"detector_shift"}
        self._lattices: Cache[tuple[float, bool], OcculterLattice] = Cache()
        # The latest result at each wavelength, with the parameters on which it depends.
        self._stops: Cache[float, tuple[Position, Wavefront]] = Cache()
        self._kernels: Cache[float, tuple[Position, Tensor]] = Cache()

    @staticmethod
    def serves(planes: Sequence[Plane]) -> bool:
        """Whether the planes are one `CompactOcculter` and otherwise factors in pupils."""
        others = [plane for plane in planes if not isinstance(plane, CompactOcculter)]
        return len(planes) - len(others) == 1 and all(plane.pointwise for plane in others)

    def pays(self, wavelengths: Sequence[float]) -> bool:
        """Whether the cells aligned with the detector are not much finer than necessary."""
        return all(
            finest_spacing(self.occulter, self.detector, wavelength, self.sampling)
            >= wavelength / self.occulter.diameter / self.sampling / 2.5
            for wavelength in wavelengths
        )

    def lattice(self, wavelength: float, *, wrapped: bool = False) -> OcculterLattice:
        """Cells at a wavelength; see `OcculterLattice` for `wrapped`."""
        return self._lattices.kept(
            (wavelength, wrapped),
            lambda: OcculterLattice(
                self.occulter, self.detector, wavelength, self.sampling, wrapped=wrapped
            ),
        )

    def _stop(self, onto: Sequence[PupilGrid], wavelength: float, values: Values) -> Wavefront:
        """The product of all planes behind the occulter.

        A shift of the detector is included as a tilt, so that nothing else depends on it.
        """
        return cached(
            self._stops,
            wavelength,
            position_of(values, self._moving),
            lambda: self._make_stop(onto, wavelength, values),
        )

    def _make_stop(self, onto: Sequence[PupilGrid], wavelength: float, values: Values) -> Wavefront:
        grid = onto[self._place]
        kind = self.detector.dtype.to_complex()
        ones = torch.ones(grid.shape, dtype=kind, device=self.detector.device)
        stop = Wavefront(ones, wavelength, grid)
        for plane, window in zip(
            self.planes[self._place + 1 :], onto[self._place + 1 :], strict=True
        ):
            stop = plane.apply(stop, values, window)
        if "detector_shift" not in values:
            return stop
        # A detector moved by d has its samples at x - d. F[L E](x - d) is the transform of L E
        # times the tilt of a source at d; the same holds for the kernel F[L].
        x, y = values["detector_shift"].unbind(-1)
        shift = torch.stack([x, y + self.detector.shear * x], dim=-1) * ARCSEC
        factors = [
            torch.polar(torch.ones_like(phase), phase).to(stop.field.dtype)
            for phase in tilt_phases(shift, stop.grid, wavelength)
        ]
        return replace(stop, field=stop.field * factors[0][None, :] * factors[1][:, None])

    def _kernel(self, stop: Wavefront, values: Values) -> Tensor:
        return cached(
            self._kernels,
            stop.wavelength,
            position_of(values, self._moving),
            lambda: self.lattice(stop.wavelength).kernel(stop, self.detector.axes({})),
        )

    def field(self, wavefront: Wavefront, values: Values, onto: Sequence[PupilGrid]) -> Tensor:
        """Propagate from the entrance pupil to the detector's samples.

        `onto` has the windows that the planes pass on, see `OpticalSystem.windows`.
        """
        for plane, window in zip(self.planes[: self._place], onto, strict=False):
            wavefront = plane.apply(wavefront, values, window)
        lattice = self.lattice(wavefront.wavelength)
        stop = self._stop(onto, wavefront.wavelength, values)
        passed = wavefront.grid.crop(wavefront.field, stop.grid) * stop.field
        direct = self.detector.field(replace(stop, field=passed), {})
        light = lattice.focus(wavefront) * lattice.blocked
        return direct - lattice.convolve(light, self._kernel(stop, values))

    def plane_waves(
        self, wavefront: Wavefront, values: Values, onto: Sequence[PupilGrid], reach: int
    ) -> PlaneWaves | None:
        """Propagation of a field times plane waves of up to `reach` cycles along an axis.

        None if there are planes in front of the occulter. The light of the outer cells is wrapped.
        """
        if self._place > 0:
            return None
        lattice, detector = self.lattice(wavefront.wavelength, wrapped=True), self.detector
        stop = self._stop(onto, wavefront.wavelength, values)
        passed = replace(stop, field=wavefront.grid.crop(wavefront.field, stop.grid) * stop.field)
        kernel = lattice.kernel(stop, detector.axes({}))
        x, y = detector.axes({})
        cells_x, cells_y = (a.positions.to(detector.device) for a in (lattice.x, lattice.y))
        return PlaneWaves(
            ShiftedTransforms(passed, x, y, detector.shear, reach),
            ShiftedTransforms(wavefront, cells_x, cells_y, lattice.shear, reach),
            lattice.blocked,
            detector.per_sample,
            lambda light: lattice.convolve(light, kernel),
        )

    def behind_occulter(
        self, wavefront: Wavefront, values: Values, onto: Sequence[PupilGrid]
    ) -> Wavefront:
        """Propagate from the entrance pupil to the pupil behind the occulter; see `field`."""
        for plane, window in zip(self.planes[: self._place], onto, strict=False):
            wavefront = plane.apply(wavefront, values, window)
        lattice, grid = self.lattice(wavefront.wavelength), onto[self._place]
        passed = replace(wavefront, field=wavefront.grid.crop(wavefront.field, grid), grid=grid)
        light = lattice.focus(wavefront) * (lattice.blocked / self.detector.per_sample)
        return replace(passed, field=passed.field - lattice.to_pupil(light, passed))
