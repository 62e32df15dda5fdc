"""Measure how fast this package and others are, and how exact their answers.

Run from the root of the project, with the package installed:

    python -m benchmarks.speed --quick

It prints the table and writes it into a folder: for each case, seconds (of the timed piece times
`times`), the duration of the row's reference over the duration of the case (`ratio`), `error` (its
meaning is in the metadata), `sigma` (rms in units of the paper scene's noise), and `size` (for
scaling). Cases that could not be measured have NaN and a note.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from astropy.table import Table

from benchmarks.provenance import provenance
from benchmarks.speed.case import Accuracy
from benchmarks.speed.rows import ROWS, Row
from benchmarks.speed.scaling import SCALING
from benchmarks.speed.setting import Setting
from benchmarks.speed.timing import exponent, interleaved
from pyklip_diffrender.io.files import write_table

COMMAND = "benchmarks.speed"


def measured(row: Row, setting: Setting, budget: float) -> list[dict[str, Any]]:
    """Lines of the table for the cases of a row."""
    lines, timed, works, reference = [], [], [], math.nan
    for case in row.cases(setting):
        line = {
            "row": case.row, "column": case.column, "precision": case.precision,
            "device": setting.device, "seconds": math.nan, "times": case.times, "ratio": math.nan,
            **asdict(Accuracy()), "size": case.size, "note": case.note,
        }  # fmt: skip
        lines.append(line)
        if case.make is not None:
            work = case.make()
            line |= asdict(case.judge(work()))
            timed.append((case, line))
            works.append(work)
    durations = interleaved(works, budget, setting.device)
    for (case, line), duration in zip(timed, durations, strict=True):
        line["seconds"] = duration * case.times
        reference = line["seconds"] if case.reference else reference
    for line in lines:
        line["ratio"] = reference / line["seconds"]
    return lines


def exponents(table: Table) -> dict[str, float]:
    """Powers of the sizes with which durations grow."""
    names = [each for each in dict.fromkeys(map(str, table["row"])) if each.startswith(SCALING)]
    rows = {name: table[table["row"] == name] for name in names}
    return {name: round(exponent(each["size"], each["seconds"]), 2) for name, each in rows.items()}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("-o", "--output", type=Path, default=Path("speed"), help="folder")
    names = [row.name for row in ROWS]
    parser.add_argument("--rows", nargs="+", choices=names, default=names, help="default all")
    parser.add_argument("--quick", action="store_true", help="small arrays and short repetitions")
    parser.add_argument("--device", default="cpu", help="torch device of this package, as cuda")
    options = parser.parse_args(arguments)
    if options.device.startswith("cuda") and not torch.cuda.is_available():
        parser.error(f"--device {options.device}: this PyTorch finds no GPU")
    setting, budget = Setting(options.quick, options.device), 0.1 if options.quick else 2.0
    selected = [row for row in ROWS if row.name in options.rows]
    table = Table([line for row in selected for line in measured(row, setting, budget)])
    for name in ("seconds", "times", "ratio", "error", "sigma", "size"):
        table[name].info.format = ".4g"
    table.meta = provenance(
        COMMAND + " --quick" * options.quick, "poppy", "stpsf", "prysm", "hcipy"
    ) | {
        "pupil": setting.npix,
        "field": setting.fov,
        "errors": {row.name: row.error for row in selected},
        "exponents": exponents(table),
    }
    table["row", "column", "precision", "seconds", "ratio", "error", "sigma"].pprint_all()
    options.output.mkdir(parents=True, exist_ok=True)
    write_table(table, options.output / "performance.ecsv")
    return 0


if __name__ == "__main__":
    sys.exit(main())
