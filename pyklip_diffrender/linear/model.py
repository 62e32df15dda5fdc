"""The linear model of a fit: the Jacobian of all unknowns and their posterior covariance.

Let G be the whitened Jacobian of all unknowns, P their prior precision, and r the whitened data
minus the prediction at the mean of the prior. The covariance of the data, marginalised over all
unknowns, is Sigma = 1 + G^T P^-1 G. By the Woodbury identity, products with Sigma^-1 need only the
Cholesky factor of P + G G^T. The flux of a template p and its error are

    flux = p . Sigma^-1 r / p . Sigma^-1 p,    error = 1 / sqrt(p . Sigma^-1 p).

This marginalisation is in section 2.7 of C. E. Rasmussen and C. K. I. Williams, "Gaussian Processes
for Machine Learning" (2006). Unknowns are rows of G, pixels are columns.

Where pixels share errors of the model, their noise has a covariance C, see `linear.noise`. G G^T
then stands for J C^-1 J^T, with the derivatives J that are not whitened.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pyklip_diffrender.errors import ShapeError
from pyklip_diffrender.linear.frames import LinearFrame, Unknown
from pyklip_diffrender.linear.noise import Noise

__all__ = ["LinearModel", "TemplateProducts"]

_BATCH = 512
"""Number of templates that are processed at a time."""


class TemplateProducts(NamedTuple):
    """Inner products of templates p with the data r, (k,) each.

    Sigma is the covariance of the data, marginalised over all unknowns.

    Attributes
    ----------
    numerator : Tensor
        p . Sigma^-1 r.
    information : Tensor
        p . Sigma^-1 p.
    photon : Tensor
        p . C^-1 p, the information if all parameters of the star were known.
    """

    numerator: Tensor
    information: Tensor
    photon: Tensor


@dataclass(frozen=True)
class LinearModel:
    """Data = prediction + Jacobian (x - vector) + noise, with Gaussian priors on x.

    Attributes
    ----------
    unknowns : tuple of Unknown
    frames : tuple of LinearFrame
    vector : Tensor, (unknowns,)
        Values of the unknowns about which the model is linearised.
    mean, deviation : Tensor, (unknowns,)
        Mean and standard deviation of the priors; inf for no prior.
    curvature : Tensor, (unknowns, unknowns)
        J C^-1 J^T over all frames, float64.

    Examples
    --------
    >>> import pyklip_diffrender as dr
    >>> model = dr.nircam_coronagraph("F444W", monochromatic=4.5e-6, npix=128, fov_pixels=32)
    >>> opd = dr.random_opd(1, npix=128)
    >>> frame = dr.simulate(model, dr.Scene(), opd, seed=3)
    >>> fit = dr.refine(model, frame, opd, settings=dr.GaussNewton(cycles=6))
    >>> fit.linear
    <LinearModel: 173 unknowns, 1 x 32 x 32 pixels>
    >>> fit.linear.covariance.shape
    torch.Size([173, 173])
    """

    unknowns: tuple[Unknown, ...]
    frames: tuple[LinearFrame, ...]
    vector: Tensor
    mean: Tensor
    deviation: Tensor
    curvature: Tensor

    def __repr__(self) -> str:
        ny, nx = self.frames[0].residual.shape
        return (
            f"<LinearModel: {len(self.unknowns)} unknowns, {len(self.frames)} x {ny} x {nx} pixels>"
        )

    def __getstate__(self) -> dict[str, Any]:
        # Without what is cached, which can be computed again and is larger than the rest.
        return {each.name: getattr(self, each.name) for each in fields(self)}

    @cached_property
    def noise(self) -> Noise:
        """Covariance of the noise of all frames."""
        return Noise(
            tuple(frame.weight for frame in self.frames),
            tuple(frame.common for frame in self.frames),
        )

    @cached_property
    def _scale(self) -> Tensor:
        """Units of the unknowns in which the curvature's diagonal is of order 1."""
        precision = self.curvature.diagonal() + self.deviation**-2.0
        return precision.clamp(min=1e-300) ** -0.5

    @cached_property
    def _factor(self) -> Tensor:
        """Lower Cholesky factor of P + G G^T, in scaled units."""
        system = self.curvature * self._scale[:, None] * self._scale
        system.diagonal().add_((self._scale / self.deviation) ** 2)
        return torch.linalg.cholesky(system)

    @property
    def covariance(self) -> Tensor:
        """Posterior covariance of all unknowns, (unknowns, unknowns)."""
        return torch.cholesky_inverse(self._factor) * self._scale[:, None] * self._scale

    def covariances(self, combinations: Tensor) -> Tensor:
        """Posterior covariance, (k, k), of linear combinations of the unknowns, (unknowns, k)."""
        solved = self._solved(combinations)
        return solved.T @ solved

    def variances(self, combinations: Tensor) -> Tensor:
        """Posterior variances, (k,), of linear combinations of the unknowns, (unknowns, k)."""
        return self._solved(combinations).square_().sum(dim=0)

    def _solved(self, combinations: Tensor) -> Tensor:
        """L^-1 of combinations of the unknowns, (unknowns, k)."""
        scaled = combinations * self._scale[:, None]
        return torch.linalg.solve_triangular(self._factor, scaled, upper=False)

    @cached_property
    def step(self) -> Tensor:
        """Most probable unknowns of the linear model minus `vector`, (unknowns,).

        It is small after a fit that has converged. The unknowns themselves may be far from the
        means of the priors, so that single precision would not do for them.
        """
        residuals = {k: frame.residual[None] for k, frame in enumerate(self.frames)}
        gradient = self._pulled(residuals)[:, 0] - (self.vector - self.mean) / self.deviation**2
        scaled = torch.cholesky_solve((gradient * self._scale)[:, None], self._factor)[:, 0]
        return scaled * self._scale

    @cached_property
    def cleaned(self) -> tuple[Tensor, ...]:
        """Sigma^-1 r of every frame, (ny, nx): the whitened residual of the most probable model."""
        whitened = self.noise.inverse(
            {k: frame.residual - frame.image(self.step) for k, frame in enumerate(self.frames)}
        )
        return tuple(whitened[k] for k in range(len(self.frames)))

    def _pulled(self, images: Mapping[int, Tensor]) -> Tensor:
        """J C^-1 x of images x, (k, ny, nx) by frame, (unknowns, k), float64."""
        size = len(self.vector)
        total = torch.zeros(size, len(next(iter(images.values()))), dtype=torch.float64)
        for k, weighted in self.noise.weighted(images).items():
            frame = self.frames[k]
            total += frame.onto_unknowns(frame.pulled(weighted).double(), size)
        return total

    def projected(self, templates: Mapping[int, Tensor]) -> Tensor:
        """Projection L^-1 G p of templates onto the unknowns, with P + G G^T = L L^T.

        Parameters
        ----------
        templates : mapping of int to Tensor, (k, ny, nx)
            Templates by frame, in units of the data (not whitened).

        Returns
        -------
        Tensor, (unknowns, k), float64
        """
        count = {len(t) for t in templates.values()}
        if len(count) != 1:
            raise ShapeError(f"templates: got {sorted(count)} of them, expected one number")
        return torch.linalg.solve_triangular(
            self._factor, self._pulled(templates) * self._scale[:, None], upper=False
        )

    def weigh(self, templates: Mapping[int, Tensor]) -> TemplateProducts:
        """Compute amplitudes of templates, one at a time, marginalised over all unknowns.

        Parameters
        ----------
        templates : mapping of int to Tensor, (k, ny, nx)
            Templates by frame, in units of the data.

        Returns
        -------
        TemplateProducts
            The amplitude is numerator / information, its standard deviation
            1 / sqrt(information), or 1 / sqrt(photon) if all unknowns were known.
        """
        parts = []
        total = len(next(iter(templates.values())))
        for start in range(0, total, _BATCH):
            part = {k: images[start : start + _BATCH] for k, images in templates.items()}
            absorbed = (self.projected(part) ** 2).sum(dim=0)
            numerator = torch.zeros_like(absorbed)
            for k, images in part.items():
                weighted = (images * self.frames[k].weight.to(images.dtype)).double()
                numerator += torch.tensordot(weighted, self.cleaned[k], dims=2)
            photon = (self.noise.whitened(part).double() ** 2).sum(dim=1)
            parts.append(TemplateProducts(numerator, photon - absorbed, photon))
        return TemplateProducts(*(torch.cat(column) for column in zip(*parts, strict=True)))

    def response(self, templates: Mapping[int, Tensor]) -> Tensor:
        """Change of the most probable unknowns when templates (k, ny, nx) are added to the data.

        Returns
        -------
        Tensor, (unknowns, k), float64
        """
        solved = torch.linalg.solve_triangular(
            self._factor.T, self.projected(templates), upper=True
        )
        return solved * self._scale[:, None]

    def clean(self, templates: Mapping[int, Tensor]) -> dict[int, Tensor]:
        """Sigma^-1 p of templates (k, ny, nx) by frame, whitened, for every frame of the model.

        This is the part of the templates that the unknowns cannot reproduce.
        """
        change = self.response(templates)
        images = {}
        for k, frame in enumerate(self.frames):
            images[k] = -frame.image(change)
            if k in templates:
                images[k] += templates[k].double()
        return self.noise.inverse(images)

    def normal_equations(self, templates: Mapping[int, Tensor]) -> tuple[Tensor, Tensor]:
        """Return p_i . Sigma^-1 p_j and p_i . Sigma^-1 r of templates that are fitted together."""
        projected = self.projected(templates)
        white = self.noise.whitened(templates).double()
        matrix = white @ white.T - projected.T @ projected
        vector = torch.zeros(len(matrix), dtype=torch.float64)
        for k, images in templates.items():
            weighted = (images.double() * self.frames[k].weight).flatten(1)
            vector += weighted @ self.cleaned[k].flatten()
        return matrix, vector

    def without(
        self, name: str, light: Mapping[int, Tensor | NDArray[np.float64] | float]
    ) -> LinearModel:
        """Remove unknowns from the model and add their light to the data.

        Parameters
        ----------
        name : str
            Name of the unknowns.
        light : mapping of int to array, (ny, nx)
            Image of those unknowns by frame, in the data's unit.
        """
        keeps = torch.tensor([unknown.name != name for unknown in self.unknowns])
        place = torch.cumsum(keeps, 0) - 1
        frames = []
        for k, frame in enumerate(self.frames):
            rows = keeps[frame.rows]
            counts = frame.weight > 0
            companions = torch.as_tensor(light.get(k, 0.0), dtype=torch.float64)
            frames.append(
                replace(
                    frame,
                    residual=torch.where(counts, frame.residual + companions, 0.0),
                    jacobian=frame.jacobian[rows],
                    rows=place[frame.rows[rows]],
                    drift=place[frame.drift],
                    first_mode=frame.first_mode - int((~rows[: frame.first_mode]).sum()),
                )
            )
        remaining = torch.nonzero(keeps).flatten()
        return LinearModel(
            tuple(self.unknowns[k] for k in remaining.tolist()),
            tuple(frames),
            self.vector[remaining],
            self.mean[remaining],
            self.deviation[remaining],
            self.curvature[remaining][:, remaining],
        )
