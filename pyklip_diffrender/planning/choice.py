"""The settings that a plan chooses, and its measure of the error of a star model."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Any, Self

__all__ = ["Choice", "Economy", "ModelError", "Option"]

_WORST = 10.0
"""Largest allowed error of a single pixel, as a multiple of the budget for the rms."""


@dataclass(frozen=True)
class Choice:
    """A value for every setting that can be made cheaper.

    Attributes
    ----------
    npix : int
        Samples across the pupil.
    multifidelity : bool
        Whether the coarse pupil is used only for the change of the field since the starting
        wavefront, at which the field is that of the full model.
    wavelengths : int
        Number of wavelengths, as nodes of a Gauss quadrature of the model's bandpass.
    cycles : float
        Highest spatial frequency of the wavefront modes, cycles across the pupil.
    """

    npix: int
    multifidelity: bool
    wavelengths: int
    cycles: float

    @property
    def system(self) -> Self:
        """The settings of the optical system alone, without those of the fit."""
        return replace(self, cycles=0.0)


@dataclass(frozen=True)
class ModelError:
    """Error of a star model in units of the pixel noise: rms, and largest absolute value."""

    rms: float = 0.0
    worst: float = 0.0

    def inside(self, budget: float) -> bool:
        """Whether the rms is within the budget, and the worst pixel within ten times as much."""
        return self.rms <= budget and self.worst <= _WORST * budget

    @classmethod
    def in_quadrature(cls, errors: Iterable[ModelError]) -> ModelError:
        """Sum of independent errors."""
        errors = list(errors)
        return cls(math.hypot(*(e.rms for e in errors)), math.hypot(*(e.worst for e in errors)))

    @classmethod
    def largest(cls, errors: Iterable[ModelError]) -> ModelError:
        """The largest rms and the largest worst pixel."""
        errors = list(errors)
        return cls(max(e.rms for e in errors), max(e.worst for e in errors))


@dataclass(frozen=True)
class Option:
    """Changed fields of `Choice`, and the error that this change alone causes."""

    changes: dict[str, Any]
    error: ModelError = field(default_factory=ModelError)


@dataclass(frozen=True)
class Economy:
    """One way to make the model cheaper, as a probe measured it.

    Attributes
    ----------
    name : str
    options : tuple of Option
        From cheap to fine; the last is the full model, or the setting that the caller keeps.
    note : str
        Why there is only one option, if so.
    """

    name: str
    options: tuple[Option, ...]
    note: str = ""
