"""A survey from its configuration to its tables: the work of its jobs, here or on a cluster."""

from __future__ import annotations

import hashlib
import logging
import math
import os
import socket
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import CancelledError
from contextlib import ExitStack, suppress
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

from astropy.table import Table
from tqdm import tqdm

from pyklip_diffrender._version import __version__
from pyklip_diffrender.detection import measured_planet, with_planets
from pyklip_diffrender.errors import CorruptFileError, IncompatibleSetupError, RefinementError
from pyklip_diffrender.io.files import sha256
from pyklip_diffrender.reduction import ReduceOptions
from pyklip_diffrender.reduction.pipeline import ReductionResult, prepare
from pyklip_diffrender.reduction.products import write_products
from pyklip_diffrender.reduction.summary import summarise
from pyklip_diffrender.refinement import FrameFit, Refinement, nircam_settings
from pyklip_diffrender.scene.objects import Planet
from pyklip_diffrender.scene.observation import Observation
from pyklip_diffrender.scene.sequence import ExposureSequence
from pyklip_diffrender.surveys.config import Config, read_config
from pyklip_diffrender.surveys.jobs import (
    Injection,
    Job,
    Record,
    clean,
    encodable,
    finished,
    folder_for_jobs,
    jobs_of,
    publish,
    read_record,
    rename_to_jobs,
    staged,
    write_record,
)
from pyklip_diffrender.surveys.results import StarSearch, page, row, search_stars, table_of

_log = logging.getLogger(__name__)


def survey(
    config: str | os.PathLike[str] | Mapping[str, Any],
    output: str | os.PathLike[str],
    scheduler: str | None = None,
    *,
    progress: bool = False,
) -> Table:
    """Reduce many sequences, with and without injected planets, as independent jobs.

    A job is named by a hash of the package's version, the content of its input files and its
    options. Finished jobs are kept in the output folder: a survey that was interrupted, or whose
    configuration or files have changed, does only what is missing when it is started again. A job
    that fails is a row of the table with its traceback, and is tried again the next time.

    Parameters
    ----------
    config : path or mapping
        TOML file, or its content; see :doc:`the guide </howto/survey>`.
    output : path
        Folder for ``jobs/NAME_KEY/`` with the products of each job, ``combined/STAR_KEY/`` with
        the search over all filters and epochs of each star that has several, ``results.ecsv``
        and ``survey.html``. Several surveys may use the same folder.
    scheduler : str, optional
        Address of a dask scheduler, such as ``tcp://host:8786``. Default processes on this
        machine, as many as the configuration says.
    progress : bool
        Show a progress bar.

    Returns
    -------
    Table
        One row for each job; what is not known is masked. ``table.meta["combined"]`` has what the
        searches over filters and epochs say: a dict for each star, with its name (`star`), the
        `folder`, and its `candidates`, or the `reason` why it was not searched.

    Raises
    ------
    CorruptFileError, IncompatibleSetupError
        If the configuration has mistakes, before any work, or if the output cannot be written.
    RefinementError
        If the scheduler is lost.

    Notes
    -----
    Processes are started with the method "spawn", so a script that calls this needs the usual
    ``if __name__ == "__main__":``.

    Examples
    --------
    With a configuration and the frames that it names, which the package does not contain:

    >>> import pyklip_diffrender as dr
    >>> table = dr.survey("survey.toml", "products")  # doctest: +SKIP
    """
    limit = read_config(config).memory_limit
    work: Work = reduce_job
    if limit is not None:
        # A worker is killed at 0.95 of its memory.
        work = partial(reduce_job, memory=0.8 * limit)
    return run_survey(config, output, work, scheduler, progress=progress)


def run_survey(
    config: str | os.PathLike[str] | Mapping[str, Any],
    output: str | os.PathLike[str],
    work: Work,
    scheduler: str | None = None,
    *,
    progress: bool = False,
) -> Table:
    """Run any work as the jobs of a survey; see `survey`."""
    read = read_config(config)
    todo = jobs_of(read)
    # Workers have their own working directory.
    output = Path(output).absolute()
    jobs = folder_for_jobs(output)
    clean(jobs)
    rename_to_jobs(jobs, todo)
    board = _Board(todo, output)
    missing = [job for job in todo if not board.has(job)]
    _log.info("%d of %d jobs are finished", len(todo) - len(missing), len(todo))
    labels = {path.name.rpartition("_")[0] for path in jobs.iterdir()}
    again = [
        job
        for job in missing
        if job.key not in board.records and job.folder.rpartition("_")[0] in labels
    ]
    if again:
        _log.warning(
            "%d jobs are done again, because their files, their options, the version of the "
            "package or their products are not as they were: %s",
            len(again), "; ".join(map(str, again)),
        )  # fmt: skip
    try:
        with tqdm(total=len(missing), desc="survey", disable=not progress) as bar:
            for job, record in _execute(missing, jobs, read, scheduler, work):
                board.add(job, record)
                failed = sum(each["status"] == "failed" for each in board.records.values())
                bar.set_postfix(failed=failed)
                bar.update()
        board.stars = search_stars(board.jobs, output, read.spectra)
    finally:
        clean(jobs)
        board.write()
    table = table_of(board.rows)
    table.meta["combined"] = [
        {"star": each.star, "folder": each.folder, **each.combined} for each in board.stars
    ]
    return table


def _execute(
    missing: list[Job], jobs: Path, config: Config, scheduler: str | None, work: Work
) -> Iterator[tuple[Job, Record]]:
    if not missing or (scheduler is None and config.workers == 0):
        return in_this_process(missing, jobs, work)
    return with_dask(missing, jobs, work, scheduler, config)


class _Board:
    """Tables and page of all jobs, on disk while the survey runs."""

    def __init__(self, todo: list[Job], output: Path) -> None:
        self.output, self.todo = output, todo
        self.records: dict[str, Record] = {}
        self.stars: list[StarSearch] = []
        for job in todo:
            record = read_record(output / "jobs" / job.folder)
            if record is not None:
                self.records[job.key] = record
        self.next = 0.0

    def has(self, job: Job) -> bool:
        """Whether a job is finished; failed ones are tried again."""
        return self.records.get(job.key, {}).get("status") == "finished"

    @property
    def jobs(self) -> list[tuple[Job, Record | None]]:
        return [(job, self.records.get(job.key)) for job in self.todo]

    @property
    def rows(self) -> list[dict[str, Any]]:
        return [row(*each) for each in self.jobs]

    def add(self, job: Job, record: Record) -> None:
        """Note how a job ended, and write the tables unless that was done just now."""
        self.records[job.key] = record
        if record["status"] == "failed":
            _log.warning("%s failed: %s", job, record["message"])
        else:
            _log.info("%s: %s", job, record["result"].get("sentence", "finished"))
        began = time.monotonic()
        if began < self.next:
            return
        try:
            self.write()
        except IncompatibleSetupError as error:
            # There may be room again for the next job.
            _log.warning("%s", error)
        ended = time.monotonic()
        # Writing them takes a twentieth of the time.
        self.next = ended + 20 * (ended - began)

    def write(self) -> None:
        """Write tables and page; raises IncompatibleSetupError if they cannot be written."""
        text = page(self.jobs, self.stars)
        # Written beside the old ones and then moved: whoever reads them meanwhile gets whole files.
        try:
            with staged(self.output / "jobs", "tables") as folder:
                table_of(self.rows).write(folder / "results.ecsv", format="ascii.ecsv")
                (folder / "survey.html").write_text(text, encoding="utf-8")
                for path in folder.iterdir():
                    os.replace(path, self.output / path.name)
        except OSError as error:
            raise IncompatibleSetupError(
                f"output: the tables cannot be written to {self.output} ({error.strerror}). Make "
                "room, and start the survey again: finished jobs are kept"
            ) from error


# The work of a job: a reduction, perhaps with an injected planet.


def reduce_job(job: Job, folder: Path, memory: float | None = None) -> dict[str, Any]:
    """Reduce a sequence, perhaps with a planet in it, and write the products."""
    changes: dict[str, Any] = {"memory": memory}
    if job.injection is not None and job.base_folder is not None:
        # The planet is added to the frames of the job without one, which has found the pattern and
        # which frames of reference stars join: what differs is the planet.
        fit = Refinement.read(folder.parent / job.base_folder / "fit.fits")
        first = fit.frames[0].observation
        planet = _planet(job.injection, first.position_angle)
        frames: Sequence[FrameFit] = [each for each in fit.frames if not each.observation.reference]
        references = tuple(each.observation for each in fit.frames if each.observation.reference)
        if job.options.disk:
            frames = _with_disk(frames, _sequence(job).cutout(job.options.side).science)
        science = with_planets(frames, [planet])
        sequence = ExposureSequence(first.target, science, references)
        changes |= {"pattern": fit.pattern or "off", "wide": False}
    else:
        sequence = _sequence(job)
    options = _options(job, sequence.science[0], **changes)
    reduction = prepare(sequence, job.opd, options).run()
    write_products(reduction, folder, fit=job.injection is None)
    result = _result(summarise(reduction))
    if job.injection is not None and job.base is not None:
        result["recovered"] = _recovered(reduction, job.injection, frames[0].star_light)
    return result


def _sequence(job: Job) -> ExposureSequence:
    return ExposureSequence.from_files(
        job.files, target=job.target, filter=job.filter, epoch=job.epoch
    )


def _options(job: Job, frames: Observation, **changes: Any) -> ReduceOptions:
    """Options of a job's reduction; settings that it does not name have the preset's values."""
    own = job.options.settings
    changes["settings"] = nircam_settings(frames, **own) if own else None
    return ReduceOptions(**{**vars(job.options), **changes})


def _with_disk(frames: Sequence[FrameFit], original: Sequence[Observation]) -> list[FrameFit]:
    """The frames of a fit, with the extended light that was subtracted from them."""
    return [
        replace(frame, observation=replace(frame.observation, data=each.combined().data))
        for frame, each in zip(frames, original, strict=True)
    ]


def _planet(injection: Injection, north: float) -> Planet:
    """Beside the star in the first frame, whose +y axis has the position angle `north`."""
    return Planet(injection.contrast, injection.separation, injection.angle - north)


def _recovered(reduction: ReductionResult, planet: Injection, star_light: float) -> dict[str, Any]:
    """Measure an injected planet, as a contrast to a star of this light."""
    detection = reduction.detection
    # The planet's candidate, or else, without one, the flux at the place of the injection.
    place = _planet(planet, detection.north).offset
    measured = measured_planet(detection, place, star_light)._asdict()
    return {key: value if math.isfinite(value) else None for key, value in measured.items()}


def _result(summary: dict[str, Any]) -> dict[str, Any]:
    """Facts of a reduction for the tables and the page of a survey."""
    keys = ("target", "filter", "sentence", "limits", "threshold_snr", "left_out")
    search = summary["wide_field"] or summary
    curve = search["contrast_curve"]
    return {
        **{key: summary[key] for key in keys},
        "candidates": [{"false_alarm_probability": None, **each} for each in search["candidates"]],
        "fit_status": summary["status"]["name"],
        "reduced_chi2": summary["fit"]["reduced_chi2"],
        "error_factor": summary["fit"]["error_factor"],
        "frames": sum(each["use"] == "target" for each in summary["frames"]),
        "curve": {key: curve[key] for key in ("sigmas", "separation_arcsec", "contrast")},
    }


# How a job is run, so that it ends in a folder whatever happens.

Work = Callable[[Job, Path], dict[str, Any]]
"""Computes a job, writes its products to a folder, and returns plain values for the record."""


def run_job(job: Job, jobs: Path, work: Work, base: Record | None = None) -> Record:
    """Run a job and publish its folder; returns its record, which says if and why it failed.

    `base` is the record of the job whose fit this one starts from, if that was to run as well.
    """
    final = jobs / job.folder
    known = read_record(final)
    if known is not None and known["status"] == "finished":
        return known
    began = time.perf_counter()
    try:
        if base is not None and base["status"] != "finished":
            raise RefinementError("the reduction without a planet failed, see there")
        _require_same_world(job, jobs)
        if base is not None and job.base_folder is not None:
            _appears(jobs / job.base_folder)
        with staged(jobs, job.key) as folder:
            result = work(job, folder)
            record = {**_circumstances(began), "status": "finished", "result": result}
            whole = write_record(folder, job, record)
            publish(folder, final)
    except Exception as error:
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
    with suppress(OSError), staged(jobs, job.key) as folder:
        record = write_record(folder, job, record)
        publish(folder, jobs / job.folder)
    return record


def _require_same_world(job: Job, jobs: Path) -> None:
    """Refuse to work where version, folders or files differ from the plan."""
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
                f"{name}: the content on {host} differs from the plan. Start the survey again if "
                "the file was changed"
            )


def _circumstances(began: float) -> dict[str, Any]:
    return {
        "seconds": round(time.perf_counter() - began, 3),
        "ended": datetime.now(UTC).isoformat(timespec="seconds"),
        "host": socket.gethostname(),
    }


# Jobs run in this process, or by the workers of dask.distributed.


def in_this_process(todo: Sequence[Job], jobs: Path, work: Work) -> Iterator[tuple[Job, Record]]:
    """Run jobs one after the other; yields each with its record."""
    records: dict[str | None, Record] = {}
    for job in todo:
        records[job.key] = run_job(job, jobs, work, records.get(job.base))
        yield job, records[job.key]


def with_dask(
    todo: Sequence[Job], jobs: Path, work: Work, scheduler: str | None, plan: Config
) -> Iterator[tuple[Job, Record]]:
    """Run jobs on a cluster, by default on this machine; yields each with its record.

    A job whose worker dies is given to another one, up to three times. Raises
    IncompatibleSetupError without dask.distributed or an answering scheduler, RefinementError if
    that is lost.
    """
    try:
        from dask import config
        from dask.distributed import Client, LocalCluster, as_completed
        from dask.system import CPU_COUNT
    except ImportError as error:
        raise IncompatibleSetupError(
            f"dask.distributed is needed for more than one process and is not installed ({error}): "
            'python -m pip install "dask[distributed]", or set workers = 0'
        ) from error
    with ExitStack() as stack:
        address: Any = scheduler
        if scheduler is None:
            stack.enter_context(config.set({
                # A worker that is not back after this time is given up, by default after 15 s.
                "distributed.deploy.lost-worker-timeout": "7 days",
                # Jobs fail when there was no worker for this time.
                "distributed.scheduler.no-workers-timeout": "10 minutes",
                # Dask makes glibc give freed memory back at once, which slows fits down.
                "distributed.nanny.pre-spawn-environ.MALLOC_TRIM_THRESHOLD_": None,
            }))  # fmt: skip
            try:
                cluster = LocalCluster(
                    n_workers=min(plan.workers or CPU_COUNT, len(todo)),
                    threads_per_worker=1,
                    processes=True,
                    memory_limit=plan.memory_limit or "auto",
                    # Any free port; None would ask for a certain one, and warn.
                    dashboard_address="127.0.0.1:0",
                    silence_logs=logging.CRITICAL,
                    env=dict.fromkeys(
                        ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1"
                    ),
                )
            except RuntimeError as error:
                raise IncompatibleSetupError(
                    f"the worker processes cannot be started ({error}). A script that calls survey "
                    "has to be a file, with `if __name__ == '__main__':`; workers = 0 does without "
                    "processes"
                ) from error
            address = stack.enter_context(cluster)
        try:
            client = stack.enter_context(Client(address, timeout=30))
        except (OSError, ValueError) as error:
            raise IncompatibleSetupError(
                f"scheduler: got {scheduler!r}, where none answers ({error}). Start one with `dask "
                "scheduler`, and give the address that it prints, such as tcp://host:8786"
            ) from error

        # Two surveys on one scheduler and one folder share their jobs.
        place = hashlib.sha256(str(jobs).encode()).hexdigest()[:8]
        futures: dict[str | None, Any] = {}
        for job in todo:
            futures[job.key] = client.submit(
                run_job, job, jobs, work, futures.get(job.base), key=f"survey-{place}-{job.key}"
            )
        running = dict(zip(futures.values(), todo, strict=True))
        for future in as_completed(list(running), raise_errors=False):
            yield running[future], _record_of(future, running[future], jobs)


def _record_of(future: Any, job: Job, jobs: Path) -> Record:
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
        taken = (
            "this job" if getattr(error, "task", None) == future.key else "the job without a planet"
        )
        killed = RefinementError(
            f"every worker that took {taken} was killed. If they ran out of memory, raise "
            "memory_limit, with fewer workers where the machine has no more"
        )
        killed.__cause__ = error
        return failure(job, jobs, killed)
    if record["status"] == "finished" and not _appears(final):
        lost = IncompatibleSetupError(
            f"the worker on {record['host']} wrote its products to another disk than {jobs}. Put "
            "the output on a disk that all workers share"
        )
        return failure(job, jobs, lost)
    return record


def _appears(final: Path) -> bool:
    """Whether a job that has finished elsewhere is seen here, perhaps after a while."""
    # Network disks lag.
    for _ in range(20):
        if finished(final):
            return True
        time.sleep(0.5)
    return False
