"""Detected and true positions: the paper's experiment on the location of the planet.

    python examples/paper/location.py --opd BEFORE AFTER --seeds 10

A planet of 2e-6, 0.4 to 2.2 arcsec from the star, at an angle that changes from seed to seed, the
OPD map 40 h old. The search is blind: the measured position is that of the nearest candidate.
Adam takes a fifth of the seeds.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import Table
from matplotlib.figure import Figure

import pyklip_diffrender as dr

sys.path.insert(0, str(Path(__file__).parent))
from judging import COLOURS, paper_snr, photon_snr, select, spread
from methods import QUICK, STEPS, all_of, references
from scene import Planet, Setting, frame, mapped, options, setting, timed_table

HOURS = 40.0
CONTRAST = 2e-6
SEPARATIONS = (0.4, 0.6, 1.0, 1.6, 2.2)
NEAR = 0.15
"""A candidate farther from the planet than this is another one, arcsec."""
SNRS = ("initial", "KLIP", "Adam", "Gauss-Newton", "optimal")


def one_frame(setup: Setting, separation: float, steps: int, seed: int) -> Table:
    """One row of the table."""
    place = round(1000 * separation)
    angle = float(np.random.default_rng([seed, place]).uniform(0, 360))
    planet = Planet(CONTRAST, separation, angle)
    shot = frame(setup, HOURS, 10 * place + seed, [planet])
    subtracted = all_of(setup, shot, references(setup, HOURS, seed), steps)
    fit = subtracted["Gauss-Newton"].fit
    assert fit is not None
    table = dr.detect(fit).candidates
    row: dict[str, Any] = {
        "separation": separation,
        "angle": angle,
        "seed": seed,
        "x": planet.offset[0],
        "y": planet.offset[1],
        "found": False,
        "false_candidates": len(table),
        "photon_snr": photon_snr(shot),
    }
    row |= dict.fromkeys(("x_found", "y_found", "x_error", "y_error", "snr", "flux_ratio"), np.nan)
    if len(table):
        distance_to = np.hypot(table["x"].value - row["x"], table["y"].value - row["y"])
        best = table[int(np.argmin(distance_to))]
        if distance_to.min() < NEAR:
            row |= {
                "found": True,
                "false_candidates": len(table) - 1,
                "x_found": float(best["x"].value),
                "y_found": float(best["y"].value),
                "x_error": float(best["x_error"].value),
                "y_error": float(best["y_error"].value),
                "snr": float(best["snr"]),
                "flux_ratio": float(best["contrast"]) / CONTRAST,
            }
    for name in SNRS:
        row[f"snr_{name}"] = (
            paper_snr(setup, subtracted[name].image, planet) if name in subtracted else np.nan
        )
    return Table(rows=[row])


def distance(table: Table) -> np.ndarray:
    """Distance of the detected from the true positions, mas."""
    return 1e3 * np.hypot(table["x_found"] - table["x"], table["y_found"] - table["y"])


def draw(table: Table) -> Figure:
    """Map of positions, distances, annulus SNR."""
    figure = Figure(figsize=(14, 4.6), layout="constrained")
    field, middle, right = figure.subplots(1, 3)
    field.plot(table["x"], table["y"], "o", mfc="none", color="0.5", ms=9, label="true")
    field.plot(table["x_found"], table["y_found"], "+", color=COLOURS["marginalised"],
               label="found")  # fmt: skip
    field.plot(0, 0, "*", color="k")
    field.set_aspect("equal")
    field.set_title("Positions, arcsec", fontsize=10, loc="left")
    field.legend(frameon=False, fontsize=8)
    places = np.unique(table["separation"])
    middle.semilogy(table["separation"], distance(table), ".", color=COLOURS["marginalised"])
    expected = [
        1e3 * np.nanmedian(np.hypot(part["x_error"], part["y_error"]))
        for part in (select(table, separation=place) for place in places)
    ]
    middle.semilogy(places, expected, "-", color="0.5", label="expected, 1 sigma")
    middle.set_title("Found position from the true one, mas", fontsize=10, loc="left")
    middle.legend(frameon=False, fontsize=8)
    for name in SNRS:
        spreads = [spread(select(table, separation=p)[f"snr_{name}"]) for p in places]
        values, low, high = np.transpose(spreads)
        right.plot(places, values, ".-", color=COLOURS[name], label=name)
        right.fill_between(places, low, high, color=COLOURS[name], alpha=0.15, lw=0)
    right.set_title("Annulus SNR", fontsize=10, loc="left")
    right.legend(frameon=False, fontsize=7)
    for ax in (middle, right):
        ax.set_xlabel("arcsec", fontsize=9)
    return figure


def main() -> None:
    """Run the study."""
    parser = options(__doc__.splitlines()[0])
    parser.set_defaults(seeds=10)
    arguments = parser.parse_args()
    setup = setting(
        tuple(arguments.opd) if arguments.opd else None, **(QUICK if arguments.quick else {})
    )
    if arguments.quick:
        jobs = [(setup, 0.8, 200, 0)]
    else:
        jobs = [
            (setup, separation, STEPS if seed < (arguments.seeds + 4) // 5 else 0, seed)
            for seed in range(arguments.seeds)
            for separation in SEPARATIONS
        ]
    name = "location_measured" if arguments.opd else "location_generator"
    table = timed_table(
        lambda: mapped(one_frame, jobs, arguments.processes), arguments.output / f"{name}.ecsv"
    )
    for separation in np.unique(table["separation"]):
        part = select(table, separation=separation)
        detected = part[part["found"]]
        pulls = np.concatenate(
            [(detected[f"{c}_found"] - detected[c]) / detected[f"{c}_error"] for c in ("x", "y")]
        )
        root = math.sqrt(np.mean(pulls**2)) if len(pulls) else math.nan
        print(
            f"{separation:.1f} arcsec: {len(detected)} of {len(part)} found, "
            f"{spread(distance(part))[0]:.2f} mas off, rms pull {root:.2f}, flux "
            f"{spread(part['flux_ratio'])[0]:.3f}, S/N {spread(part['snr'])[0]:.1f} of "
            f"{spread(part['photon_snr'])[0]:.1f}, {int(part['false_candidates'].max())} false"
        )


if __name__ == "__main__":
    main()
