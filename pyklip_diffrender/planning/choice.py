"""The settings that a plan chooses between, and how it states an error of the star model."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Any, Self

__all__ = ["Choice", "Economy", "ModelError", "Option"]

_WORST = 10.0
"""Largest error of a single pixel, as a multiple of the budget for the rms."""


@dataclass(frozen=True)
class Choice:
    """A value for every setting that can be made cheaper.

    Attributes
    ----------
    npix : int
        Samples across the pupil.
    multifidelity : bool
        Whether the coarse pupil gives only the change of the field since the starting wavefront,
        where the field is that of the model as given.
    wavelengths : int
        Number of wavelengths, the nodes of a Gauss quadrature of the model's.
    cycles : float
        Highest spatial frequency of the wavefront modes, cycles across the pupil.
    """

    npix: int
    multifidelity: bool
    wavelengths: int
    cycles: float

    @property
    def system(self) -> Self:
        """The settings of the optical system alone, without that of the fit."""
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
        several = list(errors)
        return cls(math.hypot(*(e.rms for e in several)), math.hypot(*(e.worst for e in several)))

    @classmethod
    def largest(cls, errors: Iterable[ModelError]) -> ModelError:
        """The largest rms and the largest worst pixel."""
        several = list(errors)
        return cls(max(e.rms for e in several), max(e.worst for e in several))


@dataclass(frozen=True)
class Option:
    """Fields of `Choice` that may be changed, and the error that this alone causes."""

    changes: dict[str, Any]
    error: ModelError = field(default_factory=ModelError)


@dataclass(frozen=True)
class Economy:
    """One way to make the model cheaper, as a probe measured it.

    Attributes
    ----------
    name : str
    options : tuple of Option
        From cheap to fine; the last is the model as given, or what the caller has pinned.
    note : str
        Why there is only one option, where that is so.
    """

    name: str
    options: tuple[Option, ...]
    note: str = ""
