"""Names of stars and filters, which archives and observers spell differently."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable

from pyklip_diffrender.errors import IncompatibleSetupError

__all__ = ["same_name", "unknown_name"]

_SIMBAD = re.compile(r"(V|NAME|\*+)?\*?[\s_-]+", re.IGNORECASE)
"""Prefixes of names in SIMBAD, and of observers after it: V* AU Mic, V-AU-MIC, * bet Pic."""


_SLIP = 0.6
"""Least similarity of the digits of a name and of the same with one of three digits wrong."""

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
    """Error for a name that is not among those there are, with the one that may be meant.

    Examples
    --------
    >>> print(unknown_name("target", "HIP 17659", ["HIP 17695", "AU Mic"]))
    target: got 'HIP 17659', expected one of 'AU Mic', 'HIP 17695'. Did you mean 'HIP 17695'?
    >>> print(unknown_name("target", "HIP 1234", ["HIP 17695", "AU Mic"]))
    target: got 'HIP 1234', expected one of 'AU Mic', 'HIP 17695'
    """
    known = sorted({str(name) for name in names})
    # Another number is another star, however alike the names are.
    by_plain = {_plain(name): name for name in known if _alike_numbers(choice, name)}
    nearest = difflib.get_close_matches(_plain(choice), by_plain, n=1, cutoff=0.4)
    hint = f". Did you mean {by_plain[nearest[0]]!r}?" if nearest else ""
    return IncompatibleSetupError(
        f"{key}: got {choice!r}, expected one of {', '.join(map(repr, known))}{hint}"
    )


def _alike_numbers(first: str, second: str) -> bool:
    """Whether two names have the same digits but for a slip of the fingers, or one has none."""
    one, other = ("".join(filter(str.isdigit, name)) for name in (first, second))
    if not (one and other):
        return True
    return difflib.SequenceMatcher(None, one, other).ratio() >= _SLIP


def _plain(name: str) -> str:
    signed = _SIGN.sub("\x01", name.upper())
    return "".join(c for c in signed if c.isalnum() or c == "\x01")


def _bare(name: str) -> str:
    mark = _SIMBAD.match(name)
    return _plain(name[mark.end() :] if mark else name)
