"""Learning the static wavefront of a filter from fits of stars."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from pyklip_diffrender.refinement.result import Refinement
from pyklip_diffrender.refinement.settings import GaussNewton
from pyklip_diffrender.refinement.static_wavefront import StaticWavefront
from pyklip_diffrender.wavefront.bases import default_basis

__all__ = ["combine_wavefronts", "measure_wavefronts"]

_TYPICAL_SHARE = 0.7
"""Correlation between the library's stars, for a wavefront that one star alone has shown."""


def measure_wavefronts(refinements: Sequence[Refinement]) -> list[StaticWavefront]:
    """Wavefronts that fits of stars have added to their maps, one for each fit.

    Fits that failed, whose frames are not NIRCam's, or that have modes of their own are left out.
    """
    measured = []
    for fit in refinements:
        first, settings = fit.frames[0].observation, fit.settings
        if not (fit.status.usable and first.is_nircam and fit.linear is not None):
            continue
        if not isinstance(settings, GaussNewton) or settings.basis is not None:
            continue
        phase, amplitude = (_values(fit, name) for name in ("modes", "amplitude"))
        start = None if fit.systematics is None else fit.systematics.wavefront
        if start is not None:
            phase, amplitude = _sum(phase, start.phase), _sum(amplitude, start.amplitude)
        if not len(phase):
            continue
        mask = first.header.get("CORONMSK")
        measured.append(
            StaticWavefront(
                phase=phase,
                amplitude=amplitude,
                cycles=max(settings.cycles[0], 0.0 if start is None else start.cycles),
                stars=(first.target,),
                filter=first.filter,
                image_mask=mask.strip().upper() if isinstance(mask, str) else None,
                dates=() if first.date is None else (first.date.isot,),
            )
        )
    return measured


def _values(fit: Refinement, name: str) -> NDArray[np.float64]:
    """Fitted values of the unknowns of a name."""
    assert fit.linear is not None
    rows = [k for k, unknown in enumerate(fit.linear.unknowns) if unknown.name == name]
    return np.asarray(fit.linear.vector[rows].numpy(), dtype=np.float64)


def _sum(first: NDArray[np.float64], second: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sum of coefficients of bases that begin with the same modes."""
    total = np.zeros(max(len(first), len(second)))
    total[: len(first)] += first
    total[: len(second)] += second
    return total


def combine_wavefronts(wavefronts: Sequence[StaticWavefront]) -> StaticWavefront | None:
    """Estimate what stars have in common from the wavefronts of several.

    The estimate is the mean, shrunk by what differs between stars: where a coefficient is the sum
    of a common value of variance S and a star's own of variance N, the most probable common value
    is S / (S + N / n) of the mean over n stars. S is the mean product of the coefficients of two
    stars, and S + N their mean square, separately for segments, texture and amplitude.

    Returns
    -------
    StaticWavefront or None
        None for no wavefronts.
    """
    if not wavefronts:
        return None
    # Bases begin with the same modes; those that one star lacks are nobody's.
    modes = min(len(each.phase) for each in wavefronts)
    amplitude_modes = min(len(each.amplitude) for each in wavefronts)
    cycles = min(each.cycles for each in wavefronts)
    phase = np.stack([each.phase[:modes] for each in wavefronts])
    group = default_basis(cycles).group_index.numpy()
    common = np.concatenate([_common(phase[:, group == k]) for k in range(group.max() + 1)])
    return StaticWavefront(
        phase=common,
        amplitude=_common(np.stack([each.amplitude[:amplitude_modes] for each in wavefronts])),
        cycles=cycles,
        stars=tuple(dict.fromkeys(star for each in wavefronts for star in each.stars)),
        filter=wavefronts[0].filter,
        image_mask=wavefronts[0].image_mask,
        dates=tuple(date for each in wavefronts for date in each.dates),
    )


def _common(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Shrunk mean over stars of coefficients, (stars, modes), of one kind."""
    count, mean = len(values), values.mean(axis=0)
    if count == 1:
        return _TYPICAL_SHARE * mean
    square = float(np.mean(values**2))
    product = float(np.mean([np.mean(a * b) for a, b in combinations(values, 2)]))
    common = min(max(product, 0.0), square)
    own = square - common
    return common / (common + own / count) * mean if common else 0.0 * mean
