"""Refining the star again with bright candidates in the model, and taking them back out."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pyklip_diffrender.detection.candidates import Candidates
from pyklip_diffrender.linear.model import LinearModel
from pyklip_diffrender.refinement import Refinement, refine_again
from pyklip_diffrender.scene.objects import Planet

__all__ = ["lacking", "star_only", "with_companions", "without_light"]


def lacking(fits: Sequence[Refinement], found: Candidates) -> bool:
    """Whether a fit of the target does not have all candidates as companions, and no others."""
    return any(len(fit.companions) != len(found) for fit in fits if not fit.observation.reference)


def with_companions(
    fits: Sequence[Refinement], found: Candidates, progress: bool = False
) -> list[Refinement]:
    """Refine all frames once more, with candidates as companions of the star.

    A bright companion bends the fitted wavefront beyond where the linear model holds. With
    parameters of its own it does not. Reference stars that share nothing with the target stay as
    they are: they have no companions.

    Parameters
    ----------
    fits : sequence of Refinement
    found : Candidates
        Positions as the first fit's frame has them.
    progress : bool
    """
    planets = []
    for (x, y), contrast in zip(found.offsets.tolist(), found.contrasts.tolist(), strict=True):
        angle = math.degrees(math.atan2(-x, y))
        planets.append(Planet(max(contrast, 0.0), math.hypot(x, y), angle))
    origin = fits[0].observation.position_angles
    again: dict[int, list[Refinement]] = {}
    renewed = []
    for fit in fits:
        key = id(fit.linear)
        members = [each for each in fits if each.linear is fit.linear]
        if all(each.observation.reference for each in members):
            renewed.append(fit)
            continue
        if key not in again:
            own = members[0].observation.position_angles
            # The sky of a later group is turned: its companions are where its first frame has them.
            turn = 0.0 if own is None or origin is None else float(own[0] - origin[0])
            turned = tuple(replace(p, position_angle=p.position_angle - turn) for p in planets)
            again[key] = refine_again(members, planets=turned, progress=progress)
        renewed.append(next(each for each in again[key] if each.frame == fit.frame))
    return renewed


def star_only(fits: Sequence[Refinement]) -> LinearModel:
    """The linear model of frames refined together, with companions put back into the data."""
    linear = fits[0].linear
    assert linear is not None
    light = {fit.frame: fit.companion_image for fit in fits if len(fit.companions)}
    return linear.without("companions", light) if light else linear


def without_light(fit: Refinement, light: NDArray[np.float64]) -> Refinement:
    """The star refined anew, from the start, with some light (ny, nx) taken off all frames.

    The light's own noise stays in their errors.
    """
    observation = replace(fit.observation, data=fit.observation.data - light)
    (found,) = refine_again(
        [replace(fit, observation=observation)], resume=None, prior=fit.settings.prior
    )
    return found
