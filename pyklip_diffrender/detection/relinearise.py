"""Refining the star again with bright sources in the model, or taken off the data."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pyklip_diffrender.detection.candidates import Candidates
from pyklip_diffrender.refinement import Refinement, refine, refine_again
from pyklip_diffrender.scene.objects import Planet

__all__ = ["has_only_reference_stars", "lacks_candidates", "with_companions", "without_light"]


def has_only_reference_stars(fit: Refinement) -> bool:
    """Whether a fit shows nothing of the target."""
    return all(frame.observation.reference for frame in fit.frames)


def lacks_candidates(fits: Sequence[Refinement], candidates: Candidates) -> bool:
    """Whether a fit of the target does not have all candidates as companions, and no others."""
    return any(
        len(fit.companions) != len(candidates) for fit in fits if not has_only_reference_stars(fit)
    )


def with_companions(
    fits: Sequence[Refinement], candidates: Candidates, progress: bool = False
) -> list[Refinement]:
    """Refine all fits once more, with candidates as companions of the star.

    A bright companion bends the fitted wavefront beyond where the linear model holds. With
    parameters of its own it does not. Fits of reference stars alone stay as they are.

    Parameters
    ----------
    fits : sequence of Refinement
    candidates : Candidates
        Positions as the first frame of the first fit has them.
    progress : bool
        Show progress bars.
    """
    origin = fits[0].frames[0].observation
    renewed = []
    for fit in fits:
        if has_only_reference_stars(fit):
            renewed.append(fit)
            continue
        # The companions of a later fit are where its own first frame shows them.
        roll = fit.frames[0].observation.roll_from(origin)
        planets = []
        for (x, y), contrast in zip(
            candidates.offsets.tolist(), candidates.contrasts.tolist(), strict=True
        ):
            planet = Planet.from_offset(max(contrast, 0.0), x, y)
            planets.append(replace(planet, position_angle=planet.position_angle + roll))
        renewed.append(refine_again(fit, companions=tuple(planets), progress=progress))
    return renewed


def without_light(fit: Refinement, light: NDArray[np.float64]) -> Refinement:
    """The star of a fit of one frame refined again with some light (ny, nx) taken off the data.

    The noise of that light stays in the errors.
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
