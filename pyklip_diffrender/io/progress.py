"""Progress of long computations, on a terminal and in the log; numbers as words have them."""

from __future__ import annotations

import itertools
import logging
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Self

from tqdm import tqdm

_log = logging.getLogger(__name__)

_STAGE: ContextVar[str] = ContextVar("stage", default="")

_NUMBERS: ContextVar[Iterator[int] | None] = ContextVar("numbers", default=None)
"""Numbers of the next stages; None where they are not numbered."""

_LISTENER: ContextVar[Callable[[str], None] | None] = ContextVar("listener", default=None)

_BUSY: ContextVar[bool] = ContextVar("busy", default=False)
"""Whether a bar is shown already; bars inside it are not."""

_COUNTED = "{desc}: {percentage:3.0f} % [{elapsed}<{remaining}]"
_OPEN = "{desc}, step {n} [{elapsed}]"


def duration(seconds: float) -> str:
    """Return a duration as a person would say it: 40 s, 12 min, 3.5 h."""
    if seconds < 100:
        return f"{max(seconds, 1):.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 100 * 60 else f"{seconds / 3600:.1f} h"


def counted(number: int, noun: str) -> str:
    """Return a number with its noun, in the plural where it needs one."""
    return f"{number} {noun}{'' if number == 1 else 's'}"


@contextmanager
def numbered_stages() -> Iterator[None]:
    """Number the stages inside from 1, unless they are part of stages that are numbered."""
    token = _NUMBERS.set(itertools.count(1)) if _NUMBERS.get() is None else None
    try:
        yield
    finally:
        if token is not None:
            _NUMBERS.reset(token)


@contextmanager
def heard_by(listener: Callable[[str], None]) -> Iterator[None]:
    """Call a function with the name of every stage inside, besides the log."""
    token = _LISTENER.set(listener)
    try:
        yield
    finally:
        _LISTENER.reset(token)


@contextmanager
def stage(name: str) -> Iterator[None]:
    """Name what is being done, such as "wavefront", for bars inside and for the log."""
    numbers = _NUMBERS.get()
    if numbers is not None:
        name = f"{next(numbers)}. {name}"
    token = _STAGE.set(name)
    _log.info("%s", name)
    listener = _LISTENER.get()
    if listener is not None:
        listener(name)
    try:
        yield
    finally:
        _STAGE.reset(token)


class ProgressBar:
    """A progress bar that also writes a line to the log now and then, at most one a minute.

    Inside a `stage` the name of the stage is shown in place of `name`. The bar is on standard error
    if `shown`. `total` is None for a loop that ends when it has converged. A bar inside another bar
    is not shown, nor logged.
    """

    def __init__(self, name: str, total: int | None = None, *, shown: bool) -> None:
        self._nested = _BUSY.get()
        self._name = _STAGE.get() or name
        self._total, self._steps, self._logged = total, 0, time.monotonic()
        self._bar = tqdm(
            total=total,
            desc=self._name,
            disable=self._nested or not shown,
            leave=False,
            # The time left by the mean of all steps; by the last few steps, it would jump.
            smoothing=0,
            bar_format=_OPEN if total is None else _COUNTED,
        )

    def __enter__(self) -> Self:
        self._token = _BUSY.set(True)
        return self

    def __exit__(self, *error: object) -> None:
        self._bar.close()
        _BUSY.reset(self._token)

    def update(self, steps: int = 1, **values: float) -> None:
        """Count steps, and show values such as ``chi2=4.1`` beside the name."""
        self._steps += steps
        text = ", ".join([self._name, *(f"{key} {value:.3g}" for key, value in values.items())])
        self._bar.set_description_str(text, refresh=False)
        self._bar.update(steps)
        if not self._nested and time.monotonic() - self._logged >= 60:
            self._logged = time.monotonic()
            of = "" if self._total is None else f" of {self._total}"
            _log.info("%s, step %d%s", text, self._steps, of)
