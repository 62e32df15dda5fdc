"""The results of a survey so far: a table with a row for each job, and one HTML page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from typing import Any

from astropy import units as u
from astropy.table import MaskedColumn, Table

from pyklip_diffrender import drawing
from pyklip_diffrender._version import __version__
from pyklip_diffrender.io.progress import counted, duration
from pyklip_diffrender.reduction.pages import Picture, curve_arrays, render
from pyklip_diffrender.reduction.several import COMPARISON
from pyklip_diffrender.reduction.summary import LIMITS_ARCSEC
from pyklip_diffrender.surveys.jobs import Job, Record
from pyklip_diffrender.surveys.stars import StarSearch

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
