"""Bad pixels that the file does not flag.

A hot pixel that stands out of the star's image looks like a point source to a matched filter, and
in one roll nothing else tells them apart. Its neighbours do: a point source lights several pixels.
Two hypotheses are therefore compared for every pixel that deviates, with the star marginalised in
both: that it alone is wrong, and that a point source is near it. Near a companion of the fit they
are compared twice: in place of the companion, which may be the bad pixel itself, and beside it.
"""

from __future__ import annotations

import torch
from torch import Tensor

from pyklip_diffrender.linear.model import LinearModel
from pyklip_diffrender.refinement.companions import local_maxima
from pyklip_diffrender.refinement.frame_fit import pixel_grid
from pyklip_diffrender.refinement.objective import Objective, State

__all__ = ["isolated_outliers"]

_SIGNIFICANT = 6.0
"""Deviation of an outlier in standard deviations, of the prediction from all other pixels."""

_BETTER = 1.3
"""Smallest ratio of the chi-squared that an outlier explains to that of a point source. For bad
pixels of NIRCam it was 4 to 30. For the brightest pixel of a planet it is below 0.2 in F444W, and
cannot exceed 1, which it approaches where the image of a point is as sharp as a pixel."""

_DEVIATES = 2.0
"""Smallest contribution of such a pixel to Sigma^-1 r, which is less than its deviation where the
fit has taken a part of it."""

_NEAR = 2.0
"""Pixels between an outlier and a companion that may be nothing else."""

_WRONG = 0.3
"""Smallest deviation of an outlier beside such a companion, relative to the companion's brightest
pixel. The model of the companion's image may be wrong by more than the noise, and a second source
would explain that no better than a single pixel."""

_BATCH = 256
"""Number of pixels whose deviations are computed at a time."""

_MOST = 50
"""Largest number of pixels of a frame that are compared, the most deviating first."""


def isolated_outliers(objective: Objective, state: State, linear: LinearModel) -> list[Tensor]:
    """Find pixels that deviate from the model while their neighbours do not.

    Parameters
    ----------
    objective : Objective
    state : State
    linear : LinearModel
        About the state, with the full weights of all pixels.

    Returns
    -------
    list of Tensor of bool, (ny, nx)
        For every frame.
    """
    companions = {k: (point.total - point.star).cpu() for k, point in enumerate(state.points)}
    star_only = linear.without("companions", companions)
    outliers = []
    for k, (forward, point) in enumerate(zip(objective.forwards, state.points, strict=True)):
        unknowns = point.unknowns
        grid = torch.from_numpy(pixel_grid(forward.model, unknowns.values(point.vector)))
        scale = torch.tensor(forward.model.detector.pixelscale, dtype=torch.float64)
        companions_at = unknowns.sources(point.vector)[:, 1:] @ unknowns.turn.T
        steps = torch.linspace(-1.0, 1.0, 5, dtype=torch.float64)
        beside = torch.cartesian_prod(steps, steps) * scale
        mask = torch.zeros(grid.shape[:2], dtype=torch.bool)
        for row, column in _deviating(linear, k):
            place = grid[row, column]
            distances = ((companions_at - place) / scale).norm(dim=1)
            pixel = _single_pixels(mask.shape, torch.tensor([[row, column]]))
            sources = forward.sources(point, place + beside).cpu()
            models = [linear]
            if bool((distances < _NEAR).any()):
                light = companions[k][max(row - 2, 0) : row + 3, max(column - 2, 0) : column + 3]
                exceeds = float(_amplitude(linear, k, pixel).abs()) > _WRONG * float(light.max())
                models = [star_only, linear] if exceeds else [star_only]
            mask[row, column] = any(
                bool(_explained(model, k, pixel) > _BETTER * _explained(model, k, sources).max())
                for model in models
            )
        outliers.append(mask)
    return outliers


def _deviating(linear: LinearModel, k: int) -> list[tuple[int, int]]:
    """Row and column of pixels that deviate more than those beside them, the most first."""
    cleaned = linear.cleaned[k]
    places = torch.nonzero(cleaned.abs() > _DEVIATES)
    deviations = torch.zeros_like(cleaned)
    for start in range(0, len(places), _BATCH):
        some = places[start : start + _BATCH]
        explained = _explained(linear, k, _single_pixels(cleaned.shape, some))
        deviations[some[:, 0], some[:, 1]] = explained.sqrt()
    peaks = local_maxima(deviations.numpy(), deviations.numpy() > 0, _SIGNIFICANT, size=3)
    return peaks[:_MOST]


def _single_pixels(shape: torch.Size, places: Tensor) -> Tensor:
    """Images with light in one pixel each, (k, ny, nx), for rows and columns (k, 2)."""
    images = torch.zeros(len(places), *shape)
    images[torch.arange(len(places)), places[:, 0], places[:, 1]] = 1.0
    return images


def _amplitude(linear: LinearModel, k: int, templates: Tensor) -> Tensor:
    """Most probable amplitude of each template in frame k, (templates,)."""
    products = linear.weigh({k: templates})
    return products.numerator / products.information.clamp(min=1e-300)


def _explained(linear: LinearModel, k: int, templates: Tensor) -> Tensor:
    """Decrease of chi-squared by each template in frame k, (templates,)."""
    products = linear.weigh({k: templates})
    return products.numerator**2 / products.information.clamp(min=1e-300)
