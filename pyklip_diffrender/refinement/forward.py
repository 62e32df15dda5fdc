"""The forward model of a fit and its derivatives, at a point of the unknowns."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from pyklip_diffrender.linear.response import (
    NANOMETRE,
    Responses,
    WavefrontResponse,
    coarse_copy,
    downsample,
    parameter_jacobian,
)
from pyklip_diffrender.optics.grid import PupilGrid
from pyklip_diffrender.refinement.problem import Problem
from pyklip_diffrender.refinement.unknowns import Unknowns

__all__ = ["Forward", "Point"]


@dataclass(frozen=True)
class Point:
    """Unknowns and what they render.

    Attributes
    ----------
    unknowns : Unknowns
    vector : Tensor
    opd : Tensor, (npix, npix)
        m; complex where the pupil's amplitude is free.
    fields : list of Tensor
        The star's field at each wavelength, at flux 1.
    image : Tensor, (ny, nx)
        The star at flux 1.
    star : Tensor, (ny, nx)
        Star and background, in the data's unit.
    total : Tensor, (ny, nx)
        With the companions.
    """

    unknowns: Unknowns
    vector: Tensor
    opd: Tensor
    fields: list[Tensor]
    image: Tensor
    star: Tensor
    total: Tensor


class Forward:
    """Renders points, and linearises about them.

    Parameters
    ----------
    problem : Problem
    responses : Responses
        Of the model to the basis; shared by frames.
    """

    def __init__(self, problem: Problem, responses: Responses) -> None:
        self.problem, self.model = problem, problem.model
        self.basis, self.responses = responses.basis, responses
        self.coarse = coarse_copy(problem.model, responses.npix)
        self.grid = PupilGrid.full(problem.model.npix, problem.model.diameter)
        # None and not itself: a cycle would keep the responses until the collector comes by.
        self._given = Forward(problem.given, responses) if problem.given else None

    @property
    def exact(self) -> Forward:
        """By the model as given."""
        return self._given or self

    def opd(self, unknowns: Unknowns, vector: Tensor) -> Tensor:
        """The wavefront, (npix, npix), m; complex where the pupil's amplitude is free."""
        opd = self.problem.opd0
        coefficients = vector[unknowns.where("modes")]
        if bool((coefficients != 0).any()):
            change = self.basis.opd(coefficients * NANOMETRE, self.grid)
            opd = opd + change.to(self.model.device)
        amplitude = vector[unknowns.where("amplitude")]
        if not len(amplitude):
            return opd
        padded = torch.zeros(len(self.basis), dtype=torch.float64)
        padded[: len(amplitude)] = amplitude
        absorption = -self.basis.opd(padded * NANOMETRE, self.grid).to(self.model.device)
        return torch.complex(opd, absorption)

    def coarse_opd(self, point: Point) -> Tensor:
        """The wavefront on the coarse copy's grid."""
        return downsample(point.opd, self.coarse.npix)

    def at(self, unknowns: Unknowns, vector: Tensor) -> Point:
        """Render a point."""
        values, opd = unknowns.values(vector), self.opd(unknowns, vector)
        flux = unknowns.level("flux", vector)
        with torch.no_grad():
            fields = self.model.fields(opd, **values)
            image = self.model.image_of(fields, values).double()
        star = flux * image + unknowns.level("background", vector)
        total = star
        if unknowns.shows_companions and len(unknowns.companions):
            whole = opd if self.exact is self else self.exact.opd(unknowns, vector)
            for source in unknowns.sources(vector):
                there = self._towards(values, unknowns.turn @ source[1:])
                # Neither by a plan's model nor by the coarse copy: a percent of S/N 1000 is seen.
                with torch.no_grad():
                    total = total + flux * source[0] * self.exact.model(whole, **there).double()
        return Point(unknowns, vector, opd, fields, image, star, total)

    @staticmethod
    def _towards(values: dict[str, Tensor], offset: Tensor) -> dict[str, Tensor]:
        star = values.get("star_offset", torch.zeros(2, dtype=torch.float64))
        return {**values, "star_offset": star + offset.to(star.device)}

    def jacobian(self, point: Point, modes: int) -> Tensor:
        """Derivative of `total`, (unknowns, ny, nx), float64.

        Up to the first `modes` modes; with 0 only what comes before amplitude and wavefront.
        """
        unknowns, vector = point.unknowns, point.vector
        values, opd = unknowns.values(vector), self.coarse_opd(point)
        flux = unknowns.level("flux", vector)
        count = unknowns.where("companions").stop
        if modes:
            count = unknowns.where("modes").start + modes
        # One array, filled in place: it is the largest of the fit.
        rows = torch.empty(count, *point.image.shape, dtype=torch.float64, device=opd.device)
        response = self._response_at(point) if modes else None
        if unknowns.optical:
            slopes = (
                response.parameters(point.fields, values)
                if response is not None
                else parameter_jacobian(self.coarse, opd, values, unknowns.optical, point.fields)
            )
            rows[: len(slopes)] = flux * slopes
        if "flux" in unknowns.linear:
            rows[unknowns.where("flux")] = point.image
        if "background" in unknowns.linear:
            rows[unknowns.where("background")] = 1.0
        companions = unknowns.where("companions")
        if not unknowns.shows_companions:
            rows[companions] = 0.0
        for k, source in enumerate(unknowns.sources(vector) if unknowns.shows_companions else ()):
            there = self._towards(values, unknowns.turn @ source[1:])
            first = companions.start + 3 * k
            with torch.no_grad():
                rows[first] = flux * self.coarse(opd, **there)
            moved = parameter_jacobian(self.coarse, opd, there, ("star_offset",)).double()
            turned = torch.tensordot(unknowns.turn.T.to(moved.device), moved, dims=1)
            rows[first + 1 : first + 3] = flux * source[0] * turned
        if response is not None:
            amplitude = unknowns.where("amplitude")
            slopes = response.image(point.fields, values, unknowns.amplitude_modes, modes)
            rows[amplitude] = slopes[modes:]
            rows[amplitude.stop :] = slopes[:modes]
            rows[amplitude.start :] *= flux
        return rows

    def _response_at(self, point: Point) -> WavefrontResponse:
        """The field's response to the wavefront, from where the wavefront was much the same."""
        values = point.unknowns.values(point.vector)
        return self.responses.near(point.opd, values, point.unknowns.optical)
