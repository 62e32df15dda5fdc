"""Two, three and four planets, one of contrast 1e-3, and a ring: what is kept of their light.

    python examples/paper/companions.py --opd BEFORE AFTER --seeds 20

Nothing is told about how many there are. The wavefront map is 40 h old.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path

import numpy as np
import torch
from astropy.table import Table, vstack
from numpy.typing import NDArray

import pyklip_diffrender as dr
from pyklip_diffrender.scene import Scene, Star
from pyklip_diffrender.simulation import simulate, star_photons

sys.path.insert(0, str(Path(__file__).parent))
from scene import Planet, Setting, frame, mapped, options, setting, timed_table

HOURS = 40.0
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
RING = (0.9, 1.2)
"""Inner and outer radius, arcsec."""
RING_LIGHT = 3e-5
"""Of the whole ring, relative to the star."""


def one_system(here: Setting, name: str, seed: int) -> Table:
    """One row a planet."""
    planets = SYSTEMS[name]
    shot = frame(here, HOURS, seed, planets)
    found = dr.detect(dr.refine(here.model, shot.observation, here.measured))
    table = found.table
    rows = []
    for k, planet in enumerate(planets):
        x, y = planet.offset
        away = np.hypot(table["x"].value - x, table["y"].value - y)
        nearest = int(np.argmin(away)) if len(away) else -1
        seen = nearest >= 0 and away[nearest] < 0.1
        rows.append(
            {
                "scene": name,
                "planet": k,
                "seed": seed,
                "contrast": planet.contrast,
                "found": seen,
                "measured": float(table["contrast"][nearest]) if seen else math.nan,
                "error": float(table["contrast_error"][nearest]) if seen else math.nan,
                "away_mas": 1e3 * away[nearest] if seen else math.nan,
                "false_candidates": len(table) - len(planets),
            }
        )
    return Table(rows=rows)


def ring_photons(here: Setting, opd: NDArray[np.float64]) -> NDArray[np.float64]:
    """Expected photons of a smooth ring: the mean of point sources spread over it."""
    radii = np.linspace(*RING, 4)
    angles = np.arange(0, 2 * math.pi, 2 * math.pi / 60)
    r, a = (grid.ravel() for grid in np.meshgrid(radii, angles))
    offsets = torch.from_numpy(np.stack([r * np.cos(a), r * np.sin(a)], axis=1))
    total = np.zeros(here.model.detector.shape)
    with torch.no_grad():
        for place, weight in zip(offsets, r / r.sum(), strict=True):
            total += weight * here.model(opd, place).numpy()
    return RING_LIGHT * Star().photons * total


def one_ring(here: Setting, seed: int) -> Table:
    """One row: how much of the ring the estimate has, and the subtracted frame."""
    opd = here.drifted(HOURS)
    star = star_photons(here.model, Scene(), opd)
    light = ring_photons(here, opd)
    rng = np.random.default_rng(seed)
    shot = simulate(here.model, Scene(), opd, seed=seed)
    # The ring's own photons.
    counts = shot.data[0] + rng.poisson(light)
    error = np.sqrt(np.maximum(counts, 0) + Scene().read_noise ** 2)
    scale = here.model.detector.pixelscale
    observation = dr.Observation.from_arrays(counts, error, pixelscale=scale)
    fit = dr.refine(here.model, observation, here.measured)
    found = dr.detect(fit, threshold=math.inf)
    # The shape as an observer would make it: with the fitted wavefront, not the true one.
    shape = ring_photons(here, np.real(fit.opd))
    amplitude, deviation = found.measure_shape(shape)
    weight = light / error**2
    kept = float((weight * (counts - fit.star_image)).sum() / (weight * light).sum())
    return Table(
        rows=[
            {
                "scene": "ring",
                "planet": 0,
                "seed": seed,
                "contrast": RING_LIGHT,
                "found": True,
                "measured": amplitude * RING_LIGHT,
                "error": deviation * RING_LIGHT,
                "away_mas": 0.0,
                "false_candidates": 0,
                "kept_by_subtraction": kept,
                "ring_over_star": float((light / star)[light > light.max() / 2].mean()),
            }
        ]
    )


def main() -> None:
    """Run the study."""
    given = options(__doc__.splitlines()[0]).parse_args()
    changes = {"npix": 256, "fov_pixels": 60} if given.quick else {}
    here = setting(tuple(given.opd) if given.opd else None, **changes)
    names = ("two",) if given.quick else tuple(SYSTEMS)
    seeds = range(1 if given.quick else max(1, given.seeds // 4))
    jobs = [(here, name, seed) for seed in seeds for name in names]
    rings = [(here, seed) for seed in seeds]
    name = "companions_measured" if given.opd else "companions_generator"

    def work() -> Table:
        planets = mapped(one_system, jobs, given.processes)
        return vstack([planets, mapped(one_ring, rings, given.processes)])

    table = timed_table(work, given.output / f"{name}.ecsv")
    for scene in (*names, "ring"):
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
