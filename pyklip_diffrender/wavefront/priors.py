"""Gaussian priors on wavefront changes, with scales that maximise the evidence of the data.

Each group of modes (segment motions, texture) has one scale; within a group the standard deviation
follows a fixed shape. At the scale the evidence, the probability of the data marginalised over the
modes, is stationary (D. MacKay, "Bayesian interpolation", Neural Computation 4, 415, 1992).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import torch
from astropy import units as u
from scipy.linalg.lapack import dtrtri
from torch import Tensor

from pyklip_diffrender.io.units import set_numbers, to_number
from pyklip_diffrender.wavefront.bases import Basis

_CURVATURE_ROUNDING = 1e-12
"""Relative error of the curvature's elements."""

_SCALE_LIMITS = (1e-4, 100.0)
"""Smallest and largest scale. Without a floor, a group without any signal ends in a division by
zero; without a ceiling, a bright companion that is missing from the model makes the prior so wide
that the equations cannot be solved."""

_FEWEST_DETERMINED_MODES = 20.0
"""Smallest number of determined modes that constrain the scale of a group."""


@dataclass(frozen=True)
class WavefrontPrior:
    """Standard deviations of wavefront coefficients.

    Attributes
    ----------
    scales : dict of str to float
        Group name to scale, nm rms per mode at zero frequency. Starting values when
        `fit_scales` is true.
    knee : float
        Cycles across the pupil at which the deviation has fallen to half.
    slope : float
        Beyond the knee the deviation falls as frequency to minus this power.
    fit_scales : bool
        Maximise the evidence over the scales.
    amplitude_cycles : float
        Modes up to this frequency may also change the amplitude across the pupil.
    amplitude_scale : float
        Prior deviation of amplitude modes, nm of an imaginary OPD (at 4.4 um 1 nm changes the
        amplitude by 0.14 %); 0 for a fixed amplitude.
    amplitude_slope : float
        Beyond the knee the amplitude's deviation falls as frequency to minus this power.

    Examples
    --------
    >>> from astropy import units as u
    >>> import pyklip_diffrender as dr
    >>> dr.wavefront.WavefrontPrior(scales={"segment": 2 * u.nm, "texture": 0.1}).scales
    {'segment': 2.0, 'texture': 0.1}
    """

    scales: dict[str, float] = field(default_factory=lambda: {"segment": 4.0, "texture": 0.1})
    knee: float = 8.0
    slope: float = 1.0
    fit_scales: bool = True
    amplitude_cycles: float = 0.0
    amplitude_scale: float = 0.0
    amplitude_slope: float = 1.0

    def __post_init__(self) -> None:
        scales = {
            name: to_number(scale, u.nm, f"scales: {name}", "not negative")
            for name, scale in self.scales.items()
        }
        object.__setattr__(self, "scales", scales)
        set_numbers(
            self,
            knee=("", "positive"),
            slope=("", "not negative"),
            amplitude_cycles=("", "not negative"),
            amplitude_scale=(u.nm, "not negative"),
            amplitude_slope=("", "not negative"),
        )

    def amplitude_modes(self, basis: Basis) -> int:
        """Number of modes, from the first, that may also change the pupil's amplitude."""
        if self.amplitude_scale <= 0:
            return 0
        beyond = torch.nonzero(basis.frequencies > self.amplitude_cycles).flatten()
        return int(beyond[0]) if len(beyond) else len(basis)

    def amplitude_deviation(self, basis: Basis) -> Tensor:
        """Prior deviation of the amplitude modes, in nm of an imaginary OPD."""
        frequency = basis.frequencies[: self.amplitude_modes(basis)]
        return self.amplitude_scale / (1 + (frequency / self.knee) ** self.amplitude_slope)

    def shape(self, basis: Basis) -> Tensor:
        """Standard deviation of every mode relative to its group's scale, (modes,)."""
        return 1 / (1 + (basis.frequencies / self.knee) ** self.slope)

    def widened(self, ratios: Mapping[str, float]) -> WavefrontPrior:
        """Return a prior with its scales multiplied by ratios above 1.

        Parameters
        ----------
        ratios : mapping of str to float
            Ratios by group of modes, and "amplitude" for the scale of the amplitude modes.

        Examples
        --------
        >>> from pyklip_diffrender.wavefront import WavefrontPrior
        >>> WavefrontPrior({"segment": 2.0, "texture": 0.1}).widened({"segment": 1.5}).scales
        {'segment': 3.0, 'texture': 0.1}
        """
        wider = {name: max(1.0, ratio) for name, ratio in ratios.items()}
        return replace(
            self,
            scales={name: wider.get(name, 1.0) * scale for name, scale in self.scales.items()},
            amplitude_scale=wider.get("amplitude", 1.0) * self.amplitude_scale,
        )


@dataclass(frozen=True)
class EvidenceUpdate:
    """The solution of a linearised problem."""

    step: Tensor  # (parameters,), most probable values
    variance: Tensor | None  # (parameters,), if it was asked for
    scales: Tensor  # (groups,)
    # Number of unknowns that the data determine: the sum of 1 minus the ratio of posterior and
    # prior variance (with the scales before the last update, where no errors were asked for).
    effective: float
    log_evidence: float  # up to a constant that does not depend on the scales

    def in_units(self, unit: Tensor) -> EvidenceUpdate:
        """Return the solution in other units; `unit`, (parameters,), is an old unit in new ones."""
        variance = None if self.variance is None else self.variance * unit**2
        return replace(self, step=self.step * unit, variance=variance)


def _invert_lower(factor: Tensor) -> Tensor:
    """Inverse of a lower triangle, in half the time of solving for the identity.

    The inverse overwrites `factor` if its columns are contiguous, as in torch's Cholesky factors.
    """
    inverse, failure = dtrtri(factor.numpy(), lower=1, overwrite_c=1)
    assert not failure, "a Cholesky factor has no zero on its diagonal"
    return torch.from_numpy(inverse)


def solve_with_evidence(
    curvature: Tensor,
    gradient: Tensor,
    shape: Tensor,
    group: Tensor,
    scales: Tensor,
    fixed_deviation: Tensor,
    *,
    iterations: int,
    damping: float = 0.0,
    current: Tensor | None = None,
    errors: bool = False,
) -> EvidenceUpdate:
    """Solve a whitened linear least-squares problem with Gaussian priors about zero.

    `curvature` is G^T G of the whitened Jacobian, (n, n), float64, the wavefront modes last, and
    `gradient` G^T of the whitened residual at zero, (n,). `shape` and `group` are the relative
    prior deviation and the group of every mode, `scales` the starting scales of the groups, and
    `fixed_deviation`, (n - modes,), the prior deviations of the parameters before the modes, inf
    without a prior. `iterations` is the number of updates of the scales; `damping` is the penalty
    on steps from `current`, (n,), as a multiple of the prior's penalty.
    """
    # With the prior's precision P and the damping d of steps from x0 (Levenberg-Marquardt), the
    # step x minimises |r - G x|^2 + x P x + d (x - x0) P (x - x0):
    #
    #     A x = G^T r + d P x0,    A = G^T G + (1 + d) P.
    #
    # With the variances V = diag A^-1, the data determine the share 1 - P V of every unknown. The
    # evidence is stationary in the scale s of a group where s^2 times the sum of the shares is the
    # sum of (x / shape)^2 over its modes (MacKay 1992, above); that is iterated. Without damping
    # its logarithm is, up to a constant,
    #
    #     x (G^T r) / 2 - log det A / 2 + log det P / 2.
    others = len(fixed_deviation)
    effective = float("nan")
    for k in range(iterations + 1):
        deviation = torch.cat([fixed_deviation, scales[group] * shape])
        precision = deviation**-2
        system = curvature.clone()
        # Rounding errors of the curvature can exceed the precision of a wide prior.
        system.diagonal().mul_(1 + _CURVATURE_ROUNDING).add_((1 + damping) * precision)
        factor = torch.linalg.cholesky(system)
        del system  # Of thousands of unknowns, each matrix takes 100 MB or more.
        log_determinant = 2 * factor.diagonal().log().sum()
        pulled = gradient if current is None else gradient + damping * precision * current
        step = torch.cholesky_solve(pulled[:, None], factor)[:, 0]
        if k == iterations and not errors:
            break
        # A = L L^T, so that diag A^-1 is the sum of the squares in each column of L^-1.
        variance = _invert_lower(factor).square_().sum(dim=0)
        # Share of every unknown that the data determine, and the scale of the modes of each group.
        share = 1 - precision * variance
        effective = float(share.sum())
        if k == iterations:
            break
        determined = share[others:]
        power = (step[others:] / shape) ** 2
        counted = torch.zeros_like(scales).index_add(0, group, determined)
        summed = torch.zeros_like(scales).index_add(0, group, power)
        scales = torch.sqrt(summed / counted.clamp(min=1e-3)).clamp(*_SCALE_LIMITS)
    known = torch.isfinite(deviation)
    log_evidence = float(0.5 * (gradient @ step - log_determinant) - deviation[known].log().sum())
    return EvidenceUpdate(step, variance if errors else None, scales, effective, log_evidence)


def scale_ratios(step: Tensor, variance: Tensor, deviation: Tensor, group: Tensor) -> Tensor:
    """Size of the modes of each group relative to their prior, (groups,).

    Most probable values, their variance and the prior's deviation are (modes,), as is `group`.
    A size above 1 says that the prior is too narrow; groups with too few determined modes have 1.
    """
    # At the scales of the highest evidence, the sum of (step / deviation)^2 is the number of modes
    # that the data determine.
    count = int(group.max()) + 1
    determined = torch.zeros(count, dtype=step.dtype)
    determined.index_add_(0, group, 1 - variance / deviation**2)
    size = torch.zeros_like(determined).index_add_(0, group, (step / deviation) ** 2)
    return torch.where(
        determined > _FEWEST_DETERMINED_MODES, (size / determined).clamp(min=0).sqrt(), 1.0
    )
