"""Point sources at every detector pixel, by convolution on a lattice aligned with the pixels.

In the notation of `optics.fast_path`, a source on the axis has the field

    A(x) = F[L E](x) - sum_c K(x - c) B(c) F[E](c),     K = F[L],   B = (1 - t) cell / lambda.

A source at p multiplies E by exp(-2 pi i p xi / lambda), which shifts its transforms by p:

    A_p(x) = F[L E](x - p) - sum_c K(x - c) B(c) F[E](c - p).

Mask and stop stay where they are, so K and B do not change. If samples x, cells c and sources p are
points of one lattice, so are x - p and c - p. Both transforms are computed once, on the parts of
the lattice that hold all differences: for n pixels of k samples, k (2 n - 1) differences x - p; for
2 h + 1 cells, q per pixel, 2 h + 1 + q (n - 1) differences c - p. For each source, a window of the
first and one of the second are cut out, and the sum is two FFTs of the size of the detector.

Intensities are added over wavelengths, and binned to pixels in the end. Where B F[E](c - p) changes
an image by a percent at most (far from the mask), the sum is left out, and all images are one
array, shifted.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence

import torch
from numpy.typing import ArrayLike
from torch import Tensor

from pyklip_diffrender.errors import ShapeError
from pyklip_diffrender.io.units import ARCSEC
from pyklip_diffrender.optics.fast_path import LatticeRoute, OcculterLattice
from pyklip_diffrender.optics.planes import (
    CompactOcculter,
    Detector,
    MatrixFourier,
    Plane,
    Wavefront,
)
from pyklip_diffrender.optics.propagation import Value, batch_of
from pyklip_diffrender.optics.system import OpticalSystem

Index = ArrayLike | Tensor

_log = logging.getLogger(__name__)

_DOUBLE_PRECISION_MASK_RADII = 0.15
"""Fraction of the mask's radius within which sources are computed in double precision. The mask
suppresses their light a thousandfold, and the error of single precision is 4e-6 of the image."""

_IMAGE_DIFFERENCE_RMS = 0.01
"""Largest relative rms difference from the images of the model for which the mask, or its outer
parts, are ignored. An error of a percent in a planet's template costs 5e-5 of the S/N."""

_TESTED_SOURCES = 12
"""Number of sources just outside the mask whose images decide whether to ignore the mask there."""


class PointSources:
    """Images of point sources at the centres of detector pixels, many at a time.

    `opd` (npix, npix) in m and `values` are as in a call of the model, but a ``star_offset`` is
    ignored: sources are at the pixels, moved by `offset`, x, y in arcsec. `sampling` is the
    smallest number of cells of the occulter per lambda/D. With `wrapped`, the light of the outer
    parts of the mask may wrap around the detector (`optics.fast_path`): images change by up to
    5e-5, and take two thirds of the time.
    """

    def __init__(
        self,
        model: OpticalSystem,
        opd: Value | None = None,
        values: Mapping[str, Value | None] | None = None,
        *,
        sampling: float = 1.5,
        offset: tuple[float, float] = (0.0, 0.0),
        wrapped: bool = False,
    ) -> None:
        self.model, self._wrapped = model, wrapped
        self._offset = torch.tensor(offset, dtype=torch.float64, device=model.device)
        fixed = {name: value for name, value in (values or {}).items() if name != "star_offset"}
        with torch.no_grad():
            self._opd = model.opd(opd).detach()
            if self._opd.ndim != 2:
                raise ShapeError(f"opd: got shape {tuple(self._opd.shape)}, expected one map")
            self._values = {name: value.detach() for name, value in model.values(fixed).items()}
            # `route` is "lattice", or "model" where images are calls of the model: if the planes
            # are not one mask between pupil planes, or if leaving out all parts of a mask but the
            # first changes the images of a few test sources by more than a percent. `reach`
            # (arcsec) is the distance from the axis beyond which the mask is ignored, because it
            # changes images by a percent at most. These images differ by a shift alone, and cost
            # next to nothing.
            self._radius, self.reach, self._reduced = 0.0, math.inf, False
            self._waves = self._prepared(sampling)
            self.route = "lattice" if self._waves else "model"
            if not self._agrees():
                self._waves, self.route = [], "model"
            self.reach = self._reach()
        _log.debug("images of point sources: method %r", self.route)

    def _prepared(self, sampling: float) -> list[_Wave]:
        """Transforms at all wavelengths; an empty list if `_one_mask` returns None."""
        waves = []
        for wavelength in self.model.bandpass.wavelengths:
            planes = _one_mask(self.model, wavelength)
            if planes is None:
                return []
            self._reduced |= planes != list(self.model.between)
            masks = [plane.radius for plane in planes if isinstance(plane, CompactOcculter)]
            self._radius = max(self._radius, *masks, 0.0)
            waves.append(self._wave(planes, wavelength, sampling))
        return waves

    def _agrees(self) -> bool:
        """Whether images agree with calls of the model, between the middle and a corner."""
        if self.route == "model" or not self._reduced:
            return True
        ny, nx = self.model.detector.shape
        share = torch.tensor([0.55, 0.65, 0.8, 1.0], dtype=torch.float64)
        rows, columns = ((share * (n - 1)).round().to(torch.int64) for n in (ny, nx))
        exact = self.model(self._opd, self.positions(rows, columns), **self._values).double()
        away = (self.images(rows, columns).double() - exact).flatten(1).norm(dim=1)
        return bool((away <= _IMAGE_DIFFERENCE_RMS * exact.flatten(1).norm(dim=1)).all())

    def _reach(self) -> float:
        """The radius of the mask if the mask can be ignored beyond it, else infinity."""
        if self.route == "model" or not self._radius:
            return math.inf
        ny, nx = self.model.detector.shape
        rows, columns = torch.unravel_index(torch.arange(ny * nx), (ny, nx))
        distances = self.positions(rows, columns).norm(dim=-1).cpu()
        nearest = distances.argsort()
        nearest = nearest[distances[nearest] > self._radius][:_TESTED_SOURCES]
        if not len(nearest):
            return math.inf
        # A mask with a sharp edge changes images far beyond it.
        exact, plain = (
            self._batch_of_images(rows[nearest], columns[nearest], False, masked).flatten(1)
            for masked in (True, False)
        )
        alike = ((plain - exact).norm(dim=1) <= _IMAGE_DIFFERENCE_RMS * exact.norm(dim=1)).all()
        return self._radius if bool(alike) else math.inf

    def _wave(self, planes: Sequence[Plane], wavelength: float, sampling: float) -> _Wave:
        model, values = self.model, self._values
        windows = model.windows(values)
        tilted = {**values, "star_offset": self._offset} if self._offset.any() else values
        front = model.pupil_field(self._opd, wavelength, tilted)
        ones = torch.ones((), dtype=model.dtype.to_complex(), device=model.device)
        stop = Wavefront(ones.expand(front.grid.shape), wavelength, front.grid)
        occulter = None
        # Planes up to the occulter act on the field of the source. Planes behind the occulter are
        # multiplied, because the kernel is the transform of their product. Without an occulter, all
        # planes act on the field.
        for plane, onto in zip(planes, windows, strict=True):
            if isinstance(plane, CompactOcculter):
                occulter = plane
                stop = Wavefront(ones.expand(onto.shape), wavelength, onto)
            elif occulter is None:
                front = plane.apply(front, values, onto)
                stop = Wavefront(ones.expand(front.grid.shape), wavelength, front.grid)
            else:
                stop = plane.apply(stop, values, onto)
        axes = tuple(model.detector.axes(values))
        return _Wave(front, stop, occulter, model.detector, axes, sampling, self._wrapped)

    def positions(self, rows: Index, columns: Index) -> Tensor:
        """Sources of pixels relative to the optical axis, (k, 2) as x, y in arcsec, float64."""
        rows, columns = self._indices(rows, columns)
        detector = self.model.detector
        x, y = (
            axis.reshape(-1, detector.oversample).mean(dim=1) / ARCSEC
            for axis in detector.axes(self._values)
        )
        centres = torch.stack([x[columns], y[rows] + detector.shear * x[columns]], dim=-1)
        return centres + self._offset

    def images(self, rows: Index, columns: Index) -> Tensor:
        """Images of point sources in pixels `rows`, `columns`, (k,) each: (k, ny, nx), float32.

        The images are ``model(opd, star_offset=position, **values)``: light per detector pixel as a
        fraction of the light that the pupil collects. ShapeError for pixels that are not on the
        detector.
        """
        rows, columns = self._indices(rows, columns)
        shape = (len(rows), *self.model.detector.shape)
        images = torch.empty(shape, dtype=torch.float32, device=self.model.device)
        with torch.no_grad():
            distances = self.positions(rows, columns).norm(dim=-1)
            radius = self._radius if self.model.dtype == torch.float64 else 0.0
            needs_double = distances < _DOUBLE_PRECISION_MASK_RADII * radius
            masked = distances <= self.reach
            for kind in ((False, False), (False, True), (True, True)):
                selected = torch.nonzero((needs_double == kind[0]) & (masked == kind[1])).flatten()
                for part in selected.split(self._batch(kind[0])) if len(selected) else ():
                    images[part] = self._batch_of_images(rows[part], columns[part], *kind)
        return images

    def _indices(self, rows: Index, columns: Index) -> tuple[Tensor, Tensor]:
        pair = []
        for name, values, count in zip(
            ("rows", "columns"), (rows, columns), self.model.detector.shape, strict=True
        ):
            index = torch.as_tensor(values, device=self.model.device).reshape(-1).to(torch.int64)
            if len(index) and (int(index.min()) < 0 or int(index.max()) >= count):
                raise ShapeError(f"{name}: expected indices from 0 to {count - 1}")
            pair.append(index)
        if len(pair[0]) != len(pair[1]):
            raise ShapeError(f"got {len(pair[0])} rows and {len(pair[1])} columns")
        return pair[0], pair[1]

    def _batch(self, double: bool) -> int:
        if self.route == "lattice":
            dtype = torch.complex128 if double else torch.complex64
            return batch_of(max(wave.size for wave in self._waves), dtype, self.model.device)
        return batch_of(self.model.npix**2, self.model.dtype.to_complex(), self.model.device)

    def _batch_of_images(self, rows: Tensor, columns: Tensor, double: bool, masked: bool) -> Tensor:
        if self.route == "model":
            offsets = self.positions(rows, columns)
            return self.model(self._opd, offsets, **self._values).to(torch.float32)
        oversample = self.model.detector.oversample
        ny, nx = (count * oversample for count in self.model.detector.shape)
        real = torch.float64 if double else torch.float32
        total = torch.zeros(len(rows), ny, nx, dtype=real, device=self.model.device)
        for wave, weight in zip(self._waves, self.model.bandpass.weights, strict=True):
            wave.add_intensity(total, rows, columns, float(weight), masked)
        return self.model.detector.image(total, self._values).to(torch.float32)


def _one_mask(model: OpticalSystem, wavelength: float) -> list[Plane] | None:
    """Planes of a model with compact occulters in place of the focal masks.

    None unless the planes are at most one mask between factors in the pupil.
    """
    planes: list[Plane] = []
    for plane in model.between:
        each: Plane | None = plane
        if plane.focal:
            each = plane.compact(wavelength, model.dtype, model.device)
        if each is None:
            return None
        planes.append(each)
    if LatticeRoute.serves(planes) or all(plane.pointwise for plane in planes):
        return planes
    return None


class _Wave:
    """Transforms on parts of the lattice at one wavelength.

    `front` is the field in front of the occulter for a source on the axis, `stop` the product of
    all planes behind the occulter, `axes` the sample positions x, y in radians. See `PointSources`
    for `sampling` and `wrapped`.
    """

    def __init__(
        self,
        front: Wavefront,
        stop: Wavefront,
        occulter: CompactOcculter | None,
        detector: Detector,
        axes: tuple[Tensor, ...],
        sampling: float,
        wrapped: bool,
    ) -> None:
        self._shape, self._oversample = detector.shape, detector.oversample
        counts = detector.shape[::-1]
        # Samples minus sources, from the first sample of the last source to the last sample of the
        # first source.
        k = detector.oversample
        differences = [
            (torch.arange(k * (2 * n - 1), dtype=torch.float64) - (k * (n - 0.5) - 0.5))
            * (scale * ARCSEC / k)
            for n, scale in zip(counts, detector.pixelscale, strict=True)
        ]
        behind = front.grid.crop(front.field, stop.grid) * stop.field
        direct = self._transform(behind, stop, differences, detector.shear)
        arrays = [detector.per_sample * direct]
        self._lattice: OcculterLattice | None = None
        self.size = math.prod(detector.shape) * k**2
        """Size of the largest array that a source needs."""
        if occulter is not None:
            lattice = OcculterLattice(
                occulter, detector, stop.wavelength, sampling, wrapped=wrapped
            )
            lattice_axes = (lattice.x, lattice.y)
            self._per_pixel = [k * axis.cells // axis.phases for axis in lattice_axes]
            last = [float(axis[-k:].mean()) for axis in axes]
            # Cells minus sources.
            differences = [
                torch.arange(2 * axis.half + 1 + (n - 1) * q, dtype=torch.float64) * axis.spacing
                - (axis.half * axis.spacing + pixel)
                for axis, n, q, pixel in zip(
                    lattice_axes, counts, self._per_pixel, last, strict=True
                )
            ]
            focus = self._transform(front.field, front, differences, detector.shear)
            kernel = lattice.kernel(stop, axes)
            arrays += [lattice.blocked, focus, kernel]
            self._lattice = lattice
            self.size = max(self.size, kernel.numel())
        # In single and double precision, by the type of real numbers.
        self._tables = {
            real: [a.to(real.to_complex() if a.is_complex() else real) for a in arrays]
            for real in (torch.float32, torch.float64)
        }

    @staticmethod
    def _transform(field: Tensor, like: Wavefront, axes: Sequence[Tensor], shear: float) -> Tensor:
        x, y = (axis.to(field.device) for axis in axes)
        return MatrixFourier(like.grid, x, y, like.wavelength, field.dtype, shear).forward(field)

    def add_intensity(
        self, total: Tensor, rows: Tensor, columns: Tensor, weight: float, masked: bool
    ) -> None:
        """Add the weighted intensities of sources to `total`, (k, samples in y, samples in x)."""
        k = self._oversample
        ny, nx = self._shape
        # The tables start with the differences from the source in the last pixel. The window of
        # pixel (r, c) therefore starts ny - 1 - r pixels further up and nx - 1 - c further right.
        up, left = ny - 1 - rows, nx - 1 - columns
        direct, *occulted = self._tables[total.dtype]
        field = _cut(direct, up * k, left * k, (ny * k, nx * k))
        if masked and self._lattice is not None:
            blocked, focus, kernel = occulted
            qx, qy = self._per_pixel
            light = _cut(focus, up * qy, left * qx, tuple(blocked.shape)).mul_(blocked)
            field -= self._lattice.convolve(light, kernel)
        total.add_(field.real.square().add_(field.imag.square()), alpha=weight)


def _cut(array: Tensor, top: Tensor, left: Tensor, shape: tuple[int, ...]) -> Tensor:
    """Cut windows out of an array, one for each pair of first row and column, (k, *shape)."""
    every = array.unfold(0, shape[0], 1).unfold(1, shape[1], 1)
    return every[top, left]
