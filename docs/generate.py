"""Tables of the pages that are made from the code and from the results of benchmarks."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Sequence
from dataclasses import MISSING, Field, fields
from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import Table
from numpydoc.docscrape import NumpyDocString

from pyklip_diffrender.cli import application
from pyklip_diffrender.io.headers import KEYWORDS
from pyklip_diffrender.reduction import ReduceOptions

__all__ = ["hard_cases", "keywords", "options", "scene_needs", "write_tables"]

RESULTS = Path(__file__).parent / "results"

GOOD = 0.03
"""Largest change of the limits for a model that is good enough."""


def options() -> list[list[str]]:
    """Rows for the options of `reduce`: name, default, option of the command line, meaning."""
    described = {
        name.strip(): (parameter.type, " ".join(parameter.desc))
        for parameter in NumpyDocString(ReduceOptions.__doc__ or "")["Parameters"]
        for name in parameter.name.split(",")
    }
    # An option without a description would leave a hole in the page.
    missing = {each.name for each in fields(ReduceOptions)} - set(described)
    assert not missing, f"ReduceOptions: {missing} are not in its section Parameters"
    flags = {param.name: param.opts[0] for param in application.commands["reduce"].params}
    return [
        [
            f"`{each.name}`: {described[each.name][0]}",
            _default(each),
            f"`{flags[each.name]}`" if each.name in flags else "",
            described[each.name][1],
        ]
        for each in fields(ReduceOptions)
    ]


def _default(field: Field[Any]) -> str:
    value = field.default_factory() if field.default is MISSING else field.default  # type: ignore[misc]
    return f"`{value!r}`"


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
