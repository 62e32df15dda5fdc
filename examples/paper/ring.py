"""A bright ring, whose shape is known: how much of its light the estimate has.

    python examples/paper/ring.py --opd BEFORE AFTER --seeds 20

No wavefront explains a ring, and the first fit bends to it; `measure_shape` refines the star anew
without it. What mere subtraction of the first fit keeps stands beside it. The OPD map is 40 h
old; on the embedded generator each frame has a wavefront and a drift of its own.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path

import numpy as np
import torch
from astropy.table import Table
from numpy.typing import NDArray

import pyklip_diffrender as dr
from pyklip_diffrender.scene.objects import Scene, Star
from pyklip_diffrender.scene.simulation import simulate, star_photons

sys.path.insert(0, str(Path(__file__).parent))
from scene import Setting, mapped, options, setting, timed_table

HOURS = 40.0
RING = (0.9, 1.2)
"""Inner and outer radius, arcsec."""
RING_LIGHT = 3e-5
"""Of the whole ring, relative to the star."""


def ring_photons(setup: Setting, opd: NDArray[np.float64]) -> NDArray[np.float64]:
    """Expected photons of a smooth ring: the mean of point sources spread over it."""
    radii = np.linspace(*RING, 4)
    angles = np.arange(0, 2 * math.pi, 2 * math.pi / 60)
    r, a = (grid.ravel() for grid in np.meshgrid(radii, angles))
    offsets = torch.from_numpy(np.stack([r * np.cos(a), r * np.sin(a)], axis=1))
    total = np.zeros(setup.model.detector.shape)
    with torch.no_grad():
        for place, weight in zip(offsets, r / r.sum(), strict=True):
            total += weight * setup.model(opd, place).numpy()
    return RING_LIGHT * Star().photons * total


def one_ring(setup: Setting, seed: int) -> Table:
    """One row: how much of the ring the estimate has, and the subtracted frame."""
    setup = setup.redrawn(seed)
    opd = setup.drifted(HOURS)
    star = star_photons(setup.model, Scene(), opd)
    light = ring_photons(setup, opd)
    rng = np.random.default_rng(seed)
    shot = simulate(setup.model, Scene(), opd, seed=seed)
    # The ring's own photons.
    counts = shot.data[0] + rng.poisson(light)
    error = np.sqrt(np.maximum(counts, 0) + Scene().read_noise ** 2)
    scale = setup.model.detector.pixelscale
    observation = dr.Observation.from_arrays(counts, error, pixelscale=scale)
    fit = dr.refine(setup.model, observation, setup.measured)
    detection = dr.detect(fit, threshold=math.inf)
    # The shape as an observer would make it: with the fitted wavefront, not the true one.
    shape = ring_photons(setup, np.real(fit.wavefront))
    amplitude, deviation = detection.measure_shape(shape)
    weight = light / error**2
    throughput_of = float((weight * (counts - fit.frames[0].star)).sum() / (weight * light).sum())
    return Table(
        rows=[
            {
                "seed": seed,
                "light": RING_LIGHT,
                "measured": amplitude * RING_LIGHT,
                "error": deviation * RING_LIGHT,
                "status": fit.status.name,
                "kept_by_subtraction": throughput_of,
                "ring_over_star": float((light / star)[light > light.max() / 2].mean()),
            }
        ]
    )


def main() -> None:
    """Run the study."""
    arguments = options(__doc__.splitlines()[0]).parse_args()
    changes = {"npix": 256, "fov_pixels": 48} if arguments.quick else {}
    setup = setting(tuple(arguments.opd) if arguments.opd else None, **changes)
    seeds = range(1 if arguments.quick else arguments.seeds)
    name = "ring_measured" if arguments.opd else "ring_generator"
    table = timed_table(
        lambda: mapped(one_ring, [(setup, seed) for seed in seeds], arguments.processes),
        arguments.output / f"{name}.ecsv",
    )
    ratio = table["measured"] / table["light"]
    pull = (table["measured"] - table["light"]) / table["error"]
    print(
        f"light {np.mean(ratio):.3f} (worst {np.abs(ratio - 1).max():.3f} off), pull "
        f"{np.mean(pull):.2f} +- {np.std(pull):.2f}, kept by subtraction "
        f"{np.mean(table['kept_by_subtraction']):.2f}"
    )


if __name__ == "__main__":
    main()
