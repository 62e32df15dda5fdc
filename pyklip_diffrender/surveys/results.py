"""The results of a survey so far: searches of each star, a table of all jobs, and one page."""

from __future__ import annotations

import json
import logging
import os
import shutil
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from astropy import units as u
from astropy.table import MaskedColumn, Table

from pyklip_diffrender import drawing
from pyklip_diffrender._version import __version__
from pyklip_diffrender.detection import Combination, Detection
from pyklip_diffrender.errors import CorruptFileError, IncompatibleSetupError
from pyklip_diffrender.io.files import read_text, sha256
from pyklip_diffrender.io.progress import counted, duration
from pyklip_diffrender.options import SPECTRA
from pyklip_diffrender.reduction.pages import Picture, curve_arrays, render
from pyklip_diffrender.reduction.products import read_summary
from pyklip_diffrender.reduction.several import (
    COMPARISON,
    by_star,
    in_words,
    search_together,
    write_comparison,
)
from pyklip_diffrender.reduction.summary import LIMITS_ARCSEC
from pyklip_diffrender.surveys.jobs import Job, Record, clean, folder_of, hash_of, staged

# The filters and epochs of each star, searched together when its jobs have ended.

FOLDER = "combined"
"""Folder of the searches of stars, in the survey's folder."""

Group = Sequence[tuple[Job, Detection]]
"""Jobs of one star with their searches, in order of time."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class StarSearch:
    """The search over all filters and epochs of a star.

    Attributes
    ----------
    star : str
    folder : str
        Folder of the search, in the survey's folder.
    jobs : tuple of str
        Names of the jobs.
    combined : dict
        What ``comparison.json`` has of it: the content of `Combination.to_dict`, or the `reason`
        why there is none.
    """

    star: str
    folder: str
    jobs: tuple[str, ...]
    combined: Mapping[str, Any]


def search_stars(
    rows: Sequence[tuple[Job, Record | None]], output: Path, spectra: Sequence[str]
) -> list[StarSearch]:
    """Search the finished reductions of each star together, where it has several.

    Searches of the same jobs with the same spectra that are in the folder already are kept.

    Parameters
    ----------
    rows : sequence of (Job, dict or None)
        Jobs with their records. Those with injected planets are not searched.
    output : Path
        Folder of the survey.
    spectra : sequence of str
        See `combine`; empty for its defaults.

    Returns
    -------
    list of StarSearch

    Raises
    ------
    IncompatibleSetupError
        If the output cannot be written to.
    """
    spectra = spectra or SPECTRA
    jobs: dict[str, Job] = {}
    searched: dict[str, Detection] = {}
    for job, record in rows:
        if job.injection is not None or record is None or record["status"] != "finished":
            continue
        try:
            searched[job.key] = Detection.read(output / "jobs" / job.folder)
        except CorruptFileError as error:
            _log.warning("%s is in no combined search: %s", job, error)
            continue
        jobs[job.key] = job
    found = []
    for star, group in by_star(searched).items():
        if len(group) > 1:
            dated = sorted(group, key=lambda key: (group[key].sky.mjd or 0.0, str(jobs[key])))
            try:
                found.append(
                    _search(star, [(jobs[key], group[key]) for key in dated], output, spectra)
                )
            except OSError as error:
                raise IncompatibleSetupError(
                    f"output: the search of {star} cannot be written to {output} "
                    f"({error.strerror}). Make room, and start the survey again: finished jobs are "
                    "kept"
                ) from error
    return found


def _search(star: str, group: Group, output: Path, spectra: Sequence[str]) -> StarSearch:
    """Search one star, unless that was done before."""
    listed = [sha256(each) if os.path.isfile(each) else each for each in spectra]
    keys = [job.key for job, _ in group]
    key = hash_of({"version": __version__, "jobs": keys, "spectra": listed})
    final = output / FOLDER / folder_of(star, key)
    names = tuple(str(job) for job, _ in group)
    data = final / COMPARISON[1]
    combined = _combined_in(data)
    if combined is None:
        shutil.rmtree(final, ignore_errors=True)
        _write(star, group, final, spectra)
        combined = _combined_in(data)
    return StarSearch(star, final.relative_to(output).as_posix(), names, combined)


def _combined_in(data: Path) -> Any:
    """Search in a ``comparison.json``; None if there is no such file, or a damaged one."""
    with suppress(OSError, ValueError, KeyError, TypeError):
        return json.loads(read_text(data))["combined"]


def _write(star: str, group: Group, final: Path, spectra: Sequence[str]) -> None:
    """Search one star, and publish the folder with the products as a whole."""
    final.parent.mkdir(exist_ok=True)
    clean(final.parent)
    detections = [each for _, each in group]
    combination = search_together(detections, spectra=spectra)
    _log.info("%s: %s", star, in_words(combination))
    jobs = final.parent.parent / "jobs"
    summaries = {
        # Relative to the folder of the search.
        f"../../jobs/{job.folder}": read_summary(jobs / job.folder)
        for job, _ in group
    }
    try:
        with staged(final.parent, "star") as folder:
            if isinstance(combination, Combination):
                combination.write(folder)
            write_comparison(summaries, folder, combination)
            os.rename(folder, final)
    except OSError:
        # Another survey of the folder may have been faster.
        if not (final / COMPARISON[1]).exists():
            raise


# The table of results: one row for each job.

COLUMNS: dict[str, tuple[type, str]] = {
    "name": (str, "sequence: target and filter, unless the configuration names it"),
    "status": (str, "of the job: finished, failed or waiting"),
    "contrast": (
        float, "of the candidate with the highest S/N, relative to the star without coronagraph",
    ),
    "snr": (float, "of that candidate"),
    "target": (str, ""),
    "filter": (str, ""),
    "frames": (int, ""),
    "fit_status": (str, "how the fit of the star ended"),
    "reduced_chi2": (float, ""),
    "error_factor": (float, "median factor by which errors were multiplied"),
    "candidates": (int, "number of candidates"),
    "separation_arcsec": (float, "of that candidate from the star"),
    "position_angle_deg": (float, "of that candidate, east of north"),
    "contrast_error": (float, "standard deviation of contrast"),
    **{
        f"limit_{each:.1f}_arcsec": (float, f"contrast limit at {each:g} arcsec")
        for each in LIMITS_ARCSEC
    },
    "injected_contrast": (float, ""),
    "injected_separation_arcsec": (float, ""),
    "injected_angle_deg": (float, ""),
    "recovered_contrast": (float, ""),
    "recovered_error": (float, ""),
    "recovered_snr": (float, ""),
    "recovered": (bool, "whether a candidate is within 0.1 arcsec of the injected planet"),
    "seconds": (float, "duration of the job"),
    "ended": (str, "time at which the job ended, UTC"),
    "host": (str, ""),
    "message": (str, ""),
    "traceback": (str, ""),
    "folder": (str, "name of the folder with the products, in jobs"),
    "key": (str, ""),
}  # fmt: skip
"""Columns of the results, what they hold, and descriptions; all but name, status, folder and key
may be masked.

Contrasts come first, because a table that is too wide to print loses its middle."""

_COLUMN_FORMATS = {"contrast": ".2e", "snr": ".1f"}

_COLUMN_UNITS = {"arcsec": u.arcsec, "deg": u.deg, "seconds": u.s}
"""Units by the last word of the name of a column; limits are contrasts at the separation there."""


def row(job: Job, record: Record | None) -> dict[str, Any]:
    """One row: what is known of a job, which waits if it has no record."""
    record = record or {"status": "waiting"}
    result: Mapping[str, Any] = record.get("result") or {}
    values = {key: record.get(key, result.get(key)) for key in COLUMNS}
    values |= {"name": job.name, "folder": job.folder, "key": job.key}
    candidates = result.get("candidates")
    values["candidates"] = None if candidates is None else len(candidates)
    if candidates:
        best = max(candidates, key=lambda each: each["snr"])
        names = ("snr", "separation_arcsec", "position_angle_deg", "contrast", "contrast_error")
        values |= {key: best[key] for key in names}
    for limit in result.get("limits", ()):
        key = f"limit_{limit['separation_arcsec']:.1f}_arcsec"
        if key in values:
            values[key] = limit["contrast"]
    if job.injection is not None:
        planet, seen = job.injection, result.get("recovered", {})
        values |= {
            "injected_contrast": planet.contrast,
            "injected_separation_arcsec": planet.separation,
            "injected_angle_deg": planet.angle,
            "recovered_contrast": seen.get("contrast"),
            "recovered_error": seen.get("contrast_error"),
            "recovered_snr": seen.get("snr"),
            "recovered": seen.get("detected"),
        }
    return values


def table_of(rows: Sequence[Mapping[str, Any]]) -> Table:
    """The rows as a table, in which what is not known is masked."""
    table = Table()
    for name, (kind, description) in COLUMNS.items():
        values = [each[name] for each in rows]
        known = [kind() if value is None else kind(value) for value in values]
        table[name] = MaskedColumn(known, mask=[value is None for value in values], dtype=kind)
        table[name].info.format = _COLUMN_FORMATS.get(name)
        if not name.startswith("limit_"):
            table[name].unit = _COLUMN_UNITS.get(name.rpartition("_")[2])
        table[name].description = description
    return table


# The results of a survey so far, as one HTML page that loads nothing from anywhere.

Jobs = Sequence[tuple[Job, Record | None]]


def page(jobs: Jobs, stars: Sequence[StarSearch] = ()) -> str:
    """The page of jobs with records (None for one that waits), and of the combined searches."""
    rows = [{**row(job, record), "label": str(job)} for job, record in jobs]
    states = [each["status"] for each in rows]
    done, failed, waiting = map(states.count, ("finished", "failed", "waiting"))
    parts = [f"{done} of {counted(len(rows), 'job')} finished"]
    parts += [f"{failed} failed"] if failed else []
    parts += [f"{waiting} not finished yet"] if waiting else []
    names = list(dict.fromkeys(job.name for job, _ in jobs))
    what = ", ".join(names) if len(names) <= 3 else counted(len(names), "sequence")
    seconds = sum(each["seconds"] or 0.0 for each in rows)
    injected = sum(job.injection is not None for job, _ in jobs)
    return render(
        "survey.html",
        name=f"Survey of {what}",
        version=__version__,
        now=datetime.now(UTC).strftime("%Y-%m-%d %H:%M"),
        sentence=_sentence(jobs),
        tone="bad" if failed else "warn" if waiting else "good",
        message=", ".join(parts) + ".",
        advice=(
            "When the survey has ended, start it again to do the missing jobs."
            if done < len(rows)
            else ""
        ),
        facts=[
            ("Sequences", len(rows) - injected),
            ("Injected planets", injected),
            ("Time of all jobs", duration(seconds) if seconds else "none yet"),
        ],
        rows=rows,
        pictures=_pictures(jobs),
        separations=[
            each
            for each in LIMITS_ARCSEC
            if any(row[f"limit_{each:.1f}_arcsec"] is not None for row in rows)
        ],
        candidates=[
            {"job": job, "target": result["target"], **each}
            for job, result in _reduced(jobs)
            for each in result.get("candidates", ())
        ],
        stars=[
            (each, found) for each in stars for found in each.combined.get("candidates") or [None]
        ],
        comparison=COMPARISON[0],
    )


def _reduced(jobs: Jobs) -> list[tuple[Job, dict[str, Any]]]:
    """Results of the finished jobs without injected planets."""
    return [
        (job, record["result"])
        for job, record in jobs
        if record is not None and record["status"] == "finished" and job.injection is None
    ]


def _sentence(jobs: Jobs) -> str:
    counts = [len(result.get("candidates", ())) for _, result in _reduced(jobs)]
    if not counts:
        return "No sequence is reduced yet."
    stars = counted(len(counts), "sequence")
    if not any(counts):
        return f"{stars} reduced, no companion candidate."
    return (
        f"{stars} reduced, {counted(sum(counts), 'companion candidate')} in "
        f"{sum(map(bool, counts))} of them."
    )


def _pictures(jobs: Jobs) -> list[Picture]:
    """The contrast curves of all stars; nothing before there is one."""
    results = [(job.name, each) for job, each in _reduced(jobs) if each.get("curve")]
    if not results:
        return []
    sigmas = results[0][1]["curve"]["sigmas"]
    candidates = [
        (each["separation_arcsec"], each["contrast"])
        for _, result in results
        for each in result["candidates"]
        if each["contrast"] > 0
    ]
    curves = [(name, *curve_arrays(result["curve"])) for name, result in results]
    figure, axes = drawing.new_figure(1, 1)
    drawing.survey_limits(axes[0, 0], curves, candidates, sigmas)
    caption = (
        f"Contrast, relative to the star without coronagraph, that gives S/N {sigmas:g}, against "
        f"separation, for {counted(len(curves), 'sequence')}: the median of all position angles."
        f"{' Circles are candidates.' if candidates else ''}"
    )
    return [Picture(figure, caption)]
