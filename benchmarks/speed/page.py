"""The documentation's page on performance, from the table alone."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import Table

from pyklip_diffrender.io.files import replacing

_TARGETS: tuple[tuple[str, str, str, str, float, float, str], ...] = (
    # row, case, precision, against, at least, error at most, which error
    ("forward", "this package, 1024", "float64", "stpsf calc_psf, fft_oversample 4", 100, 1e-7,
     "error"),
    ("forward", "multi-fidelity, 128", "float32",
     "stpsf calc_psf, fft_oversample 4", 1000, 1e-3, "error"),
    ("forward + backward", "this package, 1024", "float64", "the paper's recipe", 15, 1e-6,
     "error"),
    ("forward + backward", "multi-fidelity, 512", "float32", "the paper's recipe", 80, 0.1,
     "sigma"),
    ("refinement", "this package, as it comes", "float64",
     "the paper's recipe, 1000 Adam steps", 300, math.nan, "sigma"),
    ("refinement", "this package, the wavefront alone free", "float64",
     "the paper's recipe, 1000 Adam steps", 300, math.nan, "sigma"),
    ("forward", "this package, 1024", "float64", "prysm, 4 cells per lambda/D", 2, math.nan,
     "error"),
    ("forward", "this package, 1024", "float64", "hcipy, 4 cells per lambda/D", 2, math.nan,
     "error"),
    ("Jacobian", "this package, 10 wavelengths on 128", "float32",
     "this package, 1846 modes on 128", 0.1, math.nan, "error"),
)  # fmt: skip
"""Goals of speed at a given error. An error of NaN: at most that of the other."""


def _number(value: float, digits: int = 3) -> str:
    return "" if math.isnan(value) else f"{value:.{digits}g}"


def _duration(value: float) -> str:
    if math.isnan(value):
        return "not measured"
    for unit, size in (("s", 1.0), ("ms", 1e-3)):
        if value >= size:
            return f"{value / size:.3g} {unit}"
    return f"{value * 1e6:.3g} us"


def _find(table: Table, row: str, column: str, precision: str | None = None) -> Any:
    for line in table:
        if (line["row"], line["column"]) == (row, column) and (
            precision in (None, line["precision"]) and not math.isnan(line["seconds"])
        ):
            return line
    return None


def targets(table: Table) -> list[tuple[str, str, str, str, str, str]]:
    """Each goal, what was measured, and whether it is met."""
    rows = []
    for row, ours, precision, theirs, factor, worst, kind in _TARGETS:
        mine, other = _find(table, row, ours, precision), _find(table, row, theirs)
        words = f"{row}: {ours}, {precision}, against {theirs}"
        if mine is None or other is None:
            rows.append((words, f"{factor:g}", "not measured", "", "", ""))
            continue
        ratio = float(other["seconds"] / mine["seconds"])
        error = float(mine[kind])
        most = float(other[kind]) if math.isnan(worst) else worst
        good = ratio >= factor and (math.isnan(most) or math.isnan(error) or error <= most)
        rows.append(
            (
                words,
                f"{factor:g}",
                _number(ratio),
                _number(error, 2) + (" sigma" if kind == "sigma" else ""),
                _number(most, 2) + (" sigma" if kind == "sigma" else ""),
                "yes" if good else "no",
            )
        )
    return rows


def _table(head: tuple[str, ...], rows: Sequence[tuple[str, ...]]) -> list[str]:
    lines = [head, tuple("---" for _ in head), *rows]
    return ["| " + " | ".join(line) + " |" for line in lines] + [""]


def page(table: Table, figure: str = "results/performance.png", notes: str = "") -> str:
    """The page, in Markdown.

    Parameters
    ----------
    table : Table
        What `run_bench` gave.
    figure : str
        Where the Pareto plot is, from the page.
    notes : str
        What is to be said about these numbers, in Markdown.
    """
    meta = table.meta
    lines = [
        "# Performance",
        "",
        "Written by `python -m benchmarks.speed --page` from the table "
        "`results/performance.ecsv`; do not edit.",
        "",
        f"- Measured {meta['date']} by `{meta['command']}` in {meta['seconds']} s.",
        f"- {meta['machine']}, {meta['threads']} threads; device {meta['device']}"
        + ("; nothing was measured on a GPU." if meta["device"] == "cpu" else "."),
        f"- {meta['versions']}.",
        "",
        f"{meta['pupil']} x {meta['pupil']} samples in the pupil, {meta['field']} x "
        f"{meta['field']} pixels, 4.5 um, MASK335R and MASKRND; the wavefront is 40 hours from "
        "the known map (embedded generator). Every time stands beside the error of the answer "
        "that was timed. Durations are the shortest of several, warm, all ways of a section "
        "called in turns in one process (what takes more than 6 s, once). `sigma` is the rms "
        "error in units of the noise of the paper's scene. Memory is the most that a process of "
        "its own held during a warm call, "
        "less what it held before the way was set up (resident memory; torch's count on a GPU).",
        "",
        f"![Error against time]({figure})",
        "",
        "## Targets",
        "",
        *_table(("", "times faster", "found", "error", "at most", "met"), targets(table)),
        *([notes.strip(), ""] if notes else []),
    ]
    for name in dict.fromkeys(str(row) for row in table["row"]):
        if not name.startswith("scaling"):
            lines += _section(table, name)
    return "\n".join([*lines, *_scaling(table), *_limits(meta.get("limits", []))]) + "\n"


def _section(table: Table, name: str) -> list[str]:
    meta = table.meta
    reference = meta["references"].get(name, "")
    rows = []
    for line in table[table["row"] == name]:
        missing = math.isnan(line["seconds"])
        sampled = line["times"] != 1
        rows.append(
            (
                str(line["column"]),
                f"{line['precision']}, {line['mode']}" if not missing else "",
                _duration(line["seconds"]) + (" (sampled)" if sampled and not missing else ""),
                _number(line["ratio"]),
                _number(line["error"], 2),
                _number(line["sigma"], 2),
                "" if math.isnan(line["memory"]) else f"{line['memory'] / 1e6:.0f} MB",
                "" if np.ma.is_masked(line["note"]) else str(line["note"]),
            )
        )
    return [
        f"## {name[0].upper()}{name[1:]}",
        "",
        f"Error: {meta['errors'][name]}." + (f" Ratios: to {reference}." if reference else ""),
        "",
        *_table(("", "how", "time", "times faster", "error", "sigma", "memory", ""), rows),
    ]


def _scaling(table: Table) -> list[str]:
    rows = []
    for name, power in table.meta.get("exponents", {}).items():
        points_of_row = table[table["row"] == name]
        points = ", ".join(
            f"{line['column']}: {_duration(line['seconds'])}" for line in points_of_row
        )
        rows.append((name.removeprefix("scaling: "), points, f"{power:.2f}"))
    if not rows:
        return []
    return [
        "## Scaling",
        "",
        "The exponent is that of a power law through the points.",
        "",
        *_table(("", "measured", "exponent"), rows),
    ]


def _limits(limits: list[dict[str, Any]]) -> list[str]:
    works = [limit for limit in limits if "limit" in limit]
    if not works:
        return []
    rates = next(limit for limit in limits if "limit" not in limit)
    rows = []
    for w in works:
        parts = {
            "matrix products": w["products_s"],
            "memory": w["bytes_s"],
            "cosines": w["cosines_s"],
        }
        rows.append(
            (
                w["what"],
                _number(w["gflop"]),
                _number(w["cosines"] / 1e6),
                _number(w["bytes"] / 1e6),
                _duration(w["limit"]),
                _duration(w["seconds"]),
                _number(w["seconds"] / w["limit"], 2),
                max(parts, key=lambda name: parts[name]),
            )
        )
    return [
        "## How far from the machine's limit",
        "",
        f"This machine, measured in the same run: {rates['float64'] / 1e9:.0f} GFLOP/s in float64 "
        f"and {rates['float32'] / 1e9:.0f} in float32 products, {rates['bytes'] / 1e9:.0f} GB/s "
        f"copied, {rates['cosines'] / 1e6:.0f} million cosines a second. The limit is the sum of "
        "the operations counted, the bytes that have to be moved at least, and the cosines, each "
        "at full rate.",
        "",
        *_table(
            ("", "GFLOP", "million cosines", "MB", "limit", "time", "time / limit", "mostly"),
            rows,
        ),
        "Where time / limit is near 1, only less work makes it faster: a coarser pupil, fewer "
        "modes, single precision, or a device with more operations a second. Where it is large, "
        "starting small operations and arrays that pass through memory more often than they must "
        "take the time: fused kernels, compiled or captured as a graph, would get it back.",
        "",
    ]


def write_page(table: str | os.PathLike[str], folder: str | os.PathLike[str]) -> Path:
    """Write performance.md into a folder, from a table in a file; returns the path.

    Notes in the same folder, NAME_notes.md for NAME.ecsv, are included.
    """
    remarks = Path(table).with_name(f"{Path(table).stem}_notes.md")
    notes = remarks.read_text(encoding="utf-8") if remarks.is_file() else ""
    measured = Table.read(table, format="ascii.ecsv")
    path = Path(folder) / "performance.md"
    try:
        figure = Path(table).resolve().with_suffix(".png").relative_to(Path(folder).resolve())
    except ValueError:
        figure = Path("results/performance.png")
    with replacing(path) as temporary:
        Path(temporary).write_text(page(measured, figure.as_posix(), notes), encoding="utf-8")
    return path
