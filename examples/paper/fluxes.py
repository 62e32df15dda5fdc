"""Are fluxes unbiased and their errors right? One injected planet a frame, wavefront 40 h old.

    python examples/paper/fluxes.py --opd BEFORE AFTER --seeds 20

Each frame has one planet at a known place: contrasts 3e-7 to 1e-4, separations 0.3 to 2.3 arcsec,
and planets at the closed-form 5-sigma limit of that place, which must come out at S/N 5. On the
embedded generator each frame has a wavefront and a drift of its own.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from astropy.table import Table

import pyklip_diffrender as dr

sys.path.insert(0, str(Path(__file__).parent))
from scene import Planet, Setting, frame, mapped, options, setting, timed_table

CONTRASTS = (3e-7, 1e-6, 1e-5, 1e-4)
SEPARATIONS = (0.3, 0.6, 1.0, 1.6, 2.3)
HOURS = 40.0
LIMIT = 0.0
"""In place of a contrast: the 5-sigma limit."""


def one_frame(setup: Setting, contrast: float, separation: float, seed: int) -> Table:
    """One row of the table."""
    setup = setup.redrawn(seed)
    angle = float(np.random.default_rng(1000 + seed).uniform(0, 360))
    limit = contrast == LIMIT
    if limit:
        # The limit at that very place, from a frame without a planet.
        empty = dr.refine(setup.model, frame(setup, HOURS, 5000 + seed).observation, setup.measured)
        place = Planet(0.0, separation, angle).offset
        contrast = 5 * float(dr.detect(empty).measure([place])["contrast_error"][0])
    planet = Planet(contrast, separation, angle)
    shot = frame(setup, HOURS, seed, [planet])
    fit = dr.refine(setup.model, shot.observation, setup.measured)
    row = dr.detect(fit).measure([planet.offset])[0]
    # What the fit's own residual kept of it, by a matched filter on the true noise.
    weight = shot.planets[0][1] / shot.noise**2
    light = float((weight * shot.planets[0][1]).sum())
    throughput_of = float((weight * fit.frames[0].residual[0]).sum()) / light
    return Table(
        rows=[
            {
                "injected_at_limit": limit,
                "separation": separation,
                "angle": angle,
                "seed": seed,
                "contrast": contrast,
                "measured": float(row["contrast"]),
                "error": float(row["contrast_error"]),
                "photon_error": contrast * light**-0.5,
                "kept_by_subtraction": throughput_of,
                "status": fit.status.name,
            }
        ]
    )


def summary(table: Table) -> Table:
    """Bias and coverage, by contrast and for the planets at the limit."""
    pull = (table["measured"] - table["contrast"]) / table["error"]
    rows = []
    for name, select in [
        *((f"{c:g}", ~table["injected_at_limit"] & (table["contrast"] == c)) for c in CONTRASTS),
        ("5-sigma limit", table["injected_at_limit"]),
        ("all", np.ones(len(table), dtype=bool)),
    ]:
        part, of = table[select], pull[select]
        if not len(part):
            continue
        ratio = part["measured"] / part["contrast"]
        weight = (part["contrast"] / part["error"]) ** 2
        rows.append(
            {
                "contrast": name,
                "frames": len(part),
                "flux_ratio": float(np.average(ratio, weights=weight)),
                "flux_ratio_error": float(weight.sum() ** -0.5),
                "mean_pull": float(of.mean()),
                "pull_deviation": float(of.std()),
                "coverage": float((np.abs(of) < 1).mean()),
                "mean_snr": float((part["measured"] / part["error"]).mean()),
                "kept_by_subtraction": float(np.median(part["kept_by_subtraction"])),
            }
        )
    return Table(rows=rows)


def main() -> None:
    """Run the study."""
    arguments = options(__doc__.splitlines()[0]).parse_args()
    changes = {"npix": 256, "fov_pixels": 48} if arguments.quick else {}
    setup = setting(tuple(arguments.opd) if arguments.opd else None, **changes)
    if arguments.quick:
        cases = [(1e-5, 0.6, 0), (LIMIT, 0.9, 1)]
    else:
        cases = [
            (contrast, separation, seed)
            for seed in range(max(1, arguments.seeds // 4))
            for separation in SEPARATIONS
            for contrast in (*CONTRASTS, LIMIT)
        ]
        # Every frame its own noise.
        cases = [(c, s, 100 * seed + k) for k, (c, s, seed) in enumerate(cases)]
    name = "fluxes_measured" if arguments.opd else "fluxes_generator"
    jobs = [(setup, *case) for case in cases]
    table = timed_table(
        lambda: mapped(one_frame, jobs, arguments.processes), arguments.output / f"{name}.ecsv"
    )
    medians = summary(table)
    for column in medians.colnames[2:]:
        medians[column].info.format = ".3f"
    print("\n".join(medians.pformat(max_lines=-1, max_width=-1)))


if __name__ == "__main__":
    main()
