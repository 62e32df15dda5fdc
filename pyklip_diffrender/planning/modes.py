"""What the star would show of every spatial frequency of the wavefront, from a sample of modes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from pyklip_diffrender.linear.response import WavefrontResponse, downsample
from pyklip_diffrender.optics.grid import PupilGrid
from pyklip_diffrender.optics.system import OpticalSystem
from pyklip_diffrender.planning.absorb import Absorber
from pyklip_diffrender.planning.target import Target
from pyklip_diffrender.wavefront.bases import Basis, default_basis
from pyklip_diffrender.wavefront.priors import WavefrontPrior

__all__ = ["Modes", "SampledModes", "ring_edges"]

_PER_RING = 8
"""Modes that stand for all of a ring of frequencies."""

_RING = 2.0
"""Width of a ring, cycles across the pupil."""

_LEAST = 0.3
"""The prior is not narrowed more than to this, however well the star fits the data."""

_SURE = 3.0
"""Standard deviations of chi2 that are added to it."""


class SampledModes:
    """Some modes of a basis, as a basis."""

    def __init__(self, basis: Basis, indices: Tensor) -> None:
        self.basis, self.indices = basis, indices
        self.groups = basis.groups
        self.group_index = basis.group_index[indices]
        self.frequencies = basis.frequencies[indices]

    def __len__(self) -> int:
        return len(self.indices)

    def modes(self, grid: PupilGrid, start: int, stop: int) -> Tensor:
        """See `bases.Basis`."""
        picked = self.indices[start:stop].tolist()
        return torch.cat([self.basis.modes(grid, k, k + 1) for k in picked])

    def opd(self, coefficients: Tensor, grid: PupilGrid) -> Tensor:
        """See `bases.Basis`."""
        every = torch.zeros(len(self.basis), dtype=coefficients.dtype)
        every[self.indices] = coefficients
        return self.basis.opd(every, grid)


def ring_edges(cycles: float) -> list[float]:
    """Upper edges of the rings of frequencies, the last one `cycles`."""
    count = max(1, math.ceil(cycles / _RING))
    return [min(_RING * (k + 1), cycles) for k in range(count)]


class Modes:
    """The star's expected change, ring by ring.

    Parameters
    ----------
    model : OpticalSystem
    target : Target
    basis : Basis
        All modes.
    prior : WavefrontPrior
        How far the wavefront may have moved.
    opd : Tensor, (npix, npix)
        Where it is thought to be, m.
    values : dict of Tensor
        The model's other parameters.
    fields : list of Tensor
        Of the star there, at each wavelength.
    cycles : float
        Highest frequency of the basis.
    npix : int
        Pupil samples of the copy that gives derivatives.
    seed : int
        Of the sample.
    aligned : mapping of str to float
        Parameters whose misfit is not to be taken for the wavefront's, with steps for their
        derivatives.
    """

    def __init__(
        self,
        model: OpticalSystem,
        target: Target,
        basis: Basis,
        prior: WavefrontPrior,
        opd: Tensor,
        values: dict[str, Tensor],
        fields: list[Tensor],
        *,
        cycles: float,
        npix: int,
        seed: int,
        aligned: Mapping[str, float] | None = None,
    ) -> None:
        self.model, self.target, self.basis = model, target, basis
        self.opd, self.values, self.npix = opd, values, npix
        self.edges = [0.0, *ring_edges(cycles)]
        self.deviation = _deviation(basis, prior)
        ring = torch.bucketize(basis.frequencies, torch.tensor(self.edges, dtype=torch.float64))
        generator = torch.Generator().manual_seed(seed)
        sample, ahead = [], []
        for k in range(len(self.edges)):
            members = torch.nonzero(ring == k).flatten()
            order = members[torch.randperm(len(members), generator=generator)]
            sample.append(order[:_PER_RING])
            ahead.append(order[_PER_RING : 2 * _PER_RING])
        self._counts = torch.tensor([int((ring == k).sum()) for k in range(len(self.edges))])
        self._sample, self._others = sample, torch.cat(ahead)
        self._fields = fields
        response = self._response(torch.cat(sample), npix)
        slopes = target.in_sigma(response.image(self._fields, values).double())
        self.variance = self._variance(response, slopes)
        """Expected square of the star's change in every ring, in sigma^2, (rings, ny, nx)."""
        self.scale = self._scale(response.coarse, aligned or {})
        """By how much the star differs from the data, relative to what the prior expects."""
        self.variance *= self.scale**2
        self.deviation = self.deviation * self.scale
        self._slopes = slopes * self.deviation[torch.cat(sample)][:, None, None].to(slopes.device)
        self._absorber: Absorber | None = None

    def _response(self, indices: Tensor, npix: int) -> WavefrontResponse:
        picked = SampledModes(self.basis, indices)
        return WavefrontResponse(self.model, picked, self.opd, self.values, npix=npix)

    def _variance(self, response: WavefrontResponse, slopes: Tensor) -> Tensor:
        # What a mode adds where the star is dark is of second order: the square of its field.
        squares = sum(
            weight * (field.real**2 + field.imag**2)
            for field, weight in zip(response.fields, self.model.bandpass.weights, strict=True)
        )
        assert isinstance(squares, Tensor)
        light = self.target.in_sigma(response.coarse.detector.image(squares, self.values).double())
        total, first = [], 0
        for picked, count in zip(self._sample, self._counts.tolist(), strict=True):
            rows = slice(first, first + len(picked))
            first += len(picked)
            if not len(picked):
                total.append(torch.zeros_like(self.target.image))
                continue
            power = (self.deviation[picked] ** 2)[:, None, None].to(slopes.device)
            linear = count * (power * slopes[rows] ** 2).mean(dim=0)
            mean = count * (power * light[rows]).mean(dim=0)
            total.append(linear + 2 * mean**2)
        return torch.stack(total)

    def _alignment(self, coarse: OpticalSystem, steps: Mapping[str, float]) -> list[Tensor]:
        """Change of the image with each component of some parameters, by differences."""
        opd = downsample(self.opd, coarse.npix)
        there = coarse.fields(opd, **self.values)
        weights, rows = self.model.bandpass.weights, []
        for name, step in steps.items():
            for k in range(self.values[name].shape[-1]):
                moved = self.values[name].clone()
                moved[k] += step
                total = torch.zeros((), dtype=torch.float64, device=opd.device)
                # Of the field, which is as good on a coarse pupil; the star itself is not.
                for field, near, far, weight in zip(
                    self._fields,
                    there,
                    coarse.fields(opd, **{**self.values, name: moved}),
                    weights,
                    strict=True,
                ):
                    total = total + 2 * weight / step * (field.conj() * (far - near)).real
                rows.append(self.model.detector.image(total, self.values))
        return rows

    def _scale(self, coarse: OpticalSystem, steps: Mapping[str, float]) -> float:
        target = self.target
        if target.residual is None:
            return 1.0
        valid = target.valid
        with torch.no_grad():
            rows = self._alignment(coarse, steps)
        design = [target.in_sigma(row)[valid] for row in [*rows, target.image]]
        design.append(1 / target.sigma[valid])
        matrix = torch.stack(design, dim=1)
        matrix = matrix / torch.linalg.vector_norm(matrix, dim=0).clamp(min=1e-300)
        residual = (target.residual / target.sigma)[valid]
        solution = torch.linalg.lstsq(matrix, residual[:, None]).solution
        left = residual - (matrix @ solution)[:, 0]
        # As much as the noise leaves possible: what is small may be so by chance.
        excess = float(left.square().mean()) - 1.0 + _SURE * math.sqrt(2 / len(left))
        expected = float(self.variance.sum(dim=0)[valid].mean())
        return max(_LEAST, math.sqrt(max(excess, 0.0) / max(expected, 1e-300)))

    def beyond(self, cycles: float) -> Tensor:
        """Expected change by the modes above a frequency, in sigma, (ny, nx)."""
        kept = [upper > cycles for upper in self.edges]
        return self.variance[torch.tensor(kept)].sum(dim=0).sqrt()

    def upto(self, cycles: float) -> Tensor:
        """Expected change by the modes up to a frequency, in sigma, (ny, nx)."""
        kept = [upper <= cycles for upper in self.edges]
        return self.variance[torch.tensor(kept)].sum(dim=0).sqrt()

    def prepare_fit(self, cycles: float) -> None:
        """Compute the response of all modes up to a frequency, so that `left` can be asked."""
        basis = default_basis(cycles)
        response = WavefrontResponse(self.model, basis, self.opd, self.values, npix=self.npix)
        slopes = self.target.in_sigma(response.image(self._fields, self.values).double())
        prior = self.deviation[: len(basis)].to(slopes.device)
        self._absorber = Absorber(slopes * prior[:, None, None])

    def left(self, whitened: Tensor, cycles: float) -> Tensor:
        """What a fit of the modes up to a frequency leaves of an error, in units of the noise.

        Everything, where that fit was not prepared.

        Parameters
        ----------
        whitened : Tensor, (..., ny, nx)
        cycles : float
        """
        modes = int((self.basis.frequencies <= cycles).sum())
        if self._absorber is None or modes > len(self._absorber):
            return whitened
        return self._absorber.left(whitened, modes)

    def beyond_after_fit(self, cycles: float) -> Tensor:
        """As `beyond`, less what a fit of the other modes makes up for."""
        total, first = torch.zeros_like(self.target.image), 0
        for upper, picked, count in zip(
            self.edges, self._sample, self._counts.tolist(), strict=True
        ):
            rows = self._slopes[first : first + len(picked)]
            first += len(picked)
            if upper > cycles and len(picked):
                total += count * self.left(rows, cycles).square().mean(dim=0)
        return total.sqrt()

    def draw(self, seed: int) -> Tensor:
        """Coefficients of a wavefront change, (modes,), nm."""
        generator = torch.Generator().manual_seed(seed)
        unit = torch.randn(len(self.deviation), generator=generator, dtype=torch.float64)
        return self.deviation * unit

    def response_error(self, npix: int, *, others: bool = False) -> float:
        """Relative error of the derivatives from a coarser pupil, rms over pixels and modes.

        Parameters
        ----------
        npix : int
        others : bool
            Of modes that were not looked at so far.
        """
        indices = self._others if others else torch.cat(self._sample)
        fine, coarse = (
            self.target.in_sigma(
                self._response(indices, n).image(self._fields, self.values).double()
            )
            * self.deviation[indices][:, None, None].to(self.target.image.device)
            for n in (self.npix, npix)
        )
        return float((coarse - fine).norm() / fine.norm().clamp(min=1e-300))


def _deviation(basis: Basis, prior: WavefrontPrior) -> Tensor:
    scales: Sequence[float] = [prior.scales[name] for name in basis.groups]
    return torch.tensor(scales, dtype=torch.float64)[basis.group_index] * prior.shape(basis)
