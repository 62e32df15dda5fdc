"""Derivatives of the field followed through changes in the last pupil.

What acts between the last focal plane and the detector multiplies the field in the last pupil: the
instrument's internal aberration, and the phase ramp that shifts the image. A change of it convolves
all fields on the detector, and their derivatives, with one small kernel. That takes a tenth of the
time of new derivatives. A star that moves relative to the occulter moves the image as well; the
change of what the occulter blocks is neglected here.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from pyklip_diffrender.io.units import ARCSEC
from pyklip_diffrender.optics.propagation import Propagation
from pyklip_diffrender.optics.zernike import zernike_basis
from pyklip_diffrender.parameters import parameter

__all__ = ["LastPupil"]

_PIECE = 16
"""Number of fields that are transformed at a time; they fit in the processor's cache."""


class LastPupil:
    """The pupil behind all occulters of a model, seen from the detector's samples.

    Parameters
    ----------
    model : Propagation
    """

    def __init__(self, model: Propagation) -> None:
        self._model = model
        behind = model.parameters_behind
        self.shifts = tuple(n for n in ("star_offset", "detector_shift") if n in model.parameters)
        """Parameters that shift the image, arcsec."""
        self.zernikes = tuple(n for n in ("si_zernikes",) if n in behind)
        """Parameters that are Zernike coefficients of an OPD in this pupil, m."""

    def change(self, before: dict[str, Tensor], after: dict[str, Tensor]) -> float:
        """Rms phase over the pupil, radians, that `multiply` would apply."""
        wavenumber = 2 * math.pi / min(self._model.bandpass.wavelengths)
        # The rms of a tilt over a disc is a quarter of its diameter times the angle.
        tilt = self._shift(before, after).norm() * self._model.diameter / 4
        waves = self._difference(self.zernikes, before, after).norm()
        return wavenumber * math.hypot(float(tilt), float(waves))

    def multiply(
        self, fields: Sequence[Tensor], before: dict[str, Tensor], after: dict[str, Tensor]
    ) -> None:
        """Convolve fields on the detector, in place, as a change of parameters does.

        The field outside the detector is taken for the field of its opposite edge.

        Parameters
        ----------
        fields : sequence of Tensor
            For every wavelength (count, oversample ny, oversample nx), complex64.
        before, after : dict of Tensor
            Values of the model's parameters.
        """
        for wavelength, field in zip(self._model.bandpass.wavelengths, fields, strict=True):
            factor = self._factor(wavelength, field, before, after)
            for piece in field.split(_PIECE):
                piece.copy_(torch.fft.ifft2(torch.fft.fft2(piece).mul_(factor)))

    def _factor(
        self,
        wavelength: float,
        field: Tensor,
        before: dict[str, Tensor],
        after: dict[str, Tensor],
    ) -> Tensor:
        """Factor of the spectrum of the samples, (ny, nx)."""
        detector = self._model.detector
        # The sign of y is that of `optics.fourier`. The shear of the axes is negligible here.
        x, y = (
            torch.fft.fftfreq(count, dtype=torch.float64, device=field.device)
            * (sign * wavelength * detector.oversample / (scale * ARCSEC))
            for count, scale, sign in zip(
                field.shape[:-3:-1], detector.pixelscale, (1, -1), strict=True
            )
        )
        shift = self._shift(before, after).to(field.device)
        opd = shift[1] * y[:, None] - shift[0] * x[None, :]
        coefficients = self._difference(self.zernikes, before, after).to(field.device)
        if len(coefficients):
            basis = zernike_basis(len(coefficients), x, y, self._model.diameter / 2)
            opd = opd + torch.tensordot(coefficients, basis, dims=1)
        phase = (2 * math.pi / wavelength) * opd
        return torch.polar(torch.ones_like(phase), phase).to(field.dtype)

    def _shift(self, before: dict[str, Tensor], after: dict[str, Tensor]) -> Tensor:
        """Shift of the image, (2,), radians."""
        moved = self._difference(self.shifts, before, after).reshape(-1, 2)
        return moved.sum(dim=0) * ARCSEC

    def _difference(
        self, names: Sequence[str], before: dict[str, Tensor], after: dict[str, Tensor]
    ) -> Tensor:
        """Change of named parameters, one after the other, float64 on the CPU."""
        changes = []
        for name in names:
            zero = torch.zeros(parameter(name).size, dtype=torch.float64)
            changes.append(after.get(name, zero).cpu() - before.get(name, zero).cpu())
        return torch.cat([torch.zeros(0, dtype=torch.float64), *changes])
