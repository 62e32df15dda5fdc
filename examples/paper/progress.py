"""How the optimisation goes, and the estimated wavefront against the true one.

    python examples/paper/progress.py --opd BEFORE AFTER --seeds 10

A planet of 1e-6 at 0.6 arcsec, the OPD map 80 h old. After some steps of the paper's recipe
and of Gauss-Newton: the annulus SNR, the star-model error, and how much of the wavefront's true
change the estimate has: rms of what is left over the rms of the change, inside the Lyot stop's
openings, piston aside. Adam takes a fifth of the seeds. Maps are those of the first seed.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import Table
from matplotlib.figure import Figure

from pyklip_diffrender.instrument.masks import lyot_openings
from pyklip_diffrender.optics.grid import PupilGrid, polygon_coverage
from pyklip_diffrender.wavefront.opd import resample

sys.path.insert(0, str(Path(__file__).parent))
from judging import COLOURS, paper_snr, select, spread, star_error
from methods import QUICK, STEPS, Subtracted, adam, gauss_newton, initial
from pictures import image_path, show, write_images
from scene import Frame, Image, Planet, Setting, frame, mapped, options, setting, timed_table

PLANET = Planet(1e-6, 0.6, 54.0)
HOURS = 80.0
ADAM_STEPS = (1, 10, 30, 100, 300, STEPS)
NEWTON_STEPS = (2, 3, 5, 8, 40)
"""The last one is the limit: it stops by itself before."""
SAMPLES = 128
"""Of the maps."""
LIMIT = 20.0
"""nm."""


def seen_change(setup: Setting, opd: Image) -> Image:
    """Change since the map, nm, coarse, NaN outside the Lyot stop's openings, mean 0."""
    grid = PupilGrid.full(SAMPLES, setup.model.diameter)
    stop = polygon_coverage(lyot_openings("MASKRND"), grid).numpy() > 0.5
    change = 1e9 * (resample(opd, SAMPLES) - resample(setup.measured, SAMPLES))
    return np.where(stop, change - change[stop].mean(), np.nan)


def judge(setup: Setting, shot: Frame, step: Subtracted, wavefront: Image) -> dict[str, Any]:
    """Numbers of one stage."""
    true_change = seen_change(setup, shot.opd)
    fitted_change = seen_change(setup, wavefront)
    return {
        "annulus_snr": paper_snr(setup, step.image, PLANET),
        "star_error": star_error(setup, shot, step.image),
        "opd_left": float(np.nanstd(true_change - fitted_change) / np.nanstd(true_change)),
        "opd_change_nm": float(np.nanstd(true_change)),
        "seconds": step.seconds,
    }


def one_seed(setup: Setting, counts: tuple[int, ...], steps: tuple[int, ...], seed: int) -> Table:
    """One row for each stage."""
    shot = frame(setup, HOURS, seed, [PLANET])
    began = time.perf_counter()
    start = judge(setup, shot, initial(setup, shot), setup.measured)
    maps = {"true": seen_change(setup, shot.opd)}
    rows = [
        {"method": method, "step": 0, "seed": seed, **start} for method in ("Adam", "Gauss-Newton")
    ]
    stages = [("Gauss-Newton", n) for n in counts] + [("Adam", n) for n in steps]
    for method, count in stages:
        if method == "Adam":
            subtracted, steps_done = adam(setup, shot, count), count
            assert subtracted.recipe is not None
            wavefront = subtracted.recipe.wavefront
        else:
            # One basis for all stages: it would grow where the first one is not done.
            subtracted = gauss_newton(setup, shot, max_iterations=count, cycles=(24.0,))
            assert subtracted.fit is not None
            wavefront = np.real(subtracted.fit.wavefront)
            # Those that stop by themselves have fewer.
            steps_done = min(count, len(subtracted.fit.history))
        rows.append(
            {
                "method": method,
                "step": steps_done,
                "seed": seed,
                **judge(setup, shot, subtracted, wavefront),
            }
        )
        maps[method] = seen_change(setup, wavefront)
    table = Table(rows=rows)
    table.meta = {"seconds": time.perf_counter() - began}
    for name in ("true", "Gauss-Newton", "Adam"):
        blank = np.zeros((SAMPLES, SAMPLES))
        image = np.nan_to_num(maps[name]) if seed == 0 and name in maps else blank
        table[f"map {name}"] = np.broadcast_to(image, (len(table), SAMPLES, SAMPLES)).copy()
    return table


def draw(table: Table, images: dict[str, Image]) -> Figure:
    """Error against steps and against seconds; maps of the wavefront's change."""
    figure = Figure(figsize=(14, 7), layout="constrained")
    panels = figure.subplots(2, 3)
    for ax, column, title in zip(
        panels[0],
        ("star_error", "annulus_snr", "opd_left"),
        ("Star-model error, sigma", "Annulus SNR of the planet", "Wavefront change not found"),
        strict=True,
    ):
        for name in ("Adam", "Gauss-Newton"):
            subset = select(table, method=name)
            steps = np.unique(subset["step"])
            if not len(steps):
                continue
            spreads = [spread(select(subset, step=step)[column]) for step in steps]
            middle, low, high = np.transpose(spreads)
            ax.plot(steps, middle, ".-", color=COLOURS[name], label=name)
            ax.fill_between(steps, low, high, color=COLOURS[name], alpha=0.15, lw=0)
        ax.set_xscale("symlog", linthresh=1)
        ax.set_title(title, fontsize=10, loc="left")
        ax.set_xlabel("steps", fontsize=9)
    panels[0, 0].set_yscale("log")
    panels[0, 0].legend(frameon=False, fontsize=8)
    titles = {"true": "True change of the wavefront", "Adam": "found by Adam",
              "Gauss-Newton": "found by Gauss-Newton"}  # fmt: skip
    for ax, (name, title) in zip(panels[1], titles.items(), strict=True):
        if name in images:
            show(ax, images[name], f"{title}, +-{LIMIT:.0f} nm", LIMIT, "PuOr_r")
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
        jobs = [(setup, (2, 5), (30, 200), 0)]
    else:
        jobs = [
            (setup, NEWTON_STEPS, ADAM_STEPS if seed < (arguments.seeds + 4) // 5 else (), seed)
            for seed in range(arguments.seeds)
        ]
    name = "progress_measured" if arguments.opd else "progress_generator"
    path = arguments.output / f"{name}.ecsv"

    def work() -> Table:
        table = mapped(one_seed, jobs, arguments.processes)
        maps = {n.removeprefix("map "): table[n][0] for n in table.colnames if n[:4] == "map "}
        write_images(image_path(path), maps, LIMIT)
        table.remove_columns([f"map {name}" for name in maps])
        return table

    table = timed_table(work, path)
    for method in ("Adam", "Gauss-Newton"):
        subset = select(table, method=method)
        for step in np.unique(subset["step"]):
            part = select(subset, step=step)
            print(
                f"{method:13s} {step:5d} steps: star error {spread(part['star_error'])[0]:7.2f}, "
                f"annulus SNR {spread(part['annulus_snr'])[0]:6.2f}, change not found "
                f"{spread(part['opd_left'])[0]:.2f}, {spread(part['seconds'])[0]:.1f} s"
            )


if __name__ == "__main__":
    main()
