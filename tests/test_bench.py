"""The speed benchmark: its answers are right, its bookkeeping too, and the page made of it.

Nothing here asserts how long anything takes: machines are busy.
"""

from __future__ import annotations

import math
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from astropy.table import Table

from benchmarks import operations
from benchmarks.speed import Setting, rivals, run_bench, timing, write_page, write_table
from benchmarks.speed import images as bench_images
from benchmarks.speed.__main__ import main
from benchmarks.speed.case import Case
from benchmarks.speed.figure import draw
from benchmarks.speed.images import forward
from benchmarks.speed.memory import memory_of, peak_memory
from benchmarks.speed.page import page, targets
from benchmarks.speed.plain import plain_stpsf
from benchmarks.speed.rivals import load, paper_recipe
from benchmarks.speed.rows import ROWS, select_rows
from benchmarks.speed.timing import exponent, interleaved
from pyklip_diffrender.errors import IncompatibleSetupError

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def here() -> Setting:
    return Setting(quick=True)


@pytest.fixture(scope="module")
def measured(here: Setting) -> Table:
    """The rows on images, in a second."""
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("STPSF_PATH", raising=False)
        return run_bench(here, ["forward"], budget=0.02, memory=False, command="bench --quick")


def line(table: Table, row: str, column: str, precision: str = "float64") -> Any:
    (found,) = (
        r for r in table if (r["row"], r["column"], r["precision"]) == (row, column, precision)
    )
    return found


@pytest.mark.slow
def test_every_way_to_an_image_agrees_with_the_converged_one(measured: Table) -> None:
    """The codes that are compared with solve the same problem: no flip, no wrong scale."""
    assert line(measured, "forward", "this package, 128")["error"] < 1e-7
    assert line(measured, "forward", "poppy, FFT, oversample 4")["error"] < 1e-7
    # Padded by 2, as in the paper's recipe, the occulter is sampled more coarsely.
    for row in ("forward", "forward + backward"):
        assert line(measured, row, "the paper's recipe")["error"] < 1e-6


@pytest.mark.parametrize("name", ["prysm", "hcipy"])
def test_other_codes_agree_too(here: Setting, name: str) -> None:
    try:
        load(name)
    except ImportError as error:
        pytest.skip(f"needs the extra 'bench': {error}")
    image = getattr(rivals, f"{name}_image")(here.arrays)()
    assert here.judge(bench_images._scaled(image, here)).error < 1e-7


def test_the_papers_recipe_has_the_derivative_of_the_package(here: Setting) -> None:
    weight = torch.from_numpy(np.random.default_rng(1).standard_normal(here.truth.shape))
    slopes = []
    for image in (paper_recipe(here.arrays, "cpu"), here.model):
        opd = here.opd.clone().requires_grad_()
        slopes.append(torch.autograd.grad((weight * image(opd)).sum(), opd)[0])
    assert (slopes[0] - slopes[1]).norm() < 1e-5 * slopes[1].norm()


@pytest.mark.slow
def test_errors_are_of_the_answers_and_ratios_to_the_reference(measured: Table) -> None:
    ours, theirs = (
        line(measured, "forward + backward", name)
        for name in ("this package, 128", "the paper's recipe")
    )
    assert theirs["ratio"] == 1
    assert ours["ratio"] == pytest.approx(theirs["seconds"] / ours["seconds"])
    coarse = line(measured, "forward", "coarse alone, 64")
    mixed = line(measured, "forward", "multi-fidelity, 64")
    assert mixed["error"] < 0.1 * coarse["error"]
    assert mixed["sigma"] < 0.2 * coarse["sigma"]
    assert line(measured, "forward", "this package, 128", "float32")["error"] > ours["error"]


@pytest.mark.slow
def test_what_cannot_be_measured_is_said(measured: Table) -> None:
    found = line(measured, "forward", "stpsf calc_psf, fft_oversample 4")
    assert math.isnan(found["seconds"])
    assert "STPSF_PATH" in found["note"]
    assert "no GPU" in line(measured, "forward", "this package as a CUDA graph")["note"]


def test_a_missing_library_is_said(here: Setting, monkeypatch: pytest.MonkeyPatch) -> None:
    def absent(name: str) -> None:
        raise ImportError(f"No module named {name!r}")

    monkeypatch.setattr(bench_images, "load", absent)
    monkeypatch.delenv("STPSF_PATH", raising=False)
    notes = {case.column: case.note for case in forward(here) if case.make is None}
    assert "No module named 'prysm'" in notes["prysm"]
    assert "No module named 'hcipy'" in notes["hcipy"]


@pytest.mark.slow
def test_stpsf_is_one_of_the_ways(stpsf_path: Path) -> None:
    with_data = Setting(quick=True, stpsf_path=str(stpsf_path))
    cases = {case.column: case for case in forward(with_data) if "stpsf" in case.column}
    theirs, ours = cases.values()
    for case, most in ((theirs, 1e-6), (ours, 1e-6)):
        assert case.make is not None
        assert case.judge(case.make()()).error < most
    with pytest.raises(IncompatibleSetupError, match="npix512"):
        plain_stpsf(stpsf_path, 512)


@pytest.mark.slow
def test_the_other_rows_run(here: Setting) -> None:
    table = run_bench(here, ["Jacobian"], budget=0.01, memory=False)
    fine = line(table, "Jacobian", "this package, 166 modes on 64", "float32")
    rough = line(table, "Jacobian", "this package, 166 modes on 32", "float32")
    assert fine["error"] < rough["error"] < 0.1
    one_by_one = line(table, "Jacobian", "mode by mode, forward mode on 128")
    assert one_by_one["times"] == 166
    assert one_by_one["error"] == 0
    differences = line(table, "Jacobian", "finite differences of the paper's renderer")
    assert differences["times"] == 167
    # What the occulter leaves of the star is due to some 60 nm of wavefront; the square of a step
    # of 1 nm is about 1 / (2 x 60) of its product with that, more where the star is faint.
    assert fine["error"] < differences["error"] < 0.05


@pytest.mark.slow
def test_refinement_and_detection_run(here: Setting) -> None:
    table = run_bench(here, ["refinement", "S/N", "contrast"], budget=0.01, memory=False)
    ours = line(table, "refinement", "this package, the wavefront alone free")
    assert ours["error"] < line(table, "refinement", "the paper's recipe, 1000 Adam steps")["error"]
    curve = line(table, "contrast curve", "this package, 20 x 6 positions")
    assert curve["error"] < 0.05
    assert line(table, "S/N map", "this package, 576 positions")["error"] < 1e-3


def test_rows_are_chosen_by_how_they_begin() -> None:
    assert [row.name for row in select_rows(["Jac", "S/N"])] == ["Jacobian", "S/N map"]
    assert select_rows([]) == list(ROWS)
    with pytest.raises(IncompatibleSetupError, match="rows: got 'backward'"):
        select_rows(["backward"])


def test_durations_are_the_shortest_and_taken_in_turns(monkeypatch: pytest.MonkeyPatch) -> None:
    """By a clock that only the works advance."""
    now, calls = [0.0], []
    monkeypatch.setattr(timing.time, "perf_counter", lambda: now[0])

    def work(name: str, *durations: float) -> Any:
        def run() -> None:
            calls.append(name)
            now[0] += durations[min(calls.count(name), len(durations)) - 1]

        return run

    short, long = interleaved([work("short", 0.003, 0.001, 0.002), work("long", 0.07, 0.06)], 0.14)
    assert (short, long) == (pytest.approx(0.001), pytest.approx(0.06))
    # What is short is called five times as soon as that is known. The long one fits in twice.
    assert calls[:2] == ["short", "long"]
    assert calls[2:7] == ["short"] * 5
    assert calls.count("long") == 2
    assert calls[-5:] == ["short"] * 5


def test_exponents() -> None:
    assert exponent([1, 2, 4], [3, 12, 48]) == pytest.approx(2)


def test_memory_is_that_of_the_arrays(here: Setting) -> None:
    if not Path("/proc/self/clear_refs").exists():
        pytest.skip("needs Linux: /proc/self/clear_refs")

    def make() -> Any:
        kept = np.ones(4_000_000)
        return lambda: kept + 1

    assert 30e6 < memory_of(Case("row", "column", make), here) < 90e6


@pytest.mark.slow
def test_memory_in_a_process_of_its_own(here: Setting) -> None:
    (case,) = (
        c for c in forward(here) if c.column == "this package, 128" and c.precision == "float64"
    )
    assert 1e5 < peak_memory(case, here) < 1e9
    assert math.isnan(peak_memory(case, here, timeout=0.01))


@pytest.mark.slow
def test_page_and_figure_from_the_table_alone(measured: Table, tmp_path: Path) -> None:
    table = run_bench(
        Setting(quick=True), ["scaling"], budget=0.01, memory=False, command="bench --quick"
    )
    assert len(table.meta["exponents"]) == 5
    fields = table[table["row"] == "scaling: forward, field"]
    assert list(fields["size"]) == [12, 24, 48]
    power = np.polyfit(np.log(fields["size"]), np.log(fields["seconds"]), 1)[0]
    assert table.meta["exponents"]["scaling: forward, field"] == round(float(power), 2)
    *works, rates = table.meta["limits"]
    for limit in works:
        single = limit["what"] in ("multi-fidelity forward", "Jacobian")
        rate = rates["float32" if single else "float64"]
        assert limit["products_s"] == pytest.approx(1e9 * limit["gflop"] / rate)
        # The products of a fit's step are counted alone.
        names = ("products_s", "bytes_s", "cosines_s")[: 1 if "step" in limit["what"] else 3]
        assert limit["limit"] == pytest.approx(sum(limit[name] for name in names))
    written = write_table(table, tmp_path / "results")
    assert main(["--page", str(written), "-o", str(tmp_path)]) == 0
    text = (tmp_path / "performance.md").read_text(encoding="utf-8")
    assert "## Scaling" in text
    assert "nothing was measured on a GPU" in text
    assert "![Error against time](results/performance.png)" in text

    path = write_page(write_table(measured, tmp_path), tmp_path)
    text = path.read_text(encoding="utf-8")
    assert "| this package, 128 | float64, eager |" in text
    assert "not measured: no data directory" in text


@pytest.mark.slow
def test_the_figure_shows_every_measured_case_at_its_place(measured: Table) -> None:
    figure = draw(measured)
    for ax, row in zip(figure.axes, ("forward", "forward + backward"), strict=True):
        shown = sorted(
            (float(one.get_xdata()[0]), float(one.get_ydata()[0]))
            for one in ax.lines
            if one.get_marker() == "o" and len(one.get_xdata())
        )
        cases = measured[(measured["row"] == row) & np.isfinite(measured["seconds"])]
        assert shown == sorted(zip(cases["seconds"], cases["error"], strict=True))
        assert ax.get_title(loc="left").lower() == row
        labels = {text.get_text() for text in ax.texts}
        assert {"this package, 128", "the paper's recipe"} <= labels


def test_targets_are_judged_by_ratio_and_error() -> None:
    facts = {"precision": "float64", "sigma": math.nan}
    table = Table(
        [
            {"row": "contrast curve", "column": "this package, 20 x 6 positions",
             "seconds": 1.0, "error": 0.01, **facts},
            {"row": "contrast curve", "column": "120 injections, each refined again",
             "seconds": 60.0, "error": 0.0, **facts},
        ]
    )  # fmt: skip
    judged = {words: met for words, *_, met in targets(table)}
    assert judged.pop(next(words for words in judged if words.startswith("contrast"))) == "yes"
    assert set(judged.values()) == {""}
    table["error"][0] = 0.06
    assert targets(table)[-1][-1] == "no"


@pytest.mark.slow
def test_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--rows", "nothing", "-o", str(tmp_path)]) == 1
    assert "expected some of 'forward'" in capsys.readouterr().err
    options = ["--quick", "--no-memory", "--rows", "forward + backward", "-o", str(tmp_path)]
    assert main(options) == 0
    assert {path.name for path in tmp_path.iterdir()} == {"performance.ecsv", "performance.png"}
    table = Table.read(tmp_path / "performance.ecsv", format="ascii.ecsv")
    command = "python -m benchmarks.speed --quick --rows 'forward + backward'"
    assert table.meta["command"] == command
    assert f"by `{command}`" in page(table)


def test_a_gpu_that_is_not_there_is_a_usage_error(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(SystemExit) as ended:
        main(["--device", "cuda"])
    assert ended.value.code == 2
    assert "finds no GPU" in capsys.readouterr().err


@pytest.mark.slow
def test_it_runs_as_a_script(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.speed", "--help"],
        cwd=ROOT,
        env={k: v for k, v in os.environ.items() if k != "PYTHONSAFEPATH"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "--quick" in done.stdout


# -- operations ------------------------------------------------------------------------------------


def test_operations_and_bytes_are_counted() -> None:
    """A product, a transform and a choice of rows, of which the table is not read."""
    left, right = torch.ones(4, 6), torch.ones(6, 5)
    waves, rows = torch.ones(8, 8, dtype=torch.complex64), torch.tensor([0, 1])
    product = operations.counted(lambda: left @ right)
    assert (product.kernels, product.operations) == (1, 2 * 4 * 6 * 5)
    assert product.bytes == 4 * (4 * 6 + 6 * 5 + 4 * 5)
    assert product.seconds == operations.START
    assert operations.counted(lambda: torch.fft.fft2(waves)).operations == 5 * 64 * 6
    assert operations.counted(lambda: left[rows]).bytes == 2 * 4 * 12
    assert operations.counted(lambda: left.T[1:]).kernels == 0
