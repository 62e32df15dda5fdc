"""Errors of candidates' positions because the star is hidden behind the mask.

Positions are measured from the star. Where it is on the detector follows from its diffracted light,
together with the wavefront. With unknowns u of the star, and the offset o of a source,

    do = (B C^-1 B^T)^-1 B C^-1 dI/du du

is the error of the offset for an error du, where I is the image of the source and B has its
derivatives by flux, x and y, in all frames. The covariance of the offsets is that of the unknowns,
propagated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from pyklip_diffrender.detection.candidates import Candidates
from pyklip_diffrender.detection.groups import Group
from pyklip_diffrender.detection.relinearise import in_derivatives
from pyklip_diffrender.detection.templates import Templates
from pyklip_diffrender.linear import NANOMETRE, LinearModel, coarse_copy, downsample
from pyklip_diffrender.optics.grid import PupilGrid

__all__ = ["with_position_of_star"]

_STEP = 2e-3
"""arcsec between images whose difference is a derivative, in single precision."""


def with_position_of_star(
    groups: Sequence[Group], candidates: Candidates, place: Tensor | None = None
) -> Candidates:
    """Add the error of the star's position to the covariance of candidates' positions.

    The star's unknowns and the noise in the candidates' pixels are taken as independent. Errors of
    a companion whose light counts in the derivatives by the star's unknowns contain that of the
    star already, and do not change.

    Parameters
    ----------
    groups : sequence of (LinearModel, Templates)
    candidates : Candidates
    place : Tensor, (2,), optional
        x, y from the star, arcsec, at which displacements are computed for all candidates. Default
        their own positions, which must be on the frames.

    Returns
    -------
    Candidates
    """
    count = len(candidates)
    if not count:
        return candidates
    places = candidates.offsets if place is None else place[None]
    rates = [_rates(groups, each) for each in places]
    covariance = candidates.covariance.clone()
    for k, (_, templates) in enumerate(groups):
        changes = torch.stack([each[k] for each in rates], dim=2).expand(-1, -1, count)
        changes = torch.where(in_derivatives(templates, candidates.offsets), 0.0, changes)
        # A companion whose place is not known says nothing about that of the star.
        linear = templates.fit.linear
        of_star = torch.tensor([each.name != "companions" for each in linear.unknowns])
        combinations = torch.zeros(len(of_star), 2 * count, dtype=torch.float64)
        combinations[of_star] = changes.flatten(1)
        covariance[count:, count:] += linear.covariances(combinations)
    return replace(candidates, covariance=covariance)


def _rates(groups: Sequence[Group], offset: Tensor) -> list[Tensor]:
    """Change of a measured offset by the unknowns of each group, (unknowns, 2), in arcsec."""
    matrix = torch.zeros(3, 3, dtype=torch.float64)
    gradients = []
    for linear, templates in groups:
        gradient = torch.zeros(len(linear.vector), 3, dtype=torch.float64)
        for k in templates.frames:
            of_frame, by_row = _products(linear, templates, k, offset)
            matrix += of_frame
            gradient += linear.frames[k].onto_unknowns(by_row, len(gradient))
        gradients.append(gradient)
    return [torch.linalg.solve(matrix, gradient.T)[1:].T for gradient in gradients]


def _products(
    linear: LinearModel, templates: Templates, k: int, offset: Tensor
) -> tuple[Tensor, Tensor]:
    """B C^-1 B^T, (3, 3), of a source in one frame, and B C^-1 dI/du by row, (rows, 3)."""
    frame, fitted = linear.frames[k], templates.frames[k]
    model = coarse_copy(fitted.model)
    # Shifts hardly depend on the wavelength.
    model = model.at_wavelengths(model.bandpass.thinned(1)[1])
    opd = downsample(torch.from_numpy(fitted.opd.copy()), model.npix)
    grid = PupilGrid.full(model.npix, model.diameter)
    names = [linear.unknowns[unknown].name for unknown in frame.rows[: frame.first_mode].tolist()]

    def image(change: Tensor, moved: Tensor | float = 0.0) -> Tensor:
        values = fitted.optical_values
        values["star_offset"] = templates.place_of(k, offset + moved)
        for name in values.keys() & set(names):
            rows = [row for row, each in enumerate(names) if each == name]
            values[name] = values[name] + change[rows]
        modes = change[frame.first_mode :] * NANOMETRE
        wavefront = templates.fit.basis.opd(modes, grid) if len(modes) else 0.0
        return fitted.flux * model(opd + wavefront, **values).double()

    change = torch.zeros(len(frame.rows), dtype=torch.float64, requires_grad=True)
    source = image(change)
    with torch.no_grad():
        steps = _STEP * torch.eye(2, dtype=torch.float64)
        slopes = [(image(change, s) - image(change, -s)) / (2 * _STEP) for s in steps]
        columns = torch.stack([source.detach(), *slopes])
        weighted = columns * frame.weight.to(columns.device) ** 2
        matrix = torch.tensordot(weighted, columns, dims=[[1, 2], [1, 2]])
    # Products that do not depend on any row have derivatives as well.
    products = torch.tensordot(weighted, source, dims=2).cpu() + 0.0 * change.sum()
    by_row = [torch.autograd.grad(each, change, retain_graph=True)[0] for each in products]
    return matrix.cpu(), torch.stack(by_row, dim=1)
