"""What a plan chooses between: numerical settings, their options, what each costs."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any, Self

from pyklip_diffrender.errors import IncompatibleSetupError

__all__ = ["Choice", "Economy", "Error", "Option", "allowed", "check_pins"]

_WORST = 10.0
"""Error of the worst pixel, in units of the budget, that is allowed."""


@dataclass(frozen=True)
class Choice:
    """One value for everything that can be made cheaper.

    Attributes
    ----------
    npix : int
        Samples across the pupil.
    multifidelity : bool
        Take from the coarse pupil only how the field differs from that at the starting wavefront.
    occulter_sampling : float or None
        Cells per lambda/D; None as the model's route has it.
    wavelengths : int
        Number of them: nodes of a Gauss quadrature of the given ones.
    dtype : str
        "float64" or "float32".
    without : tuple of str
        Optional parts that are left out, see `build.optional_parts`.
    cycles : float
        Highest spatial frequency of the wavefront's modes, across the pupil.
    response_npix : int
        Pupil samples of the copy that gives derivatives.
    pixels : float
        The rms, in sigma, of the star's change in those pixels that need not say anything about
        the wavefront; 0 where all do.
    """

    npix: int
    multifidelity: bool
    occulter_sampling: float | None
    wavelengths: int
    dtype: str
    without: tuple[str, ...]
    cycles: float
    response_npix: int
    pixels: float

    def changed(self, changes: Mapping[str, Any]) -> Self:
        """With other values; parts to leave out are added to those that are."""
        merged = dict(changes)
        if "without" in merged:
            merged["without"] = tuple(sorted({*self.without, *merged["without"]}))
        return replace(self, **merged)

    @property
    def system(self) -> Self:
        """The part that makes the optical system; the rest is of the fit."""
        return replace(self, cycles=0.0, response_npix=0, pixels=0.0)


@dataclass(frozen=True)
class Error:
    """How far a star model is off, in units of the pixel noise.

    Attributes
    ----------
    rms : float
        Over the pixels that are used.
    worst : float
        Largest absolute value.
    """

    rms: float = 0.0
    worst: float = 0.0

    def inside(self, budget: float) -> bool:
        """Whether rms and worst pixel are small enough."""
        return self.rms <= budget and self.worst <= _WORST * budget

    @classmethod
    def in_quadrature(cls, errors: Iterable[Error]) -> Error:
        """Of errors that know nothing of each other."""
        several = list(errors)
        return cls(
            math.hypot(*(each.rms for each in several)),
            math.hypot(*(each.worst for each in several)),
        )

    @classmethod
    def largest(cls, errors: Iterable[Error]) -> Error:
        """The larger of each number."""
        several = list(errors)
        return cls(max(each.rms for each in several), max(each.worst for each in several))


@dataclass(frozen=True)
class Option:
    """A setting that may be chosen.

    Attributes
    ----------
    changes : dict
        Fields of `Choice`.
    error : Error
        Of this change alone.
    """

    changes: dict[str, Any]
    error: Error = field(default_factory=Error)


@dataclass(frozen=True)
class Economy:
    """What one probe found.

    Attributes
    ----------
    name : str
    options : tuple of Option
        From cheap to fine; the last is what was given, or what is pinned.
    note : str
        Why there is no choice, if there is none.
    """

    name: str
    options: tuple[Option, ...]
    note: str = ""


def check_pins(pins: Mapping[str, Any]) -> None:
    """Refuse names that are no fields of `Choice`.

    Raises
    ------
    IncompatibleSetupError
    """
    known = [each.name for each in fields(Choice)]
    for name in pins:
        if name not in known:
            raise IncompatibleSetupError(
                f"keep: {name!r} is nothing that a plan chooses; that is {', '.join(known)}"
            )


def allowed(
    candidates: Iterable[dict[str, Any]], finest: dict[str, Any], pins: Mapping[str, Any]
) -> list[dict[str, Any]]:
    """Those candidates, and what was given, that agree with what is pinned.

    Parameters
    ----------
    candidates : iterable of dict
        Fields of `Choice`, from cheap to fine.
    finest : dict
        The same fields as they were given.
    pins : mapping

    Raises
    ------
    IncompatibleSetupError
        If none does.
    """
    everything = [*candidates, finest]
    kept = [
        each
        for each in everything
        if all(pins[name] == value for name, value in each.items() if name in pins)
    ]
    if not kept:
        names = [name for name in finest if name in pins]
        offered = [tuple(each[name] for name in names) for each in everything]
        raise IncompatibleSetupError(
            f"keep: got {', '.join(f'{n}={pins[n]!r}' for n in names)}; for this model there are "
            f"({', '.join(names)}) = {', '.join(map(str, dict.fromkeys(offered)))}"
        )
    return kept
