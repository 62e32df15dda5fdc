"""Elements of an HTML page, with everything escaped that is not markup."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape
from importlib import resources
from string import Template
from urllib.parse import quote

__all__ = [
    "Markup",
    "Picture",
    "beside",
    "count",
    "document",
    "facts",
    "link",
    "note",
    "pictures",
    "section",
    "table",
]

_PAGE = Template("""\
<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy"
 content="default-src 'none'; img-src data:; style-src 'unsafe-inline'">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<title>$title</title>
<style>
$style</style>
</head>
<body>
$header<main>
$sections
</main>
</body>
</html>
""")


@dataclass(frozen=True)
class Picture:
    """A picture and its words.

    Attributes
    ----------
    png : bytes
    alt : str
        Description of the picture, for readers who do not see it.
    caption : str
    """

    png: bytes
    alt: str
    caption: str


class Markup(str):
    """Text that is HTML already."""

    __slots__ = ()


def link(path: str, text: str) -> Markup:
    """A link to a file beside the page, which is a cell of a table."""
    return Markup(f'<a href="{escape(quote(path))}">{escape(text)}</a>')


def document(title: str, header: str, sections: Iterable[str]) -> str:
    """A whole page that loads nothing; header and sections are HTML, the title is text."""
    style = resources.files("pyklip_diffrender.reduction").joinpath("page.css")
    return _PAGE.substitute(
        title=escape(title),
        style=style.read_text(encoding="utf-8"),
        header=header,
        sections="\n".join(sections),
    )


def section(title: str, *parts: str) -> str:
    """A part of the page with a heading; parts that are empty are left out."""
    return "\n".join([f"<section>\n<h2>{title}</h2>", *filter(None, parts), "</section>"])


def pictures(shown: Sequence[Picture], style: str = "") -> str:
    """Pictures with their captions, side by side as far as there is room."""
    figures = [
        f'<figure><img src="data:image/png;base64,{b64encode(each.png).decode()}" '
        f'alt="{escape(each.alt)}"><figcaption>{escape(each.caption)}</figcaption></figure>'
        for each in shown
    ]
    return "\n".join([f'<div class="pictures {style}">', *figures, "</div>"])


def beside(*parts: str) -> str:
    """Parts side by side as far as there is room."""
    return "\n".join(['<div class="beside">', *(f"<div>{each}</div>" for each in parts), "</div>"])


def table(header: Sequence[str], rows: Sequence[Sequence[str]], wrap: int | None = None) -> str:
    """A table that scrolls in its own box; column `wrap` may have several lines."""
    titles = "".join(f'<th scope="col">{escape(each)}</th>' for each in header)
    opening = '<td class="wrap">'
    lines = [
        "".join(
            f"{opening if k == wrap else '<td>'}"
            f"{each if isinstance(each, Markup) else escape(str(each))}</td>"
            for k, each in enumerate(row)
        )
        for row in rows
    ]
    body = "\n".join(f"<tr>{line}</tr>" for line in lines)
    return (
        f'<div class="scroll" tabindex="0"><table><thead><tr>{titles}</tr></thead>\n'
        f"<tbody>\n{body}\n</tbody></table></div>"
    )


def facts(known: Iterable[tuple[str, str]], style: str = "facts") -> str:
    """Names with their values."""
    items = "\n".join(
        f"<div><dt>{escape(name)}</dt><dd>{escape(value)}</dd></div>" for name, value in known
    )
    return f'<dl class="{style}">\n{items}\n</dl>'


def note(text: str) -> str:
    """A paragraph in small letters."""
    return f'<p class="note">{escape(text)}</p>'


def count(number: int, noun: str) -> str:
    """A number with its noun, in the plural where it needs one."""
    return f"{number} {noun}{'' if number == 1 else 's'}"
