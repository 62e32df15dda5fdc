"""Cheaper copies of a system: fewer wavelengths, coarser pupils, steps from a finer one."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor

from pyklip_diffrender.linear.response import downsample
from pyklip_diffrender.optics.bandpass import Bandpass
from pyklip_diffrender.optics.planes import Values
from pyklip_diffrender.optics.system import OpticalSystem, Value
from pyklip_diffrender.planning.choice import Choice

__all__ = ["CheapSystem", "build", "coarse_steps", "quadrature"]


class CheapSystem(OpticalSystem):
    """Another system with other wavelengths, or with a constant added to its fields.

    Parameters
    ----------
    made : OpticalSystem
    bandpass : Bandpass, optional
        Default that of `made`.
    """

    def __init__(self, made: OpticalSystem, bandpass: Bandpass | None = None) -> None:
        # Planes that were sampled at some wavelengths are others at others.
        made = made if bandpass is None else made.at_wavelengths(bandpass)
        super().__init__(
            made.entrance,
            made.planes,
            made.detector,
            made.bandpass,
            recipe=made.recipe,
            route=made.route,
            defaults=made.defaults,
        )
        self._made = made
        self._constants: dict[float, Tensor] = {}

    @property
    def setup(self) -> dict[str, str]:
        """As of the other system."""
        return self._made.setup

    @property
    def adjustable(self) -> frozenset[str]:
        """As of the other system."""
        return self._made.adjustable

    def with_fidelity(self, **changes: Any) -> OpticalSystem:
        """See `OpticalSystem.with_fidelity`."""
        return CheapSystem(self._made.with_fidelity(**changes))

    def stepping_from(self, fields: Sequence[Tensor], opd: Tensor, values: Values) -> Self:
        """The same system, with a constant added to its fields that makes them right at one OPD.

        Copies made by `with_fidelity` are without the constant: they serve derivatives, which it
        does not change, and other sources than the star, for which it would be wrong. `fields` are
        those of a finer system at `opd` (m, on this system's grid) and `values`.
        """
        with torch.no_grad():
            there = self.fields(opd, **values)
            constants = [fine - coarse for fine, coarse in zip(fields, there, strict=True)]
        other = copy.copy(self)
        other._constants = dict(zip(self.bandpass.wavelengths, constants, strict=True))
        return other

    def _field(self, opd: Tensor, wavelength: float, values: Values) -> Tensor:
        field = super()._field(opd, wavelength, values)
        constant = self._constants.get(wavelength)
        return field if constant is None else field + constant


def coarse_steps(
    model: OpticalSystem, opd0: Value, npix: int, dtype: torch.dtype | None = None
) -> CheapSystem:
    """A coarse copy of a system whose star is exact at one wavefront and almost so near it.

    Most of the error of a coarse pupil, how it samples segments and openings, does not depend on
    the wavefront and cancels in ``E_fine(opd0) + E_coarse(opd) - E_coarse(opd0)``.

    Parameters
    ----------
    model : OpticalSystem
        The fine system; its `npix` must be adjustable.
    opd0 : Tensor, Quantity or array, (model.npix, model.npix)
        Where the fine field is taken, m.
    npix : int
        Pupil samples of the copy, which takes wavefronts on this grid; must divide the model's.
    dtype : torch.dtype, optional
        Of the copy; default the model's.
    """
    coarse = CheapSystem(model.with_fidelity(npix=npix, dtype=dtype or model.dtype))
    with torch.no_grad():
        opd = model.opd(opd0)
        return coarse.stepping_from(model.fields(opd), downsample(opd, npix), {})


def quadrature(bandpass: Bandpass, count: int) -> Bandpass:
    """Fewer wavelengths with the same moments: Gauss quadrature of the given ones.

    `count` nodes integrate polynomials up to degree 2 `count` - 1 as the given ones do (G. Golub
    and J. Welsch, Math. Comp. 23, 221, 1969).

    Parameters
    ----------
    bandpass : Bandpass
    count : int
        With as many as there are, the bandpass itself is returned.
    """
    given = np.array(bandpass.wavelengths)
    if count >= len(given):
        return bandpass
    middle, half = (given.max() + given.min()) / 2, (given.max() - given.min()) / 2
    x = (given - middle) / half
    # Polynomials that are orthonormal under the given weights, at the given wavelengths; in their
    # basis, multiplication by x is a matrix whose eigenvalues are the nodes.
    powers = np.polynomial.chebyshev.chebvander(x, count - 1)
    basis, _ = np.linalg.qr(np.sqrt(np.array(bandpass.weights))[:, None] * powers)
    nodes, vectors = np.linalg.eigh(basis.T @ (x[:, None] * basis))
    return Bandpass(tuple((middle + half * nodes).tolist()), tuple((vectors[0] ** 2).tolist()))


def build(model: OpticalSystem, choice: Choice) -> CheapSystem:
    """The system of a choice, without the steps from a finer one."""
    made = model if choice.npix == model.npix else model.with_fidelity(npix=choice.npix)
    return CheapSystem(made, quadrature(model.bandpass, choice.wavelengths))
