"""The work of the command `reduce`."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from json import loads
from pathlib import Path
from typing import Any

import click

from pyklip_diffrender.cli.session import Run, claim_folder, require_in_place
from pyklip_diffrender.detection import COMBINED, Combination, checked_motion
from pyklip_diffrender.errors import DiffrenderError, IncompatibleSetupError
from pyklip_diffrender.instrument import planet_spectra
from pyklip_diffrender.instrument.spectrum import star_flux_density
from pyklip_diffrender.io.files import OutputFolder, read_text
from pyklip_diffrender.io.progress import counted, numbered_stages, stage
from pyklip_diffrender.options import SPECTRA, Accuracy, ReduceOptions
from pyklip_diffrender.pattern import (
    PatternLibrary,
    combine_libraries,
    known_pattern,
    package_library,
)
from pyklip_diffrender.reduction.pipeline import (
    Preparation,
    frames_for_pattern,
    frames_in_likelihood,
    prepare,
)
from pyklip_diffrender.reduction.products import PRODUCTS, ProductFolder, read_summary
from pyklip_diffrender.reduction.several import (
    COMPARISON,
    in_words,
    search_together,
    write_comparison,
)
from pyklip_diffrender.scene.sequence import SHORT, ExposureSequence, by_reason
from pyklip_diffrender.wavefront.opd import Rule, as_opd_map, choose_opd
from pyklip_diffrender.wavefront.opd_map import OPDMap
from pyklip_diffrender.wavefront.wss import load_wss_opd_by_date

_MAST = "mast"
"""Value of --opd for maps that come from MAST."""


def run_reduction(
    run: Run,
    read: Callable[[], tuple[ExposureSequence, ...]],
    *,
    output: Path,
    overwrite: bool,
    dry_run: bool,
    derivatives: bool,
    spectra: tuple[str, ...],
    proper_motion: tuple[str, str] | None,
    parallax: str | None,
    opd: str,
    opd_date: Rule | None,
    star_sed: str | None,
    quick: bool,
    **keywords: Any,
) -> None:
    """Reduce the epochs and filters of a target, write all products and say what they show.

    A dry run makes all the checks of a run, and stops before the first fit.
    """
    if star_sed is not None and keywords["star_flux"] is not None:
        raise click.UsageError("--star-flux and --star-sed both say how bright the star is.")
    accuracy: Accuracy = "quick" if quick else ReduceOptions.accuracy
    try:
        checked_motion(proper_motion, parallax)
        options = ReduceOptions(device=run.device, accuracy=accuracy, **keywords)
    except DiffrenderError as error:
        raise click.UsageError(str(error)) from error
    # What is there now may be replaced if the user says so, but not what other runs write later.
    writing = {"derivatives": derivatives, "overwrite": overwrite}
    whole = ProductFolder(output, **writing)
    claim_folder(output, (*PRODUCTS, *COMPARISON, *COMBINED))
    above = OutputFolder(output, (*COMPARISON, *COMBINED), overwrite=overwrite)
    earlier = [ProductFolder(each, overwrite=True) for each in _listed(output)]
    sequences = read()
    if not sequences:
        return
    several = len(sequences) > 1
    folders = [output / name for name in _names(sequences)] if several else [output]
    written = [ProductFolder(each, **writing) for each in folders] if several else [whole]
    _require_flux_and_spectra(sequences, options, spectra)
    prepared = []
    for sequence, folder in zip(sequences, folders, strict=True):
        if several:
            claim_folder(folder, tuple(PRODUCTS))
            click.echo(f"\n{folder.name}, one of {len(sequences)} reductions:")
        _show(sequence)
        start = opd_of(sequence, opd, opd_date)
        click.echo(f"OPD map: {start.name}{_age(start, sequence)}")
        own = options
        if star_sed is not None:
            flux = star_flux_density(star_sed, sequence.filter or "unknown")
            click.echo(f"star: {flux.value:.4g} Jy in {sequence.filter}, by {Path(star_sed).name}")
            own = replace(options, star_flux=flux)
        prepared.append(prepare(sequence, start, own))
        if dry_run:
            click.echo(describe_steps(prepared[-1].sequence, prepared[-1].options))
    if dry_run:
        return
    summaries = {
        products.folder: _reduced(preparation, products, progress=run.progress)
        for preparation, products in zip(prepared, written, strict=True)
    }
    place = above.place() if several else output
    above.clear()
    _clear([whole, *earlier], folders)
    if several:
        search = {"spectra": spectra or SPECTRA, "star": star_sed}
        motion = {"motion": proper_motion, "parallax": parallax}
        _compared(summaries, place, **search, **motion)
    require_in_place(*written, above)


def _clear(earlier: Iterable[ProductFolder], used: Collection[Path]) -> None:
    """Delete products of an earlier run from folders that this run has not used."""
    for each in earlier:
        if each.asked not in used:
            each.clear()
            if each.asked.is_dir() and not any(each.asked.iterdir()):
                each.asked.rmdir()


def _reduced(preparation: Preparation, products: ProductFolder, *, progress: bool) -> Any:
    """Reduce a sequence, write its products and say what they show; returns the summary."""
    with numbered_stages():
        reduction = preparation.run(progress=progress, keep=products.keep)
        with stage("products"):
            files = products.keep(reduction)
    click.echo(f"wrote {products.folder / 'report.html'} and {len(files) - 1} more files")
    summary = read_summary(products.folder)
    status = summary["status"]
    click.echo(f"\n{summary['sentence']}\n{status['name']}: {status['message']}.")
    click.echo(status["advice"])
    return summary


def _compared(summaries: Mapping[Path, Any], place: Path, **search: Any) -> None:
    """Search finished reductions together, and compare them on a page in the folder `place`.

    `summaries` are by the folders of the reductions, and `search` the arguments of
    `search_together`.
    """
    combination = search_together(list(summaries), **search)
    named = {
        Path(os.path.relpath(folder, place)).as_posix(): each for folder, each in summaries.items()
    }
    page, _ = write_comparison(named, place, combination)
    if isinstance(combination, Combination):
        combination.write(place)
    click.echo(f"\nwrote {page}, which compares them\n{in_words(combination)}")


def describe_steps(sequence: ExposureSequence, options: ReduceOptions) -> str:
    """The steps of a reduction of a cut sequence, one in each line."""
    pattern = options.pattern
    searched = pattern == "auto" or isinstance(pattern, PatternLibrary)
    libraries = [pattern] if isinstance(pattern, PatternLibrary) else []
    library = combine_libraries([*libraries, package_library()])
    known = searched and known_pattern(sequence.science[0], library=library) is not None
    teaching, joining = (
        frames(sequence, options) for frames in (frames_for_pattern, frames_in_likelihood)
    )
    steps = []
    if known or not (searched or pattern == "references"):
        teaching = ()
    if known:
        unplaced = [each.name for each in sequence.science if each.first_pixel is None]
        steps += [f"place of {name} on the detector" for name in unplaced]
    steps += [f"reference star {star}" for star in dict.fromkeys(e.target for e in teaching)]
    steps.append("wavefront")
    if joining:
        steps.append("reference stars and target together")
    steps.append("search")
    if options.disk:
        steps += ["extended light, and wavefront without it", "search without extended light"]
    if options.wide:
        steps.append("whole frames")
    if options.injections:
        steps.append(f"{options.injections} injected planets")
    if options.completeness:
        steps.append("completeness")
    used = [*teaching, *joining]
    unused = sum(not any(each is one for one in used) for each in sequence.references)
    only = f", with {counted(unused, 'reference frame')} for KLIP only"
    steps.append(f"products{only if unused else ''}")
    return "\n".join(f"{number}. {step}" for number, step in enumerate(steps, 1))


def _require_flux_and_spectra(
    sequences: Sequence[ExposureSequence], options: ReduceOptions, spectra: tuple[str, ...]
) -> None:
    """Raise an exception, before any fit, for what does not hold in several filters."""
    filters = list(dict.fromkeys(each.filter or "unknown" for each in sequences))
    if options.star_flux is not None and len(filters) > 1:
        raise IncompatibleSetupError(
            f"--star-flux: got one flux density for {', '.join(filters)}, expected one for each. "
            "Choose a --filter, or give the star's spectrum with --star-sed"
        )
    listed = [each for each in spectra if each != "free"]
    if listed and len(filters) > 1 and "unknown" not in filters:
        planet_spectra(listed, filters)


def _names(sequences: Sequence[ExposureSequence]) -> list[str]:
    """Names of the folders of sequences: their dates or filters, or both if both differ."""
    days = [_day(each) for each in sequences]
    filters = [each.filter or "unknown" for each in sequences]
    if len(set(filters)) == 1:
        return days
    if len(set(filters)) == len(filters):
        return filters
    return [f"{day}_{name}" for day, name in zip(days, filters, strict=True)]


def _listed(output: Path) -> list[Path]:
    """Folders of the epochs and filters of an earlier run."""
    _, data = (output / name for name in COMPARISON)
    with suppress(OSError, ValueError, KeyError, TypeError):
        listed = loads(read_text(data))["reductions"]
        # Only names, so that a file that was changed cannot point outside the folder.
        folders = {output / Path(each["folder"]).name for each in listed}
        return sorted(folder for folder in folders if folder.is_dir())
    return []


def _day(sequence: ExposureSequence) -> str:
    """First date of a sequence."""
    dates = [each.date.isot[:10] for each in sequence.science if each.date is not None]
    return min(dates, default="no-date")


def _show(sequence: ExposureSequence) -> None:
    """List the frames that are used, and those that are not with the reason."""
    table = sequence.table
    used = table[table["use"] != "excluded"]
    click.echo("\n".join(used[list(SHORT)].pformat(max_lines=-1, max_width=-1)))
    for row in used:
        if row["remark"]:
            click.echo(f"{row['file']}: {row['remark']}")
    for names, reason in by_reason(sequence.excluded):
        click.echo(f"left out: {names}: {reason}")


def opd_of(sequence: ExposureSequence, opd: str, rule: Rule | None) -> OPDMap:
    """The OPD map that --opd and --opd-date ask for."""
    is_folder = Path(opd).is_dir() and opd != "flat"
    if opd != _MAST and not is_folder:
        if rule is not None:
            raise click.UsageError(f"--opd-date is for --opd FOLDER and --opd {_MAST}.")
        return as_opd_map(opd)
    date, rule = sequence.date, rule or "nearest"
    if date is None:
        raise IncompatibleSetupError(
            "the frames have no date (DATE-BEG) to choose an OPD map by; give the file of one "
            "with --opd"
        )
    if is_folder:
        return choose_opd(opd, date, rule)
    return load_wss_opd_by_date(date, rule)


def _age(opd: OPDMap, sequence: ExposureSequence) -> str:
    """When a map was sensed, as an apposition."""
    if opd.date is None or sequence.date is None:
        return ""
    return f", sensed {opd.date.isot[:16]}, {opd.age(sequence.date)} the frames"
