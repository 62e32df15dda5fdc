"""Real frames: is noise being fitted, and what does each part of the model buy?

    python -m benchmarks.real_frames CALINTS OPD

Every row is a fit to one integration, judged on the other, which it has never seen. Both see the
same star through the same wavefront, so what a fit learns of the first one's noise raises the
second one's residual.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import Table

from pyklip_diffrender.instrument.nircam import NIRCAM_LW_PIXELSCALE
from pyklip_diffrender.refinement import GaussNewton, refine
from pyklip_diffrender.scene.observation import Observation
from pyklip_diffrender.scene.simulation import model_for
from pyklip_diffrender.wavefront.opd import read_opd

sys.path.insert(0, str(Path(__file__).parents[1] / "examples"))
from hip65426_pyklip import away_from_companions, residual_share

PRESET = GaussNewton.nircam()
VARIANTS: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "as published here": ({}, {}),
    "square pixels (0.0624 arcsec), no shear": (
        {"pixelscale": NIRCAM_LW_PIXELSCALE, "shear": 0.0},
        {},
    ),
    "no amplitude modes": ({}, {"prior": replace(PRESET.prior, amplitude_scale=0.0)}),
    "internal Zernikes not free": (
        {},
        {"free": tuple(n for n in PRESET.free if n != "si_zernikes")},
    ),
    "no companion in the model": ({}, {"max_companions": 0}),
    "internal wavefront error flipped": ({"flip_si_wfe": False}, {}),
    "three wavelengths": ({"nlambda": 3}, {}),
}


def one_frame(observation: Observation, frame: int) -> Observation:
    """A single integration."""
    pick = slice(frame, frame + 1)
    return replace(
        observation,
        data=observation.data[pick],
        error=observation.error[pick],
        valid=observation.valid[pick],
        center=observation.center[pick],
        position_angles=None,
    )


def main() -> None:
    """Fit all variants and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("frames", type=Path)
    parser.add_argument("opd", type=Path)
    options = parser.parse_args()
    observation = Observation.from_fits(options.frames).cutout(80)
    opd = read_opd(options.opd)
    rows = []
    for name, (model_changes, fit_changes) in VARIANTS.items():
        model = model_for(observation, **model_changes)
        settings = GaussNewton.nircam(**fit_changes)
        for fitted in (0, 1) if name == "as published here" else (0,):
            fit = refine(model, one_frame(observation, fitted), opd, settings=settings)
            keep = away_from_companions(fit)
            frames = observation.data - fit.frames[0].companion_image
            shares = [
                100 * residual_share(frame, fit.frames[0].star, keep)
                for frame in (frames[fitted], frames[1 - fitted], frames.mean(axis=0))
            ]
            rows.append((name, fitted, *shares, fit.chi2_per_pixel, fit.status.name, fit.seconds))
            print(rows[-1], flush=True)  # As they come: a fit takes a minute or more.
    table = Table(
        rows=rows,
        names=("model", "fitted", "fitted %", "held out %", "mean %", "chi2/pixel", "status", "s"),
    )
    for name in ("fitted %", "held out %", "mean %", "chi2/pixel"):
        table[name].format = ".2f"
    table["s"].format = ".0f"
    difference = (observation.data[0] - observation.data[1]) / np.sqrt(2)
    noise = 100 * np.abs(difference).mean() / np.abs(observation.data).mean()
    print(f"noise of one integration alone: {noise:.2f} % of the star")
    table.pprint_all()


if __name__ == "__main__":
    main()
