"""Time of a reduction on the command line, on an idle machine and beside other processes.

    python -m benchmarks.busy_machine OPD ROLL [ROLL] --busy 0 1 4

Every case is a process of its own, with threads that wait actively or passively (the environment
variable OMP_WAIT_POLICY) or with one thread, beside as many processes that compute all the time.
The machine must be idle otherwise.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import Table

CASES = (("passive", None), ("active", None), ("passive", 1))
"""Policies of waiting and numbers of threads."""


def measure(options: argparse.Namespace, policy: str, threads: int | None) -> dict[str, Any]:
    """Run one reduction and return its seconds, memory and median contrast limit."""
    environment = {**os.environ, "OMP_WAIT_POLICY": policy}
    for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        environment.pop(name, None)
    with tempfile.TemporaryDirectory() as folder:
        output = Path(folder) / "products"
        command = [
            sys.executable,
            "-m",
            "pyklip_diffrender",
            "reduce",
            *map(str, options.rolls),
        ]
        command += ["--opd", str(options.opd), "-o", str(output), "--quiet"]
        command += [] if threads is None else ["--threads", str(threads)]
        before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
        subprocess.run(command, check=True, env=environment, stdout=subprocess.DEVNULL)
        seconds, after = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
        curve = Table.read(output / "contrast.ecsv")
        summary = json.loads((output / "summary.json").read_text())
    return {
        "policy": policy,
        "threads": "all" if threads is None else threads,
        "seconds": round(seconds, 1),
        "CPU s": round(after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime, 1),
        "GB": round(after.ru_maxrss / 1e6 * 1.024, 2),
        "status": summary["status"]["name"],
        "median contrast": f"{np.nanmedian(curve['contrast']):.3e}",
    }


def main() -> None:
    """Measure all cases and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("opd", type=Path)
    parser.add_argument("rolls", type=Path, nargs="+")
    parser.add_argument("--busy", type=int, nargs="+", default=[0, 1, 4])
    options = parser.parse_args()
    rows = []
    for busy in options.busy:
        others = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(busy)]
        try:
            for policy, threads in CASES:
                rows.append({"busy": busy, **measure(options, policy, threads)})
                print(rows[-1], flush=True)
        finally:
            for other in others:
                other.kill()
    Table(rows).pprint_all()


if __name__ == "__main__":
    main()
