"""Surveys under fire: processes killed at random, disks that are full, files that are damaged.

Every scenario runs a survey of cheap jobs as real processes, breaks something, and requires that
no folder is half a product, that finished jobs are kept, and that there is a message. The tests of
surveys run the scenarios. Scenarios that need a mounted disk raise MountingRefused where mounting
is not allowed.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import random
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from benchmarks import mutations
from pyklip_diffrender.errors import DiffrenderError
from pyklip_diffrender.surveys import driver, jobs
from pyklip_diffrender.surveys.jobs import Job

ROOT = Path(__file__).resolve().parents[1]

JOBS = 8
PARTS = 5
DEADLINE = 300.0
"""Seconds after which a survey is taken for hung."""


# -- cheap jobs ------------------------------------------------------------------------------------


class MountingRefused(PermissionError):
    """This process may not mount disks."""


def part(key: str, k: int) -> bytes:
    """What a job writes to one of its files, 96 kB that follow from its key."""
    return hashlib.sha256(f"{key} {k}".encode()).digest() * 3000


def slow(job: Job, folder: Path) -> dict[str, Any]:
    """Write a few files with pauses."""
    for k in range(PARTS):
        (folder / f"part{k}.bin").write_bytes(part(job.key, k))
        time.sleep(0.06)
    return {"target": job.name}


def greedy(job: Job, folder: Path) -> dict[str, Any]:
    """Ask for more memory than the process may have, in one of the jobs."""
    if job.name.startswith("star3"):
        before = resource.getrlimit(resource.RLIMIT_AS)
        size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (size + 2**27, before[1]))
        try:
            bytearray(2**30)
        finally:
            resource.setrlimit(resource.RLIMIT_AS, before)
    return slow(job, folder)


def hog(job: Job, folder: Path) -> dict[str, Any]:
    """Fill the memory until the limit of the worker kills it, in one of the jobs."""
    if job.name.startswith("star3"):
        kept = []
        while True:
            kept.append(bytearray(os.urandom(2**20)) * 16)
            time.sleep(0.01)
    return slow(job, folder)


WORK: dict[str, Callable[[Job, Path], dict[str, Any]]] = {
    each.__name__: each for each in (slow, greedy, hog)
}


def run_client(config: str, output: str, work: str, scheduler: str | None) -> int:
    """Run a survey as the command line does, without the page, whose imports take longer."""
    driver.page = lambda *_: "no page"  # type: ignore[assignment]
    try:
        driver.run_survey(config, output, WORK[work], scheduler)
    except DiffrenderError as error:
        print(error, file=sys.stderr)
        return 1
    return 0


# -- tools -----------------------------------------------------------------------------------------


def require(holds: bool, message: object) -> None:
    """Stop with an error that optimised Python does not skip."""
    if not holds:
        raise AssertionError(message)


class Trial:
    """Inputs, an output folder, and surveys as processes."""

    def __init__(self, folder: Path, workers: int = 2, memory: str = "2 GB") -> None:
        self.data, self.output = folder / "data", folder / "out"
        self.config = folder / "survey.toml"
        self.data.mkdir(parents=True)
        (self.data / "opd.fits").write_bytes(b"a map")
        lines = [f'workers = {workers}\nmemory_limit = "{memory}"']
        for k in range(JOBS):
            (self.data / f"star{k}.fits").write_bytes(bytes([k]) * 100)
            lines.append(f'[[sequence]]\nfiles = "data/star{k}.fits"\nopd = "data/opd.fits"')
        self.config.write_text("\n".join(lines), encoding="utf-8")

    def start(
        self, work: str = "slow", scheduler: str | None = None, output: Path | None = None
    ) -> subprocess.Popen[str]:
        """A survey as a process."""
        arguments = [str(self.config), str(output or self.output), "--work", work]
        arguments += ["--scheduler", scheduler] if scheduler else []
        return subprocess.Popen(
            [sys.executable, "-m", "benchmarks.faults", "--client", *arguments],
            cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip

    def without_workers(self) -> None:
        """Let the surveys that follow run their jobs in their own process."""
        lines = self.config.read_text(encoding="utf-8").splitlines()
        self.config.write_text("\n".join(["workers = 0", *lines[1:]]), encoding="utf-8")

    def run(self, **how: Any) -> tuple[int, str]:
        """A survey to its end: exit status and messages."""
        with self.start(**how) as process:
            _, said = process.communicate(timeout=DEADLINE)
            return process.returncode, said

    def staged(self) -> list[int]:
        """Processes of the folders that are not published; those killed have left theirs."""
        names = [path.name for path in (self.output / "jobs").glob(".*-*-*@*")]
        return [
            int(name.split("-")[1]) for name in names if not name.startswith((".probe", ".tables"))
        ]

    def finished(self) -> dict[str, int]:
        """Finished jobs by key, each with the time of its record."""
        return verified(self.output)[0]

    def wait_for_work(self, process: subprocess.Popen[str]) -> None:
        """Wait until a job is under way."""
        end = time.monotonic() + DEADLINE
        while not self.staged():
            require(process.poll() is None, "the survey ended before a job was seen")
            require(time.monotonic() < end, "no job ever started")
            time.sleep(0.02)


def verified(output: Path) -> tuple[dict[str, int], int]:
    """Finished jobs with the times of their records, and the number of failed ones.

    Raises
    ------
    AssertionError
        If a published folder is not whole.
    """
    finished, failed = {}, 0
    for path in (output / "jobs").iterdir():
        if path.name.startswith("."):
            continue
        record = jobs.read_record(path)
        require(record is not None, f"{path}: half a product")
        if record is not None and record["status"] == "failed":
            require([each.name for each in path.iterdir()] == ["job.json"], path)
            require(bool(record["message"] and record["traceback"]), record)
            failed += 1
            continue
        for k in range(PARTS):
            content = (path / f"part{k}.bin").read_bytes()
            require(content == part(record["job"]["key"], k), f"{path}: wrong content")
        finished[path.name] = (path / jobs.RECORD).stat().st_mtime_ns
    return finished, failed


def leftovers(output: Path) -> list[str]:
    """What unfinished jobs and tables have left."""
    return [path.name for path in output.rglob(".*")]


def runs(process: int) -> bool:
    """Whether a process runs; one that waits to be collected does not."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False


@contextmanager
def disk(path: Path, size: str) -> Iterator[None]:
    """A small disk of its own.

    Raises
    ------
    MountingRefused
        Where mounting is not allowed.
    """
    path.mkdir(parents=True)
    command = ["mount", "-t", "tmpfs", "-o", f"size={size}", "none", str(path)]
    if subprocess.run(command, capture_output=True, check=False).returncode:
        raise MountingRefused("mounting is not allowed")
    try:
        yield
    finally:
        subprocess.run(["umount", "-l", str(path)], check=True)


# -- scenarios -------------------------------------------------------------------------------------


def workers_killed(folder: Path, seeds: int, _: int) -> str:
    """SIGKILL of workers at random points: the survey goes on and finishes all jobs."""
    kills = 0
    for seed in range(seeds):
        rng, trial = random.Random(seed), Trial(folder / str(seed))
        with trial.start() as process:
            trial.wait_for_work(process)
            for _ in range(2):
                time.sleep(rng.uniform(0, 0.6))
                busy = list(filter(runs, trial.staged()))
                if busy:
                    os.kill(rng.choice(busy), signal.SIGKILL)
                    kills += 1
            _, said = process.communicate(timeout=DEADLINE)
        require(process.returncode == 0, said)
        finished, failed = verified(trial.output)
        require((len(finished), failed) == (JOBS, 0), (seed, finished, failed, said))
        require(leftovers(trial.output) == [], leftovers(trial.output))
    return f"{seeds} surveys, {kills} workers killed, all {seeds * JOBS} jobs finished"


def client_killed(folder: Path, seeds: int, _: int) -> str:
    """SIGKILL of the client at a random point: a second run does only what is missing."""
    kept = orphans = 0
    for seed in range(seeds):
        rng, trial = random.Random(1000 + seed), Trial(folder / str(seed))
        with trial.start() as process:
            trial.wait_for_work(process)
            time.sleep(rng.uniform(0, 1.5))
            busy = trial.staged()
            process.kill()
        end = time.monotonic() + 30
        while any(map(runs, busy)) and time.monotonic() < end:
            time.sleep(0.05)
        require(not any(map(runs, busy)), "workers outlive their client")
        before = trial.finished()
        orphans += len(trial.staged())
        trial.without_workers()  # Which takes less time.
        code, said = trial.run()
        require(code == 0, said)
        after, failed = verified(trial.output)
        require((len(after), failed) == (JOBS, 0), said)
        require(before.items() <= after.items(), "a finished job was done again")
        require(leftovers(trial.output) == [], leftovers(trial.output))
        kept += len(before)
    return (
        f"{seeds} clients killed, {kept} finished jobs kept, {orphans} unfinished folders removed, "
        f"all {seeds * JOBS} jobs finished by the second run"
    )


def two_surveys(folder: Path, *_: int) -> str:
    """Two surveys at a time in one folder."""
    trial = Trial(folder)
    with trial.start() as one, trial.start() as two:
        said = [each.communicate(timeout=DEADLINE)[1] for each in (one, two)]
    require([one.returncode, two.returncode] == [0, 0], said)
    require(len(trial.finished()) == JOBS, said)
    require(leftovers(trial.output) == [], leftovers(trial.output))
    return f"2 surveys in one folder, {JOBS} jobs"


def read_only(folder: Path, *_: int) -> str:
    """An output folder that cannot be written, from the start and after a first survey."""
    trial = Trial(folder, workers=0)
    mounted = folder / "mounted"
    with disk(mounted, "20m"):
        code, said = trial.run(output=mounted / "out")
        require(code == 0, said)
        before = verified(mounted / "out")[0]
        subprocess.run(["mount", "-o", "remount,ro", str(mounted)], check=True)
        for output in (mounted / "out", mounted / "new"):
            code, said = trial.run(output=output)
            require(code == 1 and "can be written to (Read-only file system)" in said, said)
        require(verified(mounted / "out")[0] == before, "finished jobs were changed")
    return f"2 read-only folders refused, {len(before)} finished jobs kept"


def full_disk(folder: Path, *_: int) -> str:
    """A disk for three of eight jobs; the others fail, and finish when there is room."""
    trial = Trial(folder, workers=0)
    mounted = folder / "mounted"
    with disk(mounted, "2m"):
        output = mounted / "out"
        code, said = trial.run(output=output)
        require("No space left on device" in said, (code, said))
        before, failed = verified(output)
        require(2 <= len(before) < JOBS, (before, failed))
        require(leftovers(output) == [], leftovers(output))
        subprocess.run(["mount", "-o", "remount,size=20m", str(mounted)], check=True)
        code, said = trial.run(output=output)
        require(code == 0, said)
        after = verified(output)[0]
        require(len(after) == JOBS and before.items() <= after.items(), "finished jobs were lost")
    return f"full after {len(before)} of {JOBS} jobs, which were kept; all finished with room"


def file_limit(folder: Path, *_: int) -> str:
    """Files may have 60 kB, less than a product: every job fails, and says why."""
    trial = Trial(folder, workers=0)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (60_000, before[1]))
    try:
        code, said = trial.run()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    require(code == 0 and said.count("File too large") == JOBS, (code, said))
    require(verified(trial.output) == ({}, JOBS), "not all jobs failed")
    require(leftovers(trial.output) == [], leftovers(trial.output))
    require(trial.run()[0] == 0 and len(trial.finished()) == JOBS, "not all jobs finished")
    return f"{JOBS} jobs failed with a file limit, all finished without"


def out_of_memory(folder: Path, *_: int) -> str:
    """One job that asks for too much, and one that takes until its worker is killed."""
    said = []
    for work, memory, word in (
        ("greedy", "2 GB", "MemoryError"),
        ("hog", "400 MB", "was killed"),
    ):
        # Where there is one worker only, it has to come back each time.
        trial = Trial(folder / work, workers=1, memory=memory)
        code, message = trial.run(work=work)
        require(code == 0 and word in message, message)
        finished, failed = verified(trial.output)
        require((len(finished), failed) == (JOBS - 1, 1), (finished, failed))
        require(leftovers(trial.output) == [], leftovers(trial.output))
        said.append(word)
    return f"1 job failed ({said[0]}), 1 (its worker {said[1]}), the other {2 * JOBS - 2} finished"


def _address_in(log: Path) -> str | None:
    """The scheduler's address, or None until dask has written the file that it creates empty."""
    try:
        return str(json.loads(log.read_text())["address"])
    except (FileNotFoundError, json.JSONDecodeError):
        return None


@contextmanager
def scheduler(folder: Path) -> Iterator[tuple[str, subprocess.Popen[bytes]]]:
    """A scheduler as a process; yields its address."""
    log = folder / "scheduler.json"
    process = background(
        sys.executable, "-m", "distributed.cli.dask_scheduler", "--port", "0", "--no-dashboard",
        "--scheduler-file", str(log),
    )  # fmt: skip
    try:
        end = time.monotonic() + 60
        while (address := _address_in(log)) is None:
            require(time.monotonic() < end, "the scheduler did not start within a minute")
            time.sleep(0.05)
        yield address, process
    finally:
        process.terminate()
        process.wait()


def background(*command: str) -> subprocess.Popen[bytes]:
    """Start a process whose output nobody needs."""
    return subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


WORKER = f"{sys.executable} -m distributed.cli.dask_worker --nthreads 1 --no-dashboard"


def scheduler_killed(folder: Path, *_: int) -> str:
    """SIGKILL of the scheduler: the survey ends with a message, and a second one goes on."""
    trial = Trial(folder)
    with scheduler(folder) as (address, process):
        worker = background(*WORKER.split(), address)
        try:
            with trial.start(scheduler=address) as client:
                trial.wait_for_work(client)
                time.sleep(0.5)
                process.kill()
                _, said = client.communicate(timeout=DEADLINE)
        finally:
            worker.kill()
            worker.wait()
    require(client.returncode == 1 and "connection to the scheduler was lost" in said, said)
    before = trial.finished()
    code, said = trial.run()
    require(code == 0, said)
    after = trial.finished()
    require(len(after) == JOBS and before.items() <= after.items(), "finished jobs were lost")
    require(leftovers(trial.output) == [], leftovers(trial.output))
    return f"1 scheduler killed after {len(before)} of {JOBS} jobs, all finished by the second run"


def blind_worker(folder: Path, *_: int) -> str:
    """A worker elsewhere that sees the output, but not the data; then one that sees neither."""
    if subprocess.run(["unshare", "-m", "true"], capture_output=True, check=False).returncode:
        raise MountingRefused("mounting is not allowed")
    trial = Trial(folder)
    (trial.output / "jobs").mkdir(parents=True)
    words = ["does not see this file", "does not see this folder"]
    with scheduler(folder) as (address, _process):
        for hidden, word in zip((trial.data, trial.output), words, strict=True):
            command = f"mount -t tmpfs none {hidden} && exec {WORKER} {address}"
            worker = background("unshare", "-m", "sh", "-c", command)
            try:
                code, said = trial.run(scheduler=address)
            finally:
                worker.terminate()
                worker.wait()
            require(code == 0 and said.count(word) == JOBS, (code, said))
            require(verified(trial.output) == ({}, JOBS), "not all jobs failed")
    require(leftovers(trial.output) == [], leftovers(trial.output))
    return f"2 blind workers, {2 * JOBS} rows that say: {', '.join(words)}"


def damaged_inputs(folder: Path, _: int, count: int) -> str:
    """Mutated frames, maps, fits, configurations and records."""
    return mutations.run(folder, count)


def main() -> int:
    """Run the survey of a scenario, in a process that the scenario may kill."""
    parser = argparse.ArgumentParser(description="A survey of a scenario")
    parser.add_argument("--client", nargs=2, required=True)
    parser.add_argument("--work", choices=list(WORK), default="slow")
    parser.add_argument("--scheduler")
    options = parser.parse_args()
    return run_client(*options.client, options.work, options.scheduler)


if __name__ == "__main__":
    sys.exit(main())
