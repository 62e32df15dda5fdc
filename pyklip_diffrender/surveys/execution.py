"""Jobs run in this process, or by the workers of dask.distributed."""

from __future__ import annotations

import hashlib
import logging
import time
from collections import defaultdict, deque
from collections.abc import Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from pyklip_diffrender.errors import IncompatibleSetupError, RefinementError
from pyklip_diffrender.surveys.folders import Record, finished, read_record
from pyklip_diffrender.surveys.jobs import Job
from pyklip_diffrender.surveys.runs import Work, failure, run_job

__all__ = ["in_this_process", "with_dask"]

_ENVIRONMENT = "distributed.nanny.pre-spawn-environ"
_THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")

_CONNECT = 30.0
"""Seconds to wait for a scheduler."""

_PULSE = 0.1
"""Seconds between looks at what has finished."""

_ALONE = 600.0
"""Seconds without any worker on this machine after which the survey gives up."""

_PATIENCE = 20
"""Half seconds to wait for a folder that another machine has made: network disks lag."""


class _Order:
    """Which jobs can start: injections wait for the job whose fit they start from."""

    def __init__(self, todo: Sequence[Job], jobs: Path) -> None:
        self.jobs = jobs
        self.first: list[Job] = []
        self.later: dict[str, list[Job]] = defaultdict(list)
        coming = {job.key for job in todo}
        for job in todo:
            if job.base in coming:
                self.later[str(job.base)].append(job)
            else:
                self.first.append(job)

    def after(self, job: Job, record: Record) -> tuple[list[Job], list[tuple[Job, Record]]]:
        """Jobs that can start now that one has ended, and those that failed with it."""
        waiting = self.later.pop(job.key, [])
        if record["status"] == "finished":
            return waiting, []
        error = RefinementError("the reduction without a planet failed, see there")
        return [], [(each, failure(each, self.jobs, error)) for each in waiting]


def in_this_process(todo: Sequence[Job], jobs: Path, work: Work) -> Iterator[tuple[Job, Record]]:
    """Run jobs one after the other; yields each with its record."""
    order = _Order(todo, jobs)
    queue = deque(order.first)
    while queue:
        job = queue.popleft()
        record = run_job(job, jobs, work)
        yield job, record
        ready, failed = order.after(job, record)
        queue.extendleft(reversed(ready))
        yield from failed


def with_dask(
    todo: Sequence[Job],
    jobs: Path,
    work: Work,
    *,
    scheduler: str | None = None,
    workers: int | None = None,
    memory_limit: str | None = None,
) -> Iterator[tuple[Job, Record]]:
    """Run jobs on a cluster, by default on this machine; yields each with its record.

    A job whose worker dies is given to another one, up to three times.

    Raises
    ------
    IncompatibleSetupError
        If dask.distributed is not installed, or no scheduler answers.
    RefinementError
        If the scheduler is lost. Jobs that are finished stay.
    """
    try:
        from dask import config
        from dask.distributed import Client, LocalCluster, as_completed
        from dask.system import CPU_COUNT
    except ImportError as error:
        raise IncompatibleSetupError(
            f"dask.distributed is needed for more than one process and is not installed ({error}): "
            'python -m pip install "dask[distributed]" pyarrow, or set workers = 0'
        ) from error
    order = _Order(todo, jobs)
    with ExitStack() as stack:
        cluster: Any = None
        address: Any = scheduler
        if scheduler is None:
            stack.enter_context(_without_messages("distributed"))
            # A worker that is not back after this time is given up, by default after 15 seconds.
            stack.enter_context(config.set({"distributed.deploy.lost-worker-timeout": "7 days"}))
            try:
                # Dask makes glibc give freed memory back at once, which slows fits down.
                with config.set({f"{_ENVIRONMENT}.MALLOC_TRIM_THRESHOLD_": None}):
                    cluster = LocalCluster(
                        n_workers=min(workers or CPU_COUNT, len(todo)),
                        threads_per_worker=1,
                        processes=True,
                        memory_limit=memory_limit or "auto",
                        # Any free port; None would ask for a certain one, and warn.
                        dashboard_address="127.0.0.1:0",
                        silence_logs=logging.CRITICAL,
                        env=dict.fromkeys(_THREADS, "1"),
                    )
            except RuntimeError as error:
                raise IncompatibleSetupError(
                    f"the worker processes cannot be started ({error}). A script that calls survey "
                    "needs `if __name__ == '__main__':`; workers = 0 does without processes"
                ) from error
            address = stack.enter_context(cluster)
        try:
            client = stack.enter_context(Client(address, timeout=_CONNECT))
        except (OSError, ValueError) as error:
            raise IncompatibleSetupError(
                f"scheduler: got {scheduler!r}, where none answers ({error}). Start one with `dask "
                "scheduler`, and give the address that it prints, such as tcp://host:8786"
            ) from error

        def submit(each: Job) -> Any:
            # Two surveys on one scheduler and one folder share their jobs.
            place = hashlib.sha256(str(jobs).encode()).hexdigest()[:8]
            return client.submit(run_job, each, jobs, work, key=f"survey-{place}-{each.key}")

        running = {submit(job): job for job in order.first}
        completed = as_completed(list(running), raise_errors=False)
        seen = time.monotonic()
        while running:
            for future in completed.next_batch(block=False):
                job = running.pop(future)
                record = _record_of(future, job, jobs)
                yield job, record
                ready, failed = order.after(job, record)
                for each in ready:
                    new = submit(each)
                    running[new] = each
                    completed.add(new)
                yield from failed
            time.sleep(_PULSE)
            # Those of a cluster elsewhere may wait in a queue for days.
            if scheduler is not None or cluster.scheduler.workers:
                seen = time.monotonic()
            elif time.monotonic() > seen + _ALONE:
                raise RefinementError(
                    "no worker process is left, and none can be started. Look at the memory of the "
                    "machine and start the survey again: finished jobs are kept"
                )


@contextmanager
def _without_messages(name: str) -> Iterator[None]:
    """Silence a library; the survey says itself what became of the job of a worker that died."""
    logger = logging.getLogger(name)
    before = logger.level
    logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        logger.setLevel(before)


def _record_of(future: Any, job: Job, jobs: Path, patience: int = _PATIENCE) -> Record:
    """Record of a job that dask has finished with."""
    final = jobs / job.folder
    known = read_record(final)
    if known is not None and known["status"] == "finished":
        # The truth is on the disk: what dask has may have died with its worker.
        return known
    try:
        record: Record = future.result()
    except CancelledError as error:
        raise RefinementError(
            "the connection to the scheduler was lost. Finished jobs are kept: start the survey "
            "again to go on"
        ) from error
    except Exception as error:
        # No error of a job gets here.
        if type(error).__name__ != "KilledWorker":
            return failure(job, jobs, error)
        killed = RefinementError(
            "every worker that took this job was killed. If they ran out of memory, raise "
            "memory_limit, with fewer workers where the machine has no more"
        )
        killed.__cause__ = error
        return failure(job, jobs, killed)
    if record["status"] == "finished" and not _appears(final, patience):
        lost = IncompatibleSetupError(
            f"the worker on {record['host']} wrote its products to another disk than {jobs}. Put "
            "the output on a disk that all workers share"
        )
        return failure(job, jobs, lost)
    return record


def _appears(final: Path, patience: int) -> bool:
    for _ in range(patience):
        if finished(final):
            return True
        time.sleep(0.5)
    return False
