"""Refinement of the star with bright sources in the model, or subtracted from the data."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from pyklip_diffrender.detection.candidates import Candidates
from pyklip_diffrender.detection.field import Image
from pyklip_diffrender.detection.groups import has_only_reference_stars
from pyklip_diffrender.refinement import Refinement, refine_again
from pyklip_diffrender.scene.observation import Observation

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


def without_light(
    fit: Refinement, light: Mapping[int, Image], original: Sequence[Observation] | None = None
) -> Refinement:
    """Refine the star again after light is subtracted from the data, without companions.

    The errors of the data still contain the photon noise of that light.

    Parameters
    ----------
    fit : Refinement
    light : mapping of int to ndarray, (ny, nx)
        By frame.
    original : sequence of Observation, optional
        The frames from which it is subtracted; default those of the fit.
    """
    observations = original or [frame.observation for frame in fit.frames]
    frames = [
        replace(frame, observation=replace(observation, data=observation.data - light.get(k, 0.0)))
        for k, (frame, observation) in enumerate(zip(fit.frames, observations, strict=True))
    ]
    return refine_again(replace(fit, frames=tuple(frames)), companions=())
