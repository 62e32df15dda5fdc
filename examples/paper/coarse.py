"""A coarse model for small changes of the wavefront, exact at one wavefront."""

from __future__ import annotations

import torch
from torch import Tensor

from pyklip_diffrender.linear.response import downsample
from pyklip_diffrender.optics.planes import Values
from pyklip_diffrender.optics.propagation import Value
from pyklip_diffrender.optics.system import OpticalSystem

__all__ = ["coarse_steps"]


class _CoarseSteps(OpticalSystem):
    """A system with a constant added to its fields.

    Parameters
    ----------
    coarse : OpticalSystem
    constants : dict of float to Tensor
        By wavelength, on the detector's samples.
    """

    def __init__(self, coarse: OpticalSystem, constants: dict[float, Tensor]) -> None:
        super().__init__(
            coarse.entrance,
            coarse.between,
            coarse.detector,
            coarse.bandpass,
            recipe=coarse.recipe,
            route=coarse.route,
            defaults=coarse.defaults,
        )
        self._constants = constants

    def field(self, opd: Tensor, wavelength: float, values: Values) -> Tensor:
        """Field with the constant of its wavelength, see `OpticalSystem.field`."""
        return super().field(opd, wavelength, values) + self._constants[wavelength]


def coarse_steps(
    model: OpticalSystem, opd0: Value, npix: int, dtype: torch.dtype | None = None
) -> OpticalSystem:
    """Make a coarse copy of a system whose star is exact at one wavefront.

    Most of the error of a coarse pupil comes from its sampling of segments and openings. It does
    not depend on the wavefront and cancels in ``E_fine(opd0) + E_coarse(opd) - E_coarse(opd0)``.
    Close to it the star is nearly exact; images of other sources would be wrong.

    Parameters
    ----------
    model : OpticalSystem
        The fine system; its `npix` must be adjustable.
    opd0 : Tensor, Quantity or array, (model.npix, model.npix)
        Wavefront at which the copy is exact, m.
    npix : int
        Pupil samples of the copy and of its wavefronts; must divide the model's.
    dtype : torch.dtype, optional
        Type of the copy; default the model's.
    """
    coarse = model.with_fidelity(npix=npix, dtype=dtype or model.dtype)
    with torch.no_grad():
        opd = model.opd(opd0)
        fine = model.fields(opd)
        rough = coarse.fields(downsample(opd, npix))
    wavelengths = coarse.bandpass.wavelengths
    return _CoarseSteps(
        coarse, {w: a - b for w, a, b in zip(wavelengths, fine, rough, strict=True)}
    )
