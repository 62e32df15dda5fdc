"""Peak memory of fits of real frames, with and without `GaussNewton.memory`.

    python -m benchmarks.memory FRAMES OPD --target STAR

FRAMES is a folder of calints files. One frame of the target is fitted and searched, then all frames
of the filter, those of other stars as references. Every row is a process of its own, for what is
freed does not always return to the system.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from astropy.table import Table

import pyklip_diffrender as dr
from pyklip_diffrender.scene.simulation import model_for

ITERATIONS = 8
"""Memory is largest when the wavefront is fitted, which begins at the third to fifth step."""

CASES = (("one", None), ("one", "1.5 GB"), ("all", None), ("all", "2.5 GB"))


def measure(options: argparse.Namespace) -> dict[str, Any]:
    """Fit and search in this process."""
    sequence = dr.Sequence.from_files(
        options.frames, target=options.target, filter=options.filter
    ).cutout(options.size)
    frames = sequence.science[-1:]
    if options.which == "all":
        frames = (*sequence.science, *sequence.references)
    settings = dr.GaussNewton.nircam(max_iterations=ITERATIONS, memory=options.limit)
    model = model_for(frames[0], options.size)
    fit = dr.refine(model, frames, dr.read_opd(options.opd), settings=settings)
    dr.detect(fit)
    return {
        "frames": len(frames),
        "wavelengths": len(model.bandpass.wavelengths),
        "limit": options.limit or "none",
        "peak GB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6 * 1.024,
        "CPU s": time.process_time(),
        "chi2 per pixel": fit.chi2_per_pixel,
    }


def main() -> None:
    """Measure all cases and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("frames", type=Path)
    parser.add_argument("opd", type=Path)
    parser.add_argument("--target", required=True)
    parser.add_argument("--filter", default="F444W")
    parser.add_argument("--size", type=int, default=80)
    parser.add_argument("--which", choices=("one", "all"), help="measure one case in this process")
    parser.add_argument("--limit", help='such as "2 GB"')
    options = parser.parse_args()
    if options.which is not None:
        print(json.dumps(measure(options)))
        return
    rows = []
    for which, limit in CASES:
        command = [sys.executable, *sys.argv, "--which", which]
        command += [] if limit is None else ["--limit", limit]
        done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
        rows.append(json.loads(done.stdout.splitlines()[-1]))
        print(rows[-1], flush=True)
    table = Table(rows)
    table["peak GB"].format, table["CPU s"].format = ".2f", ".0f"
    table["chi2 per pixel"].format = ".7f"
    table.pprint_all()


if __name__ == "__main__":
    main()
