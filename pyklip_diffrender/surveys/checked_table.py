"""A table of a configuration whose values are checked one by one, with all mistakes collected."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

__all__ = [
    "CheckedTable",
    "as_count",
    "as_flag",
    "as_list",
    "as_number",
    "as_positive",
    "as_table",
    "as_text",
    "list_of",
    "only",
    "short",
]

Convert = Callable[[Any], Any]
"""Takes a value, and raises ValueError if it is not as expected."""


class CheckedTable:
    """A table of the file, whose keys are taken one by one.

    Parameters
    ----------
    content : mapping
        Anything else is a mistake.
    place : str
        Name of the table in messages; "" for the whole file.
    folder : Path
        Of the file, to which paths are relative.
    problems : list of str
        All mistakes are added to it.
    """

    def __init__(self, content: Any, place: str, folder: Path, problems: list[str]) -> None:
        self.place, self.folder, self.problems = place, folder, problems
        if not isinstance(content, Mapping):
            self.complain("", content, "a table with keys")
            content = {}
        self.content = dict(content)
        self.known: list[str] = []

    def complain(self, key: str, value: Any, expected: str) -> None:
        """Add a mistake: the value of a key, or of the table for ""."""
        where = ": ".join(filter(None, [self.place, key]))
        self.problems.append(f"{where}: got {short(value)}, expected {expected}")

    def take(self, key: str, default: Any, expected: str, convert: Convert) -> Any:
        """Value of a key; `convert` raises ValueError for one that is not as expected."""
        self.known.append(key)
        if key not in self.content:
            return default
        value = self.content.pop(key)
        try:
            return convert(value)
        except (ValueError, OverflowError):
            self.complain(key, value, expected)
            return default

    def table(self, key: str) -> CheckedTable:
        """The table of a key; empty if there is none."""
        self.known.append(key)
        where = ": ".join(filter(None, [self.place, key]))
        return CheckedTable(self.content.pop(key, {}), where, self.folder, self.problems)

    def existing(self, value: Any) -> Path:
        """A path that exists, relative to the configuration's folder."""
        path = self.folder / as_text(value)
        try:
            exists = path.exists()
        except OSError as error:  # Such as a name that is too long.
            raise ValueError(str(path)) from error
        if not exists:
            raise ValueError(str(path))
        return path.absolute()

    def finish(self) -> None:
        """Complain about keys that nobody took."""
        for key in self.content:
            where = f"{self.place}: " if self.place else ""
            self.problems.append(
                f"{where}got the key {short(key)}, expected one of {', '.join(self.known)}. "
                "Check its name and in which table it is"
            )


def short(value: Any) -> str:
    """A value in at most 80 characters."""
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:77]}..."


def as_text(value: Any) -> str:
    """Printable text, without the spaces around it."""
    if not isinstance(value, str) or not value.strip() or not value.isprintable():
        raise ValueError
    return value.strip()


def as_number(value: Any) -> float:
    """A finite number."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ValueError
    return float(value)


def as_flag(value: Any) -> bool:
    """True or false."""
    if not isinstance(value, bool):
        raise ValueError
    return value


def as_count(value: Any) -> int:
    """A whole number, 0 or more."""
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value < 1_000_000:
        raise ValueError
    return value


def as_table(value: Any) -> dict[str, Any]:
    """A mapping."""
    if not isinstance(value, Mapping):
        raise ValueError
    return dict(value)


def as_list(value: Any) -> list[Any]:
    """A list, which may be empty."""
    if not isinstance(value, list):
        raise ValueError
    return value


def list_of(convert: Convert) -> Callable[[Any], tuple[Any, ...]]:
    """Accept lists whose entries all are as expected."""
    return lambda value: tuple(map(convert, as_list(value)))


def only(convert: Convert, is_allowed: Callable[[Any], object]) -> Convert:
    """Accept some of the values that a converter accepts."""

    def check(value: Any) -> Any:
        converted = convert(value)
        if not is_allowed(converted):
            raise ValueError
        return converted

    return check


as_positive = only(as_number, lambda number: number > 0)
