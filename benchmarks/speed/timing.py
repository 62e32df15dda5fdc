"""How long things take: side by side, in one process."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch

_FEWEST_ROUNDS = 3

_SHORT = 0.05
"""Seconds: what takes less is called several times in a row, with warm caches."""


def synchronise(device: str) -> None:
    """Wait until an accelerator has done what it was asked to."""
    if torch.device(device).type == "cuda":
        torch.cuda.synchronize(device)


def seconds(work: Callable[[], Any], device: str = "cpu") -> float:
    """Duration of one call."""
    synchronise(device)
    start = time.perf_counter()
    work()
    synchronise(device)
    return time.perf_counter() - start


def interleaved(
    works: Sequence[Callable[[], Any]], budget: float, device: str = "cpu"
) -> list[float]:
    """The shortest duration of each of several functions, called in turns.

    In turns, because what else the machine does then disturbs all alike.

    Parameters
    ----------
    works : sequence of callable
        Warm: each was called before.
    budget : float
        Seconds for each; what takes longer than a third of it is called less than three times,
        but at least once.
    device : str
        See `synchronise`.
    """
    shortest = [math.inf] * len(works)
    spent = [0.0] * len(works)
    for turn in range(max(_FEWEST_ROUNDS, math.ceil(budget / _SHORT))):
        rested = True
        for k, work in enumerate(works):
            if turn and spent[k] + shortest[k] > budget:
                continue
            rested = False
            for _ in range(5 if shortest[k] < _SHORT else 1):
                durations = seconds(work, device)
                spent[k] += durations
                shortest[k] = min(shortest[k], durations)
        if rested:
            break
    return shortest


def exponent(sizes: Sequence[float], durations: Sequence[float]) -> float:
    """The power of the size with which a duration grows: a straight line through logarithms."""
    return float(np.polyfit(np.log(sizes), np.log(durations), 1)[0])
