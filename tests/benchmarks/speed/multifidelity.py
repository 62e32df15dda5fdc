"""A fine model for where the wavefront is known to be near, a coarse one for how far it is off.

The field of a fine pupil grid is expensive, and most of what is wrong with that of a coarse one
(how it samples segments and openings) does not depend on the wavefront. So it cancels in

    E(opd) = E_fine(opd0) + (E_coarse(opd) - E_coarse(opd0)),

whose error shrinks with the distance from `opd0`, and is zero there.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from pyklip_diffrender.errors import IncompatibleSetupError, ShapeError
from pyklip_diffrender.optics.system import OpticalSystem, Value

__all__ = ["MultiFidelity"]


@dataclass(frozen=True)
class _Reference:
    """Where the fine model was evaluated.

    Attributes
    ----------
    opd : Tensor, (coarse npix, coarse npix)
        m.
    values : dict of Tensor
    corrections : list of Tensor
        Fine field minus coarse field at each wavelength.
    """

    opd: Tensor
    values: dict[str, Tensor]
    corrections: list[Tensor]


class MultiFidelity:
    """A model that is called like another one, and is coarse in differences only.

    Parameters
    ----------
    model : OpticalSystem
        The fine one.
    opd0 : Tensor, Quantity or array, (npix, npix), optional
        Where the fine field is taken, m.
    values : mapping of str to value, optional
        The model's other parameters there.
    npix : int
        Pupil samples of the coarse copy; must divide the model's.
    dtype : torch.dtype, optional
        Of the coarse copy; default the model's.
    coarse : OpticalSystem, optional
        In place of a copy, for models without a recipe.

    Raises
    ------
    IncompatibleSetupError
        If the coarse grid does not divide the fine one, if the two systems do not end on the same
        detector at the same wavelengths, or if a copy is needed and the model has no recipe.
    """

    def __init__(
        self,
        model: OpticalSystem,
        opd0: Value | None = None,
        values: Mapping[str, Value | None] | None = None,
        *,
        npix: int = 128,
        dtype: torch.dtype | None = None,
        coarse: OpticalSystem | None = None,
    ) -> None:
        if coarse is None:
            if not model.recipe:
                raise IncompatibleSetupError(
                    "MultiFidelity: the model has no recipe to make a coarse copy from; pass one "
                    "as coarse"
                )
            coarse = model.with_fidelity(npix=npix, dtype=dtype or model.dtype)
        if model.npix % coarse.npix:
            raise IncompatibleSetupError(
                f"npix: {coarse.npix} does not divide the model's {model.npix} pupil samples"
            )
        same = (
            model.detector.shape == coarse.detector.shape,
            model.detector.oversample == coarse.detector.oversample,
            model.bandpass.wavelengths == coarse.bandpass.wavelengths,
        )
        if not all(same):
            raise IncompatibleSetupError(
                "MultiFidelity: the coarse system has another detector or other wavelengths"
            )
        self.model, self.coarse = model, coarse
        self.detector, self.bandpass = model.detector, model.bandpass
        self._factor = model.npix // coarse.npix
        self.move(opd0, values)

    def __repr__(self) -> str:
        return f"<MultiFidelity: {self.model!r}, differences on {self.coarse.npix} samples>"

    def move(
        self, opd0: Value | None = None, values: Mapping[str, Value | None] | None = None
    ) -> None:
        """Take the fine field somewhere else; arguments as for the class."""
        with torch.no_grad():
            fine = self.model.opd(opd0).detach()
            if fine.ndim != 2:
                raise ShapeError(f"opd0: got shape {tuple(fine.shape)}, expected one map")
            checked = {k: v.detach() for k, v in self.model.values(values or {}).items()}
            small = self._pooled(fine)
            corrections = [
                exact - rough
                for exact, rough in zip(
                    self.model.fields(fine, **checked),
                    self.coarse.fields(small, **checked),
                    strict=True,
                )
            ]
        self._reference = _Reference(small, checked, corrections)

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the parameters besides the OPD."""
        return self.model.parameters

    @property
    def npix(self) -> int:
        """Samples across the fine pupil array."""
        return self.model.npix

    def _pooled(self, opd: Tensor) -> Tensor:
        """Mean over the samples of each coarse one, (..., coarse npix, coarse npix)."""
        n, k = self.coarse.npix, self._factor
        if k == 1 or opd.shape[-1] == n:
            return opd
        # Rows first, each as a whole, then columns by a product: a third of the time of a pooling
        # over squares.
        rows = opd.unflatten(-2, (n, k)).sum(dim=-2)
        mean = torch.full((k, 1), 1 / k**2, dtype=opd.dtype, device=opd.device)
        return (rows.unflatten(-1, (n, k)) @ mean).squeeze(-1)

    def fields(self, opd: Value | None = None, **parameters: Value) -> list[Tensor]:
        """Complex field on the detector's samples at each wavelength, each (..., ny, nx).

        Parameters
        ----------
        opd : Tensor, Quantity or array, (..., npix, npix), optional
            m, on the fine grid or, as the mean over each of its samples, on the coarse one.
            Default that of the reference.
        **parameters
            Those that are not given are the reference's.
        """
        there = self._reference
        if opd is None:
            small = there.opd
        elif isinstance(opd, Tensor) and opd.shape[-2:] == there.opd.shape:
            small = self.coarse.opd(opd)
        else:
            small = self._pooled(self.model.opd(opd))
        given = {**there.values, **self.model.values(parameters)}
        return [
            rough + correction
            for rough, correction in zip(
                self.coarse.fields(small, **given), there.corrections, strict=True
            )
        ]

    def __call__(
        self,
        opd: Value | None = None,
        star_offset: Value | None = None,
        *,
        weights: Tensor | None = None,
        **parameters: Value,
    ) -> Tensor:
        """Image of a point source; see `OpticalSystem` and `fields`.

        Returns
        -------
        Tensor, (..., ny, nx)
            Light per detector pixel as a fraction of what the entrance pupil collects.
        """
        given = dict(parameters)
        if star_offset is not None:
            given["star_offset"] = star_offset
        values = {**self._reference.values, **self.model.values(given)}
        return self.model.image_of(self.fields(opd, **given), values, weights)
