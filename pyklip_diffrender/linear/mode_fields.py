"""Derivatives of the complex field on the detector with respect to wavefront modes."""

from __future__ import annotations

import math
from collections.abc import Iterator
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

    @torch.no_grad()
    def batches(self, size: int) -> Iterator[tuple[Tensor, list[Tensor]]]:
        """Compute the derivatives with respect to all modes, up to `size` of them at a time.

        Parameters
        ----------
        size : int
            At least 4.

        Yields
        ------
        modes : Tensor, (modes,), int64
            Their places in the basis.
        changes : list of Tensor, (modes, ny, nx), complex64
            For each wavelength, per nm.
        """
        first, fourier = fourier_part(self._basis) or (len(self._basis), None)
        waves = [] if fourier is None else self._plane_waves(fourier.reach)
        if not waves:
            first = len(self._basis)
        for modes in torch.arange(first).split(size) if first else ():
            yield modes, [each.to(torch.complex64) for each in self._propagated(modes)]
        if waves:
            assert fourier is not None
            for modes, changes in self._from_waves(waves, fourier, size):
                yield first + modes, [each.to(torch.complex64) for each in changes]

    def _plane_waves(self, reach: int) -> list[PlaneWaves]:
        """For each wavelength; an empty list if the model has none."""
        waves = [self._model.plane_waves(each, self._values, reach) for each in self._pupils]
        return [each for each in waves if each is not None]

    def _propagated(self, modes: Tensor) -> list[Tensor]:
        model = self._model
        full = PupilGrid.full(model.npix, model.diameter)
        sampled = self._basis.modes(full, int(modes[0]), int(modes[-1]) + 1)
        shapes = model.entrance.on_window(sampled).to(model.device, model.dtype)
        changes = []
        for wavefront in self._pupils:
            moved = replace(wavefront, field=shapes * (_factor(wavefront) * wavefront.field))
            changes.append(model.propagate(moved, self._values))
        return changes

    def _from_waves(
        self, waves: list[PlaneWaves], fourier: FourierModes, size: int
    ) -> Iterator[tuple[Tensor, list[Tensor]]]:
        """For the Fourier part, with places counted from its first mode.

        A cosine and a sine are the sum and the difference of two opposite waves.
        """
        places = {(fx, fy): 2 * k for k, (fx, fy) in enumerate(fourier.cycles.tolist())}
        scales = [fourier.amplitude / 2 * _factor(each) for each in self._pupils]
        for fx in range(fourier.reach + 1):
            every = [fy for fy in range(fourier.reach + 1) if (fx, fy) in places]
            for start in range(0, len(every), max(1, size // 4)):
                fy = every[start : start + max(1, size // 4)]
                pairs = [(fx, each) for each in fy] + [(-fx, each) for each in fy]
                # The wave opposite to (fx, 0) is (-fx, 0), so that only one of them is a pair.
                known = [k for k, pair in enumerate(pairs) if pair in places]
                cosines = torch.tensor([places[pairs[k]] for k in known])
                changes = []
                for each, scale in zip(waves, scales, strict=True):
                    fields = each.fields(fx, slice(fy[0], fy[-1] + 1))
                    plus = fields[:, 0].flatten(0, 1)[known]
                    minus = fields[[1, 0], 1].flatten(0, 1)[known]
                    pair = [scale * (plus + minus), 1j * scale * (minus - plus)]
                    changes.append(torch.stack(pair, dim=1).flatten(0, 1))
                yield torch.stack([cosines, cosines + 1], dim=1).flatten(), changes


def _factor(wavefront: Wavefront) -> complex:
    """I k for an OPD in nm."""
    return 2j * math.pi / wavefront.wavelength * NANOMETRE
