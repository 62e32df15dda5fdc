"""A survey from its configuration to its tables."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from astropy.table import Table
from tqdm import tqdm

from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.surveys.config import Config, read_config
from pyklip_diffrender.surveys.execution import Work, in_this_process, reduce_job, with_dask
from pyklip_diffrender.surveys.jobs import (
    Job,
    Record,
    clean,
    jobs_of,
    prepare,
    read_record,
    rename_to_jobs,
    staged,
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
    jobs = prepare(output)
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
                bar.set_postfix(failed=board.failures)
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
    def failures(self) -> int:
        return sum(each["status"] == "failed" for each in self.records.values())

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
