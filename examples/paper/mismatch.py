"""Nothing about the instrument known: star 50 mas off, Lyot stop shifted and turned, flux 20 % off.

    python examples/paper/mismatch.py --opd BEFORE AFTER --seeds 20

One frame a seed with a planet (1e-6 at 0.6 arcsec), fitted twice: with the instrument found from
the frame itself, and with its true alignment given. The errors of what was found, the planet's S/N
in both, and the scatter of S/N where there is no planet. The OPD map is 40 h old; on the
embedded generator each frame has a wavefront and a drift of its own.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path

import numpy as np
import torch
from astropy.table import Table

import pyklip_diffrender as dr
from pyklip_diffrender.refinement import FitSettings
from pyklip_diffrender.scene.objects import Star

sys.path.insert(0, str(Path(__file__).parent))
from scene import Planet, Setting, mapped, options, setting, timed_table

OFFSET = (0.030, -0.040)
LYOT = (0.014, -0.014)
ROTATION = 2.0
BRIGHTER = 1.2
BACKGROUND = 5000.0
PLANET = Planet(1e-6, 0.6, 54.0)
HOURS = 40.0
READ_NOISE = 42.0


def observed(setup: Setting, seed: int) -> tuple[dr.Observation, float]:
    """A frame and the star's true light."""
    opd = setup.drifted(HOURS)
    values = {"lyot_shift": LYOT, "lyot_rotation": ROTATION}
    photons = Star().photons * BRIGHTER
    with torch.no_grad():
        image = setup.model(opd, OFFSET, **values).numpy()
        planet = setup.model(opd, tuple(np.add(OFFSET, PLANET.offset)), **values).numpy()
    expected = photons * (image + PLANET.contrast * planet) + BACKGROUND
    rng = np.random.default_rng(seed)
    counts = rng.poisson(expected) + rng.normal(0, READ_NOISE, expected.shape)
    error = np.sqrt(np.maximum(counts, 0) + READ_NOISE**2)
    scale = setup.model.detector.pixelscale
    return dr.Observation.from_arrays(counts, error, pixelscale=scale), photons


def one_seed(setup: Setting, seed: int) -> Table:
    """One row of the table."""
    setup = setup.redrawn(seed)
    shot, photons = observed(setup, seed)
    truth = {"star_offset": OFFSET, "lyot_shift": LYOT, "lyot_rotation": ROTATION}
    held = FitSettings(free=("flux", "background"))
    aligned = dr.refine(setup.model, shot, setup.measured, settings=held, start=truth)
    matched = dr.detect(aligned).measure([PLANET.offset])
    fit = dr.refine(setup.model, shot, setup.measured)
    detection = dr.detect(fit)
    planet = detection.measure([PLANET.offset])
    radius = np.hypot(detection.grid[..., 0], detection.grid[..., 1])
    null = detection.residual_snr[(radius > 0.3) & (radius < 2.3)]
    values = fit.frames[0].values
    return Table(
        rows=[
            {
                "seed": seed,
                "status": fit.status.name,
                "iterations": len(fit.history),
                "offset_error_mas": 1e3 * math.hypot(*(values["star_offset"] - OFFSET)),
                "lyot_error_percent": 100 * math.hypot(*(values["lyot_shift"] - LYOT)),
                "rotation_error_deg": abs(float(values["lyot_rotation"][0]) - ROTATION),
                "flux_error_percent": 100 * abs(float(values["flux"][0]) / photons - 1),
                "background_error": float(values["background"][0]) - BACKGROUND,
                "snr_matched": float(matched["snr"][0]),
                "snr": float(planet["snr"][0]),
                "information_kept": float(
                    matched["contrast_error"][0] / planet["contrast_error"][0]
                ),
                "contrast": float(planet["contrast"][0]),
                "null": null.std(),
                "seconds": fit.seconds,
            }
        ]
    )


def main() -> None:
    """Run the study."""
    arguments = options(__doc__.splitlines()[0]).parse_args()
    changes = {"npix": 256, "fov_pixels": 48} if arguments.quick else {}
    setup = setting(tuple(arguments.opd) if arguments.opd else None, **changes)
    jobs = [(setup, seed) for seed in range(1 if arguments.quick else arguments.seeds)]
    name = "mismatch_measured" if arguments.opd else "mismatch_generator"
    table = timed_table(
        lambda: mapped(one_seed, jobs, arguments.processes), arguments.output / f"{name}.ecsv"
    )
    for column in table.colnames[3:]:
        values = np.asarray(table[column])
        print(f"{column:20s} median {np.median(values):.4g}, worst {np.abs(values).max():.4g}")


if __name__ == "__main__":
    main()
