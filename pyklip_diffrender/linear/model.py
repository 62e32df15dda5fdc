"""The linear model of a fit: the Jacobian of all unknowns and their posterior covariance.

Let G be the whitened Jacobian of all unknowns, P their prior precision, and r the whitened data
minus the prediction at the mean of the prior. The covariance of the data, marginalised over all
unknowns, is Sigma = 1 + G^T P^-1 G. By the Woodbury identity, products with Sigma^-1 need only the
Cholesky factor of P + G G^T. The flux of a template p and its error are

    flux = p . Sigma^-1 r / p . Sigma^-1 p,    error = 1 / sqrt(p . Sigma^-1 p).

This marginalisation is in section 2.7 of C. E. Rasmussen and C. K. I. Williams, "Gaussian Processes
for Machine Learning" (2006). Unknowns are rows of G, pixels are columns.

Where pixels share errors of the model, their noise has a covariance C, see `Noise`. G G^T
then stands for J C^-1 J^T, with the derivatives J that are not whitened.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

_PIXELS_AT_A_TIME = 1024
"""Number of pixels that are processed at a time, in arrays with a number for every unknown."""


class Unknown(NamedTuple):
    """One unknown of a fit."""

    # A parameter of the parameter table, or "companions", "amplitude", "modes" or "drift".
    name: str
    component: int  # Index within that parameter.
    # Index of the frame, or of the block of drift; -1 for an unknown that all frames share.
    frame: int = -1

    def __str__(self) -> str:
        suffix = "" if self.frame < 0 else f" of frame {self.frame}"
        return f"{self.name}[{self.component}]{suffix}"


@dataclass(frozen=True)
class FrameRows:
    """Unknowns of a fit to which the rows of one frame belong."""

    # (rows,), int64, index of the unknown of each row; for a row without one, their number.
    rows: Tensor
    # (blocks, some), int64, indices of the unknowns by which the leading wavefront modes of this
    # frame differ from the shared modes. One block may belong to this frame alone, and another
    # block to all frames of an exposure sequence.
    drift: Tensor
    first_mode: int  # Index of the first wavefront mode among the rows.

    def onto_unknowns(self, on_rows: Tensor, size: int) -> Tensor:
        """Sum values by row, (rows, k), to values by unknown, (size, k)."""
        total = torch.zeros(size + 1, *on_rows.shape[1:], dtype=on_rows.dtype)
        total.index_add_(0, self.rows, on_rows)
        leading = on_rows[self.first_mode : self.first_mode + self.drift.shape[-1]]
        for block in self.drift:
            total.index_add_(0, block, leading)
        return total[:size]

    def of_unknowns(self, values: Tensor) -> Tensor:
        """Values by row from values by unknown; the adjoint of `onto_unknowns`."""
        rows = torch.cat([values, torch.zeros_like(values[:1])])[self.rows]
        for block in self.drift:
            rows[self.first_mode : self.first_mode + len(block)] += values[block]
        return rows


@dataclass(frozen=True)
class LinearFrame(FrameRows):
    """One frame's part of a linear model."""

    residual: Tensor  # (ny, nx), float64, data minus prediction where the model is linearised.
    weight: Tensor  # (ny, nx), float64, 1 / standard deviation; 0 for masked pixels.
    # (rows, ny, nx), float32, derivatives of the pixels by the unknowns, in the data's unit.
    jacobian: Tensor
    # (ny, nx), float64, c of the pattern that the frames share, see `Noise`, in the data's unit; 0
    # without a pattern.
    common: Tensor

    def image(self, values: Tensor) -> Tensor:
        """Change of the image, (..., ny, nx), for changes of the unknowns, (size, ...)."""
        on_rows = self.of_unknowns(values).movedim(0, -1)
        flat = self.jacobian.flatten(1)
        parts = [on_rows @ flat[:, piece].double() for piece in pixel_pieces(flat.shape[1])]
        return torch.cat(parts, dim=-1).unflatten(-1, self.jacobian.shape[1:])


def _times_images(rows: Tensor, images: Tensor) -> Tensor:
    """Products of float32 rows (n, pixels) and images (k, ny, nx): (n, k), of the images' type."""
    # The rounding errors of single precision exceed the noise where a companion's light is 1e5
    # standard deviations.
    columns = images.flatten(1).T
    if images.dtype == rows.dtype:
        return rows @ columns
    total = torch.zeros(len(rows), columns.shape[1], dtype=images.dtype)
    for piece in pixel_pieces(len(columns)):
        total += rows[:, piece].to(images.dtype) @ columns[piece]
    return total


def pixel_pieces(pixels: int) -> list[slice]:
    """Slices of the pixels of an image, for arrays with a number for every unknown."""
    starts = range(0, pixels, _PIXELS_AT_A_TIME)
    return [slice(start, min(start + _PIXELS_AT_A_TIME, pixels)) for start in starts]


# The covariance of the noise of frames that are fitted together, and its inverse.
#
# The noise of a frame f has two parts, with the starlight s_f and pixels p:
#
# 1. Noise of the frame and errors of the model that are independent from pixel to pixel. Its
#    standard deviation is 1 / w_f.
# 2. The error of the detector pattern, where frames show the same pixels of the detector. A
#    pattern m_p with a Gaussian prior of width g_p multiplies the starlight of every frame: g_p^2
#    s_fp s_f'p in pixel p.
#
# The covariance of one pixel in all frames is diag(1 / w_f^2) + g^2 s s^T. Its inverse is diagonal
# but for one term (the Sherman-Morrison formula),
#
#     C^-1 = W - W c c^T W,    c_f = s_f g / sqrt(1 + g^2 sum_f w_f^2 s_f^2),    W = diag(w_f^2),
#
# so that every inner product loses the product of two images that are summed over frames with the
# weights W c. A `Noise` has the c of the pattern. For images that are divided by their own noise,
# C^-1 = w M^-1 w with M^-1 = 1 - t t^T and t = w c.


@dataclass(frozen=True, eq=False)
class Noise:
    """Noise of the pixels of frames that are fitted together, with covariance C."""

    # By frame, w: (ny, nx), 1 / standard deviation of the independent noise; 0 for masked pixels.
    weight: tuple[Tensor, ...]
    # By frame, c of the pattern that the frames share: (ny, nx), in the data's unit; 0 without a
    # pattern.
    common: tuple[Tensor, ...]

    @cached_property
    def shares_pattern(self) -> bool:
        """Whether the frames share a pattern of the detector."""
        return any(bool((each != 0).any()) for each in self.common)

    @cached_property
    def _pattern_power(self) -> Tensor:
        """t^T t of every pixel, (ny, nx)."""
        products = [(w * c) ** 2 for w, c in zip(self.weight, self.common, strict=True)]
        return torch.stack(products).sum(dim=0)

    def summed(self, images: Mapping[int, Tensor]) -> Tensor:
        """Sum of W c x over frames, for images x, (..., ny, nx), of the type of x."""
        total = torch.zeros_like(next(iter(images.values())))
        for k, image in images.items():
            total += (self.weight[k] ** 2 * self.common[k]).to(image.dtype) * image
        return total

    def inverse(self, images: Mapping[int, Tensor]) -> dict[int, Tensor]:
        """C^-1 x over w of images x, (..., ny, nx), by frame; 0 in masked pixels.

        A missing frame has no light. Without correlations between frames, it is missing in the
        result as well.
        """
        if not self.shares_pattern:
            return {k: self.weight[k].to(x.dtype) * x for k, x in images.items()}
        images = {k: x.double() for k, x in images.items()}
        return self._less_pattern(images, self.summed(images))

    def _less_pattern(self, images: Mapping[int, Tensor], part: Tensor) -> dict[int, Tensor]:
        """Images less c times a part, (..., ny, nx), whitened, for all frames."""
        return {
            k: weight * (images.get(k, torch.zeros(())) - common * part)
            for k, (weight, common) in enumerate(zip(self.weight, self.common, strict=True))
        }

    def weighted(self, images: Mapping[int, Tensor]) -> dict[int, Tensor]:
        """C^-1 x of images x, as `inverse`."""
        return {k: self.weight[k].to(x.dtype) * x for k, x in self.inverse(images).items()}

    def whitened(self, images: Mapping[int, Tensor]) -> Tensor:
        """Images in units in which their noise is independent and has a variance of 1.

        Scalar products of the results, (k, pixels of frames), are x^T C^-1 y of the images x and y,
        (k, ny, nx) by frame.
        """
        if not self.shares_pattern:
            white = self.inverse(images)
        else:
            # (1 - a t t^T)^2 = 1 - t t^T = M^-1 with a = 1 / (1 + sqrt(1 - t^T t)).
            summed = self.summed({k: x.double() for k, x in images.items()})
            part = summed / (1 + torch.sqrt(1 - self._pattern_power))
            white = self._less_pattern(images, part)
        return torch.cat([each.flatten(1) for each in white.values()], dim=1)

    def at_pixels(self, pixels: Tensor) -> Noise:
        """Noise of some pixels, indices (k,) into the flattened image, with arrays (k,)."""
        return Noise(
            tuple(each.flatten()[pixels] for each in self.weight),
            tuple(each.flatten()[pixels] for each in self.common),
        )

    def power(self, images: Mapping[int, Tensor]) -> Tensor:
        """x^T C^-1 x of images x, (k, ny, nx) by frame: (k,), float64."""
        images = {k: x.double() for k, x in images.items()}
        total = sum((self.weight[k] * x).square().sum(dim=(1, 2)) for k, x in images.items())
        if self.shares_pattern:
            total = total - self.summed(images).square().sum(dim=(1, 2))
        return torch.as_tensor(total)

    def chi2(self, images: Sequence[Tensor]) -> float:
        """x^T C^-1 x of images x, (ny, nx), of all frames."""
        return float(self.power({k: x[None] for k, x in enumerate(images)}))


def summed_rows(frames: Sequence[LinearFrame], unknowns: int) -> Iterator[Tensor]:
    """Sums of W c over frames with the derivatives by every unknown, float32.

    There is one array, (unknowns, some pixels), for each piece of the image, because an array of
    all pixels takes as much memory as the Jacobians of all frames.
    """
    scales = [(f.weight**2 * f.common).float().expand(f.weight.shape).flatten() for f in frames]
    for pixels in pixel_pieces(frames[0].weight.numel()):
        total = torch.zeros(unknowns, pixels.stop - pixels.start, dtype=torch.float32)
        for frame, scale in zip(frames, scales, strict=True):
            on_rows = frame.jacobian.flatten(1)[:, pixels] * scale[pixels]
            total += frame.onto_unknowns(on_rows, unknowns)
        yield total


_TEMPLATES_AT_A_TIME = 512
"""Number of templates that are processed at a time."""


class TemplateProducts(NamedTuple):
    """Inner products of templates p with the data r, (k,) each, marginalised over all unknowns.

    The amplitude is numerator / information, with a standard deviation of 1 / sqrt(information),
    or 1 / sqrt(photon) if all unknowns were known.
    """

    numerator: Tensor  # p . Sigma^-1 r, with the marginalised covariance Sigma of the data.
    information: Tensor  # p . Sigma^-1 p.
    photon: Tensor  # p . C^-1 p, the information if all parameters of the star were known.


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
    >>> opd = dr.wavefront.random_opd(1, npix=128)
    >>> frame = dr.simulate(model, dr.Scene(), opd, seed=3)
    >>> fit = dr.refine(model, frame, opd, settings=dr.FitSettings(cycles=6))
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
        # Cached properties can be computed again, and are larger than the fields.
        return {each.name: getattr(self, each.name) for each in fields(self)}

    @cached_property
    def noise(self) -> Noise:
        """Covariance of the noise of all frames."""
        return Noise(
            tuple(frame.weight for frame in self.frames),
            tuple(frame.common for frame in self.frames),
        )

    def names_before_modes(self, k: int) -> list[str]:
        """Names of the unknowns of frame `k` by row, before its modes; "" for a row without one."""
        names = [*(unknown.name for unknown in self.unknowns), ""]
        frame = self.frames[k]
        return [names[row] for row in frame.rows[: frame.first_mode].tolist()]

    @cached_property
    def _scale(self) -> Tensor:
        """Units of the unknowns in which the curvature's diagonal is of order 1."""
        precision = self.curvature.diagonal() + self.deviation**-2.0
        return precision.clamp(min=1e-300) ** -0.5

    @cached_property
    def _factor(self) -> Tensor:
        """Lower Cholesky factor of P + G G^T, in scaled units."""
        # Unknowns differ by many powers of ten. In the units U, U (P + G G^T) U is factored, whose
        # diagonal is 1.
        system = (self.curvature * self._scale[:, None]).mul_(self._scale)
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

        The step is small after a fit that has converged. The unknowns themselves may be far from
        the means of the priors, where single precision would not be enough.
        """
        # The minimum of (r - J^T s) C^-1 (r - J^T s) + sum P (x0 + s - mean)^2 is where
        #
        #     (P + J C^-1 J^T) s = J C^-1 r - P (x0 - mean).
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

    @cached_property
    def _pattern_rows(self) -> Tensor:
        """R of the shared pattern, see `_pulled`, (unknowns, pixels), float32."""
        # Filled piece by piece: to concatenate the pieces takes twice the memory.
        count, pixels = len(self.vector), self.frames[0].weight.numel()
        rows = torch.empty(count, pixels, dtype=torch.float32)
        for piece, part in zip(pixel_pieces(pixels), summed_rows(self.frames, count), strict=True):
            rows[:, piece] = part
        return rows

    def _pulled(self, images: Mapping[int, Tensor]) -> Tensor:
        """J C^-1 x of images x, (k, ny, nx) by frame, (unknowns, k), float64."""
        # With C^-1 = W - W c c^T W and R = sum_f J_f W_f c_f over all frames,
        #
        #     J C^-1 x = sum_f J_f W_f x_f - R sum_f W_f c_f x_f,
        #
        # where only frames with light count in the sums over x.
        size = len(self.vector)
        total = torch.zeros(size, len(next(iter(images.values()))), dtype=torch.float64)
        for k, image in images.items():
            frame = self.frames[k]
            weighted = frame.weight.square().to(image.dtype) * image
            pulled = _times_images(frame.jacobian.flatten(1), weighted)
            total += frame.onto_unknowns(pulled.double(), size)
        if self.noise.shares_pattern:
            total -= _times_images(self._pattern_rows, self.noise.summed(images)).double()
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
        return self._solved(self._pulled(templates))

    def weigh(self, templates: Mapping[int, Tensor]) -> TemplateProducts:
        """Compute amplitudes of templates, one at a time, marginalised over all unknowns.

        Parameters
        ----------
        templates : mapping of int to Tensor, (k, ny, nx)
            Templates by frame, in units of the data.

        Returns
        -------
        TemplateProducts
            The amplitude is numerator / information, with a standard deviation of
            1 / sqrt(information), or 1 / sqrt(photon) if all unknowns were known.
        """
        # By the Woodbury identity p . Sigma^-1 p = p . C^-1 p - |L^-1 G p|^2. The last term is the
        # part of the template that the unknowns of the star absorb.
        absorbed = (self.projected(templates) ** 2).sum(dim=0)
        numerator = torch.zeros_like(absorbed)
        for k, images in templates.items():
            weighted = (images * self.frames[k].weight.to(images.dtype)).double()
            numerator += torch.tensordot(weighted, self.cleaned[k], dims=2)
        photon = self.noise.power(templates)
        return TemplateProducts(numerator, photon - absorbed, photon)

    def weigh_pixels(self, k: int, places: Tensor) -> TemplateProducts:
        """Amplitudes of light in single pixels of frame k, `places` (n, 2) as y, x; see `weigh`."""
        # A product of the Jacobian with an image of a single pixel is a column of the Jacobian, and
        # is not computed as a product, which takes much longer.
        parts = []
        pixels = places @ torch.tensor([self.frames[k].weight.shape[1], 1])
        for some in pixels.split(_TEMPLATES_AT_A_TIME):
            noise, frame = self.noise.at_pixels(some), self.frames[k]
            light = {k: torch.ones(len(some), dtype=torch.float64)}
            weighted = noise.weighted(light)
            # As in `_pulled`.
            columns = frame.jacobian.flatten(1)[:, some].double().mul_(noise.weight[k].square())
            pulled = frame.onto_unknowns(columns, len(self.vector))
            if self.noise.shares_pattern:
                pulled -= self._pattern_rows[:, some].double().mul_(noise.summed(light))
            absorbed = self._solved(pulled).square_().sum(dim=0)
            numerator = noise.weight[k] * self.cleaned[k].flatten()[some]
            parts.append(TemplateProducts(numerator, weighted[k] - absorbed, weighted[k]))
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

        The result is the part of the templates that the unknowns cannot reproduce.
        """
        # Sigma^-1 p = C^-1 (p - J^T s), with the change s of the most probable unknowns by p.
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
        # As in `weigh`, with all products of two templates.
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
        """Return a model without some unknowns, whose light is added to the data.

        Parameters
        ----------
        name : str
            Name of the unknowns.
        light : mapping of int to array, (ny, nx)
            Image of these unknowns by frame, in the data's unit.
        """
        keeps = torch.tensor([unknown.name != name for unknown in self.unknowns])
        # `place` is the new index of every unknown that stays. The Jacobians, the largest arrays,
        # are shared: rows of the other unknowns are left without an unknown.
        none = int(keeps.sum())
        stays = torch.where(keeps, torch.cumsum(keeps, 0) - 1, none)
        place = torch.cat([stays, torch.tensor([none])])
        frames = []
        for k, frame in enumerate(self.frames):
            counts = frame.weight > 0
            companions = torch.as_tensor(light.get(k, 0.0), dtype=torch.float64)
            frames.append(
                replace(
                    frame,
                    residual=torch.where(counts, frame.residual + companions, 0.0),
                    rows=place[frame.rows],
                    drift=place[frame.drift],
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
