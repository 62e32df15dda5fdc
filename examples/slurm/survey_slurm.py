"""A survey whose workers are jobs of SLURM, with dask-jobqueue.

    python -m pip install dask-jobqueue
    python examples/slurm/survey_slurm.py survey.toml /shared/products --jobs 100

Run it where jobs are submitted. The package, the data and the output folder must be at the same
paths on all machines. If it is stopped, the same command goes on.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import dask
from dask_jobqueue import SLURMCluster

import pyklip_diffrender as dr


def main() -> None:
    """Submit workers as they are needed, and wait for the survey."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("config", type=Path, help="of the survey, TOML")
    parser.add_argument("output", type=Path, help="folder for jobs and tables")
    parser.add_argument("--jobs", type=int, default=100, help="largest number of jobs of SLURM")
    parser.add_argument(
        "--cluster", type=Path, default=Path(__file__).parent / "jobqueue.yaml",
        help="configuration of dask-jobqueue, YAML",
    )  # fmt: skip
    options = parser.parse_args()
    dask.config.update(dask.config.config, dask.config.collect([str(options.cluster)], env={}))
    with SLURMCluster() as cluster:
        cluster.adapt(minimum=0, maximum=options.jobs)
        table = dr.survey(options.config, options.output, scheduler=cluster.scheduler_address)
    print(table)


if __name__ == "__main__":
    main()
