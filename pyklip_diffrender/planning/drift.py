"""How far the wavefront may have moved, and what a fit of some of its modes leaves of an error."""

from __future__ import annotations

import torch
from torch import Tensor

from pyklip_diffrender.linear.response import NANOMETRE
from pyklip_diffrender.optics.grid import PupilGrid
from pyklip_diffrender.wavefront.bases import default_basis
from pyklip_diffrender.wavefront.priors import WavefrontPrior

__all__ = ["Drift", "RidgeResidual"]


class Drift:
    """Changes of the wavefront drawn from its prior.

    Parameters
    ----------
    prior : WavefrontPrior
    cycles : float
        Highest spatial frequency, cycles across the pupil.
    seed : int

    Attributes
    ----------
    basis : Basis
        All modes.
    deviation : Tensor, (modes,)
        Prior standard deviations, nm.
    """

    def __init__(self, prior: WavefrontPrior, cycles: float, seed: int) -> None:
        self.basis, self.seed = default_basis(cycles), seed
        scales = [prior.scales[name] for name in self.basis.groups]
        per_mode = torch.tensor(scales, dtype=torch.float64)[self.basis.group_index]
        self.deviation = per_mode * prior.shape(self.basis)

    def count(self, cycles: float) -> int:
        """Number of modes up to a spatial frequency."""
        return int((self.basis.frequencies <= cycles).sum())

    def opd(self, which: int, cycles: float, grid: PupilGrid) -> Tensor:
        """One of the draws, with its modes up to a spatial frequency, (npix, npix), m."""
        # Seeds of different plans must not share their draws.
        generator = torch.Generator().manual_seed(1000 * self.seed + which)
        unit = torch.randn(len(self.basis), generator=generator, dtype=torch.float64)
        drawn = torch.where(self.basis.frequencies <= cycles, self.deviation * unit, 0.0)
        return self.basis.opd(drawn * NANOMETRE, grid)


class RidgeResidual:
    """What a linear fit of wavefront modes, with their prior, leaves of an error.

    Parameters
    ----------
    slopes : Tensor, (modes, ny, nx), float64
        Change of the image for one prior standard deviation of each mode, in units of the noise;
        0 where masked.
    """

    def __init__(self, slopes: Tensor) -> None:
        self._slopes = slopes.flatten(1)
        self._curvature = self._slopes @ self._slopes.T

    def left(self, whitened: Tensor, modes: int) -> Tensor:
        """Residual of an error, (ny, nx) in units of the noise, after a fit of the first modes."""
        rows, flat = self._slopes[:modes], whitened.flatten()
        system = self._curvature[:modes, :modes] + torch.eye(len(rows)).to(rows)
        solution = torch.linalg.solve(system, rows @ flat)
        return (flat - solution @ rows).reshape(whitened.shape)
