"""The jobs of a survey, and their folders, which are there whole or not at all."""

from __future__ import annotations

import hashlib
import json
import logging
import os
import secrets
import shutil
import socket
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

from pyklip_diffrender._version import __version__
from pyklip_diffrender.errors import CorruptFileError, DiffrenderError, IncompatibleSetupError
from pyklip_diffrender.io.files import fits_files, read_text, sha256
from pyklip_diffrender.io.headers import file_name
from pyklip_diffrender.scene.associations import listed_files
from pyklip_diffrender.scene.sequence import epochs_of_files
from pyklip_diffrender.surveys.config import Config, Options, SequenceConfig
from pyklip_diffrender.wavefront.opd import opd_for
from pyklip_diffrender.wavefront.opd_map import FLAT


@dataclass(frozen=True)
class Injection:
    """A planet to add to the frames."""

    contrast: float
    separation: float  # arcsec
    angle: float  # position angle, degrees east of north


@dataclass(frozen=True)
class Job:
    """One reduction."""

    # Hash of the package's version, the content of the input files, and the options.
    key: str
    # Name of the sequence, by default target and filter, with the date of an epoch among several.
    name: str
    # Frames.
    files: tuple[str, ...]
    # OPD map.
    opd: str
    # SHA-256 of every file that is read.
    inputs: Mapping[str, str]
    target: str | None = None
    filter: str | None = None
    # Date in the epoch, of a sequence that has several.
    epoch: str | None = None
    options: Options = field(default_factory=Options)
    injection: Injection | None = None
    # Key of the job whose fit an injection starts from.
    base: str | None = None
    # Version of the package.
    version: str = __version__

    @property
    def folder(self) -> str:
        """Name of the folder with its products: what the job is, and the beginning of the key."""
        return folder_of(str(self), self.key)

    @property
    def base_folder(self) -> str | None:
        """Folder of the job whose fit an injection starts from; None if it starts from none."""
        return None if self.base is None else folder_of(self.name, self.base)

    def __str__(self) -> str:
        planet = self.injection
        if planet is None:
            return self.name
        return (
            f"{self.name}, planet of {planet.contrast:.3g} at {planet.separation:g} arcsec, "
            f"{planet.angle:g} deg"
        )


def jobs_of(config: Config) -> list[Job]:
    """Return the jobs of a survey; every injection comes after the job that it starts from.

    Raises IncompatibleSetupError with everything that is wrong with the inputs, a line for each
    mistake.
    """
    jobs: dict[str, Job] = {}
    problems = []
    # Sequences may share files.
    digest = cache(sha256)
    for sequence in config.sequences:
        try:
            planned = _jobs(sequence, digest, config.memory_limit)
        except (DiffrenderError, OSError) as error:
            problems.append(f"{sequence.name}: {error}")
            continue
        if not sequence.is_named and {job.name for job in planned} & {
            j.name for j in jobs.values()
        }:
            # Another sequence of the same target and filter.
            planned = [replace(job, name=f"{job.name}, {sequence.name}") for job in planned]
        for job in planned:
            if job.key in jobs:
                problems.append(f"{job}: got the same inputs and options as {jobs[job.key]}")
            jobs[job.key] = job
    if problems:
        raise IncompatibleSetupError("\n  ".join(["survey: nothing was started:", *problems]))
    return list(jobs.values())


def _jobs(
    sequence: SequenceConfig, digest: Callable[[Path], str], memory_limit: float | None
) -> list[Job]:
    files = _files(sequence.files)
    planets = sequence.injections
    jobs = []
    for opd, epoch, name, filter in _epochs(sequence, files):
        plain = _job(replace(sequence, name=name), files, opd, epoch, digest, memory_limit)
        plain = replace(plain, filter=filter)
        injected = [
            _with_planet(plain, Injection(contrast, separation, angle))
            for contrast in planets.contrasts
            for separation in planets.separations
            for angle in planets.angles
        ]
        jobs += [plain, *injected]
    return jobs


def _epochs(
    sequence: SequenceConfig, files: list[Path]
) -> list[tuple[Path, str | None, str, str | None]]:
    """OPD map, date, name and filter of every epoch; without a date if there is just one."""
    of_folder = str(sequence.opd) != FLAT and sequence.opd.is_dir()
    try:
        epochs = epochs_of_files(files, target=sequence.target, filter=sequence.filter)
    except DiffrenderError:
        if of_folder:
            raise
        # The job will fail, and its row says why.
        return [(sequence.opd, None, sequence.name, sequence.filter)]
    opd = sequence.opd
    return [
        (
            # As `reduce` chooses it: the one nearest to the target's frames.
            opd / opd_for(opd, each.date).name if of_folder else opd,
            each.date.isot if len(epochs) > 1 and each.date is not None else None,
            sequence.name if sequence.is_named else f"{each.target} {each.filter}",
            each.filter,
        )
        for each in epochs
    ]


def _job(
    sequence: SequenceConfig,
    files: list[Path],
    opd: Path,
    epoch: str | None,
    digest: Callable[[Path], str],
    memory_limit: float | None,
) -> Job:
    options = sequence.options
    pattern = str(options.pattern)
    known = [] if pattern in ("auto", "references", "off") else _files((Path(pattern),))
    maps = [] if str(opd) == FLAT else [opd]
    # Members of associations are inputs as well.
    members = [each.path for each in listed_files(files) if not each.reason]
    frames = dict.fromkeys((*files, *members))
    inputs = {str(path): digest(path) for path in (*frames, *maps, *known)}
    facts: dict[str, Any] = {
        **vars(options),
        "version": __version__,
        "frames": sorted(inputs[str(path)] for path in frames),
        "opd": inputs.get(str(opd), FLAT),
        "target": sequence.target,
        "filter": sequence.filter,
        "pattern": (inputs.get(pattern) or sorted(inputs[str(path)] for path in known) or pattern),
        "epoch": epoch,
    }
    # Frames of reference stars for which there is no memory are left out.
    if options.references == "joint" and not options.disk:
        facts["memory_limit"] = memory_limit
    return Job(
        hash_of(facts),
        sequence.name if epoch is None else f"{sequence.name} {epoch[:10]}",
        tuple(map(str, files)),
        str(opd),
        inputs,
        sequence.target,
        sequence.filter,
        epoch,
        options,
    )


def _with_planet(base: Job, planet: Injection) -> Job:
    key = hash_of({"base": base.key, "planet": [planet.contrast, planet.separation, planet.angle]})
    return replace(base, key=key, injection=planet, base=base.key)


def folder_of(label: str, key: str) -> str:
    """Name of a folder: what is in it, and the beginning of its key."""
    return f"{file_name(label)}_{key[:12]}"


def hash_of(facts: Mapping[str, Any]) -> str:
    """SHA-256 of plain values."""
    return hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()


def _files(paths: tuple[Path, ...]) -> list[Path]:
    """Paths of the files, and of the files in folders."""
    files: list[Path] = []
    for path in paths:
        inside = fits_files(path) if path.is_dir() else [path]
        if not inside:
            raise CorruptFileError(f"{path}: the folder has no FITS files")
        files += inside
    return files


# Folders of finished jobs: there whole or not at all, whoever is killed when.

RECORD = "job.json"

_log = logging.getLogger(__name__)

Record = dict[str, Any]


def folder_for_jobs(output: Path) -> Path:
    """Make the folder of the jobs; raises IncompatibleSetupError if it cannot be written to."""
    jobs = output / "jobs"
    try:
        jobs.mkdir(parents=True, exist_ok=True)
        with staged(jobs, "probe") as probe:
            (probe / RECORD).write_bytes(bytes(4096))
    except OSError as error:
        raise IncompatibleSetupError(
            f"output: got {output}, expected a folder that can be written to ({error.strerror}). "
            "Choose another folder, or make room"
        ) from error
    return jobs


@contextmanager
def staged(jobs: Path, key: str) -> Iterator[Path]:
    """New folder for the products of a running job, removed unless `publish` has renamed it."""
    folder = jobs / f".{key}-{os.getpid()}-{secrets.token_hex(4)}@{_place()}"
    folder.mkdir()
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@cache
def _place() -> str:
    """Where the numbers of processes mean what they mean for this process."""
    # Containers may share the name of a host and count their processes apart.
    facts = [socket.gethostname()]
    with suppress(OSError):
        facts.append(Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii"))
        facts.append(str(os.stat("/proc/self/ns/pid").st_ino))
    return hashlib.sha256("\n".join(facts).encode()).hexdigest()[:16]


def publish(folder: Path, final: Path) -> None:
    """Rename the folder of a complete job; a failed or damaged one of that name is replaced."""
    while True:
        try:
            os.rename(folder, final)
            return
        except OSError:
            if not final.exists():
                raise
        # Somebody else has published the job meanwhile: the same key stands for the same content.
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
    return json.loads(text)


def encodable(value: Any) -> Any:
    """Make the text in nested values such that UTF-8 can encode it."""
    # Names of files, and messages that quote them, may have bytes of another encoding, which Python
    # keeps as surrogates and no table takes.
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
        record = json.loads(read_text(final / RECORD))
        # A job that was published is whole, but somebody may have removed or cut off files since.
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
    """Remove what processes of this machine that are no more have left unfinished."""
    # Only processes of this machine can be asked for. What others have left stays: their jobs may
    # run, and clocks may differ.
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
