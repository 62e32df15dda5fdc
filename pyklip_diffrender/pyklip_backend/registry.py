"""Who uses the backend in this process, with which settings, and which calls are for it."""

from __future__ import annotations

import threading
import warnings
import weakref
from contextvars import ContextVar
from typing import Any, Protocol

from pyklip_diffrender.errors import DiffrenderWarning
from pyklip_diffrender.pyklip_backend.backend_settings import DiffrenderSettings, settings_of
from pyklip_diffrender.pyklip_backend.klip_call import RESULTS
from pyklip_diffrender.pyklip_backend.output_files import ReductionRecord
from pyklip_diffrender.pyklip_backend.patch import PatchedFunction

__all__ = [
    "ALGORITHM",
    "BLOCK",
    "BOTH",
    "REGISTRY",
    "Patched",
    "is_ours",
    "name_of",
    "settings_for",
    "warn_of_klip",
]

ALGORITHM = "diffrender"
"""Value of the argument `algo` of `klip_dataset`."""

BOTH = f"{ALGORITHM}+klip"
"""Name of the algorithm that writes KLIP's products beside those of this backend."""


class Patched(Protocol):
    """The functions of pyKLIP that are changed while the backend is in use."""

    klip_dataset: PatchedFunction
    fm_klip_dataset: PatchedFunction

    def restore(self) -> None:
        """Undo the changes."""


class Registry:
    """The users of the backend, and the settings given to `register`.

    Attributes
    ----------
    lock : RLock
        For changes of the others.
    patches : Patched or None
        None while nobody uses the backend.
    registered : bool
    blocks, forcing : int
        Number of `backend` blocks in all threads, and of those that take over KLIP.
    watching : bool
        Whether plain KLIP is mentioned, in a spawned process.
    defaults : DiffrenderSettings
    replace : bool or None
        Whether `register` was told to take over KLIP.
    """

    def __init__(self) -> None:
        self.lock = threading.RLock()
        self.patches: Patched | None = None
        self.registered = False
        self.blocks = 0
        self.forcing = 0
        self.watching = False
        self.defaults = DiffrenderSettings()
        self.replace: bool | None = None


REGISTRY = Registry()

_NO_BLOCK = (DiffrenderSettings(), None)
BLOCK: ContextVar[tuple[DiffrenderSettings, bool | None]] = ContextVar(
    "diffrender", default=_NO_BLOCK
)
"""Settings of the enclosing `backend` blocks, and whether they take over KLIP; None without."""

_warned: weakref.WeakSet[ReductionRecord] = weakref.WeakSet()
"""Reductions whose dataset, or a copy of it, was given to KLIP with a warning."""


def _takes_klip() -> bool | None:
    """Whether calls with ``algo="klip"`` are for this backend; None if nobody has said so."""
    _, force = BLOCK.get()
    return REGISTRY.replace if force is None else force


def name_of(algo: Any) -> str:
    """The argument `algo` in lower case and without spaces."""
    return "".join(str(algo).lower().split())


def is_ours(algo: Any) -> bool:
    """Whether a call with this `algo` is for this backend."""
    name = name_of(algo)
    return name in (ALGORITHM, BOTH) or (name == "klip" and bool(_takes_klip()))


def _outside_block() -> bool:
    """Whether a `backend` block was entered, but in other threads only."""
    return REGISTRY.blocks > 0 and BLOCK.get() is _NO_BLOCK


def warn_of_klip(dataset: Any, function: str) -> None:
    """Warn if KLIP runs where this backend may be expected."""
    if _takes_klip() is None and (REGISTRY.watching or (REGISTRY.forcing and _outside_block())):
        place = "spawned process" if REGISTRY.watching else "thread"
        warnings.warn(
            f"{function} runs KLIP in this {place}, to which the `with backend():` block or "
            "register(replace=True) that another one has entered does not extend. Call "
            f"register(replace=True, ...) or enter a block in the {place} itself",
            DiffrenderWarning,
            stacklevel=4,
        )
        return
    records = getattr(dataset, RESULTS, ())
    if not records or records[0] in _warned or _takes_klip() is not None:
        return
    _warned.add(records[0])
    warnings.warn(
        f"{function} runs KLIP on a dataset that was reduced with algo='diffrender' before. "
        "register(replace=True) or `with backend():` redirects calls of klip_dataset that ask for "
        "algo='klip'; register(replace=False) runs KLIP without this warning",
        DiffrenderWarning,
        stacklevel=4,
    )


def settings_for(dataset: Any) -> DiffrenderSettings:
    """Return the settings of the enclosing blocks, of the dataset and of `register`, merged."""
    settings, _ = BLOCK.get()
    if _outside_block():
        warnings.warn(
            "settings of a `with backend():` block that another thread has entered do not hold in "
            "this thread. Enter a block in the thread itself, or give the settings to register()",
            DiffrenderWarning,
            stacklevel=4,
        )
    return settings.over(settings_of(dataset)).over(REGISTRY.defaults)
