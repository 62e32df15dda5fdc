"""Point sources in a frame: the strongest first, all refined together with the wavefront free."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter
from torch import Tensor

from pyklip_diffrender.detection.templates import Templates
from pyklip_diffrender.linear.model import LinearModel
from pyklip_diffrender.refinement import Refinement

__all__ = ["Candidates", "refine_candidates", "strongest_peak"]

_log = logging.getLogger(__name__)

_ITERATIONS = 12
_SETTLED = 0.02
"""Steps of position below this many standard deviations end the refinement."""


@dataclass(frozen=True)
class Candidates:
    """Point sources fitted together.

    Attributes
    ----------
    offsets : Tensor, (k, 2)
        x, y from the star, arcsec.
    contrasts : Tensor, (k,)
    covariance : Tensor, (3 k, 3 k)
        Of all contrasts, then all x, then all y; wavefront and alignment integrated out.
    converged : bool
    """

    offsets: Tensor
    contrasts: Tensor
    covariance: Tensor
    converged: bool = True

    def __len__(self) -> int:
        return len(self.contrasts)

    @classmethod
    def none(cls) -> Candidates:
        """No candidate yet."""
        empty = torch.zeros(0, dtype=torch.float64)
        return cls(empty.reshape(0, 2), empty, empty.reshape(0, 0))

    @classmethod
    def of_fit(cls, fit: Refinement) -> Candidates:
        """Companions that a refinement had parameters for."""
        if not len(fit.companions):
            return cls.none()
        found = torch.from_numpy(np.asarray(fit.companions, dtype=float))
        count = 3 * len(found)
        return cls(found[:, 1:], found[:, 0], torch.zeros(count, count, dtype=torch.float64))

    def with_one_more(self, offset: NDArray[np.float64], contrast: float) -> Candidates:
        """Starting values with another source; its errors are not known yet."""
        return replace(
            self,
            offsets=torch.cat([self.offsets, torch.as_tensor(offset).reshape(1, 2)]),
            contrasts=torch.cat([self.contrasts, torch.tensor([contrast], dtype=torch.float64)]),
        )

    def without(self, index: int) -> Candidates:
        """Starting values less one source; the errors of the others are no longer known."""
        keep = torch.arange(len(self)) != index
        count = 3 * int(keep.sum())
        return Candidates(
            self.offsets[keep], self.contrasts[keep], torch.zeros(count, count).double()
        )

    def light(self, templates: Templates) -> dict[int, Tensor]:
        """All of them together, (1, ny, nx) by frame, in the data's unit."""
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
    groups: Sequence[tuple[LinearModel, Templates]], candidates: Candidates, reach: float
) -> Candidates:
    """Fit contrasts and positions of all candidates together.

    Gauss-Newton in the metric of Sigma^-1, in which wavefront and alignment are integrated out.

    Parameters
    ----------
    groups : sequence of (LinearModel, Templates)
        Independent of each other.
    candidates : Candidates
        Where they start.
    reach : float
        Longest step of a position, arcsec.
    """
    count = len(candidates)
    offsets, contrasts = candidates.offsets.clone(), candidates.contrasts.clone()
    identity = torch.eye(3 * count, dtype=torch.float64)
    covariance, converged = identity, False
    for _ in range(_ITERATIONS):
        # Contrasts enter linearly; a position's column is the slope times the contrast.
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
        # Where the position means nothing (contrast near 0), it stays.
        scale = matrix.diagonal().clamp(min=1e-300).sqrt()
        ridge = 1e-9 * identity
        system = matrix / scale[:, None] / scale + ridge
        covariance = torch.linalg.inv(system) / scale[:, None] / scale
        step = covariance @ vector
        contrasts = contrasts + step[:count]
        moves = step[count:].reshape(2, count).T
        longest = moves.norm(dim=1, keepdim=True).clamp(min=1e-300)
        offsets = offsets + moves * (reach / longest).clamp(max=1.0)
        deviation = covariance.diagonal().sqrt()
        if bool((step.abs() < _SETTLED * deviation).all()):
            converged = True
            break
    if not converged:
        _log.warning("positions did not settle, number of candidates: %d", count)
    return Candidates(offsets, contrasts, covariance, converged)


def strongest_peak(
    snr: NDArray[np.float64],
    grid: NDArray[np.float64],
    known: Tensor,
    *,
    threshold: float,
    inner: float,
    apart: float,
) -> tuple[int, int] | None:
    """Pixel of the highest maximum above the threshold that is no known source's.

    Parameters
    ----------
    snr : ndarray, (ny, nx)
    grid : ndarray, (ny, nx, 2)
        x, y from the star, arcsec.
    known : Tensor, (k, 2)
    threshold : float
    inner : float
        No source is looked for nearer to the star, arcsec.
    apart : float
        Nor within this distance of a known one.
    """
    allowed = (np.hypot(grid[..., 0], grid[..., 1]) >= inner) & np.isfinite(snr)
    for x, y in known.tolist():
        allowed &= np.hypot(grid[..., 0] - x, grid[..., 1] - y) >= apart
    filled = np.where(np.isfinite(snr), snr, -math.inf)
    peak = allowed & (filled == maximum_filter(filled, size=3)) & (filled > threshold)
    if not peak.any():
        return None
    row, column = np.unravel_index(int(np.argmax(np.where(peak, filled, -math.inf))), snr.shape)
    return int(row), int(column)
