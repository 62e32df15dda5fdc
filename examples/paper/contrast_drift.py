"""Contrast against drift: subtracted images with their SNR, the paper's figure 7.

    python examples/paper/contrast_drift.py --opd BEFORE AFTER --seeds 10

A planet at 0.6 arcsec, 8e-7 to 4e-6, the OPD map 10 to 80 h old. Images are those of the
first seed; Adam takes a fifth of the seeds.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import Table
from matplotlib.figure import Figure

sys.path.insert(0, str(Path(__file__).parent))
from judging import (
    marginalised,
    median_and_spread,
    methods_in,
    paper_snr,
    pixel,
    select,
    spread,
    star_error,
)
from methods import QUICK, STEPS, Subtracted, all_of, references
from pictures import image_path, show, write_images
from scene import Image, Planet, Setting, frame, mapped, options, setting, timed_table

CONTRASTS = (8e-7, 2e-6, 4e-6)
HOURS = (10.0, 40.0, 80.0)
PLACE = (0.6, 54.0)
HALF = 16
"""Images show so many pixels to each side of the star."""
LIMIT = 6.0
SHOWN = ("initial", "KLIP", "Adam", "Gauss-Newton", "marginalised", "optimal")


def one_frame(setup: Setting, contrast: float, hours: float, steps: int, seed: int) -> Table:
    """One row for each method, with its image (residual over noise) for the first seed."""
    planet = Planet(contrast, *PLACE)
    shot = frame(setup, hours, round(1e8 * contrast) + round(hours) + 1000 * seed, [planet])
    subtracted = all_of(setup, shot, references(setup, hours, seed), steps)
    fit = subtracted["Gauss-Newton"].fit
    assert fit is not None
    row_of_planet, image = marginalised(setup, shot, fit)
    subtracted["marginalised"] = Subtracted(image, row_of_planet["seconds"])
    x, y = (round(c) for c in pixel(setup, (0.0, 0.0)))
    window = (slice(y - HALF, y + HALF), slice(x - HALF, x + HALF))
    rows: list[dict[str, Any]] = []
    for name, result in subtracted.items():
        image = (result.image / shot.noise)[window]
        rows.append(
            {
                "contrast": contrast,
                "hours": hours,
                "seed": seed,
                "method": name,
                "annulus_snr": paper_snr(setup, result.image, planet),
                "star_error": star_error(setup, shot, result.image),
                "marginalised_snr": row_of_planet["matched_snr"],
                "marginalised_throughput": row_of_planet["throughput"],
                "image": np.nan_to_num(image) if seed == 0 else np.zeros_like(image),
            }
        )
    return Table(rows=rows)


def pictures(table: Table) -> dict[str, Image]:
    """Images of the first seed, by name."""
    first = select(table, seed=0)
    return {f"{r['contrast']:g} {r['hours']:g} {r['method']}": r["image"] for r in first}


def draw(table: Table, images: dict[str, Image]) -> Figure:
    """A row a contrast, a group of columns a drift."""
    contrasts, hours = np.unique(table["contrast"]), np.unique(table["hours"])
    count = len(SHOWN)
    figure = Figure(
        figsize=(1.35 * count * len(hours), 1.75 * len(contrasts)), layout="constrained"
    )
    panels = figure.subplots(len(contrasts), count * len(hours), squeeze=False)
    for i, contrast in enumerate(contrasts):
        for j, hour in enumerate(hours):
            part = select(table, contrast=contrast, hours=hour)
            for k, name in enumerate(SHOWN):
                ax = panels[i, j * count + k]
                subset = select(part, method=name)
                if not len(subset):
                    ax.set_axis_off()
                    continue
                text = f"{name}\nSNR {spread(subset['annulus_snr'])[0]:.1f}"
                show(ax, images[f"{contrast:g} {hour:g} {name}"], text, LIMIT)
                if k == 0:
                    ax.set_ylabel(f"{contrast:.0e}, {hour:g} h", fontsize=8)
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
        jobs = [(setup, 2e-6, 40.0, 200, 0)]
    else:
        jobs = [
            (setup, contrast, hours, STEPS if seed < (arguments.seeds + 4) // 5 else 0, seed)
            for seed in range(arguments.seeds)
            for contrast in CONTRASTS
            for hours in HOURS
        ]
    name = "contrast_drift_measured" if arguments.opd else "contrast_drift_generator"
    path = arguments.output / f"{name}.ecsv"

    def work() -> Table:
        table = mapped(one_frame, jobs, arguments.processes)
        write_images(image_path(path), pictures(table), LIMIT)
        table.remove_column("image")
        return table

    table = timed_table(work, path)
    for contrast in np.unique(table["contrast"]):
        for hours in np.unique(table["hours"]):
            part = select(table, contrast=contrast, hours=hours)
            print(f"{contrast:.0e}, {hours:g} h, annulus SNR:")
            for method in methods_in(part):
                snr = median_and_spread(select(part, method=method)["annulus_snr"])
                print(f"  {method:13s} {snr}")
            print(f"  marginalised S/N {median_and_spread(part['marginalised_snr'])}")


if __name__ == "__main__":
    main()
