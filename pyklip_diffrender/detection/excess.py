"""By how much what is left in the frames is larger than their noise."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from pyklip_diffrender.detection.candidates import Candidates
from pyklip_diffrender.detection.maps import Group
from pyklip_diffrender.refinement import Refinement

__all__ = ["excess"]

_DEPENDENT = 1e-6
"""Relative eigenvalue below which a source is no other than those beside it."""


def excess(fits: Sequence[Refinement], groups: Sequence[Group], offsets: Tensor) -> float:
    """Factor for the errors, at least 1, by what neither noise, modes nor known sources explain.

    A few percent of structure that no mode explains are in the star's place in a planet's filter,
    too. Light of planets is not: they are fitted together and taken out of the data first, or one
    of S/N 20 would make its own error 3 % larger, and those of all others.

    Parameters
    ----------
    fits : sequence of Refinement
    groups : sequence of (LinearModel, Templates)
        Of these fits; independent of each other.
    offsets : Tensor, (k, 2)
        x, y of the sources from the star, arcsec; some may be the same.

    Returns
    -------
    float
        Square root of the fits' chi2, over what noise and the number of modes make it, less what
        the sources explain of it.
    """
    reduced = float(np.mean([fit.reduced_chi2 for fit in fits]))
    known = Candidates.of_fit(fits[0]).offsets
    # The ratio, for fits may have given outliers less weight in their linear models.
    share = _left(groups, offsets) / _left(groups, known)
    return math.sqrt(max(1.0, reduced * share))


def _left(groups: Sequence[Group], offsets: Tensor) -> float:
    """Chi2 per degree of freedom of the data less sources and all that the unknowns explain."""
    pixels = sum(int((frame.weight > 0).sum()) for linear, _ in groups for frame in linear.frames)
    if not len(offsets):
        return sum(_chi2(linear.cleaned) for linear, _ in groups) / pixels
    images = [templates.at(offsets) for _, templates in groups]
    parts = [
        linear.normal_equations(shown) for (linear, _), shown in zip(groups, images, strict=True)
    ]
    matrix = torch.stack([own for own, _ in parts]).sum(dim=0)
    vector = torch.stack([own for _, own in parts]).sum(dim=0)
    contrasts = torch.linalg.pinv(matrix, rtol=_DEPENDENT, hermitian=True) @ vector
    independent = int(torch.linalg.matrix_rank(matrix, rtol=_DEPENDENT, hermitian=True))
    chi2 = 0.0
    for (linear, _), shown in zip(groups, images, strict=True):
        light = {k: torch.tensordot(contrasts, part, dims=1)[None] for k, part in shown.items()}
        cleaned = linear.clean(light)
        chi2 += _chi2([whole - cleaned[k][0] for k, whole in enumerate(linear.cleaned)])
    return chi2 / max(pixels - independent, 1)


def _chi2(whitened: Sequence[Tensor]) -> float:
    return sum(float((part**2).sum()) for part in whitened)
