"""Bases for wavefront changes: rigid segment motions and Fourier modes.

A coefficient is the rms of its mode in metres (over the segment, or over the full array), so that
a prior scale has the same meaning for all modes of a kind. Modes are analytic and can be sampled on
any pupil grid, so that a coarse and a fine model share their coefficients.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Protocol

import torch
from torch import Tensor

from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.instrument.masks import TABULATED_GAP, is_jwst_pupil, jwst_segments
from pyklip_diffrender.optics.grid import PupilGrid, polygon_coverage, widen_polygon
from pyklip_diffrender.optics.planes import EntrancePupil


class Basis(Protocol):
    """A set of OPD modes."""

    @property
    def groups(self) -> tuple[str, ...]:
        """Kinds of mode, each with its own prior scale."""

    @property
    def group_index(self) -> Tensor:
        """Index of the group of every mode, (modes,), int64."""

    @property
    def frequencies(self) -> Tensor:
        """Cycles across the pupil of every mode, (modes,); 0 for segment motions."""

    def __len__(self) -> int: ...

    def modes(self, grid: PupilGrid, start: int, stop: int) -> Tensor:
        """OPD of some modes at coefficient 1, (stop - start, rows, columns), float64."""

    def opd(self, coefficients: Tensor, grid: PupilGrid) -> Tensor:
        """Sum of all modes, (rows, columns), m; differentiable in the coefficients."""


class SegmentMotions:
    """Piston, and tips about x and y, of each of the 18 segments: 54 modes."""

    groups = ("segment",)

    def __len__(self) -> int:
        return 3 * len(jwst_segments())

    @property
    def group_index(self) -> Tensor:
        return torch.zeros(len(self), dtype=torch.int64)

    @property
    def frequencies(self) -> Tensor:
        return torch.zeros(len(self), dtype=torch.float64)

    def modes(self, grid: PupilGrid, start: int, stop: int) -> Tensor:
        segments = _sampled_segments(grid.npix, grid.diameter)
        return torch.stack(
            [segments[k // 3][0].crop(segments[k // 3][1][k % 3], grid) for k in range(start, stop)]
        )

    def opd(self, coefficients: Tensor, grid: PupilGrid) -> Tensor:
        total = torch.zeros(grid.shape, dtype=torch.float64)
        segments = _sampled_segments(grid.npix, grid.diameter)
        for (window, modes), motion in zip(segments, coefficients.reshape(-1, 3), strict=True):
            rigid = torch.tensordot(motion, modes, dims=1)
            total = total + window.crop(rigid, grid)
        return total


@lru_cache(maxsize=4)
def _sampled_segments(npix: int, diameter: float) -> list[tuple[PupilGrid, Tensor]]:
    """For each segment the window that holds it and its three modes there."""
    # On the full grid, so that modes do not depend on the part of a segment that a window covers.
    grid = PupilGrid.full(npix, diameter)
    reach = max(float(outline.abs().max()) for outline in jwst_segments().values())
    if 2 * reach > 1.01 * grid.diameter:
        raise IncompatibleSetupError(
            f"SegmentMotions: the pupil array is {grid.diameter:.3g} m wide, but JWST's segments "
            f"span {2 * reach:.3g} m. Use FourierModes for another telescope"
        )
    # Half the gap on every side, so that each point of the gaps belongs to a segment.
    return [
        _sampled_segment(widen_polygon(outline, TABULATED_GAP / 2), grid)
        for outline in jwst_segments().values()
    ]


def _sampled_segment(outline: Tensor, grid: PupilGrid) -> tuple[PupilGrid, Tensor]:
    pixel = outline / grid.spacing + grid.npix / 2
    low, high = pixel.min(dim=0).values.floor().int(), pixel.max(dim=0).values.ceil().int()
    rows = (max(grid.rows[0], int(low[1])), min(grid.rows[1], int(high[1])))
    columns = (max(grid.columns[0], int(low[0])), min(grid.columns[1], int(high[0])))
    window = replace(grid, rows=rows, columns=columns)
    cover = polygon_coverage([outline], window)
    area = cover.sum()
    modes = [cover]
    for axis in (window.x[None, :], window.y[:, None]):
        # Without its mean over the segment, and with an rms of 1 on it, so that a coefficient is in
        # m rms.
        ramp = axis - (cover * axis).sum() / area
        rms = torch.sqrt((cover * ramp**2).sum() / area)
        modes.append(cover * ramp / rms)
    return window, torch.stack(modes)


class FourierModes:
    """Cosines and sines with whole cycles across the pupil array, up to `max_cycles` radially."""

    groups = ("texture",)

    amplitude = math.sqrt(2)
    """Amplitude of the cosines and sines, whose rms is 1."""

    def __init__(self, max_cycles: float = 24.0, min_cycles: float = 0.5) -> None:
        # MASKRND's narrow openings spread light over 11 lambda/D, so a field of 5 arcsec at 4.5 um
        # is sensitive to frequencies up to about 24.
        self.max_cycles, self.min_cycles = float(max_cycles), float(min_cycles)
        # `reach` is the largest number of cycles along an axis.
        self.reach = reach = math.floor(max_cycles)
        # One of each two opposite frequencies, whose cosine and sine are the same but for a sign.
        pairs = [
            (fx, fy)
            for fy in range(reach + 1)
            for fx in range(-reach, reach + 1)
            if (fy > 0 or fx > 0) and min_cycles <= math.hypot(fx, fy) <= max_cycles
        ]
        pairs.sort(key=lambda pair: (pair[0] ** 2 + pair[1] ** 2, pair))
        self.cycles = torch.tensor(pairs, dtype=torch.int64).reshape(-1, 2)

    def __len__(self) -> int:
        return 2 * len(self.cycles)

    @property
    def group_index(self) -> Tensor:
        return torch.zeros(len(self), dtype=torch.int64)

    @property
    def frequencies(self) -> Tensor:
        return torch.linalg.vector_norm(self.cycles.double(), dim=1).repeat_interleave(2)

    def modes(self, grid: PupilGrid, start: int, stop: int) -> Tensor:
        pairs = self.cycles[start // 2 : (stop + 1) // 2].double()
        waves = []
        for axis, positions in ((0, grid.x), (1, grid.y)):
            angle = (2 * math.pi / grid.diameter) * pairs[:, axis, None] * positions
            waves.append(self.amplitude**0.5 * torch.complex(torch.cos(angle), torch.sin(angle)))
        # A plane wave is a product of waves in x and y, which saves trigonometry on the full grid.
        product = waves[1][:, :, None] * waves[0][:, None, :]
        stacked = torch.stack([product.real, product.imag], dim=1)
        first = 2 * (start // 2)
        return stacked.flatten(0, 1)[start - first : stop - first]

    def opd(self, coefficients: Tensor, grid: PupilGrid) -> Tensor:
        # sum c cos + s sin = Re sum (c - i s) exp(i ...): two small matrix products.
        reach = self.reach
        table = torch.zeros(reach + 1, 2 * reach + 1, dtype=torch.complex128)
        pairs = coefficients.double().reshape(-1, 2)
        table = table.index_put(
            (self.cycles[:, 1], self.cycles[:, 0] + reach), torch.complex(pairs[:, 0], -pairs[:, 1])
        )
        fx = torch.arange(-reach, reach + 1).double()
        fy = torch.arange(reach + 1).double()
        in_x = 2 * math.pi / grid.diameter * fx[:, None] * grid.x
        in_y = 2 * math.pi / grid.diameter * grid.y[:, None] * fy
        waves_x = torch.complex(torch.cos(in_x), torch.sin(in_x))
        waves_y = torch.complex(torch.cos(in_y), torch.sin(in_y))
        return self.amplitude * (waves_y @ table @ waves_x).real


class JointBasis:
    """Several bases side by side."""

    def __init__(self, parts: Sequence[Basis]) -> None:
        self.parts = tuple(parts)
        self.groups = tuple(name for part in self.parts for name in part.groups)

    def __len__(self) -> int:
        return sum(len(part) for part in self.parts)

    @property
    def group_index(self) -> Tensor:
        index, offset = [], 0
        for part in self.parts:
            index.append(part.group_index + offset)
            offset += len(part.groups)
        return torch.cat(index)

    @property
    def frequencies(self) -> Tensor:
        return torch.cat([part.frequencies for part in self.parts])

    def modes(self, grid: PupilGrid, start: int, stop: int) -> Tensor:
        pieces, offset = [], 0
        for part in self.parts:
            low, high = max(start - offset, 0), min(stop - offset, len(part))
            if low < high:
                pieces.append(part.modes(grid, low, high))
            offset += len(part)
        return torch.cat(pieces)

    def opd(self, coefficients: Tensor, grid: PupilGrid) -> Tensor:
        total = torch.zeros(grid.shape, dtype=torch.float64)
        offset = 0
        for part in self.parts:
            total = total + part.opd(coefficients[offset : offset + len(part)], grid)
            offset += len(part)
        return total


_MODES_RIDGE = 1e-3
"""Ridge of the fit of modes to maps, relative to the norms of the modes. Modes that are degenerate
on the mirror share what they explain."""

_MODES_AT_A_TIME = 256
"""Modes that are sampled at a time."""


def coefficients_of(maps: Tensor, basis: Basis, grid: PupilGrid) -> Tensor:
    """Coefficients, (maps, modes), of OPD maps, (maps, rows, columns), that are 0 outside a mirror.

    They have the unit of the maps, and are 0 for modes of segments where all maps are 0.
    """
    lit = (maps != 0).any(dim=0)
    parts = [
        basis.modes(grid, start, min(start + _MODES_AT_A_TIME, len(basis)))[:, lit]
        for start in range(0, len(basis), _MODES_AT_A_TIME)
    ]
    inside = torch.cat(parts)
    system = inside @ inside.T
    diagonal = system.diagonal()
    diagonal.copy_(torch.where(diagonal > 0, (1 + _MODES_RIDGE) * diagonal, 1.0))
    return torch.linalg.solve(system, inside @ maps[:, lit].T).T


def fourier_part(basis: Basis) -> tuple[int, FourierModes] | None:
    """Return the last modes of a basis, if they are Fourier modes, and the number before them."""
    last = basis.parts[-1] if isinstance(basis, JointBasis) else basis
    return (len(basis) - len(last), last) if isinstance(last, FourierModes) else None


def default_basis(max_cycles: float = 24.0, pupil: EntrancePupil | None = None) -> Basis:
    """Return the default wavefront modes of a fit, up to `max_cycles` across the pupil.

    JWST, the default, has segment motions and Fourier modes, 1,846 modes up to 24 cycles.
    Other telescopes (see `is_jwst_pupil`) get the Fourier modes alone, whatever their segments are.
    """
    fourier = FourierModes(max_cycles)
    if pupil is None or is_jwst_pupil(pupil.lit, pupil.full.diameter):
        return JointBasis([SegmentMotions(), fourier])
    return fourier
