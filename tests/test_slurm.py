"""The example for SLURM, with an `sbatch` that runs jobs on this machine."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from astropy.table import Table

from benchmarks.calints_files import CENTER, calints, starlight

ROOT = Path(__file__).resolve().parents[1]

SBATCH = """#!/usr/bin/env bash
# Jobs run at once, in sessions of their own; their numbers are those of the processes.
cp "$1" "{folder}/job-$$.sh"
setsid bash "{folder}/job-$$.sh" > "{folder}/job-$$.log" 2>&1 < /dev/null &
echo "Submitted batch job $!"
"""

SCANCEL = """#!/usr/bin/env bash
for job in "$@"; do kill -- "-$job" 2> /dev/null; done
exit 0
"""


@pytest.mark.slow
def test_a_survey_runs_in_jobs_of_slurm(tmp_path):
    pytest.importorskip("dask_jobqueue")
    for name, text in (("sbatch", SBATCH), ("scancel", SCANCEL)):
        program = tmp_path / name
        program.write_text(text.format(folder=tmp_path))
        program.chmod(0o755)
    light = starlight((23 - CENTER[0], 23 - CENTER[1]), 48)
    path = calints(tmp_path / "star_calints.fits", light=light, cards={"CRPIX1": 24, "CRPIX2": 24})
    config = tmp_path / "survey.toml"
    config.write_text(
        f"""
        [options]
        size = 16
        pattern = "off"
        settings = {{ wavefront = false, companions_if_stalled = false, max_companions = 0 }}
        [[sequence]]
        files = "{path}"
        opd = "flat"
        """
    )
    output = tmp_path / "products"
    done = subprocess.run(
        [
            sys.executable, str(ROOT / "examples" / "slurm" / "survey_slurm.py"),
            str(config), str(output), "--jobs", "1",
        ],
        cwd=tmp_path, capture_output=True, text=True, check=False, timeout=500,
        env={**os.environ, "PATH": f"{tmp_path}:{os.environ['PATH']}"},
    )  # fmt: skip
    logs = "\n".join(path.read_text() for path in tmp_path.glob("job-*.log"))
    assert done.returncode == 0, done.stderr + logs
    (script,) = tmp_path.glob("job-*.sh")
    lines = script.read_text().splitlines()
    for line in ("#SBATCH -p standard", "#SBATCH -A my-project", "#SBATCH -t 04:00:00",
                 "export OMP_NUM_THREADS=1"):  # fmt: skip
        assert line in lines
    assert "Starting Worker" in logs or "Start worker" in logs, logs
    (row,) = Table.read(output / "results.ecsv")
    assert row["status"] == "finished"
    assert row["target"] == "HD 1"
