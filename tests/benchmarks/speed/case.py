"""What is measured: a case is one way of doing what its row asks for."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

__all__ = ["Case", "Found", "missing"]


@dataclass(frozen=True)
class Found:
    """How good an answer is.

    Attributes
    ----------
    error : float
        In the measure of the row, see `rows.ROWS`.
    sigma : float
        rms of the error in units of the paper scene's noise, or NaN.
    """

    error: float = math.nan
    sigma: float = math.nan


@dataclass(frozen=True)
class Case:
    """One way of doing what a row asks for.

    Attributes
    ----------
    row, column : str
        What is done, and by whom and how finely.
    make : callable or None
        Everything that is done once; returns the function that is timed. None if it cannot be.
    judge : callable
        From an answer of that function to its errors.
    precision : str
        "float64" or "float32".
    mode : str
        "eager", "compiled" or "graph".
    reference : bool
        Whether the row's ratios are with respect to this case.
    times : float
        How often the timed piece is needed for the whole: above 1, the rest is extrapolated.
    memory : bool
        Measure the memory as well.
    note : str
        What a reader must know.
    size : float
        For the rows of scaling: what the duration is a function of.
    """

    row: str
    column: str
    make: Callable[[], Callable[[], Any]] | None
    judge: Callable[[Any], Found] = field(default=lambda answer: Found())
    precision: str = "float64"
    mode: str = "eager"
    reference: bool = False
    times: float = 1.0
    memory: bool = False
    note: str = ""
    size: float = math.nan

    @property
    def key(self) -> str:
        """Names the case among all."""
        return f"{self.row} | {self.column} | {self.precision} | {self.mode}"


def missing(row: str, column: str, why: str) -> Case:
    """A case that cannot be measured here, so that a reader sees that it was meant to be."""
    return Case(row, column, None, note=f"not measured: {why}")
