"""Error against time of one image, for every mask, beside stpsf.

Run from the root of the project, with stpsf installed and its data named by STPSF_PATH::

    STPSF_PATH=... python -m benchmarks.masks [NAME ...]

Images are monochromatic, of 80 x 80 pixels, of a star on the axis, with 1024 samples across the
pupil. stpsf computes with 2 and 4 points per lambda/D in the plane of the mask, and this package
with 2 cells. The error of either is the largest difference from its own limit (stpsf's optics with
8 points, by the converted model, which agrees with stpsf to rounding; this package with 8 cells),
over the peak of the image, which the mask has made fainter. Times are those of the processor with
one thread, after a first image that fills caches; of this package, the best of three.

Prints a row for each mask; with ``--own``, without stpsf.
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
from numpy.typing import NDArray

import pyklip_diffrender as dr

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


def stpsf_cells(name: str) -> tuple[list[str], float]:
    """Times and errors of stpsf for a mask, and its time with 4 points per lambda/D, s."""
    import stpsf

    aperture, band, wavelength = MASKS[name]
    mask = aperture.split("_")[2]
    nircam = stpsf.NIRCam()
    nircam.filter, nircam.image_mask = band, mask
    nircam.pupil_mask = mask if mask.endswith("WB") else "MASKRND"
    nircam.set_position_from_aperture_name(aperture)
    nircam.pupil = str(Path(os.environ["STPSF_PATH"]) / f"jwst_pupil_RevW_npix{NPIX}.fits.gz")
    nircam.options["nd_squares"] = False
    call = {"monochromatic": wavelength, "detector_oversample": 1, "fov_pixels": SIZE}
    limit = dr.from_webbpsf(nircam, **call, fft_oversample=8, add_distortion=False)().numpy()
    cells, seconds = [], np.nan
    for points in (2, 4):

        def calculate(points: int = points) -> Image:
            psf = nircam.calc_psf(**call, fft_oversample=points, add_distortion=False)
            return np.asarray(psf["DET_SAMP"].data)

        image, seconds = timed(calculate)
        cells += [f"{seconds:.1f}", f"{error(image, limit):.0e}"]
    return cells, seconds


def own_cells(name: str) -> tuple[list[str], float]:
    """Time and error of this package for a mask, and the time, s."""
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
    return [f"{seconds:.3f}", f"{error(images[2], images[8]):.0e}"], seconds


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("names", nargs="*", default=list(MASKS))
    parser.add_argument("--own", action="store_true", help="without stpsf")
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    columns = ["mask", "this, s", "error"]
    if not options.own:
        columns += ["stpsf 2, s", "error", "stpsf 4, s", "error", "stpsf 4 / this"]
        stpsf_cells(options.names[0])  # Fills its caches.
    print(f"| {' | '.join(columns)} |\n{'|---' * len(columns)}|", flush=True)
    for name in options.names:
        cells, seconds = own_cells(name)
        if not options.own:
            theirs, longer = stpsf_cells(name)
            cells += [*theirs, f"{longer / seconds:.0f}"]
        print(f"| {' | '.join([name, *cells])} |", flush=True)


if __name__ == "__main__":
    main()
