"""The memory that a case takes: in a process of its own, for allocators do not forget.

`main` takes a `Setting` as JSON and the key of a case from the command line. It writes the largest
memory held during a warm call less what was held before the case was set up, in bytes: resident
memory on a processor (Linux), torch's own count on a GPU. What the setting-up alone needed for a
while is not counted.
"""

from __future__ import annotations

import json
import math
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path

import torch

from benchmarks.speed.case import Case
from benchmarks.speed.setting import Setting
from benchmarks.speed.timing import give_back, resident, start_peak

ROOT = Path(__file__).resolve().parents[2]


def memory_of(case: Case, setting: Setting) -> float:
    """Bytes, measured in this process."""
    if case.make is None:
        return math.nan
    on_gpu = torch.device(setting.device).type == "cuda"
    # What all cases share is there before.
    _ = setting.opd, setting.model
    give_back()
    before = torch.cuda.memory_allocated(setting.device) if on_gpu else resident()
    work = case.make()
    work()
    start_peak(setting.device)
    work()
    peak = torch.cuda.max_memory_allocated(setting.device) if on_gpu else resident("VmHWM")
    return peak - before


def peak_memory(case: Case, setting: Setting, timeout: float = 300.0) -> float:
    """Bytes, measured in a process of its own; NaN where that fails."""
    # Last, as in tests/conftest.py: an installed package comes before its source.
    program = f"import sys; sys.path.append({str(ROOT)!r}); from {__name__} import main; main()"
    command = [sys.executable, "-c", program, json.dumps(asdict(setting)), case.key]
    try:
        process = subprocess.run(
            command, capture_output=True, text=True, timeout=timeout, check=True
        )
        return float(process.stdout.splitlines()[-1])
    except (subprocess.SubprocessError, ValueError, IndexError):
        return math.nan


def main() -> None:
    """Measure one case."""
    from benchmarks.speed.rows import cases_of

    setting = Setting(**json.loads(sys.argv[1]))
    (case,) = (
        case for case in cases_of(sys.argv[2].split(" | ")[0], setting) if case.key == sys.argv[2]
    )
    sys.stdout.write(f"{memory_of(case, setting)}\n")
