"""SNR against contrast, drift and separation: the paper's figures of its appendix.

    python examples/paper/snr_grid.py --opd BEFORE AFTER --seeds 10

One of the three quantities varies at a time, about a planet of 1e-6 at 0.6 arcsec and an OPD
map that is 40 h old. Throughput compares with the same frame without the planet. Adam is run for a
fifth of the seeds.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import Table
from matplotlib.figure import Figure

sys.path.insert(0, str(Path(__file__).parent))
from judging import COLOURS, judge, methods_in, photon_snr, select, spread
from methods import QUICK, STEPS, all_of, references, with_planets
from scene import Planet, Setting, frame, mapped, options, setting, timed_table

ANGLE = 54.0
CENTRE = {"contrast": 1e-6, "hours": 40.0, "separation": 0.6}
AXES = {
    "contrast": (3e-7, 1e-6, 3e-6, 1e-5),
    "hours": (3.0, 40.0, 86.0),
    "separation": (0.3, 0.6, 1.0, 2.0),
}
UNITS = {"contrast": "contrast", "hours": "drift, h", "separation": "separation, arcsec"}


def points() -> list[dict[str, float]]:
    """All settings, each once."""
    points_of_axes = [{**CENTRE, axis: value} for axis, values in AXES.items() for value in values]
    return [point for k, point in enumerate(points_of_axes) if point not in points_of_axes[:k]]


def one_seed(setup: Setting, chosen_points: list[dict[str, float]], steps: int, seed: int) -> Table:
    """One row for each point and method."""
    rows: list[dict[str, Any]] = []
    for hours in dict.fromkeys(point["hours"] for point in chosen_points):
        shot = frame(setup, hours, seed)
        frames = references(setup, hours, seed)
        empty = all_of(setup, shot, frames, steps)
        for point in chosen_points:
            if point["hours"] == hours:
                planet = Planet(point["contrast"], point["separation"], ANGLE)
                with_planet = with_planets(setup, shot, [planet], seed)
                facts = {**point, "seed": seed, "photon_snr": photon_snr(with_planet)}
                subtracted = all_of(setup, with_planet, frames, steps)
                rows += [{**facts, **row} for row in judge(setup, with_planet, subtracted, empty)]
    return Table(rows=rows)


def along(table: Table, axis: str) -> Table:
    """Rows in which only this quantity varies."""
    others = {name: value for name, value in CENTRE.items() if name != axis}
    return select(table, **others)


def draw(table: Table) -> Figure:
    """Annulus SNR above, matched filters in the middle, throughput below."""
    figure = Figure(figsize=(13, 9), layout="constrained")
    panels = figure.subplots(3, 3)
    for column, axis in enumerate(AXES):
        part = along(table, axis)
        values = np.unique(part[axis])
        for ax, quantity in zip(
            panels[:, column], ("annulus_snr", "matched_snr", "throughput"), strict=True
        ):
            for name in methods_in(part):
                subset = select(part, method=name)
                spreads = [spread(select(subset, **{axis: v})[quantity]) for v in values]
                middle, low, high = np.transpose(spreads)
                ax.plot(values, middle, ".-", color=COLOURS[name], label=name)
                ax.fill_between(values, low, high, color=COLOURS[name], alpha=0.15, lw=0)
            ax.set_xlabel(UNITS[axis], fontsize=9)
            if axis == "contrast":
                ax.set_xscale("log")
            if quantity == "matched_snr":
                ax.set_yscale("symlog", linthresh=5)
            if quantity == "throughput":
                ax.set_ylim(0, 1.5)
    for ax, label in zip(
        panels[:, 0], ("annulus SNR", "matched-filter S/N", "planet's light kept"), strict=True
    ):
        ax.set_ylabel(label, fontsize=9)
    panels[2, 0].legend(frameon=False, fontsize=7, loc="lower right")
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
        jobs = [(setup, points()[1:2], 200, 0)]
    else:
        jobs = [
            (setup, points(), STEPS if seed < (arguments.seeds + 4) // 5 else 0, seed)
            for seed in range(arguments.seeds)
        ]
    name = "snr_grid_measured" if arguments.opd else "snr_grid_generator"
    table = timed_table(
        lambda: mapped(one_seed, jobs, arguments.processes), arguments.output / f"{name}.ecsv"
    )
    for point in jobs[0][1]:
        part = select(table, **point)
        print(", ".join(f"{name} {value:g}" for name, value in point.items()))
        for method in methods_in(part):
            subset = select(part, method=method)
            print(
                f"  {method:13s} annulus SNR {spread(subset['annulus_snr'])[0]:6.2f}, matched "
                f"{spread(subset['matched_snr'])[0]:6.2f}, "
                f"throughput {spread(subset['throughput'])[0]:.2f}"
            )


if __name__ == "__main__":
    main()
