"""Chi-squared of a fit to one or several frames."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from pyklip_diffrender.linear.noise import Noise
from pyklip_diffrender.refinement.forward import Forward, Point
from pyklip_diffrender.refinement.problem import Problem
from pyklip_diffrender.refinement.unknowns import Unknowns

__all__ = ["Objective", "State"]


_MAX_KAPPA = 10.0
"""Largest model error, as a fraction of the star."""


@dataclass(frozen=True)
class State:
    """Values of all unknowns and the images that they render.

    Attributes
    ----------
    unknowns : Unknowns
    vector : Tensor, (unknowns,)
    points : tuple of Point
        One for each frame.
    """

    unknowns: Unknowns
    vector: Tensor
    points: tuple[Point, ...]

    @property
    def flux(self) -> float:
        """Flux of the star in the first frame."""
        return self.points[0].unknowns.level("flux", self.points[0].vector)

    def bright_companions(self, kappa: float = 0.0) -> int:
        """Number of companions, over all frames, that count in Jacobians; see `brightest`."""
        return sum(len(p.unknowns.bright_sources(p.vector, kappa)) for p in self.points)

    @property
    def has_star(self) -> bool:
        """Whether all frames have starlight; without it, no derivative leads back to a star."""
        return all(point.unknowns.level("flux", point.vector) > 0 for point in self.points)


class Objective:
    """Compares states with the data of all frames.

    Parameters
    ----------
    forwards : sequence of Forward
        One for each frame.
    robust : float
        Residuals of this many sigma have half the weight (Cauchy's loss); inf for least squares.

    Attributes
    ----------
    shares_pattern : tuple of bool
        Which frames show the same pixels of the detector, so that the error of the systematics is
        one unknown in all of them. It is noise of every other frame.
    """

    def __init__(self, forwards: Sequence[Forward], robust: float) -> None:
        self.forwards = tuple(forwards)
        self.shares_pattern = _sharing([forward.problem for forward in self.forwards])
        self.robust = robust

    @property
    def pixels(self) -> int:
        """Number of pixels of all frames that are fitted."""
        return sum(forward.problem.pixels for forward in self.forwards)

    def at(self, unknowns: Unknowns, vector: Tensor) -> State:
        """Render all frames."""
        points = tuple(
            forward.at(frame, rows.of_unknowns(vector))
            for forward, frame, rows in zip(
                self.forwards, unknowns.frames, unknowns.rows, strict=True
            )
        )
        return State(unknowns, vector, points)

    def sigma(self, frame: int, point: Point, kappa: float) -> Tensor:
        """Noise and, in quadrature, a model error of the fraction `kappa` of the star."""
        return torch.sqrt(self.noise(frame, point) ** 2 + (kappa * point.total) ** 2)

    def noise(self, frame: int, point: Point) -> Tensor:
        """Noise of the data and, in quadrature, the error of the systematics."""
        problem = self.forwards[frame].problem
        return torch.hypot(problem.sigma, problem.gain_error * point.multiplied)

    def whitened(self, frame: int, point: Point, sigma: Tensor) -> Tensor:
        """Residual over `sigma`; 0 where masked."""
        problem = self.forwards[frame].problem
        return torch.where(problem.valid, (problem.data - point.total) / sigma, 0.0)

    def errors(self, state: State, kappa: float, robust: float) -> Noise:
        """Noise of all frames, made robust about a state.

        Parameters
        ----------
        state : State
        kappa : float
            Assumed error of the star model, as a fraction of the star.
        robust : float
            Residual, in standard deviations, of half weight; inf for least squares.
        """
        weights = []
        for k, point in enumerate(state.points):
            problem = self.forwards[k].problem
            whole = self.sigma(k, point, kappa)
            shares = self.shares_pattern[k]
            own = torch.hypot(problem.sigma, kappa * point.total) if shares else whole
            weight = torch.where(problem.valid, 1 / own, 0.0)
            if math.isfinite(robust):
                # Outliers show against all errors, that of the pattern included.
                residual = self.whitened(k, point, whole)
                weight = weight * torch.rsqrt(1 + (residual / robust) ** 2)
            weights.append(weight)
        common = [torch.zeros_like(weight) for weight in weights]
        sharing = [k for k, shares in enumerate(self.shares_pattern) if shares]
        if sharing:
            error = self.forwards[sharing[0]].problem.gain_error
            light = {k: state.points[k].multiplied for k in sharing}
            seen = sum((weights[k] * light[k]) ** 2 for k in sharing)
            scale = error / torch.sqrt(1 + error**2 * seen)
            for k in sharing:
                common[k] = light[k] * scale
        return Noise(tuple(weights), tuple(common))

    def residual(self, frame: int, point: Point) -> Tensor:
        """Data minus model; 0 where masked."""
        problem = self.forwards[frame].problem
        return torch.where(problem.valid, problem.data - point.total, 0.0)

    def residuals(self, state: State) -> list[Tensor]:
        """Data minus model of all frames."""
        return [self.residual(k, point) for k, point in enumerate(state.points)]

    def chi2(self, state: State, noise: Noise) -> float:
        """Chi-squared of all frames, with the errors that pixels share marginalised."""
        return noise.chi2(self.residuals(state))

    def chi2_per_pixel(self, state: State) -> float:
        """Chi-squared per pixel without a model error."""
        return self.chi2(state, self.errors(state, 0.0, math.inf)) / self.pixels

    def model_error(self, state: State) -> float:
        """The model error kappa at which chi-squared per pixel is 1, at least 0 and at most 10."""
        residuals, noises, stars = [], [], []
        for k, point in enumerate(state.points):
            problem = self.forwards[k].problem
            valid = problem.valid
            residuals.append((problem.data - point.total)[valid] ** 2)
            noises.append(self.noise(k, point)[valid] ** 2)
            stars.append(point.total[valid] ** 2)
        residual, noise, star = torch.cat(residuals), torch.cat(noises), torch.cat(stars)
        if float((residual / noise).mean()) <= 1:
            return 0.0
        low, high = 0.0, _MAX_KAPPA
        for _ in range(50):
            middle = (low + high) / 2
            too_small = float((residual / (noise + middle**2 * star)).mean()) > 1
            low, high = (middle, high) if too_small else (low, middle)
        return high


def _sharing(problems: Sequence[Problem]) -> tuple[bool, ...]:
    """Which frames show the same pixels of the detector with an uncertain pattern.

    Of several such sets the largest shares it, or the first one of two equal ones.
    """
    places = [
        (each.observation.first_pixel, each.observation.shape, id(each.systematics))
        for each in problems
    ]
    known = [
        place
        for place, problem in zip(places, problems, strict=True)
        if place[0] is not None and bool((problem.gain_error > 0).any())
    ]
    most = max(known, key=known.count, default=None)
    if most is None or known.count(most) < 2:
        return (False,) * len(problems)
    return tuple(place == most for place in places)
