"""Time and difference of images, for the benchmarks that compare them."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def timed(function: Callable[[], Any], repeats: int = 1) -> tuple[Any, float]:
    """The result and the fastest of several runs, s."""
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        result = function()
        seconds.append(time.perf_counter() - start)
    return result, min(seconds)


def largest(image: Array, truth: Array) -> float:
    """Largest difference as a fraction of the peak."""
    return float(np.abs(image - truth).max() / truth.max())
