"""Seconds for refinement and search, beside the paper's recipe in the same run.

    python examples/paper/speed.py --opd BEFORE AFTER

80 x 80 pixels, all cores, nothing else running. The first run of a process loads libraries and
builds constants; then once more.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import Table

import pyklip_diffrender as dr

sys.path.insert(0, str(Path(__file__).parent))
from recipe import adam_recipe
from scene import Planet, Setting, Star, frame, options, setting, timed_table

PLANET = Planet(1e-6, 0.6, 54.0)
HOURS = 40.0
STEPS = 20
"""Adam steps that are timed; the recipe has 1000."""


def measured(
    setup: Setting, name: str, runs: tuple[str, ...], star_known: bool
) -> list[dict[str, Any]]:
    """Rows for one model."""
    shot = frame(setup, HOURS, 1, [PLANET])
    rows = []
    for run in runs:
        times = [time.perf_counter()]
        fit = dr.refine(setup.model, shot.observation, setup.measured)
        times.append(time.perf_counter())
        if star_known:
            dr.detect(fit)
        times.append(time.perf_counter())
        refine, detect = np.diff(times)
        (fitted,) = fit.frames
        star = fitted.star - float(fitted.values["background"][0])
        rows.append(
            {
                "model": name,
                "run": run,
                "refine": refine,
                "detect": detect if star_known else np.nan,
                "all": refine + detect if star_known else np.nan,
                "star_error": float(np.sqrt(np.mean(((star - shot.star) / shot.noise) ** 2))),
            }
        )
    return rows


def recipe(setup: Setting) -> dict[str, Any]:
    """The paper's 1000 Adam steps, from a sample of them, on this package's propagation."""
    shot = frame(setup, HOURS, 1, [PLANET])
    seconds = []
    for steps in (2, 2 + STEPS):
        began = time.perf_counter()
        adam_recipe(setup.model, shot.observation, setup.measured, flux=Star().photons, steps=steps)
        seconds.append(time.perf_counter() - began)
    milliseconds = 1000 * (seconds[1] - seconds[0]) / STEPS
    return {
        "model": "monochromatic, Adam recipe, 1000 steps",
        "run": f"{STEPS} steps",
        "refine": milliseconds,
        "detect": np.nan,
        "all": np.nan,
        "star_error": np.nan,
    }


def main() -> None:
    """Run the study."""
    arguments = options(__doc__.splitlines()[0]).parse_args()
    changes = {"npix": 256, "fov_pixels": 48} if arguments.quick else {}
    opd = tuple(arguments.opd) if arguments.opd else None

    def work() -> Table:
        standard = setting(opd, **changes)
        cases = [(standard, "monochromatic", True)]
        if not arguments.quick:
            ten = setting(opd, monochromatic=None, nlambda=10)
            cases.append((ten, "10 wavelengths", False))
        rows = []
        for setup, name, star_known in cases:
            rows += measured(setup, name, ("first", "second"), star_known)
        rows.append(recipe(standard))
        return Table(rows=rows)

    name = "speed_measured" if arguments.opd else "speed_generator"
    table = timed_table(work, arguments.output / f"{name}.ecsv")
    print("\n".join(table.pformat(max_lines=-1, max_width=-1)))


if __name__ == "__main__":
    main()
