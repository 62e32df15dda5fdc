"""Planets injected into real frames: this package and KLIP (pyKLIP's) on the same frames.

Run from the root of the project, with the frames of programme 1184 in ../shared/data/gto1184::

    python -m tests.benchmarks.injections --target G-7-34 --filter F444W --trials 3

For the rolls of one target, with all other stars as KLIP's references, it prints the 5-sigma limits
of `reduce` (closed form) and of KLIP (`klip_curve`), both with the small-sample correction, and
what `reduce` recovers of planets that are injected at 1.6 times its limit, seven at a time: bias,
coverage, S/N.
"""

from __future__ import annotations

import argparse
import math
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

import pyklip_diffrender as dr
from pyklip_diffrender.detection.templates import Templates
from pyklip_diffrender.pyklip_backend.klip_curve import klip_curve

Image = NDArray[np.float64]

SEPARATIONS = np.array([0.4, 0.5, 0.7, 1.0, 1.5, 2.0, 2.3])
SIZE = 80


def spiral(trial: int, separations: NDArray[np.float64] = SEPARATIONS) -> Image:
    """x, y of one planet at every separation, far from each other, turned by the trial."""
    angle = np.radians(137.5 * np.arange(len(separations)) + 47.0 * trial)
    return separations[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def recovered(
    sequence: dr.Sequence, base: dr.Reduction, opd: Path, trials: int
) -> list[dict[str, Any]]:
    """What is measured of planets at 1.6 times the limit, with positions given."""
    curve = base.detection.contrast_curve
    limit = np.interp(SEPARATIONS, curve["separation"].value, curve["contrast"])
    templates = Templates(base.fit, base.fit.frames[0])
    rows = []
    for trial in range(trials):
        offsets = spiral(trial)
        light = templates.at(torch.from_numpy(offsets))
        science = tuple(
            replace(each, data=each.data + np.tensordot(1.6 * limit, light[k].numpy(), 1))
            for k, each in enumerate(base.sequence.science)
        )
        injected = replace(base.sequence, science=science)
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
    ours, star_known, corrected = (
        np.interp(SEPARATIONS, curve["separation"].value, curve[name])
        for name in ("contrast", "known_star", "small_sample")
    )
    with_references = replace(
        base, sequence=replace(base.sequence, references=sequence.cutout(SIZE).references)
    )
    klip = klip_curve(with_references, SEPARATIONS)
    theirs, modes = np.asarray(klip["contrast"]), klip["modes"]
    print(
        "small-sample correction: ours, KLIP, ratio (modes of KLIP); without it: ours, star known"
    )
    for row in zip(
        SEPARATIONS, corrected, theirs, theirs / corrected, modes, ours, star_known, strict=True
    ):
        print("{:.1f}  {:.2e}  {:.2e}  {:.2f} ({})  {:.2e}  {:.2e}".format(*row), flush=True)
    print(f"median ratio {np.median(theirs / corrected):.2f}")
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
