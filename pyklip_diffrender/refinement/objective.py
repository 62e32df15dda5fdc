"""Chi-squared of a fit to one or several frames."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from pyklip_diffrender.refinement.forward import Forward, Point
from pyklip_diffrender.refinement.joint_layout import JointLayout

__all__ = ["Objective", "State"]


_MAX_KAPPA = 10.0
"""Largest model error, as a fraction of the star."""


@dataclass(frozen=True)
class State:
    """Values of all unknowns and the images that they render.

    Attributes
    ----------
    joint : JointLayout
    vector : Tensor, (joint unknowns,)
    points : tuple of Point
        One for each frame.
    """

    joint: JointLayout
    vector: Tensor
    points: tuple[Point, ...]

    @property
    def flux(self) -> float:
        """Flux of the star in the first frame."""
        return self.points[0].unknowns.level("flux", self.points[0].vector)


class Objective:
    """Compares states with the data of all frames.

    Parameters
    ----------
    forwards : sequence of Forward
        One for each frame.
    robust : float
        Residuals of this many sigma have half the weight (Cauchy's loss); inf for least squares.
    """

    def __init__(self, forwards: Sequence[Forward], robust: float) -> None:
        self.forwards = tuple(forwards)
        self.robust = robust
        self.pixels = sum(forward.problem.pixels for forward in self.forwards)

    def at(self, joint: JointLayout, vector: Tensor) -> State:
        """Render all frames."""
        points = tuple(
            forward.at(unknowns, joint.of_frame(k, vector))
            for k, (forward, unknowns) in enumerate(zip(self.forwards, joint.frames, strict=True))
        )
        return State(joint, vector, points)

    def sigma(self, frame: int, point: Point, kappa: float) -> Tensor:
        """Noise and, in quadrature, a model error of the fraction `kappa` of the star."""
        return torch.sqrt(self.noise(frame, point) ** 2 + (kappa * point.total) ** 2)

    def noise(self, frame: int, point: Point) -> Tensor:
        """Noise of the data and, in quadrature, the error of the systematics."""
        problem = self.forwards[frame].problem
        return torch.hypot(problem.sigma, problem.gain_error * point.light)

    def whitened(self, frame: int, point: Point, sigma: Tensor) -> Tensor:
        """Residual over `sigma`; 0 where masked."""
        problem = self.forwards[frame].problem
        return torch.where(problem.valid, (problem.data - point.total) / sigma, 0.0)

    def weighted(
        self, frame: int, point: Point, kappa: float, robust: float
    ) -> tuple[Tensor, Tensor]:
        """Whitened residual and weight of every pixel, made robust; 0 where masked."""
        sigma = self.sigma(frame, point, kappa)
        residual = self.whitened(frame, point, sigma)
        weight = torch.where(self.forwards[frame].problem.valid, 1 / sigma, 0.0)
        if math.isfinite(robust):
            halving = torch.rsqrt(1 + (residual / robust) ** 2)
            residual, weight = residual * halving, weight * halving
        return residual, weight

    def chi2_per_pixel(self, state: State) -> float:
        """Chi-squared per pixel without a model error."""
        total = sum(
            float((self.whitened(k, point, self.noise(k, point)) ** 2).sum())
            for k, point in enumerate(state.points)
        )
        return total / self.pixels

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

    def loss(self, state: State, sigmas: Sequence[Tensor]) -> float:
        """Chi-squared of all frames for fixed standard deviations, or Cauchy's loss if robust."""
        total = 0.0
        for k, (point, sigma) in enumerate(zip(state.points, sigmas, strict=True)):
            squared = self.whitened(k, point, sigma) ** 2
            if math.isfinite(self.robust):
                limit = self.robust**2
                squared = limit * torch.log1p(squared / limit)
            total += float(squared.sum())
        return total
