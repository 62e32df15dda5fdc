"""The hard cases: how large their errors are, and how fits of hard data end.

Run from the root of the project, with the package installed:

    python -m benchmarks.stability

It writes reports/stability.md. ``pytest --full -m hard`` holds every line to its limit.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch

from benchmarks import stability_fits as fits
from benchmarks import stability_optics as optics
from benchmarks.provenance import provenance

INTRODUCTION = """# Numerical stability

Written by a script; do not edit.

What has broken codes of this kind, measured on small grids. `pytest -m hard` holds every line to
its limit, and tests what has no number: gradients at exact zeros, masked pixels, damaged files,
processes that are killed.
"""

OPTICS = """
## Images and gradients

{npix} x {npix} samples in the pupil, 32 x 32 pixels, 4.5 um unless the case says otherwise. The
error is the largest difference as a fraction of the image's peak; of a gradient, the length of the
difference as a fraction of its length. An image of zeros has an error of 1, one that is 1 % too
bright of 0.01. Behind a number: its limit.
"""

FITS = """
## Fits

One star of {flux:.0e} photons (those that the pupil collects) on {size} x {size} pixels, with
photon and read noise; Gauss-Newton, from a wavefront {rms:.1f} nm rms away. The error is the rms,
in units of the noise, of fitted minus true star over all pixels, used or not. A star of zeros has
an error of {zeros:.0f}, the transposed star of {transposed:.0f}, one that is 1 % too bright of
{brighter:.1f}. A fit may say that it has converged only if its error is below {success}. The last
number is the largest difference of the star fitted with a float32 model, in units of the noise.
"""

NOTES = """
## What follows

- float32 is good enough for images and for fits: what differs is far below the noise. The
  relative error of its gradient grows as the distance to the truth shrinks.
- Light of sources is added up in float64. In float32 a planet of 1e-10 would have an error of
  {summed:.0%} at 0.3 arcsec and of {summed_far:.0%} at 1 arcsec.
- With another number of threads sums are taken in another order: results agree to rounding, not
  bit by bit. At a fixed number of threads they are the same bits.
- No image shows piston of the whole pupil. Gauss-Newton with free segments (prior 4 nm) leaves it
  at {piston:.2f} nm and reports an error of {unknown:.2f} nm.
- A plain FITS file holds no checksum: a changed pixel value cannot be noticed. Gzipped files are
  checked, and files with CHECKSUM and DATASUM: data that do not add up are an error, a header
  that was edited under its CHECKSUM is a warning.
"""


def optics_table() -> list[str]:
    """Every optical row in both types."""
    lines = ["| case | what could go wrong | float64 | float32 | what the user sees |"]
    lines.append("|---|---|---|---|---|")
    for row in optics.ROWS:
        cells = [
            f"{row.measure(dtype):.1e} ({limit:.0e})"
            for dtype, limit in zip((torch.float64, torch.float32), row.limits, strict=True)
        ]
        lines.append(f"| {row.case} | {row.trouble} | {' | '.join(cells)} | {row.sees} |")
    return lines


def fits_table() -> list[str]:
    """Every fit, in float64."""
    lines = [
        "| case | what could go wrong | status | chi2/pixel | error | float32 | what you see |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in fits.FITS:
        fit, error = row.run(torch.float64)
        single, _ = row.run(torch.float32)
        difference = abs((single.frames[0].star - fit.frames[0].star) / fits.noise()).max()
        lines.append(
            f"| {row.case} | {row.trouble} | {fit.status.name} | {fit.chi2_per_pixel:.3g} | "
            f"{error:.2g} | {difference:.1e} | {row.sees} |"
        )
    return lines


def notes() -> dict[str, float]:
    """Numbers of the last paragraph."""
    pistons = fits.piston_of_segments()
    return {
        "summed": optics.summed_in_float32(0.3),
        "summed_far": optics.summed_in_float32(1.0),
        "piston": abs(pistons.together) / 18**0.5,
        "unknown": pistons.error / 18**0.5,
    }


def main() -> None:
    """Measure, and write the page."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--output", type=Path, default=Path("reports") / "stability.md")
    arguments = parser.parse_args()
    star = fits.star()
    facts = {
        "flux": fits.FLUX,
        "size": fits.SIZE,
        "rms": 1e9 * fits.drift_rms(),
        "zeros": fits.error_of(0 * star + fits.BACKGROUND),
        "transposed": fits.error_of(star.T + fits.BACKGROUND),
        "brighter": fits.error_of(1.01 * star + fits.BACKGROUND),
        "success": fits.SUCCESS,
    }
    lines = [INTRODUCTION, *provenance("-m benchmarks.stability")]
    lines += [OPTICS.format(npix=optics.NPIX), *optics_table()]
    lines += [FITS.format(**facts), *fits_table(), NOTES.format(**notes())]
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    arguments.output.write_text("\n".join(lines), encoding="utf-8")


if __name__ == "__main__":
    main()
