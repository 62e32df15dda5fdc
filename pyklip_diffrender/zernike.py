"""Noll-ordered Zernike polynomials, normalised to unit rms on the disc.

R. J. Noll, "Zernike polynomials and atmospheric turbulence", J. Opt. Soc. Am. 66, 207 (1976).
"""

from __future__ import annotations

from math import comb, sqrt

import torch
from torch import Tensor

__all__ = ["noll_indices", "zernike_basis"]


def noll_indices(j: int) -> tuple[int, int]:
    """Radial order n and azimuthal frequency m (negative for sines) of Noll index `j` >= 1."""
    n = 0
    while (n + 1) * (n + 2) // 2 < j:
        n += 1
    rank = j - n * (n + 1) // 2
    magnitude = 2 * (rank // 2) if n % 2 == 0 else 2 * ((rank - 1) // 2) + 1
    return n, magnitude if j % 2 == 0 else -magnitude


def zernike_basis(count: int, x: Tensor, y: Tensor, radius: float) -> Tensor:
    """Sample the first `count` Noll Zernikes on a rectangular grid; zero outside the disc.

    Parameters
    ----------
    count : int
        Number of polynomials, from Noll index 1 (piston).
    x, y : Tensor, (columns,), (rows,)
        Positions, m.
    radius : float
        Radius of the disc, m.

    Returns
    -------
    Tensor, (count, rows, columns)
    """
    rho = torch.hypot(y[:, None], x[None, :]) / radius
    theta = torch.atan2(y[:, None], x[None, :])
    basis = []
    for j in range(1, count + 1):
        n, m = noll_indices(j)
        radial = torch.zeros_like(rho)
        for k in range((n - abs(m)) // 2 + 1):
            factor = (-1) ** k * comb(n - k, k) * comb(n - 2 * k, (n - abs(m)) // 2 - k)
            radial = radial + factor * rho ** (n - 2 * k)
        if m == 0:
            polynomial = sqrt(n + 1) * radial
        else:
            angular = torch.cos(m * theta) if m > 0 else torch.sin(-m * theta)
            polynomial = sqrt(2 * (n + 1)) * radial * angular
        basis.append(torch.where(rho <= 1, polynomial, 0.0))
    return torch.stack(basis)
