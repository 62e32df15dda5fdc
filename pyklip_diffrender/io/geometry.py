"""Rotations of positions in a plane."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

__all__ = ["rotation_matrix"]


def rotation_matrix(degrees: float) -> NDArray[np.float64]:
    """Return the matrix that rotates positions (x, y) counter-clockwise, from +x to +y.

    Parameters
    ----------
    degrees : float

    Returns
    -------
    ndarray, (2, 2)
        To be multiplied by positions as columns from the left; rows take its transpose from
        the right.

    Examples
    --------
    >>> rotation_matrix(90).round(12) @ [1, 0]
    array([0., 1.])
    """
    cosine, sine = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return np.array([[cosine, -sine], [sine, cosine]])
