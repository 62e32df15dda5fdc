"""How well the scale of a contrast is known: the star's light, and the source's own image."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from pyklip_diffrender.detection.templates import Templates
from pyklip_diffrender.linear.model import LinearFrame, LinearModel
from pyklip_diffrender.linear.response import NANOMETRE
from pyklip_diffrender.optics.grid import PupilGrid

__all__ = ["scale_errors"]

_CLEAR = 25.0
"""S/N from which on it matters that the wavefront makes a source's own image, too."""


def scale_errors(
    groups: Sequence[tuple[LinearModel, Templates]], offsets: Tensor, significance: Tensor
) -> Tensor:
    """Relative errors of contrasts by what the sources' light is compared with.

    A contrast is the source's light over the star's, and the light is measured by an image that
    the wavefront forms: what is not known of the flux or of the wavefront changes it in proportion.
    Neither makes a source more or less significant. Both come from the same posterior, and may
    cancel in part.

    Parameters
    ----------
    groups : sequence of (LinearModel, Templates)
        Independent of each other.
    offsets : Tensor, (k, 2)
        x, y of the sources from the star, arcsec.
    significance : Tensor, (k,)
        Their S/N. The image of a source below 25 counts as known: noise hides what is not.

    Returns
    -------
    Tensor, (k,), float64
    """
    frames = sum(len(templates.frames) for _, templates in groups)
    variance = torch.zeros(len(offsets), dtype=torch.float64)
    for linear, templates in groups:
        changes = torch.zeros(len(linear.vector), len(offsets), dtype=torch.float64)
        for k, fitted in templates.frames.items():
            frame = linear.frames[k]
            on_rows = torch.zeros(len(frame.rows), len(offsets), dtype=torch.float64)
            for row, unknown in enumerate(frame.rows[: frame.first_mode].tolist()):
                if linear.unknowns[unknown].name == "flux":
                    on_rows[row] = 1 / fitted.flux
            for j in torch.nonzero(significance > _CLEAR).flatten().tolist():
                on_rows[frame.first_mode :, j] = _by_modes(templates, k, frame, offsets[j])
            changes += frame.onto_unknowns(on_rows, len(linear.vector)) / frames
        variance += linear.variances(changes)
    return variance.sqrt()


def _by_modes(templates: Templates, k: int, frame: LinearFrame, offset: Tensor) -> Tensor:
    """By what share every mode changes a source's light as its template sees it, per nm.

    The part of the image's change that looks like the image; the rest only adds information.
    """
    modes = torch.zeros(len(frame.rows) - frame.first_mode, dtype=torch.float64)
    if not len(modes):
        return modes  # The wavefront was not fitted.
    modes.requires_grad_()
    model, basis = templates.frames[k].model, templates.fit.basis
    assert basis is not None
    grid = PupilGrid.full(model.npix, model.diameter)
    image = templates.image(k, offset, basis.opd(modes * NANOMETRE, grid))
    seen = image.detach() * frame.weight.to(image.device) ** 2
    share = (seen * image).sum() / (seen * image.detach()).sum()
    return torch.autograd.grad(share, modes)[0]
