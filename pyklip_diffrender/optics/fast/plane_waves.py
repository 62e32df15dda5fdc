"""Propagation of a field times plane waves, as in the derivatives with respect to Fourier modes.

A plane wave with f whole cycles across the pupil array, of side D, moves the image by f lambda/D
along each axis. The transform of the field times the wave is therefore the transform of the field
at shifted positions. The two matrix products of the transform factor: the first depends on the
cycles along x alone, and is computed once for all waves; the second takes a tenth of the time of a
transform.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from pyklip_diffrender.optics.fourier import kernel
from pyklip_diffrender.optics.planes import Wavefront

__all__ = ["PlaneWaves", "ShiftedTransforms"]


class ShiftedTransforms:
    """Fourier transforms of a field times plane waves.

    Parameters
    ----------
    wavefront : Wavefront
    x, y : Tensor
        Image positions, radians, float64.
    shear : float
        See `MatrixFourier`.
    reach : int
        Largest number of cycles along an axis.
    """

    def __init__(
        self, wavefront: Wavefront, x: Tensor, y: Tensor, shear: float, reach: int
    ) -> None:
        grid, wavelength, field = wavefront.grid, wavefront.wavelength, wavefront.field
        self._reach = reach
        pupil_x, pupil_y = grid.x.to(x.device), grid.y.to(x.device)
        shifts = torch.arange(-reach, reach + 1, dtype=torch.float64, device=x.device)
        shifts = shifts * (wavelength / grid.diameter)
        columns = kernel((x + shifts[:, None]).flatten(), pupil_x, wavelength, +1)
        along_x = (field @ columns.to(field.dtype).T).unflatten(-1, (-1, len(x)))
        if shear:
            turned = kernel(shear * x, pupil_y, wavelength, -1).T
            along_x = along_x * turned.to(field.dtype)[:, None, :]
        self._along_x = (grid.spacing**2 / wavelength) * along_x.movedim(1, 0).contiguous()
        rows = kernel((y - shifts[:, None]).flatten(), pupil_y, wavelength, -1)
        self._rows = rows.to(field.dtype).unflatten(0, (-1, len(y)))

    def at(self, cycles: Tensor) -> Tensor:
        """Transforms for waves of (fx, fy) whole cycles, (waves, 2), per radian: (waves, y, x)."""
        fx, fy = (cycles + self._reach).to(self._rows.device).T
        return self._rows[fy] @ self._along_x[fx]


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

    def fields(self, cycles: Tensor) -> Tensor:
        """Fields for waves exp(2 pi i (fx xi + fy eta) / D), (waves, ny, nx)."""
        removed = self.onwards(self.focus.at(cycles).mul_(self.blocked))
        return self.direct.at(cycles).mul_(self.per_sample).sub_(removed)
