"""Parity with poppy and stpsf at full size.

Run from the root of the project, with the package and its extra "webbpsf" installed:

    python -m benchmarks.parity --official ../shared/data/stpsf-data

It makes an offline STPSF data directory whose pupil, wavefront, Lyot stop and internal aberrations
have no symmetry, so that no flipped or transposed answer passes, and runs the real stpsf on it and
on STScI's own files. Images have 80 x 80 pixels, at 4.5 um unless another band is named. Errors are
the largest difference over the peak unless the table says otherwise. At 1024 samples it takes about
ten minutes and 6 GB of memory.

The last table compares the package's own `nircam_coronagraph`, which knows pupil and stop as
outlines, with stpsf on STScI's files: the mean difference in rings about a star at (50, -30) mas,
in percent of the mean light there. It is given stpsf's internal Zernikes, but for the last row:
there it has those of its table, the field point nearest to the mask, where stpsf interpolates
between field points and gets 5 nm more astigmatism. stpsf is given the published in-flight
alignment of the stop in the row before, which poppy cuts to whole samples.
"""

from __future__ import annotations

import argparse
import logging
import os
import tempfile
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import torch
from astropy.table import Table
from numpy.typing import NDArray

from benchmarks import poppy_reference as reference
from benchmarks.parity_cases import BARE, CALL, EMBEDDED, FULL, differences
from benchmarks.stpsf_data import make_stpsf_data, nircam, wss_file
from pyklip_diffrender.bridges import from_poppy, from_webbpsf, load_wss_opd
from pyklip_diffrender.instrument.masks import jwst_pupil, lyot_openings
from pyklip_diffrender.instrument.nircam import NIRCAM_LW_PIXELSCALE
from pyklip_diffrender.optics.grid import PupilGrid, polygon_coverage
from pyklip_diffrender.optics.system import OpticalSystem

Array = NDArray[np.float64]
Rows = list[tuple[str, str, float]]
"""What is compared with, the quantity, and the error."""

BROAD = {"monochromatic": None, "nlambda": 9, "fft_oversample": 4}
SHORT = {"monochromatic": 2.0e-6}
NEAR = {"source_offset_x": -0.2, "source_offset_y": 0.57}
MOVED = {
    "pupil_shift_x": 0.012, "pupil_shift_y": -0.02, "pupil_rotation": 1.3,
    "source_offset_x": 0.02, "source_offset_y": 0.01,
}  # fmt: skip
DISTORTED = ("nd_squares on, on axis", "pupil shift, rotation and source offset")
ROWS: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "nd_squares off, on axis": (BARE, {}),
    "nd_squares off, star at 0.6 arcsec": (
        {**BARE, "source_offset_x": 0.5, "source_offset_y": -0.33}, {},
    ),
    "nd_squares off, star at 2 arcsec": (
        {**BARE, "source_offset_r": 2.0, "source_offset_theta": 50.0}, {},
    ),
    "nd_squares on, on axis": ({}, {}),
    "nd_squares on, star at 0.6 arcsec": (NEAR, {}),
    "broadband F444W, 9 wavelengths": (BARE, BROAD),
    "broadband F335M, 9 wavelengths": ({**BARE, "band": "F335M"}, BROAD),
    "pupil shift, rotation and source offset": (MOVED, {}),
    "MASK430R": ({"image_mask": "MASK430R"}, {}),
    "MASK210R, F200W": ({"image_mask": "MASK210R", "band": "F200W"}, SHORT),
    "MASKLWB": ({"image_mask": "MASKLWB", "pupil_mask": "MASKLWB"}, {}),
    "MASKSWB, F200W": (
        {"image_mask": "MASKSWB", "pupil_mask": "MASKSWB", "band": "F200W"}, SHORT,
    ),
}  # fmt: skip
"""Options of the instrument and arguments of the call."""


def image_of(model: OpticalSystem) -> Array:
    """The image as numpy array."""
    with torch.no_grad():
        return model().numpy().astype(np.float64)


def largest(image: Array, truth: Array) -> float:
    """Largest difference as a fraction of the peak."""
    return float(np.abs(image - truth).max() / truth.max())


def against_poppy(npix: int) -> Rows:
    """The padded FFT path and the compact one against poppy."""
    system = reference.coronagraph(
        jwst_pupil(npix).numpy(),
        reference.lopsided_opd(npix),
        polygon_coverage(lyot_openings("MASKRND"), PupilGrid.full(npix)).numpy(),
        reference.zernike_opd(reference.lopsided_zernikes(), npix),
        oversample=4,
        fov_pixels=80,
        pixelscale=NIRCAM_LW_PIXELSCALE,
    )
    system.planes[2].occulter_box = 2.14
    truth = system.calc_psf(4.5e-6)[0].data
    rows = []
    for propagation in ("fft", "compact"):
        image = image_of(from_poppy(system, 4.5e-6, propagation=propagation))
        error = float(np.linalg.norm(image - truth) / np.linalg.norm(truth))
        rows.append(("poppy, oversample 4", f"relative L2, path {propagation!r}", error))
    return rows


def against_stpsf(folder: Path, npix: int, oversample: int) -> Rows:
    """Images of stpsf's masks and options, and some with its distortion."""
    rows = []
    for words, (options, changes) in ROWS.items():
        call = {**CALL, "fft_oversample": oversample, "detector_oversample": 1, **changes}
        instrument = nircam(folder, npix=npix, **options)
        truth = instrument.calc_psf(**call)
        error = largest(image_of(from_webbpsf(instrument, **call)), truth["DET_SAMP"].data)
        rows.append((f"stpsf, fft_oversample {call['fft_oversample']}", words, error))
        if words in DISTORTED:
            distorted = image_of(from_webbpsf(instrument, add_distortion=True, **call))
            rows.append(("stpsf, DET_DIST", words, largest(distorted, truth["DET_DIST"].data)))
    # The detector is oversampled, as stpsf does by default.
    instrument = nircam(folder, npix=npix)
    call = {"monochromatic": 4.5e-6, "fov_pixels": 80, "oversample": 4}
    image = image_of(from_webbpsf(instrument, add_distortion=True, **call))
    error = largest(image, instrument.calc_psf(**call)["DET_DIST"].data)
    return [*rows, ("stpsf, DET_DIST", "calc_psf's defaults (oversample 4)", error)]


def wavefront_sensing(folder: Path, npix: int) -> Rows:
    """`load_wss_opd` against stpsf's."""
    path = folder / "R2022081102-NRCA3_FP1-1.fits"
    wss_file(path)
    instrument = nircam(folder, npix=npix)
    instrument.load_wss_opd(str(path), verbose=False)
    loaded = load_wss_opd(path, npix=npix)
    error = float(np.abs(loaded.data - instrument.pupilopd[0].data).max())
    instrument.pupilopd.close()
    return [("stpsf, load_wss_opd", "OPD, m", error)]


def on_official_files(folder: Path) -> Rows:
    """Converted models with STScI's files."""
    rows = []
    for options, words in (
        (NEAR, "star at 0.6 arcsec"), (MOVED, "stop shifted and turned"),
    ):  # fmt: skip
        instrument = nircam(folder, npix=1024, **options)
        call = {**FULL, "monochromatic": 4.5e-6}
        truth = instrument.calc_psf(**call)
        for distorted, name in ((False, "DET_SAMP"), (True, "DET_DIST")):
            image = image_of(from_webbpsf(instrument, add_distortion=distorted, **call))
            rows.append((f"STScI's files, {name}", words, largest(image, truth[name].data)))
    return rows


def main() -> None:
    """Compare, and print the tables."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--npix", type=int, default=1024)
    parser.add_argument("--official", type=Path, help="STScI's data directory for stpsf")
    parser.add_argument("--oversample", type=int, default=8, help="of stpsf's FFTs")
    options = parser.parse_args()
    logging.disable(logging.WARNING)
    warnings.simplefilter("ignore")
    with tempfile.TemporaryDirectory() as scratch:
        folder = make_stpsf_data(Path(scratch) / "stpsf-data", options.npix)
        os.environ["STPSF_PATH"] = str(folder)
        rows = [
            *against_poppy(options.npix),
            *against_stpsf(folder, options.npix, options.oversample),
            *wavefront_sensing(folder, options.npix),
        ]
    if options.official:
        path = options.official.resolve()
        os.environ["STPSF_PATH"] = str(path)
        rows += on_official_files(path)
    table = Table(rows=rows, names=("compared with", "quantity", "error"))
    table["error"].format = ".2g"
    table.pprint_all()
    if options.official:
        rings = Table(names=("case", "< 0.3 arcsec", "0.3 to 0.7", "0.7 to 1.2", "1.2 to 2.4"),
                      dtype=("U40", *(4 * [float])))  # fmt: skip
        for case in EMBEDDED:
            rings.add_row((case, *(100 * each for each in differences(path, case, {}))))
        for name in rings.colnames[1:]:
            rings[name].format = ".2f"
        rings.pprint_all()


if __name__ == "__main__":
    main()
