"""The results of a survey so far: a table with a row for each job, and one HTML page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from astropy import units as u
from astropy.table import MaskedColumn, Table
from numpy.typing import NDArray

from pyklip_diffrender import drawing
from pyklip_diffrender._version import __version__
from pyklip_diffrender.reduction import COMPARISON
from pyklip_diffrender.reduction.pages import (
    Picture,
    count,
    number,
    plus_minus,
    render,
    scientific,
)
from pyklip_diffrender.surveys.jobs import Injection, Job, Record
from pyklip_diffrender.surveys.stars import StarSearch

__all__ = ["COLUMNS", "page", "row", "table_of", "write_tables"]


# The table of results: one row for each job.

_AT = (0.5, 1.0, 1.5, 2.0)
"""Separations of the limits, arcsec."""

COLUMNS: dict[str, type] = {
    "name": str,
    "status": str,
    "contrast": float,
    "snr": float,
    "target": str,
    "filter": str,
    "frames": int,
    "fit_status": str,
    "reduced_chi2": float,
    "error_factor": float,
    "candidates": int,
    "separation_arcsec": float,
    "position_angle_deg": float,
    "contrast_error": float,
    **{f"limit_{each:.1f}_arcsec": float for each in _AT},
    "injected_contrast": float,
    "injected_separation_arcsec": float,
    "injected_angle_deg": float,
    "recovered_contrast": float,
    "recovered_error": float,
    "recovered_snr": float,
    "recovered": bool,
    "seconds": float,
    "peak_memory_bytes": int,
    "ended": str,
    "host": str,
    "message": str,
    "traceback": str,
    "folder": str,
    "key": str,
}
"""Columns of the results and what they hold; all but name, status, folder and key may be masked.

Contrasts come first, because a table that is too wide to print loses its middle."""

_FORMATS = {"contrast": ".2e", "snr": ".1f"}

_UNITS = {"arcsec": u.arcsec, "deg": u.deg, "seconds": u.s, "bytes": u.byte}
"""Units by the last word of the name of a column; limits are contrasts at the separation there."""

_DESCRIPTIONS = {
    "name": "sequence: target and filter, unless the configuration names it",
    "status": "of the job: finished, failed or waiting",
    "contrast": "of the candidate with the highest S/N, relative to the star without coronagraph",
    "snr": "of that candidate",
    "fit_status": "how the fit of the star ended",
    "error_factor": "median factor by which errors were multiplied",
    "candidates": "number of candidates",
    "separation_arcsec": "of that candidate from the star",
    "position_angle_deg": "of that candidate, east of north",
    "contrast_error": "standard deviation of contrast",
    **{f"limit_{each:.1f}_arcsec": f"contrast limit at {each:g} arcsec" for each in _AT},
    "recovered": "whether a candidate is within 0.1 arcsec of the injected planet",
    "seconds": "duration of the job",
    "peak_memory_bytes": "largest memory of the job",
    "folder": "name of the folder with the products, in jobs",
    "ended": "time at which the job ended, UTC",
}


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
    for name, kind in COLUMNS.items():
        values = [each[name] for each in rows]
        known = [kind() if value is None else kind(value) for value in values]
        table[name] = MaskedColumn(known, mask=[value is None for value in values], dtype=kind)
        table[name].info.format = _FORMATS.get(name)
        table[name].unit = _unit(name)
        table[name].description = _DESCRIPTIONS.get(name, "")
    return table


def _unit(name: str) -> u.UnitBase | None:
    return None if name.startswith("limit_") else _UNITS.get(name.rpartition("_")[2])


def write_tables(rows: Sequence[Mapping[str, Any]], folder: Path) -> None:
    """Write ``results.ecsv`` and, where pyarrow is installed, ``results.parquet``."""
    table_of(rows).write(folder / "results.ecsv", format="ascii.ecsv")
    if find_spec("pyarrow") is None:
        return
    import pyarrow as pa
    from pyarrow import parquet as files

    kinds = {str: pa.string(), int: pa.int64(), float: pa.float64(), bool: pa.bool_()}
    schema = pa.schema([(name, kinds[kind]) for name, kind in COLUMNS.items()])
    table = pa.Table.from_pylist(list(rows), schema=schema)
    files.write_table(table, folder / "results.parquet")


# The results of a survey so far, as one HTML page that loads nothing from anywhere.

Rows = Sequence[tuple[Job, Record | None]]

_GIB = 2.0**30

_NAMES = 3
"""Most sequences that the title names."""


def page(rows: Rows, stars: Sequence[StarSearch] = ()) -> str:
    """The page of jobs with records (None for one that waits), and of the combined searches."""
    states = [_status(record) for _, record in rows]
    done, failed, waiting = map(states.count, ("finished", "failed", "waiting"))
    parts = [f"{done} of {count(len(rows), 'job')} finished"]
    parts += [f"{failed} failed"] if failed else []
    parts += [f"{waiting} not finished yet"] if waiting else []
    seconds = sum(record["seconds"] for _, record in rows if record and "seconds" in record)
    peak = max((record.get("peak_memory_bytes") or 0 for _, record in rows if record), default=0)
    separations, limits = _limits(rows)
    return render(
        "survey.html",
        name=_title(rows),
        version=__version__,
        now=datetime.now(UTC).strftime("%Y-%m-%d %H:%M"),
        sentence=_sentence(rows),
        tone="bad" if failed else "warn" if waiting else "good",
        message=", ".join(parts) + ".",
        advice=(
            "When the survey has ended, start it again to do the missing jobs."
            if done < len(rows)
            else ""
        ),
        facts=[
            ("Sequences", str(sum(job.injection is None for job, _ in rows))),
            ("Injected planets", str(sum(job.injection is not None for job, _ in rows))),
            ("Time of all jobs", _time(seconds)),
            ("Largest memory of a job", _memory(peak)),
        ],
        pictures=_pictures(rows),
        separations=separations,
        titles=[f"at {each:.3g} arcsec" for each in separations],
        limits=limits,
        candidates=[
            (job, record["result"]["target"], each)
            for job, record in _finished(rows)
            for each in record["result"].get("candidates", ())
        ],
        stars=[line for each in stars for line in _star(each)],
        any_injected=any(job.injection for job, _ in rows),
        injections=_injections(rows),
        jobs=[_job(job, record) for job, record in rows],
        failures=[
            (_label(job), record)
            for job, record in rows
            if record is not None and record["status"] == "failed"
        ],
    )


def _title(rows: Rows) -> str:
    """Title of a survey: its sequences, or the first of them and their number."""
    names = list(dict.fromkeys(job.name for job, _ in rows))
    if len(names) > _NAMES:
        return f"Survey of {names[0]} and {len(names) - 1} more sequences"
    return f"Survey of {', '.join(names)}"


def _finished(rows: Rows, *, injected: bool = False) -> list[tuple[Job, Record]]:
    return [
        (job, record)
        for job, record in rows
        if record is not None
        and record["status"] == "finished"
        and (job.injection is not None) == injected
    ]


def _status(record: Record | None) -> str:
    return "waiting" if record is None else str(record["status"])


def _sentence(rows: Rows) -> str:
    plain = _finished(rows)
    counts = [len(record["result"].get("candidates", ())) for _, record in plain]
    if not plain:
        return "No sequence is reduced yet."
    stars = count(len(plain), "sequence")
    if not any(counts):
        return f"{stars} reduced, no companion candidate."
    return (
        f"{stars} reduced, {count(sum(counts), 'companion candidate')} in "
        f"{sum(map(bool, counts))} of them."
    )


def _curves(rows: Rows) -> list[tuple[Job, Record]]:
    """Results with a contrast curve."""
    return [
        (job, record["result"]) for job, record in _finished(rows) if record["result"].get("curve")
    ]


def _pictures(rows: Rows) -> list[Picture]:
    """The contrast curves of all stars; nothing before there is one."""
    curves = _curves(rows)
    if not curves:
        return []
    sigmas = curves[0][1]["curve"]["sigmas"]
    candidates = [
        (each["separation_arcsec"], each["contrast"])
        for _, result in curves
        for each in result["candidates"]
        if each["contrast"] > 0
    ]
    figure, axes = drawing.new_figure(1, 1)
    drawing.survey_limits(
        axes[0, 0],
        [
            (job.name, _array(result, "separation_arcsec"), _array(result, "contrast"))
            for job, result in curves
        ],
        candidates,
        sigmas,
    )
    picture = Picture(
        "contrast_curves",
        figure,
        "Contrast, relative to the star without coronagraph, that gives S/N "
        f"{sigmas:g}, against separation, for {count(len(curves), 'sequence')}: the median of all "
        "position angles.",
        "Circles are candidates." if candidates else "",
    )
    return [picture]


def _limits(rows: Rows) -> tuple[list[float], list[tuple[str, dict[float, float]]]]:
    """Separations with limits, and for every star the limits by separation."""
    limits = [
        (job.name, {each["separation_arcsec"]: each["contrast"] for each in result["limits"]})
        for job, result in _curves(rows)
    ]
    return sorted({separation for _, each in limits for separation in each}), limits


def _array(result: dict[str, Any], key: str) -> NDArray[np.float64]:
    """A column of the contrast curve, NaN where it is not known."""
    return np.array(result["curve"][key], dtype=float)


def _star(search: StarSearch) -> list[dict[str, str]]:
    """Rows about the search of a star: one for each candidate, or one that says that none is."""
    about = {
        "star": search.star,
        "page": f"{search.folder}/{COMPARISON[0]}",
        "jobs": ", ".join(search.jobs),
        **dict.fromkeys(("separation", "angle", "snr", "false_alarm"), ""),
    }
    if "reason" in search.combined:
        return [{**about, "result": f"no combined search: {search.combined['reason']}"}]
    left_out = "".join(
        f" Left out: {each['name']}: {each['reason']}." for each in search.combined["left_out"]
    )
    found = [
        {
            "result": f"candidate with the spectrum {each['spectrum']}"
            + (f", {each['verdict']}" if "verdict" in each else "") + f".{left_out}",
            "separation": plus_minus(each["separation_arcsec"], each["separation_error_arcsec"]),
            "angle": plus_minus(each["position_angle_deg"], each["position_angle_error_deg"]),
            "snr": f"{each['snr']:.1f}",
            "false_alarm": scientific(each["false_alarm_probability"]),
        }
        for each in search.combined["candidates"]
    ]  # fmt: skip
    return [{**about, **each} for each in found or [{"result": f"no candidate.{left_out}"}]]


def _injections(rows: Rows) -> list[tuple[Job, Injection, Record]]:
    """Injected planets that were measured, and what was measured."""
    table = []
    for job, record in _finished(rows, injected=True):
        planet, seen = job.injection, record["result"].get("recovered")
        if planet is not None and seen and None not in seen.values():
            table.append((job, planet, seen))
    return table


def _job(job: Job, record: Record | None) -> dict[str, Any]:
    """A job and how it went; text is empty where nothing is known."""
    known: dict[str, Any] = record or {}
    result = known.get("result") or {}
    candidates = result.get("candidates")
    return {
        "key": job.folder,
        "label": _label(job),
        "filter": result.get("filter") or job.filter or "",
        "status": _status(record),
        "fit_status": result.get("fit_status") or "",
        "reduced_chi2": number(result["reduced_chi2"]) if "reduced_chi2" in result else "",
        "candidates": "" if candidates is None else str(len(candidates)),
        "time": _time(known["seconds"]) if "seconds" in known else "",
        "memory": _memory(known["peak_memory_bytes"]) if known.get("peak_memory_bytes") else "",
    }


def _label(job: Job) -> str:
    planet = job.injection
    if planet is None:
        return job.name
    place = f"{planet.separation:g} arcsec, {planet.angle:g} deg"
    contrast = scientific(planet.contrast).replace(" ", "\u00a0")
    return f"{job.name}, planet of {contrast} at {place}"


def _time(seconds: float) -> str:
    if seconds < 120:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"


def _memory(size: float) -> str:
    return f"{size / _GIB:.2f} GiB"
