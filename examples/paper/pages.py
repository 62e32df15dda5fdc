"""Functions shared by the pages that are made from committed tables."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from astropy.table import Table

RESULTS = Path("docs/results")
KINDS = {"measured": "measured maps", "generator": "embedded generator"}
"""Name in a table's file, name for readers."""


def read(study: str, kind: str) -> Table | None:
    """A study's table, if it has been run."""
    path = RESULTS / f"{study}_{kind}.ecsv"
    return Table.read(path, format="ascii.ecsv") if path.is_file() else None


def tables(study: str) -> dict[str, Table]:
    """Tables of a study, for every kind of wavefront."""
    by_kind = {kind: read(study, kind) for kind in KINDS}
    return {kind: table for kind, table in by_kind.items() if table is not None}


def markdown(header: Iterable[str], rows: Iterable[Iterable[str]]) -> list[str]:
    """Format a table in Markdown."""
    head = list(header)
    return [
        "| " + " | ".join(head) + " |",
        "|" + "---|" * len(head),
        *("| " + " | ".join(row) + " |" for row in rows),
        "",
    ]


def origin(by_kind: dict[str, Table]) -> list[str]:
    """List the command, date and duration of each table."""
    return [
        f"- {KINDS[kind]}: `{table.meta['command']}`, {table.meta['date']}, "
        f"{table.meta['seconds'] / 60:.0f} min ({table.meta['machine']})."
        for kind, table in by_kind.items()
    ] + [""]


def study_table(results: Path, name: str) -> tuple[Table, Path, str] | None:
    """A study's table, that on the measured maps if it exists."""
    for kind, label in KINDS.items():
        path = results / f"{name}_{kind}.ecsv"
        if path.is_file():
            return Table.read(path, format="ascii.ecsv"), path, label
    return None
