"""Small HTML summaries of results, for notebooks."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from html import escape
from typing import Any

from astropy.table import Table

_MOST_ROWS = 20


def html_summary(
    title: str, facts: Mapping[str, Any], table: Table | None = None, columns: Iterable[str] = ()
) -> str:
    """Summary of an object as HTML, for ``_repr_html_``; facts that are None are left out.

    At most 20 rows of the table are shown, with the `columns` that exist. Everything that is not
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
        lines += _rows(table, [name for name in columns if name in table.colnames])
    return "\n".join([*lines, "</div>"])


def _rows(table: Table, names: list[str]) -> list[str]:
    shown = table[:_MOST_ROWS]
    units = ["" if table[n].unit in (None, "") else f" ({table[n].unit})" for n in names]
    titles = [f"{name}{unit}" for name, unit in zip(names, units, strict=True)]
    cells = zip(*(shown[name].info.iter_str_vals() for name in names), strict=True)
    lines = ["<table>", _line("th", titles), *(_line("td", row) for row in cells), "</table>"]
    if len(table) > len(shown):
        lines.append(f"<p>and {len(table) - len(shown)} more</p>")
    return lines


def _line(tag: str, cells: Iterable[str]) -> str:
    return "<tr>" + "".join(f"<{tag}>{escape(each)}</{tag}>" for each in cells) + "</tr>"
