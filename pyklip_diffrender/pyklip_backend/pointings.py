"""Pointings: frames that show the star at one place and orientation, averaged for the fit."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from pyklip_diffrender.scene.exposure import beginning, middle
from pyklip_diffrender.scene.integrations import pointings
from pyklip_diffrender.scene.observation import Observation

__all__ = [
    "FrameDetails",
    "Pointing",
    "part_of",
    "pointings_of",
]


class FrameDetails(NamedTuple):
    """Details of one frame, from its file, that an `Observation` of several does not hold."""

    file: str
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
    """Sort the frames of an observation by file and by where they show the star.

    The rule is that of `Observation.pointings`. As in a `Sequence`, the pointings are in order of
    time.

    Parameters
    ----------
    observation : Observation
        Several pointings.
    details : sequence of FrameDetails, optional
        One for each frame; by default all frames are as if from one file.
    """
    known = observation.position_angles
    if details is None:
        groups = list(pointings(observation.center, known))
        return [Pointing(group, _at_one_place(observation, group)) for group in groups]
    files: dict[str, list[int]] = {}
    for k, each in enumerate(details):
        files.setdefault(each.file, []).append(k)
    made = []
    for file, rows in files.items():
        inside = np.array(rows)
        angles = None if known is None else known[inside]
        groups = [inside[each] for each in pointings(observation.center[inside], angles)]
        for k, group in enumerate(groups, 1):
            first = details[group[0]]
            part = dataclasses.replace(
                _at_one_place(observation, group),
                name=file if len(groups) == 1 else f"{file} (pointing {k})",
                header=first.header,
                date=beginning(first.header, file),
                mid_date=middle(first.header, file),
                first_pixel=first.first_pixel,
                star_offset=first.star_offset,
            )
            made.append(Pointing(group, part))
    return sorted(
        made, key=lambda each: 0.0 if each.observation.date is None else each.observation.date.mjd
    )


def _at_one_place(observation: Observation, group: NDArray[np.intp]) -> Observation:
    """Some frames, with their star at one place: what is averaged has one star."""
    part = part_of(observation, group)
    return dataclasses.replace(part, center=np.tile(part.center.mean(axis=0), (len(group), 1)))
