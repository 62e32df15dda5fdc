"""Calibration errors of contrasts, from the star's flux and from the image of the source."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pyklip_diffrender.detection.candidates import Candidates
from pyklip_diffrender.detection.error_factor import ErrorFactor
from pyklip_diffrender.detection.groups import Group
from pyklip_diffrender.detection.relinearise import in_derivatives
from pyklip_diffrender.detection.templates import Templates
from pyklip_diffrender.linear.frames import LinearFrame
from pyklip_diffrender.linear.mode_fields import NANOMETRE
from pyklip_diffrender.optics.grid import PupilGrid
from pyklip_diffrender.refinement import star_flux_error

__all__ = ["calibration_errors", "candidate_errors"]

_CLEAR = 25.0
"""S/N above which the error of a source's own image matters."""


def candidate_errors(
    groups: Sequence[Group], candidates: Candidates, factor: ErrorFactor
) -> NDArray[np.float64]:
    """Relative calibration errors of candidates, (2, k), see `calibration_errors`."""
    factors = torch.from_numpy(factor.of(candidates.offsets))
    snr = torch.from_numpy(candidates.snr(factor))
    return calibration_errors(groups, candidates.offsets, snr, factors).numpy()


def calibration_errors(
    groups: Sequence[Group], offsets: Tensor, snr: Tensor, factors: Tensor
) -> Tensor:
    """Relative errors of contrasts because of the star's flux and of the source's image.

    A contrast is the flux of the source over that of the star. The source is measured with an
    image that depends on the wavefront, so errors of the wavefront and of the star's flux change
    the contrast in proportion. They do not change the significance of a source. Both come from
    the same posterior and may partly cancel. In real frames the posterior understates the error of
    the star's flux, see `star_flux_error`, which is added. Errors of a companion whose light counts
    in the derivatives by the star's unknowns contain the posterior's already; only this is added.

    Parameters
    ----------
    groups : sequence of (LinearModel, Templates)
    offsets : Tensor, (k, 2)
        x, y of the sources from the star, arcsec.
    snr : Tensor, (k,)
        S/N of the sources. Below 25 the image is taken as known, because noise dominates.
    factors : Tensor, (k,)
        By which errors of the posterior are multiplied.

    Returns
    -------
    Tensor, (2, k), float64
        Relative errors of the contrasts, and of the sources' own fluxes, which do not depend on the
        star's.
    """
    count = len(offsets)
    frames = sum(len(templates.frames) for _, templates in groups)
    variance = torch.zeros(2 * count, dtype=torch.float64)
    for linear, templates in groups:
        changes = torch.zeros(len(linear.vector), 2 * count, dtype=torch.float64)
        contained = in_derivatives(templates, offsets)
        for k, fitted in templates.frames.items():
            frame = linear.frames[k]
            on_rows = torch.zeros(len(frame.rows), 2 * count, dtype=torch.float64)
            for row, unknown in enumerate(frame.rows[: frame.first_mode].tolist()):
                if linear.unknowns[unknown].name == "flux":
                    on_rows[row, :count] = 1 / fitted.flux
            for j in torch.nonzero((snr > _CLEAR) & ~contained).flatten().tolist():
                by_modes = _by_modes(templates, k, frame, offsets[j])
                on_rows[frame.first_mode :, [j, count + j]] = by_modes[:, None]
            on_rows[:, contained.repeat(2)] = 0.0
            changes += frame.onto_unknowns(on_rows, len(linear.vector)) / frames
        variance += linear.variances(changes)
    errors = factors * variance.sqrt().reshape(2, count)
    untied = sum(star_flux_error(templates.fit) for _, templates in groups) / len(groups)
    return torch.stack([torch.hypot(errors[0], torch.full_like(errors[0], untied)), errors[1]])


def _by_modes(templates: Templates, k: int, frame: LinearFrame, offset: Tensor) -> Tensor:
    """Relative change, per nm of every mode, of the flux that a matched filter measures."""
    modes = torch.zeros(len(frame.rows) - frame.first_mode, dtype=torch.float64)
    if not len(modes):
        return modes  # The wavefront was not fitted.
    modes.requires_grad_()
    model, basis = templates.frames[k].model, templates.fit.basis
    grid = PupilGrid.full(model.npix, model.diameter)
    image = templates.image(k, offset, basis.opd(modes * NANOMETRE, grid))
    weighted = image.detach() * frame.weight.to(image.device) ** 2
    share = (weighted * image).sum() / (weighted * image.detach()).sum()
    return torch.autograd.grad(share, modes)[0]
