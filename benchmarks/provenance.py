"""When, where and with what a table of a benchmark was measured."""

from __future__ import annotations

import datetime
import os
import platform
import subprocess
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import torch


def _processor() -> str:
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


def provenance(command: str, *packages: str) -> dict[str, str]:
    """Command, date, commit, machine and versions, for the metadata of a table.

    Parameters
    ----------
    command : str
        The script and its options, from the root of the project, without "python -m".
    packages : str
        What the table compares with.
    """
    git = ["git", "describe", "--always", "--dirty"]
    commit = subprocess.run(git, capture_output=True, text=True, check=True).stdout.strip()
    versions = [_version(name) for name in ("torch", "numpy", *packages)]
    threads = torch.get_num_threads()
    return {
        "command": f"python -m {command}",
        "date": f"{datetime.datetime.now(datetime.UTC):%Y-%m-%d}",
        "commit": commit,
        "machine": f"{os.cpu_count()} cores of {_processor()}, {threads} threads",
        "versions": ", ".join([f"Python {platform.python_version()}", *versions]),
    }
