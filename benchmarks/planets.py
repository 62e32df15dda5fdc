"""Planets and binaries in simulated frames: listed by the search, or excluded by the curve?

Run from the root of the project:

    python -m benchmarks.planets --scenes 200 [--processes N]

Single frames through F444W and MASK335R, 36 pixels, photon noise of a bright star, a wavefront that
has drifted since its map. Each has one companion: of contrast 1e-5 to 1e-2 at .1 to 2 arcsec (at
most the edge of the frame), every fifth one of .01 to .1 at such separations. It counts as found if
a candidate is within half a lambda/D; one that is not found is explained if it is fainter than the
curve at its separation, with the small-sample correction that the threshold has, or nearer to the
star than the curve begins. The script prints a line for each that is not found or has other
candidates beside it, the counts, and how far contrasts are from the truth in units of their errors.
"""

from __future__ import annotations

import argparse
import math
import multiprocessing
from collections import Counter
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

import pyklip_diffrender as dr
from pyklip_diffrender.instrument.nircam import NIRCAM_LW_PIXELSCALE

NPIX, PIXELS = 128, 36
DRIFT = 0.15
"""Part of another random wavefront that is added to the map's."""


@dataclass(frozen=True)
class Outcome:
    """Result of the search of one scene.

    Attributes
    ----------
    verdict : str
    scene : str
        Planet, status of the fit and, where the planet is missing, limit and candidates.
    false : tuple of float
        S/N of candidates that are not the planet.
    pull : float
        Measured minus true contrast in units of its error; NaN for a planet that is missing.
    """

    verdict: str
    scene: str
    false: tuple[float, ...] = ()
    pull: float = math.nan


def searched(seed: int, **settings: Any) -> Outcome:
    """Simulate, fit and search one scene, with fields of `FitSettings` other than the defaults."""
    rng = np.random.default_rng(seed)
    low, high = (-2, -1) if seed % 5 == 4 else (-5, -2)
    contrast = 10 ** rng.uniform(low, high)
    reach = NIRCAM_LW_PIXELSCALE * (PIXELS / 2 - 2)
    separation, angle = min(10 ** rng.uniform(-1, np.log10(2)), reach), rng.uniform(0, 360)
    planet = dr.Planet(contrast, separation, angle)
    model = dr.nircam_coronagraph("F444W", monochromatic=4.4e-6, npix=NPIX, fov_pixels=PIXELS)
    before, change = (dr.wavefront.random_opd(k, npix=NPIX) for k in (2 * seed, 2 * seed + 1))
    now = replace(before, data=before.data + DRIFT * change.data)
    frame = dr.simulate(model, dr.Scene(planets=(planet,)), now, seed=seed)
    fit = dr.refine(model, frame, before, settings=dr.FitSettings(**settings))
    words = f"{seed}: {contrast:.2g} at {separation:.3f} arcsec, {fit.status.name}"
    if not fit.status.usable:
        return Outcome("the fit says that it failed", words)
    result = dr.detect(fit)
    table = result.candidates
    x, y = planet.offset
    away = np.hypot(table["x"].value - x, table["y"].value - y)
    near = away < 0.5 * model.resolution
    false = tuple(table["snr"][~near].tolist())
    if near.any():
        row = table[int(away.argmin())]
        pull = float((row["contrast"] - contrast) / row["contrast_error"])
        return Outcome("found", words, false, pull)
    curve = result.contrast_curve
    limit = np.interp(separation, curve["separation"].value, curve["small_sample"], left=np.inf)
    verdict = "fainter than the curve" if contrast < limit else "lost"
    return Outcome(verdict, f"{words}, limit {limit:.2g}", false)


def main() -> None:
    """Search all scenes."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", type=int, default=200)
    parser.add_argument("--processes", type=int, default=1)
    options = parser.parse_args()
    counts: Counter[str] = Counter()
    pulls = []
    context = multiprocessing.get_context("spawn")
    with context.Pool(options.processes, torch.set_num_threads, (1,)) as pool:
        for outcome in pool.imap_unordered(searched, range(options.scenes)):
            counts[outcome.verdict] += 1
            counts["false candidates"] += len(outcome.false)
            pulls.append(outcome.pull)
            if outcome.verdict != "found" or outcome.false:
                others = f", others of S/N {np.round(outcome.false, 1).tolist()}"
                print(
                    f"{outcome.scene}: {outcome.verdict}{others * bool(outcome.false)}", flush=True
                )
    print(dict(counts))
    print(f"pulls of contrast: median {np.nanmedian(pulls):+.2f}, "
          f"rms {np.sqrt(np.nanmean(np.square(pulls))):.2f}, "
          f"largest {np.nanmax(np.abs(pulls)):.1f}")  # fmt: skip


if __name__ == "__main__":
    main()
