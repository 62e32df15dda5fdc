"""Names of stars and filters, which archives and observers spell differently."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable

from pyklip_diffrender.errors import IncompatibleSetupError

__all__ = ["same_name", "unknown_name"]

_SIMBAD = re.compile(r"(V|NAME|\*+)?\*?[\s_-]+", re.IGNORECASE)
"""Prefixes of names in SIMBAD, and of observers after it: V* AU Mic, V-AU-MIC, * bet Pic."""


_SIGN = re.compile(r"\+(?=\s*\d)")
"""A plus sign before digits, which belongs to the name: BD+20 1790 is not BD-20 1790."""


def same_name(first: str | None, second: str | None) -> bool:
    """Whether two names differ only in case, separators and SIMBAD's marks before the name.

    A plus sign before digits counts. A minus sign cannot be told from a dash.

    Examples
    --------
    >>> same_name("V* AU Mic", "au-mic"), same_name("BD+20-1790", "BD-20-1790")
    (True, False)
    """
    names = [str(each) for each in (first, second)]
    return _plain(names[0]) == _plain(names[1]) or _bare(names[0]) == _bare(names[1])


def unknown_name(key: str, choice: str, names: Iterable[str | None]) -> IncompatibleSetupError:
    """Error for a name that is not among those there are, with the nearest of them."""
    known = sorted({str(name) for name in names})
    by_plain = {_plain(name): name for name in known}
    nearest = difflib.get_close_matches(_plain(choice), by_plain, n=1, cutoff=0.4)
    hint = f". Did you mean {by_plain[nearest[0]]!r}?" if nearest else ""
    return IncompatibleSetupError(
        f"{key}: got {choice!r}, expected one of {', '.join(map(repr, known))}{hint}"
    )


def _plain(name: str) -> str:
    signed = _SIGN.sub("\x01", name.upper())
    return "".join(c for c in signed if c.isalnum() or c == "\x01")


def _bare(name: str) -> str:
    mark = _SIMBAD.match(name)
    return _plain(name[mark.end() :] if mark else name)
