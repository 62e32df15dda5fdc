"""Error against time of one image, for every mask, beside stpsf.

Run from the root of the project, with stpsf installed and its data named by STPSF_PATH::

    STPSF_PATH=... python -m benchmarks.masks [NAME ...]

Images are monochromatic, of 80 x 80 pixels, of a star on the axis, with 1024 samples across the
pupil. stpsf computes with 2 and 4 points per lambda/D in the plane of the mask, and this package
with 2 cells. The error of either is the largest difference from its own limit (stpsf's optics with
8 points, by the converted model, which agrees with stpsf to rounding; this package with 8 cells),
over the peak of the image, which the mask has made fainter. Times are those of the processor with
one thread, after a first image that fills caches; of this package, the best of three.

Prints a row for each mask; with ``--own`` without stpsf.
"""

from __future__ import annotations

import argparse
import os
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from astropy.table import Table
from numpy.typing import NDArray

import pyklip_diffrender as dr
from benchmarks.stpsf_data import nircam, stop_of

MASKS = {
    "MASK210R": ("NRCA2_FULL_MASK210R", "F210M", 2.1e-6),
    "MASK335R short": ("NRCA2_FULL_MASK335R", "F210M", 2.1e-6),
    "MASK430R short": ("NRCA2_FULL_MASK430R", "F210M", 2.1e-6),
    "MASK335R": ("NRCA5_FULL_MASK335R", "F444W", 4.5e-6),
    "MASK430R": ("NRCA5_FULL_MASK430R", "F444W", 4.5e-6),
    "MASKSWB": ("NRCA4_FULL_MASKSWB_F210M", "F210M", 2.1e-6),
    "MASKLWB": ("NRCA5_FULL_MASKLWB_F460M", "F460M", 4.6e-6),
}
"""Aperture, filter and wavelength (m) by name."""

SIZE, NPIX = 80, 1024

Image = NDArray[np.float64]


def timed(function: Callable[[], Any], count: int = 1) -> tuple[Any, float]:
    """The result of a function and its shortest time of the processor, s."""
    value, best = None, np.inf
    for _ in range(count):
        began = time.process_time()
        value = function()
        best = min(best, time.process_time() - began)
    return value, best


def error(image: Image, limit: Image) -> float:
    """Largest difference over the peak."""
    return float(np.abs(image - limit).max() / limit.max())


def by_stpsf(name: str) -> list[float]:
    """Times, s, and errors of stpsf for a mask, with 2 and 4 points per lambda/D."""
    aperture, band, wavelength = MASKS[name]
    mask = aperture.split("_")[2]
    instrument = nircam(Path(os.environ["STPSF_PATH"]), mask, stop_of(mask), band, NPIX,
                        aperture=aperture, nd_squares=False)  # fmt: skip
    call = {"monochromatic": wavelength, "detector_oversample": 1, "fov_pixels": SIZE}
    limit = dr.from_webbpsf(instrument, **call, fft_oversample=8, add_distortion=False)().numpy()
    values = []
    for points in (2, 4):

        def calculate(points: int = points) -> Image:
            psf = instrument.calc_psf(**call, fft_oversample=points, add_distortion=False)
            return np.asarray(psf["DET_SAMP"].data)

        image, seconds = timed(calculate)
        values += [seconds, error(image, limit)]
    return values


def by_package(name: str) -> list[float]:
    """Time, s, and error of this package for a mask."""
    aperture, band, wavelength = MASKS[name]
    opd = torch.from_numpy(dr.wavefront.random_opd(1, npix=NPIX).data)
    images = {}
    for cells in (8, 2):
        model = dr.nircam_coronagraph(
            band, image_mask=aperture.split("_")[2], monochromatic=wavelength, npix=NPIX,
            fov_pixels=SIZE, occulter_sampling=cells,
        )  # fmt: skip
        with torch.no_grad():
            images[cells], seconds = timed(lambda model=model: model(opd).numpy(), 4)
    return [seconds, error(images[2], images[8])]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("names", nargs="*", default=list(MASKS))
    parser.add_argument("--own", action="store_true", help="without stpsf")
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    columns = ["mask", "s", "error"]
    if not options.own:
        columns += ["stpsf 2, s", "stpsf 2, error", "stpsf 4, s", "stpsf 4, error"]
        by_stpsf(options.names[0])  # Fills its caches.
    rows = []
    for name in options.names:
        rows.append((name, *by_package(name), *([] if options.own else by_stpsf(name))))
        print(*rows[-1], flush=True)
    table = Table(rows=rows, names=columns)
    for column in columns[1:]:
        table[column].format = ".2g"
    table.pprint_all()


if __name__ == "__main__":
    main()
