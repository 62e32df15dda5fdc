"""The unknowns of a fit: their order, starting values and priors.

The vector of a frame has its optical parameters, levels, companions, amplitude and wavefront. The
vector of all frames begins with the unknowns that differ between frames, frame by frame. Then come
the shared ones in the order of a frame's vector, with the wavefront modes last. At its end are
the blocks of drift, by which the leading modes of a frame differ from the shared modes: a block of
its exposure sequence, and one of its own.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import torch
from torch import Tensor

from pyklip_diffrender.io.units import rotation_matrix
from pyklip_diffrender.linear.model import FrameRows, Unknown
from pyklip_diffrender.parameters import LEVELS, parameter
from pyklip_diffrender.scene.objects import Planet

_LINEAR_NAMES = tuple(p.name for p in LEVELS)

_COUPLED_COMPANION_CONTRAST = 1e-4
"""Contrast of a companion whose light counts in the Jacobian by optics, flux and wavefront. A
change of the wavefront by 10 nm moves 1 % of this light. Without its derivatives, companions of
1e-3 have false candidates beside them, and errors of a S/N above 30 are too small. The derivatives
take as long as the star's."""

_COUPLED_CONTRAST_OVER_ERROR = 0.3
"""Contrast over the error of the star's model below which the derivatives of a companion's light do
not matter yet. Two rolls of G 7-34 need a fifth less memory without them. The last linear model has
all of them."""

COMPANION_PRIOR = (float("inf"), 0.1, 0.1)
"""Prior standard deviations of a companion's contrast, x and y (arcsec) about its start."""


def brightest(sources: Tensor, kappa: float = 0.0) -> Tensor:
    """The brightest of companions (k, 3), if its light depends noticeably on the wavefront.

    The result is (1, 3), or (0, 3) if none does or a model error `kappa` outweighs it.
    """
    # One companion, because its derivatives take as long as the star's.
    first = sources[sources[:, 0].argsort(descending=True)[:1]]
    return first[
        first[:, 0] > max(_COUPLED_COMPANION_CONTRAST, _COUPLED_CONTRAST_OVER_ERROR * kappa)
    ]


@dataclass(frozen=True)
class FrameUnknowns:
    """The unknowns of one frame, in the units of the parameter table.

    A companion is (contrast, x, y) with x, y in arcsec from the star, image orientation; modes are
    in nm.
    """

    names: tuple[str, ...]  # Free optical parameters and levels: flux, background and pedestal.
    # Values of all optical parameters that are not at their defaults, free or not, and of levels.
    start: Mapping[str, Tensor]
    modes: int
    amplitude_modes: int = 0
    companions: tuple[Planet, ...] = ()  # Starting values.
    # Degrees by which the sky is turned, counter-clockwise, relative to the first frame.
    roll: float = 0.0
    shows_companions: bool = True  # False for a reference star.
    # Prior standard deviations that replace the defaults in the parameter table.
    deviations: Mapping[str, float] = field(default_factory=dict)

    @property
    def optical(self) -> tuple[str, ...]:
        """Free parameters of the model."""
        return tuple(name for name in self.names if name not in _LINEAR_NAMES)

    @property
    def linear(self) -> tuple[str, ...]:
        """Levels that are free, in the order of the parameter table."""
        return tuple(name for name in _LINEAR_NAMES if name in self.names)

    @property
    def ordered(self) -> tuple[str, ...]:
        """Names in the order of the vector."""
        return (*self.optical, *self.linear)

    @cached_property
    def slices(self) -> dict[str, slice]:
        """Places of the parameters, and of "companions", "amplitude" and "modes"."""
        sizes = {each: parameter(each).size for each in self.ordered}
        sizes["companions"] = 3 * len(self.companions)
        sizes["amplitude"], sizes["modes"] = self.amplitude_modes, self.modes
        ends = itertools.accumulate(sizes.values())
        return {
            name: slice(end - size, end)
            for (name, size), end in zip(sizes.items(), ends, strict=True)
        }

    def where(self, name: str) -> slice:
        """Place of a parameter, or of "companions", "amplitude" or "modes"."""
        return self.slices[name]

    def initial(self) -> Tensor:
        """The starting vector."""
        named = [self.start[name] for name in self.ordered]
        planets = [
            torch.tensor([p.contrast, *p.offset], dtype=torch.float64) for p in self.companions
        ]
        zeros = torch.zeros(self.amplitude_modes + self.modes, dtype=torch.float64)
        return torch.cat([*named, *planets, zeros])

    def values(self, vector: Tensor) -> dict[str, Tensor]:
        """All optical parameters as the model takes them."""
        values = {name: value for name, value in self.start.items() if name not in _LINEAR_NAMES}
        return {**values, **{name: vector[self.where(name)] for name in self.optical}}

    def level(self, name: str, vector: Tensor) -> float:
        """Flux, background or pedestal."""
        value = vector[self.where(name)] if name in self.linear else self.start[name]
        return float(value[0])

    def sources(self, vector: Tensor) -> Tensor:
        """Contrast, x and y of companions in the first frame, (companions, 3)."""
        return vector[self.where("companions")].reshape(-1, 3)

    def visible_sources(self, vector: Tensor) -> Tensor:
        """Companions that this frame shows, (k, 3) as `sources`."""
        sources = self.sources(vector)
        return sources if self.shows_companions else sources[:0]

    def are_bright(self, vector: Tensor) -> Tensor:
        """Mask of visible companions whose light depends noticeably on the wavefront, (k,)."""
        return self.visible_sources(vector)[:, 0] > _COUPLED_COMPANION_CONTRAST

    def bright_sources(self, vector: Tensor, kappa: float = 0.0) -> Tensor:
        """Companions whose light counts in the Jacobian by the star, (k, 3), see `brightest`."""
        return brightest(self.visible_sources(vector), kappa)

    @property
    def turn(self) -> Tensor:
        """Matrix from positions in the first frame to positions in this one, (2, 2)."""
        return torch.from_numpy(rotation_matrix(self.roll))

    def prior_deviation(self) -> Tensor:
        """Prior standard deviations of all unknowns before the amplitude and the modes."""
        named = [
            torch.full(
                (parameter(name).size,),
                self.deviations.get(name, parameter(name).prior),
                dtype=torch.float64,
            )
            for name in self.ordered
        ]
        planets = torch.tensor(COMPANION_PRIOR, dtype=torch.float64).repeat(len(self.companions))
        return torch.cat([*named, planets])


@dataclass(frozen=True)
class Unknowns:
    """The unknowns of all frames."""

    # Frames differ in their starting values, roll and companions' visibility only.
    frames: tuple[FrameUnknowns, ...]
    own: tuple[str, ...] = ()  # Names of the parameters that differ between frames.
    drift: int = 0  # Number of leading modes that may differ between frames.
    # For every frame, which blocks of drift its wavefront has; empty without drift.
    blocks: tuple[tuple[int, ...], ...] = ()

    @cached_property
    def _own_size(self) -> int:
        """Number of unknowns of every frame that are its own."""
        slices = self.frames[0].slices
        return sum(slices[n].stop - slices[n].start for n in self.frames[0].names if n in self.own)

    def _blocks_of(self, frame: int) -> tuple[int, ...]:
        return self.blocks[frame] if self.blocks else ()

    @cached_property
    def size(self) -> int:
        """Number of unknowns."""
        number = 1 + max((block for blocks in self.blocks for block in blocks), default=-1)
        return self.where("modes").stop + number * self.drift

    def where(self, name: str) -> slice:
        """Place of "companions", "amplitude" or "modes", which frames share."""
        first = self.frames[0].where(name)
        before = (len(self.frames) - 1) * self._own_size
        return slice(first.start + before, first.stop + before)

    def with_modes(self, modes: int) -> int:
        """Number of unknowns if only the first `modes` modes are free; 0 for the alignment only."""
        if modes == 0:
            return self.where("companions").stop
        every = self.where("modes")
        return self.size if modes == every.stop - every.start else every.start + modes

    @cached_property
    def rows(self) -> tuple[FrameRows, ...]:
        """Which unknowns the entries of every frame's vector are."""
        return tuple(self._rows(k) for k in range(len(self.frames)))

    def _rows(self, frame: int) -> FrameRows:
        # The vector begins with the own unknowns of every frame, in the order of its vector, and
        # goes on with the shared ones in the same order. The blocks of drift follow the last of
        # these, the modes.
        own, shared = frame * self._own_size, len(self.frames) * self._own_size
        rows = torch.empty(self.frames[frame].where("modes").stop, dtype=torch.int64)
        for name, where in self.frames[frame].slices.items():
            begin, count = own if name in self.own else shared, where.stop - where.start
            rows[where] = torch.arange(begin, begin + count)
            own, shared = (own + count, shared) if name in self.own else (own, shared + count)
        blocks = torch.tensor(self._blocks_of(frame), dtype=torch.int64)
        drift = shared + blocks[:, None] * self.drift + torch.arange(self.drift)
        return FrameRows(rows, drift, self.frames[frame].where("modes").start)

    def labels(self) -> tuple[Unknown, ...]:
        """Label every unknown, in order."""
        labels = [Unknown("", 0)] * self.size
        for frame, part in reversed(list(enumerate(self.rows))):
            for name, where in self.frames[frame].slices.items():
                owner = frame if name in self.own else -1
                for k, place in enumerate(part.rows[where].tolist()):
                    labels[place] = Unknown(name, k, owner)
            for block, places in zip(self._blocks_of(frame), part.drift.tolist(), strict=True):
                for k, place in enumerate(places):
                    labels[place] = Unknown("drift", k, block)
        return tuple(labels)

    def _joined(self, vectors: Iterable[Tensor]) -> Tensor:
        """Join the vectors of all frames; shared unknowns are taken from the first."""
        joined = torch.zeros(self.size, dtype=torch.float64)
        for part, vector in reversed(list(zip(self.rows, vectors, strict=True))):
            joined[part.rows[: len(vector)]] = vector
        return joined

    def initial(self) -> Tensor:
        """The starting vector: the mean of the prior."""
        return self._joined(frame.initial() for frame in self.frames)

    def warm(self, values: Mapping[Unknown, float]) -> Tensor:
        """Return the starting vector with the final values of an earlier fit.

        Unknowns that are not known here are ignored, and missing ones keep their starting values,
        as do companions. The bases may differ in length if they begin with the same modes.
        """
        vector = self.initial()
        for place, unknown in enumerate(self.labels()):
            if unknown.name != "companions" and unknown in values:
                vector[place] = values[unknown]
        return vector

    def prior_deviation(self) -> Tensor:
        """Prior standard deviations of all unknowns before the amplitude and the modes."""
        joined = self._joined(frame.prior_deviation() for frame in self.frames)
        return joined[: self.where("amplitude").start]

    # The image is not linear in the star's flux F together with what it multiplies. States of the
    # same light are on a curve, and a long step along its tangent leaves it; a step is taken in the
    # light. With e = dF / F,
    #
    # - companions of contrast c have the light F c, so that c' = (c + dc + c e) / (1 + e);
    # - behind an occulter, a wavefront x, the map included, scatters light in proportion to F x^2.
    #   In y = sqrt(F) x, with dy = sqrt(F) dx + x dF / (2 sqrt(F)), a step leads to
    #   x' = (x + dx + x e / 2) / sqrt(1 + e).
    #
    # Without the second, fits with a wide prior take a small part of many accurate steps, and end
    # before the flux is at rest.

    def stepped(self, vector: Tensor, step: Tensor, of_map: Tensor | None) -> Tensor:
        """The vector after a step of the leading unknowns, within the bounds of all parameters.

        `of_map` has the coefficients of the starting map, (modes,), if the step has any modes.
        """
        moved = vector.clone()
        moved[: len(step)] += step
        showing = [frame for frame, each in enumerate(self.frames) if each.shows_companions]
        change = self._change_of_flux(vector, moved, showing)
        if change is not None:
            companions = self.where("companions")
            contrasts = slice(companions.start, companions.stop, 3)
            moved[contrasts] = (moved[contrasts] + change * vector[contrasts]) / (1 + change)
        scattering = slice(self.where("amplitude").start, len(step))
        change = self._change_of_flux(vector, moved, range(len(self.frames)))
        if change is not None and of_map is not None:
            map_part = torch.zeros_like(vector)
            map_part[self.where("modes")] = of_map
            whole = (vector + map_part)[scattering]
            bent = (moved + map_part)[scattering] + change / 2 * whole
            moved[scattering] = bent / math.sqrt(1 + change) - map_part[scattering]
        return self.clamped(moved)

    def _change_of_flux(self, before: Tensor, after: Tensor, frames: Iterable[int]) -> float | None:
        """Relative change of the star's flux summed over frames; None if it is not positive."""
        fluxes = [
            sum(self.frames[k].level("flux", self.rows[k].of_unknowns(each)) for k in frames)
            for each in (before, after)
        ]
        return fluxes[1] / fluxes[0] - 1 if min(fluxes) > 0 else None

    def clamped(self, vector: Tensor) -> Tensor:
        """Clip every parameter to its bounds."""
        vector = vector.clone()
        for unknowns, part in zip(self.frames, self.rows, strict=True):
            for name in unknowns.ordered:
                entry, places = parameter(name), part.rows[unknowns.where(name)]
                vector[places] = vector[places].clamp(entry.lower, entry.upper)
        return vector

    def with_companions(self, added: Sequence[Planet], vector: Tensor) -> tuple[Unknowns, Tensor]:
        """Return unknowns with more companions, and the vector of the same state."""
        frames = [replace(each, companions=(*each.companions, *added)) for each in self.frames]
        grown = replace(self, frames=tuple(frames))
        moved = grown.initial()
        before, after = self.where("companions").stop, grown.where("companions").stop
        moved[:before] = vector[:before]
        moved[after:] = vector[before:]
        return grown, moved

    def without_companions(self, dropped: Tensor, vector: Tensor) -> tuple[Unknowns, Tensor]:
        """Return unknowns without some companions, a mask (companions,), and their vector."""
        stays = torch.ones(self.size, dtype=torch.bool)
        stays[self.where("companions")] = ~dropped.repeat_interleave(3)
        frames = [
            replace(each, companions=tuple(itertools.compress(each.companions, ~dropped)))
            for each in self.frames
        ]
        return replace(self, frames=tuple(frames)), vector[stays]
