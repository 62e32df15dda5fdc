"""What a plan saves, and what it changes, from a bright star to a faint one.

    python -m benchmarks.planning

Every frame (embedded generator, the wavefront map 40 h old) is fitted with the model as given, with
a plan of its own, and with that plan once more, on one core; the star that is found and the planet
that is measured are compared. Prints the table of docs/planning.md.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

import pyklip_diffrender as dr
from benchmarks.provenance import provenance
from pyklip_diffrender.instrument.nircam import nircam_coronagraph
from pyklip_diffrender.refinement import Refinement
from pyklip_diffrender.scene.objects import PAPER_SEGMENT_GAP, Planet, Scene, Star
from pyklip_diffrender.scene.simulation import simulate, star_photons
from pyklip_diffrender.wavefront.opd import random_drift, random_opd

SEEDS = (1, 2)
ONE = {"monochromatic": 4.5e-6}
TEN = {"monochromatic": None, "nlambda": 10}


@dataclass(frozen=True)
class Case:
    """A star, fainter than the paper's by a factor, and its planet."""

    name: str
    fainter: float
    contrast: float
    pixels: int
    spectrum: dict[str, Any]
    seeds: tuple[int, ...] = SEEDS


CASES = (
    Case("the paper's star, 80 x 80 pixels", 1.0, 1e-6, 80, ONE),
    Case("5 magnitudes fainter, 32 x 32", 1e2, 1e-5, 32, ONE),
    Case("7.5 magnitudes fainter, 32 x 32", 1e3, 5e-5, 32, ONE),
    Case("10 magnitudes fainter, 32 x 32", 1e4, 3e-4, 32, ONE),
    Case("5 magnitudes fainter, 10 wavelengths", 1e2, 1e-5, 32, TEN, SEEDS[:1]),
    Case("10 magnitudes fainter, 10 wavelengths", 1e4, 3e-4, 32, TEN, SEEDS[:1]),
)


def timed(function: Callable[[], Refinement]) -> tuple[Refinement, float]:
    """The result and the processor's seconds."""
    began = time.process_time()
    result = function()
    return result, time.process_time() - began


def row(case: Case, seed: int) -> str:
    """A row of the table, in Markdown."""
    model = nircam_coronagraph(
        "F444W", fov_pixels=case.pixels, segment_gap=PAPER_SEGMENT_GAP, **case.spectrum
    )
    planet = Planet(case.contrast, 0.6, 54.0)
    star = Star(exposure=Star().exposure / case.fainter)
    scene = Scene(star=star, planets=(planet,))
    measured = random_opd(seed).data
    opd = measured + random_drift(seed + 1000, 40.0).data
    observation = simulate(model, scene, opd, seed=seed)
    star = star_photons(model, replace(scene, planets=()), opd)
    noise = np.sqrt(star + scene.background + scene.read_noise**2)

    full, slow = timed(lambda: dr.refine(model, observation, measured, plan="off"))
    planned, fast = timed(lambda: dr.refine(model, observation, measured))
    assert planned.plan is not None
    _, reused = timed(lambda: dr.refine(model, observation, measured, plan=planned.plan))
    frames = [fit.frames[0] for fit in (full, planned)]
    stars = [frame.star - float(frame.values["background"][0]) for frame in frames]
    errors = [float(np.sqrt(np.mean(((image - star) / noise) ** 2))) for image in stars]
    difference = float(np.sqrt(np.mean(((stars[1] - stars[0]) / noise) ** 2)))
    measured_planets = [dr.measure(fit, [planet.offset])[0] for fit in (full, planned)]
    moved = (measured_planets[1]["contrast"] - measured_planets[0]["contrast"]) / measured_planets[
        0
    ]["contrast_error"]
    choice = planned.plan.choice
    grid = f"{choice.npix}{' for differences' if choice.multifidelity else ''}"
    cells = (
        f"{case.name}, seed {seed}",
        f"{choice.cycles:g} cycles, {grid}, {choice.wavelengths} wavelengths",
        f"{slow:.1f}",
        f"{fast:.1f} ({slow / fast:.1f})",
        f"{reused:.1f} ({slow / reused:.1f})",
        f"{errors[0]:.3f}",
        f"{errors[1]:.3f}",
        f"{difference:.3f}",
        f"{moved:+.2f}",
        f"{measured_planets[0]['snr']:.2f}",
        f"{measured_planets[1]['snr']:.2f}",
    )
    return "| " + " | ".join(cells) + " |"


def main() -> None:
    """Print the table."""
    torch.set_num_threads(1)
    header = (
        "star", "plan", "as given, s", "planned, s (times faster)", "plan reused, s",
        "star error, as given", "planned", "between the two", "planet's contrast moved by",
        "S/N, as given", "planned",
    )  # fmt: skip
    print("| " + " | ".join(header) + " |")
    print("|" + "---|" * len(header))
    for case in CASES:
        for seed in case.seeds:
            print(row(case, seed), flush=True)  # As they come: the whole takes minutes.
    print()
    print("\n".join(provenance("-m benchmarks.planning", packages=())))


if __name__ == "__main__":
    main()
