"""Refinement of the star with bright sources in the model, or subtracted from the data."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pyklip_diffrender.detection.candidates import Candidates
from pyklip_diffrender.detection.field import Image
from pyklip_diffrender.detection.groups import has_only_reference_stars
from pyklip_diffrender.detection.templates import Templates
from pyklip_diffrender.refinement import Refinement, refine_again
from pyklip_diffrender.scene.observation import Observation

__all__ = [
    "are_companions",
    "in_derivatives",
    "lacks_candidates",
    "unconfirmed_companions",
    "with_companions",
    "without_light",
]

_NEAR = 0.25
"""lambda/D between a companion of a fit and a candidate that are the same source. Positions of
sources above the threshold are known to a tenth of it."""

_SIMILAR = 0.1
_SIGMAS = 5.0
"""Relative difference of their contrasts, and in standard deviations of that of the companion,
beyond which the fit has not found the source."""


def lacks_candidates(fits: Sequence[Refinement], candidates: Candidates) -> bool:
    """Return True if the companions of a fit of the target are not the candidates.

    They are if every companion is at the place of one candidate and about as bright, and the other
    way round.

    Parameters
    ----------
    fits : sequence of Refinement
    candidates : Candidates
        Positions refer to the first frame of the first fit.
    """
    return any(
        len(fit.companions) != len(candidates) or bool((~_confirmed(fit, fits, candidates)).any())
        for fit in fits
        if not has_only_reference_stars(fit)
    )


def in_derivatives(templates: Templates, offsets: Tensor) -> Tensor:
    """Which sources are companions whose light counts in the derivatives of a fit, (k,).

    Errors of such a source from the linear model contain those of the star and of the source's
    image already.

    Parameters
    ----------
    templates : Templates
    offsets : Tensor, (k, 2)
        x, y of the sources from the star, arcsec.
    """
    fit = templates.fit
    first = fit.frames[0].observation
    places = torch.from_numpy(first.turned(offsets.numpy(), templates.origin.observation))
    companions = torch.from_numpy(fit.bright_companions[:, 1:])
    return (torch.cdist(places, companions) < _NEAR * fit.model.resolution).any(dim=1)


def unconfirmed_companions(
    fits: Sequence[Refinement], candidates: Candidates
) -> NDArray[np.float64]:
    """Companions of the fits of the target that are none of the candidates.

    They are most often errors of the star, which was fitted together with them.

    Parameters
    ----------
    fits : sequence of Refinement
    candidates : Candidates
        Positions refer to the first frame of the first fit.

    Returns
    -------
    ndarray, (k, 3)
        Contrast, and x and y from the star in the first frame of their fit, arcsec.
    """
    parts = [
        fit.companions[~_confirmed(fit, fits, candidates)]
        for fit in fits
        if not has_only_reference_stars(fit)
    ]
    return np.concatenate([np.zeros((0, 3)), *parts])


def _confirmed(
    fit: Refinement, fits: Sequence[Refinement], candidates: Candidates
) -> NDArray[np.bool_]:
    """Which companions of a fit are candidates, (companions,)."""
    roll = fit.frames[0].observation.roll_from(fits[0].frames[0].observation)
    places = np.array([planet.offset for planet in candidates.planets(roll)]).reshape(1, -1, 2)
    contrasts = candidates.contrasts.numpy()
    near = np.hypot(*np.moveaxis(fit.companions[:, None, 1:] - places, -1, 0))
    difference = np.abs(fit.companions[:, None, 0] - contrasts)
    allowed = np.hypot(_SIMILAR * contrasts, _SIGMAS * fit.companion_errors[:, None, 0])
    same = (near < _NEAR * fit.model.resolution) & (difference < allowed)
    return np.asarray(same.any(axis=1))


def are_companions(fit: Refinement, candidates: Candidates) -> NDArray[np.bool_]:
    """Which candidates are at the place of a companion of the fit, (candidates,)."""
    away = candidates.offsets.numpy()[:, None] - fit.companions[None, :, 1:]
    near = np.hypot(*np.moveaxis(away, -1, 0)) < _NEAR * fit.model.resolution
    return np.asarray(near.any(axis=1))


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
            again = refine_again(fit, companions=candidates.planets(roll), progress=progress)
            fit = replace(again, seconds=fit.seconds + again.seconds)
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
