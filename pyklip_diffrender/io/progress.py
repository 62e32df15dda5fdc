"""Progress of long computations: one bar on a terminal, and few lines in the log."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from types import TracebackType
from typing import Self

from tqdm import tqdm

__all__ = [
    "ProgressBar",
    "duration",
    "heard_by",
    "heartbeat",
    "numbered_stages",
    "progressed",
    "stage",
]

_log = logging.getLogger(__name__)

_STAGE: ContextVar[str] = ContextVar("stage", default="")

_SCHEDULE: ContextVar[_Schedule | None] = ContextVar("schedule", default=None)
"""None where stages are not numbered."""

_LISTENER: ContextVar[Callable[[str], None] | None] = ContextVar("listener", default=None)

_BUSY: ContextVar[bool] = ContextVar("busy", default=False)
"""Whether a bar is shown already; bars inside it are not."""

_INTERVAL = 60.0
"""Shortest time between two lines of a bar in the log, s."""

_COUNTED = "{desc}: {percentage:3.0f} % [{elapsed}<{remaining}]"
_OPEN = "{desc}, step {n} [{elapsed}]"


def duration(seconds: float) -> str:
    """Return a duration as a person would say it: 40 s, 12 min, 3.5 h."""
    if seconds < 100:
        return f"{max(seconds, 1):.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 100 * 60 else f"{seconds / 3600:.1f} h"


@dataclass
class _Schedule:
    """Stages and how long they take, compared with what was expected."""

    expected: dict[str, float]  # s, of stages that have not begun, by name
    count: int = 0  # of stages that have begun
    _own: float = 0.0  # expected duration of the present stage, s
    _began: float = field(default_factory=time.monotonic)
    _done: float = 0.0  # expected duration of the stages that have ended, s
    _spent: float = 0.0  # what these have taken, s
    _part: float = 0.0
    _part_spent: float = 0.0

    def begin(self, name: str) -> str:
        """Begin a stage; its name with its number."""
        self.count += 1
        self._own, self._began = self.expected.pop(name, 0.0), time.monotonic()
        self._part = 0.0
        return f"{self.count}. {name}"

    def end(self) -> None:
        """End the stage: the next estimates are by the speed of all stages that were expected."""
        if self._own:
            self._done += self._own
            self._spent += time.monotonic() - self._began
        self._own = 0.0

    def progressed(self, part: float) -> None:
        """Note that a part of the stage is done: the next estimates are by its speed as well."""
        self._part, self._part_spent = part, time.monotonic() - self._began

    @property
    def left(self) -> str:
        """Time that this stage and the next ones take, as far as they were expected."""
        if not (self._own or self.expected):
            return ""
        # `pace` is the time that things take over the time that was expected.
        spent, later = time.monotonic() - self._began, sum(self.expected.values())
        pace = self._spent / self._done if self._done else 1.0
        if self._part > 0:
            # By the speed of what is done of this stage, which is a large one.
            pace = self._part_spent / (self._own * self._part) if self._own else pace
            # What was expected of the rest, at that pace, less what has passed since the part was
            # noted.
            rest = (self._own * (1 - self._part) + later) * pace - (spent - self._part_spent)
            return f", about {duration(max(rest, later * pace))} left"
        if not self._own:
            return f", about {duration(later * pace)} left"
        if spent <= self._own * pace:
            return f", about {duration((self._own + later) * pace - spent)} left"
        if not later:
            return ""
        # This stage takes longer than expected, and so may the next ones.
        pace = (self._spent + spent) / (self._done + self._own)
        return f", more than {duration(later * pace)} left"


@contextmanager
def numbered_stages(expected: Mapping[str, float] | None = None) -> Iterator[None]:
    """Number the stages inside from 1, unless they are part of stages that are numbered.

    With `expected` durations of stages (s, by name), messages say how much time is left, by the
    speed of the stages that have ended.
    """
    token = None
    if _SCHEDULE.get() is None:
        token = _SCHEDULE.set(_Schedule(dict(expected or {})))
    try:
        yield
    finally:
        if token is not None:
            _SCHEDULE.reset(token)


def progressed(part: float) -> None:
    """Note that a part of the current stage, from 0 to 1, is done, for estimates of the time."""
    schedule = _SCHEDULE.get()
    if schedule is not None:
        schedule.progressed(part)


@contextmanager
def heartbeat(say: Callable[[], str]) -> Iterator[None]:
    """Write a line to the log every minute, whatever else is done or waited for inside."""
    ended = threading.Event()

    def beat() -> None:
        while not ended.wait(_INTERVAL):
            _log.info("%s", say())

    thread = threading.Thread(target=beat, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def _left() -> str:
    schedule = _SCHEDULE.get()
    return "" if schedule is None else schedule.left


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
    schedule = _SCHEDULE.get()
    if schedule is not None:
        name = schedule.begin(name)
    token = _STAGE.set(name)
    _log.info("%s%s", name, _left())
    listener = _LISTENER.get()
    if listener is not None:
        listener(name)
    try:
        yield
    finally:
        _STAGE.reset(token)
        if schedule is not None:
            schedule.end()


class ProgressBar:
    """A progress bar that also writes a line to the log now and then, at most one a minute.

    Inside a `stage` the name of the stage is shown in place of `name`. It is on standard error if
    `shown`. `total` is None for a loop that ends when it has converged. A bar inside another one is
    not shown, nor logged.
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
        text += "" if self._nested else _left()
        self._bar.set_description_str(text, refresh=False)
        self._bar.update(steps)
        if not self._nested and time.monotonic() - self._logged >= _INTERVAL:
            self._logged = time.monotonic()
            of = "" if self._total is None else f" of {self._total}"
            _log.info("%s, step %d%s", text, self._steps, of)
