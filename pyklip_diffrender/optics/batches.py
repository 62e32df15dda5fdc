"""How many arrays to compute at a time."""

from __future__ import annotations

import torch

__all__ = ["batch_of"]

_CPU_BYTES = 3e6
"""Bytes of one array of a batch on the CPU. Batches of three times the size may take twice as long:
the C library returns their memory to the operating system, which has to clear it for the next."""

_GPU_BYTES = 1e8
"""Bytes of one array of a batch on an accelerator, which needs many arrays at a time to be busy;
not measured."""


def batch_of(size: int, dtype: torch.dtype, device: torch.device) -> int:
    """Return how many arrays to compute at a time, at least 1.

    Parameters
    ----------
    size : int
        Number of elements of the largest array for each member of the batch.
    dtype : torch.dtype
        Its type.
    device : torch.device

    Examples
    --------
    >>> batch_of(160 * 160, torch.complex64, torch.device("cpu"))
    14
    """
    available = _CPU_BYTES if device.type == "cpu" else _GPU_BYTES
    return max(1, int(available / (size * dtype.itemsize)))
