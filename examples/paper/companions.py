"""Two, three and four planets, and one of contrast 1e-3: what is kept of their light.

    python examples/paper/companions.py --opd BEFORE AFTER --seeds 20

Nothing is told about how many there are. The wavefront map is 40 h old; on the embedded generator
each frame has a wavefront and a drift of its own.
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
"""From a planet within which a candidate is that planet, arcsec."""
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


def one_system(here: Setting, name: str, seed: int) -> Table:
    """One row a planet."""
    planets = SYSTEMS[name]
    here = here.redrawn(seed)
    shot = frame(here, HOURS, seed, planets)
    found = dr.detect(dr.refine(here.model, shot.observation, here.measured))
    table = found.table
    places = np.array([planet.offset for planet in planets])
    x, y = table["x"].value, table["y"].value
    away = np.hypot(x - places[:, :1], y - places[:, 1:])
    false = int((away.min(axis=0) >= NEAR).sum())
    rows = []
    for k, planet in enumerate(planets):
        nearest = int(np.argmin(away[k])) if len(table) else -1
        seen = nearest >= 0 and away[k, nearest] < NEAR
        rows.append(
            {
                "scene": name,
                "planet": k,
                "seed": seed,
                "contrast": planet.contrast,
                "found": seen,
                "measured": float(table["contrast"][nearest]) if seen else math.nan,
                "error": float(table["contrast_error"][nearest]) if seen else math.nan,
                "away_mas": 1e3 * away[k, nearest] if seen else math.nan,
                "false_candidates": false,
            }
        )
    return Table(rows=rows)


def main() -> None:
    """Run the study."""
    given = options(__doc__.splitlines()[0]).parse_args()
    changes = {"npix": 256, "fov_pixels": 48} if given.quick else {}
    here = setting(tuple(given.opd) if given.opd else None, **changes)
    names = ("two",) if given.quick else tuple(SYSTEMS)
    seeds = range(1 if given.quick else given.seeds)
    jobs = [(here, name, seed) for seed in seeds for name in names]
    name = "companions_measured" if given.opd else "companions_generator"
    table = timed_table(
        lambda: mapped(one_system, jobs, given.processes), given.output / f"{name}.ecsv"
    )
    for scene in names:
        part = table[(table["scene"] == scene) & table["found"]]
        ratio = part["measured"] / part["contrast"]
        pull = (part["measured"] - part["contrast"]) / part["error"]
        lost = int((~table["found"][table["scene"] == scene]).sum())
        print(
            f"{scene}: flux ratio {np.mean(ratio):.3f} (worst {np.abs(ratio - 1).max():.3f} off), "
            f"pull {np.mean(pull):.2f} +- {np.std(pull):.2f}, {lost} missed, "
            f"{int(part['false_candidates'].max())} false"
        )


if __name__ == "__main__":
    main()
