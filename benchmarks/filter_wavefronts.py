"""How the wavefronts that two filters see differ, and what they would gain from sharing one.

Run from the root of the project, on the products of two filters of one star in the same visit::

    pyklip-diffrender reduce FRAMES --target G-7-34 --opd MAP --derivatives -o products
    python -m benchmarks.filter_wavefronts products/F356W products/F444W

Each filter was fitted alone. By the linear theory of both fits, with all that is a filter's own
(internal aberrations, alignment, pupil amplitude, flux) left to it, one vector of modes is fitted
to both. The first table has the rise of chi-squared over that of the separate fits, if the filters
may differ in nothing, or in some of the modes, by as much as the prior of the wavefront allows; and
the rms of the difference in these modes. The second has the rise if all modes may differ by a
fraction of their prior, the logarithm of the evidence relative to that of wavefronts of their own,
and the ratio by which the errors of a planet's flux in each filter become smaller.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

import pyklip_diffrender as dr
from pyklip_diffrender.detection.templates import groups_of
from pyklip_diffrender.optics.grid import zernike_basis

SEPARATIONS = (0.5, 1.0, 1.5, 2.0)
FRACTIONS = (0.0, 0.03, 0.1, 0.2, 0.3, 0.5, 0.7, 1.0)
ZERNIKES = {
    "tilt": (2, 3), "focus": (4,), "astigmatism": (5, 6), "Zernikes 2 to 36": tuple(range(2, 37)),
}  # fmt: skip
"""Noll indices."""

FREE = 100.0
"""Prior deviation of Zernike differences, nm."""


@dataclass
class Filter:
    """What one filter's frames say about the modes.

    `gradient` is half that of chi-squared at the fitted modes, and `shared` half its curvature,
    with everything else marginalised.
    """

    name: str
    linear: dr.linear.LinearModel
    images: dict[int, torch.Tensor]
    modes: torch.Tensor
    shared: torch.Tensor
    best: torch.Tensor
    deviation: torch.Tensor

    @property
    def gradient(self) -> torch.Tensor:
        """The prior's pull, which that of the data balances at the fitted modes."""
        return -self.best / self.deviation**2

    def rise(self, modes: torch.Tensor) -> float:
        """Chi-squared at other modes minus that at the fitted ones."""
        step = modes - self.best
        return float(2 * self.gradient @ step + step @ self.shared @ step)

    def errors(self, more: torch.Tensor | None = None) -> np.ndarray:
        """Errors of a planet at every separation, with more information on the modes."""
        linear = self.linear
        if more is not None:
            curvature = linear.curvature.clone()
            curvature[self.modes[:, None], self.modes] += more
            linear = replace(linear, curvature=curvature)
        errors = linear.weigh(self.images).information.numpy() ** -0.5
        return np.asarray(np.median(errors.reshape(len(SEPARATIONS), -1), axis=1))


def information(linear: dr.linear.LinearModel, count: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Indices of the leading modes, and what the frames say of them, without their prior."""
    leading = torch.tensor(
        [each.name == "modes" and each.component < count for each in linear.unknowns]
    )
    modes, rest = torch.nonzero(leading).flatten(), torch.nonzero(~leading).flatten()
    own = linear.curvature[rest][:, rest].double()
    own.diagonal().add_(linear.deviation[rest] ** -2.0)
    mixed = linear.curvature[rest][:, modes].double()
    shared = linear.curvature[modes][:, modes].double()
    return modes, shared - mixed.T @ torch.linalg.solve(own, mixed)


def linearised(fit: dr.Refinement, count: int) -> Filter:
    """What the fit of a filter says about its leading modes."""
    ((linear, templates),) = groups_of([fit])
    modes, shared = information(linear, count)
    angles = np.arange(0, 2 * np.pi, np.pi / 3)
    offsets = [(r * np.cos(t), r * np.sin(t)) for r in SEPARATIONS for t in angles]
    images = templates.at(torch.tensor(offsets, dtype=torch.float64))
    name = str(fit.frames[0].observation.filter)
    vector, deviation = linear.vector[modes].double(), linear.deviation[modes].double()
    return Filter(name, linear, images, modes, shared, vector, deviation)


def zernikes_in(fit: dr.Refinement, noll: tuple[int, ...]) -> torch.Tensor:
    """Coefficients of the modes, (modes, Zernikes), that have the shape of Zernikes of rms 1 nm."""
    grid = fit.frames[0].model.entrance.grid
    modes = fit.basis.modes(grid, 0, len(fit.basis)).double()
    rows, columns = modes.shape[1:]
    y = (torch.arange(rows, dtype=torch.float64) - (rows - 1) / 2) / (rows / 2)
    x = (torch.arange(columns, dtype=torch.float64) - (columns - 1) / 2) / (rows / 2)
    shapes = zernike_basis(max(noll), x, y, 1.0)[[n - 1 for n in noll]]
    # Where the segments are; every third row and second column are enough for smooth shapes.
    inside = modes[fit.basis.frequencies == 0].abs().sum(dim=0) > 0
    inside[1::3], inside[2::3], inside[:, 1::2] = False, False, False
    matrix = modes[:, inside].T
    normal = matrix.T @ matrix
    normal.diagonal().add_(1e-6 * normal.diagonal().mean())
    solution: torch.Tensor = torch.linalg.solve(normal, matrix.T @ shapes[:, inside].double().T)
    return solution


def together(
    one: Filter, two: Filter, directions: torch.Tensor, deviation: torch.Tensor
) -> tuple[float, torch.Tensor, float]:
    """Fit both with modes that differ along directions, (modes, k), of given prior deviations.

    Returns the rise of chi-squared, the difference (modes,), and the logarithm of the evidence.
    """
    prior = one.deviation**-2.0
    cross = two.shared @ directions
    own = directions.T @ cross
    own.diagonal().add_(deviation**-2.0)
    top = one.shared + two.shared
    top.diagonal().add_(prior)
    matrix = torch.cat([torch.cat([top, cross], 1), torch.cat([cross.T, own], 1)])
    pull_one = one.shared @ one.best - one.gradient
    pull_two = two.shared @ two.best - two.gradient
    factor = torch.linalg.cholesky(matrix)
    pull = torch.cat([pull_one + pull_two, directions.T @ pull_two])
    solution = torch.cholesky_solve(pull[:, None], factor)[:, 0]
    modes, size = solution[: len(prior)], solution[len(prior) :]
    difference = directions @ size
    rise = one.rise(modes) + two.rise(modes + difference)
    cost = rise + float((modes**2 * prior).sum() + ((size / deviation) ** 2).sum())
    volume = float(
        prior.log().sum() - 2 * deviation.log().sum() - 2 * factor.diagonal().log().sum()
    )
    return rise, difference, (volume - cost) / 2


def apart(one: Filter, two: Filter) -> float:
    """Logarithm of the evidence of wavefronts of their own."""
    total = 0.0
    for each in (one, two):
        prior = one.deviation**-2.0
        matrix = each.shared.clone()
        matrix.diagonal().add_(prior)
        cost = float((each.best**2 * prior).sum())
        total += float(prior.log().sum() - torch.linalg.slogdet(matrix)[1] - cost) / 2
    return total


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folders", nargs=2, type=Path)
    options = parser.parse_args()
    torch.set_num_threads(1)
    fits = [dr.Refinement.read(folder / "fit.fits") for folder in options.folders]
    # A basis begins with the modes of a shorter one; those beyond are the longer one's own.
    fit, other = sorted(fits, key=lambda each: len(each.basis))
    count = len(fit.basis)
    one, two = (linearised(each, count) for each in (fit, other))
    frequency = fit.basis.frequencies
    segments = frequency == 0
    print(f"prior scales, nm: {fit.scales}, {other.scales}")
    spread = float((two.best - one.best).square().sum() ** 0.5)
    print(f"difference of the separate fits: norm {spread:.1f} nm; of each "
          f"{float(one.best.norm()):.1f}, {float(two.best.norm()):.1f}")  # fmt: skip
    print("| may differ | modes | rise of chi-squared | rms of the difference, nm |")
    print(f"modes: {count} of {one.name} and of {two.name}, which has {len(other.basis)}")
    everything = torch.eye(count, dtype=torch.float64)
    none = everything[:, :0]
    print(
        f"| nothing | 0 | {together(one, two, none, torch.ones(0).double())[0]:.0f} | |", flush=True
    )
    cases = {}
    for name, noll in ZERNIKES.items():
        shape = zernikes_in(fit, noll)
        cases[name] = (shape, torch.full((len(noll),), FREE, dtype=torch.float64))
    bands = {
        "segments": segments,
        **{
            f"texture up to {top} cycles": (frequency > 0) & (frequency <= top)
            for top in (2, 4, 8)
        },
        "segments and texture up to 8 cycles": frequency <= 8,
        "texture beyond 8 cycles": frequency > 8,
        "all modes": frequency >= 0,
    }  # fmt: skip
    cases |= {name: (everything[:, use], one.deviation[use]) for name, use in bands.items()}
    grid = fit.frames[0].model.entrance.grid
    mirror = fit.basis.opd(segments.double(), grid) != 0
    for name, (directions, deviation) in cases.items():
        rise, difference, _ = together(one, two, directions, deviation)
        rms = float(fit.basis.opd(difference, grid)[mirror].std())
        print(f"| {name} | {directions.shape[1]} | {rise:.0f} | {rms:.1f} |", flush=True)
    alone = {each.name: each.errors() for each in (one, two)}
    base = apart(one, two)
    titles = [f"{n} {s}" for n in alone for s in SEPARATIONS]
    print(f"| fraction of the prior | rise | ln evidence | {' | '.join(titles)} |")
    for fraction in FRACTIONS:
        scale = fraction * one.deviation
        use, widths = (everything, scale) if fraction else (none, torch.ones(0).double())
        rise, _, evidence = together(one, two, use, widths)
        gains = []
        for each, partner in ((one, two), (two, one)):
            more = partner.shared
            if fraction:
                # (S^-1 + D)^-1, in a form for singular S.
                inverse = torch.diag(scale**-2.0)
                more = inverse - inverse @ torch.linalg.solve(partner.shared + inverse, inverse)
            gains += list(alone[each.name] / each.errors(more))
        row = " | ".join(f"{value:.2f}" for value in gains)
        print(f"| {fraction:g} | {rise:.0f} | {evidence - base:.0f} | {row} |", flush=True)


if __name__ == "__main__":
    main()
