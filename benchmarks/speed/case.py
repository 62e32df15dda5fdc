"""Cases of the benchmark: each is one way of performing the task of its row."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Accuracy:
    """Errors of a result.

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
    """One way of performing the task of a row.

    Attributes
    ----------
    row, column : str
        The task, and the software and settings that perform it.
    make : callable or None
        Performs the set-up; returns the function that is timed. None if the case cannot be run.
    judge : callable
        Maps a result of that function to its errors.
    precision : str
        "float64" or "float32".
    reference : bool
        Whether the row's ratios are with respect to this case.
    times : float
        Number of times that the timed piece is needed; the total is extrapolated.
    note : str
        Remark for the reader.
    size : float
        For the rows of scaling: the independent variable.
    """

    row: str
    column: str
    make: Callable[[], Callable[[], Any]] | None
    judge: Callable[[Any], Accuracy] = field(default=lambda answer: Accuracy())
    precision: str = "float64"
    reference: bool = False
    times: float = 1.0
    note: str = ""
    size: float = math.nan


def missing(row: str, column: str, why: str) -> Case:
    """Make a case that is listed although it cannot be measured on this machine."""
    return Case(row, column, None, note=f"not measured: {why}")
