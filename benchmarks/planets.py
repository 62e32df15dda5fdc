"""Planets and binaries in simulated frames: listed by the search, or excluded by the curve?

Run from the root of the project:

    python -m benchmarks.planets --scenes 200

Single frames through F444W and MASK335R, 36 pixels, photon noise of a bright star, a wavefront that
has drifted since its map. Each has one companion: of contrast 1e-5 to 1e-2 at .1 to 2 arcsec (at
most the edge of the frame), every fifth one of .01 to .1 at such separations. It counts as found if
a candidate is within half a lambda/D; one that is not found is explained if it is fainter than the
curve at its separation, with the small-sample correction that the threshold has, or nearer to the
star than the curve begins. The script prints a
line for each that is not found, and the counts.
"""

from __future__ import annotations

import argparse
from collections import Counter
from dataclasses import replace

import numpy as np

import pyklip_diffrender as dr
from pyklip_diffrender.instrument.nircam import NIRCAM_LW_PIXELSCALE

NPIX, PIXELS = 128, 36
DRIFT = 0.15
"""Part of another random wavefront that is added to the map's."""


def verdict(seed: int) -> tuple[str, str]:
    """What the search says of one scene, and the scene in words."""
    rng = np.random.default_rng(seed)
    low, high = (-2, -1) if seed % 5 == 4 else (-5, -2)
    contrast = 10 ** rng.uniform(low, high)
    reach = NIRCAM_LW_PIXELSCALE * (PIXELS / 2 - 2)
    separation, angle = min(10 ** rng.uniform(-1, np.log10(2)), reach), rng.uniform(0, 360)
    planet = dr.Planet(contrast, separation, angle)
    model = dr.nircam_coronagraph("F444W", monochromatic=4.4e-6, npix=NPIX, fov_pixels=PIXELS)
    before, change = (dr.random_opd(k, npix=NPIX) for k in (2 * seed, 2 * seed + 1))
    now = replace(before, data=before.data + DRIFT * change.data)
    frame = dr.simulate(model, dr.Scene(planets=(planet,)), now, seed=seed)
    fit = dr.refine(model, frame, before, settings=dr.GaussNewton(cycles=12))
    words = f"{seed}: {contrast:.2g} at {separation:.3f} arcsec, {fit.status.name}"
    if not fit.status.usable:
        return "the fit says that it failed", words
    found = dr.detect(fit)
    places = np.stack([found.candidates["x"].value, found.candidates["y"].value], axis=1)
    away = np.hypot(*(places - planet.offset).T)
    if (away < 0.5 * model.resolution).any():
        return "found", words
    curve = found.contrast_curve
    limit = np.interp(separation, curve["separation"].value, curve["small_sample"], left=np.inf)
    words = f"{words}, limit {limit:.2g}, candidates {found.candidates['snr'].round(1).tolist()}"
    return ("fainter than the curve" if contrast < limit else "lost"), words


def main() -> None:
    """Search all scenes."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", type=int, default=200)
    parser.add_argument("--first", type=int, default=0, help="seed of the first scene")
    options = parser.parse_args()
    counts: Counter[str] = Counter()
    for seed in range(options.first, options.first + options.scenes):
        result, words = verdict(seed)
        counts[result] += 1
        if result != "found":
            print(f"{words}: {result}", flush=True)
    print(dict(counts))


if __name__ == "__main__":
    main()
