"""Pointings: frames that show the star at one place and orientation, averaged for the fit."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from pyklip_diffrender.io.geometry import half_circle
from pyklip_diffrender.scene.exposure import beginning
from pyklip_diffrender.scene.observation import Observation

__all__ = [
    "FrameDetails",
    "Pointing",
    "part_of",
    "pointings_of",
]

_SAME_PLACE = 0.05
"""Pixels by which the star may move within a pointing."""

_SAME_ANGLE = 0.01
"""Degrees by which the position angle may change within a pointing: a tenth of a pixel 10 arcsec
from the star."""


class FrameDetails(NamedTuple):
    """Details of one frame, from its file, that an `Observation` of several does not hold."""

    name: str
    header: fits.Header
    first_pixel: tuple[int, int] | None = None
    star_offset: tuple[float, float] | None = None


@dataclass(frozen=True, eq=False)
class Pointing:
    """Frames that show the star at one place and orientation.

    Attributes
    ----------
    frames : ndarray of int
        Their indices among the fitted frames.
    observation : Observation
        These frames, with the header of the first.
    """

    frames: NDArray[np.intp]
    observation: Observation

    def __repr__(self) -> str:
        return f"<Pointing: frames {', '.join(map(str, self.frames))} of {self.observation.name!r}>"


def part_of(observation: Observation, which: NDArray[np.intp] | NDArray[np.bool_]) -> Observation:
    """Some frames of an observation, chosen by an index array or a mask."""
    angles = observation.position_angles
    return dataclasses.replace(
        observation,
        data=observation.data[which],
        error=observation.error[which],
        valid=observation.valid[which],
        center=observation.center[which],
        position_angles=None if angles is None else angles[which],
    )


def pointings_of(
    observation: Observation, details: Sequence[FrameDetails] | None = None
) -> list[Pointing]:
    """Sort the frames of an observation by where they show the star.

    Parameters
    ----------
    observation : Observation
        Several pointings.
    details : sequence of FrameDetails, optional
        One for each frame; default what the observation says.
    """
    known = observation.position_angles
    angles = np.zeros(len(observation)) if known is None else known
    groups: list[list[int]] = []
    for k, (center, angle) in enumerate(zip(observation.center, angles, strict=True)):
        for group in groups:
            other = group[0]
            if (
                np.hypot(*(center - observation.center[other])) <= _SAME_PLACE
                and abs(half_circle(angle - angles[other])) <= _SAME_ANGLE
                and (details is None or details[k].first_pixel == details[other].first_pixel)
            ):
                group.append(k)
                break
        else:
            groups.append([k])
    pointings = []
    for group in groups:
        frames = np.array(group)
        part = part_of(observation, frames)
        # One place for all: what is averaged has one star.
        center = np.tile(part.center.mean(axis=0), (len(frames), 1))
        part = dataclasses.replace(part, center=center, position_angles=angles[frames])
        if details is not None:
            first = details[group[0]]
            part = dataclasses.replace(
                part,
                name=first.name if len(group) == 1 else f"{first.name} and {len(group) - 1} more",
                header=first.header,
                date=beginning(first.header, first.name),
                first_pixel=first.first_pixel,
                star_offset=first.star_offset,
            )
        pointings.append(Pointing(frames, part))
    return pointings
