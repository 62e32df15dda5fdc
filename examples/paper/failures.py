"""Cases in which calibration breaks, and whether the status reports it.

    python examples/paper/failures.py --opd BEFORE AFTER --seeds 3

Frames without a planet. Each case has one error that is unknown to the fit: a wavefront
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
from pyklip_diffrender.refinement import FitSettings
from pyklip_diffrender.wavefront.priors import WavefrontPrior

sys.path.insert(0, str(Path(__file__).parent))
from scene import Frame, Setting, frame, mapped, options, setting, timed_table

MEASURED_SCALES = {"segment": 2.1, "texture": 0.13}
GENERATOR_SCALES = {"segment": 2.0, "texture": 0.16}
"""Scales that the evidence finds at 40 h, nm."""


@dataclass(frozen=True)
class Case:
    """A case, by its errors."""

    name: str
    hours: float = 40.0
    prior: float = 0.0
    """Error of the prior's fixed scales, as a factor; 0 for scales that are fitted."""
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


def _prior(setup: Setting, factor: float) -> WavefrontPrior:
    typical = MEASURED_SCALES if setup.before else GENERATOR_SCALES
    scales = {name: factor * scale for name, scale in typical.items()}
    return WavefrontPrior(scales=scales, fit_scales=False)


def _shot(setup: Setting, case: Case, seed: int) -> Frame:
    model = setup.model.with_fidelity(**case.truth) if case.truth else setup.model
    if case.name.startswith("Lyot"):
        model = _moved(model)
    shot = frame(replace(setup, model=model), case.hours, seed)
    # The observer does not know of the difference.
    scale = setup.model.detector.pixelscale
    return replace(shot, observation=replace(shot.observation, pixelscale=scale))


def _moved(model: dr.OpticalSystem) -> Any:
    """The model with a Lyot stop that has been shifted."""

    class Shifted:
        detector, recipe, npix = model.detector, model.recipe, model.npix

        def __call__(self, opd: Any, offset: Any = (0.0, 0.0)) -> Any:
            return model(opd, offset, **MOVED)

    return Shifted()


def one_frame(setup: Setting, case: Case, seed: int) -> Table:
    """One row of the table."""
    setup = setup.redrawn(seed)
    shot = _shot(setup, case, seed)
    wrong = {"prior": _prior(setup, case.prior)} if case.prior else {}
    settings = FitSettings(**case.fit, **wrong)
    fit = dr.refine(setup.model, shot.observation, setup.measured, settings=settings)
    detection = dr.detect(fit, threshold=math.inf)
    radius = np.hypot(detection.grid[..., 0], detection.grid[..., 1])
    inside = (radius >= 0.3) & (radius < 2.3)
    return Table(
        rows=[
            {
                "case": case.name,
                "seed": seed,
                "status": fit.status.name,
                "chi2": fit.chi2_per_pixel,
                "expected_chi2": 1 - fit.effective_parameters / shot.star.size,
                "scatter": detection.scatter,
                "null": detection.snr[inside].std(),
                "highest": np.abs(detection.snr[inside]).max(),
                "limit": float(np.median((detection.error / detection.photon_error)[inside])),
                "cycles": float(fit.basis.frequencies.max()),
                "seconds": fit.seconds,
            }
        ]
    )


def main() -> None:
    """Run the study."""
    arguments = options(__doc__.splitlines()[0]).parse_args()
    changes = {"npix": 256, "fov_pixels": 48} if arguments.quick else {}
    setup = setting(tuple(arguments.opd) if arguments.opd else None, **changes)
    cases = CASES[4:6] if arguments.quick else CASES
    seeds = range(1 if arguments.quick else arguments.seeds)
    jobs = [(setup, case, seed) for case in cases for seed in seeds]
    name = "failures_measured" if arguments.opd else "failures_generator"
    table = timed_table(
        lambda: mapped(one_frame, jobs, arguments.processes), arguments.output / f"{name}.ecsv"
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
