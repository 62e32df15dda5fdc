"""The results of a survey so far, as one HTML page that loads nothing from anywhere."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pyklip_diffrender import drawing
from pyklip_diffrender._version import __version__
from pyklip_diffrender.reduction.pages import Picture, count, render
from pyklip_diffrender.reduction.words import number, scientific
from pyklip_diffrender.surveys.folders import Record
from pyklip_diffrender.surveys.jobs import Injection, Job

__all__ = ["page"]

Rows = Sequence[tuple[Job, Record | None]]

_GIB = 2.0**30

_NAMES = 3
"""Most sequences that the title names."""


def page(rows: Rows) -> str:
    """The page.

    Parameters
    ----------
    rows : sequence of (Job, dict or None)
        Jobs with their records; None for one that waits.
    """
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
    """What the survey is of: its sequences, or the first of them and their number."""
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
        f"Curves of the contrast at {sigmas:g} sigma against separation in arcsec for "
        f"{count(len(curves), 'sequence')}; the table has their values.",
        f"Contrast, relative to the star without coronagraph, that gives S/N {sigmas:g}: the "
        f"median of all position angles.{' Circles are candidates.' if candidates else ''}",
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
