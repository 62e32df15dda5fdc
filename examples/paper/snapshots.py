"""Several frames: N = 1, 2, 4, 8 snapshots of a planet while the wavefront drifts.

    python examples/paper/snapshots.py --opd BEFORE AFTER --seeds 20

The snapshots are three hours apart, beginning 40 h after the map. Fitted one by one (their
information adds), and together with a wavefront that may drift (linked), for a quarter of the
seeds. On the embedded generator each seed has a wavefront and a drift of its own.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path

import numpy as np
from astropy.table import Table

import pyklip_diffrender as dr
from pyklip_diffrender.refinement import FitSettings
from pyklip_diffrender.wavefront.priors import WavefrontPrior

sys.path.insert(0, str(Path(__file__).parent))
from scene import Planet, Setting, frame, mapped, options, setting, timed_table

PLANET = Planet(5e-7, 0.6, 54.0)
COUNTS = (1, 2, 4, 8)
BEGIN, APART = 40.0, 3.0
DRIFT = WavefrontPrior(scales={"segment": 0.2, "texture": 0.01})


def one_seed(setup: Setting, counts: tuple[int, ...], linked: int, seed: int) -> Table:
    """One row for each number of snapshots."""
    setup = setup.redrawn(seed)
    shots = [
        frame(setup, BEGIN + APART * k, 100 * seed + k, [PLANET]).observation
        for k in range(max(counts))
    ]
    alone = [
        dr.detect(dr.refine(setup.model, shot, setup.measured)).measure([PLANET.offset])[0]
        for shot in shots
    ]
    measured, errors = np.array([(row["contrast"], row["contrast_error"]) for row in alone]).T
    rows = []
    for count in counts:
        weights = errors[:count] ** -2.0
        row = {
            "snapshots": count,
            "seed": seed,
            "measured": float(np.average(measured[:count], weights=weights)),
            "error": float(weights.sum() ** -0.5),
            "linked": math.nan,
            "linked_error": math.nan,
        }
        if 1 < count <= linked:
            settings = FitSettings(drift=DRIFT)
            joint = dr.refine(setup.model, shots[:count], setup.measured, settings=settings)
            together = dr.detect(joint).measure([PLANET.offset])
            row["linked"] = float(together["contrast"][0])
            row["linked_error"] = float(together["contrast_error"][0])
        rows.append(row)
    return Table(rows=rows)


def gain(table: Table, count: int, error: str) -> float:
    """Of S/N with a number of snapshots, over its square root; NaN where none was measured.

    Seed by seed, for each may have a wavefront of its own; rows are in the order of seeds.
    """
    single = np.asarray(table["error"][table["snapshots"] == 1], dtype=float)
    combined = np.asarray(table[error][table["snapshots"] == count], dtype=float)
    ratio = single / combined / math.sqrt(count)
    return float(np.mean(ratio[np.isfinite(ratio)])) if np.isfinite(ratio).any() else math.nan


def main() -> None:
    """Run the study."""
    parser = options(__doc__.splitlines()[0])
    parser.add_argument("--linked", type=int, default=4, help="most snapshots fitted together")
    arguments = parser.parse_args()
    changes = {"npix": 256, "fov_pixels": 48} if arguments.quick else {}
    setup = setting(tuple(arguments.opd) if arguments.opd else None, **changes)
    counts = COUNTS[:2] if arguments.quick else COUNTS
    seeds = 1 if arguments.quick else arguments.seeds
    jobs = [
        (setup, counts, arguments.linked if seed < max(1, seeds // 4) else 0, seed)
        for seed in range(seeds)
    ]
    name = "snapshots_measured" if arguments.opd else "snapshots_generator"
    table = timed_table(
        lambda: mapped(one_seed, jobs, arguments.processes), arguments.output / f"{name}.ecsv"
    )
    for count in counts:
        part = table[table["snapshots"] == count]
        pull = (part["measured"] - PLANET.contrast) / part["error"]
        separate, linked = (gain(table, count, name) for name in ("error", "linked_error"))
        print(
            f"N = {count}: gain over sqrt(N) {separate:.3f}, fitted together {linked:.3f}, "
            f"pull {pull.mean():.2f}"
        )


if __name__ == "__main__":
    main()
