"""Tables with units, formats and descriptions, their rows as plain values, and HTML of results."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from html import escape
from typing import Any

import numpy as np
from astropy import units as u
from astropy.table import QTable, Table

Column = tuple[str, Any, Any, str, str]
"""Name, values, unit or None, format and description; the last two may be empty."""


def add_columns(table: QTable, columns: Iterable[Column]) -> QTable:
    """Add columns to a table, replacing columns of the same name, and return the table."""
    for name, values, unit, form, about in columns:
        table[name] = values if unit is None else values * unit
        table[name].info.format = form or None
        table[name].info.description = about or None
    return table


def labelled(table: Table, name: str) -> str:
    """Name of a column with its unit, which the names of magnitudes include already."""
    unit = table[name].unit
    return name if unit in (None, u.mag) else f"{name}_{unit}"


def plain_rows(table: Table) -> list[dict[str, Any]]:
    """Rows of a table as JSON has them, with the unit in the names; None for what is not known."""
    names = {name: labelled(table, name) for name in table.colnames}
    return [{label: _plain(row[name]) for name, label in names.items()} for row in table]


def _plain(cell: Any) -> Any:
    value = getattr(cell, "value", cell)
    value = value.item() if isinstance(value, np.generic | np.ndarray) else value
    return None if isinstance(value, float) and not math.isfinite(value) else value


def html_summary(
    title: str, facts: Mapping[str, Any], table: Table | None = None, columns: Iterable[str] = ()
) -> str:
    """Summary of an object as HTML, for ``_repr_html_``; facts that are None are left out.

    The table is shown in at most 20 lines, with the `columns` that exist. Everything that is not
    markup is escaped: headers of files may hold anything.
    """
    lines = [f"<div><strong>{escape(title)}</strong>", "<table>"]
    lines += [
        f'<tr><th style="text-align:left">{escape(name)}</th>'
        f'<td style="text-align:left">{escape(str(value))}</td></tr>'
        for name, value in facts.items()
        if value is not None
    ]
    lines.append("</table>")
    if table is not None and len(table):
        names = [name for name in columns if name in table.colnames]
        lines += table[names].pformat(max_lines=20, show_unit=True, html=True, tableid="")
    return "\n".join([*lines, "</div>"])
