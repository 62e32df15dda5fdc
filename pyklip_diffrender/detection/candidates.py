"""Point sources in refined frames, fitted together with the star marginalised."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from pyklip_diffrender.detection.error_factor import ErrorFactor
from pyklip_diffrender.detection.field import Image
from pyklip_diffrender.detection.groups import Group
from pyklip_diffrender.detection.templates import Templates
from pyklip_diffrender.refinement import Refinement
from pyklip_diffrender.scene.objects import Planet

__all__ = ["Candidates", "refine_candidates"]

_log = logging.getLogger(__name__)

_ITERATIONS = 12
_SETTLED = 0.02
"""A position whose step is shorter than this many standard deviations stays where it is, so that
its images are used again; the fit ends when all steps are shorter."""


@dataclass(frozen=True)
class Candidates:
    """Point sources fitted together.

    Attributes
    ----------
    offsets : Tensor, (k, 2)
        x, y from the star, arcsec.
    contrasts : Tensor, (k,)
    covariance : Tensor, (3 k, 3 k)
        Of all contrasts, then all x, then all y, with the star marginalised; 0 where not known.
    detection_errors : Tensor, (k,)
        Standard deviations of the contrasts for known positions, as in a map of S/N; 0 where not
        known. Those in `covariance` include what the uncertain positions add.
    converged : bool
    """

    offsets: Tensor
    contrasts: Tensor
    covariance: Tensor
    detection_errors: Tensor
    converged: bool = True

    def snr(self, factor: ErrorFactor) -> Image:
        """S/N of the candidates, (k,), with their errors multiplied by the factor.

        Its square is the difference in chi-squared that a candidate makes. It is what a map of S/N
        shows at the fitted position, so that thresholds and false-alarm probabilities of the map's
        maximum apply.
        """
        errors = self.detection_errors.numpy() * factor.of(self.offsets)
        return np.asarray(self.contrasts.numpy() / errors)

    def __len__(self) -> int:
        return len(self.contrasts)

    @classmethod
    def at(cls, offsets: ArrayLike, contrasts: ArrayLike) -> Candidates:
        """Make starting values from x, y (k, 2) and contrasts (k,)."""
        places = torch.from_numpy(np.asarray(offsets, dtype=float).reshape(-1, 2))
        count = 3 * len(places)
        return cls(
            places,
            torch.from_numpy(np.asarray(contrasts, dtype=float)),
            torch.zeros(count, count, dtype=torch.float64),
            torch.zeros(len(places), dtype=torch.float64),
        )

    @classmethod
    def of_fit(cls, fit: Refinement) -> Candidates:
        """Return the companions that were part of a refinement."""
        return cls.at(fit.companions[:, 1:], fit.companions[:, 0])

    def with_one_more(self, offset: Image, contrast: float) -> Candidates:
        """Starting values with one more source."""
        return Candidates.at(np.vstack([self.offsets, offset]), np.append(self.contrasts, contrast))

    def without(self, index: int) -> Candidates:
        """Starting values without one source."""
        keep = np.arange(len(self)) != index
        return Candidates.at(self.offsets[keep], self.contrasts[keep])

    def planets(self, roll: float = 0.0) -> tuple[Planet, ...]:
        """As planets in a frame whose sky is turned by `roll` degrees counter-clockwise.

        Negative contrasts become 0.
        """
        rows = torch.column_stack([self.contrasts.clamp(min=0), self.offsets]).tolist()
        return tuple(Planet.from_offset(*row).rotated(roll) for row in rows)

    def light(self, templates: Templates) -> dict[int, Tensor]:
        """Image of all candidates together, (1, ny, nx) by frame, in the data's unit."""
        if not len(self):
            return {}
        return {
            frame: torch.tensordot(self.contrasts, images, dims=1)[None]
            for frame, images in templates.at(self.offsets).items()
        }

    @property
    def errors(self) -> Tensor:
        """Standard deviations of contrast, x and y, (k, 3)."""
        return self.covariance.diagonal().clamp(min=0).sqrt().reshape(3, -1).T


def refine_candidates(
    groups: Sequence[Group], candidates: Candidates, reach: float, iterations: int = _ITERATIONS
) -> Candidates:
    """Fit contrasts and positions of all candidates together.

    Gauss-Newton steps with the star marginalised.

    Parameters
    ----------
    groups : sequence of (LinearModel, Templates)
    candidates : Candidates
        Starting values.
    reach : float
        Longest step of a position, arcsec.
    iterations : int
        Largest number of steps.
    """
    if not len(candidates):
        return candidates
    count = len(candidates)
    offsets, contrasts = candidates.offsets.clone(), candidates.contrasts.clone()
    identity = torch.eye(3 * count, dtype=torch.float64)
    covariance, converged = identity, False
    detection_errors = torch.ones(count, dtype=torch.float64)
    for _ in range(iterations):
        # The model is linear in contrasts. The column of a position is slope times contrast.
        matrix = torch.zeros(3 * count, 3 * count, dtype=torch.float64)
        vector = torch.zeros(3 * count, dtype=torch.float64)
        for linear, templates in groups:
            columns = {
                frame: torch.cat([part[0], *(contrasts[:, None, None] * part[1:])])
                for frame, part in templates.at(offsets, slopes=True).items()
            }
            curvature, gradient = linear.normal_equations(columns)
            matrix += curvature
            vector += gradient - curvature[:, :count] @ contrasts
        # The ridge keeps positions where they are if the contrast is near 0.
        scale = matrix.diagonal().clamp(min=1e-300).sqrt()
        ridge = 1e-9 * identity
        system = matrix / scale[:, None] / scale + ridge
        covariance = torch.linalg.inv(system) / scale[:, None] / scale
        of_contrasts = torch.linalg.inv(system[:count, :count])
        detection_errors = of_contrasts.diagonal().clamp(min=0).sqrt() / scale[:count]
        step = covariance @ vector
        contrasts = contrasts + step[:count]
        is_settled = (step.abs() < _SETTLED * covariance.diagonal().sqrt()).reshape(3, count)
        if bool(is_settled.all()):
            converged = True
            break
        moves = step[count:].reshape(2, count).T
        longest = moves.norm(dim=1, keepdim=True).clamp(min=1e-300)
        moves = moves * (reach / longest).clamp(max=1.0)
        offsets = offsets + torch.where(is_settled[1:].all(dim=0)[:, None], 0.0, moves)
    if not converged:
        _log.info("positions did not settle, number of candidates: %d", count)
    return Candidates(offsets, contrasts, covariance, detection_errors, converged)
