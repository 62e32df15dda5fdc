"""Cheaper copies of a system: fewer wavelengths, parts left out, steps from a finer one."""

from __future__ import annotations

import copy
from collections.abc import Collection, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor

from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.linear.response import downsample
from pyklip_diffrender.optics.bandpass import Bandpass
from pyklip_diffrender.optics.detector import Detector
from pyklip_diffrender.optics.detector_effects import GaussianBlur, LinearResampling, PixelCrosstalk
from pyklip_diffrender.optics.masks import FourierMask, SampledOcculter
from pyklip_diffrender.optics.planes import CompactOcculter, Plane, Values
from pyklip_diffrender.optics.sampled_planes import OrientedPupil, PupilOptic
from pyklip_diffrender.optics.system import OpticalSystem, Value
from pyklip_diffrender.planning.choice import Choice

__all__ = [
    "CheapSystem",
    "build",
    "coarse_steps",
    "occulter_sampling",
    "optional_parts",
    "quadrature",
    "wavelengths_are_fixed",
]

_EFFECTS = {GaussianBlur: "blur", LinearResampling: "distortion", PixelCrosstalk: "crosstalk"}


class CheapSystem(OpticalSystem):
    """Another system with other wavelengths, without some parts, or with corrected fields.

    Parameters
    ----------
    made : OpticalSystem
    bandpass : Bandpass, optional
        Default that of `made`.
    without : collection of str
        Names from `optional_parts`.
    """

    def __init__(
        self,
        made: OpticalSystem,
        bandpass: Bandpass | None = None,
        without: Collection[str] = (),
    ) -> None:
        band = bandpass or made.bandpass
        planes, detector = _reduced(made, without)
        super().__init__(
            made.entrance,
            planes,
            detector,
            band,
            recipe=made.recipe,
            remake=partial(_remade, made, band, without) if made.adjustable else None,
            route=made.route,
        )
        self._corrections: dict[float, Tensor] = {}

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
        other._corrections = dict(zip(self.bandpass.wavelengths, constants, strict=True))
        return other

    def _field(self, opd: Tensor, wavelength: float, values: Values) -> Tensor:
        field = super()._field(opd, wavelength, values)
        correction = self._corrections.get(wavelength)
        return field if correction is None else field + correction


def _remade(
    made: OpticalSystem, band: Bandpass, without: Collection[str], **recipe: Any
) -> OpticalSystem:
    return CheapSystem(made.with_fidelity(**recipe), band, without)


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


def _parts(model: OpticalSystem) -> dict[str, tuple[int, str, int]]:
    """Optional parts by name: number of the plane (-1 for the detector), attribute, index."""
    parts = {}
    for place, plane in enumerate(model.planes):
        if isinstance(plane, SampledOcculter):
            # The first part is the spot; neutral-density squares and the holder come after.
            for k in range(1, len(plane.parts)):
                parts[f"{plane.name} part {k + 1}"] = (place, "parts", k)
    for where in ("on_samples", "on_pixels"):
        for k, effect in enumerate(getattr(model.detector, where, ())):
            if type(effect) in _EFFECTS:
                parts[f"{_EFFECTS[type(effect)]} {where} {k + 1}"] = (-1, where, k)
    if model.detector.shear:
        parts["shear"] = (-1, "shear", 0)
    return parts


def optional_parts(model: OpticalSystem) -> frozenset[str]:
    """Names of what a system could do without: squares and bars of the mask, detector effects."""
    return frozenset(_parts(model))


def _reduced(model: OpticalSystem, without: Collection[str]) -> tuple[list[Plane], Detector]:
    """Planes and detector of a system without some of its parts."""
    parts, planes, detector = _parts(model), list(model.planes), model.detector
    if unknown := set(without) - set(parts):
        raise IncompatibleSetupError(
            f"without: got {unknown}, expected optional parts of this model: {tuple(parts)}"
        )
    gone = {parts[name] for name in without}
    for place, attribute in {(place, attribute) for place, attribute, _ in gone}:
        old: Any = detector if place < 0 else planes[place]
        items = enumerate(getattr(old, attribute) if attribute != "shear" else ())
        kept = tuple(item for k, item in items if (place, attribute, k) not in gone)
        if place >= 0:
            planes[place] = SampledOcculter(kept, old.sampling, old.diameter, old.name)
        else:
            detector = replace(old, **{attribute: 0.0 if attribute == "shear" else kept})
    return planes, detector


def occulter_sampling(model: OpticalSystem) -> float | None:
    """Cells per lambda/D on the occulters; None if there are none, or none that can be changed."""
    # A padded Fourier transform takes whole numbers only.
    fixed = any(isinstance(plane, FourierMask) for plane in model.planes)
    if fixed or "occulter_sampling" not in model.adjustable:
        return None
    default = 2.0 if model.route == "lattice" else 4.0
    masks = [p for p in model.planes if isinstance(p, CompactOcculter | SampledOcculter)]
    return max((mask.sampling or default for mask in masks), default=None)


def wavelengths_are_fixed(model: OpticalSystem) -> bool:
    """Whether some plane holds samples for the model's own wavelengths only."""
    return any(isinstance(p, OrientedPupil | PupilOptic) for p in (model.entrance, *model.planes))


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
    """The system of a choice, without the steps from a finer one.

    Parameters
    ----------
    model : OpticalSystem
        As given.
    choice : Choice
    """
    changes: dict[str, Any] = {}
    if choice.npix != model.npix:
        changes["npix"] = choice.npix
    if choice.dtype != model.dtype:
        changes["dtype"] = choice.dtype
    if choice.occulter_sampling != model.recipe.get("occulter_sampling"):
        changes["occulter_sampling"] = choice.occulter_sampling
    made = model.with_fidelity(**changes) if changes else model
    return CheapSystem(made, quadrature(model.bandpass, choice.wavelengths), choice.without)
