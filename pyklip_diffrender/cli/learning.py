"""The command `pyklip-diffrender learn`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from pyklip_diffrender.cli.session import Run
from pyklip_diffrender.cli.shared_options import (
    Command,
    archive,
    file_type,
    option,
    outputs,
    require_frames,
    wavefront,
)

if TYPE_CHECKING:
    from pyklip_diffrender.wavefront.map_choice import Rule

__all__ = ["learn"]

_COLUMNS = ("star", "filter", "mask", "flat", "frames", "chi2_alone", "chi2_with_others", "shown")


@click.command(
    "learn",
    cls=Command,
    epilog="""\b
Examples:
  pyklip-diffrender learn calints --opd maps -o patterns/cycle1.fits
  pyklip-diffrender learn calints --star HIP17695 --star G-7-34 --opd maps -o patterns.fits
  pyklip-diffrender learn --program 1184 --filter F444W --opd mast -o patterns.fits
  pyklip-diffrender reduce frames --opd maps --systematics patterns -o products""",
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
@option(
    "--size",
    type=click.IntRange(min=8),
    default=80,
    show_default=True,
    metavar="N",
    section="Fit",
    help="Side of the fitted square about the star, pixels.",
)
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
    """Learn the flat-field pattern from the frames of many stars.

    FRAMES are calints files, or folders of them, of stars without bright companions or disks; with
    --program they come from MAST. Every star is fitted alone, and again with the pattern of the
    others, which tells how much a pattern is worth for a star that it was not learned from. The
    same command goes on where an earlier one was stopped.
    """
    require_frames(frames, program)
    run.claim_file(output, overwrite)
    from pyklip_diffrender.archive import fetch_calints
    from pyklip_diffrender.cli.reducing import map_for
    from pyklip_diffrender.pattern import learn_library

    files = list(frames)
    if program is not None:
        files = fetch_calints(
            program,
            filter=filters[0] if len(filters) == 1 else None,
            folder=cache,
            progress=run.progress,
        )
    library = learn_library(
        files,
        lambda sequence: map_for(sequence, opd, opd_date),
        stars=stars,
        filters=filters,
        size=size,
        folder=output.with_name(f"{output.name.removesuffix('.gz').removesuffix('.fits')}_fits"),
        device=run.device,
        progress=run.progress,
    )
    library.write(output, overwrite=overwrite)
    table = library.validation
    for name in ("chi2_alone", "chi2_with_others", "shown"):
        table[name].info.format = ".2f"
    click.echo("\n".join(table[list(_COLUMNS)].pformat(max_lines=-1, max_width=-1)))
    if len(library.stars) < 2:
        click.echo("only one star: nothing tests its pattern, and it is not used for that star")
    click.echo(f"wrote {output}: {len(library.patterns)} frames of {', '.join(library.stars)}")
