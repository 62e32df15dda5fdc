"""Propagation through a coronagraph with one round occulter, by convolution (see `occulter`).

A single star with fixed planes is computed block by block (see `streaming`). Everything else uses
ordinary torch operations, which have derivatives of all kinds.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from pyklip_diffrender.io.units import ARCSEC
from pyklip_diffrender.optics.detector import Detector
from pyklip_diffrender.optics.differentiation import (
    Cache,
    Position,
    cached,
    has_memory,
    is_plain,
    position_of,
)
from pyklip_diffrender.optics.fast.occulter import DEFAULT_SAMPLING, OcculterLattice, finest_spacing
from pyklip_diffrender.optics.fast.plane_waves import PlaneWaves, ShiftedTransforms
from pyklip_diffrender.optics.fast.streaming import Branch, PupilStream
from pyklip_diffrender.optics.fourier import tilt_phases
from pyklip_diffrender.optics.grid import PupilGrid
from pyklip_diffrender.optics.planes import (
    CompactOcculter,
    EntrancePupil,
    Plane,
    Values,
    Wavefront,
)

__all__ = ["LatticeRoute"]

_LARGE = 512
"""Samples across a pupil above which arrays do not fit into the cache. Only then is it faster to
compute the field a second time for its derivative."""


class LatticeRoute:
    """Propagation through planes with one round occulter by `OcculterLattice`.

    Parameters
    ----------
    planes : sequence of Plane
        See `serves`.
    detector : Detector
    """

    def __init__(self, planes: Sequence[Plane], detector: Detector) -> None:
        self.planes, self.detector = tuple(planes), detector
        (self._place,) = (k for k, p in enumerate(planes) if isinstance(p, CompactOcculter))
        behind = planes[self._place + 1 :]
        self._moving = {name for plane in behind for name in plane.parameters} | {"detector_shift"}
        self._lattices: Cache[float, OcculterLattice] = Cache()
        # The most recent result at each wavelength, with the parameters that it depends on.
        self._stops: Cache[float, tuple[Position, Wavefront]] = Cache()
        self._kernels: Cache[float, tuple[Position, Tensor]] = Cache()
        self._stars: Cache[float, tuple[Position, _StreamedStar]] = Cache()
        self._streams: Cache[PupilGrid, PupilStream] = Cache()

    @staticmethod
    def serves(planes: Sequence[Plane]) -> bool:
        """Whether the planes are one `CompactOcculter` and otherwise factors in pupils."""
        others = [plane for plane in planes if not isinstance(plane, CompactOcculter)]
        return len(planes) - len(others) == 1 and all(plane.pointwise for plane in others)

    @property
    def occulter(self) -> CompactOcculter:
        """The occulter among the planes."""
        plane = self.planes[self._place]
        assert isinstance(plane, CompactOcculter)
        return plane

    @property
    def sampling(self) -> float:
        """Smallest number of cells per lambda/D."""
        return self.occulter.sampling or DEFAULT_SAMPLING

    def pays(self, wavelengths: Sequence[float]) -> bool:
        """Whether the cells aligned with the detector are not much finer than necessary."""
        return all(
            finest_spacing(self.occulter, self.detector, wavelength, self.sampling)
            >= wavelength / self.occulter.diameter / self.sampling / 2.5
            for wavelength in wavelengths
        )

    def lattice(self, wavelength: float) -> OcculterLattice:
        """The cells at a wavelength."""
        return self._lattices.kept(
            wavelength,
            lambda: OcculterLattice(self.occulter, self.detector, wavelength, self.sampling),
        )

    def _stop(self, onto: Sequence[PupilGrid], wavelength: float, values: Values) -> Wavefront:
        """The product of all planes behind the occulter.

        A shift of the detector is included as a tilt, so that nothing else depends on it.
        """
        return cached(
            self._stops,
            wavelength,
            position_of(values, self._moving),
            lambda: self._make_stop(onto, wavelength, values),
        )

    def _make_stop(self, onto: Sequence[PupilGrid], wavelength: float, values: Values) -> Wavefront:
        grid = onto[self._place]
        ones = torch.ones(
            grid.shape, dtype=self.detector.dtype.to_complex(), device=self.detector.device
        )
        stop = Wavefront(ones, wavelength, grid)
        for plane, window in zip(
            self.planes[self._place + 1 :], onto[self._place + 1 :], strict=True
        ):
            stop = plane.apply(stop, values, window)
        if "detector_shift" not in values:
            return stop
        x, y = values["detector_shift"].unbind(-1)
        shift = torch.stack([x, y + self.detector.shear * x], dim=-1) * ARCSEC
        factors = [
            torch.polar(torch.ones_like(phase), phase).to(stop.field.dtype)
            for phase in tilt_phases(shift, stop.grid, wavelength)
        ]
        return replace(stop, field=stop.field * factors[0][None, :] * factors[1][:, None])

    def _kernel(self, stop: Wavefront, values: Values) -> Tensor:
        return cached(
            self._kernels,
            stop.wavelength,
            position_of(values, self._moving),
            lambda: self.lattice(stop.wavelength).kernel(stop, self.detector.axes({})),
        )

    def field(self, wavefront: Wavefront, values: Values, onto: Sequence[PupilGrid]) -> Tensor:
        """Propagate from the entrance pupil to the detector's samples.

        Parameters
        ----------
        wavefront : Wavefront
        values : mapping of str to Tensor
        onto : sequence of PupilGrid
            For every plane, the window to pass on (`OpticalSystem.windows`).
        """
        for plane, window in zip(self.planes[: self._place], onto, strict=False):
            wavefront = plane.apply(wavefront, values, window)
        lattice = self.lattice(wavefront.wavelength)
        stop = self._stop(onto, wavefront.wavelength, values)
        passed = wavefront.grid.crop(wavefront.field, stop.grid) * stop.field
        direct = self.detector.field(replace(stop, field=passed), {})
        light = lattice.focus(wavefront) * lattice.blocked
        return direct - lattice.convolve(light, self._kernel(stop, values))

    def plane_waves(
        self, wavefront: Wavefront, values: Values, onto: Sequence[PupilGrid], reach: int
    ) -> PlaneWaves | None:
        """Prepare the propagation of a field times plane waves, up to `reach` cycles along an axis.

        None if there are planes in front of the occulter.
        """
        if self._place > 0:
            return None
        lattice, detector = self.lattice(wavefront.wavelength), self.detector
        stop = self._stop(onto, wavefront.wavelength, values)
        passed = replace(stop, field=wavefront.grid.crop(wavefront.field, stop.grid) * stop.field)
        kernel = self._kernel(stop, values)
        x, y = detector.axes({})
        cells_x, cells_y = (a.positions.to(detector.device) for a in (lattice.x, lattice.y))
        return PlaneWaves(
            ShiftedTransforms(passed, x, y, detector.shear, reach),
            ShiftedTransforms(wavefront, cells_x, cells_y, lattice.shear, reach),
            lattice.blocked,
            detector.per_sample,
            lambda light: lattice.convolve(light, kernel),
        )

    def behind_occulter(
        self, wavefront: Wavefront, values: Values, onto: Sequence[PupilGrid]
    ) -> Wavefront:
        """Propagate from the entrance pupil to the pupil behind the occulter; see `field`."""
        for plane, window in zip(self.planes[: self._place], onto, strict=False):
            wavefront = plane.apply(wavefront, values, window)
        lattice, grid = self.lattice(wavefront.wavelength), onto[self._place]
        passed = replace(wavefront, field=wavefront.grid.crop(wavefront.field, grid), grid=grid)
        light = lattice.focus(wavefront) * (lattice.blocked / self.detector.per_sample)
        return replace(passed, field=passed.field - lattice.to_pupil(light, passed))

    def star(
        self,
        entrance: EntrancePupil,
        opd: Tensor,
        wavelength: float,
        values: Values,
        onto: Sequence[PupilGrid],
    ) -> Tensor | None:
        """Compute the field of a single star, in a third of the time of `field`.

        Returns
        -------
        Tensor or None
            Differentiable in reverse mode with respect to the OPD and the star's offset. None if
            other derivatives or several stars are required.
        """
        offset = values.get("star_offset")
        fixed = [value for name, value in values.items() if name != "star_offset"]
        if (
            self._place > 0
            or type(entrance) is not EntrancePupil
            or opd.device.type != "cpu"
            or opd.ndim > 2
            or (offset is not None and offset.ndim > 1)
            or not all(is_plain(t) for t in fixed)
            or not all(has_memory(t) for t in (opd, *values.values()))
        ):
            return None
        varied = [t for t in (opd, offset) if t is not None and not is_plain(t)]
        if varied and (opd.is_complex() or opd.shape[-1] < _LARGE):
            return None
        with torch.no_grad():
            star = cached(
                self._stars,
                wavelength,
                position_of(values, self._moving),
                lambda: self._streamed(entrance, wavelength, values, onto),
            )
            if not varied:
                return star.field(star.products(opd, offset))

        def recompute(opd: Tensor, offset: Tensor | None) -> Tensor:
            moved = dict(values) if offset is None else {**values, "star_offset": offset}
            return self.field(entrance.field(opd, wavelength, offset), moved, onto)

        field: Tensor = _ReverseMode.apply(opd, offset, star, recompute)
        return field

    def _streamed(
        self,
        entrance: EntrancePupil,
        wavelength: float,
        values: Values,
        onto: Sequence[PupilGrid],
    ) -> _StreamedStar:
        stream = self._streams.kept(
            entrance.grid, lambda: PupilStream(entrance.amplitude, entrance.grid)
        )
        lattice = self.lattice(wavelength)
        stop = self._stop(onto, wavelength, values)
        cells = lattice.x.positions, lattice.y.positions
        branches = [
            Branch(grid, factor, *axes, wavelength, self.detector.dtype, lattice.shear)
            for grid, factor, axes in (
                (entrance.grid, None, cells),
                (stop.grid, stop.field, self.detector.axes({})),
            )
        ]
        return _StreamedStar(
            stream, branches, lattice, self._kernel(stop, values), self.detector.per_sample
        )


@dataclass(frozen=True)
class _StreamedStar:
    """The field of a star as a function of OPD and star offset only.

    Attributes
    ----------
    stream : PupilStream
    branches : list of Branch
        Transforms to the cells of the mask and to the detector.
    lattice : OcculterLattice
    kernel : Tensor
        Transform of the kernel of the convolution.
    per_sample : float
        See `Detector`.
    """

    stream: PupilStream
    branches: list[Branch]
    lattice: OcculterLattice
    kernel: Tensor
    per_sample: float

    def products(self, opd: Tensor, offset: Tensor | None) -> list[Tensor]:
        """Products of the field along x, see `PupilStream.products`; the offset is in arcsec."""
        with torch.no_grad():
            return self.stream.products(opd, _radians(offset), self.branches)

    def field(self, products: Sequence[Tensor]) -> Tensor:
        """Field on the detector's samples; linear, and by torch's own operations."""
        focus, direct = (b.finish(p) for b, p in zip(self.branches, products, strict=True))
        light = focus * self.lattice.blocked
        return self.per_sample * direct - self.lattice.convolve(light, self.kernel)

    def slopes(
        self, opd: Tensor, offset: Tensor | None, along_x: Sequence[Tensor]
    ) -> tuple[Tensor, Tensor | None]:
        """Derivatives with respect to OPD and offset, from those with respect to `products`."""
        by_opd, by_offset = self.stream.slopes(opd, _radians(offset), self.branches, along_x)
        return by_opd, None if by_offset is None else by_offset * ARCSEC


def _radians(offset: Tensor | None) -> Tensor | None:
    return None if offset is None else offset * ARCSEC


class _ReverseMode(torch.autograd.Function):
    """The field of a `_StreamedStar` with its derivatives in reverse mode.

    The field in the pupil is not stored, but computed again in the backward pass, block by block.
    """

    @staticmethod
    def forward(
        ctx: Any,
        opd: Tensor,
        offset: Tensor | None,
        star: _StreamedStar,
        recompute: Callable[[Tensor, Tensor | None], Tensor],
    ) -> Tensor:
        products = star.products(opd, offset)
        with torch.enable_grad():
            # The arrays after the products are small enough for autograd to keep.
            products = [product.requires_grad_() for product in products]
            field = star.field(products)
        ctx.save_for_backward(opd, offset)
        ctx.star, ctx.recompute, ctx.products = star, recompute, (products, field)
        return field.detach()

    @staticmethod
    def backward(ctx: Any, slope: Tensor) -> tuple[Tensor | None, ...]:
        opd, offset = ctx.saved_tensors
        if not torch.is_grad_enabled():
            products, field = ctx.products
            along_x = torch.autograd.grad(field, products, slope, retain_graph=True)
            by_opd, by_offset = ctx.star.slopes(opd, offset, along_x)
            return by_opd.to(opd.dtype), by_offset, None, None
        # Second derivatives need the differentiable operations.
        inputs = opd, offset
        differentiated = [t for t in inputs if t is not None and t.requires_grad]
        by_each = iter(
            torch.autograd.grad(
                ctx.recompute(opd, offset), differentiated, slope, create_graph=True
            )
        )
        slopes = [next(by_each) if t is not None and t.requires_grad else None for t in inputs]
        return slopes[0], slopes[1], None, None
