"""What a fit leaves of an error of the star model: its modes bend to what they can explain."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["Absorber"]


class Absorber:
    """A linear fit of wavefront modes with their prior.

    Parameters
    ----------
    slopes : Tensor, (modes, ny, nx), float64
        What a prior standard deviation of each mode does to the image, in units of the noise; 0
        where masked.
    """

    def __init__(self, slopes: Tensor) -> None:
        self._slopes = slopes.flatten(1)
        self._curvature = self._slopes @ self._slopes.T
        self._factors: dict[int, Tensor] = {}

    def __len__(self) -> int:
        return len(self._slopes)

    def left(self, whitened: Tensor, modes: int) -> Tensor:
        """What a fit of the first modes leaves, without noise.

        Parameters
        ----------
        whitened : Tensor, (..., ny, nx)
            In units of the noise.
        modes : int
        """
        if modes not in self._factors:
            system = self._curvature[:modes, :modes].clone()
            system.diagonal().add_(1.0)
            self._factors[modes] = torch.linalg.cholesky(system)
        rows, flat = self._slopes[:modes], whitened.reshape(-1, self._slopes.shape[1])
        found = torch.cholesky_solve(rows @ flat.T, self._factors[modes])
        return (flat - found.T @ rows).reshape(whitened.shape)
