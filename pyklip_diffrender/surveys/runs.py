"""How a job is run, so that it ends in a folder whatever happens."""

from __future__ import annotations

import os
import shutil
import socket
import sys
import time
import traceback
from collections.abc import Callable
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from pyklip_diffrender._version import __version__
from pyklip_diffrender.errors import CorruptFileError, IncompatibleSetupError
from pyklip_diffrender.io.files import sha256
from pyklip_diffrender.surveys.folders import (
    Record,
    encodable,
    publish,
    read_record,
    staging,
    write_record,
)
from pyklip_diffrender.surveys.jobs import Job

__all__ = ["Work", "failure", "run_job"]

Work = Callable[[Job, Path], dict[str, Any]]
"""Computes a job, writes its products to a folder, and returns plain values for the record."""


def run_job(job: Job, jobs: Path, work: Work) -> Record:
    """Run a job and publish its folder; returns its record.

    A job that is there already is not run again. No error of the job goes through: its record
    says that it failed, and why.
    """
    final = jobs / job.folder
    known = read_record(final)
    if known is not None and known["status"] == "finished":
        return known
    began = time.perf_counter()
    _reset_peak()
    folder = None
    try:
        _require_same_world(job, jobs)
        folder = staging(jobs, job.key)
        result = work(job, folder)
        record = {**_circumstances(began), "status": "finished", "result": result}
        whole = write_record(folder, job, record)
        publish(folder, final)
    except Exception as error:
        if folder is not None:
            shutil.rmtree(folder, ignore_errors=True)
        return failure(job, jobs, error, **_circumstances(began))
    return whole


def failure(job: Job, jobs: Path, error: BaseException, **circumstances: Any) -> Record:
    """Publish the record of a failed job, as far as the disk takes it, and return it."""
    record: Record = {
        **circumstances,
        "status": "failed",
        "message": encodable(f"{type(error).__name__}: {error}".removesuffix(": ")),
        "traceback": encodable("".join(traceback.format_exception(error))),
        "result": {},
    }
    folder = None
    try:
        folder = staging(jobs, job.key)
        record = write_record(folder, job, record)
        publish(folder, jobs / job.folder)
    except OSError:
        if folder is not None:
            shutil.rmtree(folder, ignore_errors=True)
    return record


def _require_same_world(job: Job, jobs: Path) -> None:
    """Refuse to work where version, folders or files are not those of the plan."""
    host = socket.gethostname()
    if job.version != __version__:
        raise IncompatibleSetupError(
            f"the worker on {host} has pyklip_diffrender {__version__}, expected {job.version} as "
            "where the survey was started. Install the same version on both"
        )
    if not jobs.is_dir():
        raise CorruptFileError(
            f"{jobs}: the worker on {host} does not see this folder. Put the output on a disk that "
            "all workers share"
        )
    for name, digest in job.inputs.items():
        if not Path(name).is_file():
            raise CorruptFileError(
                f"{name}: the worker on {host} does not see this file. Put the data on a disk that "
                "all workers share, under the same path"
            )
        if sha256(name) != digest:
            raise CorruptFileError(
                f"{name}: the content on {host} is not that of the plan. Start the survey again if "
                "the file was changed"
            )


def _circumstances(began: float) -> dict[str, Any]:
    return {
        "seconds": round(time.perf_counter() - began, 3),
        "peak_memory_bytes": _peak(),
        "ended": datetime.now(UTC).isoformat(timespec="seconds"),
        "host": socket.gethostname(),
        "process": os.getpid(),
    }


def _reset_peak() -> None:
    """Make Linux forget the peak memory of the jobs that this process ran before."""
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def _peak() -> int | None:
    """Peak resident memory of this process, bytes; since `_reset_peak` on Linux."""
    with suppress(OSError):
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith("VmHWM:"):
                return 1024 * int(line.split()[1])
    try:
        import resource
    except ImportError:  # Windows.
        return None
    largest = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    # macOS counts bytes.
    return largest if sys.platform == "darwin" else 1024 * largest
