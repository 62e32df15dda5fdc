"""Cheaper copies of a system: fewer wavelengths, a coarser pupil, changes of a finer field."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any, Self

import torch
from torch import Tensor

from pyklip_diffrender.linear.response import downsample
from pyklip_diffrender.optics.bandpass import Bandpass
from pyklip_diffrender.optics.planes import Values
from pyklip_diffrender.optics.system import OpticalSystem, Value
from pyklip_diffrender.planning.choice import Choice

__all__ = ["CheapSystem", "build", "coarse_steps"]


class CheapSystem(OpticalSystem):
    """A system with other wavelengths, or with a constant added to its fields.

    Parameters
    ----------
    base : OpticalSystem
    bandpass : Bandpass, optional
        Default that of `base`.
    """

    def __init__(self, base: OpticalSystem, bandpass: Bandpass | None = None) -> None:
        # `at_wavelengths`, because planes may have to be sampled at the new wavelengths.
        base = base if bandpass is None else base.at_wavelengths(bandpass)
        super().__init__(
            base.entrance,
            base.planes,
            base.detector,
            base.bandpass,
            recipe=base.recipe,
            route=base.route,
            defaults=base.defaults,
        )
        self._base = base
        self._constants: dict[float, Tensor] = {}

    @property
    def setup(self) -> dict[str, str]:
        """See `OpticalSystem.setup`."""
        return self._base.setup

    @property
    def adjustable(self) -> frozenset[str]:
        """See `OpticalSystem.adjustable`."""
        return self._base.adjustable

    def with_fidelity(self, **changes: Any) -> OpticalSystem:
        """See `OpticalSystem.with_fidelity`."""
        return CheapSystem(self._base.with_fidelity(**changes))

    def stepping_from(self, fields: Sequence[Tensor], opd: Tensor, values: Values) -> Self:
        """The same system with a constant added to its fields that makes them exact at one OPD.

        `fields` are those of a finer system at `opd` (m, on this system's grid) and `values`.
        Copies made by `with_fidelity` lack the constant: it does not change derivatives, for which
        they are used, and would be wrong for sources other than the star.
        """
        with torch.no_grad():
            coarse_fields = self.fields(opd, **values)
            constants = [fine - coarse for fine, coarse in zip(fields, coarse_fields, strict=True)]
        shifted = copy.copy(self)
        shifted._constants = dict(zip(self.bandpass.wavelengths, constants, strict=True))
        return shifted

    def field(self, opd: Tensor, wavelength: float, values: Values) -> Tensor:
        """Field with the constant of its wavelength, see `Propagation.field`."""
        field = super().field(opd, wavelength, values)
        constant = self._constants.get(wavelength)
        return field if constant is None else field + constant


def coarse_steps(
    model: OpticalSystem, opd0: Value, npix: int, dtype: torch.dtype | None = None
) -> CheapSystem:
    """A coarse copy of a system whose star is exact at one wavefront and nearly so close to it.

    Most of the error of a coarse pupil comes from its sampling of segments and openings. It does
    not depend on the wavefront and cancels in ``E_fine(opd0) + E_coarse(opd) - E_coarse(opd0)``.

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
    coarse = CheapSystem(model.with_fidelity(npix=npix, dtype=dtype or model.dtype))
    with torch.no_grad():
        opd = model.opd(opd0)
        return coarse.stepping_from(model.fields(opd), downsample(opd, npix), {})


def build(model: OpticalSystem, choice: Choice) -> CheapSystem:
    """The system of a choice, without the constant that makes it exact at one wavefront."""
    base = model if choice.npix == model.npix else model.with_fidelity(npix=choice.npix)
    return CheapSystem(base, model.bandpass.condensed(choice.wavelengths))
