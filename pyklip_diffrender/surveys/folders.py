"""Folders of finished jobs: there whole or not at all, whoever is killed when."""

from __future__ import annotations

import json
import os
import secrets
import shutil
import socket
import time
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.surveys.jobs import Job

__all__ = [
    "RECORD",
    "clean",
    "finished",
    "prepare",
    "publish",
    "read_record",
    "staging",
    "write_record",
]

RECORD = "job.json"

Record = dict[str, Any]

_OLD = 7 * 86400.0
"""Seconds after which what another machine left unfinished is taken for abandoned."""


def prepare(output: Path) -> Path:
    """Make the folder of the jobs, and see that it can be written to.

    Raises
    ------
    IncompatibleSetupError
        If it cannot be.
    """
    jobs = output / "jobs"
    try:
        jobs.mkdir(parents=True, exist_ok=True)
        probe = staging(jobs, "probe")
        (probe / RECORD).write_bytes(bytes(4096))
        shutil.rmtree(probe)
    except OSError as error:
        raise IncompatibleSetupError(
            f"output: got {output}, expected a folder that can be written to ({error.strerror}). "
            "Choose another folder, or make room"
        ) from error
    return jobs


def staging(jobs: Path, key: str) -> Path:
    """Make a folder for the products of a running job, which `publish` renames."""
    path = jobs / f".{key}-{os.getpid()}-{secrets.token_hex(4)}@{socket.gethostname()}"
    path.mkdir()
    return path


def publish(folder: Path, final: Path) -> None:
    """Rename the folder of a complete job.

    A finished job that somebody else has published meanwhile stays: it has the same content. A
    failed or damaged one is replaced.
    """
    while True:
        try:
            os.rename(folder, final)
            return
        except OSError:
            if not final.exists():
                raise
        if finished(final):
            shutil.rmtree(folder)
            return
        # Renamed first: half of a folder must never have its name.
        old = folder.with_name(f"{folder.name}.old")
        try:
            os.rename(final, old)
        except FileNotFoundError:
            continue  # Somebody else was faster.
        shutil.rmtree(old, ignore_errors=True)


def write_record(folder: Path, job: Job, record: Mapping[str, Any]) -> Record:
    """Write what is known of a job next to its products, which it lists with their sizes."""
    products = {
        path.relative_to(folder).as_posix(): path.stat().st_size
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name != RECORD
    }
    about = asdict(job)
    # JSON has no infinity.
    about["options"]["settings"] = {k: repr(v) for k, v in job.options.settings.items()}
    whole = {**record, "job": about, "products": products}
    text = json.dumps(whole, indent=2, allow_nan=False) + "\n"
    (folder / RECORD).write_text(text, encoding="utf-8")
    read: Record = json.loads(text)
    return read


def read_record(final: Path) -> Record | None:
    """Record of a published job; None if there is none, or not all of its products."""
    try:
        record = json.loads((final / RECORD).read_text(encoding="utf-8"))
        sizes = {name: (final / name).stat().st_size for name in record["products"]}
        whole = sizes == record["products"] and record["job"]["key"] == final.name
        return record if whole and record["status"] in ("finished", "failed") else None
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return None


def finished(final: Path) -> bool:
    """Whether a job is published, complete and did not fail."""
    record = read_record(final)
    return record is not None and record["status"] == "finished"


def clean(jobs: Path) -> None:
    """Remove what processes that are no more have left unfinished."""
    for path in jobs.glob(".*@*"):
        owner, host = path.name.split("@", 1)
        try:
            process = int(owner.split("-")[1])
            same = host.removesuffix(".old") == socket.gethostname()
            abandoned = time.time() - path.stat().st_mtime > _OLD
        except (IndexError, ValueError, OSError):
            continue
        if abandoned or (same and not _runs(process)):
            shutil.rmtree(path, ignore_errors=True)


def _runs(process: int) -> bool:
    """Whether a process of this machine runs, or may run."""
    if os.name != "posix":
        return True
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        pass
    return True
