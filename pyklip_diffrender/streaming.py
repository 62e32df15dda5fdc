"""From the pupil to images in blocks of rows, where no derivatives are asked for.

A megapixel field and the arrays on the way to it do not fit into a processor's cache, and making
room for them takes longer than filling them. Here the field exists for some rows at a time, and
goes through the product along x before the next. It is kept as real and imaginary parts of the
half to the right of the axis and of the other, mirrored: sums and differences of the two halves
take half-size products with cosines and sines.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.autograd.forward_ad import unpack_dual

from pyklip_diffrender.geometry import PupilGrid
from pyklip_diffrender.propagation import RowTransform, centred, kernel, symmetric, tilt_phases

__all__ = ["Branch", "PupilStream", "is_plain"]

_ROWS = 128
"""Rows of a block, for each thread: about 2 MB an array for 1024 samples across the pupil."""


def is_plain(tensor: Tensor) -> bool:
    """Whether a tensor takes part in no differentiation and in no transform of `torch.func`."""
    if tensor.requires_grad and torch.is_grad_enabled():
        return False
    try:
        tensor.data_ptr()
    except RuntimeError:
        return False  # It stands for others, and has no memory of its own.
    return unpack_dual(tensor).tangent is None


def _sides(array: Tensor) -> Tensor:
    """Columns from the axis to the right, and to the left: (..., 2, rows, half).

    In an odd number of columns the middle one is on both sides.
    """
    half = (array.shape[-1] + 1) // 2
    right, left = array[..., array.shape[-1] - half :], array[..., :half].flip(-1)
    return torch.stack([right, left], dim=-3).contiguous()


def _reach(lit: Tensor) -> list[int]:
    """For every row of (sides, rows, half), the columns up to the last one that is lit."""
    column = torch.arange(1, lit.shape[-1] + 1, device=lit.device)
    found: list[int] = (lit.any(dim=0) * column).amax(dim=-1).tolist()
    return found


def _part(room: Tensor, *shape: int) -> Tensor:
    """The beginning of a flat array as an array of some shape."""
    return room[: math.prod(shape)].view(shape)


@dataclass
class Branch:
    """One image that is made of the field.

    Parameters
    ----------
    grid : PupilGrid
        Window outside of which `factor` is zero.
    factor : Tensor or None
        What the field is multiplied with on `grid`, complex; None for 1.
    x, y : Tensor
        Positions of the image, radians.
    wavelength : float
        m.
    dtype : torch.dtype
        Real type.
    shear : float
        See `MatrixFourier`.
    """

    grid: PupilGrid
    factor: Tensor | None
    x: Tensor
    y: Tensor
    wavelength: float
    dtype: torch.dtype
    shear: float

    def __post_init__(self) -> None:
        device = self.x.device
        window = centred(self.grid)
        self.parts: Tensor | None = None
        if self.factor is not None:
            factor = self.grid.crop(self.factor, window)
            self.parts = _sides(torch.stack([factor.real, factor.imag]))
            self.reach = _reach((self.parts != 0).any(dim=0))
        self.grid = window
        pupil = window.x[window.shape[1] // 2 :].to(device)
        self._mirrored = symmetric(self.x)
        image = self.x[len(self.x) // 2 :] if self._mirrored else self.x
        product = kernel(image, pupil, self.wavelength, +1)
        cosine, sine = product.real.clone(), product.imag.clone()
        if window.shape[1] % 2:
            cosine[:, 0] /= 2  # The middle column is on both sides.
        self.products = [part.contiguous().to(self.dtype) for part in (cosine, sine)]
        complex_type = self.dtype.to_complex()
        rows = window.y.to(device)
        self._rows = RowTransform(self.y, rows, self.wavelength, -1, complex_type, True)
        self._turn = None
        if self.shear:
            turn = kernel(self.shear * self.x, rows, self.wavelength, -1).T
            self._turn = turn.contiguous().to(complex_type)
        self.scale = window.spacing**2 / self.wavelength

    def finish(self, along_x: Tensor) -> Tensor:
        """The image (y, x) from products of shape (even and odd, k, real and imaginary, rows)."""
        even = torch.complex(along_x[0, :, 0], along_x[0, :, 1]).mT
        odd = torch.complex(-along_x[1, :, 1], along_x[1, :, 0]).mT
        field = even + odd
        if self._mirrored:
            below = (even - odd)[:, len(self.x) % 2 :].flip(-1)
            field = torch.cat([below, field], dim=-1)
        if self._turn is not None:
            field = field * self._turn
        return self.scale * self._rows.forward(field)


class PupilStream:
    """The field behind an entrance pupil, and images of it, by blocks of rows.

    Parameters
    ----------
    amplitude : Tensor, (rows, columns)
        On `grid`, real.
    grid : PupilGrid
    """

    def __init__(self, amplitude: Tensor, grid: PupilGrid) -> None:
        self.grid = centred(grid)
        self._amplitude = _sides(grid.crop(amplitude, self.grid))
        self._reach = _reach(self._amplitude != 0)

    def images(
        self, opd: Tensor, offset: Tensor | None, wavelength: float, branches: Sequence[Branch]
    ) -> list[Tensor]:
        """Images of the field times the factor of each branch.

        Parameters
        ----------
        opd : Tensor, (npix, npix)
            m; see `EntrancePupil.field`.
        offset : Tensor, (2,), or None
            Of the source, radians.
        wavelength : float
            m.
        branches : sequence of Branch
            At that wavelength.
        """
        device, dtype = self._amplitude.device, self._amplitude.dtype
        half = self._amplitude.shape[-1]
        opd = PupilGrid.full(self.grid.npix, self.grid.diameter).crop(opd, self.grid)
        tilt = None
        if offset is not None:
            x, y = tilt_phases(offset, self.grid, wavelength)
            tilt = _sides(x[None, :]).to(dtype), y[:, None].to(dtype)
        products = [
            torch.zeros(2, len(b.products[0]), 2, b.grid.shape[0], dtype=dtype, device=device)
            for b in branches
        ]
        block = min(_ROWS * torch.get_num_threads(), len(self._reach))
        room = torch.empty(8, 2 * block * half, dtype=dtype, device=device)
        for start in range(0, len(self._reach), block):
            rows = slice(start, min(start + block, len(self._reach)))
            width = max(self._reach[rows])
            if not width:
                continue
            field = self._block(opd, 2 * math.pi / wavelength, tilt, rows, width, room)
            for branch, product in zip(branches, products, strict=True):
                self._along_x(field, rows, branch, product, room[3:])
        return [b.finish(p) for b, p in zip(branches, products, strict=True)]

    def _block(
        self,
        opd: Tensor,
        wavenumber: float,
        tilt: tuple[Tensor, Tensor] | None,
        rows: slice,
        width: int,
        room: Tensor,
    ) -> Tensor:
        """Field on some rows: (real and imaginary, sides, rows, width)."""
        count = rows.stop - rows.start
        phase = _part(room[0], 2, count, width)
        field = _part(room[1:3].view(-1), 2, 2, count, width)
        part = opd[rows]
        real = part.real if part.is_complex() else part
        middle = self.grid.shape[1] // 2
        sides = (
            real[:, middle : middle + width],
            real[:, self.grid.shape[1] - middle - width : self.grid.shape[1] - middle].flip(-1),
        )
        for side, values in zip(phase, sides, strict=True):
            torch.mul(values, wavenumber, out=side)
        if tilt is not None:
            phase.add_(tilt[0][..., :width]).add_(tilt[1][rows])
        torch.cos(phase, out=field[0])
        torch.sin(phase, out=field[1])
        field.mul_(self._amplitude[:, rows, :width])
        if part.is_complex():
            field.mul_(_sides(torch.exp(-wavenumber * part.imag))[..., :width])
        return field

    def _along_x(
        self, field: Tensor, rows: slice, branch: Branch, product: Tensor, room: Tensor
    ) -> None:
        """Put the product along x of a branch, on some rows, into `product`."""
        first = self.grid.rows[0] - branch.grid.rows[0]  # Row 0 of this grid in the branch's.
        top, stop = max(rows.start + first, 0), min(rows.stop + first, branch.grid.shape[0])
        if top >= stop:
            return
        width = field.shape[-1]
        here = field[:, :, top - rows.start - first : stop - rows.start - first]
        if branch.parts is not None:
            width = min(width, max(branch.reach[top:stop]))
            if not width:
                return
            factor = branch.parts[:, :, top:stop, :width]
            passed = _part(room[:2].view(-1), 2, 2, stop - top, width)
            real, imaginary = here[0, ..., :width], here[1, ..., :width]
            torch.mul(real, factor[0], out=passed[0]).addcmul_(imaginary, factor[1], value=-1)
            torch.mul(real, factor[1], out=passed[1]).addcmul_(imaginary, factor[0])
            here = passed
        for k, combine in enumerate((torch.add, torch.sub)):
            folded = _part(room[2 + k], 2, stop - top, width)
            combine(here[:, 0], here[:, 1], out=folded)
            # In this order: a product of few columns takes twice as long as one of few rows.
            found = branch.products[k][:, :width] @ folded.view(-1, width).T
            product[k, :, :, top:stop] = found.view(-1, 2, stop - top)
