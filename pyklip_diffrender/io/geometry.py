"""Angles, and rotations of positions in a plane."""

from __future__ import annotations

import math
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

__all__ = ["full_circle", "half_circle", "rotation_matrix"]

Angle = TypeVar("Angle", float, NDArray[np.float64])


def full_circle(degrees: Angle) -> Angle:
    """Return an angle from 0 to 360 degrees, the range of all position angles.

    Examples
    --------
    >>> full_circle(-54.0)
    306.0
    """
    # Twice, because rounding makes 360 of a tiny negative angle.
    return degrees % 360 % 360


def half_circle(degrees: Angle) -> Angle:
    """Return the difference of two angles, from -180 to 180 degrees.

    Examples
    --------
    >>> half_circle(0.5 - 359.5)
    1.0
    """
    return (degrees + 180) % 360 - 180


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
