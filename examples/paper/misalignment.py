"""A misaligned Lyot stop, shifted and rotated: the paper's figure 12.

    python examples/paper/misalignment.py --opd BEFORE AFTER --seeds 10

A planet of 5e-6 at 0.6 arcsec, the OPD map 40 h old, the stop shifted in x or y by up to 2 %
of the pupil, or turned by up to 2 degrees. PSNR over the 11 x 11 pixels about the planet, against
the planet's expected image: by the paper's recipe and by Gauss-Newton with the stop held where it
is not, and by Gauss-Newton with the alignment fitted (the default), as well as with the true star.
Held, Gauss-Newton would go on for long: it gets 20 iterations and modes to 24 cycles, and, as
Adam, a fifth of the seeds.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from astropy.table import Table
from matplotlib.figure import Figure

import pyklip_diffrender as dr

sys.path.insert(0, str(Path(__file__).parent))
from judging import COLOURS, pixel, psnr, select, spread, star_error
from methods import (
    QUICK,
    STEPS,
    Subtracted,
    adam,
    gauss_newton,
    initial,
    optimal,
    with_planets,
)
from scene import Frame, Planet, Scene, Setting, mapped, options, setting, star_photons, timed_table

HOURS = 40.0
PLANET = Planet(5e-6, 0.6, 54.0)
AMOUNTS = {
    "shift in x, %": (1.0, 2.0),
    "shift in y, %": (1.0, 2.0),
    "rotation, deg": (1.0, 2.0),
}
HELD = ("star_offset", "flux", "background")
"""Free parameters of Gauss-Newton if the stop is held."""
HELD_FIT = {"max_iterations": 20, "cycles": (24.0,)}
QUICK_FIT = {"max_iterations": 8, "cycles": (24.0,)}
"""Settings of the small version."""
STYLES = {
    "initial": (COLOURS["initial"], ":"),
    "Adam, held": (COLOURS["Adam"], "-"),
    "Gauss-Newton, held": (COLOURS["Gauss-Newton"], ":"),
    "Gauss-Newton, fitted": (COLOURS["Gauss-Newton"], "-"),
    "optimal": (COLOURS["optimal"], "--"),
}


def stop(axis: str, amount: float) -> dict[str, Any]:
    """Values of the model's parameters."""
    if axis == "rotation, deg":
        return {"lyot_rotation": amount}
    return {"lyot_shift": (amount / 100, 0.0) if axis == "shift in x, %" else (0.0, amount / 100)}


class Moved:
    """A model with its Lyot stop elsewhere."""

    def __init__(self, model: dr.OpticalSystem, values: dict[str, Any]) -> None:
        self.model, self.values = model, values
        self.detector, self.recipe, self.npix = model.detector, model.recipe, model.npix

    def __call__(self, opd: Any, offset: Any = (0.0, 0.0)) -> torch.Tensor:
        """Image of a point source."""
        return self.model(opd, offset, **self.values)


def observed(setup: Setting, values: dict[str, Any], seed: int) -> Frame:
    """A frame through the moved stop."""
    model: Any = Moved(setup.model, values)
    moved = replace(setup, model=model)
    opd = setup.drifted(HOURS)
    star = star_photons(model, Scene(), opd)
    noise = np.sqrt(star + Scene().read_noise ** 2)
    rng = np.random.default_rng(seed)
    counts = rng.poisson(star) + rng.normal(0, Scene().read_noise, star.shape)
    bare = dr.Observation.from_arrays(counts, noise, pixelscale=setup.model.detector.pixelscale)
    return with_planets(moved, Frame(bare, star, noise, (), opd), [PLANET], seed)


def one_frame(
    setup: Setting,
    axis: str,
    amount: float,
    steps: int,
    held: bool,
    seed: int,
    limits: dict[str, Any],
) -> Table:
    """One row for each method."""
    shot = observed(setup, stop(axis, amount), seed)
    fitted = gauss_newton(setup, shot, **limits)
    subtracted: dict[str, Subtracted] = {
        "initial": initial(setup, shot),
        "Gauss-Newton, fitted": fitted,
        "optimal": optimal(shot),
    }
    if held:
        subtracted["Gauss-Newton, held"] = gauss_newton(
            setup, shot, free=HELD, **(limits or HELD_FIT)
        )
    if steps:
        subtracted["Adam, held"] = adam(setup, shot, steps)
    assert fitted.fit is not None
    planet = dr.detect(fitted.fit).measure([PLANET.offset])[0]
    rows = []
    for name, result in subtracted.items():
        rows.append(
            {
                "axis": axis,
                "amount": amount,
                "seed": seed,
                "method": name,
                "psnr": psnr(result.image, shot.planets[0][1], pixel(setup, PLANET.offset)),
                "star_error": star_error(setup, shot, result.image),
                "marginalised_snr": float(planet["snr"]),
                "marginalised_throughput": float(planet["contrast"]) / PLANET.contrast,
                "seconds": result.seconds,
            }
        )
    return Table(rows=rows)


def draw(table: Table) -> Figure:
    """PSNR against each misalignment; none at all is in all panels."""
    figure = Figure(figsize=(13, 4.2), layout="constrained")
    panels = figure.subplots(1, 3, sharey=True)
    for ax, axis in zip(panels, AMOUNTS, strict=True):
        part = table[(table["axis"] == axis) | (table["amount"] == 0)]
        for name, (colour, style) in STYLES.items():
            subset = select(part, method=name)
            amounts = np.unique(subset["amount"])
            if not len(amounts):
                continue
            spreads = [spread(select(subset, amount=amount)["psnr"]) for amount in amounts]
            middle, low, high = np.transpose(spreads)
            ax.plot(amounts, middle, style, marker=".", color=colour, label=name)
            ax.fill_between(amounts, low, high, color=colour, alpha=0.15, lw=0)
        ax.set_xlabel(f"{axis}", fontsize=9)
    panels[0].set_ylabel("PSNR about the planet, dB", fontsize=9)
    panels[0].legend(frameon=False, fontsize=7)
    return figure


def main() -> None:
    """Run the study."""
    parser = options(__doc__.splitlines()[0])
    parser.set_defaults(seeds=10)
    arguments = parser.parse_args()
    setup = setting(
        tuple(arguments.opd) if arguments.opd else None, **(QUICK if arguments.quick else {})
    )
    cases = [
        ("rotation, deg", 0.0),
        *((axis, a) for axis, amounts in AMOUNTS.items() for a in amounts),
    ]
    if arguments.quick:
        jobs = [(setup, "shift in x, %", 0.2, 200, True, 0, QUICK_FIT)]
    else:
        adam_seeds = (arguments.seeds + 4) // 5
        jobs = [
            (setup, axis, amount, STEPS if seed < adam_seeds else 0, seed < adam_seeds, seed, {})
            for seed in range(arguments.seeds)
            for axis, amount in cases
        ]
    name = "misalignment_measured" if arguments.opd else "misalignment_generator"
    table = timed_table(
        lambda: mapped(one_frame, jobs, arguments.processes), arguments.output / f"{name}.ecsv"
    )
    for axis, amount in dict.fromkeys((job[1], job[2]) for job in jobs):
        part = select(table, axis=axis, amount=amount)
        print(f"{axis} {amount:g}:")
        for method in STYLES:
            subset = select(part, method=method)
            if len(subset):
                decibel, error = (
                    spread(subset["psnr"])[0],
                    spread(subset["star_error"])[0],
                )
                print(f"  {method:20s} PSNR {decibel:6.1f} dB, star error {error:.2f} sigma")
        print(f"  marginalised S/N {spread(part['marginalised_snr'])[0]:.1f}")


if __name__ == "__main__":
    main()
