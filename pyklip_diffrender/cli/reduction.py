"""The work of the commands `reduce` and `detect`."""

from __future__ import annotations

import sys
from collections.abc import Callable
from contextlib import nullcontext, redirect_stdout
from json import dumps, loads
from pathlib import Path
from typing import Any

import click

from pyklip_diffrender.cli.estimate import describe_plan, size_of_products
from pyklip_diffrender.cli.run import Run, with_options
from pyklip_diffrender.errors import DiffrenderError, IncompatibleSetupError
from pyklip_diffrender.io.opd_map import OPDMap
from pyklip_diffrender.io.progress import numbered_stages, stage
from pyklip_diffrender.reduction import PRODUCTS, ReduceOptions, prepare
from pyklip_diffrender.scene.sequence import Sequence
from pyklip_diffrender.wavefront.map_choice import Rule, choose_map
from pyklip_diffrender.wavefront.opd import as_opd_map
from pyklip_diffrender.wavefront.wss import load_wss_opd_by_date

__all__ = ["run_reduction"]

_MAST = "mast"
"""Value of --opd for maps that come from MAST."""


def run_reduction(
    run: Run,
    read: Callable[[], Sequence],
    *,
    output: Path,
    overwrite: bool,
    derivatives: bool,
    json: bool,
    dry_run: bool,
    opd: str,
    opd_date: Rule | None,
    **options: Any,
) -> None:
    """Reduce a sequence, write all products and say what they show.

    A dry run makes all the checks of a run, and stops before the first fit.
    """
    if dry_run and json:
        raise click.UsageError("A --dry-run has no summary to print with --json.")
    try:
        checked = ReduceOptions(device=run.device, **options)
    except DiffrenderError as error:
        raise click.UsageError(with_options(str(error))) from error
    run.claim_folder(output, tuple(PRODUCTS), overwrite)
    # Libraries may print, too.
    with redirect_stdout(sys.stderr) if json else nullcontext():
        sequence = read()
        click.echo("\n".join(sequence.table.pformat(max_lines=-1, max_width=-1)))
        for name, reason in sequence.excluded:
            click.echo(f"left out: {name}: {reason}")
        map_ = _map(sequence, opd, opd_date)
        click.echo(f"wavefront map: {map_.name}{_age(map_, sequence)}")
        preparation = prepare(sequence, map_, checked)
        run.require_room(output, size_of_products(preparation.sequence, derivatives=derivatives))
        if dry_run:
            click.echo(describe_plan(preparation.sequence, checked))
            return
        with numbered_stages():
            reduction = preparation.run(progress=run.progress)
            with stage("products"):
                written = reduction.write(output, overwrite=overwrite, derivatives=derivatives)
        summary = loads((output / "summary.json").read_text(encoding="utf-8"))
        click.echo(f"\n{summary['sentence']}\n{with_options(summary['status']['advice'])}\n")
        click.echo(f"wrote {output / 'report.html'} and {len(written) - 1} more files")
    if json:
        click.echo(dumps(summary, indent=2))


def _map(sequence: Sequence, opd: str, rule: Rule | None) -> OPDMap:
    """The wavefront map that --opd and --opd-date ask for."""
    is_folder = Path(opd).is_dir() and opd != "flat"
    if opd != _MAST and not is_folder:
        if rule is not None:
            raise click.UsageError(f"--opd-date is for --opd FOLDER and --opd {_MAST}.")
        return as_opd_map(opd)
    date, rule = sequence.date, rule or "nearest"
    if date is None:
        raise IncompatibleSetupError(
            "the frames have no date (DATE-BEG) to choose a wavefront map by; give the file of one "
            "with --opd"
        )
    if is_folder:
        return choose_map(opd, date, rule)
    return load_wss_opd_by_date(date, "closest" if rule == "nearest" else rule)


def _age(opd: OPDMap, sequence: Sequence) -> str:
    """When a map was sensed, as an apposition."""
    days = None if sequence.date is None else opd.days_after(sequence.date)
    if opd.date is None or days is None:
        return ""
    side = "after" if days > 0 else "before"
    return f", sensed {opd.date.isot[:16]}, {abs(days):.1f} days {side} the frames"
