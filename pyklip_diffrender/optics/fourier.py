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
    "RowTransform",
    "centred",
    "fold",
    "kernel",
    "symmetric",
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


class RowTransform:
    """The kernel ``exp(sign 2 pi i q p / lambda)`` between positions q and p, along axis -2.

    If the positions are symmetric about zero, as for cells and centred pixels, the kernel
    splits into a cosine that is even and a sine that is odd: two real products of half the size,
    and a quarter of it where both kinds of position are symmetric.
    """

    def __init__(
        self,
        image: Tensor,
        pupil: Tensor,
        wavelength: float,
        sign: int,
        dtype: torch.dtype,
        fold: bool,
    ) -> None:
        self.sign = sign
        self.sizes = len(image), len(pupil)
        self._image_folds = fold and symmetric(image)
        self._pupil_folds = self._image_folds and symmetric(pupil)
        if self._image_folds:
            image = image[len(image) // 2 :]
            pupil = pupil[len(pupil) // 2 :] if self._pupil_folds else pupil
        values = kernel(image, pupil, wavelength, sign)
        if self._image_folds:
            self._cosine = values.real.contiguous().to(dtype.to_real())
            self._sine = (sign * values.imag).contiguous().to(dtype.to_real())
        else:
            self._matrix = values.to(dtype)

    def forward(self, field: Tensor) -> Tensor:
        """(..., pupil, k) to (..., image, k)."""
        if not self._image_folds:
            return self._matrix @ field
        even, odd = fold(field) if self._pupil_folds else (field, field)
        return _unfold(
            _real_product(self._cosine, even),
            self.sign * _real_product(self._sine, odd),
            self.sizes[0],
        )

    def adjoint(self, field: Tensor) -> Tensor:
        """(..., image, k) to (..., pupil, k)."""
        if not self._image_folds:
            return self._matrix.conj().T @ field
        even, odd = fold(field)
        cosine = _real_product(self._cosine.T, even)
        sine = -self.sign * _real_product(self._sine.T, odd)
        return _unfold(cosine, sine, self.sizes[1]) if self._pupil_folds else cosine + 1j * sine


def symmetric(positions: Tensor) -> bool:
    """Whether positions lie symmetrically about zero."""
    if len(positions) < 2:
        return False
    step = float((positions[1] - positions[0]).abs())
    return float((positions + positions.flip(0)).abs().max()) < 1e-12 * step * len(positions)


def fold(field: Tensor) -> tuple[Tensor, Tensor]:
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


def _unfold(even: Tensor, odd: Tensor, size: int) -> Tensor:
    """``even + i odd`` above zero and ``even - i odd`` mirrored below it."""
    turned = 1j * odd
    below = (even - turned)[..., size % 2 :, :].flip(-2)
    return torch.cat([below, even + turned], dim=-2)


def _real_product(matrix: Tensor, field: Tensor) -> Tensor:
    """Real matrix times complex field, without complex arithmetic."""
    parts = torch.view_as_real(field.contiguous())
    product = matrix @ parts.flatten(-2)
    return torch.view_as_complex(product.unflatten(-1, (-1, 2)))


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
    fold : bool
        Use a symmetry of the positions about zero. False for positions that are differentiated,
        because their changes may break it.
    """

    def __init__(
        self,
        grid: PupilGrid,
        x: Tensor,
        y: Tensor,
        wavelength: float,
        dtype: torch.dtype = torch.complex128,
        shear: float = 0.0,
        fold: bool = True,
    ) -> None:
        self.grid = grid
        pupil_x, pupil_y = grid.x.to(x.device), grid.y.to(x.device)
        self._columns = RowTransform(x, pupil_x, wavelength, +1, dtype, fold)
        self._rows = RowTransform(y, pupil_y, wavelength, -1, dtype, fold)
        self._shear = (
            kernel(shear * x, pupil_y, wavelength, -1).T.contiguous().to(dtype) if shear else None
        )
        self._scale = grid.spacing**2 / wavelength
        self._inverse_scale = 1 / wavelength

    def forward(self, field: Tensor) -> Tensor:
        """Pupil field (..., rows, columns), per m, to image field (..., y, x), per radian."""
        if self._shear is None:
            return self._scale * self._columns.forward(self._rows.forward(field).mT).mT
        # Along x first, so that every column can have its own shift in y.
        return self._scale * self._rows.forward(self._columns.forward(field.mT).mT * self._shear)

    def inverse(self, field: Tensor, cell: float) -> Tensor:
        """Image field (..., y, x) on cells of solid angle `cell` (sr), back to the pupil."""
        scale = cell * self._inverse_scale
        if self._shear is None:
            return scale * self._rows.adjoint(self._columns.adjoint(field.mT).mT)
        turned = self._rows.adjoint(field) * self._shear.conj()
        return scale * self._columns.adjoint(turned.mT).mT
