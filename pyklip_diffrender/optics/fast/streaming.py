"""Transforms from the pupil to images in blocks of rows, with derivatives in reverse mode.

A field of a megapixel and its temporary arrays do not fit into a processor's cache, and allocating
them takes longer than filling them. Here the field is computed for a block of rows at a time, which
is transformed along x before the next block. Its real and imaginary parts are stored for the half
of the pupil to the right of the axis, and for the other half mirrored. The cosine transform of the
sum and the sine transform of the difference of these halves need matrices of half the size.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from pyklip_diffrender.optics.fourier import RowTransform, centred, kernel, symmetric, tilt_phases
from pyklip_diffrender.optics.grid import PupilGrid

__all__ = ["Branch", "PupilStream"]

_ROWS = 128
"""Rows of a block per thread. For 1024 samples across the pupil an array has about 2 MB."""


def _sides(array: Tensor) -> Tensor:
    """Columns to the right and to the left of the axis, outwards: (..., 2, rows, half).

    If the number of columns is odd, both sides contain the middle one.
    """
    half = (array.shape[-1] + 1) // 2
    right, left = array[..., array.shape[-1] - half :], array[..., :half].flip(-1)
    return torch.stack([right, left], dim=-3).contiguous()


def _reach(lit: Tensor) -> list[int]:
    """Number of columns up to the last lit one, for every row of (sides, rows, half)."""
    column = torch.arange(1, lit.shape[-1] + 1, device=lit.device)
    reach: list[int] = (lit.any(dim=0) * column).amax(dim=-1).tolist()
    return reach


def _part(room: Tensor, *shape: int) -> Tensor:
    """View the beginning of a flat array with another shape."""
    return room[: math.prod(shape)].view(shape)


@dataclass
class Branch:
    """One image made from the field.

    Parameters
    ----------
    grid : PupilGrid
        Window outside of which `factor` is zero.
    factor : Tensor or None
        Complex factor of the field on `grid`; None for 1.
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
            cosine[:, 0] /= 2  # Both sides contain the middle column.
        self.products = [part.contiguous().to(self.dtype) for part in (cosine, sine)]
        complex_type = self.dtype.to_complex()
        rows = window.y.to(device)
        self._rows = RowTransform(self.y, rows, self.wavelength, -1, complex_type, True)
        self._turn = None
        if self.shear:
            turn = kernel(self.shear * self.x, rows, self.wavelength, -1).T
            self._turn = turn.contiguous().to(complex_type)
        self.scale = window.spacing**2 / self.wavelength

    def room(self, dtype: torch.dtype) -> Tensor:
        """Zeros for the products along x: (even and odd, k, real and imaginary, rows)."""
        shape = 2, len(self.products[0]), 2, self.grid.shape[0]
        return torch.zeros(shape, dtype=dtype, device=self.x.device)

    def finish(self, along_x: Tensor) -> Tensor:
        """Image (y, x) from products of shape (even and odd, k, real and imaginary, rows)."""
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
    """Images of the field behind an entrance pupil, by blocks of rows.

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

    @property
    def dtype(self) -> torch.dtype:
        """Real type of the computation."""
        return self._amplitude.dtype

    def products(
        self, opd: Tensor, offset: Tensor | None, branches: Sequence[Branch]
    ) -> list[Tensor]:
        """Transform the field times the factor of each branch along x.

        Parameters
        ----------
        opd : Tensor, (npix, npix)
            m; see `EntrancePupil.field`.
        offset : Tensor, (2,), or None
            Offset of the source, radians.
        branches : sequence of Branch
            All at one wavelength.

        Returns
        -------
        list of Tensor, (even and odd, k, real and imaginary, rows)
            Input of `Branch.finish`.
        """
        products = [branch.room(self.dtype) for branch in branches]
        for rows, field, room in self._blocks(opd, offset, branches[0].wavelength):
            for branch, product in zip(branches, products, strict=True):
                self._along_x(field, rows, branch, product, room)
        return products

    def slopes(
        self,
        opd: Tensor,
        offset: Tensor | None,
        branches: Sequence[Branch],
        along_x: Sequence[Tensor],
    ) -> tuple[Tensor, Tensor | None]:
        """Derivatives of a real number with respect to the OPD and the offset.

        Parameters
        ----------
        opd, offset, branches
            See `products`; the OPD is real.
        along_x : sequence of Tensor
            Derivatives of the number with respect to the products.

        Returns
        -------
        Tensor, (npix, npix)
            Per m.
        Tensor, (2,), or None
            Per radian.
        """
        wavelength = branches[0].wavelength
        # The factor from OPD to phase is applied to these arrays because they are small.
        along_x = [slope * (2 * math.pi / wavelength) for slope in along_x]
        by_opd = torch.zeros(opd.shape, dtype=self.dtype, device=opd.device)
        window = PupilGrid.full(self.grid.npix, self.grid.diameter).crop(by_opd, self.grid)
        middle = self.grid.shape[1] // 2
        before = self.grid.shape[1] - middle
        for rows, field, room in self._blocks(opd, offset, wavelength):
            count, width = field.shape[-2:]
            back = _part(room[:2].view(-1), 2, 2, count, width).zero_()
            for branch, slope in zip(branches, along_x, strict=True):
                self._back_along_x(back, rows, branch, slope, room[2:])
            # d(field) = i field d(phase)
            right, left = back[1].mul_(field[0]).addcmul_(back[0], field[1], value=-1)
            window[rows, middle : middle + width] = right
            # Added, because both sides contain the middle of an odd number of columns.
            window[rows, before - width : before] += left.flip(-1)
        by_offset = None
        if offset is not None:
            # An offset in x is a tilt of the OPD along -x of the pupil, an offset in y along y.
            x, y = (axis.to(opd.device) for axis in (self.grid.x, self.grid.y))
            by_offset = torch.stack(
                [-(window.sum(dim=0).to(x.dtype) @ x), window.sum(dim=1).to(y.dtype) @ y]
            )
        return by_opd, by_offset

    def _blocks(
        self, opd: Tensor, offset: Tensor | None, wavelength: float
    ) -> Iterator[tuple[slice, Tensor, Tensor]]:
        """Iterate over rows, the field (real and imaginary, sides, rows, width) and work space."""
        opd = PupilGrid.full(self.grid.npix, self.grid.diameter).crop(opd, self.grid)
        tilt = None
        if offset is not None:
            x, y = tilt_phases(offset, self.grid, wavelength)
            tilt = _sides(x[None, :]).to(self.dtype), y[:, None].to(self.dtype)
        block = min(_ROWS * torch.get_num_threads(), len(self._reach))
        size = 2 * block * self._amplitude.shape[-1]
        room = torch.empty(8, size, dtype=self.dtype, device=self._amplitude.device)
        for start in range(0, len(self._reach), block):
            rows = slice(start, min(start + block, len(self._reach)))
            width = max(self._reach[rows])
            if width:
                wavenumber = 2 * math.pi / wavelength
                yield rows, self._block(opd, wavenumber, tilt, rows, width, room), room[3:]

    def _block(
        self,
        opd: Tensor,
        wavenumber: float,
        tilt: tuple[Tensor, Tensor] | None,
        rows: slice,
        width: int,
        room: Tensor,
    ) -> Tensor:
        """Field of a block of rows, (real and imaginary, sides, rows, width)."""
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
        """Store the transform along x of a block of rows in `product`."""
        part = self._overlap(rows, branch, field.shape[-1])
        if part is None:
            return
        inside, top, stop, width = part
        light = field[:, :, inside]
        if branch.parts is not None:
            factor = branch.parts[:, :, top:stop, :width]
            passed = _part(room[:2].view(-1), 2, 2, stop - top, width)
            real, imaginary = light[0, ..., :width], light[1, ..., :width]
            torch.mul(real, factor[0], out=passed[0]).addcmul_(imaginary, factor[1], value=-1)
            torch.mul(real, factor[1], out=passed[1]).addcmul_(imaginary, factor[0])
            light = passed
        for k, combine in enumerate((torch.add, torch.sub)):
            folded = _part(room[2 + k], 2, stop - top, width)
            combine(light[:, 0], light[:, 1], out=folded)
            # A product with few columns would take twice as long as this one with few rows.
            folded_product = branch.products[k][:, :width] @ folded.view(-1, width).T
            product[k, :, :, top:stop] = folded_product.view(-1, 2, stop - top)

    def _overlap(
        self, rows: slice, branch: Branch, width: int
    ) -> tuple[slice, int, int, int] | None:
        """Slice of the rows that a branch contains, their range on its grid, and their width."""
        first = self.grid.rows[0] - branch.grid.rows[0]  # Row 0 of this grid in the branch's.
        top, stop = max(rows.start + first, 0), min(rows.stop + first, branch.grid.shape[0])
        if top >= stop:
            return None
        if branch.parts is not None:
            width = min(width, max(branch.reach[top:stop]))
        if not width:
            return None
        start = rows.start + first
        return slice(top - start, stop - start), top, stop, width

    def _back_along_x(
        self, back: Tensor, rows: slice, branch: Branch, slope: Tensor, room: Tensor
    ) -> None:
        """Add the derivative with respect to the field of a block of rows to `back`.

        Parameters
        ----------
        back : Tensor, (real and imaginary, sides, rows, width)
        rows : slice
        branch : Branch
        slope : Tensor, (even and odd, k, real and imaginary, rows)
            Derivative with respect to the products along x.
        room : Tensor
        """
        part = self._overlap(rows, branch, back.shape[-1])
        if part is None:
            return
        inside, top, stop, width = part
        even, odd = (
            torch.mm(
                slope[k, :, :, top:stop].flatten(1).T,
                branch.products[k][:, :width],
                out=_part(room[k], 2 * (stop - top), width),
            ).view(2, stop - top, width)
            for k in range(2)
        )
        target = back[:, :, inside, :width]
        if branch.parts is None:
            target[:, 0].add_(even).add_(odd)
            target[:, 1].add_(even).sub_(odd)
            return
        factor = branch.parts[:, :, top:stop, :width]
        for side, combine in enumerate((torch.add, torch.sub)):
            real, imaginary = combine(even, odd, out=_part(room[2], 2, stop - top, width))
            target[0, side].addcmul_(real, factor[0, side]).addcmul_(imaginary, factor[1, side])
            target[1, side].addcmul_(imaginary, factor[0, side])
            target[1, side].addcmul_(real, factor[1, side], value=-1)
