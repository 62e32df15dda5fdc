"""Tell processes that are spawned in a `backend` block that plain KLIP would run in them.

A spawned process starts with pyKLIP as it is, and would run KLIP without a word where its parent
takes calls with ``algo="klip"``. The environment, which it inherits, says so to whatever it loads
of this package: the script that imports it, or a dataset that was read with it.
"""

from __future__ import annotations

import os

__all__ = ["announce", "spawned_beside_klip"]

_VARIABLE = "PYKLIP_DIFFRENDER_TAKES_KLIP"
"""Environment variable with the number of the process that takes calls with ``algo="klip"``."""


def announce(takes_klip: bool) -> None:
    """Tell processes that are spawned from now on whether this one takes calls of KLIP."""
    if takes_klip:
        os.environ[_VARIABLE] = str(os.getpid())
    elif os.environ.get(_VARIABLE) == str(os.getpid()):
        del os.environ[_VARIABLE]


def spawned_beside_klip() -> bool:
    """Whether this process was started by one that takes calls of KLIP."""
    return os.environ.get(_VARIABLE, str(os.getpid())) != str(os.getpid())
