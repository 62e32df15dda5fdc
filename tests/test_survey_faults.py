"""Surveys as real processes that are killed, and inputs that are damaged."""

from pathlib import Path

import pytest

from benchmarks import faults

ROOT = Path(__file__).resolve().parents[1]

pytestmark = [pytest.mark.slow, pytest.mark.hard]

WITH_DASK = ("workers_killed", "client_killed")
WITHOUT = ("full_disk", "damaged_inputs")
BY_HAND = (
    "out_of_memory", "two_surveys", "scheduler_killed", "blind_worker", "read_only", "file_limit",
)  # fmt: skip
"""Where importing the libraries alone needs more than the limit, the workers of the first are
restarted without end. The others take long, and break the same code as those that remain."""


@pytest.mark.parametrize(
    "scenario",
    [*WITH_DASK, *WITHOUT, *(pytest.param(name, marks=pytest.mark.study) for name in BY_HAND)],
)
def test_nothing_is_half_done_and_nothing_finished_is_lost(scenario, tmp_path, monkeypatch):
    if scenario in (*WITH_DASK, *BY_HAND[:4]):
        pytest.importorskip("distributed")
    monkeypatch.setenv("PYTHONPATH", str(ROOT))  # Of the surveys, which are processes.
    try:
        said = getattr(faults, scenario)(tmp_path, 1, 60)
    except PermissionError as error:
        pytest.skip(f"{scenario}: {error}")
    assert said
