"""Derivatives of the complex field on the detector with respect to wavefront modes."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from pyklip_diffrender.optics.fast.plane_waves import PlaneWaves
from pyklip_diffrender.optics.grid import PupilGrid
from pyklip_diffrender.optics.planes import Wavefront
from pyklip_diffrender.optics.system import OpticalSystem
from pyklip_diffrender.wavefront.bases import Basis, FourierModes, fourier_part

__all__ = ["NANOMETRE", "ModeFields"]

NANOMETRE = 1e-9
"""Wavefront coefficients are in nm inside a fit, so that its numbers are of order 1."""


class ModeFields:
    """Derivatives of the field with respect to modes, about a wavefront.

    d(exp(i k OPD)) = i k exp(i k OPD) d(OPD): the field in the pupil times the mode is propagated.
    Cosines and sines are pairs of plane waves, whose propagation is faster, see `plane_waves`.

    Parameters
    ----------
    model : OpticalSystem
    basis : Basis
    opd : Tensor, (npix, npix)
        m, on the model's grid.
    values : dict of Tensor
        Values of the model's other parameters.
    """

    def __init__(
        self, model: OpticalSystem, basis: Basis, opd: Tensor, values: dict[str, Tensor]
    ) -> None:
        self._model, self._basis, self._values = model, basis, model.values(values)
        wavelengths = model.bandpass.wavelengths
        with torch.no_grad():
            self._pupils = [model.pupil_field(opd, each, self._values) for each in wavelengths]
        self._fourier = fourier_part(basis)
        self._waves: list[PlaneWaves | None] | None = None

    @torch.no_grad()
    def changes(self, part: slice) -> list[Tensor]:
        """Derivatives with respect to some modes, for each wavelength, (modes, ny, nx), per nm."""
        first, fourier = self._fourier or (len(self._basis), None)
        split = min(max(part.start, first), part.stop)
        pieces = []
        if part.start < split:
            pieces.append(self._propagated(slice(part.start, split)))
        if split < part.stop:
            assert fourier is not None
            pieces.append(self._from_waves(fourier, slice(split - first, part.stop - first)))
        return [torch.cat(each).to(torch.complex64) for each in zip(*pieces, strict=True)]

    def _propagated(self, part: slice) -> list[Tensor]:
        model = self._model
        full = PupilGrid.full(model.npix, model.diameter)
        sampled = self._basis.modes(full, part.start, part.stop)
        modes = model.entrance.on_window(sampled).to(model.device, model.dtype)
        changes = []
        for wavefront in self._pupils:
            moved = replace(wavefront, field=modes * (_factor(wavefront) * wavefront.field))
            changes.append(model.propagate(moved, self._values))
        return changes

    def _from_waves(self, fourier: FourierModes, part: slice) -> list[Tensor]:
        """For modes of the Fourier part, counted from its first one."""
        if self._waves is None:
            self._waves = [
                self._model.plane_waves(wavefront, self._values, fourier.reach)
                for wavefront in self._pupils
            ]
        first = 2 * (part.start // 2)
        cycles = fourier.cycles[part.start // 2 : (part.stop + 1) // 2]
        changes = []
        for wavefront, waves in zip(self._pupils, self._waves, strict=True):
            if waves is None:
                offset = len(self._basis) - len(fourier)
                return self._propagated(slice(part.start + offset, part.stop + offset))
            plus, minus = waves.fields(torch.cat([cycles, -cycles])).chunk(2)
            cosines, sines = plus + minus, -1j * (plus - minus)
            pairs = torch.stack([cosines, sines], dim=1).flatten(0, 1)
            scale = fourier.amplitude / 2 * _factor(wavefront)
            changes.append(scale * pairs[part.start - first : part.stop - first])
        return changes


def _factor(wavefront: Wavefront) -> complex:
    """I k for an OPD in nm."""
    return 2j * math.pi / wavefront.wavelength * NANOMETRE
