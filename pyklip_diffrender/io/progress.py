"""Progress of long computations: one bar on a terminal, and few lines in the log."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from types import TracebackType
from typing import Self

from tqdm import tqdm

__all__ = ["ProgressBar", "numbered_stages", "stage"]

_log = logging.getLogger(__name__)

_STAGE: ContextVar[str] = ContextVar("stage", default="")

_COUNT: ContextVar[int | None] = ContextVar("count", default=None)
"""Number of stages that have begun; None where they are not numbered."""

_BUSY: ContextVar[bool] = ContextVar("busy", default=False)
"""Whether a bar is shown already; bars inside it are not."""

_INTERVAL = 60.0
"""Shortest time between two lines of a bar in the log, s."""

_COUNTED = "{desc}: {percentage:3.0f} % [{elapsed}<{remaining}]"
_OPEN = "{desc}, step {n} [{elapsed}]"


@contextmanager
def numbered_stages() -> Iterator[None]:
    """Number the stages inside from 1, unless they are part of stages that are numbered."""
    outermost = _COUNT.get() is None
    if outermost:
        _COUNT.set(0)
    try:
        yield
    finally:
        if outermost:
            _COUNT.set(None)


@contextmanager
def stage(name: str) -> Iterator[None]:
    """Name what is being done, such as "wavefront", for bars inside and for the log."""
    count = _COUNT.get()
    if count is not None:
        _COUNT.set(count + 1)
        name = f"{count + 1}. {name}"
    token = _STAGE.set(name)
    _log.info("%s", name)
    try:
        yield
    finally:
        _STAGE.reset(token)


class ProgressBar:
    """A progress bar that also writes a line to the log now and then, at most one a minute.

    Parameters
    ----------
    name : str
        What is counted. Inside a `stage` the name of that is shown instead.
    total : int, optional
        Number of steps; None for a loop that ends when it has converged.
    shown : bool
        Show the bar on standard error. A bar inside another one is not shown, nor logged.
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
            bar_format=_OPEN if total is None else _COUNTED,
        )

    def __enter__(self) -> Self:
        self._token = _BUSY.set(True)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._bar.close()
        _BUSY.reset(self._token)

    def update(self, steps: int = 1, **values: float) -> None:
        """Count steps, and show values such as ``chi2=4.1`` beside the name."""
        self._steps += steps
        text = ", ".join([self._name, *(f"{key} {value:.3g}" for key, value in values.items())])
        self._bar.set_description_str(text, refresh=False)
        self._bar.update(steps)
        if not self._nested and time.monotonic() - self._logged >= _INTERVAL:
            self._logged = time.monotonic()
            of = "" if self._total is None else f" of {self._total}"
            _log.info("%s, step %d%s", text, self._steps, of)
