"""Throughput of two, three and four planets, and of one of contrast 1e-3.

    python examples/paper/companions.py --opd BEFORE AFTER --seeds 20

The number of planets is not given to the search. The OPD map is 40 h old; on the embedded
generator each frame has its own wavefront and drift.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path

import numpy as np
from astropy.table import Table

import pyklip_diffrender as dr

sys.path.insert(0, str(Path(__file__).parent))
from scene import Planet, Setting, frame, mapped, options, setting, timed_table

HOURS = 40.0
NEAR = 0.1
"""Largest distance from a planet at which a candidate is identified with it, arcsec."""
SYSTEMS = {
    "two": (Planet(1e-6, 0.6, 54.0), Planet(1e-6, 1.2, 200.0)),
    "three": (Planet(2e-6, 0.5, 54.0), Planet(1e-6, 0.9, 170.0), Planet(5e-7, 1.5, 290.0)),
    "four": (
        Planet(2e-6, 0.5, 54.0),
        Planet(1e-6, 0.9, 170.0),
        Planet(1e-6, 1.0, 185.0),
        Planet(5e-7, 1.5, 290.0),
    ),
    "bright": (Planet(1e-3, 0.8, 30.0), Planet(1e-6, 1.2, 200.0)),
}


def one_system(setup: Setting, name: str, seed: int) -> Table:
    """One row for each planet."""
    planets = SYSTEMS[name]
    setup = setup.redrawn(seed)
    shot = frame(setup, HOURS, seed, planets)
    detection = dr.detect(dr.refine(setup.model, shot.observation, setup.measured))
    table = detection.candidates
    places = np.array([planet.offset for planet in planets])
    x, y = table["x"].value, table["y"].value
    distance = np.hypot(x - places[:, :1], y - places[:, 1:])
    false = int((distance.min(axis=0) >= NEAR).sum())
    rows = []
    for k, planet in enumerate(planets):
        nearest = int(np.argmin(distance[k])) if len(table) else -1
        detected = nearest >= 0 and distance[k, nearest] < NEAR
        rows.append(
            {
                "scene": name,
                "planet": k,
                "seed": seed,
                "contrast": planet.contrast,
                "found": detected,
                "measured": float(table["contrast"][nearest]) if detected else math.nan,
                "error": float(table["contrast_error"][nearest]) if detected else math.nan,
                "away_mas": 1e3 * distance[k, nearest] if detected else math.nan,
                "false_candidates": false,
            }
        )
    return Table(rows=rows)


def main() -> None:
    """Run the study."""
    arguments = options(__doc__.splitlines()[0]).parse_args()
    changes = {"npix": 256, "fov_pixels": 48} if arguments.quick else {}
    setup = setting(tuple(arguments.opd) if arguments.opd else None, **changes)
    names = ("two",) if arguments.quick else tuple(SYSTEMS)
    seeds = range(1 if arguments.quick else arguments.seeds)
    jobs = [(setup, name, seed) for seed in seeds for name in names]
    name = "companions_measured" if arguments.opd else "companions_generator"
    table = timed_table(
        lambda: mapped(one_system, jobs, arguments.processes), arguments.output / f"{name}.ecsv"
    )
    for scene in names:
        part = table[(table["scene"] == scene) & table["found"]]
        ratio = part["measured"] / part["contrast"]
        pull = (part["measured"] - part["contrast"]) / part["error"]
        missed = int((~table["found"][table["scene"] == scene]).sum())
        print(
            f"{scene}: flux ratio {np.mean(ratio):.3f} (worst {np.abs(ratio - 1).max():.3f} off), "
            f"pull {np.mean(pull):.2f} +- {np.std(pull):.2f}, {missed} missed, "
            f"{int(part['false_candidates'].max())} false"
        )


if __name__ == "__main__":
    main()
