"""The work of the commands `reduce`, `detect` and `survey`, and estimates of what it takes."""

from __future__ import annotations

import math
import sys
from collections import Counter, abc
from collections.abc import Callable
from contextlib import nullcontext, redirect_stdout, suppress
from dataclasses import replace
from json import dumps, loads
from pathlib import Path
from typing import Any, Literal

import click

from pyklip_diffrender.cli.session import Run, config_remark, free_memory, with_options
from pyklip_diffrender.detection import COMBINED, Combination
from pyklip_diffrender.detection.recovery import TOGETHER
from pyklip_diffrender.errors import DiffrenderError, IncompatibleSetupError
from pyklip_diffrender.instrument import planet_spectra
from pyklip_diffrender.instrument.spectrum import star_flux_density
from pyklip_diffrender.io.files import read_text
from pyklip_diffrender.io.progress import duration, numbered_stages, stage
from pyklip_diffrender.options import Accuracy, ReduceOptions
from pyklip_diffrender.pattern import (
    PatternLibrary,
    combine_libraries,
    known_systematics,
    package_library,
)
from pyklip_diffrender.reduction import (
    COMPARISON,
    PRODUCTS,
    SPECTRA,
    UNFINISHED,
    ProductFolder,
    existing_products,
    in_words,
    prepare,
    search_together,
    write_comparison,
)
from pyklip_diffrender.reduction.pipeline import frames_for_pattern, frames_in_likelihood
from pyklip_diffrender.reduction.visit import worth_joining
from pyklip_diffrender.scene.exposure import proper_motion as motion_of
from pyklip_diffrender.scene.observation import Observation
from pyklip_diffrender.scene.sequence import SHORT, Sequence
from pyklip_diffrender.surveys.driver import survey
from pyklip_diffrender.wavefront.opd import Rule, as_opd_map, choose_map
from pyklip_diffrender.wavefront.opd_map import OPDMap
from pyklip_diffrender.wavefront.wss import load_wss_opd_by_date

__all__ = [
    "describe_plan",
    "map_for",
    "run",
    "run_reduction",
    "size_of_products",
    "steps_of",
]


# Steps of a reduction, and estimates of their time, memory and room on disk.

# Seconds on two cores. Measured for the first roll of G 7-34 in F444W, 80 x 80 pixels, in processor
# time of one thread of an AMD EPYC: 40 s for the fit, 11 s for the search, 10 s for products. Two
# threads take 0.7 of that. The place of HIP 65426 on the detector took 0.6 of its fit. In two rolls
# of AU Mic, the fits with extended light take 1.2 (F356W) and 1.7 times (F444W) the time of the fit
# before; in HIP 17695 the fit with the star's flux takes three fifths of it. Exponents as
# documented.
_FIT = 29.0
_PLACE = 0.6
_QUICK = 0.3
_SEARCH = 8.0
_DISK = 1.4
_TIED = 0.6
_WIDE = 10.0
_COMPLETENESS = 90.0
_WRITE = 7.0
_FRAMES = 0.88
_JOINT = 0.9
_PIXELS = 0.17
_MEMORY = 1.4e9
_MEMORY_PER_FRAME = 0.4e9

# Bytes that reading takes for each of the largest file: pixels and errors of four bytes and a mask,
# of files with flags and no more. Measured: 0.75 (tests/test_memory_of_reading.py bounds it).
_READING = 0.8
_BEFORE_READING = 0.7e9

# Bytes for frames of 80 x 80 pixels.
_REPORT = 5e6
_PRODUCTS = 10e6
_DERIVATIVES = 50e6


def steps_of(sequence: Sequence, options: ReduceOptions) -> list[tuple[str, float]]:
    """The stages of a reduction of a cut sequence, each with its duration on two cores, s."""
    count = len(sequence.science)
    systematics = options.systematics
    area = (options.side / 80) ** 2
    # The time of a fit grows with the powers `_PIXELS` of the pixels and `_FRAMES` of the frames.
    fit = _FIT * area**_PIXELS * (_QUICK if options.accuracy == "quick" else 1.0)
    steps = []
    searched = systematics == "auto" or isinstance(systematics, PatternLibrary)
    libraries = [systematics] if isinstance(systematics, PatternLibrary) else []
    library = combine_libraries([*libraries, package_library()])
    known = searched and known_systematics(sequence.science[0], library=library) is not None
    teaching = frames_for_pattern(sequence, options)
    stars = Counter(each.target for each in teaching)
    if known:
        steps += [
            (f"place of {each.name} on the detector", _PLACE * fit)
            for each in sequence.science
            if each.first_pixel is None
        ]
    elif searched or systematics == "references":
        steps += [(f"reference star {star}", fit * n**_FRAMES) for star, n in stars.items()]
    joint = fit * count**_FRAMES * (1 + _TIED * (options.star_flux is not None))
    steps.append(("wavefront", joint))
    others: abc.Sequence[Observation] = frames_in_likelihood(sequence, options)
    if known or (teaching and searched):
        others = worth_joining(others)
    if others:
        steps.append(("reference stars and target together", fit * _JOINT * (count + len(others))))
    refit = _DISK * joint * options.disk
    search = _SEARCH * area * count
    steps.append(("search", search))
    more = options.disk or options.wide or options.injections or options.completeness
    if more:
        steps.append(("products after the stage search", _WRITE))
    if options.disk:
        steps.append(("extended light, and wavefront without it", refit))
        steps.append(("search without extended light", search))
    if options.wide:
        steps.append(("whole frames", _WIDE * count))
    if options.injections:
        seconds = joint + refit + _SEARCH * area * count
        # Each round adds several planets at once, and fits and searches the frames again.
        rounds = math.ceil(options.injections / TOGETHER)
        steps.append((f"{options.injections} injected planets", rounds * seconds))
    if options.completeness:
        steps.append(("completeness", _COMPLETENESS * area * count))
    steps.append(("products", _WRITE))
    return steps


def size_of_products(sequence: Sequence, *, derivatives: bool) -> float:
    """Bytes that the products of a reduction may take, with some to spare."""
    ny, nx = sequence.science[0].shape
    each = _PRODUCTS + _DERIVATIVES * derivatives
    return _REPORT + each * len(sequence.science) * nx * ny / 80**2


def describe_plan(sequence: Sequence, options: ReduceOptions) -> str:
    """Steps, time and memory as lines of text; arguments as for `steps_of`."""
    steps = steps_of(sequence, options)
    lines = [f"{k}. {name}: about {duration(s)}" for k, (name, s) in enumerate(steps, 1)]
    total = sum(seconds for _, seconds in steps)
    frames = len(sequence.science) + len(frames_in_likelihood(sequence, options))
    memory = _MEMORY + _MEMORY_PER_FRAME * frames * (options.side / 80) ** 2
    files = [row.path for row in sequence.rows if row.path is not None and row.path.exists()]
    largest = max((path.stat().st_size for path in files), default=0)
    # A reduction reads before it fits, and what it has read is then the means of integrations.
    memory = max(memory, _BEFORE_READING + _READING * largest)
    free = free_memory()
    of = "" if free is None else f" ({free / 1e9:.1f} GB are free)"
    lines.append(
        f"in all about {duration(total)} on two cores, up to twice as long if a companion makes "
        f"a second fit necessary, and {memory / 1e9:.1f} GB of memory{of}"
    )
    return "\n".join(lines)


# The work of the commands `reduce` and `detect`.

_MAST = "mast"
"""Value of --opd for maps that come from MAST."""


def run_reduction(
    run: Run,
    read: Callable[[], tuple[Sequence, ...]],
    *,
    output: Path,
    overwrite: bool,
    derivatives: bool,
    figures: Literal["pdf", "png", "svg"] | None,
    json: bool,
    dry_run: bool,
    resume: bool,
    quick: bool,
    opd: str,
    opd_date: Rule | None,
    star_sed: str | None,
    spectra: tuple[str, ...] = (),
    proper_motion: tuple[float, float] | None = None,
    parallax: float | None = None,
    **options: Any,
) -> None:
    """Reduce the epochs and filters of a target, write all products and say what they show.

    A dry run makes all the checks of a run, and stops before the first fit.
    """
    if dry_run and json:
        raise click.UsageError("A --dry-run has no summary to print with --json.")
    if resume and overwrite:
        raise click.UsageError("--resume keeps products, and --overwrite replaces them.")
    if star_sed is not None and options["star_flux"] is not None:
        raise click.UsageError("--star-flux and --star-sed both say how bright the star is.")
    try:
        accuracy: Accuracy = "quick" if quick else ReduceOptions.accuracy
        checked = ReduceOptions(device=run.device, accuracy=accuracy, **options)
    except DiffrenderError as error:
        raise click.UsageError(with_options(str(error)) + config_remark()) from error
    run.claim_folder(output, (*PRODUCTS, *COMPARISON, *COMBINED), overwrite or resume)
    # Libraries may print, too.
    with redirect_stdout(sys.stderr) if json else nullcontext():
        sequences = read()
        if not sequences:
            return
        several = len(sequences) > 1
        folders = [output / name for name in _names(sequences)] if several else [output]
        filters = list(dict.fromkeys(each.filter or "unknown" for each in sequences))
        if checked.star_flux is not None and len(filters) > 1:
            raise IncompatibleSetupError(
                f"star_flux: got one flux density for {', '.join(filters)}, expected one for each. "
                "Choose a --filter, or give the star's spectrum with --star-sed"
            )
        prepared = []
        for sequence, folder in zip(sequences, folders, strict=True):
            if several:
                run.claim_folder(folder, tuple(PRODUCTS), overwrite or resume)
                click.echo(f"\n{folder.name}, one of {len(sequences)} reductions:")
            _show(sequence)
            map_ = map_for(sequence, opd, opd_date)
            click.echo(f"wavefront map: {map_.name}{_age(map_, sequence)}")
            prepared.append(prepare(sequence, map_, _with_flux(checked, star_sed, sequence.filter)))
            if dry_run:
                click.echo(describe_plan(prepared[-1].sequence, prepared[-1].options))
        if several:
            _require_spectra(spectra, filters)
        sizes = (size_of_products(each.sequence, derivatives=derivatives) for each in prepared)
        run.require_room(output, sum(sizes))
        if dry_run:
            return
        summaries = {}
        for preparation, folder in zip(prepared, folders, strict=True):
            if resume and _is_finished(folder):
                click.echo(f"{folder}: this reduction has finished")
            else:
                products = ProductFolder(
                    folder,
                    derivatives=derivatives,
                    figures=figures,
                    overwrite=overwrite,
                    resume=resume,
                )
                try:
                    with numbered_stages(dict(steps_of(preparation.sequence, preparation.options))):
                        reduction = preparation.run(progress=run.progress, products=products)
                        with stage("products"):
                            written = products.finish(reduction)
                except KeyboardInterrupt:
                    if (folder / UNFINISHED).exists():
                        click.echo("to go on, repeat the command with --resume", err=True)
                    raise
                click.echo(f"wrote {folder / 'report.html'} and {len(written) - 1} more files")
            summary = loads(read_text(folder / "summary.json"))
            summaries[folder.name] = summary
            status = summary["status"]
            click.echo(f"\n{summary['sentence']}\n{status['name']}: {status['message']}.")
            click.echo(with_options(status["advice"]))
        if overwrite:
            _remove_others(output, folders)
        if several:
            first = sequences[0].science[0]
            motion = proper_motion or motion_of(first.header, first.name)
            combination = search_together(
                folders, spectra=spectra or SPECTRA, star=star_sed, motion=motion, parallax=parallax
            )
            if isinstance(combination, str):
                combination = with_options(combination)
            page, data = write_comparison(summaries, motion, output, combination)
            summary = loads(read_text(data))
            if isinstance(combination, Combination):
                combination.write(output, overwrite=overwrite or resume)
            click.echo(f"\nwrote {page}, which compares them\n{in_words(combination)}")
    if json:
        click.echo(dumps(summary, indent=2))


def _is_finished(folder: Path) -> bool:
    """Whether a folder has the products of a reduction that was not interrupted."""
    return (folder / "summary.json").exists() and not (folder / UNFINISHED).exists()


def _require_spectra(spectra: tuple[str, ...], filters: list[str]) -> None:
    """Raise an exception, before any fit, for spectra that cannot be combined in the filters."""
    listed = [each for each in spectra if each != "free"]
    if listed and len(filters) > 1 and "unknown" not in filters:
        planet_spectra(listed, filters)


def _with_flux(options: ReduceOptions, star_sed: str | None, name: str | None) -> ReduceOptions:
    """Options with the star's flux density in a filter, from its spectrum if there is one."""
    if star_sed is None:
        return options
    flux = star_flux_density(star_sed, name or "unknown")
    click.echo(f"star: {flux.value:.4g} Jy in {name}, by {Path(star_sed).name}")
    return replace(options, star_flux=flux)


def _names(sequences: abc.Sequence[Sequence]) -> list[str]:
    """Names of the folders of sequences: their dates or filters, or both if both differ."""
    days = [_day(each) for each in sequences]
    filters = [each.filter or "unknown" for each in sequences]
    if len(set(filters)) == 1:
        return days
    if len(set(filters)) == len(filters):
        return filters
    return [f"{day}_{name}" for day, name in zip(days, filters, strict=True)]


def _remove_others(output: Path, folders: list[Path]) -> None:
    """Remove the products of an earlier run from other folders than those of this one."""
    earlier = [output]
    page, data = (output / name for name in COMPARISON)
    if data.exists():
        with suppress(ValueError, KeyError, TypeError):
            listed = loads(read_text(data))["reductions"]
            # Only names, so that a file that was changed cannot point outside the folder.
            earlier += [output / Path(each["folder"]).name for each in listed]
    for folder in set(earlier) - set(folders):
        for path in existing_products(folder):
            path.unlink()
        if folder != output and folder.is_dir() and not any(folder.iterdir()):
            folder.rmdir()
    for path in (page, data, *(output / name for name in COMBINED)):
        path.unlink(missing_ok=True)


def _day(sequence: Sequence) -> str:
    """First date of a sequence."""
    dates = [each.date.isot[:10] for each in sequence.science if each.date is not None]
    return min(dates, default="no-date")


def _show(sequence: Sequence) -> None:
    """List the frames that are used, and those that are not with the reason."""
    table = sequence.table
    used = table[table["use"] != "excluded"]
    click.echo("\n".join(used[list(SHORT)].pformat(max_lines=-1, max_width=-1)))
    for row in used:
        if row["remark"]:
            click.echo(f"{row['file']}: {row['remark']}")
    for name, reason in sequence.excluded:
        click.echo(f"left out: {name}: {reason}")


def map_for(sequence: Sequence, opd: str, rule: Rule | None) -> OPDMap:
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
    return load_wss_opd_by_date(date, rule)


def _age(opd: OPDMap, sequence: Sequence) -> str:
    """When a map was sensed, as an apposition."""
    if opd.date is None or sequence.date is None:
        return ""
    return f", sensed {opd.date.isot[:16]}, {opd.age(sequence.date)} the frames"


# The command `pyklip-diffrender survey`.


def run(config: Path, output: Path, scheduler: str | None = None, *, progress: bool = False) -> int:
    """Run a survey, and return the exit status: 1 if some jobs failed, 130 if interrupted."""
    try:
        table = survey(config, output, scheduler, progress=progress)
    except KeyboardInterrupt:
        click.echo(
            "pyklip-diffrender: interrupted; finished jobs are kept, and the same command goes on",
            err=True,
        )
        return 130
    failed = table[table["status"] == "failed"]
    counts = {status: int((table["status"] == status).sum()) for status in ("finished", "failed")}
    click.echo(f"{counts['finished']} of {len(table)} jobs finished, {counts['failed']} failed")
    # The candidates of a job with an injected planet include that planet.
    real = (table["status"] == "finished") & table["injected_contrast"].mask
    for row in table[real & ~table["snr"].mask]:
        click.echo(
            f"  {row['name']}: S/N {row['snr']:.1f} at {row['separation_arcsec']:.3f} arcsec, "
            f"contrast {row['contrast']:.2e} +- {row['contrast_error']:.1e}"
        )
    for star in table.meta["combined"]:
        if "reason" in star:
            click.echo(f"  {star['star']}: no combined search: {star['reason']}")
            continue
        for each in star["candidates"]:
            verdict = f", {each['verdict']}" if "verdict" in each else ""
            click.echo(
                f"  {star['star']}, all filters and epochs: S/N {each['snr']:.1f} at "
                f"{each['separation_arcsec']:.3f} arcsec ({each['spectrum']}){verdict}"
            )
    for row in failed:
        click.echo(f"  {row['name']} failed: {row['message']}")
    for name in ("results.ecsv", "results.parquet", "survey.html"):
        if (output / name).exists():
            click.echo(f"wrote {output / name}")
    return 1 if len(failed) else 0
