"""The fit of a target with the flat-field pattern that its frames turn out to have."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from pyklip_diffrender.optics.system import OpticalSystem
from pyklip_diffrender.pattern.choice import PatternChoice, ReferenceFrames, choose_systematics
from pyklip_diffrender.refinement import Refinement
from pyklip_diffrender.scene.observation import Observation
from pyklip_diffrender.wavefront.opd import OPDMap

__all__ = ["fit_with_pattern"]


def fit_with_pattern(
    science: Sequence[Observation],
    references: ReferenceFrames,
    model: OpticalSystem,
    opd: OPDMap,
    fit: Callable[[PatternChoice, bool], Sequence[Refinement]],
    **options: Any,
) -> tuple[PatternChoice, list[Refinement]]:
    """Choose a pattern and fit the target; once more without the library if it is refuted.

    Frames that were calibrated with another flat field do not have the library's pattern, which
    only a fit can tell.

    Parameters
    ----------
    science, references, model, opd
        See `choose_systematics`.
    fit : callable
        Fits the target with a choice. The second argument is True for the fit without the library.
        Frames that cannot be fitted together may have several fits.
    **options
        Keywords of `choose_systematics`.

    Returns
    -------
    choice : PatternChoice
        The pattern of the last fit.
    fits : list of Refinement

    Raises
    ------
    DiffrenderError
        As `choose_systematics` and `fit`.
    """
    choice = choose_systematics(science, references, model, opd, **options)
    fits = list(fit(choice, False))
    # All of them, because every fit that lacks its pattern is to be mentioned in the log.
    if any([choice.is_refuted_by(each) for each in fits]):
        choice = choose_systematics(science, references, model, opd, library=False, **options)
        fits = list(fit(choice, True))
    return choice, fits
