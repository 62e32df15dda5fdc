"""How long a survey takes, by its number of stars and of workers.

    python -m benchmarks.survey_growth --output docs/results/survey_growth.ecsv

The jobs are the rolls of two M dwarfs (gto1184 in the shared data) in squares of 48 pixels, without
the combined searches that would follow. Some numbers of them are surveyed with one worker and with
two. Then the scheduler of dask is simulated with the times that the jobs took with one worker: a
worker that is free takes the next job. A survey of more stars than there are rolls has the same
jobs again. The time in which a survey starts its workers and writes its page is measured with one
star, and added. Measured surveys are among the simulated ones, so that the two can be compared.
"""

from __future__ import annotations

import argparse
import heapq
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from unittest.mock import patch

from astropy.io import fits
from astropy.table import Table

import pyklip_diffrender as dr
from benchmarks.provenance import provenance
from benchmarks.real_frames import DATA, opd_of
from pyklip_diffrender.io.files import write_table
from pyklip_diffrender.surveys import driver

STARS, MEASURED_STARS = (1, 2, 5, 10, 20, 50), (1, 4, 8)
TARGETS = ("G-7-34", "HIP17695")
WORKERS, MEASURED_WORKERS = (1, 2, 4, 8, 16, 32), (1, 2)
SIZE = 48
"""Side of the fitted square, pixels."""


def makespan(seconds: Sequence[float], workers: int) -> float:
    """Time until the last job ends, if a worker that is free takes the next one."""
    free = [0.0] * workers
    for each in seconds:
        heapq.heapreplace(free, free[0] + each)
    return max(free)


def surveyed(files: Sequence[Path], opd: Path, workers: int) -> tuple[float, list[float]]:
    """Wall time of a survey with one job for each file, and of its jobs, s."""
    sequences = [
        {"name": f"roll {k}", "files": [str(file.resolve())], "opd": str(opd.resolve())}
        for k, file in enumerate(files)
    ]
    config = {"workers": workers, "options": {"size": SIZE}, "sequence": sequences}
    with tempfile.TemporaryDirectory() as folder:
        began = time.perf_counter()
        with patch.object(driver, "search_stars", return_value=[]):
            table = dr.survey(config, folder)
        total = time.perf_counter() - began
    if set(table["status"]) != {"finished"}:
        raise SystemExit(f"not all jobs are finished:\n{table}")
    return total, [float(each) for each in table["seconds"]]


def main() -> None:
    """Measure, simulate, print, and write the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--data", type=Path, default=DATA)
    parser.add_argument("--output", type=Path, help="file for the table (ECSV)")
    options = parser.parse_args()
    files = [
        file
        for file in sorted((options.data / "gto1184").glob("*_calints.fits.gz"))
        if fits.getval(file, "TARGPROP") in TARGETS
    ]
    measured = {
        (stars, workers): surveyed(files[:stars], opd_of(options.data), workers)
        for workers in MEASURED_WORKERS
        for stars in MEASURED_STARS
    }
    jobs = measured[max(MEASURED_STARS), 1][1]
    single, (first,) = measured[1, 1]
    overhead = single - first

    def simulated(stars: int, workers: int) -> float:
        return overhead + makespan([jobs[k % len(jobs)] for k in range(stars)], workers)

    rows = [
        {"stars": stars, "workers": workers, "seconds": total, "kind": "measured"}
        for (stars, workers), (total, _) in measured.items()
    ]
    sizes = sorted({*STARS, *MEASURED_STARS})
    rows += [
        {"stars": stars, "workers": workers, "seconds": simulated(stars, workers),
         "kind": "simulated"}
        for workers in WORKERS for stars in sizes
    ]  # fmt: skip
    table = Table(rows)
    table["seconds"].unit = "s"
    table["seconds"].format = ".1f"
    table.meta = provenance("benchmarks.survey_growth --output FILE", "distributed")
    table.meta["seconds of the jobs"] = [round(each, 2) for each in jobs]
    table.meta["seconds of start and page"] = round(overhead, 2)
    table.pprint_all()
    if options.output is not None:
        write_table(table, options.output)


if __name__ == "__main__":
    main()
