"""Fraunhofer propagation between pupil and image by matrix products.

Convention, with x, y angles on the image (radians, image orientation as in
stpsf) and xi, eta positions in the entrance-pupil orientation (m),

    E(x, y) = 1/lambda  sum  E(xi, eta) exp(+2 pi i (x xi - y eta) / lambda) d_xi d_eta

The minus sign is the inversion in y between the JWST entrance and exit pupils. |E|^2 is then
light per steradian, and sums over the image and over the pupil are equal (Parseval). A source
at (x0, y0) has the pupil phase -2 pi (x0 xi - y0 eta) / lambda.
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from pyklip_diffrender.optics.grid import PupilGrid

__all__ = [
    "MatrixFourier",
    "centred",
    "kernel",
    "tilt_phases",
]


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

    Parameters
    ----------
    offset : Tensor, (..., 2)
        x, y of the source on the image, radians.
    grid : PupilGrid
    wavelength : float
        m.

    Returns
    -------
    Tensor, (..., columns) and (..., rows)
        Radians, each within half a turn.
    """
    x_turns = -offset[..., 0:1] * grid.x.to(offset.device) / wavelength
    y_turns = offset[..., 1:2] * grid.y.to(offset.device) / wavelength
    return tuple(2 * math.pi * (t - torch.round(t.detach())) for t in (x_turns, y_turns))  # type: ignore[return-value]


class MatrixFourier:
    """The Fourier transform between one pupil window and one set of image positions.

    The matrices are built once, in double precision, and cast; forward and inverse are two
    matrix products each (R. Soummer et al., "Fast computation of Lyot-style coronagraph
    propagation", Opt. Express 15, 15935, 2007). The large product is the one along y.

    Parameters
    ----------
    grid : PupilGrid
        The pupil window.
    x, y : Tensor, (columns,), (rows,), float64
        Image positions, radians. They may require gradients.
    wavelength : float
        m.
    dtype : torch.dtype
        complex128 or complex64.
    shear : float
        Increase of y with x on the image: the true y of pixel (i, j) is ``y[i] + shear x[j]``.
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
