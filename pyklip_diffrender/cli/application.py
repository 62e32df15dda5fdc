"""The program: its commands, its messages and its exit status."""

from __future__ import annotations

import logging
import os
import platform
from collections.abc import Callable, Iterable, Sequence
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pyklip_diffrender._version import __version__
from pyklip_diffrender.cli.session import (
    PROGRAM,
    Command,
    Run,
    archive,
    claim_file,
    claim_folder,
    common,
    declared,
    file_type,
    importing,
    keep_freed_memory,
    open_streams,
    option,
    outputs,
    require_frames,
    require_in_place,
    search,
    together,
    wavefront,
)
from pyklip_diffrender.errors import DiffrenderError

if TYPE_CHECKING:
    from pyklip_diffrender.scene.sequence import ExposureSequence
    from pyklip_diffrender.wavefront.opd import Rule

# The commands that compute something.

_DEMO = ("demo.png", "demo.fits", "demo.ecsv", "candidates.ecsv")


@click.command(
    cls=Command,
    epilog="""\b
Examples:
  pyklip-diffrender demo
  pyklip-diffrender demo --contrast 3e-7 --separation 1 -o faint""",
)
@option("--contrast", type=click.FloatRange(min=0), default=1e-6, show_default=True,
        metavar="RATIO", help="Flux of the planet over the star's.")  # fmt: skip
@option("--separation", type=click.FloatRange(0, 2.3), default=0.6, show_default=True,
        metavar="ARCSEC", help="Separation of the planet from the star.")  # fmt: skip
@option("--hours", type=click.FloatRange(min=0), default=40.0, show_default=True, metavar="H",
        help="Age of the OPD map.")  # fmt: skip
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
    from pyklip_diffrender.io.files import OutputFolder

    products = OutputFolder(output, _DEMO, overwrite=overwrite)
    claim_folder(output, _DEMO)
    with importing():
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

    def write(folder: Path) -> list[Path]:
        save(draw_demo(result), folder / _DEMO[0])
        return [folder / _DEMO[0], *write_demo(result, folder)]

    figure, *written = products.replace(write)
    click.echo()
    click.echo("\n".join(result.table.pformat(max_lines=-1, max_width=-1)))
    click.echo(
        f"\nA planet of contrast {contrast:g} at {separation:g} arcsec; the "
        f"OPD map is {hours:g} h old.\nSNR: the paper's, in the planet's annulus. "
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
    require_in_place(products)


@click.command(
    "reduce",
    cls=Command,
    epilog="""\b
Examples:
  pyklip-diffrender reduce frames --opd maps -o products
  pyklip-diffrender reduce frames --target G-7-34 --filter F444W --opd map.fits -o products
  pyklip-diffrender reduce frames --opd maps -o products --dry-run
  pyklip-diffrender reduce calints.fits --opd flat -o products
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
@option(
    "--star", type=float, nargs=2, metavar="X Y", section="Frames",
    help="Where the target's star is in its files, pixels from 0, in place of what the headers say "
         "and whatever else the frames show.",
)  # fmt: skip
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

    FRAMES are calints files, folders of them, patterns ("frames/*_calints.fits") or association
    files (*_asn.json). With --program they come from MAST. Filters, and epochs more than 5 days
    apart, are reduced one by one, into a folder for each, then searched together, and compared on
    one page.
    """
    require_frames(frames, program)

    def read() -> tuple[ExposureSequence, ...]:
        from pyklip_diffrender.archive import fetch_calints
        from pyklip_diffrender.scene.sequence import ExposureSequence

        files: Any = frames[0] if len(frames) == 1 else frames
        if program is not None:
            if options["dry_run"] and _is_to_fetch(program, target, filter, cache):
                return ()
            files = fetch_calints(
                program, target, filter=filter, folder=cache, progress=run.progress
            )
        return ExposureSequence.by_filter_and_epoch(files, target=target, filter=filter, star=star)

    with importing():
        from pyklip_diffrender.cli.reducing import run_reduction

    run_reduction(run, read, **options)


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
def run_survey(run: Run, /, file: Path, output: Path, scheduler: str | None) -> int:
    """Reduce many sequences, with and without injected planets, as jobs.

    FILE is a TOML file with the sequences and their options. The same command goes on where an
    earlier one was stopped.
    """
    with importing():
        from pyklip_diffrender.surveys import survey

    try:
        table = survey(file, output, scheduler, progress=run.progress)
    except KeyboardInterrupt:
        click.echo(f"{PROGRAM}: interrupted; finished jobs are kept, and the same command goes on",
                   err=True)  # fmt: skip
        return 130
    failed = table[table["status"] == "failed"]
    finished = int((table["status"] == "finished").sum())
    click.echo(f"{finished} of {len(table)} jobs finished, {len(failed)} failed")
    for row in failed:
        click.echo(f"  {row['name']} failed: {row['message']}")
    click.echo(f"wrote {output / 'results.ecsv'} and {output / 'survey.html'}")
    return 1 if len(failed) else 0


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


# The command `pyklip-diffrender learn`.


@click.command(
    "learn",
    cls=Command,
    epilog="""\b
Examples:
  pyklip-diffrender learn calints --opd maps -o patterns/cycle1.fits
  pyklip-diffrender learn calints --star HIP17695 --star G-7-34 --opd maps -o patterns.fits
  pyklip-diffrender learn --program 1184 --filter F444W --opd mast -o patterns.fits
  pyklip-diffrender reduce frames --opd maps --pattern patterns -o products""",
)
@click.argument("frames", type=file_type(), nargs=-1)
@option(
    "--star",
    "stars",
    multiple=True,
    metavar="STAR",
    section="Frames",
    help="A star to learn from, in any spelling; may be repeated. Default: all.",
)
@option(
    "--filter",
    "filters",
    multiple=True,
    metavar="NAME",
    section="Frames",
    help="A filter to use; may be repeated. Default: all.",
)
@archive
@wavefront
@declared(
    "size", section="Fit", default=80, show_default=True,
    help="Side of the fitted square about the star, pixels.",
)  # fmt: skip
@outputs(file="FITS file for the library; finished fits are kept in a folder beside it.")
@click.pass_obj
def learn(
    run: Run,
    /,
    frames: tuple[Path, ...],
    stars: tuple[str, ...],
    filters: tuple[str, ...],
    program: int | None,
    cache: Path | None,
    opd: str,
    opd_date: Rule | None,
    size: int,
    output: Path,
    overwrite: bool,
) -> None:
    """Learn the detector pattern from the frames of many stars.

    FRAMES are calints files, folders of them, patterns ("frames/*_calints.fits") or association
    files (*_asn.json), of stars without bright companions or disks; with --program they come from
    MAST. Every star is fitted alone, and again with the pattern of the
    others, which tells how much a pattern is worth for a star that it was not learned from. The
    same command goes on where an earlier one was stopped.
    """
    from pyklip_diffrender.io.files import OutputFolder, without_fits_suffix

    require_frames(frames, program)
    claim_file(output)
    products = OutputFolder(output.parent, (output.name,), overwrite=overwrite)
    from pyklip_diffrender.archive import fetch_calints
    from pyklip_diffrender.cli.reducing import opd_of
    from pyklip_diffrender.pattern import learn_patterns

    files = list(frames)
    if program is not None:
        files = fetch_calints(
            program,
            filter=filters[0] if len(filters) == 1 else None,
            folder=cache,
            progress=run.progress,
        )
    library = learn_patterns(
        files,
        lambda sequence: opd_of(sequence, opd, opd_date),
        stars=stars,
        filters=filters,
        size=size,
        folder=output.with_name(f"{without_fits_suffix(output.name)}_fits"),
        device=run.device,
        progress=run.progress,
    )
    (path,) = products.replace(lambda folder: [library.write(folder / output.name)])
    table = library.validation
    numbers = ["chi2_alone", "chi2_with_others", "shown"]
    for name in numbers:
        table[name].info.format = ".2f"
    shown = table[["star", "filter", "mask", "flat", "frames", *numbers]]
    click.echo("\n".join(shown.pformat(max_lines=-1, max_width=-1)))
    if len(library.stars) < 2:
        click.echo("only one star: nothing tests its pattern, and it is not used for that star")
    click.echo(f"wrote {path}: {len(library.patterns)} frames of {', '.join(library.stars)}")
    require_in_place(products)


# ``pyklip-diffrender doctor``: whether the package can work here.

_REPORTED_LIBRARIES = (
    "torch", "numpy", "scipy", "astropy", "poppy", "photutils", "pyklip", "matplotlib",
)  # fmt: skip


def check_libraries(names: Iterable[str] = _REPORTED_LIBRARIES) -> str:
    """Import libraries that the package needs; returns their versions."""
    texts = [f"pyklip-diffrender {__version__}", f"Python {platform.python_version()}"]
    for name in names:
        import_module(name)
        texts.append(f"{name} {version(name)}")
    return ", ".join(texts)


def check_data() -> str:
    """Read the library that comes with the package."""
    from pyklip_diffrender.pattern.library import package_library

    return f"{len(package_library().patterns)} detector patterns"


def check_machine() -> str:
    """Look at processors and GPUs."""
    import torch

    gpus = [torch.cuda.get_device_name(k) for k in range(torch.cuda.device_count())]
    return (
        f"{torch.get_num_threads()} threads on {os.cpu_count()} processors, "
        f"{', '.join(gpus) or 'no GPU'}"
    )


CHECKS: tuple[Callable[[], str], ...] = (check_libraries, check_data, check_machine)


@click.command(cls=Command)
@common
@click.pass_obj
def doctor(run: Run) -> int:
    """Check libraries, data files and machine; demo fits a simulated star.

    The exit status is 1 if a check fails.
    """
    failed = False
    for check in CHECKS:
        try:
            click.echo(f"ok    {check()}")
        except Exception as error:  # Broken libraries raise anything.
            click.echo(f"FAIL  {type(error).__name__}: {error}")
            failed = True
    return int(failed)


_log = logging.getLogger(__name__)


@click.group(
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
    subcommand_metavar="COMMAND ...",
)
@click.version_option(__version__, prog_name=PROGRAM, message="%(prog)s %(version)s")
def application() -> None:
    """Find planets in JWST coronagraphic images by refining the wavefront.

    `pyklip-diffrender COMMAND --help` explains a command.
    """


for _command in (demo, reduce_frames, learn, run_survey, doctor):
    application.add_command(_command)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line, and return the exit status.

    It is 0, 1 for an error that a message explains, 2 for wrong options, and 130 if interrupted.
    """
    # Threads of PyTorch that wait in a loop take the processor from other processes. Libraries read
    # this when they are loaded, which is later.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    keep_freed_memory()
    run = Run()
    with open_streams(), run.messages():
        try:
            status = application.main(arguments, prog_name=PROGRAM, standalone_mode=False, obj=run)
        except click.ClickException as error:
            error.show()
            return error.exit_code
        except (click.Abort, KeyboardInterrupt):
            _log.error("interrupted; products that were written are complete")
            return 130
        except (DiffrenderError, OSError) as error:
            _log.error("%s", error)
            return 1
        except (MemoryError, RuntimeError) as error:
            # PyTorch has errors of its own for memory on the processor and on the GPU.
            if isinstance(error, RuntimeError) and "memory" not in str(error):
                raise
            _log.error("not enough memory; a smaller --size or fewer frames need less (%s)", error)
            return 1
    return status if isinstance(status, int) else 0
