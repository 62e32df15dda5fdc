"""The tiers of tests, fixtures for all, and an environment in which runs repeat.

Plain ``pytest`` leaves out what is marked ``slow`` and tries few examples in each property test;
``pytest --full`` runs everything but what needs a GPU; ``pytest -m gpu`` runs that.
"""

import importlib.util
import os
import sys
import warnings
from pathlib import Path

# Before numpy or torch are imported: thread pools read these once.
if "PYTEST_XDIST_WORKER" in os.environ:
    for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(_name, "1")
# No test opens a window.
os.environ.setdefault("MPLBACKEND", "Agg")

import numpy as np
import pytest
import torch
from hypothesis import settings

ROOT = Path(__file__).resolve().parents[1]
# The scripts in benchmarks by their place, not by the path: another package may have that name,
# and the installed pyklip_diffrender has to come before its source.
_spec = importlib.util.spec_from_file_location("benchmarks", ROOT / "benchmarks" / "__init__.py")
assert _spec is not None
assert _spec.loader is not None
sys.modules["benchmarks"] = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(sys.modules["benchmarks"])

# A deadline measures how busy the machine is; derandomised, a failure is there again tomorrow.
settings.register_profile("quick", deadline=None, derandomize=True, max_examples=8)
settings.register_profile("full", settings.get_profile("quick"), max_examples=20)


def pytest_addoption(parser):
    parser.addoption(
        "--full",
        action="store_true",
        help="run the slow tests too (hard cases, studies), and more examples of property tests",
    )


def pytest_configure(config):
    # Before the test modules are imported, whose settings start from the profile.
    settings.load_profile("full" if config.getoption("--full") else "quick")


def pytest_xdist_auto_num_workers(config):
    """No workers where files or tests are named: starting them would take longer."""
    return None if config.args_source is pytest.Config.ArgsSource.TESTPATHS else 0


def pytest_collection_modifyitems(config, items):
    for item in items:
        if getattr(getattr(item, "obj", None), "is_hypothesis_test", False):
            item.add_marker("fuzz")
    absent = set() if config.getoption("--full") else {"slow", "study"}
    if "gpu" not in config.getoption("markexpr"):
        absent.add("gpu")
    left_out = [item for item in items if any(map(item.get_closest_marker, absent))]
    if left_out:
        config.hook.pytest_deselected(items=left_out)
        items[:] = [item for item in items if item not in set(left_out)]


@pytest.fixture(scope="session", autouse=True)
def _forward_mode():
    """Torch's own deprecation warning, at its first forward-mode derivative, is behind us.

    It compiles its rules by what it calls deprecated.
    """
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=r"`torch\.jit\.script` is")
        torch.func.jvp(torch.sin, (torch.ones(1),), (torch.ones(1),))


@pytest.fixture
def rng():
    """A fresh generator with a fixed seed, the same for every test."""
    return np.random.default_rng(335)


@pytest.fixture(scope="session")
def shared_data():
    """Folder of real frames and OPD maps, too large to come with the code.

    It is ``data`` in the folder named by PYKLIP_DIFFRENDER_SHARED, or in ``shared`` next to the
    project. Without either, the tests are skipped; a variable that points nowhere fails them.
    """
    named = os.environ.get("PYKLIP_DIFFRENDER_SHARED")
    data = (Path(named) if named else ROOT.parent / "shared") / "data"
    if data.is_dir():
        return data
    if named:
        pytest.fail(f"PYKLIP_DIFFRENDER_SHARED={named}: there is no folder {data}")
    pytest.skip(
        "needs real frames and OPD maps: put a folder 'shared' next to the project or "
        "name one in PYKLIP_DIFFRENDER_SHARED"
    )


@pytest.fixture(scope="session")
def official_files(shared_data):
    """The folder of STScI's own files for stpsf."""
    folder = shared_data / "stpsf-data"
    if not folder.is_dir():
        pytest.skip(f"needs STScI's files for stpsf in {folder}")
    return folder


@pytest.fixture(scope="session")
def stpsf_path(tmp_path_factory):
    """An offline data directory with 256 samples across the pupil, set as STPSF_PATH."""
    if importlib.util.find_spec("stpsf") is None:
        pytest.skip("needs stpsf, the extra 'webbpsf'")
    from benchmarks.stpsf_data import make_stpsf_data

    folder = make_stpsf_data(tmp_path_factory.mktemp("stpsf") / "data", npix=256)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("STPSF_PATH", str(folder))
        yield folder


@pytest.fixture
def offline(monkeypatch):
    """JWSTData asks a web service for its filters, and falls back to tables without."""
    JWST = pytest.importorskip("pyklip.instruments.JWST")

    def refuse(**kw):
        raise OSError("offline")

    monkeypatch.setattr(JWST.SvoFps, "get_filter_list", refuse)


@pytest.fixture
def registered():
    """The backend in pyKLIP, with a subtractor that renders the star of `backend_scene`."""
    from backend_scene import OPD, render

    from pyklip_diffrender.pyklip_backend import register, unregister

    register(opd=OPD, subtractor=render)
    yield
    unregister()
