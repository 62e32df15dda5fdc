"""Cholesky factor of a covariance between pixels that are near each other.

The matrix is cut into strips of a few rows of pixels. Where no pixel is correlated with one beyond
the next strip, the matrix is block tridiagonal, with diagonal blocks A_s and blocks B_s of strip
s + 1 and strip s, and so is its factor:

    L_s L_s^T = A_s - E_(s-1) E_(s-1)^T,    E_s = B_s L_s^-T.

For frames of n x n pixels in strips of h rows, this takes n^3 h^2 operations, and n^3 h with every
image, instead of n^6 and n^4.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

__all__ = ["StripFactor"]


class StripFactor:
    """Lower Cholesky factor L of a block-tridiagonal matrix.

    Parameters
    ----------
    blocks : callable
        Of two strips, the block of the matrix with rows of the first and columns of the second,
        float64.
    strips : sequence of Tensor, int64
        Places of the pixels of every strip in the vectors, in order.

    Examples
    --------
    >>> import torch
    >>> from pyklip_diffrender.linear.strips import StripFactor
    >>> matrix = torch.eye(4, dtype=torch.float64) + 0.5
    >>> strips = torch.arange(4).split(2)
    >>> factor = StripFactor(lambda a, b: matrix[strips[a]][:, strips[b]], strips)
    >>> torch.allclose(factor.solve(matrix), torch.eye(4, dtype=torch.float64))
    True
    """

    def __init__(self, blocks: Callable[[int, int], Tensor], strips: Sequence[Tensor]) -> None:
        self._strips = tuple(strips)
        self._diagonal: list[Tensor] = []
        self._below: list[Tensor] = []
        for s in range(len(self._strips)):
            block = blocks(s, s)
            if s:
                below = torch.linalg.solve_triangular(
                    self._diagonal[-1], blocks(s, s - 1).T, upper=False
                ).T.contiguous()
                self._below.append(below)
                block = block - below @ below.T
            self._diagonal.append(torch.linalg.cholesky(block))
        self._as: dict[torch.dtype, tuple[list[Tensor], list[Tensor]]] = {
            torch.float64: (self._diagonal, self._below)
        }

    @property
    def log_determinant(self) -> float:
        """Logarithm of the determinant of the matrix."""
        return 2 * sum(float(block.diagonal().log().sum()) for block in self._diagonal)

    def _of_type(self, dtype: torch.dtype) -> tuple[list[Tensor], list[Tensor]]:
        """The blocks in single or double precision."""
        if dtype not in self._as:
            self._as[dtype] = (
                [each.to(dtype) for each in self._diagonal],
                [each.to(dtype) for each in self._below],
            )
        return self._as[dtype]

    def whiten(self, vectors: Tensor) -> Tensor:
        """L^-1 x of vectors x, (k, pixels); their scalar products are x^T (L L^T)^-1 x."""
        diagonal, below = self._of_type(vectors.dtype)
        white = torch.empty_like(vectors)
        before = torch.zeros(0)
        for s, places in enumerate(self._strips):
            part = vectors[:, places].T
            if s:
                part = part - below[s - 1] @ before
            before = torch.linalg.solve_triangular(diagonal[s], part, upper=False)
            white[:, places] = before.T
        return white

    def solve(self, vectors: Tensor) -> Tensor:
        """(L L^T)^-1 x of vectors x, (k, pixels)."""
        diagonal, below = self._of_type(vectors.dtype)
        solved = self.whiten(vectors)
        after = torch.zeros(0)
        for s in reversed(range(len(self._strips))):
            part = solved[:, self._strips[s]].T
            if s + 1 < len(self._strips):
                part = part - below[s].T @ after
            after = torch.linalg.solve_triangular(diagonal[s].T, part, upper=True)
            solved[:, self._strips[s]] = after.T
        return solved
