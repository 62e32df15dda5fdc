"""The hard cases: how large their errors are, and how fits of hard data end.

Run from the root of the project, with the package installed:

    python -m benchmarks.stability --output docs/results

It writes the tables stability_images.ecsv and stability_fits.ecsv. ``pytest --full -m hard``
holds every row to its limit, and tests what has no number: gradients at exact zeros, masked pixels,
damaged files, processes that are killed.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch
from astropy.table import Table

from benchmarks import stability_fits as fits
from benchmarks import stability_optics as optics
from benchmarks.provenance import provenance
from pyklip_diffrender.io.files import write_table


def images_table() -> Table:
    """Every optical row in both types."""
    rows = []
    for row in optics.ROWS:
        double, single = (row.measure(dtype) for dtype in (torch.float64, torch.float32))
        rows.append((row.case, row.trouble, double, row.limits[0], single, row.limits[1], row.sees))
    names = ("case", "risk", "float64", "float64_limit", "float32", "float32_limit", "seen")
    table = Table(rows=rows, names=names)
    table.meta["about"] = (
        f"{optics.NPIX} x {optics.NPIX} samples in the pupil, 32 x 32 pixels, 4.5 um unless the "
        "case says otherwise; float64 and float32 are largest differences as a fraction of the "
        "image's peak (gradients: relative length of the difference), each with its limit"
    )
    return table


def fits_table() -> Table:
    """Every fit, and the same with a float32 model."""
    rows = []
    for row in fits.FITS:
        fit, error = row.run(torch.float64)
        single, _ = row.run(torch.float32)
        difference = abs((single.frames[0].star - fit.frames[0].star) / fits.noise()).max()
        rows.append((row.case, row.trouble, fit.status.name, fit.chi2_per_pixel, error,
                     float(difference), row.sees))  # fmt: skip
    names = ("case", "risk", "status", "chi2_per_pixel", "error", "float32", "seen")
    table = Table(rows=rows, names=names)
    table.meta["about"] = (
        f"one star of {fits.FLUX:.0e} photons on {fits.SIZE} x {fits.SIZE} pixels, Gauss-Newton "
        f"from a wavefront {1e9 * fits.drift_rms():.1f} nm rms away; error is the rms of fitted "
        "minus true star over all pixels in units of the noise, float32 the largest difference of "
        "the star fitted in single precision, in units of the noise"
    )
    return table


def main() -> None:
    """Measure, print and write the tables."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--output", type=Path, required=True)
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    for name, table in (("images", images_table()), ("fits", fits_table())):
        for column in table.colnames:
            if table[column].dtype.kind == "f":
                table[column].format = ".2g"
        table.meta |= provenance("benchmarks.stability --output docs/results", "poppy")
        table.pprint_all()
        write_table(table, options.output / f"stability_{name}.ecsv")


if __name__ == "__main__":
    main()
