"""Pages of HTML that need no other file: their templates, pictures and numbers."""

from __future__ import annotations

import re
from base64 import b64encode
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from pyklip_diffrender import drawing
from pyklip_diffrender.reduction.words import number, plus_minus, probability, scientific

if TYPE_CHECKING:
    from jinja2 import Environment

__all__ = ["FIGURE_FORMATS", "Picture", "count", "render", "write_figures"]

FIGURE_FORMATS = ("pdf", "png", "svg")
"""Formats in which the figures of a page can be written as files of their own."""


@dataclass(frozen=True, eq=False)
class Picture:
    """A figure of a page and its words.

    Attributes
    ----------
    name : str
        Of its file, without the ending.
    figure : matplotlib Figure
    alt : str
        Description of the picture, for readers who do not see it.
    caption : str
    """

    name: str
    figure: Any
    alt: str
    caption: str

    @cached_property
    def uri(self) -> str:
        """The picture itself as the address of an image."""
        return f"data:image/png;base64,{b64encode(drawing.to_png(self.figure)).decode()}"


def render(template: str, **values: Any) -> str:
    """Make a page of a template; all values are escaped: headers of files may hold anything."""
    return _environment().get_template(template).render(values)


def write_figures(pictures: Iterable[Picture], folder: Path, form: str) -> list[Path]:
    """Write every figure to a file of its own in one of `FIGURE_FORMATS`."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for each in pictures:
        paths.append(folder / f"{each.name}.{form}")
        drawing.save(each.figure, paths[-1])
    return paths


def count(number: int, noun: str) -> str:
    """A number with its noun, in the plural where it needs one."""
    return f"{number} {noun}{'' if number == 1 else 's'}"


def _unbroken(text: str) -> str:
    """Text whose numbers are not broken over lines."""
    return re.sub(" ([±×]) ", "\u00a0\\1\u00a0", text)


@cache
def _environment() -> Environment:
    # Commands that write no page need no templates.
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader("pyklip_diffrender.reduction", "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters |= {
        "count": count,
        "number": number,
        "path": quote,
        "plus_minus": plus_minus,
        "probability": probability,
        "scientific": scientific,
        "unbroken": _unbroken,
    }
    return environment
