"""The paper's comparison with KLIP: six planets, every method on the same frames.

    python examples/paper/klip_table.py --opd BEFORE AFTER --seeds 10

The OPD map is 40 h old. KLIP has nine dithered frames of alpha Pictoris taken 3 h after the
target, 10 mas off (9 modes, 5 annuli, 4 subsections), and, in a second column, a library of 50
frames (30 modes). Throughput compares each subtraction with that of the same frame without the
planet. Adam takes half the seeds.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import Table
from matplotlib.figure import Figure

sys.path.insert(0, str(Path(__file__).parent))
import published
from judging import COLOURS, judge, median_and_spread, methods_in, photon_snr, select, spread
from methods import LIBRARY, QUICK, STEPS, all_of, library, references, with_planets
from scene import Planet, Setting, frame, mapped, options, setting, timed_table

HOURS = 40.0
ANGLE = 54.0
CASES = tuple(published.TABLE)
"""Separation and contrast; the first three rows are one panel, the last three the other."""


def one_seed(setup: Setting, cases: tuple[Any, ...], steps: int, count: int, seed: int) -> Table:
    """One row for each planet and method."""
    shot = frame(setup, HOURS, seed)
    nine, archive = references(setup, HOURS, seed), library(setup, HOURS, seed, count)

    empty = all_of(setup, shot, nine, steps, archive)
    rows = []
    for separation, contrast in cases:
        with_planet = with_planets(setup, shot, [Planet(contrast, separation, ANGLE)], seed)
        subtracted = all_of(setup, with_planet, nine, steps, archive)
        facts = {
            "separation": separation,
            "contrast": contrast,
            "seed": seed,
            "photon_snr": photon_snr(with_planet),
        }
        rows += [{**facts, **row} for row in judge(setup, with_planet, subtracted, empty)]
    return Table(rows=rows)


def draw(table: Table) -> Figure:
    """Annulus SNR and matched-filter S/N, relative to the known star's."""
    figure = Figure(figsize=(13, 4.6), layout="constrained")
    panels = figure.subplots(1, 3)
    cases = [case for case in CASES if len(select(table, separation=case[0], contrast=case[1]))]
    names = methods_in(table)
    titles = {
        "annulus_snr": "Annulus SNR (the paper's)",
        "matched_snr": "Matched-filter S/N",
        "throughput": "Planet's light kept",
    }
    for ax, (column, title) in zip(panels, titles.items(), strict=True):
        for k, name in enumerate(names):
            spreads = [
                spread(select(table, separation=s, contrast=c, method=name)[column])
                for s, c in cases
            ]
            middle, low, high = np.transpose(spreads)
            place = np.arange(len(cases)) + 0.1 * (k - len(names) / 2)
            ax.errorbar(
                place, middle, np.stack([middle - low, high - middle]), fmt="o", ms=4, lw=1,
                color=COLOURS[name], label=name,
            )  # fmt: skip
        ax.set_title(title, fontsize=10, loc="left")
        ax.set_xticks(range(len(cases)), [f'{s:g}"\n{c:.0e}' for s, c in cases], fontsize=8)
    panels[0].axhline(5, color="0.7", lw=0.8, zorder=0)
    panels[1].set_yscale("symlog", linthresh=5)
    panels[2].axhline(1, color="0.7", lw=0.8, zorder=0)
    panels[2].set_ylim(0, 1.5)
    panels[1].legend(frameon=False, fontsize=7, ncols=2)
    return figure


def lines(table: Table, column: str, form: str) -> list[list[str]]:
    """Rows of the page's table: case, then the spread of every method."""
    rows = []
    for separation, contrast in CASES:
        case = select(table, separation=separation, contrast=contrast)
        if len(case):
            cells = [
                median_and_spread(select(case, method=m)[column], form) for m in methods_in(table)
            ]
            rows.append([f"{separation:g} arcsec, {contrast:.0e}", *cells])
    return rows


def main() -> None:
    """Run the study."""
    parser = options(__doc__.splitlines()[0])
    parser.set_defaults(seeds=10)
    arguments = parser.parse_args()
    changes = QUICK if arguments.quick else {}
    setup = setting(tuple(arguments.opd) if arguments.opd else None, **changes)
    if arguments.quick:
        jobs = [(setup, CASES[:1], 200, 10, 0)]
    else:
        jobs = [
            (setup, CASES, STEPS if seed < (arguments.seeds + 1) // 2 else 0, LIBRARY, seed)
            for seed in range(arguments.seeds)
        ]
    name = "klip_table_measured" if arguments.opd else "klip_table_generator"
    table = timed_table(
        lambda: mapped(one_seed, jobs, arguments.processes), arguments.output / f"{name}.ecsv"
    )
    for column in ("annulus_snr", "matched_snr", "throughput", "star_error"):
        print(column, *methods_in(table), sep=" | ")
        for row in lines(table, column, ".2f"):
            print("  ", *row, sep=" | ")
    won = select(table, method="marginalised")
    print(f"marginalised / photon limit: {spread(won['matched_snr'] / won['photon_snr'])}")


if __name__ == "__main__":
    main()
