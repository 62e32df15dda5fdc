"""Folders of finished jobs: there whole or not at all, whoever is killed when."""

from __future__ import annotations

import hashlib
import json
import logging
import os
import secrets
import shutil
import socket
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import asdict
from functools import cache
from pathlib import Path
from typing import Any

from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.surveys.jobs import Job

__all__ = [
    "RECORD",
    "clean",
    "encodable",
    "finished",
    "prepare",
    "publish",
    "read_record",
    "rename_to_jobs",
    "staging",
    "write_record",
]

RECORD = "job.json"

_log = logging.getLogger(__name__)

Record = dict[str, Any]


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
    path = jobs / f".{key}-{os.getpid()}-{secrets.token_hex(4)}@{_place()}"
    path.mkdir()
    return path


@cache
def _place() -> str:
    """Where the numbers of processes mean what they mean for this process.

    Containers may share the name of a host and count their processes apart.
    """
    facts = [socket.gethostname()]
    with suppress(OSError):
        facts.append(Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii"))
        facts.append(str(os.stat("/proc/self/ns/pid").st_ino))
    return hashlib.sha256("\n".join(facts).encode()).hexdigest()[:16]


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
    whole = encodable({**record, "job": about, "products": products})
    text = json.dumps(whole, indent=2, allow_nan=False) + "\n"
    (folder / RECORD).write_text(text, encoding="utf-8")
    read: Record = json.loads(text)
    return read


def encodable(value: Any) -> Any:
    """Make the text in nested values such that UTF-8 can encode it.

    Names of files, and messages that quote them, may have bytes of another encoding, which Python
    keeps as surrogates and no table takes.
    """
    if isinstance(value, str):
        return value.encode("utf-8", "backslashreplace").decode("utf-8")
    if isinstance(value, Mapping):
        return {encodable(key): encodable(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [encodable(each) for each in value]
    return value


def read_record(final: Path) -> Record | None:
    """Record of a published job; None if there is none, or not all of its products."""
    try:
        record = json.loads((final / RECORD).read_text(encoding="utf-8"))
        sizes = {name: (final / name).stat().st_size for name in record["products"]}
        whole = sizes == record["products"]
        whole &= record["job"]["key"].startswith(final.name.rpartition("_")[2])
        return record if whole and record["status"] in ("finished", "failed") else None
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return None


def rename_to_jobs(jobs: Path, todo: Iterable[Job]) -> None:
    """Rename folders of jobs whose sequences have another name in the configuration by now."""
    names = {job.folder.rpartition("_")[2]: job.folder for job in todo}
    for path in jobs.iterdir():
        name = names.get(path.name.rpartition("_")[2], path.name)
        if name != path.name and not (jobs / name).exists():
            # Somebody else may be faster.
            with suppress(FileNotFoundError):
                os.rename(path, jobs / name)


def finished(final: Path) -> bool:
    """Whether a job is published, complete and did not fail."""
    record = read_record(final)
    return record is not None and record["status"] == "finished"


def clean(jobs: Path) -> None:
    """Remove what processes that are no more have left unfinished.

    Only processes of this machine can be asked for. What others have left stays: their jobs may
    run, and clocks may differ.
    """
    elsewhere = 0
    for path in jobs.glob(".*@*"):
        owner, place = path.name.split("@", 1)
        try:
            process = int(owner.split("-")[1])
        except (IndexError, ValueError):
            continue
        if place.removesuffix(".old") != _place():
            elsewhere += 1
        elif not _runs(process):
            shutil.rmtree(path, ignore_errors=True)
    if elsewhere:
        _log.info(
            "%d unfinished jobs in %s are of other machines, or of before a restart; if nothing "
            "else works there, their folders (.*@*) can be removed", elsewhere, jobs,
        )  # fmt: skip


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
