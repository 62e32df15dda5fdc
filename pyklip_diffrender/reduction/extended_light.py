"""Whether candidates are parts of extended light, such as a disk, rather than planets."""

from __future__ import annotations

import numpy as np
from astropy.table import QTable
from numpy.typing import NDArray
from scipy.special import gammainc

_CHANCE_PROBABILITY = 0.01
"""Probability below which unrelated sources are not taken to be arranged by chance."""

_NEIGHBOURS_LAMBDA_D = 1.5
"""Separation of neighbours, lambda/D: one extended source is found as several this close."""


def looks_extended(candidates: QTable, resolution: float, edge: float) -> str:
    """Say how candidates are arranged like extended light; empty if they may be so by chance.

    `candidates` has x and y from the star, and frame_angle; `resolution` is lambda/D and `edge` the
    largest separation that was searched, arcsec.
    """
    # Sources that have nothing to do with each other have independent position angles, and are
    # spread evenly over the field. The number of candidates alone says nothing.
    count = len(candidates)
    if count < 2:
        return ""
    if count > 2:
        axes = np.sort(candidates["frame_angle"].value % 180)
        gaps = np.diff(axes, append=axes[0] + 180)
        # All axes are in the arc that is left by the largest gap. The probability that n random
        # axes are in an arc a of their circle, a < 1/2, is n a^(n - 1).
        arc = 1 - gaps.max() / 180
        if arc < 0.5 and count * arc ** (count - 1) < _CHANCE_PROBABILITY:
            return "The candidates are in line with the star, like an edge-on disk"
    places = np.stack([candidates["x"].value, candidates["y"].value], axis=1)
    distances = np.hypot(*(places[:, None] - places).T)[np.triu_indices(count, 1)]
    # Each of the n (n - 1) / 2 pairs is within reach of each other with the probability
    # (reach / edge)^2, the ratio of two areas, so that their number is nearly Poisson's.
    reach = _NEIGHBOURS_LAMBDA_D * resolution
    expected = len(distances) * (reach / edge) ** 2
    # The probability of n pairs or more is the regularised incomplete gamma function of n.
    if gammainc((distances < reach).sum(), expected) < _CHANCE_PROBABILITY:
        return "Candidates are next to each other, like parts of an extended source"
    return ""


def on_extended_light(candidates: QTable, offsets: NDArray[np.float64], resolution: float) -> str:
    """Say which candidates lie on extended light that was fitted; empty if none does.

    `candidates` has x, y and separation. `offsets` (k, 2) are x, y of the sources of the extended
    light from the star; `resolution` is lambda/D, arcsec.
    """
    if not len(candidates) or not len(offsets):
        return ""
    places = np.stack([candidates["x"].value, candidates["y"].value], axis=1)
    away = np.hypot(*np.moveaxis(places[:, None] - offsets, -1, 0)).min(axis=1)
    near = np.sort(candidates["separation"].value[away < resolution])
    if not len(near):
        return ""
    separations = ", ".join(f"{each:.2f}" for each in near)
    return (
        f"On the extended light, candidates at {separations} arcsec may be parts of it that its "
        "fit has left."
    )
