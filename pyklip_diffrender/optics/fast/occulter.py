"""An occulter by convolution on a lattice aligned with the detector's samples.

Notation: E is the field in the pupil in front of the occulter, t the occulter's transmission, L the
product of all planes behind it, F the transform from the pupil to the sky, * a convolution. Behind
the occulter the field in the pupil is E - F^-1[(1 - t) F[E]] (`planes`). Behind L, on the detector,

    A = F[L (E - F^-1[(1 - t) F[E]])]
      = F[L E] - F[L] * ((1 - t) F[E])                   a product in the pupil is a convolution
    A(x) = F[L E](x) - (cell / lambda) sum_c F[L](x - c) (1 - t)(c) F[E](c),

summed over the cells c, of solid angle `cell`, within the reach of the mask. The terms:

    F[L E](x)      matrix transform to the detector's samples             `LatticeRoute.field`
    F[E](c)        matrix transform to the cells                          `OcculterLattice.focus`
    (1 - t)(c)     times cell / lambda, once for all                      `OcculterLattice.blocked`
    F[L](x - c)    matrix transform to all differences, once for a stop   `OcculterLattice.kernel`
    sum_c          product of FFTs                                        `OcculterLattice.convolve`

Differences. Along each axis let the samples be s apart and the cells h. Either s = h n (`cells` n
per sample: the mask needs finer cells than the detector) or h = s p (`phases` p: the detector is
oversampled). In the first case all x - c are multiples of h, and every n-th point of the
convolution is a sample: its spectrum is folded n times before the inverse FFT. In the second case
the samples of equal index modulo p form a lattice of spacing h of their own, each with a kernel of
its own. Shear makes y depend on x and is part of the matrix transforms, so that pixels may be
rectangular and sheared.

Wrapping. The FFTs need as many points as there are differences x - c, about twice the detector's.
With fewer points, the largest differences, of samples at one edge from cells at the opposite one,
are taken for smaller ones on the other side. Little light is on the outer cells, and little is
diffracted so far: fields change by 1e-4 (F444W behind MASK335R, 80 x 80 pixels, 128 points rather
than 160), and take two thirds of the time. That is enough for derivatives and for the templates of
planets, which change by 5e-5, but not for the star.

Sampling. The sum over cells equals the integral if the spectrum of 1 - t vanishes at the
frequencies that alias onto the band of F[E] F[L], up to (D_E + D_L) / 2 lambda < D / lambda. The
spectrum of a mask with an edge does not vanish. It is cut off on a lattice `_FINER` times
finer, by a windowed sinc (`_Axis.band_limiting`), before the mask is sampled; a change of 1 - t
outside the band does not change A. The propagation plane by plane samples the mask directly.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from scipy.fft import next_fast_len
from torch import Tensor
from torch.nn.functional import pad

from pyklip_diffrender.io.units import ARCSEC
from pyklip_diffrender.optics.detector import Detector
from pyklip_diffrender.optics.differentiation import Cache
from pyklip_diffrender.optics.fourier import MatrixFourier
from pyklip_diffrender.optics.planes import CompactOcculter, Wavefront

__all__ = ["DEFAULT_SAMPLING", "OcculterLattice", "finest_spacing"]

DEFAULT_SAMPLING = 2.0
"""Cells per lambda/D by default. The error is 4e-9 of the star's peak at 4.5 um."""

_FINER = 4
"""Points per cell, along each axis, at which the mask is sampled before it is band-limited."""

_ROLL_OFF = 0.06
"""Width of the edge of the band, cycles per cell. With at least 2 cells per lambda/D, the band of
the pupils (0.87 D / lambda) is well below the edge and the band that aliases onto it well above."""

_MARGIN = 4
"""Number of cells of the band-limited mask beyond its edge."""

_UNWRAPPED = 0.6
"""Part of the cells along an axis, the middle ones, from which differences to all samples are
right where the others may be wrapped."""


@dataclass(frozen=True)
class _Axis:
    """Cells and samples along one axis.

    Attributes
    ----------
    samples : int
        Number of detector samples.
    phases : int
        Samples per cell, where samples are finer; each has its own kernel.
    cells : int
        Cells per sample, where cells are finer.
    half : int
        Cells are numbered from -half to half.
    spacing : float
        Distance between cells, radians.
    wrapped : bool
        Whether the largest differences may be wrapped.
    """

    samples: int
    phases: int
    cells: int
    half: int
    spacing: float
    wrapped: bool

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
        half = math.ceil(reach / spacing) + _MARGIN
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
        cells = math.ceil(_UNWRAPPED * 2 * self.half) if self.wrapped else 2 * self.half
        needed = (self.count - 1) * self.cells + cells + 1
        return int(next_fast_len(math.ceil(needed / self.cells)))

    @property
    def differences(self) -> range:
        """Differences of samples of a phase from cells, from the first sample and cell, in cells.

        Those that fit in a period; the middle ones if there are more.
        """
        every = range(-2 * self.half, (self.count - 1) * self.cells + 1)
        excess = max(0, len(every) - self.period * self.cells)
        return every[excess // 2 : len(every) - (excess + 1) // 2]

    def angles(self, first: Tensor) -> Tensor:
        """The differences, radians, where the first sample of the phase is at `first`."""
        span = self.differences
        offsets = torch.arange(span.start, span.stop, dtype=torch.float64) + self.half
        return first + (offsets * self.spacing).to(first.device)

    def band_limiting(self) -> Tensor:
        """Matrix from the mask on a finer lattice to the band-limited mask on the cells."""
        inside = self.half - _MARGIN
        fine = torch.arange(-inside * _FINER, inside * _FINER + 1, dtype=torch.float64) / _FINER
        cells = torch.arange(-self.half, self.half + 1, dtype=torch.float64)
        distance = cells[:, None] - fine
        window = torch.exp(-((math.pi * _ROLL_OFF * distance) ** 2))
        return torch.sinc(distance) * window / _FINER


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
    """Return the smaller spacing of the aligned cells, radians.

    Parameters
    ----------
    occulter : CompactOcculter
    detector : Detector
    wavelength : float
        m.
    sampling : float
        Smallest number of cells per lambda/D.
    """
    return min(axis.spacing for axis in _axes(occulter, detector, wavelength, sampling))


class OcculterLattice:
    """The cells of an occulter at one wavelength, and the convolution from them to the detector.

    Parameters
    ----------
    occulter : CompactOcculter
    detector : Detector
    wavelength : float
        m.
    sampling : float
        Smallest number of cells per lambda/D.
    wrapped : bool
        Whether the largest differences may be wrapped, see the top of this module.

    Attributes
    ----------
    x, y : _Axis
    blocked : Tensor, (cells in y, cells in x)
        1 - t on the cells, times the factor that turns the sum into the field on a sample.
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
            torch.arange(-n, n + 1, dtype=torch.float64) * (axis.spacing / _FINER / ARCSEC)
            for axis in (self.x, self.y)
            for n in [(axis.half - _MARGIN) * _FINER]
        )
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
        transform = self._transform(wavefront, self.x.positions, self.y.positions)
        return transform.inverse(light, self.wavelength)

    def kernel(self, stop: Wavefront, axes: Sequence[Tensor]) -> Tensor:
        """Transform of the kernel of the convolution, (phases in y, phases in x, n, m).

        Parameters
        ----------
        stop : Wavefront
            The product of all planes behind the occulter.
        axes : two Tensor
            Sample positions x, y, radians.
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
        # The inverse transform of a folded spectrum is smaller by this factor.
        return torch.fft.fft2(kernels) / (self.x.cells * self.y.cells)

    def convolve(self, light: Tensor, kernel: Tensor) -> Tensor:
        """Field on the detector's samples of the light that the mask removes on the cells.

        Parameters
        ----------
        light : Tensor, (..., cells in y, cells in x)
            ``focus`` times ``blocked``.
        kernel : Tensor
            See `kernel`.

        Returns
        -------
        Tensor, (..., samples in y, samples in x)
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
