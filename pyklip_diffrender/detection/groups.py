"""Fits of one target, each with its linear model and its templates.

The frames of a fit share unknowns, those of different fits do not. Therefore the information of
different groups adds.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import torch
from torch import Tensor

from pyklip_diffrender.detection.templates import Templates
from pyklip_diffrender.linear.model import LinearModel, TemplateProducts
from pyklip_diffrender.refinement import Refinement

__all__ = ["Group", "groups_of", "has_only_reference_stars", "weigh"]

Group = tuple[LinearModel, Templates]


def has_only_reference_stars(fit: Refinement) -> bool:
    """Whether no frame of a fit shows the target."""
    return all(frame.observation.reference for frame in fit.frames)


def groups_of(fits: Sequence[Refinement]) -> list[Group]:
    """Linear model and templates of every fit of the target."""
    origin = fits[0].frames[0]
    return [
        (fit.star_only, Templates(fit, origin)) for fit in fits if not has_only_reference_stars(fit)
    ]


def weigh(
    groups: Sequence[Group], render: Callable[[Templates], Mapping[int, Tensor]]
) -> TemplateProducts:
    """Inner products of templates with the data, summed over groups.

    Parameters
    ----------
    groups : sequence of (LinearModel, Templates)
    render : callable
        Returns the templates (k, ny, nx) of a group by frame.
    """
    products = [linear.weigh(render(templates)) for linear, templates in groups]
    return TemplateProducts(
        *(torch.stack(parts).sum(dim=0) for parts in zip(*products, strict=True))
    )
