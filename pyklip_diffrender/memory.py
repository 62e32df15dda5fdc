"""What the C library does with memory that arrays have freed."""

from __future__ import annotations

import ctypes
import sys

__all__ = ["keep_freed_memory"]

# Of malloc.h; mallopt takes no larger value than an int.
_TRIM_THRESHOLD, _MMAP_MAX = -1, -4
_LARGEST = 2**31 - 1


def keep_freed_memory() -> bool:
    """Keep what arrays free for the next ones, instead of giving it back to the system.

    A fit makes and frees gigabytes in arrays of tens of megabytes. As it comes, glibc has the
    system provide each of them anew, page by page; kept, they made fits a tenth to a fifth faster
    (docs/inference.md). The process then holds as much memory as it ever needed. The command line
    does this for its own process. A library must not for its caller's: call it once, at the
    beginning of a program.

    Returns
    -------
    bool
        Whether the C library has such a setting: glibc does.
    """
    if sys.platform != "linux":
        return False
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is None:
        return False
    settings = ((_MMAP_MAX, 0), (_TRIM_THRESHOLD, _LARGEST))
    return all(mallopt(name, value) == 1 for name, value in settings)
