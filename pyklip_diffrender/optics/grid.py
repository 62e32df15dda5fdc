"""Pupil grids, the exact rasterisation of polygons onto them, Zernike polynomials, convolution.

Orientation: all pupil planes are in OTE entrance-pupil orientation, x along +V2 and y along
+V3, arrays [y, x], pixel centres at ``(arange(n) - (n - 1) / 2) * D / n``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from math import comb, sqrt

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.fft import irfft2, next_fast_len, rfft2
from torch import Tensor

from pyklip_diffrender.errors import ShapeError
from pyklip_diffrender.io.units import ARCSEC, native_float64

JWST_DIAMETER = 6.603464
"""Circumscribed diameter of the primary, m (stpsf.constants 2.2.0)."""

STAR_RADIUS = 2.0
"""Radius of a star's image, arcsec. Light at larger radii is too faint to matter behind a mask."""


@dataclass(frozen=True)
class PupilGrid:
    """A rectangular window of an ``npix`` x ``npix`` pupil array of side ``diameter``."""

    npix: int
    diameter: float  # m, side of the full array
    rows: tuple[int, int]  # [start, stop) of the window
    columns: tuple[int, int]

    @classmethod
    def full(cls, npix: int, diameter: float = JWST_DIAMETER) -> PupilGrid:
        """The window that is the whole array."""
        return cls(npix, diameter, (0, npix), (0, npix))

    @property
    def spacing(self) -> float:
        """Distance between samples, m."""
        return self.diameter / self.npix

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the window."""
        return self.rows[1] - self.rows[0], self.columns[1] - self.columns[0]

    @property
    def x(self) -> Tensor:
        """Sample positions along V2, m, float64."""
        return self._positions(self.columns)

    @property
    def y(self) -> Tensor:
        """Sample positions along V3, m, float64."""
        return self._positions(self.rows)

    def _positions(self, limits: tuple[int, int]) -> Tensor:
        index = torch.arange(*limits, dtype=torch.float64)
        return (index - (self.npix - 1) / 2) * self.spacing

    def around(self, array: Tensor) -> PupilGrid:
        """The smallest window of this one outside which `array` is zero."""
        used = array.detach() != 0
        rows = torch.nonzero(used.any(dim=1)).flatten().tolist() or [0]
        columns = torch.nonzero(used.any(dim=0)).flatten().tolist() or [0]
        return replace(
            self,
            rows=(self.rows[0] + rows[0], self.rows[0] + rows[-1] + 1),
            columns=(self.columns[0] + columns[0], self.columns[0] + columns[-1] + 1),
        )

    def widened(self, margin: float) -> PupilGrid:
        """Return the window with `margin` metres added on every side, inside the full array."""
        extra = int(np.ceil(margin / self.spacing))
        return replace(
            self,
            rows=(max(0, self.rows[0] - extra), min(self.npix, self.rows[1] + extra)),
            columns=(max(0, self.columns[0] - extra), min(self.npix, self.columns[1] + extra)),
        )

    def intersection(self, other: PupilGrid) -> PupilGrid:
        """Return the part that this window shares with another, empty if they are apart."""
        pairs = [(self.rows, other.rows), (self.columns, other.columns)]
        starts = [max(mine[0], its[0]) for mine, its in pairs]
        stops = [max(start, min(p[0][1], p[1][1])) for start, p in zip(starts, pairs, strict=True)]
        return replace(self, rows=(starts[0], stops[0]), columns=(starts[1], stops[1]))

    def crop(self, array: Tensor, to: PupilGrid) -> Tensor:
        """Cut the window `to` out of an array (..., rows, columns) on this; zero outside."""
        if to == self:
            return array
        top, bottom = to.rows[0] - self.rows[0], self.rows[1] - to.rows[1]
        left, right = to.columns[0] - self.columns[0], self.columns[1] - to.columns[1]
        height, width = self.shape
        if top >= height or bottom >= height or left >= width or right >= width:
            return array.new_zeros((*array.shape[:-2], *to.shape))  # No overlap.
        if min(top, bottom, left, right) < 0:
            return torch.nn.functional.pad(array, (-left, -right, -top, -bottom))
        return array[..., top : top + to.shape[0], left : left + to.shape[1]]


def samples_for_field(field: float, wavelength: float, diameter: float = JWST_DIAMETER) -> int:
    """Smallest number of pupil samples for which the image does not repeat inside `field` arcsec.

    `wavelength` (m) is the shortest one, `diameter` (m) the side of the pupil array.
    """
    return math.ceil(field * ARCSEC * diameter / wavelength)


def doubled_samples(
    npix: int, field: float, wavelength: float, diameter: float = JWST_DIAMETER
) -> int:
    """Pupil samples `npix`, doubled until there are enough for `field`, see `samples_for_field`."""
    needed = samples_for_field(field, wavelength, diameter)
    while npix < needed:
        npix *= 2
    return npix


def resample(opd: NDArray[np.float64], npix: int) -> NDArray[np.float64]:
    """Resample pupil maps (..., n, n) to (..., npix, npix), float64, across the same pupil.

    A map of the right size is returned without a copy. ShapeError if the maps are not square.
    """
    if opd.ndim < 2 or opd.shape[-1] != opd.shape[-2] or not opd.size:
        raise ShapeError(
            f"opd: got shape {opd.shape}, expected square maps, (..., npix, npix), as wide as the "
            "pupil array. Pad the missing samples with zeros"
        )
    count = opd.shape[-1]
    if npix == count:
        return opd
    maps = torch.from_numpy(native_float64(opd)).reshape(-1, 1, count, count)
    # Blocks are averaged where the numbers of pixels divide, which keeps the mean exactly;
    # otherwise maps are interpolated, and smoothed before (`antialias`) if the new pixels are
    # larger.
    if count % npix == 0:
        maps = torch.nn.functional.avg_pool2d(maps, count // npix)
    else:
        maps = torch.nn.functional.interpolate(
            maps, size=(npix, npix), mode="bilinear", align_corners=False, antialias=True
        )
    return np.asarray(maps.reshape(*opd.shape[:-2], npix, npix).numpy())


def fft_convolve(
    images: NDArray[np.float64], kernel: NDArray[np.float64], *, full: bool = False
) -> NDArray[np.float64]:
    """Convolve images, (..., ny, nx), with a kernel, (my, mx); zero beyond their edges.

    The result has the size of the images, or, if `full`, every pixel that light gets to,
    (..., ny + my - 1, nx + mx - 1). A kernel is about its pixel (my - 1) // 2, (mx - 1) // 2.
    """
    # As scipy.signal.fftconvolve, whose import loads all of scipy.stats.
    sides = np.array(images.shape[-2:]), np.array(kernel.shape)
    ny, nx = sides[0] + sides[1] - 1
    padded = (next_fast_len(int(ny), real=True), next_fast_len(int(nx), real=True))
    result = irfft2(rfft2(images, padded) * rfft2(kernel, padded), padded)[..., :ny, :nx]
    if not full:
        y, x = (sides[1] - 1) // 2
        result = result[..., y : y + sides[0][0], x : x + sides[0][1]]
    return np.ascontiguousarray(result)


def polygon_coverage(polygons: list[Tensor], grid: PupilGrid) -> Tensor:
    """Fraction of each pixel's area inside non-overlapping polygons, (rows, columns), float64.

    Each polygon is (vertices, 2), x, y in m, in either sense of rotation and not self-intersecting.
    The area is exact, whatever the grid, and differentiable in the vertices.
    """
    # In units of pixels, let C(i, j) be the covered area of the pixel in row i, column j. By
    # Green's theorem the area of a polygon is the integral of x dy along its edges, and the area to
    # the left of a vertical line is the same integral with x cut off at the line. All edges are cut
    # at the borders of pixels (`_border_crossings`). A straight piece of an edge in pixel (i, j),
    # from y1 to y2 with its middle at x = j + f, bounds the strip between the piece and the right
    # end of row i, which has the area
    #
    #     (y1 - y2) (1 - f)   in the pixel (i, j) itself, a trapezium,
    #     (y1 - y2)           in every pixel (i, j + 1), (i, j + 2), ... to its right,
    #
    # for edges that run counter-clockwise. Summed over the pieces, areas outside the polygon
    # cancel. The second line needs no loop: each piece adds
    #
    #     D(i, j) += (y1 - y2) (1 - f),    D(i, j + 1) += (y1 - y2) f,
    #
    # and C(i, j) = D(i, 0) + ... + D(i, j), a cumulative sum (the accumulation buffer of font
    # rasterisers). The derivatives with respect to the vertices come from the ends of the pieces;
    # the integers i, j are constant except where a vertex crosses a border, where C is continuous.
    rows, columns = grid.shape
    origin = torch.tensor([grid.columns[0], grid.rows[0]], dtype=torch.float64)
    # All polygons are computed at once, because the number of operations determines the time.
    sizes = torch.tensor([len(polygon) for polygon in polygons])
    owner = torch.repeat_interleave(torch.arange(len(polygons)), sizes)
    first = (sizes.cumsum(0) - sizes)[owner]
    following = first + (torch.arange(len(owner)) - first + 1) % sizes[owner]
    start = torch.cat(polygons).to(torch.float64) / grid.spacing + grid.npix / 2 - origin
    end = start[following]
    (x, y), (x2, y2) = start.detach().T, end.detach().T
    area = torch.zeros(len(polygons), dtype=torch.float64).index_add(0, owner, x * y2 - x2 * y)
    sense = torch.sign(area)[owner]

    edge, fraction = _border_crossings(start, end)
    begin = start[edge] + fraction[:-1, None] * (end - start)[edge]
    # A piece ends where the next piece of its edge begins; the last piece ends at 1.
    last = torch.ones(len(edge), dtype=torch.bool)
    last[:-1] = edge[1:] != edge[:-1]
    stop_fraction = torch.where(last, torch.ones_like(fraction[1:]), fraction[1:])
    finish = start[edge] + stop_fraction[:, None] * (end - start)[edge]

    middle = (begin + finish) / 2
    column, row = torch.floor(middle.detach()).to(torch.int64).unbind(dim=1)
    height = -(finish - begin)[:, 1] * sense[edge]
    # A piece to the left of the window fills its row; a piece to the right does not contribute.
    beyond = column < 0
    inside_x = torch.where(beyond, torch.zeros_like(height), middle[:, 0] - column)
    column = column.clamp(0, columns)
    kept = (row >= 0) & (row < rows)
    flat = (row * (columns + 2) + column)[kept]
    accumulated = torch.zeros(rows * (columns + 2), dtype=torch.float64)
    accumulated = accumulated.index_add(0, flat, (height * (1 - inside_x))[kept])
    accumulated = accumulated.index_add(0, flat + 1, (height * inside_x)[kept])
    covered = accumulated.reshape(rows, columns + 2).cumsum(dim=1)[:, :columns]
    # Rounding leaves 1e-14 to the right of a polygon.
    return torch.where(covered.detach().abs() < 1e-11, torch.zeros_like(covered), covered)


def _border_crossings(start: Tensor, end: Tensor) -> tuple[Tensor, Tensor]:
    """Cut edges (n, 2) at integer x and y: the edge of each piece, and its start.

    Edges are (pieces,), int64, ascending; starts are (pieces + 1,), fractions of the edge,
    ascending within an edge, with one spare element.
    """
    edges = [torch.arange(len(start))]
    fractions = [torch.zeros(len(start), dtype=torch.float64)]
    for axis in (0, 1):
        a, b = start[:, axis], end[:, axis]
        # The edge from a to b crosses the integers strictly between them, `first` to `after` - 1.
        # It crosses k at the fraction (k - a) / (b - a).
        first = torch.floor(torch.minimum(a, b).detach()).to(torch.int64) + 1
        after = torch.ceil(torch.maximum(a, b).detach()).to(torch.int64)
        count = (after - first).clamp(min=0)
        edge = torch.repeat_interleave(torch.arange(len(start)), count)
        order = torch.arange(len(edge)) - (count.cumsum(0) - count)[edge]
        fractions.append((first[edge] + order - a[edge]) / (b - a)[edge])
        edges.append(edge)
    edge, fraction = torch.cat(edges), torch.cat(fractions)
    order = torch.argsort(fraction.detach(), stable=True)
    order = order[torch.argsort(edge[order], stable=True)]
    return edge[order], torch.cat([fraction[order], torch.ones(1, dtype=torch.float64)])


def transform_polygons(polygons: list[Tensor], shift: Tensor, rotation: Tensor) -> list[Tensor]:
    """Turn polygons (vertices, 2) by `rotation` about the pupil's centre, then add `shift`.

    Vertices and `shift` (2,) are x, y in m; the angle is in radians, counter-clockwise (+x to +y).
    """
    cosine, sine = torch.cos(rotation), torch.sin(rotation)
    matrix = torch.stack([torch.stack([cosine, sine]), torch.stack([-sine, cosine])])
    moved = torch.cat(polygons) @ matrix + shift
    return list(moved.split([len(polygon) for polygon in polygons]))


def widen_polygon(polygon: Tensor, distance: float) -> Tensor:
    """Move every edge of a convex polygon outwards by `distance` m (inwards if negative)."""
    edge = polygon.roll(-1, dims=0) - polygon
    sense = torch.sign((polygon * polygon.roll(-1, dims=0).flip(1) * torch.tensor([1, -1])).sum())
    normal = sense * torch.stack([edge[:, 1], -edge[:, 0]], dim=1)
    normal = normal / normal.norm(dim=1, keepdim=True)
    before = normal.roll(1, dims=0)
    # A corner moves along the bisector until both edges have moved by the distance.
    bisector = (before + normal) / (1 + (before * normal).sum(dim=1, keepdim=True))
    return polygon + distance * bisector


# Zernike polynomials are in Noll's order and have unit rms on the disc: R. J. Noll, "Zernike
# polynomials and atmospheric turbulence", J. Opt. Soc. Am. 66, 207 (1976).


def noll_indices(j: int) -> tuple[int, int]:
    """Radial order n and azimuthal frequency m (negative for sines) of Noll index `j` >= 1."""
    n = 0
    while (n + 1) * (n + 2) // 2 < j:
        n += 1
    rank = j - n * (n + 1) // 2
    magnitude = 2 * (rank // 2) if n % 2 == 0 else 2 * ((rank - 1) // 2) + 1
    return n, magnitude if j % 2 == 0 else -magnitude


def zernike_basis(count: int, x: Tensor, y: Tensor, radius: float) -> Tensor:
    """The first `count` Noll Zernikes on a grid, (count, rows, columns); zero outside the disc.

    `x` is (columns,), `y` (rows,), `radius` the radius of the disc, all in m. The first is piston.
    """
    # rho^m exp(i m theta) is a power of x + i y: no trigonometry, and smooth at the centre.
    point = torch.complex(*torch.broadcast_tensors(x[None, :] / radius, y[:, None] / radius))
    squared = point.real**2 + point.imag**2
    inside = (squared <= 1).to(squared.dtype)
    highest = noll_indices(count)[0]
    waves = [torch.ones_like(point)]
    even = [torch.ones_like(squared)]
    for _ in range(highest):
        waves.append(waves[-1] * point)
        even.append(even[-1] * squared)
    basis = []
    for j in range(1, count + 1):
        n, m = noll_indices(j)
        half = (n - abs(m)) // 2
        # R_n^m(rho) = sum_k (-1)^k C(n - k, k) C(n - 2k, (n - m) / 2 - k) rho^(n - 2k). `radial` is
        # R without the factor rho^m, which is in `waves`. sqrt(n + 1), and sqrt(2 (n + 1)) for
        # m > 0, make the rms on the disc 1.
        radial = sum(
            (-1) ** k * comb(n - k, k) * comb(n - 2 * k, half - k) * even[half - k]
            for k in range(half + 1)
        )
        if m == 0:
            basis.append(sqrt(n + 1) * radial * inside)
        else:
            wave = waves[m].real if m > 0 else waves[-m].imag
            basis.append(sqrt(2 * (n + 1)) * radial * wave * inside)
    return torch.stack(basis)
