"""Cheaper copies of a system: fewer wavelengths, parts left out, a correction from a finer one."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor

from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.optics.bandpass import Bandpass
from pyklip_diffrender.optics.detector import Detector
from pyklip_diffrender.optics.detector_effects import (
    ChainDetector,
    GaussianBlur,
    LinearResampling,
    PixelCrosstalk,
)
from pyklip_diffrender.optics.masks import SampledOcculter
from pyklip_diffrender.optics.planes import Plane, Values
from pyklip_diffrender.optics.system import OpticalSystem
from pyklip_diffrender.planning.choice import Choice

__all__ = ["DTYPES", "CheapSystem", "build", "optional_parts", "quadrature"]

DTYPES = {"float64": torch.float64, "float32": torch.float32}
"""Types of the computation by name."""

_EFFECTS = {GaussianBlur: "blur", LinearResampling: "distortion", PixelCrosstalk: "crosstalk"}


class CheapSystem(OpticalSystem):
    """Another system with other wavelengths, without some parts, or with corrected fields.

    Parameters
    ----------
    made : OpticalSystem
    bandpass : Bandpass, optional
        Default that of `made`.
    without : sequence of str
        Names from `optional_parts`.
    """

    def __init__(
        self,
        made: OpticalSystem,
        bandpass: Bandpass | None = None,
        without: Sequence[str] = (),
    ) -> None:
        made = made if bandpass is None else made.at_wavelengths(bandpass)
        planes, detector = _reduced(made, without)
        super().__init__(
            made.entrance, planes, detector, made.bandpass, recipe=made.recipe, route=made.route
        )
        self._made, self._without = made, tuple(without)
        self._corrections: dict[float, Tensor] = {}

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
        return CheapSystem(self._made.with_fidelity(**changes), without=self._without)

    def corrected(self, corrections: Sequence[Tensor]) -> Self:
        """The same system with something added to the star's field on the detector.

        Copies made by `with_fidelity`, which are for derivatives and other sources, have nothing
        added: a correction belongs to one star on one grid.

        Parameters
        ----------
        corrections : sequence of Tensor
            One for each wavelength.
        """
        other = copy.copy(self)
        other._corrections = dict(zip(self.bandpass.wavelengths, corrections, strict=True))
        return other

    def _field(self, opd: Tensor, wavelength: float, values: Values) -> Tensor:
        found = super()._field(opd, wavelength, values)
        correction = self._corrections.get(wavelength)
        return found if correction is None else found + correction


def _parts(model: OpticalSystem) -> dict[str, tuple[str, int, int]]:
    """Where the optional parts are: name to (kind of place, place, index)."""
    found: dict[str, tuple[str, int, int]] = {}
    for place, plane in enumerate(model.planes):
        if isinstance(plane, SampledOcculter):
            # The first part is the spot; neutral-density squares and the holder come after.
            for k in range(1, len(plane.parts)):
                found[f"{plane.name} part {k + 1}"] = ("plane", place, k)
    if isinstance(model.detector, ChainDetector):
        for kind in ("on_samples", "on_pixels"):
            for k, effect in enumerate(getattr(model.detector, kind)):
                if type(effect) in _EFFECTS:
                    found[f"{_EFFECTS[type(effect)]} {kind} {k + 1}"] = (kind, 0, k)
    if model.detector.shear:
        found["shear"] = ("shear", 0, 0)
    return found


def optional_parts(model: OpticalSystem) -> tuple[str, ...]:
    """Names of what a system could do without: squares and bars of the mask, detector effects."""
    return tuple(_parts(model))


def _reduced(model: OpticalSystem, without: Sequence[str]) -> tuple[tuple[Plane, ...], Detector]:
    parts = _parts(model)
    for name in without:
        if name not in parts:
            raise IncompatibleSetupError(
                f"without: {name!r} is no optional part of this model, which has {tuple(parts)}"
            )
    dropped = {parts[name] for name in without}
    planes: list[Plane] = []
    for place, plane in enumerate(model.planes):
        gone = {k for kind, where, k in dropped if kind == "plane" and where == place}
        if gone and isinstance(plane, SampledOcculter):
            kept = [part for k, part in enumerate(plane.parts) if k not in gone]
            plane = SampledOcculter(kept, plane.sampling, plane.diameter, plane.name)
        planes.append(plane)
    changes: dict[str, Any] = {}
    for kind in ("on_samples", "on_pixels"):
        gone = {k for where, _, k in dropped if where == kind}
        if gone:
            effects = getattr(model.detector, kind)
            changes[kind] = tuple(e for k, e in enumerate(effects) if k not in gone)
    if ("shear", 0, 0) in dropped:
        changes["shear"] = 0.0
    if not changes:
        return tuple(planes), model.detector
    # Transforms are kept by wavelength and grid only: not those of the other detector.
    return tuple(planes), replace(model.detector, **changes, _transforms={})


def quadrature(bandpass: Bandpass, count: int) -> Bandpass:
    """Fewer wavelengths with the same moments: Gauss quadrature of the given ones.

    `count` nodes integrate polynomials up to degree 2 `count` - 1 as the given ones do (G. Golub
    and J. Welsch, Math. Comp. 23, 221, 1969).

    Parameters
    ----------
    bandpass : Bandpass
    count : int
        As many as there are give the bandpass itself.
    """
    given = np.array(bandpass.wavelengths)
    if count >= len(given):
        return bandpass
    middle, half = (given.max() + given.min()) / 2, (given.max() - given.min()) / 2
    x = (given - middle) / half
    vectors = [np.sqrt(np.array(bandpass.weights))]
    diagonal, beside = [], []
    for k in range(count):
        moved = x * vectors[-1]
        diagonal.append(float(vectors[-1] @ moved))
        # Against all earlier ones, twice: the recurrence alone loses orthogonality.
        for _ in range(2):
            for vector in vectors:
                moved = moved - (vector @ moved) * vector
        length = float(np.linalg.norm(moved))
        if k < count - 1:
            beside.append(length)
            vectors.append(moved / length)
    jacobi = np.diag(diagonal) + np.diag(beside, 1) + np.diag(beside, -1)
    nodes, columns = np.linalg.eigh(jacobi)
    weights = columns[0] ** 2
    return Bandpass(tuple((middle + half * nodes).tolist()), tuple(weights.tolist()))


def build(model: OpticalSystem, choice: Choice) -> OpticalSystem:
    """The system of a choice, as it is without a correction from a finer one.

    Parameters
    ----------
    model : OpticalSystem
        As given.
    choice : Choice
    """
    changes: dict[str, Any] = {}
    if choice.npix != model.npix:
        changes["npix"] = choice.npix
    if DTYPES[choice.dtype] != model.dtype:
        changes["dtype"] = DTYPES[choice.dtype]
    if choice.occulter_sampling != model.recipe.get("occulter_sampling"):
        changes["occulter_sampling"] = choice.occulter_sampling
    if choice.wavelengths != len(model.bandpass.wavelengths):
        changes["bandpass"] = quadrature(model.bandpass, choice.wavelengths)
    return CheapSystem(model.with_fidelity(**changes), without=choice.without)
