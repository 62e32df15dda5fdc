"""The command line. Nothing heavy is imported before a command needs it."""

from __future__ import annotations

import argparse
import logging
import sys
from collections import abc
from pathlib import Path
from typing import TYPE_CHECKING

from pyklip_diffrender.errors import DiffrenderError, IncompatibleSetupError

if TYPE_CHECKING:
    from pyklip_diffrender.scene.sequence import Sequence

__all__ = ["main"]


def _parser() -> argparse.ArgumentParser:
    from pyklip_diffrender import __version__

    parser = argparse.ArgumentParser(
        prog="pyklip-diffrender",
        description="Find planets in JWST coronagraphic images by refining the wavefront.",
    )
    parser.add_argument("--version", action="version", version=f"%(prog)s {__version__}")
    # Before and after the command alike.
    common = argparse.ArgumentParser(add_help=False)
    common.add_argument("-v", "--verbose", action="store_true", help="log every step")
    common.add_argument("-q", "--quiet", action="store_true", help="show no progress bars")
    common.add_argument(
        "--overwrite", action="store_true", help="replace existing products of an earlier run"
    )
    frames = argparse.ArgumentParser(add_help=False)
    frames.add_argument(
        "--opd", type=Path, required=True, help="wavefront map to start from (FITS)"
    )
    frames.add_argument("-o", "--output", type=Path, required=True, help="folder for the products")
    frames.add_argument("--size", type=int, default=80, help="side of the fitted square, pixels")
    frames.add_argument("--threshold", type=float, default=5.0, help="S/N of a candidate")
    frames.add_argument(
        "--systematics",
        default="auto",
        help="pattern of the model's error: 'auto' (the package's library, else the reference "
        "stars), 'references' (both), 'off', or a systematics.fits of an earlier reduction",
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    demo = commands.add_parser(
        "demo",
        parents=[common],
        help="a simulated planet with KLIP and wavefront refinement side by side",
    )
    demo.add_argument("-o", "--output", type=Path, default=Path("diffrender-demo"))
    demo.add_argument("--contrast", type=float, default=1e-6)
    demo.add_argument("--separation", type=float, default=0.6, help="arcsec")
    demo.add_argument("--hours", type=float, default=40.0, help="age of the wavefront map")
    demo.add_argument("--seed", type=int, default=1)
    demo.set_defaults(run=_demo, products="demo.fits")

    reduce = commands.add_parser(
        "reduce",
        parents=[common, frames],
        help="search all rolls of a target, with what its reference stars teach",
        epilog="example: pyklip-diffrender reduce frames/ --target G-7-34 --filter F444W "
        "--opd wavefront.fits -o products",
    )
    reduce.add_argument("frames", type=Path, nargs="+", help="calints files, or a folder of them")
    reduce.add_argument("--target", help="name of the target; the other stars are references")
    reduce.add_argument("--filter", help="which filter, if the files have several")
    reduce.add_argument(
        "--dry-run", action="store_true", help="list what would be reduced, and stop"
    )
    reduce.set_defaults(run=_reduce, products="detection.fits")

    detect = commands.add_parser(
        "detect", parents=[common, frames], help="search a single calints file"
    )
    detect.add_argument("frames", type=Path, help="calints file")
    detect.set_defaults(run=_detect, products="detection.fits")

    psf = commands.add_parser(
        "psf", parents=[common], help="write the image of a star behind the coronagraph"
    )
    psf.add_argument("output", type=Path, help="FITS file to write")
    psf.add_argument("--filter", default="F444W")
    psf.add_argument("--monochromatic", type=float, help="wavelength, m")
    psf.add_argument("--opd", type=Path, help="wavefront map (FITS); default a flat wavefront")
    psf.add_argument("--size", type=int, default=80, help="side of the image, pixels")
    psf.add_argument("--offset", type=float, nargs=2, default=(0.0, 0.0), metavar=("X", "Y"),
                     help="star from the occulter's centre, arcsec")  # fmt: skip
    psf.set_defaults(run=_psf, products="")

    survey = commands.add_parser(
        "survey", parents=[common], help="reduce many sequences, with and without injected planets"
    )
    survey.add_argument("config", type=Path, help="TOML file that lists sequences and options")
    survey.add_argument("-o", "--output", type=Path, required=True, help="folder for the products")
    survey.add_argument("--scheduler", help="address of a dask scheduler, such as tcp://host:8786")
    survey.set_defaults(run=_survey, products="jobs")
    return parser


def main(arguments: abc.Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit status."""
    options = _parser().parse_args(arguments)
    logging.basicConfig(
        level=logging.INFO if options.verbose else logging.WARNING, format="%(message)s"
    )
    try:
        # A survey goes on with what is there.
        _require_free(
            options.output, options.products, options.overwrite or options.command == "survey"
        )
        status: int | None = options.run(options)
    except DiffrenderError as error:
        print(f"pyklip-diffrender: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("pyklip-diffrender: interrupted; nothing was written", file=sys.stderr)
        return 130
    return status or 0


def _require_free(output: Path, product: str, overwrite: bool) -> None:
    """Refuse, before any work, an output that could not be written or would be replaced.

    Raises
    ------
    IncompatibleSetupError
    """
    if product and output.exists() and not output.is_dir():
        raise IncompatibleSetupError(f"--output: {output} is a file, expected a folder")
    taken = output / product if product else output
    if taken.exists() and not overwrite:
        raise IncompatibleSetupError(
            f"--output: {taken} exists; choose another place, or replace it with --overwrite"
        )


def _demo(options: argparse.Namespace) -> None:
    from pyklip_diffrender.demo import run_demo, write_demo
    from pyklip_diffrender.plotting import draw_demo, save

    result = run_demo(
        contrast=options.contrast,
        separation=options.separation,
        hours=options.hours,
        seed=options.seed,
        progress=not options.quiet,
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
        options.filter, monochromatic=options.monochromatic, fov_pixels=options.size
    )
    opd = None if options.opd is None else resample(read_opd(options.opd).data, model.npix)
    image = model(opd, tuple(options.offset))
    hdu = fits.PrimaryHDU(image.numpy())
    hdu.header["PIXELSCL"] = (model.detector.pixelscale[0], "arcsec")
    hdu.header["FILTER"] = options.filter.upper()
    write_fits(fits.HDUList([hdu]), options.output)
    print(f"wrote {options.output}")


def _survey(options: argparse.Namespace) -> int:
    from pyklip_diffrender.surveys.command import run

    return run(options.config, options.output, options.scheduler, progress=not options.quiet)


def _detect(options: argparse.Namespace) -> None:
    from pyklip_diffrender.scene.observation import Observation
    from pyklip_diffrender.scene.sequence import Sequence

    observation = Observation.from_fits(options.frames)
    _search(Sequence(observation.target, (observation,)), options)


def _reduce(options: argparse.Namespace) -> None:
    from pyklip_diffrender.scene.sequence import Sequence

    frames = options.frames[0] if len(options.frames) == 1 else options.frames
    sequence = Sequence.from_files(frames, target=options.target, filter=options.filter)
    print("\n".join(sequence.table.pformat(max_lines=-1, max_width=-1)))
    for name, reason in sequence.excluded:
        print(f"left out: {name}: {reason}")
    if not options.dry_run:
        _search(sequence, options)


def _search(sequence: Sequence, options: argparse.Namespace) -> None:
    """Reduce a sequence, write all products and say what they show."""
    from pyklip_diffrender.plotting import draw_detection, save
    from pyklip_diffrender.reduction import reduce
    from pyklip_diffrender.refinement import Systematics

    known = options.systematics
    if known not in ("auto", "references", "off"):
        known = Systematics.read(known)
    reduction = reduce(
        sequence,
        options.opd,
        size=options.size,
        systematics=known,
        threshold=options.threshold,
        progress=not options.quiet,
    )
    written = reduction.write(options.output)
    figure = options.output / "detection.png"
    save(draw_detection(reduction.detection), figure)
    print(f"\n{reduction}")
    for path in (*written, figure):
        print(f"wrote {path}")
