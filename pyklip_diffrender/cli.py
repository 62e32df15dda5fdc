"""The command line. Nothing heavy is imported before a command needs it."""

from __future__ import annotations

import argparse
import logging
import sys
from collections.abc import Sequence
from pathlib import Path

from pyklip_diffrender.errors import DiffrenderError

__all__ = ["main"]


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="pyklip-diffrender",
        description="Star subtraction for JWST coronagraphy by refining the wavefront.",
    )
    parser.add_argument("-v", "--verbose", action="store_true", help="say what is being done")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    demo = commands.add_parser(
        "demo", help="a simulated planet, KLIP and wavefront refinement side by side"
    )
    demo.add_argument("-o", "--output", type=Path, default=Path("diffrender-demo"))
    demo.add_argument("--contrast", type=float, default=1e-6)
    demo.add_argument("--separation", type=float, default=0.6, help="arcsec")
    demo.add_argument("--hours", type=float, default=40.0, help="age of the wavefront map")
    demo.add_argument("--seed", type=int, default=1)
    demo.set_defaults(run=_demo)

    psf = commands.add_parser("psf", help="write the image of a star behind the coronagraph")
    psf.add_argument("output", type=Path, help="FITS file to write")
    psf.add_argument("--filter", default="F444W")
    psf.add_argument("--monochromatic", type=float, help="wavelength, m")
    psf.add_argument("--opd", type=Path, help="OPD map (FITS); default a flat wavefront")
    psf.add_argument("--fov-pixels", type=int, default=80)
    psf.add_argument("--offset", type=float, nargs=2, default=(0.0, 0.0), metavar=("X", "Y"),
                     help="star from the occulter's centre, arcsec")  # fmt: skip
    psf.set_defaults(run=_psf)

    refine = commands.add_parser("refine", help="refine a wavefront on a calints file")
    refine.add_argument("frames", type=Path, help="calints FITS")
    refine.add_argument("opd", type=Path, help="OPD map (FITS)")
    refine.add_argument("-o", "--output", type=Path, required=True, help="FITS file to write")
    refine.add_argument("--fov-pixels", type=int, default=80)
    refine.set_defaults(run=_refine)
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit status."""
    options = _parser().parse_args(arguments)
    logging.basicConfig(
        level=logging.INFO if options.verbose else logging.WARNING, format="%(message)s"
    )
    try:
        options.run(options)
    except DiffrenderError as error:
        print(f"pyklip-diffrender: {error}", file=sys.stderr)
        return 1
    return 0


def _demo(options: argparse.Namespace) -> None:
    from pyklip_diffrender.demo import run_demo, write_demo
    from pyklip_diffrender.report import draw_demo, save

    result = run_demo(
        contrast=options.contrast,
        separation=options.separation,
        hours=options.hours,
        seed=options.seed,
        progress=True,
    )
    written = write_demo(result, options.output)
    figure = options.output / "demo.png"
    save(draw_demo(result), figure)
    print()
    print("\n".join(result.table.pformat(max_lines=-1, max_width=-1)))
    print(
        f"\nA planet of contrast {options.contrast:g} at {options.separation:g} arcsec; the "
        f"wavefront map is {options.hours:g} h old.\nSNR: the paper's, in the planet's annulus. "
        "Throughput: share of the planet's light kept.\nStar error: rms of what is left of the "
        "star in that annulus, in units of the noise.\n"
        f"Refinement: {result.fit.status.message}."
    )
    for path in (*written, figure):
        print(f"wrote {path}")


def _psf(options: argparse.Namespace) -> None:
    from astropy.io import fits

    from pyklip_diffrender.files import write_fits
    from pyklip_diffrender.nircam import nircam_coronagraph
    from pyklip_diffrender.opd import read_opd, resample

    model = nircam_coronagraph(
        options.filter, monochromatic=options.monochromatic, fov_pixels=options.fov_pixels
    )
    opd = None if options.opd is None else resample(read_opd(options.opd).data, model.npix)
    image = model(opd, tuple(options.offset))
    hdu = fits.PrimaryHDU(image.numpy())
    hdu.header["PIXELSCL"] = (model.detector.pixelscale[0], "arcsec")
    hdu.header["FILTER"] = options.filter.upper()
    write_fits(fits.HDUList([hdu]), options.output)
    print(f"wrote {options.output}")


def _refine(options: argparse.Namespace) -> None:
    import numpy as np
    from astropy.io import fits

    from pyklip_diffrender.files import write_fits
    from pyklip_diffrender.nircam import nircam_coronagraph
    from pyklip_diffrender.observation import Observation
    from pyklip_diffrender.refinement import refine
    from pyklip_diffrender.refinement.presets import NIRCAM_FIT, NIRCAM_MODEL

    observation = Observation.from_fits(options.frames).cutout(options.fov_pixels)
    model = nircam_coronagraph(
        observation.filter or "", fov_pixels=options.fov_pixels, **NIRCAM_MODEL
    )
    fit = refine(model, observation, options.opd, progress=True, **NIRCAM_FIT)
    primary = fits.PrimaryHDU()
    for key, value in fit.summary().items():
        primary.header[f"HIERARCH {key}"] = value
    hdus = fits.HDUList(
        [
            primary,
            fits.ImageHDU(fit.residual.astype(np.float32), name="RESIDUAL"),
            fits.ImageHDU(fit.star_image.astype(np.float32), name="STAR"),
            fits.ImageHDU(fit.opd.astype(np.float32), name="OPD"),
        ]
    )
    hdus["OPD"].header["BUNIT"] = "m"
    write_fits(hdus, options.output)
    print(fit.parameters["name", "value", "error", "unit"])
    print(fit.status.message)
    print(f"wrote {options.output}")
