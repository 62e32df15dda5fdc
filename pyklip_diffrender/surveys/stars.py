"""The filters and epochs of each star of a survey, searched together when its jobs have ended."""

from __future__ import annotations

import json
import logging
import os
import shutil
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pyklip_diffrender._version import __version__
from pyklip_diffrender.detection import Combination, Detection
from pyklip_diffrender.errors import CorruptFileError, IncompatibleSetupError
from pyklip_diffrender.io.files import read_text, sha256
from pyklip_diffrender.options import SPECTRA
from pyklip_diffrender.reduction.products import read_summary
from pyklip_diffrender.reduction.several import (
    COMPARISON,
    by_star,
    in_words,
    search_together,
    write_comparison,
)
from pyklip_diffrender.surveys.jobs import Job, Record, clean, folder_of, hash_of, staged

FOLDER = "combined"
"""Folder of the searches of stars, in the survey's folder."""

Group = Sequence[tuple[Job, Detection]]
"""Jobs of one star with their searches, in order of time."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class StarSearch:
    """The search over all filters and epochs of a star.

    Attributes
    ----------
    star : str
    folder : str
        Folder of the search, in the survey's folder.
    jobs : tuple of str
        Names of the jobs.
    combined : dict
        What ``comparison.json`` has of it: the content of `Combination.to_dict`, or the `reason`
        why there is none.
    """

    star: str
    folder: str
    jobs: tuple[str, ...]
    combined: Mapping[str, Any]


def search_stars(
    rows: Sequence[tuple[Job, Record | None]], output: Path, spectra: Sequence[str]
) -> list[StarSearch]:
    """Search the finished reductions of each star together, where it has several.

    Searches of the same jobs with the same spectra that are in the folder already are kept.

    Parameters
    ----------
    rows : sequence of (Job, dict or None)
        Jobs with their records. Those with injected planets are not searched.
    output : Path
        Folder of the survey.
    spectra : sequence of str
        See `combine`; empty for its defaults.

    Returns
    -------
    list of StarSearch

    Raises
    ------
    IncompatibleSetupError
        If the output cannot be written to.
    """
    spectra = spectra or SPECTRA
    jobs: dict[str, Job] = {}
    searched: dict[str, Detection] = {}
    for job, record in rows:
        if job.injection is not None or record is None or record["status"] != "finished":
            continue
        try:
            searched[job.key] = Detection.read(output / "jobs" / job.folder)
        except CorruptFileError as error:
            _log.warning("%s is in no combined search: %s", job, error)
            continue
        jobs[job.key] = job
    found = []
    for star, group in by_star(searched).items():
        if len(group) > 1:
            dated = sorted(group, key=lambda key: (group[key].sky.mjd or 0.0, str(jobs[key])))
            try:
                found.append(
                    _search(star, [(jobs[key], group[key]) for key in dated], output, spectra)
                )
            except OSError as error:
                raise IncompatibleSetupError(
                    f"output: the search of {star} cannot be written to {output} "
                    f"({error.strerror}). Make room, and start the survey again: finished jobs are "
                    "kept"
                ) from error
    return found


def _search(star: str, group: Group, output: Path, spectra: Sequence[str]) -> StarSearch:
    """Search one star, unless that was done before."""
    listed = [sha256(each) if os.path.isfile(each) else each for each in spectra]
    keys = [job.key for job, _ in group]
    key = hash_of({"version": __version__, "jobs": keys, "spectra": listed})
    final = output / FOLDER / folder_of(star, key)
    names = tuple(str(job) for job, _ in group)
    data = final / COMPARISON[1]
    combined = _combined_in(data)
    if combined is None:
        shutil.rmtree(final, ignore_errors=True)
        _write(star, group, final, spectra)
        combined = _combined_in(data)
    return StarSearch(star, final.relative_to(output).as_posix(), names, combined)


def _combined_in(data: Path) -> Any:
    """Search in a ``comparison.json``; None if there is no such file, or a damaged one."""
    with suppress(OSError, ValueError, KeyError, TypeError):
        return json.loads(read_text(data))["combined"]


def _write(star: str, group: Group, final: Path, spectra: Sequence[str]) -> None:
    """Search one star, and publish the folder with the products as a whole."""
    final.parent.mkdir(exist_ok=True)
    clean(final.parent)
    detections = [each for _, each in group]
    combination = search_together(detections, spectra=spectra)
    _log.info("%s: %s", star, in_words(combination))
    jobs = final.parent.parent / "jobs"
    summaries = {
        # Relative to the folder of the search.
        f"../../jobs/{job.folder}": read_summary(jobs / job.folder)
        for job, _ in group
    }
    try:
        with staged(final.parent, "star") as folder:
            if isinstance(combination, Combination):
                combination.write(folder)
            write_comparison(summaries, folder, combination)
            os.rename(folder, final)
    except OSError:
        # Another survey of the folder may have been faster.
        if not (final / COMPARISON[1]).exists():
            raise
