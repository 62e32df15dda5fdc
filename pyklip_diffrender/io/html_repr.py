"""Small HTML summaries of results, for notebooks."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from html import escape
from typing import Any

from astropy.table import Table


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
