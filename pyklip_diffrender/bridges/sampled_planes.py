"""Planes made from sampled arrays in any orientation.

Inside a system all pupil arrays have the frame in which `fourier` makes the final image. The planes
here take arrays in the frame of their own plane and turn them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from pyklip_diffrender.bridges.orientation import Orientation
from pyklip_diffrender.io.geometry import rotation_matrix
from pyklip_diffrender.optics.differentiation import Cache, Position, cached, position_of
from pyklip_diffrender.optics.grid import PupilGrid
from pyklip_diffrender.optics.planes import EntrancePupil, Plane, Values, Wavefront, phase_factor
from pyklip_diffrender.optics.zernike import zernike_basis
from pyklip_diffrender.parameters import parameter

__all__ = [
    "AberrationOptic",
    "Gain",
    "MovableStop",
    "OrientedPupil",
    "PupilOptic",
]


class OrientedPupil(EntrancePupil):
    """An entrance pupil in any frame, with a wavefront and a pointing of its own.

    Parameters
    ----------
    amplitude, opd : Tensor, (npix, npix)
        Amplitude transmission and OPD (m), frame of the entrance pupil. The OPD is used in calls
        without one.
    orientation : Orientation
        From the frame of the entrance pupil to that of the system.
    pointing : tuple of float
        x, y in arcsec on the image, added to every star offset.
    chromatic : mapping of float to Tensor
        Wavelength (m) to an OPD (m) that is added to that of every call, frame of the entrance
        pupil.
    turned : float
        Rotation of the image by planes behind, degrees counter-clockwise; sources are rotated the
        other way, so that they appear at their star offset.
    collected : float, optional
        Sum of the squared amplitude of the true pupil, in units of a sample's area. Default that of
        `amplitude`, which is smaller if samples are means over partly blocked areas.
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
        if collected is not None:
            self.amplitude = self.amplitude * math.sqrt(self.total / collected)
            self.total = collected
        self.opd = opd.to(device, torch.float64)
        self.lit = (amplitude > 0).to(device)
        """Samples that transmit light, (npix, npix), in the frame of the OPD."""
        self.orientation = orientation
        self.pointing = torch.tensor(pointing, dtype=torch.float64, device=device)
        self.chromatic = {w: extra.to(device) for w, extra in (chromatic or {}).items()}
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
    """Amplitude and phase in a pupil plane, one array per wavelength.

    Parameters
    ----------
    phasors : mapping of float to Tensor
        Wavelength (m) to complex amplitude transmission, (npix, npix), frame of this plane. A
        larger array reaches beyond the pupil by as much on every side.
    npix : int
        Samples across the pupil.
    orientation : Orientation
        From the frame of this plane to that of the system.
    trainable : bool
        Make the leaf tensors `opd` (m, added) and `transmission` (a factor), both (npix, npix) in
        the frame of this plane, to optimise by their gradients.
    """

    sampled = True

    def __init__(
        self,
        phasors: Mapping[float, Tensor],
        npix: int,
        diameter: float,
        dtype: torch.dtype,
        device: torch.device,
        name: str,
        orientation: Orientation,
        trainable: bool = False,
    ) -> None:
        self.name, self.orientation = name, orientation
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
        self.opd: Tensor | None = None
        self.transmission: Tensor | None = None
        if trainable:
            self.opd = torch.zeros(size, size, dtype=dtype, device=device).requires_grad_()
            self.transmission = torch.ones_like(self.opd).requires_grad_()

    @property
    def pointwise(self) -> bool:  # type: ignore[override]
        """See `Plane`: false if the factors are trained."""
        return self.opd is None

    def window(self, values: Values) -> PupilGrid:
        """The window with all samples that transmit light at some wavelength."""
        return self.grid

    def _turned(self, array: Tensor) -> Tensor:
        return self._full.crop(self.orientation.apply(array), self.grid).to(self._dtype)

    def apply(self, wavefront: Wavefront, values: Values, onto: PupilGrid) -> Wavefront:
        """Multiply by the phasor and the trainable factors."""
        field = wavefront.grid.crop(wavefront.field, self.grid)
        field = field * self._phasors[wavefront.wavelength]
        if self.opd is not None and self.transmission is not None:
            opd = self._turned(self.opd)
            field = field * phase_factor(opd, wavefront.wavelength, self._dtype)
            field = field * self._turned(self.transmission)
        return replace(wavefront, field=field, grid=self.grid)


class MovableStop(PupilOptic):
    """A stop known from its samples only, that can be shifted and turned.

    At rest the samples are used directly. Elsewhere they are interpolated by cubic convolution
    (R. Keys, IEEE Trans. Acoust. Speech Signal Process. 29, 1153, 1981), which is exact for shifts
    by whole samples. Parameters as for `planes.LyotStop`.
    """

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
    """Values of an array at positions in samples, by cubic convolution; zero outside.

    Differentiable in forward and reverse mode, unlike torch's `grid_sample`.

    Parameters
    ----------
    array : Tensor, (ny, nx)
    rows, columns : Tensor, (...)
    """
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
    """A uniform factor; 1 for a plane without effect on the field.

    Attributes
    ----------
    name : str
    factor : complex
        Amplitude transmission.
    """

    name: str
    factor: complex = 1.0
    pointwise = True

    def apply(self, wavefront: Wavefront, values: Values, onto: PupilGrid) -> Wavefront:
        """Multiply."""
        if self.factor == 1:
            return wavefront
        return replace(wavefront, field=wavefront.field * self.factor)
