"""Tables of the pages that are made from the code and from the results of benchmarks."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from astropy.table import Table

from pyklip_diffrender.io.headers import KEYWORDS
from pyklip_diffrender.options import OPTIONS

__all__ = ["hard_cases", "keywords", "options", "scene_needs", "write_tables"]

RESULTS = Path(__file__).parent / "results"

GOOD = 0.03
"""Largest change of the limits for a model that is good enough."""


def options() -> list[list[str]]:
    """Rows for the options of `reduce`: name, default, option of the command line, meaning."""
    return [
        [
            f"`{each.name}`: {each.stated_type}",
            f"`{each.default!r}`",
            "" if each.not_on_command_line else f"`{each.flag}`",
            each.meaning,
        ]
        for each in OPTIONS.values()
    ]


def keywords() -> list[list[str]]:
    """Rows for the package's FITS keywords: name, files, comment, meaning."""
    return [
        [f"`{each.name}`", each.files, each.comment, each.meaning] for each in KEYWORDS.values()
    ]


def scene_needs(window: int = 80) -> list[list[str]]:
    """Rows for the cheapest model that is good enough, by how much fainter the star is."""
    table = Table.read(RESULTS / "scene_fidelity.ecsv")
    table = table[table["window"] == window]
    rows = [["star", "modes of the wavefront", "wavelengths", "samples across the pupil"]]
    for fainter in dict.fromkeys(table["fainter"]):
        cases = {
            str(row["model"]): float(row["change"]) for row in table[table["fainter"] == fainter]
        }
        modes = _cheapest(cases, "modes to", "all")
        name = "as it is" if fainter == 1 else f"{fainter} times fainter"
        waves = _cheapest(cases, "nlambda: ", "7").removeprefix("nlambda: ")
        samples = "128" if cases["npix: 128"] <= GOOD else "256"
        rows.append([name, modes.removeprefix("modes "), waves, samples])
    return rows


def _cheapest(cases: dict[str, float], kind: str, finest: str) -> str:
    """The last of the cases of a kind, from fine to coarse, before one is not good enough."""
    best = finest
    for name, change in cases.items():
        if name.startswith(kind):
            if change > GOOD:
                break
            best = name
    return best


def hard_cases() -> Table:
    """Hard cases with the error of the fitted star and the status of the fit."""
    table = Table.read(RESULTS / "stability_fits.ecsv")
    return table[np.isfinite(table["error"])]


def _write(path: Path, rows: Iterable[Sequence[str]]) -> None:
    with path.open("w", encoding="utf-8", newline="") as file:
        csv.writer(file).writerows(rows)


def write_tables(folder: Path) -> None:
    """Write the tables as CSV files into a folder."""
    _write(folder / "options.csv", options())
    _write(folder / "keywords.csv", keywords())
    _write(folder / "scene_needs.csv", scene_needs())
