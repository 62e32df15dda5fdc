"""When, where and with what a table of a benchmark was measured."""

from __future__ import annotations

import datetime
import os
import platform
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import torch


def processor() -> str:
    """What the machine calls its processor."""
    info = Path("/proc/cpuinfo")
    if info.is_file():
        for line in info.read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


def _version(name: str) -> str:
    try:
        return f"{name} {version(name)}"
    except PackageNotFoundError:
        return f"{name} (not installed)"


def provenance(command: str, packages: tuple[str, ...] = ("poppy",)) -> list[str]:
    """Lines of Markdown: date, command, machine, versions.

    Parameters
    ----------
    command : str
        The script, from the root of the project.
    packages : tuple of str
        What the table compares with.
    """
    versions = ", ".join(
        [f"Python {platform.python_version()}", f"torch {torch.__version__}"]
        + [_version(name) for name in ("numpy", *packages)]
    )
    return [
        f"- Measured {datetime.datetime.now(datetime.UTC):%Y-%m-%d} by `python {command}`.",
        f"- {os.cpu_count()} cores of {processor()}, {torch.get_num_threads()} threads.",
        f"- {versions}.",
    ]
