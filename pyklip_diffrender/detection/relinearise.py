"""Refinement of the star with bright sources in the model, or subtracted from the data."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pyklip_diffrender.detection.candidates import Candidates
from pyklip_diffrender.detection.groups import has_only_reference_stars
from pyklip_diffrender.refinement import Refinement, refine, refine_again

__all__ = ["lacks_candidates", "with_companions", "without_light"]


def lacks_candidates(fits: Sequence[Refinement], candidates: Candidates) -> bool:
    """Whether a fit of the target has another number of companions than there are candidates."""
    return any(
        len(fit.companions) != len(candidates) for fit in fits if not has_only_reference_stars(fit)
    )


def with_companions(
    fits: Sequence[Refinement], candidates: Candidates, progress: bool = False
) -> list[Refinement]:
    """Refine all fits of the target again, with the candidates as companions of the star.

    Without parameters of its own, a bright companion biases the fitted wavefront beyond the range
    of the linear model.

    Parameters
    ----------
    fits : sequence of Refinement
    candidates : Candidates
        Positions refer to the first frame of the first fit.
    progress : bool
        Show progress bars.
    """
    origin = fits[0].frames[0].observation
    refined = []
    for fit in fits:
        if not has_only_reference_stars(fit):
            # Companions of a fit have the orientation of its own first frame.
            roll = fit.frames[0].observation.roll_from(origin)
            fit = refine_again(fit, companions=candidates.planets(roll), progress=progress)
        refined.append(fit)
    return refined


def without_light(fit: Refinement, light: NDArray[np.float64]) -> Refinement:
    """Refine the star of a single frame again after light (ny, nx) is subtracted from the data.

    The errors of the data still contain the photon noise of that light.
    """
    (frame,) = fit.frames
    observation = replace(frame.observation, data=frame.observation.data - light)
    return refine(
        frame.model,
        observation,
        fit.initial,
        settings=fit.settings,
        start=frame.start,
        systematics=fit.systematics,
        plan=fit.plan or "off",
        seed=fit.seed,
    )
