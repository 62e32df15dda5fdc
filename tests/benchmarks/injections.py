"""Planets injected into real frames: this package and KLIP (pyKLIP's) on the same frames.

Run from the root of the project, with the frames of programme 1184 in ../shared/data/gto1184::

    python -m tests.benchmarks.injections --target G-7-34 --filter F444W --trials 3

For the rolls of one target, with all other stars as KLIP's references, it prints the 5-sigma limits
of `reduce` (closed form) and of KLIP (ADI+RDI, best number of modes at every separation, smoothed
with the planet's image, throughput from injections), and what `reduce` recovers of planets that
are injected at 1.6 times its limit, seven at a time: bias, coverage, S/N.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from astropy.io import fits
from numpy.typing import NDArray
from pyklip.klip import klip_math, rotate
from scipy.signal import fftconvolve
from scipy.stats import norm, t

import pyklip_diffrender as dr
from pyklip_diffrender.refinement import FrameFit

Image = NDArray[np.float64]

SEPARATIONS = np.array([0.4, 0.5, 0.7, 1.0, 1.5, 2.0, 2.3])
MODES = (1, 2, 3, 4, 5)
PIXEL = 0.0624
SIZE = 80


def spiral(trial: int, separations: NDArray[np.float64] = SEPARATIONS) -> Image:
    """x, y of one planet at every separation, far from each other, turned by the trial."""
    angle = np.radians(137.5 * np.arange(len(separations)) + 47.0 * trial)
    return separations[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def planet(frame: FrameFit, roll: float, offset: Image, shift: Image) -> Image:
    """Planet of contrast 1 in a frame, its position as in the first frame, the star at `shift`."""
    angle = math.radians(roll)
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    values = {**frame.optical_values, "detector_shift": torch.from_numpy(shift)}
    star = values.pop("star_offset", torch.zeros(2, dtype=torch.float64))
    with torch.no_grad():
        image = frame.model(
            torch.from_numpy(frame.opd),
            star_offset=star + torch.from_numpy(turn @ offset),
            **values,
        )
    return frame.flux * image.double().numpy()


def aligned(path: Path) -> Image:
    """The aligned frame about the star, which is at (40, 40)."""
    with fits.open(path) as hdus:
        header = hdus["SCI"].header
        x, y = round(header["CRPIX1"]) - 1 - SIZE // 2, round(header["CRPIX2"]) - 1 - SIZE // 2
        return np.nan_to_num(np.asarray(hdus["SCI"].data[0], dtype=float))[
            y : y + SIZE, x : x + SIZE
        ]


def klip_limits(fit: dr.Refinement, files: Sequence[Path], others: Sequence[Path]) -> Image:
    """5-sigma contrast of KLIP at `SEPARATIONS`, the best of `MODES`."""
    science, references = [aligned(p) for p in files], [aligned(p) for p in others]
    rolls = [frame.observation.roll_from(fit.frames[0].observation) for frame in fit.frames]
    shift = np.full(2, 0.5 * PIXEL)
    kernel = planet(fit.frames[0], 0.0, np.array([1.2, 0.0]), shift - [1.2, 0.0])
    kernel /= np.sqrt((kernel**2).sum())

    def images(frames: Sequence[Image]) -> list[Image]:
        """Rolls turned onto the first one, averaged and smoothed, for each number of modes."""
        subtracted = subtraction(frames, references, rolls)
        return [fftconvolve(each, kernel[::-1, ::-1], mode="same") for each in subtracted]

    plain = images(science)
    y, x = np.indices(plain[0].shape)
    # The kernel's middle is half a pixel off the star's.
    distance = np.hypot(x - SIZE / 2, y - SIZE / 2) * PIXEL
    response = np.zeros((len(MODES), len(SEPARATIONS)))
    trials = 4
    for trial in range(trials):
        offsets = spiral(trial)
        added = [frame.copy() for frame in science]
        for k, frame in enumerate(fit.frames):
            for offset in offsets:
                added[k] += 3e-5 * planet(frame, rolls[k], offset, shift)
        for m, image in enumerate(images(added)):
            for s, offset in enumerate(offsets):
                close = np.hypot(x - SIZE / 2 - offset[0] / PIXEL, y - SIZE / 2 - offset[1] / PIXEL)
                response[m, s] += (image - plain[m])[close < 1.5].max() / 3e-5 / trials
    limits = np.zeros_like(response)
    for s, separation in enumerate(SEPARATIONS):
        ring = np.abs(distance - separation) < 0.07
        # Small samples (Mawet et al. 2014): as improbable as 5 sigma of a Gaussian.
        count = 2 * math.pi * separation / 0.145
        factor = t.ppf(norm.cdf(5), count - 1) * math.sqrt(1 + 1 / count)
        for m, image in enumerate(plain):
            limits[m, s] = factor * image[ring].std() / max(response[m, s], 1e-30)
    return limits.min(axis=0)


def subtraction(
    science: Sequence[Image], references: Sequence[Image], rolls: Sequence[float]
) -> list[Image]:
    """KLIP of every roll with the other rolls and the references, turned onto the first roll."""
    center = np.array([SIZE / 2, SIZE / 2])
    total = [np.zeros((SIZE, SIZE)) for _ in MODES]
    y, x = np.indices((SIZE, SIZE))
    zone = np.hypot(x - center[0], y - center[1]) * PIXEL
    zone = (zone > 0.2) & (zone < 2.45)
    for k, frame in enumerate(science):
        library = np.array([each[zone] for j, each in enumerate(science) if j != k]
                           + [each[zone] for each in references])  # fmt: skip
        subtracted = klip_math(frame[zone], library, np.array(MODES))
        for m in range(len(MODES)):
            residual = np.zeros((SIZE, SIZE))
            residual[zone] = subtracted[:, m]
            total[m] += rotate(residual, -rolls[k], center) / len(science)
    return [np.nan_to_num(each) for each in total]


def recovered(
    sequence: dr.Sequence, base: dr.Reduction, opd: Path, trials: int
) -> list[dict[str, Any]]:
    """What is measured of planets at 1.6 times the limit, with positions given."""
    curve = base.detection.contrast_curve
    limit = np.interp(SEPARATIONS, curve["separation"].value, curve["contrast"])
    rows = []
    for trial in range(trials):
        offsets = spiral(trial)
        science = []
        for frame, each in zip(base.fit.frames, base.sequence.science, strict=True):
            roll = each.roll_from(base.sequence.science[0])
            shift = np.asarray(frame.values["detector_shift"], dtype=float)
            light = sum(1.6 * c * planet(frame, roll, o, shift)
                        for c, o in zip(limit, offsets, strict=True))  # fmt: skip
            science.append(replace(each, data=each.data + light))
        injected = replace(base.sequence, science=tuple(science))
        result = dr.reduce(injected, opd, systematics=base.systematics or "off")
        table = result.detection.measure(offsets)
        for s, row in enumerate(table):
            candidates = result.detection.table
            distances = np.hypot(
                candidates["x"].value - offsets[s][0], candidates["y"].value - offsets[s][1]
            )
            is_close = (distances < 0.1).tolist()
            best = candidates[is_close.index(True)] if any(is_close) else row
            rows.append(
                {
                    "separation": SEPARATIONS[s],
                    "true": 1.6 * limit[s],
                    "contrast": float(best["contrast"]),
                    "error": float(best["contrast_error"]),
                    "snr": float(best["snr"]),
                    "detected": any(is_close),
                }
            )
        print(f"trial {trial}: {result.fit.status.name}, scatter {result.detection.scatter:.3f}",
              flush=True)  # fmt: skip
    return rows


def main() -> None:
    """Compare limits, then inject."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--frames", type=Path, default=Path("../shared/data/gto1184"))
    parser.add_argument("--opd", type=Path, default=Path("../shared/data/opd_2022-08-14.fits.gz"))
    parser.add_argument("--target", default="G-7-34")
    parser.add_argument("--filter", default="F444W")
    parser.add_argument("--trials", type=int, default=3)
    options = parser.parse_args()
    sequence = dr.Sequence.from_files(options.frames, target=options.target, filter=options.filter)
    others = [options.frames / each.name for each in sequence.references]
    files = [options.frames / each.name for each in sequence.science]
    began = time.perf_counter()
    base = dr.reduce(replace(sequence, references=()), options.opd)
    distant = np.hypot(base.detection.grid[..., 0], base.detection.grid[..., 1]) > 0.3
    print(base)
    print(
        f"{time.perf_counter() - began:.0f} s; chi2 {base.fit.chi2_per_pixel:.3f}, errors scaled "
        f"by {base.detection.scatter:.3f}, S/N beyond 0.3 arcsec: deviation "
        f"{np.nanstd(base.detection.residual_snr[distant]):.3f}, "
        f"{np.nanmin(base.detection.residual_snr[distant]):.1f} to "
        f"{np.nanmax(base.detection.residual_snr[distant]):.1f}",
        flush=True,
    )
    curve = base.detection.contrast_curve
    ours, star_known = (
        np.interp(SEPARATIONS, curve["separation"].value, curve[name])
        for name in ("contrast", "known_star")
    )
    theirs = klip_limits(base.fit, files, others)
    print("separation, ours, KLIP, ratio, star known, ours / star known")
    for row in zip(
        SEPARATIONS, ours, theirs, theirs / ours, star_known, ours / star_known, strict=True
    ):
        print("{:.1f}  {:.2e}  {:.2e}  {:.2f}  {:.2e}  {:.2f}".format(*row), flush=True)
    print(f"median ratio {np.median(theirs / ours):.2f}")
    rows = recovered(sequence, base, options.opd, options.trials)
    for row in rows:
        print({k: (f"{v:.3g}" if isinstance(v, float) else v) for k, v in row.items()})
    if rows:
        pull = np.array([(r["contrast"] - r["true"]) / r["error"] for r in rows])
        ratio = np.array([r["contrast"] / r["true"] for r in rows])
        print(
            f"{len(rows)} planets: contrast / true {np.mean(ratio):.3f} +- "
            f"{np.std(ratio) / math.sqrt(len(rows)):.3f}, mean pull {pull.mean():.2f}, deviation "
            f"{pull.std():.2f}, within 1 sigma {np.mean(np.abs(pull) < 1):.2f}, detected "
            f"{np.mean([r['detected'] for r in rows]):.2f}"
        )


if __name__ == "__main__":
    main()
