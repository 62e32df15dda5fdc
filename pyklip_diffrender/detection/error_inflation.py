"""Errors and thresholds of a search, from the residuals of its fits."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from pyklip_diffrender.detection.candidates import Candidates
from pyklip_diffrender.detection.groups import Group
from pyklip_diffrender.detection.maps import Maps
from pyklip_diffrender.detection.significance import Significance
from pyklip_diffrender.io.units import ARCSEC
from pyklip_diffrender.refinement import Refinement

__all__ = ["error_inflation", "follows_scatter", "resolution_of", "significance_of"]

_DEGENERATE = 1e-6
"""Relative eigenvalue below which sources are degenerate with each other."""


def resolution_of(fit: Refinement) -> float:
    """lambda/D, arcsec."""
    return fit.model.bandpass.mean_wavelength / fit.model.diameter / ARCSEC


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
        resolution_of(fits[0]),
        error_inflation(fits, maps.groups, sources) if scatter is None else scatter,
        scatter is None and follows_scatter(fits),
    )


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


def _reduced_chi2(groups: Sequence[Group], offsets: Tensor) -> float:
    """Reduced chi-squared of the data after the sources and all unknowns are fitted."""
    pixels = sum(int((frame.weight > 0).sum()) for linear, _ in groups for frame in linear.frames)
    if not len(offsets):
        return sum(_chi2(linear.cleaned) for linear, _ in groups) / pixels
    images = [templates.at(offsets) for _, templates in groups]
    equations = [
        linear.normal_equations(part) for (linear, _), part in zip(groups, images, strict=True)
    ]
    matrix, vector = (torch.stack(parts).sum(dim=0) for parts in zip(*equations, strict=True))
    contrasts = torch.linalg.pinv(matrix, rtol=_DEGENERATE, hermitian=True) @ vector
    independent = int(torch.linalg.matrix_rank(matrix, rtol=_DEGENERATE, hermitian=True))
    chi2 = 0.0
    for (linear, _), part in zip(groups, images, strict=True):
        light = {k: torch.tensordot(contrasts, each, dims=1)[None] for k, each in part.items()}
        cleaned = linear.clean(light)
        chi2 += _chi2([residual - cleaned[k][0] for k, residual in enumerate(linear.cleaned)])
    return chi2 / max(pixels - independent, 1)


def _chi2(whitened: Sequence[Tensor]) -> float:
    return sum(float((part**2).sum()) for part in whitened)
