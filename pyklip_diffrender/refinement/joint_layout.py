"""Layout of the joint unknowns of several frames, some shared and some different in each frame."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from pyklip_diffrender.linear.frames import Unknown
from pyklip_diffrender.parameters import parameter
from pyklip_diffrender.refinement.frame_layout import FrameLayout
from pyklip_diffrender.scene.objects import Planet

__all__ = ["JointLayout"]


@dataclass(frozen=True)
class JointLayout:
    """Layout of the joint vector.

    First are the unknowns that differ between frames, frame by frame. Then come the shared ones in
    the order of `FrameLayout`, with the wavefront modes last. At the end are the differences of
    the leading modes of each frame from the shared modes.

    Attributes
    ----------
    frames : tuple of FrameLayout
        They differ only in their starting values.
    own : tuple of str
        Names of the parameters that differ between frames.
    drift : int
        Number of leading modes that may differ between frames.
    """

    frames: tuple[FrameLayout, ...]
    own: tuple[str, ...] = ()
    drift: int = 0

    @property
    def _own(self) -> tuple[str, ...]:
        return tuple(name for name in self.frames[0].ordered if name in self.own)

    @property
    def _shared(self) -> tuple[str, ...]:
        named = tuple(name for name in self.frames[0].ordered if name not in self.own)
        return (*named, "companions", "amplitude", "modes")

    def _size(self, name: str) -> int:
        where = self.frames[0].where(name)
        return where.stop - where.start

    def _begin(self, name: str) -> int:
        """First index of a shared parameter."""
        begin = len(self.frames) * sum(self._size(own) for own in self._own)
        for each in self._shared:
            if each == name:
                return begin
            begin += self._size(each)
        raise KeyError(name)

    def where(self, name: str) -> slice:
        """Place of a shared parameter, or of "drift"."""
        if name == "drift":
            begin = self._begin("modes") + self._size("modes")
            return slice(begin, begin + len(self.frames) * self.drift)
        begin = self._begin(name)
        return slice(begin, begin + self._size(name))

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return self.where("drift").stop

    def unknowns_with(self, modes: int) -> int:
        """Number of unknowns if only the first `modes` modes are free; 0 for the alignment only."""
        if modes == 0:
            return self.where("companions").stop
        every = self.where("modes")
        return self.size if modes == every.stop - every.start else every.start + modes

    def rows(self, frame: int) -> Tensor:
        """Indices in the joint vector of the entries of a frame's vector, (entries,), int64."""
        unknowns = self.frames[frame]
        rows = torch.empty(unknowns.where("modes").stop, dtype=torch.int64)
        begin = frame * sum(self._size(own) for own in self._own)
        for name in self._own:
            rows[unknowns.where(name)] = torch.arange(begin, begin + self._size(name))
            begin += self._size(name)
        for name in self._shared:
            place = self.where(name)
            rows[unknowns.where(name)] = torch.arange(place.start, place.stop)
        return rows

    def drift_rows(self, frame: int) -> Tensor:
        """Indices of the differences of a frame's modes from the shared ones, (drift,), int64."""
        begin = self.where("drift").start + frame * self.drift
        return torch.arange(begin, begin + self.drift)

    def of_frame(self, frame: int, vector: Tensor) -> Tensor:
        """Return the vector of a frame."""
        values = vector[self.rows(frame)]
        first = self.frames[frame].where("modes").start
        values[first : first + self.drift] += vector[self.drift_rows(frame)]
        return values

    def onto_unknowns(self, frame: int, vector: Tensor) -> Tensor:
        """Return derivatives by the joint vector from those by a frame's; adjoint of `of_frame`."""
        total = torch.zeros(self.size, dtype=vector.dtype)
        total[self.rows(frame)] = vector
        first = self.frames[frame].where("modes").start
        total[self.drift_rows(frame)] = vector[first : first + self.drift]
        return total

    def joined(self, vectors: Sequence[Tensor]) -> Tensor:
        """Return the joint vector; shared parameters are those of the first frame."""
        joint = torch.zeros(self.size, dtype=torch.float64)
        for frame in reversed(range(len(self.frames))):
            joint[self.rows(frame)] = vectors[frame]
        return joint

    def initial(self) -> Tensor:
        """The starting vector: the mean of the prior."""
        return self.joined([unknowns.initial() for unknowns in self.frames])

    def warm(self, values: Mapping[Unknown, float]) -> Tensor:
        """Return the starting vector with the final values of an earlier fit.

        Parameters
        ----------
        values : mapping of Unknown to float
            Unknowns that are not part of this layout are ignored, and missing ones keep their
            starting values. The bases may differ in length if they begin with the same modes.
            Companions keep the starting values of the layout.
        """
        vector = self.initial()
        for place, unknown in enumerate(self.unknowns()):
            if unknown.name != "companions" and unknown in values:
                vector[place] = values[unknown]
        return vector

    def prior_deviation(self) -> Tensor:
        """Prior standard deviations of all unknowns before the amplitude and the modes."""
        joint = torch.empty(self.where("amplitude").start, dtype=torch.float64)
        for frame, layout in reversed(list(enumerate(self.frames))):
            own = layout.prior_deviation()
            joint[self.rows(frame)[: len(own)]] = own
        return joint

    def clamped(self, vector: Tensor) -> Tensor:
        """Clip every parameter to its bounds."""
        vector = vector.clone()
        for frame, unknowns in enumerate(self.frames):
            rows = self.rows(frame)
            for name in unknowns.ordered:
                entry, places = parameter(name), rows[unknowns.where(name)]
                vector[places] = vector[places].clamp(entry.lower, entry.upper)
        return vector

    def with_companions(
        self, added: Sequence[Planet], vector: Tensor
    ) -> tuple[JointLayout, Tensor]:
        """Return a layout with more companions, and the vector of the same state in it."""
        grown = replace(self, frames=tuple(u.with_companions(added) for u in self.frames))
        moved = grown.initial()
        before, after = self.where("companions").stop, grown.where("companions").stop
        moved[:before] = vector[:before]
        moved[after:] = vector[before:]
        return grown, moved

    def unknowns(self) -> tuple[Unknown, ...]:
        """All unknowns, in order."""
        labels = [Unknown("", 0)] * self.size
        for frame, layout in reversed(list(enumerate(self.frames))):
            rows = self.rows(frame)
            for name in (*layout.ordered, "companions", "amplitude", "modes"):
                owner = frame if name in self.own else -1
                for k, place in enumerate(rows[layout.where(name)].tolist()):
                    labels[place] = Unknown(name, k, owner)
            for k, place in enumerate(self.drift_rows(frame).tolist()):
                labels[place] = Unknown("drift", k, frame)
        return tuple(labels)
