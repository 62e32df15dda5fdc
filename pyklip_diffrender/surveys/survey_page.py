"""The results of a survey so far, as one HTML page that loads nothing from anywhere."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime
from html import escape
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pyklip_diffrender import drawing
from pyklip_diffrender._version import __version__
from pyklip_diffrender.reduction import html
from pyklip_diffrender.reduction.html import Picture
from pyklip_diffrender.reduction.words import number, plus_minus, probability, scientific
from pyklip_diffrender.surveys.folders import Record
from pyklip_diffrender.surveys.jobs import Job

__all__ = ["page"]

Rows = Sequence[tuple[Job, Record | None]]

_GIB = 2.0**30

_NAMES = 3
"""Most sequences that the title names."""


def page(rows: Rows) -> str:
    """The page, with every value escaped: headers of files may hold anything.

    Parameters
    ----------
    rows : sequence of (Job, dict or None)
        Jobs with their records; None for one that waits.
    """
    name = _title(rows)
    sections = [
        html.section("Contrast", _limits(rows)),
        html.section("Candidates", _candidates(rows)),
        html.section("Injected planets", _injections(rows)),
        html.section("Jobs", _jobs(rows)),
        html.section("Failures", _failures(rows)),
    ]
    if not any(job.injection for job, _ in rows):
        del sections[2]
    states = [_status(record) for _, record in rows]
    done, failed, waiting = map(states.count, ("finished", "failed", "waiting"))
    tone = "bad" if failed else "warn" if waiting else "good"
    parts = [f"{done} of {html.count(len(rows), 'job')} finished"]
    parts += [f"{failed} failed"] if failed else []
    parts += [f"{waiting} not finished yet"] if waiting else []
    advice = (
        "When the survey has ended, start it again to do the missing jobs."
        if done < len(rows)
        else ""
    )
    seconds = sum(record["seconds"] for _, record in rows if record and "seconds" in record)
    peak = max((record.get("peak_memory_bytes") or 0 for _, record in rows if record), default=0)
    facts = [
        ("Sequences", str(sum(job.injection is None for job, _ in rows))),
        ("Injected planets", str(sum(job.injection is not None for job, _ in rows))),
        ("Time of all jobs", _time(seconds)),
        ("Largest memory of a job", _memory(peak)),
    ]
    now = datetime.now(UTC).strftime("%Y-%m-%d %H:%M")
    header = (
        f"<header>\n<h1>{escape(name)}</h1>\n"
        f'<p class="setup">Survey with pyklip_diffrender {__version__}, state of {now} UTC</p>\n'
        f'<p class="result">{escape(_sentence(rows))}</p>\n'
        f'<div class="status {tone}"><strong>{escape(", ".join(parts))}.</strong>'
        f"<p>{advice}</p></div>\n{html.facts(facts)}\n</header>\n"
    )
    return html.document(name, header, sections)


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
    stars = html.count(len(plain), "sequence")
    if not any(counts):
        return f"{stars} reduced, no companion candidate."
    return (
        f"{stars} reduced, {html.count(sum(counts), 'companion candidate')} in "
        f"{sum(map(bool, counts))} of them."
    )


def _limits(rows: Rows) -> str:
    curves = [
        (job, record["result"]) for job, record in _finished(rows) if record["result"].get("curve")
    ]
    if not curves:
        return html.note("There are no contrast curves yet.")
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
        drawing.to_png(figure, dpi=200),
        f"Curves of the contrast at {sigmas:g} sigma against separation in arcsec for "
        f"{html.count(len(curves), 'sequence')}; the table has their values.",
        f"Contrast, relative to the star without coronagraph, that gives S/N {sigmas:g}: the "
        f"median of all position angles.{' Circles are candidates.' if candidates else ''}",
    )
    separations = sorted(
        {each["separation_arcsec"] for _, result in curves for each in result["limits"]}
    )
    table = []
    for job, result in curves:
        limits = {each["separation_arcsec"]: each["contrast"] for each in result["limits"]}
        cells = [scientific(limits[s]) if s in limits else "" for s in separations]
        table.append([job.name, *cells])
    header = ["Sequence", *(f"at {each:.3g} arcsec" for each in separations)]
    return html.pictures([picture], "single") + html.table(header, table)


def _array(result: dict[str, Any], key: str) -> NDArray[np.float64]:
    """A column of the contrast curve, NaN where it is not known."""
    return np.array(result["curve"][key], dtype=float)


def _candidates(rows: Rows) -> str:
    table = [
        [
            _report(job),
            record["result"]["target"],
            plus_minus(each["separation_arcsec"], each["separation_error_arcsec"]),
            plus_minus(each["position_angle_deg"], each["position_angle_error_deg"]),
            scientific(each["contrast"], each["contrast_error"]),
            f"{each['snr']:.1f}",
            probability(each["false_alarm_probability"]),
        ]
        for job, record in _finished(rows)
        for each in record["result"].get("candidates", ())
    ]
    if not table:
        return html.note("There are no candidates.")
    header = ["Sequence", "Star", "Separation (arcsec)", "Position angle (deg)", "Contrast", "S/N",
              "False-alarm probability"]  # fmt: skip
    return html.table(header, table)


def _injections(rows: Rows) -> str:
    table = []
    for job, record in _finished(rows, injected=True):
        planet, seen = job.injection, record["result"].get("recovered")
        if planet is None or not seen or None in seen.values():
            continue
        ratio = [seen[key] / planet.contrast for key in ("contrast", "contrast_error")]
        table.append(
            [
                _report(job),
                f"{planet.separation:g}",
                f"{planet.angle:g}",
                scientific(planet.contrast),
                scientific(seen["contrast"], seen["contrast_error"]),
                plus_minus(ratio[0], ratio[1]),
                f"{seen['snr']:.1f}",
                "yes" if seen["detected"] else "no",
            ]
        )
    if not table:
        return html.note("No injected planet is measured yet.")
    header = ["Sequence", "Separation (arcsec)", "Position angle (deg)", "Injected", "Recovered",
              "Recovered / injected", "S/N", "Detected"]  # fmt: skip
    note = "A planet that is not detected is measured at its place."
    return html.table(header, table) + html.note(note)


def _jobs(rows: Rows) -> str:
    table = []
    for job, record in rows:
        known: dict[str, Any] = record or {}
        result = known.get("result") or {}
        candidates = result.get("candidates")
        table.append(
            [
                _report(job, _label(job)) if _status(record) == "finished" else _label(job),
                result.get("filter") or job.filter or "",
                _status(record),
                result.get("fit_status") or "",
                number(result["reduced_chi2"]) if "reduced_chi2" in result else "",
                "" if candidates is None else str(len(candidates)),
                _time(known["seconds"]) if "seconds" in known else "",
                _memory(known["peak_memory_bytes"]) if known.get("peak_memory_bytes") else "",
            ]
        )
    header = ["Job", "Filter", "Job status", "Fit status", "Reduced chi-squared", "Candidates",
              "Time", "Peak memory"]  # fmt: skip
    return html.table(header, table, wrap=0)


def _failures(rows: Rows) -> str:
    failed = [(job, r) for job, r in rows if r is not None and r["status"] == "failed"]
    if not failed:
        return html.note("No job has failed.")
    return "\n".join(
        f"<h3>{escape(_label(job))}</h3>\n<p>{escape(record['message'])}</p>\n"
        "<details><summary>Traceback</summary>"
        f'<div class="scroll" tabindex="0"><pre>{escape(record["traceback"])}</pre></div></details>'
        for job, record in failed
    )


def _label(job: Job) -> str:
    planet = job.injection
    if planet is None:
        return job.name
    place = f"{planet.separation:g} arcsec, {planet.angle:g} deg"
    contrast = scientific(planet.contrast).replace(" ", "\u00a0")
    return f"{job.name}, planet of {contrast} at {place}"


def _report(job: Job, label: str | None = None) -> html.Markup:
    return html.link(f"jobs/{job.folder}/report.html", label or job.name)


def _time(seconds: float) -> str:
    if seconds < 120:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"


def _memory(size: float) -> str:
    return f"{size / _GIB:.2f} GiB"
