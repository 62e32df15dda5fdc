"""Planes made from sampled arrays in any orientation.

Inside a system all pupil arrays have the frame in which `MatrixFourier` makes the final image. The
planes of this module take arrays in the frame of their own plane and turn them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from poppy.poppy_core import PlaneType
from scipy.ndimage import spline_filter1d
from torch import Tensor

from pyklip_diffrender.io.units import rotation_matrix
from pyklip_diffrender.optics.grid import PupilGrid, zernike_basis
from pyklip_diffrender.optics.planes import (
    Cache,
    EntrancePupil,
    Plane,
    Position,
    Values,
    Wavefront,
    cached,
    phase_factor,
    position_of,
)
from pyklip_diffrender.parameters import parameter

# Flips and quarter turns between the frames of successive planes, kept exact; other turns.

Matrix = tuple[tuple[int, int], tuple[int, int]]


@dataclass(frozen=True)
class Orientation:
    """A symmetry of the square, one of eight, as the matrix that acts on positions (x, y)."""

    # New position from old: x' = m[0][0] x + m[0][1] y, and likewise for y'.
    matrix: Matrix = ((1, 0), (0, 1))

    @classmethod
    def inversion(cls, axis: str) -> Orientation:
        """Change of sign of "x", "y" or "both"."""
        return cls(((-1 if axis in ("x", "both") else 1, 0), (0, -1 if axis != "x" else 1)))

    @classmethod
    def quarter_turns(cls, count: int) -> Orientation:
        """Counter-clockwise rotation (from +x to +y) by `count` times 90 deg."""
        turned = cls()
        for _ in range(count % 4):
            turned = turned.then(cls(((0, -1), (1, 0))))
        return turned

    def then(self, later: Orientation) -> Orientation:
        """Return the change, followed by another."""
        a, b = later.matrix, self.matrix
        rows = [[sum(a[i][k] * b[k][j] for k in (0, 1)) for j in (0, 1)] for i in (0, 1)]
        return Orientation(((rows[0][0], rows[0][1]), (rows[1][0], rows[1][1])))

    @property
    def inverse(self) -> Orientation:
        """The change back; the matrix is orthogonal."""
        ((a, b), (c, d)) = self.matrix
        return Orientation(((a, c), (b, d)))

    @property
    def sense(self) -> int:
        """1 if counter-clockwise stays counter-clockwise, -1 in a mirror."""
        ((a, b), (c, d)) = self.matrix
        return a * d - b * c

    def positions(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        """New positions of points."""
        ((a, b), (c, d)) = self.matrix
        return a * x + b * y, c * x + d * y

    def apply(self, array: Tensor) -> Tensor:
        """Turn an array (..., n, n) whose middle is the middle of the array."""
        return self._turn(array, roll=0)

    def apply_to_lattice(self, array: Tensor) -> Tensor:
        """Turn an array (..., n, n) whose middle is sample n // 2, as after an FFT, n even.

        The samples at ``-n / 2`` have no mirror image and stay, because they are periodic.
        """
        return self._turn(array, roll=1)

    def _turn(self, array: Tensor, roll: int) -> Tensor:
        ((a, b), (c, d)) = self.matrix
        if a == 0:
            array = array.transpose(-1, -2)
        for sign, axis in ((a + b, -1), (c + d, -2)):
            if sign < 0:
                array = torch.roll(array.flip(axis), roll, axis) if roll else array.flip(axis)
        return array


def is_quarter_turn(optic: Any) -> bool:
    """Whether a plane rotates by a multiple of 90 degrees."""
    return bool(
        optic.planetype == PlaneType.rotation and round(optic.angle / 90) * 90 == optic.angle
    )


def turns_behind(planes: Sequence[Any]) -> list[Orientation]:
    """For every plane, the product of all quarter turns and inversions behind it."""
    turns, turn = [], Orientation()
    for optic in reversed(planes):
        turns.append(turn)
        if optic.planetype == PlaneType.inversion:
            turn = Orientation.inversion(optic.axis).then(turn)
        elif is_quarter_turn(optic):
            turn = Orientation.quarter_turns(round(optic.angle / 90)).then(turn)
    return turns[::-1]


def free_turn(planes: Sequence[Any]) -> float:
    """Rotation of the image by planes that turn by other than right angles, degrees."""
    total, sense = 0.0, 1
    for optic in reversed(planes):
        if optic.planetype == PlaneType.inversion and optic.axis != "both":
            sense = -sense
        elif optic.planetype == PlaneType.rotation and not is_quarter_turn(optic):
            total += optic.angle * sense
    return total


# Rotation of a sampled pupil field by any angle, as in poppy.


class SplineRotation:
    """Cubic-spline rotation of arrays: `scipy.ndimage.rotate` as a linear torch function.

    `angle` is in degrees, from the first axis of the array to the second, as scipy counts; `shape`
    is that of the output as well.
    """

    def __init__(self, angle: float, shape: tuple[int, int]) -> None:
        self._filters = [
            torch.from_numpy(spline_filter1d(np.eye(n), order=3, axis=0)) for n in shape
        ]
        cosine, sine = math.cos(math.radians(angle)), math.sin(math.radians(angle))
        half = [(n - 1) / 2 for n in shape]
        y = (torch.arange(shape[0], dtype=torch.float64) - half[0])[:, None]
        x = (torch.arange(shape[1], dtype=torch.float64) - half[1])[None, :]
        # Where the sample at (y, x) of the result is in the array: the rotation back, about the
        # middle.
        from_row = cosine * y + sine * x + half[0]
        from_column = -sine * y + cosine * x + half[1]
        self._rows = self._taps(from_row, shape[0])
        self._columns = self._taps(from_column, shape[1])
        self._inside = (
            (from_row >= 0)
            & (from_row <= shape[0] - 1)
            & (from_column >= 0)
            & (from_column <= shape[1] - 1)
        )

    @staticmethod
    def _taps(position: Tensor, size: int) -> list[tuple[Tensor, Tensor]]:
        """Index and weight of the four spline coefficients around every position."""
        # Cubic B-splines at the distances 1 + t, t, 1 - t and 2 - t; coefficients beyond an edge
        # are mirrored about the sample at the edge.
        first = torch.floor(position)
        t = position - first
        weights = (
            (1 - t) ** 3 / 6,
            (3 * t**3 - 6 * t**2 + 4) / 6,
            (-3 * t**3 + 3 * t**2 + 3 * t + 1) / 6,
            t**3 / 6,
        )
        taps = []
        for k, weight in enumerate(weights):
            index = (first.to(torch.int64) + k - 1).abs()
            index = torch.where(index > size - 1, 2 * (size - 1) - index, index)
            taps.append((index.clamp(0, size - 1), weight))
        return taps

    def __call__(self, array: Tensor) -> Tensor:
        """Rotate (..., rows, columns), real or complex, with zeros outside the array."""
        kind = array.dtype
        real = torch.float32 if kind in (torch.float32, torch.complex64) else torch.float64
        device = array.device
        down, across = (matrix.to(device, kind) for matrix in self._filters)
        coefficients = down @ array @ across.T
        total = torch.zeros_like(coefficients)
        for rows, row_weight in self._rows:
            for columns, column_weight in self._columns:
                weight = (row_weight * column_weight * self._inside).to(device, real)
                total = total + coefficients[..., rows.to(device), columns.to(device)] * weight
        return total


class FreeRotation(Plane):
    """A rotation of the field in a pupil by `angle` degrees, counter-clockwise (system's frame)."""

    def __init__(self, angle: float, npix: int, diameter: float, name: str) -> None:
        self.name = name
        self._full = PupilGrid.full(npix, diameter)
        self._rotation = SplineRotation(-angle, (npix, npix))

    def window(self, values: Values) -> PupilGrid:
        """The whole pupil."""
        return self._full

    def apply(self, wavefront: Wavefront, values: Values, onto: PupilGrid) -> Wavefront:
        """Rotate the field on the array of the pupil."""
        field = self._rotation(wavefront.grid.crop(wavefront.field, self._full))
        return replace(wavefront, field=self._full.crop(field, onto), grid=onto)


class OrientedPupil(EntrancePupil):
    """An entrance pupil in any frame, with a wavefront and a pointing of its own.

    `amplitude` and `opd` (m), for calls without one, are (npix, npix) in the frame of the entrance
    pupil, which `orientation` takes to that of the system. `pointing`, x, y in arcsec on the image,
    is added to every star offset, and `chromatic` has for wavelengths (m) an OPD (m, same frame)
    that is added to that of every call.
    """

    sampled = True

    def __init__(
        self,
        amplitude: Tensor,
        opd: Tensor,
        diameter: float,
        dtype: torch.dtype,
        device: torch.device,
        name: str,
        orientation: Orientation,
        pointing: tuple[float, float] = (0.0, 0.0),
        chromatic: Mapping[float, Tensor] | None = None,
        turned: float = 0.0,
        collected: float | None = None,
    ) -> None:
        array = orientation.apply(amplitude).contiguous().to(device)
        super().__init__(array, diameter, dtype, name)
        # The sum of the squared amplitude of the true pupil, in units of a sample's area: samples
        # that are means over partly blocked areas have less.
        if collected is not None:
            self.amplitude = self.amplitude * math.sqrt(self.total / collected)
            self.total = collected
        self.opd = opd.to(device, torch.float64)
        self.lit = (amplitude > 0).to(device)
        """Samples that transmit light, (npix, npix), in the frame of the OPD."""
        self.orientation = orientation
        self.pointing = torch.tensor(pointing, dtype=torch.float64, device=device)
        self.chromatic = {w: extra.to(device) for w, extra in (chromatic or {}).items()}
        # Planes behind rotate the image by `turned` degrees counter-clockwise; sources are rotated
        # the other way, so that they appear at their star offset.
        self._tilt = torch.from_numpy(rotation_matrix(-turned).T.copy()).to(device)

    def on_window(self, maps: Tensor) -> Tensor:
        """See `EntrancePupil.on_window`; the maps have the frame of the entrance pupil."""
        return super().on_window(self.orientation.apply(maps))

    def field(self, opd: Tensor, wavelength: float, star_offset: Tensor | None) -> Wavefront:
        """See `EntrancePupil.field`; `opd` has the frame of the entrance pupil."""
        if wavelength in self.chromatic:
            opd = opd + self.chromatic[wavelength]
        offset = self.pointing if star_offset is None else star_offset + self.pointing
        offset = offset @ self._tilt
        return super().field(opd, wavelength, offset)


class PupilOptic(Plane):
    """Amplitude and phase in a pupil plane, one array per wavelength (m).

    Complex amplitude transmissions are (npix, npix) in the frame of this plane, which `orientation`
    takes to that of the system; a larger array reaches beyond the pupil by as much on every side.
    """

    sampled = True
    pointwise = True

    def __init__(
        self,
        phasors: Mapping[float, Tensor],
        npix: int,
        diameter: float,
        dtype: torch.dtype,
        device: torch.device,
        name: str,
        orientation: Orientation,
    ) -> None:
        self.name = name
        size = next(iter(phasors.values())).shape[-1]
        first = -((size - npix) // 2)
        full = PupilGrid(npix, diameter, (first, first + size), (first, first + size))
        used = torch.stack([p != 0 for p in {id(p): p for p in phasors.values()}.values()])
        self.grid = full.around(orientation.apply(used.any(dim=0)))
        turned_phasors: dict[int, Tensor] = {}
        for phasor in phasors.values():
            if id(phasor) not in turned_phasors:
                turned = full.crop(orientation.apply(phasor), self.grid).contiguous()
                turned_phasors[id(phasor)] = turned.to(device, dtype.to_complex())
        self._phasors = {
            wavelength: turned_phasors[id(phasor)] for wavelength, phasor in phasors.items()
        }
        self._full, self._dtype = full, dtype

    def window(self, values: Values) -> PupilGrid:
        """The window with all samples that transmit light at some wavelength."""
        return self.grid

    def apply(self, wavefront: Wavefront, values: Values, onto: PupilGrid) -> Wavefront:
        """Multiply by the phasor."""
        field = wavefront.grid.crop(wavefront.field, self.grid)
        field = field * self._phasors[wavefront.wavelength]
        return replace(wavefront, field=field, grid=self.grid)


class MovableStop(PupilOptic):
    """A stop known from its samples only, that can be shifted and turned as a `planes.LyotStop`."""

    parameters = ("lyot_shift", "lyot_rotation")
    margin = 0.06
    """Room for shifts and rotations, as a fraction of the diameter."""

    @cached_property
    def _latest(self) -> Cache[tuple[int, PupilGrid], tuple[Position, Tensor]]:
        return Cache()

    def _moves(self, values: Values) -> bool:
        return any(name in values for name in self.parameters)

    def window(self, values: Values) -> PupilGrid:
        """See `PupilOptic.window`; with a margin if the stop is moved."""
        if not self._moves(values):
            return self.grid
        return self.grid.widened(self.margin * self._full.diameter)

    def apply(self, wavefront: Wavefront, values: Values, onto: PupilGrid) -> Wavefront:
        """Multiply by the stop at its position."""
        # At rest the samples are used directly. Elsewhere they are interpolated by cubic
        # convolution, which is exact for shifts by whole samples.
        if not self._moves(values):
            return super().apply(wavefront, values, onto)
        window = self.window(values)
        field = wavefront.grid.crop(wavefront.field, window)
        phasor = self._phasors[wavefront.wavelength]
        stop = cached(
            self._latest,
            (id(phasor), window),
            position_of(values, self.parameters),
            lambda: self._moved(phasor, window, values),
        )
        return replace(wavefront, field=field * stop, grid=window)

    def _moved(self, phasor: Tensor, window: PupilGrid, values: Values) -> Tensor:
        """The shifted and rotated stop on a window."""
        zero = torch.zeros(2, dtype=torch.float64, device=phasor.device)
        shift = values.get("lyot_shift", zero) * self._full.diameter
        angle = torch.deg2rad(values.get("lyot_rotation", zero[:1])).reshape(())
        x = window.x.to(phasor.device)[None, :] - shift[0]
        y = window.y.to(phasor.device)[:, None] - shift[1]
        # The position in the stop at rest of each sample: the inverse motion.
        from_x = torch.cos(angle) * x + torch.sin(angle) * y
        from_y = -torch.sin(angle) * x + torch.cos(angle) * y
        spacing = self.grid.spacing
        rows = (from_y - float(self.grid.y[0])) / spacing
        columns = (from_x - float(self.grid.x[0])) / spacing
        return _cubic(phasor, rows, columns)


def _cubic(array: Tensor, rows: Tensor, columns: Tensor) -> Tensor:
    """Values of an array (ny, nx) at positions in samples, by cubic convolution; zero outside."""
    # R. Keys, IEEE Trans. Acoust. Speech Signal Process. 29, 1153, 1981, with a = -1/2: weights at
    # the distances 1 + t, t, 1 - t and 2 - t. Differentiable in forward and reverse mode, unlike
    # torch's `grid_sample`.
    ny, nx = array.shape
    edge = 4  # Positions far outside are clamped to this margin of zeros.
    flat = torch.nn.functional.pad(array, (edge,) * 4).flatten()
    taps = []
    for position, count in ((rows, ny), (columns, nx)):
        below = torch.floor(position.detach())
        t = position - below
        weights = (
            ((2 - t) * t - 1) * t / 2,
            ((3 * t - 5) * t * t + 2) / 2,
            ((4 - 3 * t) * t + 1) * t / 2,
            (t - 1) * t * t / 2,
        )
        first = (below.to(torch.int64) + edge - 1).clamp(0, count + edge)
        taps.append((first, [weight.to(array.real.dtype) for weight in weights]))
    (top, down), (left, across) = taps
    corner = top * (nx + 2 * edge) + left
    total = torch.zeros((), dtype=array.dtype, device=array.device)
    for i, row_weight in enumerate(down):
        line = torch.zeros((), dtype=array.dtype, device=array.device)
        for j, column_weight in enumerate(across):
            line = line + column_weight * flat[corner + (i * (nx + 2 * edge) + j)]
        total = total + row_weight * line
    return total


class AberrationOptic(PupilOptic):
    """A sampled aberration plus free Zernikes as in `planes.InternalAberration`."""

    parameters = ("si_zernikes",)

    @cached_property
    def _bases(self) -> Cache[PupilGrid, Tensor]:
        return Cache()

    def _zernikes(self) -> Tensor:
        count = parameter("si_zernikes").size
        basis = zernike_basis(count, self.grid.x, self.grid.y, self.grid.diameter / 2)
        return basis.to(next(iter(self._phasors.values())).device)

    def apply(self, wavefront: Wavefront, values: Values, onto: PupilGrid) -> Wavefront:
        """Multiply by the phasors of the samples and of the Zernikes."""
        wavefront = super().apply(wavefront, values, onto)
        if "si_zernikes" not in values:
            return wavefront
        opd = torch.tensordot(
            values["si_zernikes"], self._bases.kept(self.grid, self._zernikes), dims=1
        )
        factor = phase_factor(opd, wavefront.wavelength, self._dtype)
        return replace(wavefront, field=wavefront.field * factor)


@dataclass
class Gain(Plane):
    """A uniform factor; 1 for a plane without effect on the field."""

    name: str
    factor: complex = 1.0  # amplitude transmission
    edge: PupilGrid | None = None  # window outside which the field is cut off
    pointwise = True

    def apply(self, wavefront: Wavefront, values: Values, onto: PupilGrid) -> Wavefront:
        """Multiply."""
        if self.edge is not None:
            grid = wavefront.grid.intersection(self.edge)
            wavefront = replace(
                wavefront, field=wavefront.grid.crop(wavefront.field, grid), grid=grid
            )
        if self.factor == 1:
            return wavefront
        return replace(wavefront, field=wavefront.field * self.factor)
