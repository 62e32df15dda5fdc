"""The fit of a target with the flat-field pattern that its frames turn out to have."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from pyklip_diffrender.io.progress import stage
from pyklip_diffrender.optics.system import OpticalSystem
from pyklip_diffrender.pattern.choice import (
    PatternChoice,
    ReferenceFrames,
    choose_systematics,
    is_refuted_by_first_frame,
)
from pyklip_diffrender.refinement import Refinement
from pyklip_diffrender.scene.observation import Observation
from pyklip_diffrender.wavefront.opd import OPDMap

__all__ = ["fit_with_pattern"]


def fit_with_pattern(
    science: Sequence[Observation],
    references: ReferenceFrames,
    model: OpticalSystem,
    opd: OPDMap,
    fit: Callable[[PatternChoice, bool], Refinement],
    **options: Any,
) -> tuple[PatternChoice, Refinement]:
    """Choose a pattern and fit the target; once more without the library if it is refuted.

    Frames that were calibrated with another flat field do not have the library's pattern, which
    only a fit can tell.

    Parameters
    ----------
    science, references, model, opd
        See `choose_systematics`.
    fit : callable
        Fits the target with a choice. The second argument is True for the fit without the library.
    **options
        Keywords of `choose_systematics`.

    Returns
    -------
    choice : PatternChoice
        The pattern of the last fit.
    fit : Refinement

    Raises
    ------
    DiffrenderError
        As `choose_systematics` and `fit`.
    """
    choice = choose_systematics(science, references, model, opd, **options)
    if choice.has_other_flat_field:
        with stage("pattern of the library in the first frame"):
            is_refuted = is_refuted_by_first_frame(choice, model, opd)
        if is_refuted:
            choice = choose_systematics(science, references, model, opd, library=False, **options)
    result = fit(choice, False)
    if choice.is_refuted_by(result):
        choice = choose_systematics(science, references, model, opd, library=False, **options)
        result = fit(choice, True)
    return choice, result
