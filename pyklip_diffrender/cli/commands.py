"""The commands that compute something."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pyklip_diffrender.cli.session import Run
from pyklip_diffrender.cli.shared_options import (
    Command,
    archive,
    common,
    file_type,
    option,
    outputs,
    require_frames,
    search,
    together,
    wavefront,
)
from pyklip_diffrender.errors import IncompatibleSetupError

if TYPE_CHECKING:
    from pyklip_diffrender.scene.sequence import Sequence

__all__ = ["demo", "detect_in_file", "psf", "reduce_frames", "survey"]

_DEMO = ("demo.fits", "demo.ecsv", "candidates.ecsv", "demo.png")


@click.command(
    cls=Command,
    epilog="""\b
Examples:
  pyklip-diffrender demo
  pyklip-diffrender demo --contrast 3e-7 --separation 1 -o faint""",
)
@option("--contrast", type=click.FloatRange(min=0), default=1e-6, show_default=True,
        metavar="RATIO", help="Flux of the planet over that of the star.")  # fmt: skip
@option("--separation", type=click.FloatRange(0, 2.3), default=0.6, show_default=True,
        metavar="ARCSEC", help="Separation of the planet from the star.")  # fmt: skip
@option("--hours", type=click.FloatRange(min=0), default=40.0, show_default=True, metavar="H",
        help="Age of the wavefront map.")  # fmt: skip
@option("--seed", type=int, default=1, show_default=True, metavar="N",
        help="Random seed of wavefront, drift and noise.")  # fmt: skip
@outputs("diffrender-demo")
@click.pass_obj
def demo(
    run: Run,
    contrast: float,
    separation: float,
    hours: float,
    seed: int,
    output: Path,
    overwrite: bool,
) -> None:
    """Show KLIP and wavefront refinement side by side on a simulated planet.

    Needs no data, half a minute and 2 GB of memory.
    """
    run.claim_folder(output, _DEMO, overwrite)
    from pyklip_diffrender.demo import draw_demo, run_demo, write_demo
    from pyklip_diffrender.drawing import save

    result = run_demo(
        contrast=contrast,
        separation=separation,
        hours=hours,
        seed=seed,
        progress=run.progress,
        device=run.device,
    )
    written = write_demo(result, output)
    figure = output / "demo.png"
    save(draw_demo(result), figure)
    click.echo()
    click.echo("\n".join(result.table.pformat(max_lines=-1, max_width=-1)))
    click.echo(
        f"\nA planet of contrast {contrast:g} at {separation:g} arcsec; the "
        f"wavefront map is {hours:g} h old.\nSNR: the paper's, in the planet's annulus. "
        "Throughput: fraction of the planet's light that is kept;\nit says nothing where much of "
        "the star remains, as with the initial map. Star error: rms\nresidual of the star in that "
        "annulus, in units of the noise.\n"
        f"Refinement: {result.fit.status}.\n\n"
        "Point sources with the wavefront marginalised, which loses none of the planet:"
    )
    for row in result.detection.candidates:
        click.echo(
            f"  {row['separation'].to_value('arcsec'):.3f} arcsec at "
            f"{row['position_angle'].to_value('deg'):.1f} deg: contrast {row['contrast']:.2e} +- "
            f"{row['contrast_error']:.1e}, S/N {row['snr']:.1f}"
        )
    if not len(result.detection.candidates):
        click.echo(f"  none above {result.detection.threshold:g} sigma")
    click.echo(f"\nwrote {figure} and {len(written)} more files")


def _star_callback(
    ctx: click.Context, parameter: click.Parameter, text: str | None
) -> tuple[float, float] | None:
    """The position of a star from "x,y"."""
    if text is None:
        return None
    try:
        x, y = (float(part) for part in str(text).strip("()[] ").split(","))
    except ValueError:
        raise click.BadParameter(
            f"got {text!r}, expected x,y of the star in pixels from 0, such as 150,174.2",
            ctx, parameter,
        ) from None  # fmt: skip
    return x, y


_STAR = option(
    "--star", metavar="X,Y", section="Frames", callback=_star_callback,
    help="Where the target's star is in its files, pixels from 0, in place of what the headers say "
         "and whatever else the frames show.",
)  # fmt: skip


@click.command(
    "reduce",
    cls=Command,
    epilog="""\b
Examples:
  pyklip-diffrender reduce frames --opd maps -o products
  pyklip-diffrender reduce frames --target G-7-34 --filter F444W --opd map.fits -o products
  pyklip-diffrender reduce frames --opd maps -o products --dry-run
  pyklip-diffrender reduce --program 1184 --target G-7-34 --filter F444W --opd map.fits -o out""",
)
@click.argument("frames", type=file_type(), nargs=-1)
@option("--target", metavar="STAR", section="Frames",
        help="Name of the target, in any spelling; the other stars are references.")  # fmt: skip
@option(
    "--filter",
    metavar="NAME",
    section="Frames",
    help="Which filter; default: all of the target's, one by one.",
)
@_STAR
@archive
@wavefront
@search
@together
@outputs()
@click.pass_obj
def reduce_frames(
    run: Run,
    /,
    frames: tuple[Path, ...],
    target: str | None,
    filter: str | None,
    star: tuple[float, float] | None,
    program: int | None,
    cache: Path | None,
    **options: Any,
) -> None:
    """Subtract the star from all rolls of a target and search for planets.

    FRAMES are calints files, or one folder of them. With --program they come from MAST. Filters,
    and epochs more than 5 days apart, are reduced one by one, into a folder for each, then searched
    together, and compared on one page.
    """
    require_frames(frames, program)

    def read() -> tuple[Sequence, ...]:
        from pyklip_diffrender.archive import fetch_calints
        from pyklip_diffrender.scene.sequence import Sequence

        files: Any = frames[0] if len(frames) == 1 else frames
        if program is not None:
            if options["dry_run"] and _is_to_fetch(program, target, filter, cache):
                return ()
            files = fetch_calints(
                program, target, filter=filter, folder=cache, progress=run.progress
            )
        return Sequence.by_filter_and_epoch(files, target=target, filter=filter, star=star)

    from pyklip_diffrender.cli.reducing import run_reduction

    run_reduction(run, read, **options)


@click.command(
    "detect",
    cls=Command,
    epilog="""\b
Examples:
  pyklip-diffrender detect calints.fits --opd map.fits -o products
  pyklip-diffrender detect calints.fits --opd maps --opd-date before -o products
  pyklip-diffrender detect calints.fits --opd maps -o products --json | jq .sentence""",
)
@click.argument("frames", type=file_type())
@_STAR
@wavefront
@search
@outputs()
@click.pass_obj
def detect_in_file(
    run: Run, /, frames: Path, star: tuple[float, float] | None, **options: Any
) -> None:
    """Subtract the star from a single file and search for planets.

    FRAMES is a calints file.
    """

    def read() -> tuple[Sequence, ...]:
        from pyklip_diffrender.scene.sequence import Sequence

        if frames.is_dir():
            raise IncompatibleSetupError(
                f"{frames} is a folder, expected a file; the command reduce takes folders"
            )
        return (Sequence.from_files([frames], star=star),)

    from pyklip_diffrender.cli.reducing import run_reduction

    run_reduction(run, read, **options)


@click.command(
    cls=Command,
    epilog="""\b
Examples:
  pyklip-diffrender psf --filter F356W --offset 0.02 0 -o star.fits
  pyklip-diffrender psf --filter F460M --mask MASKLWB -o star.fits
  pyklip-diffrender psf --monochromatic 4.5e-6 --opd map.fits -o star.fits""",
)
@option("--filter", default="F444W", show_default=True, metavar="NAME", help="Filter of NIRCam.")
@option("--mask", default="MASK335R", show_default=True, metavar="NAME",
        help="Coronagraph mask of NIRCam.")  # fmt: skip
@option("--monochromatic", type=float, metavar="M", help="A single wavelength, m.")
@option("--opd", default="flat", show_default=True, metavar="FILE|flat",
        help="Wavefront map: a FITS file, or flat.")  # fmt: skip
@option("--size", type=click.IntRange(min=1), default=80, show_default=True, metavar="N",
        help="Side of the image, pixels.")  # fmt: skip
@option("--offset", type=float, nargs=2, default=(0.0, 0.0), show_default=True,
        metavar="X Y", help="Star from the occulter's centre, arcsec.")  # fmt: skip
@outputs(file="The FITS file to write.")
@click.pass_obj
def psf(
    run: Run,
    output: Path,
    filter: str,
    mask: str,
    monochromatic: float | None,
    opd: str,
    size: int,
    offset: tuple[float, float],
    overwrite: bool,
) -> None:
    """Write the image of a star behind the coronagraph."""
    run.claim_file(output, overwrite)
    import numpy as np
    from astropy.io import fits

    from pyklip_diffrender.instrument.nircam import nircam_coronagraph
    from pyklip_diffrender.io.files import write_fits
    from pyklip_diffrender.io.headers import fits_text
    from pyklip_diffrender.wavefront.opd import as_opd_map, resample

    model = nircam_coronagraph(
        filter,
        image_mask=mask,
        monochromatic=monochromatic,
        fov_pixels=size,
        device=run.device,
    )
    edge = size / 2 * min(model.detector.pixelscale)
    if not np.abs(offset).max() < edge:
        raise IncompatibleSetupError(
            f"offset: got {offset[0]:g} {offset[1]:g}, expected a star inside the image, less "
            f"than {edge:.3g} arcsec from its centre along x and y. Choose a larger size (--size)"
        )
    map_ = as_opd_map(opd)
    pixels = model.calc_psf(opd=resample(map_.data, model.npix), star_offset=offset)["DET_SAMP"]
    hdu = fits.PrimaryHDU(pixels.data, pixels.header)
    del hdu.header["EXTNAME"]
    hdu.header["BUNIT"] = ("", "fraction of the light that the pupil collects")
    hdu.header["PUPILOPD"] = (fits_text(map_.name), "Pupil OPD source")
    hdu.header["STAROFFX"] = (offset[0], "x of the star from the mask's centre, arcsec")
    hdu.header["STAROFFY"] = (offset[1], "y of the star from the mask's centre, arcsec")
    write_fits(fits.HDUList([hdu]), output)
    click.echo(f"wrote {output}")


@click.command(
    "survey",
    cls=Command,
    epilog="""\b
Examples:
  pyklip-diffrender survey survey.toml -o products
  pyklip-diffrender survey survey.toml -o products --scheduler tcp://host:8786""",
)
@click.argument("file", type=file_type())
@option("-o", "--output", type=file_type(), required=True, metavar="FOLDER",
        help="Folder for jobs and tables. Finished jobs are not repeated.")  # fmt: skip
@option("--scheduler", metavar="ADDRESS", help="Of a dask scheduler; default a local cluster.")
@common
@click.pass_obj
def survey(run: Run, /, file: Path, output: Path, scheduler: str | None) -> int:
    """Reduce many sequences, with and without injected planets, as jobs.

    FILE is a TOML file with the sequences and their options. The same command goes on where an
    earlier one was stopped.
    """
    from pyklip_diffrender.cli.survey import run as run_survey

    run.configured = True
    return run_survey(file, output, scheduler, progress=run.progress)


def _is_to_fetch(program: int, target: str | None, filter: str | None, cache: Path | None) -> bool:
    """List the files of a programme; whether some of them would have to be fetched."""
    from pyklip_diffrender.archive import list_calints

    listing = list_calints(program, target, filter=filter, folder=cache)
    names = ["file", "filter", "size", "access", "complete"]
    click.echo("\n".join(listing[names].pformat(max_lines=-1, max_width=-1)))
    missing = listing[~listing["complete"]]
    size = missing["size"].to_value("Mbyte").sum()
    click.echo(f"to fetch: {len(missing)} of {len(listing)} files, {size:.0f} MB")
    return len(missing) > 0
