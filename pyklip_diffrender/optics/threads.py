"""Threads of torch in processes that are made by a fork."""

from __future__ import annotations

import os

import torch

__all__ = ["one_thread_after_fork"]

_registered = False


def one_thread_after_fork() -> None:
    """Let forked children of this process compute with one thread.

    A fork copies the state of the thread pool of OpenMP, but not its threads: a child of a process
    that has computed with several threads, such as a worker of `multiprocessing.Pool`, would wait
    for them forever. One thread needs no pool. Children may not raise the number again.
    """
    global _registered
    if not _registered and hasattr(os, "register_at_fork"):
        os.register_at_fork(after_in_child=lambda: torch.set_num_threads(1))
        _registered = True
