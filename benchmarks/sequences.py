"""A sequence of real frames with its reference stars: limits, null S/N, residuals.

Run from the root of the project, with the frames of programme 1184 in ../shared/data/gto1184::

    python -m benchmarks.sequences --target G-7-34 --references HIP17695

It prints a table of 5-sigma limits and, for the fit of the target, the standard deviation of S/N
away from candidates and chi-squared per pixel in rings about the star.
"""

from __future__ import annotations

import argparse
import resource
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

import pyklip_diffrender as dr
from pyklip_diffrender.refinement import FrameFit

RINGS = ((0.3, 0.7), (0.7, 1.2), (1.2, 1.8), (1.8, 2.4))
INNER = 0.3


def ring_chi2(frame: FrameFit) -> list[float]:
    """Chi-squared per pixel in rings about the star, with the errors of the data alone."""
    combined = frame.observation.combined()
    residual = combined.data[0] - frame.star - frame.companion_image
    y, x = np.indices(residual.shape)
    scale, center = frame.model.detector.pixelscale, combined.center[0]
    distance = np.hypot((x - center[0]) * scale[0], (y - center[1]) * scale[1])
    square = (residual / combined.error[0]) ** 2
    inside = [(distance >= a) & (distance < b) & combined.valid[0] for a, b in RINGS]
    return [float(square[ring].mean()) for ring in inside]


def main() -> None:
    """Reduce one target with some of the other stars as references."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=Path, default=Path("../shared/data/gto1184"))
    parser.add_argument("--opd", type=Path, default=Path("../shared/data/opd_2022-08-14.fits.gz"))
    parser.add_argument("--target", default="G-7-34")
    parser.add_argument("--references", nargs="*", default=["HIP17695"])
    parser.add_argument("--filter", default="F444W")
    options = parser.parse_args()
    sequence = dr.Sequence.from_files(options.frames, target=options.target, filter=options.filter)
    references = [each for each in sequence.references if each.target in options.references]
    sequence = replace(sequence, references=tuple(references))
    began = time.perf_counter()
    result = dr.reduce(sequence, options.opd, systematics="references" if references else "auto")
    seconds = time.perf_counter() - began
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    print(f"{result}\n{seconds:.0f} s, {memory:.1f} GB")
    detection = result.detection
    distant = np.hypot(detection.grid[..., 0], detection.grid[..., 1]) > INNER
    print(f"S/N beyond {INNER} arcsec: deviation {np.nanstd(detection.residual_snr[distant]):.3f}")
    print(f"errors scaled by {detection.scatter:.3g}, model error {result.fit.model_error:.3g}")
    for name, fits in (("references", result.references), ("target", (result.fit,))):
        for fit in fits:
            print(name, fit, [np.round(ring_chi2(frame), 2).tolist() for frame in fit.frames])
    detection.contrast_curve["separation", "contrast", "known_star"].pprint_all()


if __name__ == "__main__":
    main()
