"""Propagation of a field times plane waves, as in the derivatives with respect to Fourier modes.

A plane wave with f whole cycles across the pupil array, of side D, moves the image by f lambda/D
along each axis. The transform of the field times the wave is therefore the transform of the field
at shifted positions. The two matrix products of the transform factor: the first, along x, depends
on the cycles along x alone, and is computed once for all waves.

The second, along y, is real and serves two waves. With the even and odd parts E and O of the first
product about the middle row of the pupil, and f = fy lambda/D,

    A(y; fx, fy) = C - i S,    C, S = sum over eta > 0 of E cos k (y - f) eta, O sin k (y - f) eta.

If y and f change their signs, C stays and S changes its sign: A(-y; fx, -fy) = C + i S.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from pyklip_diffrender.optics.fourier import centred, kernel
from pyklip_diffrender.optics.planes import Wavefront

__all__ = ["PlaneWaves", "ShiftedTransforms"]


class ShiftedTransforms:
    """Fourier transforms of a field times plane waves.

    Parameters
    ----------
    wavefront : Wavefront
    x, y : Tensor
        Image positions, radians, float64, those along y symmetric about 0.
    shear : float
        See `MatrixFourier`.
    reach : int
        Largest number of cycles along an axis.
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
        # Of waves with fy >= 0.
        upper = (y - shifts[reach:, None]).flatten()
        rows = kernel(upper, pupil_y[len(pupil_y) // 2 :], wavelength, +1)
        rows = rows.unflatten(0, (-1, len(y)))
        self._cosine, self._sine = (
            each.to(field.real.dtype).contiguous() for each in (rows.real, rows.imag)
        )

    def at(self, fx: int, fy: slice) -> Tensor:
        """Transforms for waves of fx and -fx whole cycles along x, and fy and -fy along y.

        Parameters
        ----------
        fx : int
        fy : slice
            Of the numbers 0 to `reach`.

        Returns
        -------
        Tensor, (2, 2, waves, y, x)
            Per radian; the first axis is the sign of fx, the second that of fy.
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
        # The middle is its own mirror image: it counts once and has no odd part.
        middle, above = upper[..., :1, :], upper[..., 1:, :]
        return (
            torch.cat([middle, above + lower], dim=-2),
            torch.cat([torch.zeros_like(middle), above - lower], dim=-2),
        )
    return upper + lower, upper - lower


@dataclass(frozen=True)
class PlaneWaves:
    """Fields on the detector of a field in the entrance pupil times plane waves.

    Attributes
    ----------
    direct : ShiftedTransforms
        From the pupil to the detector, without the occulter.
    focus : ShiftedTransforms
        To the cells of the occulter.
    blocked : Tensor
        See `OcculterLattice`.
    per_sample : float
        See `Detector`.
    onwards : callable
        From the light on the cells to the detector.
    """

    direct: ShiftedTransforms
    focus: ShiftedTransforms
    blocked: Tensor
    per_sample: float
    onwards: Callable[[Tensor], Tensor]

    def fields(self, fx: int, fy: slice) -> Tensor:
        """Fields for waves exp(2 pi i (+-fx xi +- fy eta) / D), (2, 2, waves, ny, nx).

        Parameters and axes are those of `ShiftedTransforms.at`.
        """
        removed = self.onwards(self.focus.at(fx, fy).mul_(self.blocked))
        return self.direct.at(fx, fy).mul_(self.per_sample).sub_(removed)
