"""The course of a fit: its states, and how far it has come."""

from __future__ import annotations

import math
from dataclasses import dataclass

from pyklip_diffrender.refinement.objective import State
from pyklip_diffrender.refinement.settings import GaussNewton
from pyklip_diffrender.refinement.solver import StepState

__all__ = ["NOTHING", "Course"]

NOTHING = (math.inf, math.inf)
"""Model error and chi-squared of no state."""


@dataclass
class Course:
    """Where a fit is in its schedule.

    Attributes
    ----------
    state, best, aligned : State
        The present one, the one of the least model error, and the one that ended the alignment.
    carried : StepState
        What the last step hands on to the next one.
    settings : GaussNewton
        Those of the fit, with the size of the drift between frames once it is measured.
    kappa : float
        Assumed error of the star model, as a fraction of the star.
    modes : int
        Number of leading wavefront modes that are free; 0 for the alignment.
    remaining : int
        Number of steps that may follow.
    error, chi2 : float
        Model error and chi-squared per pixel of `state`.
    least : (float, float)
        Model error and chi-squared per pixel of `best`.
    may_drop : bool
        Whether companions may be dropped. They may not after some were added to a fit that had
        stalled, or it might add and drop them for ever.
    """

    state: State
    best: State
    aligned: State
    carried: StepState
    settings: GaussNewton
    kappa: float
    modes: int
    remaining: int
    error: float = math.inf
    chi2: float = math.inf
    least: tuple[float, float] = NOTHING
    may_drop: bool = True
