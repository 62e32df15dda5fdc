"""Beyond the paper: cases that it did not study, with one complication at a time.

    python examples/paper/beyond.py --opd BEFORE AFTER --seeds 10

A planet of 1e-6 at 0.6 arcsec, the OPD map 40 h old unless stated otherwise. Cases that cost
more than a single fit (nine wavelengths, KLIP on refined residuals), and Adam, take a fifth of
the seeds. "null" is the standard deviation of S/N with the candidates removed: 1 if errors are
right. Where the ring's shape is given, the star is refined once more on the frame less the ring, as
bright as `Detection.measure_shape` finds it.
"""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import Table
from matplotlib.figure import Figure

import pyklip_diffrender as dr
from pyklip_diffrender.detection.metrics import annulus_snr
from pyklip_diffrender.io.files import embedded_table
from pyklip_diffrender.wavefront.priors import WavefrontPrior

sys.path.insert(0, str(Path(__file__).parent))
from failures import MEASURED_SCALES
from judging import COLOURS, photon_snr, pixel, select, spread, star_error
from methods import QUICK, STEPS, Subtracted, all_of, klip, references
from ring import ring_photons
from scene import Frame, Image, Planet, Scene, Setting, frame, mapped, options, setting, timed_table

PLANET = Planet(1e-6, 0.6, 54.0)
HOURS = 40.0
NON_COMMON_PATH = 5e-9
"""Rms of the error of the instrument's internal wavefront, m, over Noll terms 4 to 15."""
NINE = {"monochromatic": None, "nlambda": 9}
FREE = ("star_offset", "lyot_shift", "lyot_rotation", "flux", "background")
SHOWN = (0.4, 1.6)
"""Of S/N and contrast in the figure; beyond it stands the number."""
METHODS = (
    "initial", "KLIP", "Adam", "Gauss-Newton", "KLIP on residuals", "marginalised", "optimal",
)  # fmt: skip


def _held(factor: float) -> dict[str, Any]:
    scales = {name: factor * scale for name, scale in MEASURED_SCALES.items()}
    return {"prior": WavefrontPrior(scales=scales, fit_scales=False)}


@dataclass(frozen=True)
class Case:
    """A case, by its differences from the standard scene.

    Attributes
    ----------
    name : str
    fit : dict
        Fields of `FitSettings`.
    truth : dict
        Settings of the model that makes the frames, and not of the one that is fitted.
    both : dict
        Settings of both models.
    offset : tuple of float
        Of the star behind the occulter, arcsec.
    internal, later, disk, shape, combined : bool
        Internal wavefront wrong; map taken after the frame; a ring; its shape given; KLIP on
        residuals.
    few : bool
        Too expensive for all seeds.
    """

    name: str
    fit: dict[str, Any] = field(default_factory=dict)
    truth: dict[str, Any] = field(default_factory=dict)
    both: dict[str, Any] = field(default_factory=dict)
    offset: tuple[float, float] = (0.0, 0.0)
    internal: bool = False
    later: bool = False
    disk: bool = False
    shape: bool = False
    combined: bool = False
    few: bool = False


CASES = (
    Case("as in the paper"),
    Case("star 20 mas off", offset=(0.016, -0.012)),
    Case("map measured after the frame", later=True),
    Case("internal wavefront 5 nm off", internal=True),
    Case(
        "internal wavefront 5 nm off, fitted", internal=True, fit={"free": (*FREE, "si_zernikes")}
    ),
    Case("a ring of 3e-5 beside the planet", disk=True),
    Case("a ring of 3e-5, its shape given", disk=True, shape=True),
    Case("prior 3 times too narrow, held", fit=_held(1 / 3)),
    Case("prior 3 times too wide, held", fit=_held(3.0)),
    Case("nine wavelengths, fitted with nine", both=NINE, few=True),
    Case("nine wavelengths, fitted with one", truth=NINE, few=True),
    Case("KLIP on refined residuals", combined=True, few=True),
)


def makers(setup: Setting, case: Case, seed: int) -> tuple[Setting, Setting]:
    """Return the setting that simulates the frames, and the one that the methods assume."""
    assumed = replace(setup, model=setup.model.with_fidelity(**case.both)) if case.both else setup
    settings = {**case.both, **case.truth}
    if case.internal:
        table = 1e-9 * np.asarray(embedded_table("nircam_si_zernikes")["MASK335R"], dtype=float)
        wrong = np.random.default_rng([seed, 99]).normal(0, NON_COMMON_PATH / 12**0.5, 12)
        table[3:15] += wrong
        settings["si_wfe"] = table
    truth = replace(setup, model=setup.model.with_fidelity(**settings)) if settings else setup
    if case.later:
        assumed = replace(assumed, measured=setup.drifted(HOURS))
    return truth, assumed


def with_ring(setup: Setting, shot: Frame, seed: int) -> Frame:
    """The frame, and a ring from 0.9 to 1.2 arcsec."""
    light = np.random.default_rng([seed, 88]).poisson(ring_photons(setup, shot.opd))
    counts = shot.observation.data[0] + light
    return replace(shot, observation=observed(setup, counts))


def without_ring(assumed: Setting, shot: Frame, bent: Subtracted) -> tuple[Subtracted, Image]:
    """Refine the star again after subtracting a ring of known shape; also return the ring."""
    assert bent.fit is not None
    shape = ring_photons(assumed, bent.fit.wavefront)
    amplitude, _ = dr.detect(bent.fit, threshold=math.inf).measure_shape(shape)
    ring = amplitude * shape
    less = replace(shot.observation, data=shot.observation.data - ring)
    fit = dr.refine(assumed.model, less, assumed.measured)
    return Subtracted(fit.frames[0].residual[0] + ring, bent.seconds + fit.seconds, fit), ring


def observed(setup: Setting, counts: Image) -> dr.Observation:
    """Counts as an observer has them."""
    error = np.sqrt(np.maximum(counts, 0) + Scene().read_noise ** 2)
    scale = setup.model.detector.pixelscale
    return dr.Observation.from_arrays(counts, error, unit="photon", pixelscale=scale)


def klip_on_residuals(assumed: Setting, subtracted: Subtracted, frames: Image) -> Subtracted:
    """Apply KLIP to the refined residuals of the target and of each of the nine references."""
    fits = [
        dr.refine(assumed.model, observed(assumed, counts), assumed.measured) for counts in frames
    ]
    blank = np.zeros_like(subtracted.image)
    target = Frame(observed(assumed, subtracted.image), blank, blank, (), blank)
    return klip(target, np.stack([fit.frames[0].residual[0] for fit in fits]))


def one_frame(setup: Setting, number: int, steps: int, seed: int) -> Table:
    """One row for each method, for the case with this number."""
    case = CASES[number]
    truth, assumed = makers(setup, case, seed)
    hours = 0.0 if case.later else HOURS
    shot = frame(truth, hours, seed, [PLANET], star_offset=case.offset)
    if case.disk:
        shot = with_ring(truth, shot, seed)
    frames = references(truth, hours, seed)
    subtracted = all_of(assumed, shot, frames, steps, **case.fit)
    ring = np.zeros_like(shot.star)
    if case.shape:
        subtracted["Gauss-Newton"], ring = without_ring(assumed, shot, subtracted["Gauss-Newton"])
    if case.combined:
        subtracted["KLIP on residuals"] = klip_on_residuals(
            assumed, subtracted["Gauss-Newton"], frames
        )
    fit = subtracted["Gauss-Newton"].fit
    assert fit is not None
    # The ring is no point source: nothing there is to be taken for one.
    detection = dr.detect(fit, threshold=math.inf if case.disk and not case.shape else 5.0)
    subtracted["marginalised"] = Subtracted(detection.subtracted[0] + ring, fit.seconds)
    planet = detection.measure([PLANET.offset])[0]
    x, y = detection.grid[..., 0], detection.grid[..., 1]
    radius = np.hypot(x, y)
    distant = np.hypot(x - PLANET.offset[0], y - PLANET.offset[1]) > 0.4
    null = detection.residual_snr[distant & (radius > 0.3) & (radius < 2.3)]
    star = pixel(setup, case.offset)
    place = pixel(setup, (PLANET.offset[0] + case.offset[0], PLANET.offset[1] + case.offset[1]))
    facts = {
        "case": case.name,
        "seed": seed,
        "status": fit.status.name,
        "chi2": fit.chi2_per_pixel,
        "photon_snr": photon_snr(shot),
        "marginalised_snr": float(planet["snr"]),
        "marginalised_throughput": float(planet["contrast"]) / PLANET.contrast,
        "null": float(null.std()),
        "fit_seconds": fit.seconds,
    }
    rows = [
        {
            **facts,
            "method": name,
            "annulus_snr": annulus_snr(result.image, place, star),
            "star_error": star_error(setup, shot, result.image),
        }
        for name, result in subtracted.items()
    ]
    return Table(rows=rows)


def draw(table: Table) -> Figure:
    """S/N relative to the photon limit, measured contrast, and star error, case by case."""
    names = list(dict.fromkeys(table["case"]))
    figure = Figure(figsize=(14, 1.4 + 0.36 * len(names)), layout="constrained")
    panels = figure.subplots(1, 3, sharey=True)
    place = np.arange(len(names))
    marginalised_rows = [select(table, case=name, method="Gauss-Newton") for name in names]
    for ax, title, column in (
        (panels[0], "Marginalised S/N / photon limit", "share"),
        (panels[1], "Measured / true contrast", "marginalised_throughput"),
    ):
        spreads = [
            spread(
                part["marginalised_snr"] / part["photon_snr"] if column == "share" else part[column]
            )
            for part in marginalised_rows
        ]
        middle, low, high = np.transpose(spreads)
        ax.errorbar(middle, place, xerr=np.stack([middle - low, high - middle]), fmt="o", ms=4,
                    color=COLOURS["marginalised"])  # fmt: skip
        ax.axvline(1, color="0.7", lw=0.8, zorder=0)
        ax.set_title(title, fontsize=10, loc="left")
        ax.set_xlim(*SHOWN)
        for y, value in zip(place, middle, strict=True):
            if not SHOWN[0] <= value <= SHOWN[1]:
                edge = SHOWN[0] if value < SHOWN[0] else SHOWN[1]
                side = "left" if value < SHOWN[0] else "right"
                ax.text(edge, y, f" {value:.2g} ", ha=side, va="center", fontsize=8)
    for name in ("initial", "KLIP", "Adam", "Gauss-Newton"):
        spreads = [spread(select(table, case=c, method=name)["star_error"]) for c in names]
        panels[2].plot(np.transpose(spreads)[0], place, "o", ms=4, color=COLOURS[name], label=name)
    panels[2].set_xscale("log")
    panels[2].set_title("Star error, sigma", fontsize=10, loc="left")
    panels[2].legend(frameon=False, fontsize=7)
    panels[0].set_yticks(place, names, fontsize=8)
    panels[0].invert_yaxis()
    return figure


def main() -> None:
    """Run the study."""
    parser = options(__doc__.splitlines()[0])
    parser.set_defaults(seeds=10)
    parser.add_argument("--cases", type=int, nargs="+", help="numbers, from 0; default all")
    arguments = parser.parse_args()
    setup = setting(
        tuple(arguments.opd) if arguments.opd else None, **(QUICK if arguments.quick else {})
    )
    numbers = arguments.cases or range(len(CASES))
    if arguments.quick:
        jobs = [(setup, number, 200, 0) for number in arguments.cases or (1,)]
    else:
        adam_seeds = (arguments.seeds + 4) // 5
        jobs = [
            (setup, number, STEPS if seed < adam_seeds else 0, seed)
            for seed in range(arguments.seeds)
            for number in numbers
            if seed < adam_seeds or not CASES[number].few
        ]
    name = "beyond_measured" if arguments.opd else "beyond_generator"
    table = timed_table(
        lambda: mapped(one_frame, jobs, arguments.processes), arguments.output / f"{name}.ecsv"
    )
    for case in dict.fromkeys(table["case"]):
        part = select(table, case=case)
        share = spread(part["marginalised_snr"] / part["photon_snr"])[0]
        print(
            f"{case}: {', '.join(sorted(set(part['status'])))}, chi2 {np.mean(part['chi2']):.2f}, "
            f"S/N {spread(part['marginalised_snr'])[0]:.1f} ({share:.2f} of the photon limit), "
            f"contrast {spread(part['marginalised_throughput'])[0]:.2f} of true, null "
            f"{spread(part['null'])[0]:.2f}"
        )
        for method in METHODS:
            subset = select(part, method=method)
            if len(subset):
                print(
                    f"  {method:17s} annulus SNR {spread(subset['annulus_snr'])[0]:6.2f}, "
                    f"star error {spread(subset['star_error'])[0]:7.2f}"
                )


if __name__ == "__main__":
    main()
