"""The command line. Nothing heavy is imported before a command needs it."""

from __future__ import annotations

import argparse
import logging
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from pyklip_diffrender.errors import DiffrenderError

if TYPE_CHECKING:
    from pyklip_diffrender.refinement import Refinement

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
    refine.add_argument("--plan", choices=("auto", "off"), default="auto", help="model fidelity")
    refine.set_defaults(run=_refine)

    detect = commands.add_parser(
        "detect", help="look for companions in a calints file, the wavefront integrated out"
    )
    detect.add_argument("frames", type=Path, help="calints FITS")
    detect.add_argument("opd", type=Path, help="OPD map (FITS)")
    detect.add_argument("-o", "--output", type=Path, required=True, help="folder to write into")
    detect.add_argument("--fov-pixels", type=int, default=80)
    detect.add_argument("--plan", choices=("auto", "off"), default="auto", help="model fidelity")
    detect.add_argument("--threshold", type=float, default=5.0, help="S/N of a candidate")
    detect.set_defaults(run=_detect)

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
    from pyklip_diffrender.plotting import draw_demo, save

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
        f"Refinement: {result.fit.status.message}.\n\n"
        "Point sources with the wavefront integrated out, which loses none of the planet:"
    )
    for row in result.detection.table:
        print(
            f"  {row['separation'].to_value('arcsec'):.3f} arcsec at "
            f"{row['position_angle'].to_value('deg'):.1f} deg: contrast {row['contrast']:.2e} +- "
            f"{row['contrast_error']:.1e}, S/N {row['snr']:.1f}"
        )
    if not len(result.detection.table):
        print(f"  none above {result.detection.threshold:g} sigma")
    for path in (*written, figure):
        print(f"wrote {path}")


def _psf(options: argparse.Namespace) -> None:
    from astropy.io import fits

    from pyklip_diffrender.instrument.nircam import nircam_coronagraph
    from pyklip_diffrender.io.files import write_fits
    from pyklip_diffrender.wavefront.opd import read_opd, resample

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


def _fitted(options: argparse.Namespace) -> Refinement:
    from pyklip_diffrender.refinement import refine
    from pyklip_diffrender.scene.observation import Observation
    from pyklip_diffrender.scene.real_frames import model_for

    observation = Observation.from_fits(options.frames)
    model = model_for(observation, options.fov_pixels)
    cutout = observation.cutout(options.fov_pixels)
    fit = refine(model, cutout, options.opd, progress=True, plan=options.plan)
    if fit.plan is not None:
        print(f"{fit.plan}\n")
    return fit


def _detect(options: argparse.Namespace) -> None:
    from pyklip_diffrender.detection import detect
    from pyklip_diffrender.plotting import draw_detection, save

    fit = _fitted(options)
    found = detect(fit, threshold=options.threshold, progress=True)
    written = found.write(options.output)
    figure = options.output / "detection.png"
    save(draw_detection(found), figure)
    print(found.table["separation", "position_angle", "contrast", "contrast_error", "snr"])
    print(f"{fit.status.message}; errors scaled by {found.scatter:.3g}")
    for path in (*written, figure):
        print(f"wrote {path}")


def _refine(options: argparse.Namespace) -> None:
    import numpy as np
    from astropy.io import fits

    from pyklip_diffrender.io.files import write_fits

    fit = _fitted(options)
    (frame,) = fit.frames
    primary = fits.PrimaryHDU()
    for key, value in fit.summary().items():
        primary.header[f"HIERARCH {key}"] = value
    hdus = fits.HDUList(
        [
            primary,
            fits.ImageHDU(frame.residual.astype(np.float32), name="RESIDUAL"),
            fits.ImageHDU(frame.star.astype(np.float32), name="STAR"),
            fits.ImageHDU(fit.wavefront.real.astype(np.float32), name="OPD"),
        ]
    )
    hdus["OPD"].header["BUNIT"] = "m"
    write_fits(hdus, options.output)
    print(fit.parameters["name", "value", "error", "unit"])
    print(fit.status.message)
    print(f"wrote {options.output}")
