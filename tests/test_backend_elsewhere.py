"""Calls in other threads and processes never run plain KLIP without a word."""

from __future__ import annotations

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import pytest
from backend_scene import OPD, frames, generic, render
from pyklip.parallelized import klip_dataset

from pyklip_diffrender.errors import DiffrenderWarning
from pyklip_diffrender.pyklip_backend import backend, is_registered, register, unregister
from pyklip_diffrender.pyklip_backend.child import spawned_beside_klip

VARIABLE = "PYKLIP_DIFFRENDER_TAKES_KLIP"


def call(rng, folder, algo):
    """Run `klip_dataset` in another thread; returns what it raised."""
    dataset = generic(frames([0.0, 30.0], rng), [0.0, 30.0])
    options = {
        "mode": "ADI", "outputdir": str(folder), "annuli": 1, "subsections": 1, "numbasis": [1],
        "numthreads": 1, "verbose": False, "algo": algo,
    }  # fmt: skip
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(klip_dataset, dataset, **options).exception()


@pytest.mark.parametrize("algo", ["klip", "diffrender"])
def test_a_block_of_another_thread_is_mentioned(algo, rng, tmp_path):
    # Warnings are errors here, so that KLIP does not run.
    with backend(opd=OPD, subtractor=render):
        raised = call(rng, tmp_path, algo)
    assert isinstance(raised, DiffrenderWarning)
    assert "in this thread" in str(raised)


def test_what_is_registered_holds_in_threads(rng, tmp_path):
    register(opd=OPD, subtractor=render, replace=True)
    try:
        assert call(rng, tmp_path, "klip") is None
    finally:
        unregister()
    assert (tmp_path / "-KLmodes-all.fits").is_file()


def test_who_takes_calls_of_klip_is_in_the_environment(monkeypatch):
    monkeypatch.delenv(VARIABLE, raising=False)
    with backend(opd=OPD, force=False):
        assert VARIABLE not in os.environ
        with backend(opd=OPD):
            assert os.environ[VARIABLE] == str(os.getpid())
            assert not spawned_beside_klip()
        assert VARIABLE not in os.environ
    register(opd=OPD, replace=True)
    assert VARIABLE in os.environ
    unregister()
    assert VARIABLE not in os.environ
    assert not is_registered()


SCRIPT = """
import multiprocessing
import warnings
import pyklip_diffrender as dr

def work(_):
    from pyklip import parallelized
    from pyklip_diffrender.pyklip_backend import is_registered
    assert not is_registered()
    warnings.simplefilter("error")
    try:
        parallelized.klip_dataset(None, algo="klip")
    except UserWarning as warning:
        return str(warning)

if __name__ == "__main__":
    with dr.backend(opd="flat"):
        with multiprocessing.get_context("spawn").Pool(1) as pool:
            print(pool.map(work, [0])[0])
"""


@pytest.mark.slow
def test_a_spawned_process_says_that_it_runs_klip(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(SCRIPT, encoding="utf-8")
    done = subprocess.run(
        [sys.executable, str(script)], capture_output=True, text=True, check=False, timeout=300
    )
    assert "runs KLIP in this spawned process" in done.stdout, done.stderr
