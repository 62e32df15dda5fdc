"""By how much what is left in the frames is larger than their noise."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from pyklip_diffrender.detection.templates import Templates
from pyklip_diffrender.linear_model import LinearModel

__all__ = ["excess"]

_DEPENDENT = 1e-6
"""Relative eigenvalue below which a source is no other than those beside it."""


def excess(groups: Sequence[tuple[LinearModel, Templates]], offsets: Tensor) -> float:
    """Factor for the errors, at least 1, by what neither noise, modes nor known sources explain.

    A few percent of structure that no mode explains are in the star's place in a planet's filter,
    too. Light of planets is not: they are fitted together and taken out of the data first, or one
    of S/N 20 would make its own error 3 % larger, and those of all others.

    Parameters
    ----------
    groups : sequence of (LinearModel, Templates)
        Independent of each other.
    offsets : Tensor, (k, 2)
        x, y of the sources from the star, arcsec; some may be the same.

    Returns
    -------
    float
        Square root of chi2 over what noise and the number of fitted parameters make it, averaged
        over frames.
    """
    chi2, expected = 0.0, 0.0
    images = [templates.at(offsets) if len(offsets) else {} for _, templates in groups]
    contrasts, count = _together(groups, images)
    for (linear, _), shown in zip(groups, images, strict=True):
        left = dict(enumerate(linear.cleaned))
        if shown:
            light = {k: torch.tensordot(contrasts, part, dims=1)[None] for k, part in shown.items()}
            left = {k: left[k] - part[0] for k, part in linear.clean(light).items()}
        chi2 += sum(float((part**2).sum()) for part in left.values())
        pixels = sum(int((frame.weight > 0).sum()) for frame in linear.frames)
        expected += max(pixels - float(linear.determined.sum()), 1e-3 * pixels)
    return math.sqrt(max(1.0, chi2 / max(expected - count, 1.0)))


def _together(
    groups: Sequence[tuple[LinearModel, Templates]], images: Sequence[dict[int, Tensor]]
) -> tuple[Tensor, int]:
    """Contrasts of all sources as one fit has them, and how many of them are independent."""
    if not images[0]:
        return torch.zeros(0, dtype=torch.float64), 0
    matrices, vectors = zip(
        *(
            linear.normal_equations(shown)
            for (linear, _), shown in zip(groups, images, strict=True)
        ),
        strict=True,
    )
    matrix = torch.stack(matrices).sum(dim=0)
    inverse = torch.linalg.pinv(matrix, rtol=_DEPENDENT, hermitian=True)
    count = int(torch.linalg.matrix_rank(matrix, rtol=_DEPENDENT, hermitian=True))
    return inverse @ torch.stack(vectors).sum(dim=0), count
