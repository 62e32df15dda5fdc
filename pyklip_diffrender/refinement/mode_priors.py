"""Priors of the modes of a fit: amplitude, wavefront, and its drift between frames."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from pyklip_diffrender.refinement.settings import GaussNewton
from pyklip_diffrender.wavefront.bases import Basis
from pyklip_diffrender.wavefront.priors import EvidenceUpdate, scale_ratios

__all__ = ["ModePriors", "count_modes_below"]

_IMPROBABLE = 1.5
"""Ratio of the fitted to the fixed scale of modes above which the prior is wrong."""


def count_modes_below(basis: Basis, cycles: float) -> int:
    """Count the leading modes of a basis whose spatial frequency is at most `cycles`."""
    beyond = torch.nonzero(basis.frequencies > cycles).flatten()
    return int(beyond[0]) if len(beyond) else len(basis)


@dataclass
class ModePriors:
    """Gaussian priors about zero.

    Attributes
    ----------
    amplitude : Tensor, (amplitude modes,)
        Standard deviations, nm of an imaginary OPD.
    drift : int
        Number of leading modes of the wavefront that may differ between frames.
    shape : Tensor, (modes + frames * drift,)
        Standard deviations of the wavefront's modes relative to the scale of their group.
    group : Tensor, (modes + frames * drift,), int64
        Index of the group.
    names : tuple of str
        Names of the groups.
    scales : Tensor, (groups,)
        nm. Every step of a fit updates them unless they are fixed.
    """

    amplitude: Tensor
    drift: int
    shape: Tensor
    group: Tensor
    names: tuple[str, ...]
    scales: Tensor

    @classmethod
    def of(cls, settings: GaussNewton, basis: Basis, frames: int) -> ModePriors:
        """Return the priors of a fit to so many frames."""
        prior, drift = settings.prior, settings.drift
        shape, group, names = prior.shape(basis), basis.group_index, list(basis.groups)
        scales = [prior.scales[name] for name in basis.groups]
        drifting = 0
        if drift is not None and frames > 1:
            drifting = count_modes_below(basis, settings.drift_cycles)
            shape = torch.cat([shape, drift.shape(basis)[:drifting].repeat(frames)])
            own_group = basis.group_index[:drifting] + len(basis.groups)
            group = torch.cat([group, own_group.repeat(frames)])
            names += [f"{name} drift" for name in basis.groups]
            scales += [drift.scales[name] for name in basis.groups]
        amplitude = prior.amplitude_deviation(basis)
        as_tensor = torch.tensor(scales, dtype=torch.float64)
        return cls(amplitude, drifting, shape, group, tuple(names), as_tensor)

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
