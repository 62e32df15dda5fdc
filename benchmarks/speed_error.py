"""Error against time: images, gradients, whole fits, and the codes they are compared with.

    python -m benchmarks.speed_error -o results

One simulated scene, that of the paper (beta Pictoris for two hours behind MASK335R at 4.5 um), and
a wavefront 40 hours from the known map. Every way of making an image, a gradient or a fit is a
point; ways that differ in one setting, such as the samples across the pupil, are joined by a line:

- images, at one wavelength against the converged image, and in the filter against 17 wavelengths;
- gradients of the misfit by the wavefront's modes, against automatic differentiation of the finest
  model;
- whole fits of the frame with coarser models;
- stpsf and the paper's recipe; and KLIP from the table of `examples/paper/klip_table.py`, whose
  times are of another day;
- with ``--frames FILES --opd MAP``, whole reductions of real frames with coarser models, whose
  error is the median change of the limits.

The error of images and fits is the rms error of the star in units of the noise (sigma). Takes about
four minutes on two idle cores, of which stpsf takes one, and two more for one roll of real frames;
without stpsf and its data (STPSF_PATH) its points are left out. ``--quick`` sees whether all runs.
Writes speed_error.ecsv, and a figure for images and one for fits, which the documentation shows.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from astropy.table import Table
from matplotlib.figure import Figure
from numpy.typing import NDArray
from torch import Tensor

import pyklip_diffrender as dr
from benchmarks.provenance import provenance
from benchmarks.speed.rivals import ADAM_STEPS, adam, paper_recipe, star_after_adam
from benchmarks.speed.setting import Setting, coarse_steps, of_stpsf, rendered
from benchmarks.speed.timing import interleaved
from pyklip_diffrender.drawing import save
from pyklip_diffrender.io.files import write_table
from pyklip_diffrender.linear.response import downsample
from pyklip_diffrender.optics.grid import PupilGrid
from pyklip_diffrender.optics.system import OpticalSystem
from pyklip_diffrender.reduction import ReduceOptions
from pyklip_diffrender.reduction.pipeline import prepare
from pyklip_diffrender.refinement import FitSettings, Refinement, nircam_settings, refine
from pyklip_diffrender.wavefront.bases import default_basis

RESULTS = Path(__file__).parents[1] / "docs" / "results"

MODES_OF_GRADIENTS = 6.0
"""Cycles across the pupil of the modes by which gradients are compared."""

_OTHERS = ("the paper's recipe", "stpsf", "poppy", "prysm", "hcipy", "KLIP")
"""Ways of other codes begin with one of these."""

FIGURES = {
    "image": {
        "fewer samples across the pupil": "this package, 128 to 1024 samples",
        "stpsf calc_psf": "stpsf",
        "the paper's recipe": "the paper's renderer",
    },
    "fit": {
        "fewer modes of the wavefront": "this package, modes to 8 to 24 cycles",
        "KLIP": "KLIP",
        "the paper's recipe": "the paper's fit",
    },
}
"""Tasks that have a figure, with the ways that it shows and their labels."""

UNITS = {
    "image": "rms error (sigma)",
    "broad image": "rms error (sigma)",
    "gradient": "relative error of the gradient",
    "fit": "rms error of the star (sigma)",
    "reduction": "median change of the limits",
}
"""Meaning of the errors of each task."""


class Point(NamedTuple):
    """One way of doing something, with how long it takes and how wrong it is.

    Attributes
    ----------
    what : str
        Key of `UNITS`.
    way : str
        Points of one way are joined by a line.
    setting : str
        What differs between them.
    seconds : float
    error : float
        See `UNITS`.
    status : str
        How a fit ended.
    note : str
    """

    what: str
    way: str
    setting: str
    seconds: float
    error: float
    status: str = ""
    note: str = ""


def fidelities(setting: Setting) -> Iterator[tuple[str, str, OpticalSystem]]:
    """Ways of making the monochromatic image: way, setting, model."""
    fine = setting.model
    for npix in (*setting.coarse, setting.npix):
        model = fine if npix == setting.npix else fine.with_fidelity(npix=npix)
        yield "fewer samples across the pupil", f"{npix} samples", model
    for npix in setting.coarse:
        yield (
            "change of a fine image, on fewer samples",
            f"{npix} samples",
            coarse_steps(fine, setting.measured, npix),
        )
    single = fine.with_fidelity(dtype=torch.float32)
    yield "single precision", f"{setting.npix} samples", single


def image_points(setting: Setting, budget: float) -> list[Point]:
    """Images at one wavelength, by this package and by the paper's recipe."""
    ways = list(fidelities(setting))
    works = [partial(rendered, model, setting.opd) for *_, model in ways]
    recipe = paper_recipe(setting.arrays, setting.device)
    works.append(partial(torch.no_grad()(recipe), setting.opd))
    names = [(way, label) for way, label, _ in ways] + [("the paper's recipe", "padded FFT")]
    errors = [setting.judge(work()).sigma for work in works]
    times = interleaved(works, budget, setting.device)
    return [
        Point("image", *name, seconds, error)
        for name, seconds, error in zip(names, times, errors, strict=True)
    ]


def broad_points(setting: Setting, budget: float) -> list[Point]:
    """Images in the filter, for several numbers of wavelengths and samples."""
    count = 5 if setting.quick else 17

    def model(nlambda: int, npix: int) -> OpticalSystem:
        broad = setting.model.with_fidelity(monochromatic=None, nlambda=nlambda)
        return broad.with_fidelity(npix=npix)

    truth = rendered(model(count, setting.npix), setting.opd).cpu().numpy()
    photons = setting.scene.star.photons
    noise = np.sqrt(photons * truth + setting.scene.read_noise**2)
    numbers = (1, 3) if setting.quick else (1, 3, 5, 7, 9)
    ways = [(f"{npix} samples", n, model(n, npix)) for npix in setting.coarse[-2:] for n in numbers]
    works = [partial(rendered, each, setting.opd) for *_, each in ways]
    errors = []
    for work in works:
        difference = photons * (work().cpu().numpy() - truth) / noise
        errors.append(float(np.sqrt((difference**2).mean())))
    times = interleaved(works, budget, setting.device)
    return [
        Point("broad image", way, f"{n} wavelength{'s' * (n > 1)}", seconds, error)
        for (way, n, _), seconds, error in zip(ways, times, errors, strict=True)
    ]


def gradient_points(setting: Setting, budget: float) -> list[Point]:
    """Image and gradient of the misfit; the error is that of the gradient by smooth modes."""
    data = torch.from_numpy(setting.observation.data[0]).to(setting.device)
    noise = torch.from_numpy(setting.noise).to(setting.device)
    photons, start = setting.scene.star.photons, setting.measured
    basis = default_basis(MODES_OF_GRADIENTS)

    def gradient(image: Callable[[Tensor], Tensor], opd: Tensor) -> Tensor:
        opd = opd.clone().requires_grad_()
        misfit = (((photons * image(opd) - data) / noise) ** 2).sum() / 2
        return torch.autograd.grad(misfit, opd)[0]

    def by_modes(slope: Tensor) -> Tensor:
        grid = PupilGrid.full(len(slope), setting.model.diameter)
        modes = basis.modes(grid, 0, len(basis)).to(slope)
        return torch.einsum("kyx,yx->k", modes, slope).cpu().double()

    truth = by_modes(gradient(setting.converged, start.cpu()).to(setting.device))
    ways: list[tuple[str, str, Callable[[Tensor], Tensor], int]] = [
        (way, label, model, model.npix) for way, label, model in fidelities(setting)
    ]
    recipe = paper_recipe(setting.arrays, setting.device)
    ways.append(("the paper's recipe", "padded FFT", recipe, setting.npix))
    works = [partial(gradient, image, downsample(start, npix)) for *_, image, npix in ways]
    errors = [float((by_modes(work()) - truth).norm() / truth.norm()) for work in works]
    times = interleaved(works, budget, setting.device)
    return [
        Point("gradient", way, label, seconds, error)
        for (way, label, *_), seconds, error in zip(ways, times, errors, strict=True)
    ]


def fit_points(setting: Setting) -> list[Point]:
    """Whole fits of the frame with coarser models, and the paper's recipe."""
    cycles = (4.0, 6.0) if setting.quick else (8.0, 12.0, 16.0, 20.0, 24.0)
    quick = {"max_iterations": 10} if setting.quick else {}
    points = []

    def fit(model: OpticalSystem, highest: float) -> tuple[Refinement, float]:
        began = time.perf_counter()
        result = refine(
            model,
            setting.observation,
            setting.measured.cpu().numpy(),
            settings=FitSettings(basis=default_basis(highest), **quick),
        )
        return result, time.perf_counter() - began

    def point(way: str, label: str, model: OpticalSystem, highest: float) -> Point:
        result, seconds = fit(model, highest)
        difference = (result.frames[0].star - setting.star) / setting.noise
        error = float(np.sqrt((difference**2).mean()))
        return Point("fit", way, label, seconds, error, result.status.name)

    # Once without a clock: PyTorch and the caches of the package warm up.
    fit(setting.model.with_fidelity(npix=setting.coarse[0]), cycles[0])
    for highest in cycles:
        label = f"{highest:g} cycles"
        points.append(point("fewer modes of the wavefront", label, setting.model, highest))
    for npix in setting.coarse:
        coarse = setting.model.with_fidelity(npix=npix)
        label = f"{npix} samples"
        points.append(point("fewer samples across the pupil", label, coarse, cycles[-1]))
    return [*points, adam_point(setting)]


def adam_point(setting: Setting) -> Point:
    """The paper's recipe: Adam steps on the wavefront, of which a few are timed.

    The error is that after all steps, taken with the change of a fine image on fewer samples.
    """
    step = adam(paper_recipe(setting.arrays, setting.device), setting.measured, setting)
    step()
    (seconds,) = interleaved([step], 0.1 if setting.quick else 3.0, setting.device)
    error = setting.judge(star_after_adam(setting)).sigma
    note = f"one step timed, times {ADAM_STEPS}"
    label = f"{ADAM_STEPS} Adam steps"
    return Point("fit", "the paper's recipe", label, ADAM_STEPS * seconds, error, note=note)


def klip_points(path: Path) -> list[Point]:
    """Subtraction of reference images, from a table of `examples/paper/klip_table.py`."""
    table = Table.read(path)
    points = []
    for method in ("KLIP", "KLIP, library"):
        rows = table[table["method"] == method]
        seconds, error = (float(np.median(rows[name])) for name in ("seconds", "star_error"))
        label = "9 dithered frames" if method == "KLIP" else "50 frames"
        note = f"from {path.name}, {table.meta['date']}; error in the planet's annulus"
        points.append(Point("fit", "KLIP", label, seconds, error, note=note))
    return points


def reduction_points(frames: Sequence[Path], opd: Path, *, quick: bool) -> list[Point]:
    """Reductions of real frames with fewer wavelengths and modes; limits against finer ones."""
    sequence = dr.ExposureSequence.from_files(list(frames))
    first = sequence.science[0]
    size = 32 if quick else 80
    # As `reduce` has it where its pattern is known.
    default = nircam_settings(first, min_model_error=0.002)
    (highest, *_) = np.atleast_1d(default.cycles)
    finest = (5, 5.0) if quick else (9, float(highest))
    others = [(5, 4.0)] if quick else [(7, highest), (5, highest), (3, highest)]
    others += [] if quick else [(7, 0.75 * highest), (7, 0.5 * highest)]

    def limits(nlambda: int, cycles: float) -> tuple[NDArray[np.float64], float, str]:
        options = ReduceOptions(size=size, settings=replace(default, cycles=cycles))
        preparation = prepare(sequence, opd, options)
        model = dr.model_for(first, size, nlambda=nlambda)
        began = time.perf_counter()
        result = replace(preparation, model=model).run()
        seconds = time.perf_counter() - began
        curve = np.asarray(result.detection.contrast_curve["contrast"])
        return curve, seconds, result.fit.status.name

    truth, *_ = limits(*finest)
    points = []
    for nlambda, cycles in others:
        curve, seconds, status = limits(nlambda, cycles)
        error = float(np.median(np.abs(curve / truth - 1)))
        way = "fewer wavelengths" if cycles == finest[1] else "fewer modes of the wavefront"
        label = f"{nlambda} wavelengths" if cycles == finest[1] else f"{cycles:g} cycles"
        note = f"{len(sequence.science)} of {sequence.target}, {first.filter}"
        points.append(Point("reduction", way, label, seconds, error, status, note))
    return points


def stpsf_points(setting: Setting, budget: float) -> list[Point]:
    """stpsf's own calc_psf for several samplings, and the same arrays in this package."""
    if setting.stpsf is None:
        return []
    instrument, call = setting.stpsf
    photons, read_noise = setting.scene.star.photons, setting.scene.read_noise
    truth = of_stpsf(setting, 16.0)().numpy()
    noise = np.sqrt(photons * truth + read_noise**2)

    def sigma(image: Any) -> float:
        return float(np.sqrt(((photons * (np.asarray(image) - truth) / noise) ** 2).mean()))

    points = []
    for pad in (1,) if setting.quick else (1, 2, 4):
        began = time.perf_counter()
        image = instrument.calc_psf(**call, fft_oversample=pad)["DET_SAMP"].data
        seconds = time.perf_counter() - began
        label = f"fft_oversample {pad}"
        points.append(Point("image", "stpsf calc_psf", label, seconds, sigma(image)))
    ways = (2.0, 3.0, 6.0)
    works = [of_stpsf(setting, cells) for cells in ways]
    errors = [sigma(work()) for work in works]
    for cells, seconds, error in zip(ways, interleaved(works, budget), errors, strict=True):
        label = f"{cells:g} cells per lambda/D"
        way = "this package, of stpsf's arrays"
        points.append(Point("image", way, label, seconds, error))
    return points


def measure(setting: Setting, budget: float) -> list[Point]:
    """All points, with `budget` seconds for each timed function."""
    return [
        *image_points(setting, budget),
        *stpsf_points(setting, budget),
        *broad_points(setting, budget),
        *gradient_points(setting, budget),
        *fit_points(setting),
        *klip_points(RESULTS / "klip_table_measured.ecsv"),
    ]


def as_table(points: Sequence[Point], command: str) -> Table:
    """The points as a table with its provenance."""
    table = Table(rows=list(points), names=Point._fields)
    for name in ("seconds", "error"):
        table[name].info.format = ".3g"
    table["seconds"].unit = "s"
    table["error"].description = "; ".join(f"{key}: {value}" for key, value in UNITS.items())
    table.meta = provenance(command, "stpsf")
    return table


def draw(table: Table, what: str) -> Figure:
    """Error against time for one task; a line for each way to do it that a user can choose."""
    figure = Figure(figsize=(4.6, 4.2), layout="constrained")
    ax = figure.subplots()
    rows = table[table["what"] == what]
    for way, label in FIGURES[what].items():
        line = rows[rows["way"] == way]
        marker = "s--" if way.startswith(_OTHERS) else "o-"
        ax.loglog(line["seconds"], line["error"], marker, ms=6, label=label)
        for each in {0, len(line) - 1} if len(line) > 1 else ():
            ax.annotate(
                str(line["setting"][each]).replace("dithered ", ""),
                (line["seconds"][each], line["error"][each]),
                xytext=(6, 5), textcoords="offset points", fontsize=7,
            )  # fmt: skip
    ax.margins(0.15)
    left, right = ax.get_xlim()
    ax.set_xlim(left, right * (right / left) ** 0.25)  # For the labels.
    ax.set(xlabel="time (s)", ylabel=UNITS[what])
    ax.axhline(1.0, color="0.7", lw=1, zorder=0)  # The noise of a pixel.
    figure.legend(loc="outside upper center", fontsize=8, frameon=False)
    return figure


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=Path, default=Path("speed_error"))
    parser.add_argument(
        "--quick", action="store_true", help="small arrays, to see whether all runs"
    )
    parser.add_argument("--device", default="cpu", help="torch device of this package")
    parser.add_argument("--frames", nargs="+", type=Path, metavar="FILE", help="real frames")
    parser.add_argument("--opd", type=Path, metavar="FILE", help="OPD map of the frames")
    parser.add_argument("--figure", type=Path, metavar="TABLE", help="only draw a table again")
    options = parser.parse_args(arguments)
    options.output.mkdir(parents=True, exist_ok=True)
    command = "benchmarks.speed_error"
    if options.figure:
        table = Table.read(options.figure)
    else:
        setting = Setting(options.quick, options.device)
        points = measure(setting, 0.05 if options.quick else 2.0)
        if options.frames:
            points += reduction_points(options.frames, options.opd, quick=options.quick)
        command += " --quick" * options.quick + " --frames FILES --opd MAP" * bool(options.frames)
        table = as_table(points, command)
        write_table(table, options.output / "speed_error.ecsv")
        table["what", "way", "setting", "seconds", "error", "status"].pprint_all()
    for what in FIGURES:
        save(draw(table, what), options.output / f"speed_error_{what}.png")
    return 0


if __name__ == "__main__":
    sys.exit(main())
