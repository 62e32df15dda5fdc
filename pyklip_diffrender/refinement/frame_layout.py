"""Layout of the unknowns of one frame: indices, starting values and priors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from pyklip_diffrender.io.geometry import rotation_matrix
from pyklip_diffrender.parameters import LEVELS, parameter
from pyklip_diffrender.scene.objects import Planet

__all__ = ["COMPANION_PRIOR", "FrameLayout"]

_LINEAR = tuple(p.name for p in LEVELS)

COMPANION_PRIOR = (float("inf"), 0.1, 0.1)
"""Prior standard deviations of a companion's contrast, x and y (arcsec) about its start."""


@dataclass
class FrameLayout:
    """Layout of the vector: optical parameters, levels, companions, amplitude, wavefront.

    Units are those of the parameter table; a companion is (contrast, x, y) with x, y in arcsec
    from the star, image orientation; modes are in nm.

    Attributes
    ----------
    names : tuple of str
        Free optical parameters and levels: flux, background and pedestal.
    start : dict of str to Tensor
        Values of all optical parameters that are not at their defaults, free or not, and of
        the levels.
    modes : int
        Wavefront modes.
    amplitude_modes : int
        Amplitude modes of the pupil.
    companions : list of Planet
        Starting values of companions.
    roll : float
        Degrees by which the sky is turned, counter-clockwise, relative to the first frame.
    shows_companions : bool
        False for a reference star.
    deviations : mapping of str to float
        Prior standard deviations that replace those of the parameter table.
    """

    names: tuple[str, ...]
    start: dict[str, Tensor]
    modes: int
    amplitude_modes: int = 0
    companions: list[Planet] = field(default_factory=list)
    roll: float = 0.0
    shows_companions: bool = True
    deviations: Mapping[str, float] = field(default_factory=dict)

    @property
    def optical(self) -> tuple[str, ...]:
        """Free parameters of the model."""
        return tuple(name for name in self.names if name not in _LINEAR)

    @property
    def linear(self) -> tuple[str, ...]:
        """Levels that are free, in the order of the parameter table."""
        return tuple(name for name in _LINEAR if name in self.names)

    @property
    def ordered(self) -> tuple[str, ...]:
        """Names in the order of the vector."""
        return (*self.optical, *self.linear)

    def where(self, name: str) -> slice:
        """Place of a parameter, or of "companions", "amplitude" or "modes"."""
        sizes = {each: parameter(each).size for each in self.ordered}
        sizes["companions"] = 3 * len(self.companions)
        sizes["amplitude"], sizes["modes"] = self.amplitude_modes, self.modes
        begin = 0
        for each, size in sizes.items():
            if each == name:
                return slice(begin, begin + size)
            begin += size
        raise KeyError(name)

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
        values = {name: value for name, value in self.start.items() if name not in _LINEAR}
        for name in self.optical:
            values[name] = vector[self.where(name)]
        return values

    def level(self, name: str, vector: Tensor) -> float:
        """Flux, background or pedestal."""
        value = vector[self.where(name)] if name in self.linear else self.start[name]
        return float(value[0])

    def sources(self, vector: Tensor) -> Tensor:
        """Contrast, x and y of companions in the first frame, (companions, 3)."""
        return vector[self.where("companions")].reshape(-1, 3)

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

    def with_companions(self, added: Sequence[Planet]) -> FrameLayout:
        """Return a layout with more companions."""
        return replace(self, companions=[*self.companions, *added])
