"""Rotations and inversions among the planes of a poppy system."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from poppy.poppy_core import PlaneType

from pyklip_diffrender.bridges.orientation import Orientation

__all__ = ["free_turn", "is_quarter_turn", "turns_behind"]


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
