"""Which rows there are."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from benchmarks.speed.case import Case
from benchmarks.speed.images import FORWARD, STEP, forward, step
from benchmarks.speed.inference import MAP, REFINEMENT, refinement, snr_map
from benchmarks.speed.scaling import SCALING, scaling
from benchmarks.speed.setting import Setting


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
    Row(REFINEMENT, refinement, "of the star model, rms in units of the noise"),
    Row(MAP, snr_map, "of S/N at some positions, largest difference"),
    Row(SCALING, scaling, "none"),
)
"""In the order of the table."""
