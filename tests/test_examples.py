"""Every study of examples/paper in its small version, as its reader would start it."""

from __future__ import annotations

import importlib
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from astropy.table import Table

pytestmark = pytest.mark.slow

FOLDER = Path(__file__).parents[1] / "examples" / "paper"

COLUMNS = {
    "calibration": ("null", "known_star_null", "limit_mean", "star_error"),
    "companions": ("contrast", "measured", "error"),
    "contrast_boundary": ("contrast", "matched"),
    "contrast_drift": ("annulus_snr", "star_error", "marginalised_snr"),
    "beyond": ("annulus_snr", "star_error", "marginalised_snr", "null"),
    "failures": ("chi2", "null", "limit"),
    "fluxes": ("measured", "error", "kept_by_subtraction"),
    "klip_table": ("matched_snr", "throughput", "photon_snr"),
    "location": ("x_found", "y_found", "snr", "photon_snr"),
    "misalignment": ("psnr", "star_error", "marginalised_snr"),
    "mismatch": ("snr", "contrast", "null", "lyot_error_percent"),
    "progress": ("annulus_snr", "star_error", "opd_left"),
    "ring": ("measured", "error", "kept_by_subtraction"),
    "snapshots": ("measured", "error"),
    "snr_grid": ("matched_snr", "throughput", "photon_snr"),
    "speed": ("refine",),
}
"""Of each study's table, those that must be finite in all rows."""

NO_SCRIPTS = {
    "experiments", "inference_figure", "judging", "methods", "overview", "pages", "pictures",
    "published", "scene", "sections", "summary",
}  # fmt: skip

WARNINGS = ("-W", "error")


def test_every_study_is_tested() -> None:
    assert {path.stem for path in FOLDER.glob("*.py")} - NO_SCRIPTS == set(COLUMNS)


@pytest.fixture
def examples(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(FOLDER))


def run(name: str, folder: Path) -> Table:
    command = [sys.executable, *WARNINGS, str(FOLDER / f"{name}.py"), "--quick", "-o", str(folder)]
    done = subprocess.run(
        command,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return Table.read(folder / f"{name}_generator.ecsv", format="ascii.ecsv")


def middle(table: Table, method: str, column: str) -> float:
    """Median of one method's rows."""
    return float(np.median(table[column][table["method"] == method]))


@pytest.mark.parametrize("name", COLUMNS)
@pytest.mark.usefixtures("examples")
def test_small_version(name: str, tmp_path: Path) -> None:
    table = run(name, tmp_path)
    assert len(table)
    for column in COLUMNS[name]:
        assert np.isfinite(np.asarray(table[column], dtype=float)).all(), column
    if "method" in table.colnames:
        check_methods(table, name)
    experiments = importlib.import_module("experiments")
    if name in experiments.TITLES:
        page = experiments.write(tmp_path, tmp_path).read_text(encoding="utf-8")
        assert f"![{experiments.TITLES[name]}](images/paper_{name}.png)" in page
        assert (tmp_path / "images" / f"paper_{name}.png").stat().st_size > 10_000
        assert not re.search(r"\bnan\b", page)


def check_methods(table: Table, name: str) -> None:
    """The refined star is nearest to the truth, and the marginalised planet seen best."""
    if name == "progress":
        for method in ("Adam", "Gauss-Newton"):
            mine = table[table["method"] == method]
            mine.sort("step")
            assert (np.diff(mine["star_error"]) < 0).all()
            assert (np.diff(mine["opd_left"]) <= 0).all()
    elif "star_error" in table.colnames:
        best = "Gauss-Newton, fitted" if name == "misalignment" else "Gauss-Newton"
        error = middle(table, best, "star_error")
        assert error < 1
        for other in {str(m) for m in table["method"]} - {best, "optimal", "marginalised"}:
            assert error < middle(table, other, "star_error")
    if "matched_snr" in table.colnames:
        won = middle(table, "marginalised", "matched_snr")
        assert won > 5 * abs(middle(table, "KLIP", "matched_snr"))
        assert 0.5 < won / np.median(table["photon_snr"]) < 1.2
        assert middle(table, "optimal", "throughput") == pytest.approx(1, abs=0.05)
