"""Where calibration breaks, and whether the status says so.

    python examples/paper/failures.py --opd BEFORE AFTER --seeds 3

Frames without a planet. Each case makes one thing wrong that the fit does not know of: a wavefront
that drifted too far, a prior that is wrong and held fixed, an instrument that is not the model's.
On the embedded generator each seed has a wavefront and a drift of its own.
"""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import Table

import pyklip_diffrender as dr
from pyklip_diffrender.refinement import GaussNewton
from pyklip_diffrender.wavefront.priors import WavefrontPrior

sys.path.insert(0, str(Path(__file__).parent))
from scene import Frame, Setting, frame, mapped, options, setting, timed_table

MEASURED_SCALES = {"segment": 2.1, "texture": 0.13}
GENERATOR_SCALES = {"segment": 2.0, "texture": 0.16}
"""Scales that the evidence finds at 40 h, nm."""


@dataclass(frozen=True)
class Case:
    """What is wrong."""

    name: str
    hours: float = 40.0
    prior: float = 0.0
    """Factor by which the prior's fixed scales are off; 0 for scales that are fitted."""
    fit: dict[str, Any] = field(default_factory=dict)
    truth: dict[str, Any] = field(default_factory=dict)


CASES = (
    Case("nothing wrong"),
    Case("drift of 200 h", hours=200.0),
    Case("drift of 400 h", hours=400.0),
    Case("drift of 200 h, modes to 24 cycles only", hours=200.0, fit={"cycles": (24.0,)}),
    Case("prior 3 times too narrow, fixed", prior=1 / 3),
    Case("prior 10 times too narrow, fixed", prior=0.1),
    Case("prior 10 times too wide, fixed", prior=10.0),
    Case("internal wavefront error flipped", truth={"flip_si_wfe": False}),
    Case("star 0.5 % redder wavelength", truth={"monochromatic": 4.5e-6 * 1.005}),
    Case("pixels 0.1 % larger", truth={"pixelscale": 0.062424185 * 1.001}),
    Case("Lyot stop held where it is not", fit={"free": ("star_offset", "flux", "background")}),
)
MOVED = {"lyot_shift": (0.002, -0.001)}


def _prior(here: Setting, factor: float) -> WavefrontPrior:
    found = MEASURED_SCALES if here.before else GENERATOR_SCALES
    scales = {name: factor * scale for name, scale in found.items()}
    return WavefrontPrior(scales=scales, fit_scales=False)


def _shot(here: Setting, case: Case, seed: int) -> Frame:
    model = here.model.with_fidelity(**case.truth) if case.truth else here.model
    if case.name.startswith("Lyot"):
        model = _moved(model)
    shot = frame(replace(here, model=model), case.hours, seed)
    # The observer does not know of the difference.
    scale = here.model.detector.pixelscale
    return replace(shot, observation=replace(shot.observation, pixelscale=scale))


def _moved(model: dr.OpticalSystem) -> Any:
    """The model with a Lyot stop that has been shifted."""

    class Shifted:
        detector, recipe, npix = model.detector, model.recipe, model.npix

        def __call__(self, opd: Any, offset: Any = (0.0, 0.0)) -> Any:
            return model(opd, offset, **MOVED)

    return Shifted()


def one_frame(here: Setting, case: Case, seed: int) -> Table:
    """One row of the table."""
    here = here.redrawn(seed)
    shot = _shot(here, case, seed)
    wrong = {"prior": _prior(here, case.prior)} if case.prior else {}
    settings = GaussNewton(**case.fit, **wrong)
    fit = dr.refine(here.model, shot.observation, here.measured, settings=settings)
    found = dr.detect(fit, threshold=math.inf)
    radius = np.hypot(found.grid[..., 0], found.grid[..., 1])
    inside = (radius >= 0.3) & (radius < 2.3)
    return Table(
        rows=[
            {
                "case": case.name,
                "seed": seed,
                "status": fit.status.name,
                "chi2": fit.chi2_per_pixel,
                "expected_chi2": 1 - fit.effective_parameters / shot.star.size,
                "scatter": found.scatter,
                "null": found.snr[inside].std(),
                "highest": np.abs(found.snr[inside]).max(),
                "limit": float(np.median((found.error / found.photon_error)[inside])),
                "cycles": float(fit.basis.frequencies.max()),
                "seconds": fit.seconds,
            }
        ]
    )


def main() -> None:
    """Run the study."""
    given = options(__doc__.splitlines()[0]).parse_args()
    changes = {"npix": 256, "fov_pixels": 48} if given.quick else {}
    here = setting(tuple(given.opd) if given.opd else None, **changes)
    cases = CASES[4:6] if given.quick else CASES
    seeds = range(1 if given.quick else given.seeds)
    jobs = [(here, case, seed) for case in cases for seed in seeds]
    name = "failures_measured" if given.opd else "failures_generator"
    table = timed_table(
        lambda: mapped(one_frame, jobs, given.processes), given.output / f"{name}.ecsv"
    )
    for case in cases:
        part = table[table["case"] == case.name]
        print(
            f"{case.name}: {', '.join(sorted(set(part['status'])))}, chi2 "
            f"{part['chi2'].mean():.2f}, null {part['null'].mean():.2f}, scatter "
            f"{part['scatter'].mean():.2f}, limit {part['limit'].mean():.2f}"
        )


if __name__ == "__main__":
    main()
