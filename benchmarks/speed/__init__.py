"""Measure durations and errors of this package and of others in the same run.

A row is a task (one image, one image with its derivative, a refinement ...); its cases are ways of
performing it. All cases of a row are timed in turns, in one process after a warm-up, and the
shortest duration counts. Errors are those of the timed results.
"""

from __future__ import annotations

import datetime
import logging
import math
import os
import platform
import time
from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import torch
from astropy.table import Table

from benchmarks.provenance import processor
from benchmarks.speed.case import Accuracy, Case
from benchmarks.speed.memory import peak_memory
from benchmarks.speed.rows import ROWS, Row, select_rows
from benchmarks.speed.scaling import SCALING
from benchmarks.speed.setting import Setting
from benchmarks.speed.timing import exponent, interleaved
from pyklip_diffrender.io.files import replacing

__all__ = ["ROWS", "Setting", "run_bench", "write_table"]

_log = logging.getLogger(__name__)

_ONCE = 3
"""Cases that take longer than this many budgets are called only once."""

_COLUMNS = {
    "row": str,
    "column": str,
    "precision": str,
    "mode": str,
    "device": str,
    "seconds": float,
    "times": float,
    "ratio": float,
    "error": float,
    "sigma": float,
    "memory": float,
    "size": float,
    "note": str,
}


def run_bench(
    setting: Setting,
    rows: Sequence[str] | None = None,
    *,
    budget: float = 2.0,
    memory: bool = True,
    command: str = "",
) -> Table:
    """Run the benchmark.

    Parameters
    ----------
    here : Setting
    rows : sequence of str, optional
        Beginnings of names of `ROWS`; default all.
    budget : float
        Seconds for the repetitions of each case. Cases that take more than three times as long
        are called once.
    memory : bool
        Also measure the memory of the cases that request it, in separate processes.
    command : str
        For the provenance.

    Returns
    -------
    Table
        One row for each case: seconds (of the timed piece times `times`), the duration of the
        row's reference over the duration of the case (`ratio`), `error` (see `ROWS`), `sigma` (rms
        in units of the paper scene's noise), `memory` (bytes), `size` (for scaling). Cases that
        could not be measured have NaN and a note. In `meta`: provenance, the reference of every
        row, and exponents.

    Raises
    ------
    IncompatibleSetupError
        For an unknown row.
    """
    selected = select_rows(list(rows or []))
    began = time.perf_counter()
    lines: list[dict[str, Any]] = []
    references: dict[str, str] = {}
    for row in selected:
        lines_of_row = _measured(row, setting, budget, memory)
        if row.name != SCALING:
            references[row.name] = _with_ratios(lines_of_row)
        lines += lines_of_row
    table = Table(
        rows=[[line[name] for name in _COLUMNS] for line in lines],
        names=list(_COLUMNS),
        dtype=list(_COLUMNS.values()),
    )
    for name, kind in _COLUMNS.items():
        if kind is float:
            table[name].info.format = ".4g"
    table.meta = {
        "command": command,
        "date": f"{datetime.datetime.now(datetime.UTC):%Y-%m-%d}",
        "machine": f"{os.cpu_count()} cores of {processor()}",
        "threads": torch.get_num_threads(),
        "device": _device(setting.device),
        "versions": _versions(),
        "pupil": setting.npix,
        "field": setting.fov,
        "quick": setting.quick,
        "errors": {row.name: row.error for row in selected},
        "references": references,
        "exponents": _exponents(table),
    }
    table.meta["seconds"] = round(time.perf_counter() - began)
    return table


def _measured(row: Row, setting: Setting, budget: float, memory: bool) -> list[dict[str, Any]]:
    lines, works, timed, repeated = [], [], [], []
    for case in row.cases(setting):
        line = _blank(case, setting)
        lines.append(line)
        if case.make is None:
            continue
        _log.info("%s", case.key)
        work = case.make()
        start = time.perf_counter()
        answer = work()
        first = time.perf_counter() - start
        accuracy: Accuracy = case.judge(answer)
        del answer
        line.update(error=accuracy.error, sigma=accuracy.sigma)
        line["seconds"] = first * case.times
        timed.append((case, line))
        if first < _ONCE * budget:
            works.append(work)
            repeated.append((case, line))
    durations = interleaved(works, budget, setting.device)
    del works
    for (case, line), duration in zip(repeated, durations, strict=True):
        line["seconds"] = duration * case.times
    if memory:
        for case, line in timed:
            if case.memory:
                _log.info("memory of %s", case.key)
                line["memory"] = peak_memory(case, setting)
    for case, line in timed:
        line["_reference"] = case.reference
    return lines


def _blank(case: Case, setting: Setting) -> dict[str, Any]:
    line: dict[str, Any] = dict.fromkeys(_COLUMNS, math.nan)
    line.update(
        row=case.row,
        column=case.column,
        precision=case.precision,
        mode=case.mode,
        device=setting.device,
        times=case.times,
        size=case.size,
        note=case.note,
    )
    return line


def _with_ratios(lines: list[dict[str, Any]]) -> str:
    """Add the ratios to the duration of the reference; return the name of the reference."""
    references = [line for line in lines if line.get("_reference")]
    if not references:
        return ""
    for line in lines:
        line["ratio"] = references[-1]["seconds"] / line["seconds"]
    return str(references[-1]["column"])


def _exponents(table: Table) -> dict[str, float]:
    exponents = {}
    for name in dict.fromkeys(table["row"]):
        lines = table[(table["row"] == name)]
        if str(name).startswith(SCALING) and len(lines) > 1:
            exponents[str(name)] = round(exponent(lines["size"], lines["seconds"]), 2)
    return exponents


def _device(name: str) -> str:
    if torch.device(name).type == "cuda":
        return str(torch.cuda.get_device_name(name))
    return name


def _versions() -> str:
    words = [f"Python {platform.python_version()}"]
    for name in ("torch", "numpy", "poppy", "stpsf", "prysm", "hcipy"):
        try:
            words.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            words.append(f"{name} not installed")
    return ", ".join(words)


def write_table(table: Table, folder: str | os.PathLike[str]) -> Path:
    """Write the table as performance.ecsv; returns the path."""
    path = Path(folder) / "performance.ecsv"
    with replacing(path) as temporary:
        table.write(temporary, format="ascii.ecsv", overwrite=True)
    return path
