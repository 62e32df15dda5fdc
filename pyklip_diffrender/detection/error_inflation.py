"""Errors and thresholds of a search, from the residuals of its fits."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np
import torch
from astropy import units as u
from astropy.table import QTable
from torch import Tensor

from pyklip_diffrender.detection.candidates import Candidates
from pyklip_diffrender.detection.error_factor import ErrorFactor
from pyklip_diffrender.detection.field import separation_of
from pyklip_diffrender.detection.groups import Group
from pyklip_diffrender.detection.maps import Maps
from pyklip_diffrender.detection.significance import Significance
from pyklip_diffrender.refinement import Refinement

__all__ = [
    "chi2_by_ring",
    "default_factor",
    "error_inflation",
    "follows_scatter",
    "significance_of",
]

_RINGS = (0.2, 0.6, 1.2, 2.0)
"""Separations between which chi-squared is stated, arcsec."""

_DEGENERATE = 1e-6
"""Relative eigenvalue below which sources are degenerate with each other."""


def follows_scatter(fits: Sequence[Refinement]) -> bool:
    """Whether errors are multiplied by the scatter of the S/N, and not by chi-squared alone.

    On real frames, and where a fit does not explain its data, errors of the model that neighbouring
    pixels share do not show in chi-squared.
    """
    explained = all(fit.status.calibrated for fit in fits)
    return not explained or fits[0].frames[0].observation.is_nircam


def significance_of(
    fits: Sequence[Refinement],
    maps: Maps,
    sources: Tensor,
    inner: float,
    scatter: float | None = None,
) -> Significance:
    """Errors and thresholds of the S/N maps of fits.

    Parameters
    ----------
    fits : sequence of Refinement
    maps : Maps
    sources : Tensor, (k, 2)
        x, y of the known sources, arcsec.
    inner : float
        Smallest separation of a source, arcsec.
    scatter : float, optional
        Replaces the factor.
    """
    return Significance(
        maps.grid,
        maps.starlight,
        maps.correlation,
        inner,
        fits[0].model.resolution,
        error_inflation(fits, maps.groups, sources) if scatter is None else scatter,
        scatter is None and follows_scatter(fits),
    )


def default_factor(
    fits: Sequence[Refinement], groups: Sequence[Group], sources: Candidates
) -> ErrorFactor:
    """Factor for the errors of sources that were fitted together, as in a search."""
    if not follows_scatter(fits):
        return ErrorFactor.constant(error_inflation(fits, groups, sources.offsets))
    maps = Maps(groups)
    significance = significance_of(fits, maps, sources.offsets, fits[0].model.resolution)
    return significance.factor(maps.snr(maps.without(sources)), sources.offsets)


def error_inflation(fits: Sequence[Refinement], groups: Sequence[Group], offsets: Tensor) -> float:
    """Square root of the reduced chi-squared with the light of sources removed, at least 1.

    Unmodelled structure in the residuals biases planet fluxes, so it inflates their errors. Planets
    are not part of it: one of S/N 20 that is not removed would increase all errors by 3 %.
    Therefore the sources are fitted together and removed first.

    Parameters
    ----------
    fits : sequence of Refinement
    groups : sequence of (LinearModel, Templates)
        Of these fits.
    offsets : Tensor, (k, 2)
        x, y of the sources from the star, arcsec; some may coincide.

    Returns
    -------
    float
        1 if a fit does not explain its data, because its noise then includes a model error.
    """
    if not all(fit.status.calibrated for fit in fits):
        return 1.0
    reduced = float(np.mean([fit.reduced_chi2 for fit in fits]))
    companions = Candidates.of_fit(fits[0]).offsets
    # A ratio, because robust fits give outliers less weight in their linear models.
    share = _reduced_chi2(groups, offsets) / _reduced_chi2(groups, companions)
    return math.sqrt(max(1.0, reduced * share))


def chi2_by_ring(groups: Sequence[Group], sources: Tensor, factor: ErrorFactor) -> QTable:
    """Chi-squared per pixel of the target's frames in rings about the star, without the sources.

    Parameters
    ----------
    groups : sequence of (LinearModel, Templates)
    sources : Tensor, (k, 2)
        x, y of the sources, arcsec.
    factor : ErrorFactor

    Returns
    -------
    QTable
        Inner and outer separation, chi-squared per pixel, and the median error factor.
    """
    squares, distances = [], []
    for (linear, templates), residuals in zip(groups, _residuals(groups, sources)[0], strict=True):
        for k, fitted in templates.frames.items():
            used = (linear.frames[k].weight > 0).numpy()
            squares.append(residuals[k].numpy()[used] ** 2)
            distances.append(separation_of(fitted.grid)[used])
    square, distance = np.concatenate(squares), np.concatenate(distances)
    edges = [*(each for each in _RINGS if each < distance.max()), float(distance.max())]
    rows = []
    for low, high in itertools.pairwise(edges):
        ring = (distance >= low) & (distance <= high)
        if ring.any():
            rows.append((low, high, square[ring].mean(), float(factor.at((low + high) / 2))))
    table = QTable(rows=rows, names=("inner", "outer", "chi2", "error_factor"), dtype=[float] * 4)
    for name in ("inner", "outer"):
        table[name] = np.asarray(table[name]) * u.arcsec
    for name in table.colnames:
        table[name].info.format = ".2f"
    return table


def _reduced_chi2(groups: Sequence[Group], offsets: Tensor) -> float:
    """Reduced chi-squared of the data after the sources and all unknowns are fitted."""
    pixels = sum(int((frame.weight > 0).sum()) for linear, _ in groups for frame in linear.frames)
    residuals, independent = _residuals(groups, offsets)
    chi2 = sum(float((part**2).sum()) for parts in residuals for part in parts)
    return chi2 / max(pixels - independent, 1)


def _residuals(groups: Sequence[Group], offsets: Tensor) -> tuple[list[list[Tensor]], int]:
    """Whitened residuals of all frames by group, and the number of independent sources in them."""
    if not len(offsets):
        return [list(linear.cleaned) for linear, _ in groups], 0
    images = [templates.at(offsets) for _, templates in groups]
    equations = [
        linear.normal_equations(part) for (linear, _), part in zip(groups, images, strict=True)
    ]
    matrix, vector = (torch.stack(parts).sum(dim=0) for parts in zip(*equations, strict=True))
    contrasts = torch.linalg.pinv(matrix, rtol=_DEGENERATE, hermitian=True) @ vector
    independent = int(torch.linalg.matrix_rank(matrix, rtol=_DEGENERATE, hermitian=True))
    residuals = []
    for (linear, _), part in zip(groups, images, strict=True):
        light = {k: torch.tensordot(contrasts, each, dims=1)[None] for k, each in part.items()}
        cleaned = linear.clean(light)
        residuals.append([each - cleaned[k][0] for k, each in enumerate(linear.cleaned)])
    return residuals, independent
