"""The linear model of a fit: the Jacobian of all unknowns and their posterior covariance.

Let G be the whitened Jacobian of all unknowns, P their prior precision, and r the whitened data
minus the prediction at the mean of the prior. The covariance of the data, marginalised over all
unknowns, is Sigma = 1 + G^T P^-1 G. By the Woodbury identity, products with Sigma^-1 need only the
Cholesky factor of P + G G^T. The flux of a template p and its error are

    flux = p . Sigma^-1 r / p . Sigma^-1 p,    error = 1 / sqrt(p . Sigma^-1 p).

This marginalisation is in section 2.7 of C. E. Rasmussen and C. K. I. Williams, "Gaussian Processes
for Machine Learning" (2006). Unknowns are rows of G, pixels are columns.

Frames of the same pixels of a detector share the error of its flat field. A pattern m_p with a
Gaussian prior of width g_p multiplies the star s_fp of every frame f in pixel p. The noise of one
pixel is therefore correlated between frames, with the covariance C = diag(1 / w_f^2) + g^2 s s^T.
Its inverse is diagonal but for one term (the Sherman-Morrison formula):

    C^-1 = W - W c c^T W,    c_f = s_f g / sqrt(1 + g^2 sum_f w_f^2 s_f^2),    W = diag(w_f^2).

Every inner product above therefore loses the product of two images that are summed over frames
with the weights W c. The frames' `common` is c.
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
from pyklip_diffrender.linear.frames import LinearFrame, Unknown, pixel_pieces, summed_rows

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
        G G^T over all frames (J C^-1 J^T where they share a pattern), float64.

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
    def shares_pattern(self) -> bool:
        """Whether the frames share a pattern of the detector."""
        return any(bool((frame.common != 0).any()) for frame in self.frames)

    @cached_property
    def _summed_rows(self) -> Tensor:
        """W c summed over frames with the derivative by every unknown, (unknowns, pixels)."""
        return summed_rows(self.frames, len(self.vector))

    def _whitened(self, images: Mapping[int, Tensor]) -> dict[int, Tensor]:
        """C^-1 x over w of images x by frame, (..., ny, nx), for all frames."""
        whitened = {k: self.frames[k].weight * image for k, image in images.items()}
        if self.shares_pattern:
            total = sum(self.frames[k].summed(image) for k, image in images.items())
            for k, frame in enumerate(self.frames):
                shared = frame.weight * frame.common * total
                whitened[k] = whitened[k] - shared if k in whitened else -shared
        return whitened

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

    def variances(self, combinations: Tensor) -> Tensor:
        """Posterior variances, (k,), of linear combinations of the unknowns, (unknowns, k)."""
        scaled = combinations * self._scale[:, None]
        return torch.linalg.solve_triangular(self._factor, scaled, upper=False).square_().sum(dim=0)

    @cached_property
    def step(self) -> Tensor:
        """Most probable unknowns of the linear model minus `vector`, (unknowns,).

        It is small after a fit that has converged. The unknowns themselves may be far from the
        means of the priors, so that single precision would not do for them.
        """
        gradient = -(self.vector - self.mean) / self.deviation**2
        for frame in self.frames:
            weighted = (frame.weight**2 * frame.residual).flatten()
            on_rows = frame.jacobian.flatten(1) @ weighted.float()
            gradient = gradient + frame.onto_unknowns(on_rows.double(), len(self.vector))
        if self.shares_pattern:
            total = torch.stack([frame.summed(frame.residual) for frame in self.frames]).sum(dim=0)
            gradient = gradient - self._summed_rows.double() @ total.flatten()
        scaled = torch.cholesky_solve((gradient * self._scale)[:, None], self._factor)[:, 0]
        return scaled * self._scale

    @cached_property
    def cleaned(self) -> tuple[Tensor, ...]:
        """Sigma^-1 r of every frame, (ny, nx): the whitened residual of the most probable model."""
        whitened = self._whitened(
            {k: frame.residual - frame.image(self.step) for k, frame in enumerate(self.frames)}
        )
        return tuple(whitened[k] for k in range(len(self.frames)))

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
        total = torch.zeros(len(self.vector), *count, dtype=torch.float64)
        for k, images in templates.items():
            frame = self.frames[k]
            weighted = (images * (frame.weight**2).to(images.dtype)).flatten(1)
            on_rows = frame.jacobian.flatten(1) @ weighted.T.to(frame.jacobian.dtype)
            total += frame.onto_unknowns(on_rows.double(), len(self.vector))
        if self.shares_pattern:
            summed = self._summed(templates)
            total -= (self._summed_rows @ summed.T.to(self._summed_rows.dtype)).double()
        return torch.linalg.solve_triangular(
            self._factor, total * self._scale[:, None], upper=False
        )

    def _summed(self, templates: Mapping[int, Tensor]) -> Tensor:
        """W c summed over frames with templates, (k, pixels)."""
        return sum(
            (self.frames[k].summed(images.double()).flatten(1) for k, images in templates.items()),
            start=torch.zeros(()),
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
            numerator, photon = torch.zeros_like(absorbed), torch.zeros_like(absorbed)
            for k, images in part.items():
                whitened = (images * self.frames[k].weight.to(images.dtype)).double()
                numerator += torch.tensordot(whitened, self.cleaned[k], dims=2)
                photon += (whitened**2).sum(dim=(1, 2))
            if self.shares_pattern:
                photon -= (self._summed(part) ** 2).sum(dim=1)
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
        return self._whitened(images)

    def normal_equations(self, templates: Mapping[int, Tensor]) -> tuple[Tensor, Tensor]:
        """Return p_i . Sigma^-1 p_j and p_i . Sigma^-1 r of templates that are fitted together."""
        projected = self.projected(templates)
        matrix = -projected.T @ projected
        vector = torch.zeros(len(matrix), dtype=torch.float64)
        for k, images in templates.items():
            whitened = (images.double() * self.frames[k].weight).flatten(1)
            matrix += whitened @ whitened.T
            vector += whitened @ self.cleaned[k].flatten()
        if self.shares_pattern:
            summed = self._summed(templates)
            matrix -= summed @ summed.T
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

    def _predictors(self, frame: LinearFrame) -> Tensor:
        """L^-1 G of a frame with P + G G^T = L L^T, (unknowns, pixels), float64."""
        basis = torch.empty(len(self.vector), frame.weight.numel(), dtype=torch.float64)
        weight, shared = frame.weight.flatten(), (frame.weight * frame.common).flatten()
        for pixels in pixel_pieces(basis.shape[1]):
            white = frame.jacobian.flatten(1)[:, pixels].double() * weight[pixels]
            whitened = frame.onto_unknowns(white, len(self.vector))
            if self.shares_pattern:
                whitened -= self._summed_rows[:, pixels] * shared[pixels]
            basis[:, pixels] = torch.linalg.solve_triangular(
                self._factor, whitened * self._scale[:, None], upper=False
            )
        return basis

    def left_out(self, size: int = 5, frame: int = 0) -> tuple[Tensor, Tensor]:
        """Residual of every patch of pixels, predicted from all pixels outside the patch.

        Parameters
        ----------
        size : int
            Side of a patch, pixels.
        frame : int

        Returns
        -------
        residual, deviation : Tensor, (ny, nx)
            Data minus the prediction of a fit without the patch, in the data's unit, and its
            standard deviation, noise and prediction included; NaN for masked pixels.
        """
        part = self.frames[frame]
        ny, nx = part.residual.shape
        precision = torch.ones(ny, nx, dtype=torch.float64)
        if self.shares_pattern:
            precision -= (part.weight * part.common) ** 2
        basis = self._predictors(part).reshape(-1, ny, nx)
        residual = torch.full((ny, nx), torch.nan, dtype=torch.float64)
        deviation = residual.clone()
        for y in range(0, ny, size):
            for x in range(0, nx, size):
                window = (slice(y, y + size), slice(x, x + size))
                counts = part.weight[window] > 0
                if not bool(counts.any()):
                    continue
                inside = basis[:, window[0], window[1]][:, counts]
                inverse = torch.diag(precision[window][counts]) - inside.T @ inside
                covariance = torch.linalg.inv(inverse)
                weight = part.weight[window][counts]
                prediction_error = covariance @ self.cleaned[frame][window][counts] / weight
                residual[window] = residual[window].masked_scatter(counts, prediction_error)
                deviation[window] = deviation[window].masked_scatter(
                    counts, covariance.diagonal().sqrt() / weight
                )
        return residual, deviation
