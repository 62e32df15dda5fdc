"""Which rows there are."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from benchmarks.speed.case import Case
from benchmarks.speed.images import FORWARD, STEP, forward, step
from benchmarks.speed.inference import (
    JACOBIAN,
    MAP,
    REFINEMENT,
    jacobian,
    refinement,
    snr_map,
)
from benchmarks.speed.scaling import SCALING, scaling
from benchmarks.speed.setting import Setting
from pyklip_diffrender.errors import IncompatibleSetupError


@dataclass(frozen=True)
class Row:
    """Something that is done, and in what its errors are.

    Attributes
    ----------
    name : str
    cases : callable
    error : str
        What the column "error" is.
    """

    name: str
    cases: Callable[[Setting], list[Case]]
    error: str


ROWS = (
    Row(FORWARD, forward, "largest difference from the converged image, over its peak"),
    Row(STEP, step, "of the image: largest difference from the converged one, over its peak"),
    Row(JACOBIAN, jacobian, "of the derivatives of some modes, relative L2"),
    Row(REFINEMENT, refinement, "of the star model, rms in units of the noise"),
    Row(MAP, snr_map, "of S/N at some positions, largest difference"),
    Row(SCALING, scaling, "none"),
)
"""In the order of the table."""


def select_rows(names: list[str] | None) -> list[Row]:
    """Return rows by their names or the beginnings of their names.

    Raises
    ------
    IncompatibleSetupError
        If no row begins with a name.
    """
    if not names:
        return list(ROWS)
    for name in names:
        if not any(row.name.startswith(name) for row in ROWS):
            available = ", ".join(repr(row.name) for row in ROWS)
            raise IncompatibleSetupError(f"rows: got {name!r}, expected some of {available}")
    return [row for row in ROWS if any(row.name.startswith(name) for name in names)]


def cases_of(row: str, setting: Setting) -> list[Case]:
    """All cases of the row that a case belongs to."""
    (selected_row,) = (r for r in ROWS if r.name == row.split(":")[0])
    return selected_row.cases(setting)
