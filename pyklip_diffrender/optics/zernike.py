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
    # rho^m exp(i m theta) is a power of x + i y: no trigonometry, and smooth at the centre.
    point = torch.complex(*torch.broadcast_tensors(x[None, :] / radius, y[:, None] / radius))
    squared = point.real**2 + point.imag**2
    inside = (squared <= 1).to(squared.dtype)
    highest = noll_indices(count)[0]
    waves = [torch.ones_like(point)]
    even = [torch.ones_like(squared)]
    for _ in range(highest):
        waves.append(waves[-1] * point)
        even.append(even[-1] * squared)
    basis = []
    for j in range(1, count + 1):
        n, m = noll_indices(j)
        half = (n - abs(m)) // 2
        radial = sum(
            (-1) ** k * comb(n - k, k) * comb(n - 2 * k, half - k) * even[half - k]
            for k in range(half + 1)
        )
        if m == 0:
            basis.append(sqrt(n + 1) * radial * inside)
        else:
            wave = waves[m].real if m > 0 else waves[-m].imag
            basis.append(sqrt(2 * (n + 1)) * radial * wave * inside)
    return torch.stack(basis)
