"""Flips and quarter turns between the frames of successive planes, kept exact; other turns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from poppy.poppy_core import PlaneType
from torch import Tensor

__all__ = ["Orientation", "free_turn", "is_quarter_turn", "turns_behind"]

Matrix = tuple[tuple[int, int], tuple[int, int]]


@dataclass(frozen=True)
class Orientation:
    """A symmetry of the square, one of eight, as the matrix that acts on positions (x, y).

    Attributes
    ----------
    matrix : 2 x 2 of int
        New position from old: ``x' = m[0][0] x + m[0][1] y`` and likewise for ``y'``.
    """

    matrix: Matrix = ((1, 0), (0, 1))

    @classmethod
    def inversion(cls, axis: str) -> Orientation:
        """Change of sign of "x", "y" or "both"."""
        return cls(((-1 if axis in ("x", "both") else 1, 0), (0, -1 if axis != "x" else 1)))

    @classmethod
    def quarter_turns(cls, count: int) -> Orientation:
        """Counter-clockwise rotation (from +x to +y) by `count` times 90 deg."""
        turned = cls()
        for _ in range(count % 4):
            turned = turned.then(cls(((0, -1), (1, 0))))
        return turned

    def then(self, later: Orientation) -> Orientation:
        """Return the change, followed by another."""
        a, b = later.matrix, self.matrix
        rows = [[sum(a[i][k] * b[k][j] for k in (0, 1)) for j in (0, 1)] for i in (0, 1)]
        return Orientation(((rows[0][0], rows[0][1]), (rows[1][0], rows[1][1])))

    @property
    def inverse(self) -> Orientation:
        """The change back; the matrix is orthogonal."""
        ((a, b), (c, d)) = self.matrix
        return Orientation(((a, c), (b, d)))

    @property
    def sense(self) -> int:
        """1 if counter-clockwise stays counter-clockwise, -1 in a mirror."""
        ((a, b), (c, d)) = self.matrix
        return a * d - b * c

    def positions(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        """New positions of points."""
        ((a, b), (c, d)) = self.matrix
        return a * x + b * y, c * x + d * y

    def apply(self, array: Tensor) -> Tensor:
        """Turn an array (..., n, n) whose middle is the middle of the array."""
        return self._turn(array, roll=0)

    def apply_to_lattice(self, array: Tensor) -> Tensor:
        """Turn an array (..., n, n) whose middle is sample n // 2, as after an FFT, n even.

        The samples at ``-n / 2`` have no mirror image and stay, because they are periodic.
        """
        return self._turn(array, roll=1)

    def _turn(self, array: Tensor, roll: int) -> Tensor:
        ((a, b), (c, d)) = self.matrix
        if a == 0:
            array = array.transpose(-1, -2)
        for sign, axis in ((a + b, -1), (c + d, -2)):
            if sign < 0:
                array = torch.roll(array.flip(axis), roll, axis) if roll else array.flip(axis)
        return array


def is_quarter_turn(optic: Any) -> bool:
    """Whether a plane rotates by a multiple of 90 degrees."""
    return bool(
        optic.planetype == PlaneType.rotation and round(optic.angle / 90) * 90 == optic.angle
    )


def turns_behind(planes: Sequence[Any]) -> list[Orientation]:
    """For every plane, the product of all quarter turns and inversions behind it."""
    turns, turn = [], Orientation()
    for optic in reversed(planes):
        turns.append(turn)
        if optic.planetype == PlaneType.inversion:
            turn = Orientation.inversion(optic.axis).then(turn)
        elif is_quarter_turn(optic):
            turn = Orientation.quarter_turns(round(optic.angle / 90)).then(turn)
    return turns[::-1]


def free_turn(planes: Sequence[Any]) -> float:
    """Rotation of the image by planes that turn by other than right angles, degrees."""
    total, sense = 0.0, 1
    for optic in reversed(planes):
        if optic.planetype == PlaneType.inversion and optic.axis != "both":
            sense = -sense
        elif optic.planetype == PlaneType.rotation and not is_quarter_turn(optic):
            total += optic.angle * sense
    return total
