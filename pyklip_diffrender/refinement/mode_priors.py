"""Priors of the modes of a fit: amplitude, wavefront, and its drift between frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from pyklip_diffrender.io.geometry import half_circle
from pyklip_diffrender.refinement.settings import GaussNewton
from pyklip_diffrender.scene.observation import Observation
from pyklip_diffrender.wavefront.bases import Basis
from pyklip_diffrender.wavefront.priors import EvidenceUpdate, scale_ratios

__all__ = ["ModePriors", "count_modes_below"]

_IMPROBABLE = 1.5
"""Ratio of the fitted to the fixed scale of modes above which the prior is wrong."""


_SAME_SEQUENCE = 2.0 / 24
"""Days between the beginnings of frames of one exposure sequence: nine dithers of a faint star."""

_SAME_ROLL = 1.0
"""Degrees by which the roll may differ within an exposure sequence."""


def exposure_sequences(observations: Sequence[Observation]) -> list[int]:
    """Number the exposure sequences that observations belong to.

    Frames of one star at one roll, each begun at most two hours after another one, are of one
    sequence: the small-grid dithers of a reference star, for example. There is no slew between
    them. Frames of which date or angle are not known belong to every sequence of their star.

    Returns
    -------
    list of int
        For every observation, from 0 in the order of first appearance.
    """
    numbers: list[int] = []
    for k, each in enumerate(observations):
        own = [numbers[j] for j in range(k) if _follows(each, observations[j])]
        numbers.append(own[0] if own else 1 + max(numbers, default=-1))
    return numbers


def _follows(one: Observation, other: Observation) -> bool:
    """Whether there is no slew between two observations, as far as is known."""
    if one.target != other.target or one.reference != other.reference:
        return False
    dates = [each.date.mjd for each in (one, other) if each.date is not None]
    if max(dates, default=0.0) - min(dates, default=0.0) > _SAME_SEQUENCE:
        return False
    angle, other_angle = one.position_angles, other.position_angles
    if angle is None or other_angle is None:
        return True
    return abs(half_circle(float(angle[0] - other_angle[0]))) <= _SAME_ROLL


def count_modes_below(basis: Basis, cycles: float) -> int:
    """Count the leading modes of a basis whose spatial frequency is at most `cycles`."""
    beyond = torch.nonzero(basis.frequencies > cycles).flatten()
    return int(beyond[0]) if len(beyond) else len(basis)


@dataclass(frozen=True)
class ModePriors:
    """Gaussian priors about zero.

    Attributes
    ----------
    amplitude : Tensor, (amplitude modes,)
        Standard deviations, nm of an imaginary OPD.
    drift : int
        Number of leading modes of the wavefront that may differ between frames.
    blocks : tuple of tuple of int
        For every frame, the blocks of drift that its wavefront has: the first is that of its
        exposure sequence or, where frames of a sequence share none, its own.
    shape : Tensor, (modes + blocks * drift,)
        Standard deviations of the wavefront's modes relative to the scale of their group.
    group : Tensor, (modes + blocks * drift,), int64
        Index of the group.
    names : tuple of str
        Names of the groups.
    scales : Tensor, (groups,)
        nm. A step of a fit returns others unless they are fixed.
    """

    amplitude: Tensor
    drift: int
    blocks: tuple[tuple[int, ...], ...]
    shape: Tensor
    group: Tensor
    names: tuple[str, ...]
    scales: Tensor

    @classmethod
    def of(
        cls, settings: GaussNewton, basis: Basis, observations: Sequence[Observation]
    ) -> ModePriors:
        """Return the priors of a fit to frames of these observations."""
        prior, drift, dither = settings.prior, settings.drift, settings.dither_drift
        shape, group, names = [prior.shape(basis)], [basis.group_index], list(basis.groups)
        scales = [prior.scales[name] for name in basis.groups]
        drifting, blocks = 0, []
        if drift is not None and len(observations) > 1:
            drifting = count_modes_below(basis, settings.drift_cycles)
            sequences = list(range(len(observations)))
            if dither is not None:
                sequences = exposure_sequences(observations)
            blocks = [[number] for number in sequences]
            kinds = [(drift, "drift", 1 + max(sequences))]
            if dither is not None:
                many = [k for k, each in enumerate(sequences) if sequences.count(each) > 1]
                for number, k in enumerate(many, 1 + max(sequences)):
                    blocks[k].append(number)
                kinds += [(dither, "dither", len(many))] if many else []
            for kind, label, count in kinds:
                shape.append(kind.shape(basis)[:drifting].repeat(count))
                group.append((basis.group_index[:drifting] + len(names)).repeat(count))
                names += [f"{name} {label}" for name in basis.groups]
                scales += [kind.scales[name] for name in basis.groups]
        return cls(
            prior.amplitude_deviation(basis),
            drifting,
            tuple(map(tuple, blocks)),
            torch.cat(shape),
            torch.cat(group),
            tuple(names),
            torch.tensor(scales, dtype=torch.float64),
        )

    @property
    def deviation(self) -> Tensor:
        """Standard deviations of amplitude, wavefront and drift, in this order."""
        return torch.cat([self.amplitude, self.scales[self.group] * self.shape])

    def ratios_if_fixed(self, update: EvidenceUpdate, settings: GaussNewton) -> dict[str, float]:
        """Size of the fitted modes relative to their priors, by group; empty if they are fitted."""
        is_fixed = settings.wavefront and not settings.prior.fit_scales
        return self.ratios(update) if is_fixed else {}

    def are_improbable(self, ratios: Mapping[str, float]) -> bool:
        """Whether the wavefront is too large for its prior."""
        of_wavefront = [ratios[name] for name in self.names if ratios]
        return max(of_wavefront, default=0.0) >= _IMPROBABLE

    def ratios(self, update: EvidenceUpdate) -> dict[str, float]:
        """Size of the fitted modes relative to their priors, by group.

        Parameters
        ----------
        update : EvidenceUpdate
            Of all unknowns of the fit, with their variances.
        """
        assert update.variance is not None
        amplitude = torch.zeros(len(self.amplitude), dtype=torch.int64)
        group = torch.cat([amplitude, self.group + 1])
        last = slice(-len(group), None)
        ratios = scale_ratios(update.step[last], update.variance[last], self.deviation, group)
        return dict(zip(["amplitude", *self.names], ratios.tolist(), strict=True))
