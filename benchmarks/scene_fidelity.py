"""Real frames: by how much may the model be coarser without changing the limits?

    python -m benchmarks.scene_fidelity FIT FRAMES...

FIT is a fit that `Refinement.write` wrote, with its linear model; FRAMES are the files that were
fitted, from which the noise without the star's light is measured. From this one fit follow the
5-sigma limits of coarser models, on windows of 40 and 80 pixels, for the star as it is and 10 and
100 times fainter:

- Fewer modes: the unknowns above a spatial frequency are taken out of the linear model, their light
  is added to the data, and the others are solved for again.
- Fewer wavelengths, pupil samples or cells of the occulter: the star is rendered with them where
  the fit ended, and the difference is added to the residual, to which all unknowns are fitted.

A star that is k times fainter: the frame is divided by k, and white Gaussian noise is added until
the variance of a pixel is floor + (error^2 - floor) / k, where `floor` is the median variance
beyond 6 arcsec, which is read and background noise.

Limits are medians in rings of 0.2 arcsec from 0.3 to 2.1 arcsec, as far as the window reaches,
multiplied by the scatter of the S/N where it exceeds 1. A model is good if the median change of the
limits is at most 3 %. Prints one line for each case.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.stats import median_abs_deviation
from torch import Tensor

import pyklip_diffrender as dr
from pyklip_diffrender.detection.templates import Templates
from pyklip_diffrender.linear.model import LinearFrame, LinearModel
from pyklip_diffrender.linear.response import downsample

FAR = 6.0
"""arcsec from the star, beyond which its light adds no noise."""

GOOD = 0.03
"""Largest median change of the limits."""

STEP = 3
"""Pixels between the positions at which limits and the scatter of the S/N are computed."""

MODES = (0.85, 0.7, 0.55, 0.4, 0.25, 0.15)
"""Highest spatial frequencies, as fractions of the preset's, from fine to coarse."""

MODELS: tuple[dict[str, Any], ...] = (
    {"nlambda": 5},
    {"nlambda": 3},
    {"nlambda": 1},
    {"npix": 128},
    {"occulter_sampling": 1.0},
)

Image = NDArray[np.float64]


def floor_of(frames: dr.Observation) -> float:
    """Variance of a pixel far from the star."""
    y, x = np.indices(frames.shape)
    column, row = frames.center[0]
    away = np.hypot((x - column) * frames.pixelscale[0], (y - row) * frames.pixelscale[1])
    combined = frames.combined()
    return float(np.median(combined.error[0][(away > FAR) & combined.valid[0]] ** 2))


def fainter(fit: Any, floors: list[float], factor: float, seed: int = 1) -> LinearModel:
    """The linear model of a fit to a star that is fainter by a factor."""
    generator = np.random.default_rng(seed)
    shared = [torch.zeros(()), torch.zeros(())]
    parts: list[tuple[LinearFrame, Tensor]] = []
    for part, frame, floor in zip(fit.linear.frames, fit.frames, floors, strict=True):
        variance = torch.from_numpy(frame.observation.combined().error[0] ** 2)
        base = variance.clamp(max=floor)
        wanted = base + (variance - base) / factor
        counts = part.weight > 0
        present = torch.where(counts, part.weight, 1.0) ** -2
        other = (present - variance).clamp(min=0.0)  # Errors in proportion to the star.
        weight = torch.where(counts, (wanted + other / factor**2) ** -0.5, 0.0)
        noise = torch.from_numpy(generator.normal(size=tuple(wanted.shape)))
        added = (wanted - variance / factor**2).clamp(min=0.0).sqrt() * noise
        residual = torch.where(counts, part.residual / factor + (added if factor > 1 else 0), 0.0)
        shared[0] = shared[0] + (part.weight * part.common) ** 2
        jacobian = part.jacobian / factor
        changed = replace(part, residual=residual, weight=weight, jacobian=jacobian)
        parts.append((changed, part.common))
    # The pattern's error times the star, u, from c = u / sqrt(1 + sum w^2 u^2), and c anew.
    total = shared[0] / (1 - shared[0]).clamp(min=1e-12)
    errors = [common * (1 + total).sqrt() / factor for _, common in parts]
    again = sum((p.weight * u) ** 2 for (p, _), u in zip(parts, errors, strict=True))
    frames = tuple(
        replace(p, common=u / torch.sqrt(1 + again))
        for (p, _), u in zip(parts, errors, strict=True)
    )
    return replace(fit.linear, frames=frames)


def cut(linear: LinearModel, size: int) -> LinearModel:
    """The linear model of the middle of the frames, with its curvature."""
    ny = linear.frames[0].residual.shape[0]
    a, b = (ny - size) // 2, (ny + size) // 2
    frames = tuple(
        replace(
            f,
            residual=f.residual[a:b, a:b],
            weight=f.weight[a:b, a:b],
            common=f.common[a:b, a:b],
            jacobian=f.jacobian[:, a:b, a:b].contiguous(),
        )
        for f in linear.frames
    )
    smaller = replace(linear, frames=frames)
    count = len(linear.vector)
    white = smaller.noise.whitened(
        {k: f.onto_unknowns(f.jacobian, count) for k, f in enumerate(frames)}
    ).double()
    return replace(smaller, curvature=white @ white.T)


def with_fewer_modes(linear: LinearModel, frequencies: Tensor, share: float) -> LinearModel:
    """The linear model without modes above a share of the highest frequency."""
    highest = share * float(frequencies.max())
    goes = [
        u.name in ("modes", "amplitude") and bool(frequencies[u.component] > highest)
        for u in linear.unknowns
    ]
    labelled = tuple(
        u._replace(name="dropped") if drop else u
        for u, drop in zip(linear.unknowns, goes, strict=True)
    )
    change = torch.where(torch.tensor(goes), linear.vector, 0.0)
    light = {k: frame.image(change[:, None])[0] for k, frame in enumerate(linear.frames)}
    return replace(linear, unknowns=labelled).without("dropped", light)


def difference(frame: Any, changes: dict[str, Any]) -> Tensor:
    """The star minus that of a coarser model, (ny, nx)."""
    coarse = dr.model_for(frame.observation, **changes)
    opd = torch.from_numpy(np.ascontiguousarray(frame.opd))

    def image(model: Any) -> Tensor:
        with torch.no_grad():
            return model(downsample(opd, model.npix), **frame.optical_values).double()

    return frame.flux * torch.from_numpy(frame.gain) * (image(frame.model) - image(coarse))


def limits(linear: LinearModel, templates: dict[int, Tensor], away: Image) -> Image:
    """5-sigma limits in rings, with the scatter of the S/N."""
    products = linear.weigh(templates)
    deviation = products.information.clamp(min=1e-300).numpy() ** -0.5
    snr = products.numerator.numpy() * deviation
    scatter = max(1.0, float(median_abs_deviation(snr, scale="normal")))
    rings = [deviation[(away > r) & (away <= r + 0.2)] for r in np.arange(0.3, 2.0, 0.2)]
    return np.array([5 * scatter * np.median(ring) for ring in rings if len(ring) > 5])


def main() -> None:
    """Print what can be left out, case by case."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("fit", type=Path)
    parser.add_argument("frames", type=Path, nargs="+")
    options = parser.parse_args()
    torch.set_num_threads(1)
    fit = dr.Refinement.read(options.fit)
    floors = [floor_of(dr.Observation.from_fits(path)) for path in options.frames]
    frequencies = fit.basis.frequencies
    grid, first = fit.frames[0].grid, fit.frames[0].observation
    changes = [[difference(frame, model) for frame in fit.frames] for model in MODELS]
    side = len(grid)
    for size in (40, 80):
        a, b = (side - size) // 2, (side + size) // 2
        margin = 3
        rows, columns = (
            each.ravel()
            for each in np.mgrid[a + margin : b - margin : STEP, a + margin : b - margin : STEP]
        )
        away = np.hypot(*grid[rows, columns].T)
        near = (away > 0.3) & (away < 2.1)
        rows, columns, away = rows[near], columns[near], away[near]
        images = Templates(fit).at_pixels(rows, columns)
        for factor in (1, 10, 100):
            linear = cut(fainter(fit, floors, factor), size)
            shown = {k: image[:, a:b, a:b] / factor for k, image in images.items()}
            preset = limits(linear, shown, away)
            result: dict[str, Any] = {
                "star": first.target, "filter": first.filter, "frames": len(fit.frames),
                "window": size, "fainter": factor,
                "limits": preset.tolist(), "unknowns": [len(linear.unknowns)], "modes": {},
                "models": {},
            }  # fmt: skip
            for share in MODES:
                fewer = with_fewer_modes(linear, frequencies, share)
                ratio = limits(fewer, shown, away) / preset
                result["modes"][share] = ratio.round(3).tolist()
                result["unknowns"].append(len(fewer.unknowns))
                if np.median(np.abs(ratio - 1)) > 2 * GOOD:
                    break
            for model, change in zip(MODELS, changes, strict=True):
                residuals = tuple(
                    replace(f, residual=f.residual + (f.weight > 0) * c[a:b, a:b] / factor)
                    for f, c in zip(linear.frames, change, strict=True)
                )
                ratio = limits(replace(linear, frames=residuals), shown, away) / preset
                result["models"][str(model)] = ratio.round(3).tolist()
            print(json.dumps(result), flush=True)


if __name__ == "__main__":
    sys.exit(main())
