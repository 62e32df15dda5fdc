"""Propagation through a coronagraph with one compact occulter, by convolution (see `occulter`).

All of it are ordinary torch operations, which have derivatives of all kinds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from pyklip_diffrender.io.units import ARCSEC
from pyklip_diffrender.optics.detector import Detector
from pyklip_diffrender.optics.differentiation import (
    Cache,
    Position,
    cached,
    position_of,
)
from pyklip_diffrender.optics.fast.occulter import DEFAULT_SAMPLING, OcculterLattice, finest_spacing
from pyklip_diffrender.optics.fast.plane_waves import PlaneWaves, ShiftedTransforms
from pyklip_diffrender.optics.fourier import tilt_phases
from pyklip_diffrender.optics.grid import PupilGrid
from pyklip_diffrender.optics.planes import (
    CompactOcculter,
    Plane,
    Values,
    Wavefront,
)

__all__ = ["LatticeRoute"]


class LatticeRoute:
    """Propagation through planes with one compact occulter by `OcculterLattice`.

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
        self._lattices: Cache[tuple[float, bool], OcculterLattice] = Cache()
        # The most recent result at each wavelength, with the parameters that it depends on.
        self._stops: Cache[float, tuple[Position, Wavefront]] = Cache()
        self._kernels: Cache[float, tuple[Position, Tensor]] = Cache()

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

    def lattice(self, wavelength: float, *, wrapped: bool = False) -> OcculterLattice:
        """The cells at a wavelength; `wrapped` is explained in `occulter`."""
        return self._lattices.kept(
            (wavelength, wrapped),
            lambda: OcculterLattice(
                self.occulter, self.detector, wavelength, self.sampling, wrapped=wrapped
            ),
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

        None if there are planes in front of the occulter. The light of the outer cells is wrapped.
        """
        if self._place > 0:
            return None
        lattice, detector = self.lattice(wavefront.wavelength, wrapped=True), self.detector
        stop = self._stop(onto, wavefront.wavelength, values)
        passed = replace(stop, field=wavefront.grid.crop(wavefront.field, stop.grid) * stop.field)
        kernel = lattice.kernel(stop, detector.axes({}))
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
