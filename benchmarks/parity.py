"""Parity with poppy and stpsf at full size, and the speed of converted models.

Run from the root of the project, with the package and its extra "webbpsf" installed:

    python -m benchmarks.parity --official ../shared/data/stpsf-data

It makes an offline STPSF data directory without symmetry, runs the real stpsf on it and on STScI's
own files, and writes reports/parity.md. At 1024 samples it takes about ten minutes and 6 GB of
memory. Speed is measured only if asked for (--speed). docs/validation/optics.md has the results.
"""

from __future__ import annotations

import argparse
import logging
import os
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks import poppy_reference as reference
from benchmarks.compared import Array, largest, timed
from benchmarks.parity_cases import BARE, CALL, EMBEDDED, FULL, differences
from benchmarks.provenance import provenance
from benchmarks.stpsf_data import make_stpsf_data, nircam, wss_file
from pyklip_diffrender.bridges import from_poppy, from_webbpsf, load_wss_opd
from pyklip_diffrender.instrument.jwst import jwst_pupil, maskrnd_openings
from pyklip_diffrender.instrument.nircam import NIRCAM_LW_PIXELSCALE
from pyklip_diffrender.optics.grid import PupilGrid, polygon_coverage
from pyklip_diffrender.optics.system import OpticalSystem

BROAD = {"monochromatic": None, "nlambda": 9, "fft_oversample": 4}
SHORT = {"monochromatic": 2.0e-6}
NEAR = {"source_offset_x": -0.2, "source_offset_y": 0.57}
MOVED = {
    "pupil_shift_x": 0.012, "pupil_shift_y": -0.02, "pupil_rotation": 1.3,
    "source_offset_x": 0.02, "source_offset_y": 0.01,
}  # fmt: skip
DISTORTED = ("nd_squares on, on axis", "pupil shift, rotation and source offset")
# What is compared: options of the instrument, arguments of the call, and the largest error.
ROWS: dict[str, tuple[dict[str, Any], dict[str, Any], float | None]] = {
    "nd_squares off, on axis": (BARE, {}, 1e-8),
    "nd_squares off, star at 0.6 arcsec": (
        {**BARE, "source_offset_x": 0.5, "source_offset_y": -0.33}, {}, 1e-8,
    ),
    "nd_squares off, star at 2 arcsec": (
        {**BARE, "source_offset_r": 2.0, "source_offset_theta": 50.0}, {}, 1e-8,
    ),
    "nd_squares on, on axis": ({}, {}, 1e-7),
    "nd_squares on, star at 0.6 arcsec": (NEAR, {}, 1e-7),
    "broadband F444W, 9 wavelengths": (BARE, BROAD, 1e-8),
    "broadband F335M, 9 wavelengths": ({**BARE, "band": "F335M"}, BROAD, 1e-8),
    "pupil shift, rotation and source offset": (MOVED, {}, 1e-7),
    "MASK430R": ({"image_mask": "MASK430R"}, {}, None),
    "MASK210R, F200W": ({"image_mask": "MASK210R", "band": "F200W"}, SHORT, None),
    "MASKLWB": ({"image_mask": "MASKLWB", "pupil_mask": "MASKLWB"}, {}, None),
    "MASKSWB, F200W": (
        {"image_mask": "MASKSWB", "pupil_mask": "MASKSWB", "band": "F200W"}, SHORT, None,
    ),
}  # fmt: skip


def run(model: OpticalSystem) -> tuple[Array, float]:
    """An image, and how long one takes once the system has been used."""
    with torch.no_grad():
        model()
        image, seconds = timed(model, 15)
    return image.numpy().astype(np.float64), seconds


def image_of(model: OpticalSystem) -> Array:
    """The image alone."""
    with torch.no_grad():
        return model().numpy().astype(np.float64)


def line(*cells: str | float) -> str:
    """A row of a table, numbers short."""
    return "| " + " | ".join(c if isinstance(c, str) else f"{c:.2g}" for c in cells) + " |"


def against_poppy(npix: int) -> list[str]:
    """The padded FFT path and the compact one against poppy."""
    system = reference.coronagraph(
        jwst_pupil(npix).numpy(),
        reference.lopsided_opd(npix),
        polygon_coverage(maskrnd_openings(), PupilGrid.full(npix)).numpy(),
        reference.zernike_opd(reference.lopsided_zernikes(), npix),
        oversample=4,
        fov_pixels=80,
        pixelscale=NIRCAM_LW_PIXELSCALE,
    )
    system.planes[2].occulter_box = 2.14
    truth = system.calc_psf(4.5e-6)[0].data
    lines = []
    for propagation in ("fft", "compact"):
        image = image_of(from_poppy(system, 4.5e-6, propagation=propagation))
        error = float(np.linalg.norm(image - truth) / np.linalg.norm(truth))
        quantity = f"image, relative L2, path {propagation!r}"
        lines.append(line("poppy, plain FFT, oversample 4", quantity, 1e-12, error))
    return lines


def against_stpsf(folder: Path, npix: int, oversample: int) -> list[str]:
    """The rows of the table."""
    lines = []
    for words, (options, changes, limit) in ROWS.items():
        call = {**CALL, "fft_oversample": oversample, "detector_oversample": 1, **changes}
        instrument = nircam(folder, npix=npix, **options)
        truth = instrument.calc_psf(**call)
        error = largest(image_of(from_webbpsf(instrument, **call)), truth["DET_SAMP"].data)
        most = "reported" if limit is None else f"{limit:g}"
        whose = f"stpsf, fft_oversample {call['fft_oversample']}"
        lines.append(line(whose, f"image / peak, {words}", most, error))
        if words in DISTORTED:
            distorted = image_of(from_webbpsf(instrument, add_distortion=True, **call))
            error = largest(distorted, truth["DET_DIST"].data)
            lines.append(line("stpsf, DET_DIST", f"image / peak, {words}", "1e-05", error))
    return lines


def oversampled_chain(folder: Path, npix: int) -> str:
    """DET_DIST with the detector oversampled, as stpsf does by default."""
    instrument = nircam(folder, npix=npix)
    call = {"monochromatic": 4.5e-6, "fov_pixels": 80, "oversample": 4}
    image = image_of(from_webbpsf(instrument, add_distortion=True, **call))
    error = largest(image, instrument.calc_psf(**call)["DET_DIST"].data)
    quantity = "image / peak, calc_psf's defaults (oversample 4)"
    return line("stpsf, DET_DIST", quantity, "1e-05", error)


def precision(folder: Path, npix: int) -> list[str]:
    """float32 against float64."""
    instrument = nircam(folder, npix=npix)
    call = {**CALL, "fft_oversample": 4, "detector_oversample": 1}
    weight = torch.from_numpy(np.random.default_rng(335).standard_normal((80, 80)))
    images, gradients = [], []
    for dtype in (torch.float64, torch.float32):
        model = from_webbpsf(instrument, dtype=dtype, **call)
        opd = model.entrance.opd.to(dtype).requires_grad_()
        images.append(image_of(model))
        (gradient,) = torch.autograd.grad((model(opd) * weight.to(dtype)).sum(), opd)
        gradients.append(gradient.to(torch.float64))
    shift = float((gradients[1] - gradients[0]).norm() / gradients[0].norm())
    return [
        line("float64", "float32: image / peak, on axis", "reported", largest(*images[::-1])),
        line("float64", "float32: gradient for the OPD, relative L2", "reported", shift),
    ]


def wavefront_sensing(folder: Path, npix: int) -> str:
    """`load_wss_opd` against stpsf's."""
    path = folder / "R2022081102-NRCA3_FP1-1.fits"
    wss_file(path)
    instrument = nircam(folder, npix=npix)
    instrument.load_wss_opd(str(path), verbose=False)
    loaded = load_wss_opd(path, npix=npix)
    error = float(np.abs(loaded.data - instrument.pupilopd[0].data).max())
    instrument.pupilopd.close()
    return line("stpsf, load_wss_opd", "OPD, m", "1e-12", error)


def on_official_files(folder: Path) -> list[str]:
    """Two tables: converted models, and the embedded coronagraph in rings about the star."""
    converted = []
    for options, words in (
        (NEAR, "F444W, MASK335R, star at 0.6 arcsec"), (MOVED, "stop shifted and turned"),
    ):  # fmt: skip
        instrument = nircam(folder, npix=1024, **options)
        call = {**FULL, "monochromatic": 4.5e-6}
        truth = instrument.calc_psf(**call)
        for distorted, name in ((False, "DET_SAMP"), (True, "DET_DIST")):
            image = image_of(from_webbpsf(instrument, add_distortion=distorted, **call))
            converted.append(line(words, name, largest(image, truth[name].data)))
    rings = [
        line(case, *(f"{100 * x:.2f} %" for x in differences(folder, case, {})))
        for case in EMBEDDED
    ]
    return [
        "| converted model | extension | largest difference / peak |",
        "|---|---|---|",
        *converted,
        "",
        "| `nircam_coronagraph` | within 0.3 arcsec | 0.3 to 0.7 | 0.7 to 1.2 | 1.2 to 2.4 |",
        "|---|---|---|---|---|",
        *rings,
    ]


OFFICIAL = (
    "The same stpsf with STScI's own pupil, Lyot stop, filters and internal Zernikes (webbpsf-data "
    "1.1.1), at 1024 samples and fft_oversample 2. First models converted by `from_webbpsf`; then "
    "the package's own `nircam_coronagraph`, which knows pupil and stop as outlines, star at "
    "(50, -30) mas, nd_squares off: the mean difference in a ring about the star, in units of the "
    "mean light there. It is given stpsf's internal Zernikes, but for the last row: there it has "
    "those of its table, the field point nearest to the mask, where stpsf interpolates between "
    "field points and gets 5 nm more astigmatism. stpsf is given the published in-flight alignment "
    "of the stop in the row before, which poppy cuts to whole samples."
)


def processor_time(function: Callable[[], Any], repeats: int) -> float:
    """The least time of all threads together, s: what a busy machine does not change much."""
    seconds = []
    for _ in range(repeats):
        start = time.process_time()
        function()
        seconds.append(time.process_time() - start)
    return min(seconds)


def speed(folder: Path, npix: int, oversample: int) -> list[str]:
    """One monochromatic image, the star on the axis, each against its own limit."""
    lines = []
    for squares in (False, True):
        instrument = nircam(folder, npix=npix, nd_squares=squares)
        call = {**CALL, "detector_oversample": 1, "add_distortion": False}
        truth = instrument.calc_psf(**{**call, "fft_oversample": oversample})[1].data
        call["fft_oversample"] = 4

        def theirs(instrument: Any = instrument, call: Any = call) -> Any:
            return instrument.calc_psf(**call)

        wall, busy = timed(theirs, 3)[1], processor_time(theirs, 2)
        for sampling in (3, 4):
            model = from_webbpsf(instrument, occulter_sampling=sampling, **call)
            image, ours = run(model)
            torch.set_num_threads(1)
            with torch.no_grad():
                single = processor_time(model, 7)
            torch.set_num_threads(os.cpu_count() or 1)
            squares_word = "on" if squares else "off"
            lines.append(
                line(squares_word, str(sampling), largest(image, truth), wall, ours)[:-1]
                + line(f"{wall / ours:.0f}", busy, single, f"{busy / single:.0f}")
            )
    return lines


def speed_section(rows: list[str], oversample: int) -> list[str]:
    """The page's section on speed."""
    return [
        "## Speed",
        "",
        "One monochromatic image of a star on the axis, against `nircam.calc_psf` at "
        f"fft_oversample 4. The error is with respect to stpsf at fft_oversample "
        f"{oversample}. Seconds by the clock, on all cores; then of processor time, the "
        "model on one thread.",
        "",
        "| ND squares | cells per lambda/D | error | s, stpsf | s, ours | times faster "
        "| CPU s, stpsf | CPU s, ours | times less |",
        "|---|---|---|---|---|---|---|---|---|",
        *rows,
        "",
        "The edges of the ND squares are cut without anti-aliasing in stpsf, so that its "
        "images with them change with the oversampling; the model follows it at each.",
        "",
    ]


def main() -> None:
    """Measure, and write the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--npix", type=int, default=1024)
    parser.add_argument("--official", type=Path, help="STScI's data directory for stpsf")
    parser.add_argument("--speed", action="store_true", help="measure speed anew")
    parser.add_argument("--oversample", type=int, default=8, help="of stpsf's FFTs")
    parser.add_argument("--output", type=Path, default=Path("reports") / "parity.md")
    arguments = parser.parse_args()
    npix, oversample = arguments.npix, arguments.oversample
    logging.disable(logging.WARNING)
    warnings.simplefilter("ignore")
    with tempfile.TemporaryDirectory() as scratch:
        folder = make_stpsf_data(Path(scratch) / "stpsf-data", npix)
        os.environ["STPSF_PATH"] = str(folder)
        # First, while nothing else has filled the memory.
        faster = speed(folder, npix, oversample) if arguments.speed else []
        rows = [
            *against_poppy(npix),
            *against_stpsf(folder, npix, oversample),
            oversampled_chain(folder, npix),
            wavefront_sensing(folder, npix),
            *precision(folder, npix),
        ]
    official = []
    if arguments.official:
        path = arguments.official.resolve()
        os.environ["STPSF_PATH"] = str(path)
        official = [
            "## STScI's files",
            "",
            OFFICIAL,
            "",
            *on_official_files(path),
            "",
        ]
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    arguments.output.write_text(
        "\n".join(
            [
                "# Parity with poppy and stpsf",
                "",
                *provenance("-m benchmarks.parity", ("poppy", "stpsf", "pysiaf")),
                "",
                f"{npix} x {npix} samples in the pupil, 80 x 80 pixels, 4.5 um unless another band "
                "is named. stpsf runs on an offline data directory (`stpsf_data`) whose "
                "pupil, wavefront, Lyot stop and internal aberrations have no symmetry, so that "
                "no flipped or transposed answer passes. Errors are the largest difference "
                "divided by the peak unless they say otherwise.",
                "",
                "| compared with | quantity | at most | found |",
                "|---|---|---|---|",
                *rows,
                "",
                "The errors are rounding because the converted model samples image planes at the "
                "points where stpsf's FFT does, if it is asked for the same oversampling; it only "
                "leaves out the points where the mask is clear.",
                "",
                *official,
                *(speed_section(faster, oversample) if faster else []),
                "",
            ]
        ),
        encoding="utf-8",
    )


if __name__ == "__main__":
    main()
