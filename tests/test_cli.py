"""The command line: what it writes, where errors go, and that it starts quickly."""

from __future__ import annotations

import json
import logging
import os
import re
import shutil
import subprocess
import sys
import tomllib
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from astropy.io import fits
from astropy.time import Time
from synthetic_searches import searched, write_searched

from benchmarks.calints_files import calints
from pyklip_diffrender import __version__
from pyklip_diffrender.cli import application, main
from pyklip_diffrender.cli.reducing import describe_plan, steps_of
from pyklip_diffrender.cli.session import read_config
from pyklip_diffrender.errors import DiffrenderWarning, MissingOPDError, RefinementError
from pyklip_diffrender.instrument.nircam import nircam_coronagraph
from pyklip_diffrender.io.files import open_fits
from pyklip_diffrender.reduction import UNFINISHED, Preparation, ReduceOptions
from pyklip_diffrender.scene.sequence import Sequence
from pyklip_diffrender.wavefront.opd import RULES, OPDMap, random_opd, resample

# The package has the command under the name of its module.
doctor = import_module("pyklip_diffrender.cli.application")

PYTHON = re.compile(r"\w=|\bu\.\w|np\.|\w\(\)|[a-z]_[a-z]+:|=\.\.\.|\ba[n]? [A-Z][a-z]+[A-Z]")
"""Signs of Python in a message."""

ROOT = Path(__file__).resolve().parents[1]

WAVELENGTH = ["--monochromatic", "4.5e-6"]


@lru_cache(maxsize=1)
def wavefront() -> np.ndarray:
    """A wavefront, nm."""
    return random_opd(3, npix=128).data * 1e9


def opd_file(path: Path, unit: str | None = "nm") -> Path:
    hdu = fits.PrimaryHDU(wavefront())
    if unit:
        hdu.header["BUNIT"] = unit
    hdu.writeto(path)
    return path


def test_help_names_the_commands(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--help"]) == 0
    shown = capsys.readouterr().out
    for command in ("demo", "reduce", "detect", "psf", "doctor"):
        assert command in shown


def test_threads_sleep_while_they_wait(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_WAIT_POLICY", "active")
    assert main(["--version"]) == 0
    assert os.environ["OMP_WAIT_POLICY"] == "active"
    monkeypatch.delenv("OMP_WAIT_POLICY")
    assert main(["--version"]) == 0
    assert os.environ["OMP_WAIT_POLICY"] == "passive"


@pytest.mark.parametrize("command", ["demo", "reduce", "detect", "psf"])
def test_help_of_a_command_has_sections_and_examples(
    capsys: pytest.CaptureFixture[str], command: str
) -> None:
    assert main([command, "-h"]) == 0
    shown = capsys.readouterr().out
    assert shown.index("\nOutput:") < shown.index("\nGeneral:")
    assert f"  pyklip-diffrender {command}" in shown.partition("Examples:")[2]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "Commands:"),
        (["fit"], "No such command 'fit'"),
        (["reduce", "-o", "x", "--opd", "y"], "Missing argument 'FRAMES...'"),
        (["detect", "x", "--opd", "y"], "Missing option '-o'"),
        (["detect", "x", "-o", "y"], "Missing option '--opd'"),
        (["detect", "x", "-o", "y", "--opd", "z", "--opd-date", "closest"], "nearest"),
        (["detect", "x", "-o", "y", "--opd", "z", "--threshold", "-3"], "--threshold: got -3"),
        (["detect", "x", "-o", "y", "--opd", "z", "--star-flux", "9 parsec"], "--star-flux: got"),
        (["detect", "x", "-o", "y", "--opd", "z", "--star-flux-error", "20"], "20 % are 0.2"),
        (["detect", "x", "-o", "y", "--opd", "z", "--memory", "2 lightyears"], "--memory: got"),
        (["reduce", "x", "-o", "y", "--opd", "z", "--star", "12"], "'12', expected x,y"),
        (["detect", "x", "-o", "y", "--opd", "z", "--disk", "--wide"], "--wide, --disk: got both"),
        (["detect", "x", "-o", "y", "--opd", "z", "--systematics", "no.fits"], "--systematics"),
        (["detect", "x", "-o", "y", "--opd", "z", "--opd-folder", "x"], "--opd-folder"),
        (["detect", "x", "-o", "y", "--opd", "z", "--dry-run", "--json"], "--dry-run has no"),
        (["psf", "-o", "x.fits", "--threads", "0"], "--threads"),
        (["psf", "-o", "x.fits", "--size", "0"], "--size"),
        (["demo", "--hours", "-1"], "--hours"),
        (["demo", "--contrast", "-1"], "--contrast"),
        (["demo", "--separation", "9"], "--separation"),
    ],
)
def test_wrong_options_are_usage_errors(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    words: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    shown = capsys.readouterr()
    assert words in shown.err
    assert not PYTHON.search(shown.err)
    assert shown.out == ""
    assert list(tmp_path.iterdir()) == []


def test_help_does_not_wait_for_torch() -> None:
    program = (
        "import sys, pyklip_diffrender.cli as cli\n"
        "cli.main(['--help'])\n"
        "heavy = {'torch', 'numpy', 'pyklip', 'matplotlib', 'poppy'} & set(sys.modules)\n"
        "sys.exit(f'imported {heavy}' if heavy else 0)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )
    assert done.returncode == 0, done.stderr


def test_psf_writes_the_image_of_the_model(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "star.fits"
    opd = opd_file(tmp_path / "opd.fits")
    arguments = ["psf", "-o", str(path), *WAVELENGTH, "--size", "20", "--opd", str(opd)]
    assert main([*arguments, "--offset", "0.02", "-0.3"]) == 0
    assert str(path) in capsys.readouterr().out
    with open_fits(path) as hdus:
        image, header = hdus[0].data, hdus[0].header
    assert (header["FILTER"], header["CORONMSK"], header["PUPIL"]) == (
        "F444W", "MASK335R", "MASKRND",
    )  # fmt: skip
    assert (header["STAROFFX"], header["STAROFFY"]) == (0.02, -0.3)
    assert header["PUPILOPD"] == "opd.fits"
    assert header["WAVELEN"] == 4.5e-6
    assert header["PIXELSCL"] == pytest.approx(0.062424185)
    model = nircam_coronagraph("F444W", monochromatic=4.5e-6, fov_pixels=20)
    map_ = resample(random_opd(3, npix=128).data, 1024)
    with torch.no_grad():
        expected = model(map_, (0.02, -0.3)).numpy()
    np.testing.assert_allclose(image, expected, rtol=1e-9)
    # The star is below the middle, as asked for.
    assert np.unravel_index(image.argmax(), image.shape)[0] < 9
    assert not np.allclose(image, expected[::-1], rtol=0.1)


@pytest.mark.parametrize(
    ("extra", "words"),
    [
        (["--filter", "F090W"], ["F090W", "F200W", "F444W"]),
        (["--monochromatic", "4.5"], ["--monochromatic: 4.5", "metres"]),
        (["--mask", "MASK9"], ["--mask: got 'MASK9'", "MASK335R"]),
        (["--offset", "nan", "0"], ["--offset: got nan 0", "inside the image"]),
        (["--offset", "0", "2.6"], ["--offset: got 0 2.6", "--size"]),
        (["--opd", "nowhere.fits"], ["nowhere.fits", "no such file"]),
    ],
    ids=["filter", "wavelength", "mask", "nan", "outside", "file"],
)
def test_errors_go_to_stderr_and_nothing_is_written(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    extra: list[str],
    words: list[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["psf", "-o", "star.fits", *extra]) == 1
    shown = capsys.readouterr()
    assert shown.out == ""
    assert shown.err.startswith("pyklip-diffrender: ")
    assert "Traceback" not in shown.err
    assert not PYTHON.search(shown.err)
    for word in words:
        assert word in shown.err
    assert list(tmp_path.iterdir()) == []


def test_a_map_without_a_unit_is_an_error(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    opd = opd_file(tmp_path / "opd.fits", unit=None)
    product = tmp_path / "star.fits"
    assert main(["psf", "-o", str(product), *WAVELENGTH, "--opd", str(opd)]) == 1
    assert "opd.fits: the header has no BUNIT" in capsys.readouterr().err
    assert not product.exists()


@pytest.mark.parametrize("percent", [0, 50])
def test_detect_in_a_broken_file_leaves_no_product(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], percent: int
) -> None:
    frames, products = tmp_path / "calints.fits", tmp_path / "products"
    if percent:
        fits.HDUList([fits.PrimaryHDU(), fits.ImageHDU(np.ones((2, 90, 90)), name="SCI")]).writeto(
            frames
        )
        whole = frames.read_bytes()
        frames.write_bytes(whole[: len(whole) * percent // 100])
    opd = opd_file(tmp_path / "opd.fits")
    assert main(["detect", str(frames), "--opd", str(opd), "-o", str(products)]) == 1
    assert "calints.fits" in capsys.readouterr().err
    assert not products.exists()


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"pyklip-diffrender {__version__}\n"


# -- outputs that are there already --------------------------------------------------------------


def test_an_image_is_replaced_only_when_told_to(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "star.fits"
    path.write_text("mine")
    arguments = ["psf", "-o", str(path), *WAVELENGTH, "--size", "8"]
    assert main(arguments) == 1
    shown = capsys.readouterr().err
    assert str(path) in shown
    assert "--overwrite" in shown
    assert path.read_text() == "mine"
    assert main([*arguments, "--overwrite"]) == 0
    with open_fits(path) as hdus:
        assert hdus[0].data.shape == (8, 8)


@pytest.mark.parametrize(
    ("command", "product"),
    [("demo", "demo.fits"), ("reduce", "detection.fits"), ("detect", "detection.fits")],
)
def test_products_are_refused_before_any_work(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], command: str, product: str
) -> None:
    """The frames do not exist: had they been opened first, the message would be theirs."""
    arguments = [command, "-o", str(tmp_path)]
    if command != "demo":
        arguments += ["nowhere.fits", "--opd", "nowhere_else.fits"]
    path = tmp_path / product
    path.write_text("mine")
    assert main(arguments) == 1
    shown = capsys.readouterr().err
    assert str(path) in shown
    assert "--overwrite" in shown
    if command != "demo":
        assert main([*arguments, "--overwrite"]) == 1
        assert "nowhere.fits" in capsys.readouterr().err
    assert path.read_text() == "mine"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("extra", [[], ["--overwrite"]], ids=["plain", "overwrite"])
def test_an_output_that_is_a_file_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], extra: list[str]
) -> None:
    path = tmp_path / "products"
    path.write_text("mine")
    assert main(["reduce", "nowhere.fits", "--opd", "nowhere.fits", "-o", str(path), *extra]) == 1
    assert f"{path} is a file, expected a folder" in capsys.readouterr().err
    assert path.read_text() == "mine"


# -- sequences -----------------------------------------------------------------------------------


def calints_file(path: Path, star: str, reference: bool) -> Path:
    rng = np.random.default_rng(1)
    data = rng.normal(10, 2, (2, 8, 10)).astype(np.float32)
    primary = fits.PrimaryHDU()
    primary.header.update(
        {
            "FILTER": "F444W",
            "TARGPROP": star,
            "IS_PSF": reference,
            "DATE-BEG": "2022-07-30T02:03:04",
        }
    )
    hdus = fits.HDUList([primary])
    planes = {"SCI": data, "ERR": np.ones_like(data), "DQ": np.zeros(data.shape, dtype=np.uint32)}
    for name, array in planes.items():
        hdus.append(fits.ImageHDU(array, name=name))
    hdus["SCI"].header.update(
        {
            "BUNIT": "MJy/sr", "PIXAR_A2": 0.00396, "CRPIX1": 6.0, "CRPIX2": 5.0,
            "ROLL_REF": 100.0, "V3I_YANG": -0.5, "VPARITY": -1,
        }
    )  # fmt: skip
    hdus.writeto(path)
    return path


@pytest.fixture
def frames(tmp_path: Path) -> Path:
    """A folder with frames of a target and of a reference star, and an empty file."""
    folder = tmp_path / "frames"
    folder.mkdir()
    calints_file(folder / "one_calints.fits", "HIP-1", reference=False)
    calints_file(folder / "two_calints.fits", "HIP-2", reference=True)
    (folder / "three_calints.fits").write_bytes(b"")
    return folder


@pytest.fixture
def maps(tmp_path: Path) -> Path:
    """A folder of wavefront maps from before and after the frames."""
    folder = tmp_path / "maps"
    folder.mkdir()
    opd_file(folder / "opd_2022-07-20.fits")
    opd_file(folder / "opd_2022-07-31.fits")
    return folder


def test_a_dry_run_lists_frames_map_and_steps_and_writes_nothing(
    tmp_path: Path, frames: Path, maps: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    products = tmp_path / "products"
    arguments = ["reduce", str(frames), "--opd", str(maps), "-o", str(products)]
    arguments += ["--dry-run", "--size", "8"]
    assert main(arguments) == 0
    lines = capsys.readouterr().out.splitlines()
    target, reference = (
        next(line for line in lines if name in line) for name in ("one_calints", "two_calints")
    )
    assert target.split()[:2] == ["target", "HIP-1"]
    assert reference.split()[:2] == ["reference", "HIP-2"]
    assert any(line.startswith("left out: three_calints.fits: ") for line in lines)
    sensed = "opd_2022-07-31.fits, sensed 2022-07-31T00:00, 0.9 days after the frames"
    assert f"wavefront map: {sensed}" in lines
    steps = [line for line in lines if line[:3] in ("1. ", "2. ", "3. ", "4. ")]
    assert ["wavefront" in steps[0], "star" in steps[1], "search" in steps[2]] == [True] * 3
    assert "GB of memory" in lines[-1]
    assert not products.exists()
    # Which is which follows from the option, too.
    assert main([*arguments, "--target", "HIP-2"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert next(x for x in lines if "two_calints" in x).split()[:2] == ["target", "HIP-2"]
    assert main([*arguments, "--target", "HIP-3"]) == 1
    assert "HIP-3" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--star-flux", "0.4 Jy"], "--star-flux: one_calints.fits is not calibrated"),
        (["--opd", "flat", "--opd-date", "before"], "--opd-date is for --opd FOLDER"),
        (["--size", "9"], "Choose a smaller --size"),
        (["--opd", "nowhere.fits"], "nowhere.fits: no such file"),
        (["--filter", "F356W"], "--filter: got 'F356W'"),
    ],
)
def test_a_dry_run_refuses_what_the_run_would_refuse(
    tmp_path: Path,
    frames: Path,
    maps: Path,
    reduced: Reduced,
    capsys: pytest.CaptureFixture[str],
    options: list[str],
    words: str,
) -> None:
    arguments = ["reduce", str(frames), "--opd", str(maps), "-o", str(tmp_path / "products")]
    arguments += ["--size", "8", *options]
    answers = []
    for dry in ([], ["--dry-run"]):
        assert main([*arguments, *dry]) != 0
        answers.append(capsys.readouterr().err)
    assert answers[0] == answers[1]
    assert words in answers[0]
    assert not PYTHON.search(answers[0])
    assert reduced == []
    assert not (tmp_path / "products").exists()


def test_a_full_disk_is_noticed_before_the_work(
    tmp_path: Path,
    frames: Path,
    maps: Path,
    reduced: Reduced,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    usage = SimpleNamespace(total=1e9, used=1e9 - 1e5, free=1e5)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage)
    arguments = ["reduce", str(frames), "--opd", str(maps), "-o", str(tmp_path / "products")]
    assert main([*arguments, "--size", "8"]) == 1
    assert "has 0 MB of room, expected at least" in capsys.readouterr().err
    assert reduced == []


def test_an_interrupted_reduction_is_resumed_and_a_finished_one_is_kept(
    tmp_path: Path,
    frames: Path,
    maps: Path,
    reduced: Reduced,
    capsys: pytest.CaptureFixture[str],
) -> None:
    products = tmp_path / "products"
    arguments = ["reduce", str(frames), "--opd", str(maps), "-o", str(products), "--size", "8"]
    products.mkdir()
    (products / UNFINISHED).write_text("{}")
    reduced.error = KeyboardInterrupt()
    assert main([*arguments, "--resume"]) == 130
    assert "--resume" in capsys.readouterr().err
    reduced.error = None
    # Without the option, nothing is replaced.
    assert main(arguments) == 1
    assert UNFINISHED in capsys.readouterr().err
    assert main([*arguments, "--resume", "--quick"]) == 0
    assert reduced[0].given.options.accuracy == "quick"
    (products / UNFINISHED).unlink()
    assert main([*arguments, "--resume"]) == 0
    assert "this reduction has finished" in capsys.readouterr().out
    assert len(reduced) == 1
    assert main([*arguments, "--resume", "--overwrite"]) == 2
    assert "--resume keeps products" in capsys.readouterr().err


def two_filters(folder: Path) -> Path:
    """A folder with a frame of one star in each of two filters."""
    frames = folder / "frames"
    frames.mkdir()
    for name in ("F356W", "F444W"):
        path = frames / f"{name}_calints.fits"
        calints_file(path, "HIP-1", reference=False)
        fits.setval(path, "FILTER", value=name)
    return frames


def test_spectra_that_do_not_cover_a_filter_are_an_error_before_any_fit(
    tmp_path: Path, maps: Path, reduced: Reduced, capsys: pytest.CaptureFixture[str]
) -> None:
    table = tmp_path / "short.txt"
    table.write_text("# micron Y\n3.0 1\n3.5 2\n4.1 3\n", encoding="utf-8")
    arguments = ["reduce", str(two_filters(tmp_path)), "--opd", str(maps), "--size", "8"]
    arguments += ["-o", str(tmp_path / "products"), "--spectra", str(table)]
    assert main(arguments) == 1
    assert re.search(r"Y: .* F444W needs", capsys.readouterr().err)
    assert reduced == []


def test_a_resumed_command_keeps_reductions_and_searches_them_together_again(
    tmp_path: Path, maps: Path, reduced: Reduced, capsys: pytest.CaptureFixture[str]
) -> None:
    """Two filters, of which one had finished before the interruption."""
    frames, products = two_filters(tmp_path), tmp_path / "products"
    place = (0.6, 0.35)
    made = {
        "F356W": searched("F356W", 2, [(*place, 4.0)]),
        "F444W": searched("F444W", 1, [(*place, 4.2)], north=20.0),
    }
    arguments = ["reduce", str(frames), "--opd", str(maps), "-o", str(products), "--size", "8"]
    write_searched(made["F356W"], products / "F356W")
    reduced.error = KeyboardInterrupt()
    assert main([*arguments, "--resume"]) == 130
    assert not (products / "combined.fits").exists()
    reduced.error = None
    before = (products / "F356W" / "detection.fits").stat().st_mtime_ns
    reduced.writes = lambda folder: write_searched(made[folder.name], folder)
    assert main([*arguments, "--resume"]) == 0
    shown = capsys.readouterr().out
    assert f"{products / 'F356W'}: this reduction has finished" in shown
    assert "combined search of 2 reductions: 1 candidate" in shown
    assert (products / "F356W" / "detection.fits").stat().st_mtime_ns == before
    assert len(reduced) == 1
    # With nothing left to reduce, the search is made again: now with one spectrum.
    assert main([*arguments, "--resume", "--spectra", "flat"]) == 0
    assert len(reduced) == 1
    assert fits.getdata(products / "combined.fits", "SNR").shape[0] == 1
    content = json.loads((products / "comparison.json").read_text(encoding="utf-8"))
    assert [each["name"] for each in content["combined"]["spectra"]] == ["flat"]


def test_frames_without_a_map_start_from_a_flat_wavefront(
    tmp_path: Path, frames: Path, reduced: Reduced, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["reduce", str(frames), "--opd", "flat", "-o", str(tmp_path / "products")]
    assert main([*arguments, "--size", "8"]) == 0
    assert "wavefront map: flat wavefront\n" in capsys.readouterr().out
    (call,) = reduced
    assert not call.given.wavefront.data.any()


def test_an_estimate_counts_the_fits_that_are_made(frames: Path) -> None:
    def steps(sequence: Sequence, **options: Any) -> dict[str, float]:
        return dict(steps_of(sequence, ReduceOptions(size=8, **options)))

    sequence = Sequence.from_files(frames).cutout(8)
    names = list(steps(sequence))
    assert names == ["wavefront", "reference stars and target together", "search", "products"]
    for_pattern = steps(sequence, references="pattern")
    assert list(for_pattern) == ["reference star HIP-2", "wavefront", "search", "products"]
    alone = steps(replace(sequence, references=()))
    assert len(alone) == len(names) - 1
    twice = replace(sequence, science=sequence.science * 2)
    both = steps(twice, systematics="off", references="off")
    assert both["search"] == 2 * alone["search"]
    one, two = alone["wavefront"], both["wavefront"]
    assert one < two < 2 * one
    more = steps(twice, systematics="off", disk=True, references="off")
    assert more.items() > both.items()
    assert more["search without extended light"] == more["search"]
    assert more["extended light, and wavefront without it"] > one
    eight = steps(twice, systematics="off", injections=8, references="off")
    assert eight["8 injected planets"] == 2 * (both["wavefront"] + both["search"])
    both_kinds = steps(twice, systematics="off", injections=8, disk=True)
    longer = both_kinds["8 injected planets"] - eight["8 injected planets"]
    assert longer == pytest.approx(2 * more["extended light, and wavefront without it"])
    tied = steps(twice, systematics="off", star_flux=0.4)
    assert tied["wavefront"] == pytest.approx(1.6 * two)
    whole = steps(twice, systematics="off", wide=True)
    assert whole["whole frames"] > 0
    quick = steps(twice, systematics="off", accuracy="quick")
    assert quick["wavefront"] < both["wavefront"]


# -- a reduction, with a stub in the place of the fit --------------------------------------------


SUMMARY = {
    "sentence": "One companion.",
    "status": {
        "name": "MODEL_MISMATCH", "message": "converged, but", "advice": "Use disk=True (--disk).",
    },
}  # fmt: skip


@dataclass
class StubReduction:
    """Writes what a reduction writes, as far as the command line reads it."""

    given: Preparation
    progress: bool
    interrupted: bool
    writes: Callable[[Path], None] | None = None

    def write(self, folder: Path, **_: Any) -> list[Path]:
        folder.mkdir(exist_ok=True)
        path = folder / "summary.json"
        if self.writes is not None:
            self.writes(folder)
            return [folder / "report.html", path]
        path.write_text(json.dumps(SUMMARY))
        if self.interrupted:
            raise KeyboardInterrupt
        return [folder / "report.html", path]


class Reduced(list[StubReduction]):
    """What fits and searches were given, and how they end."""

    error: BaseException | None = None
    interrupted_writing = False
    writes: Callable[[Path], None] | None = None


@pytest.fixture
def reduced(monkeypatch: pytest.MonkeyPatch) -> Reduced:
    """Stub for the fits and searches."""
    made = Reduced()

    def stub(given: Preparation, *, progress: bool, products: Any) -> StubReduction:
        print("a library says hello")
        if isinstance(made.error, RefinementError):
            for _ in range(2):
                warnings.warn("the map is old", DiffrenderWarning, stacklevel=1)
        if made.error is not None:
            raise made.error
        made.append(StubReduction(given, progress, made.interrupted_writing, made.writes))
        return made[-1]

    monkeypatch.setattr(Preparation, "run", stub)
    return made


def test_reduce_passes_its_options_on_and_names_the_products(
    tmp_path: Path,
    frames: Path,
    maps: Path,
    reduced: Reduced,
    capsys: pytest.CaptureFixture[str],
) -> None:
    products = tmp_path / "products"
    arguments = ["reduce", str(frames), "--opd", str(maps), "--opd-date", "before"]
    arguments += ["-o", str(products), "--size", "8", "--threshold", "4", "--systematics", "off"]
    arguments += ["--memory", "2 GB", "--injections", "7", "--star-flux-error", "0.1"]
    assert main(arguments) == 0
    shown = capsys.readouterr()
    # Names of the command line, and the page to open.
    assert "One companion.\nMODEL_MISMATCH: converged, but.\nUse --disk.\n" in shown.out
    assert f"wrote {products / 'report.html'} and 1 more files\n" in shown.out
    (call,) = reduced
    assert call.given.wavefront.name == "opd_2022-07-20.fits"
    assert call.given.options == ReduceOptions(
        size=8, threshold=4.0, systematics="off", memory="2 GB", injections=7, star_flux_error=0.1
    )
    # Not on a terminal: no bar, but the stages.
    assert call.progress is False
    assert "1. products" in shown.err


def test_overwriting_leaves_no_products_of_other_epochs(
    tmp_path: Path, frames: Path, reduced: Reduced
) -> None:
    products = tmp_path / "products"
    for day in ("2022-01-02", "2022-07-30"):
        (products / day).mkdir(parents=True)
        (products / day / "report.html").write_text("earlier")
    (products / "2022-01-02" / "notes.txt").write_text("mine")
    (products / "other").mkdir()
    (products / "other" / "report.html").write_text("mine")
    listed = [{"folder": name} for name in ("2022-01-02", "2022-07-30", "../../frames")]
    (products / "comparison.json").write_text(json.dumps({"reductions": listed}))
    (products / "comparison.html").write_text("earlier")
    arguments = ["reduce", str(frames), "--opd", "flat", "-o", str(products), "--size", "8"]
    assert main(arguments) == 1
    assert main([*arguments, "--overwrite"]) == 0
    left = {str(path.relative_to(products)) for path in products.rglob("*") if path.is_file()}
    assert left == {"summary.json", "2022-01-02/notes.txt", "other/report.html"}
    assert not (products / "2022-07-30").exists()
    assert len(list(frames.iterdir())) == 3


def test_a_spectrum_says_how_bright_the_star_is(
    tmp_path: Path,
    frames: Path,
    maps: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    spectrum = tmp_path / "star.txt"
    spectrum.write_text("2.0 0.4\n4.0 0.4\n6.0 0.4\n")
    arguments = ["reduce", str(frames), "--opd", str(maps), "-o", str(tmp_path / "products")]
    arguments += ["--size", "8", "--star-sed", str(spectrum)]
    # These frames have no calibration, so that it goes no further.
    assert main(arguments) == 1
    shown = capsys.readouterr()
    assert "star: 0.4 Jy in F444W, by star.txt" in shown.out
    assert "--star-flux: one_calints.fits is not calibrated" in shown.err
    assert main([*arguments, "--star-flux", "0.4 Jy"]) == 2
    assert "both say how bright the star is" in capsys.readouterr().err


def test_json_is_all_that_goes_to_standard_output(
    tmp_path: Path,
    frames: Path,
    maps: Path,
    reduced: Reduced,
    capsys: pytest.CaptureFixture[str],
) -> None:
    arguments = ["detect", str(frames / "one_calints.fits"), "--opd", str(maps / "x.fits")]
    arguments[-1] = str(maps / "opd_2022-07-31.fits")
    assert main([*arguments, "-o", str(tmp_path / "products"), "--size", "8", "--json"]) == 0
    shown = capsys.readouterr()
    assert json.loads(shown.out) == SUMMARY
    assert "a library says hello" in shown.err
    assert "One companion." in shown.err


@pytest.mark.parametrize("before", [True, False])
def test_general_options_stand_before_or_after_the_command(
    tmp_path: Path,
    frames: Path,
    maps: Path,
    reduced: Reduced,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    before: bool,
) -> None:
    threads: list[int] = []
    monkeypatch.setattr(torch, "set_num_threads", threads.append)
    log = tmp_path / "logs" / "run.log"
    general = ["-q", "--threads", "1", "--log-file", str(log)]
    command = ["detect", str(frames / "one_calints.fits"), "--opd", str(maps)]
    command += ["-o", str(tmp_path / "products"), "--size", "8"]
    assert main([*general, *command] if before else [*command, *general]) == 0
    assert threads == [1]
    assert capsys.readouterr().err == ""
    lines = log.read_text().splitlines()
    assert any("INFO 1. products" in line for line in lines)
    assert any("opd_2022-07-31.fits" in line for line in lines)
    # What the run changed is as it was.
    assert not any(getattr(h, "baseFilename", "") == str(log) for h in logging.root.handlers)


def test_warnings_and_errors_are_messages(
    tmp_path: Path,
    frames: Path,
    reduced: Reduced,
    capsys: pytest.CaptureFixture[str],
) -> None:
    old = opd_file(tmp_path / "opd_2020-01-01.fits")
    maps = tmp_path / "old"
    maps.mkdir()
    old.rename(maps / old.name)
    arguments = ["detect", str(frames / "one_calints.fits"), "--opd", str(maps)]
    arguments += ["-o", str(tmp_path / "products"), "-q", "--size", "8"]
    reduced.error = RefinementError("no fit")
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        assert main(arguments) == 1
    lines = capsys.readouterr().err.splitlines()
    assert "sensed 941 days before the frames" in lines[0]
    assert lines[1:] == ["pyklip-diffrender: warning: the map is old", "pyklip-diffrender: no fit"]


@pytest.mark.parametrize(
    "error",
    [MemoryError("8 GB"), RuntimeError("DefaultCPUAllocator: can't allocate memory: 8 GB")],
    ids=["python", "torch"],
)
def test_too_little_memory_is_a_message(
    tmp_path: Path,
    frames: Path,
    maps: Path,
    capsys: pytest.CaptureFixture[str],
    reduced: Reduced,
    error: Exception,
) -> None:
    reduced.error = error
    arguments = ["detect", str(frames / "one_calints.fits"), "--opd", str(maps)]
    arguments += ["-o", str(tmp_path / "products"), "--size", "8"]
    assert main(arguments) == 1
    assert "pyklip-diffrender: not enough memory; a smaller --size" in capsys.readouterr().err
    # Any other error is a fault of the program, with its traceback.
    reduced.error = RuntimeError("a bug")
    with pytest.raises(RuntimeError, match="a bug"):
        main(arguments)


def test_impossible_arguments_are_messages(
    tmp_path: Path, frames: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    products = ["-o", str(tmp_path / "products")]
    assert main(["detect", str(frames), "--opd", "nowhere.fits", *products]) == 1
    assert "is a folder, expected a file; the command reduce" in capsys.readouterr().err


def test_an_interrupted_run_says_what_it_left(
    tmp_path: Path,
    frames: Path,
    maps: Path,
    reduced: Reduced,
    capsys: pytest.CaptureFixture[str],
) -> None:
    products = tmp_path / "products"
    products.mkdir()
    (products / "notes.txt").write_text("mine")
    arguments = ["detect", str(frames / "one_calints.fits"), "--opd", str(maps), "-q"]
    arguments += ["-o", str(products), "--size", "8"]
    reduced.interrupted_writing = True
    assert main(arguments) == 130
    assert f"interrupted; these files in {products} are new and complete: summary.json\n" in (
        capsys.readouterr().err
    )
    reduced.error = KeyboardInterrupt()
    assert main([*arguments, "--overwrite"]) == 130
    assert capsys.readouterr().err.strip() == "pyklip-diffrender: interrupted; nothing was written"


def test_mast_is_asked_for_the_map_of_the_date(
    tmp_path: Path,
    frames: Path,
    reduced: Reduced,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked: list[tuple[str, str]] = []

    def retrieve(date: Time, choice: str) -> OPDMap:
        asked.append((date.isot[:19], choice))
        if choice == "after":
            raise MissingOPDError("no wavefront map from MAST (no route to host)")
        return random_opd(1, npix=64)

    monkeypatch.setattr("pyklip_diffrender.cli.reducing.load_wss_opd_by_date", retrieve)
    arguments = ["detect", str(frames / "one_calints.fits"), "-o", str(tmp_path / "products")]
    arguments += ["--size", "8", "--opd", "mast"]
    assert main(arguments) == 0
    assert reduced[0].given.wavefront.name == "random_opd(seed=1)"
    capsys.readouterr()
    assert main([*arguments, "--opd-date", "after", "--overwrite"]) == 1
    assert "no route to host" in capsys.readouterr().err
    assert asked == [("2022-07-30T02:03:04", "nearest"), ("2022-07-30T02:03:04", "after")]


@pytest.mark.parametrize(
    ("path", "words"),
    [("nowhere/star.fits", "there is no folder"), (".", "is a folder, expected a file")],
)
def test_an_image_goes_into_a_folder_that_exists(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], path: str, words: str
) -> None:
    assert main(["psf", "-o", str(tmp_path / path)]) == 1
    assert words in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_a_folder_without_permission_is_refused_before_the_work(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path) != tmp_path)
    assert main(["demo", "-o", str(tmp_path / "products" / "deep")]) == 1
    assert f"no permission in {tmp_path}\n" in capsys.readouterr().err


def test_a_device_that_is_not_there_is_an_error(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "star.fits"
    assert main(["psf", "-o", str(path), "--device", "abacus"]) == 1
    assert "--device: PyTorch" in capsys.readouterr().err
    assert not path.exists()


# -- configuration files -------------------------------------------------------------------------


def test_a_written_configuration_gives_the_same_run(
    tmp_path: Path,
    frames: Path,
    maps: Path,
    reduced: Reduced,
    capsys: pytest.CaptureFixture[str],
) -> None:
    config, products = tmp_path / "run.toml", tmp_path / "products"
    arguments = ["reduce", str(frames), "--opd", str(maps), "-o", str(products), "-q"]
    arguments += ["--size", "8", "--target", "HIP-1", "--star", "5.2,3.5"]
    assert main([*arguments, "--write-config", str(config)]) == 0
    assert capsys.readouterr().out == f"wrote {config}\n"
    assert reduced == []
    content = tomllib.loads(config.read_text())["reduce"]
    assert content["frames"] == [str(frames)]
    assert content["opd"] == str(maps)
    assert content["quiet"] is True
    assert content["json"] is False
    assert main(["reduce", "--config", str(config)]) == 0
    assert main(["--config", str(config), "reduce", "--threshold", "6", "--overwrite"]) == 0
    assert [call.given.options.threshold for call in reduced] == [5, 6]
    assert reduced[0].given.sequence.target == "HIP-1"
    np.testing.assert_allclose(reduced[0].given.whole.science[0].center[0], (5.2, 3.5))
    assert capsys.readouterr().err == ""
    # It is a product like others.
    assert main([*arguments, "--write-config", str(config)]) == 2
    assert "--overwrite" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("[psf]\nsise = 20\n", "[psf] has 'sise'"),
        ("sise = 20\n", "has 'sise'"),
        ("[psf\n", "run.toml: Expected"),
        ("[psf]\nsize = 'large'\n", "'size' in {config}: 'large' is not a valid int"),
        (None, "No such file"),
    ],
)
def test_a_wrong_configuration_is_a_usage_error(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], content: str | None, words: str
) -> None:
    config, star = tmp_path / "run.toml", tmp_path / "star.fits"
    if content is not None:
        config.write_text(content)
    assert main(["psf", "-o", str(star), "--config", str(config)]) == 2
    assert words.format(config=config) in capsys.readouterr().err
    assert not star.exists()


def test_checks_of_options_name_the_configuration_that_they_may_come_from(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = tmp_path / "run.toml"
    config.write_text("[detect]\nthreshold = -3.0\n")
    arguments = ["detect", "x", "-o", "y", "--opd", "z"]
    assert main([*arguments, "--config", str(config)]) == 2
    assert f"options are also taken from {config}" in capsys.readouterr().err
    assert main([*arguments, "--threshold", "-3"]) == 2
    assert "taken from" not in capsys.readouterr().err


def test_mistakes_of_a_survey_are_in_the_words_of_its_configuration(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = tmp_path / "survey.toml"
    config.write_text("[options]\nsize = 2\n[[sequence]]\nfiles = '.'\nopd = 'flat'\n")
    assert main(["survey", str(config), "-o", str(tmp_path / "out")]) == 1
    shown = capsys.readouterr().err
    assert "options: size: got 2" in shown
    assert "--size" not in shown


def test_a_missing_map_is_answered_with_what_there_is(capsys: pytest.CaptureFixture[str]) -> None:
    for command in (
        ["detect", "x", "-o", "y"],
        ["reduce", "x", "-o", "y"],
        ["learn", "x", "-o", "y"],
    ):
        assert main(command) == 2
        shown = capsys.readouterr().err
        assert "'--opd'" in shown
        assert "a folder of maps" in shown
        assert "mast to fetch" in shown
        assert "flat to start without one" in shown


def test_tables_of_a_configuration_are_commands(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = tmp_path / "run.toml"
    config.write_text("quiet = true\n[fit]\nsize = 20\n")
    assert main(["--config", str(config), "psf", "-o", str(tmp_path / "star.fits")]) == 2
    assert "[fit] is no command" in capsys.readouterr().err


def test_the_documented_configuration_is_valid(tmp_path: Path) -> None:
    page = (ROOT / "docs" / "reference" / "command_line.md").read_text(encoding="utf-8")
    example = page.partition("```toml\n")[2].partition("```")[0]
    assert '[reduce]\nframes = ["calints"]' in example
    path = tmp_path / "run.toml"
    path.write_text(example)
    assert read_config(application, path)["reduce"]["log_file"] == "products/run.log"


def test_the_rules_are_those_of_the_package() -> None:
    (option,) = (p for p in application.commands["reduce"].params if p.name == "opd_date")
    assert tuple(option.type.choices) == RULES


@pytest.mark.parametrize(
    ("words", "completed"),
    [("--opd-", "plain,--opd-date"), ("--star-sed star", "file,star")],
)
def test_the_shell_completes_options_and_files(words: str, completed: str) -> None:
    """What the shell's completion function calls."""
    done = subprocess.run(
        [sys.executable, "-m", "pyklip_diffrender.cli"],
        capture_output=True,
        text=True,
        check=False,
        env={
            **os.environ,
            "PYTHONPATH": str(ROOT),
            "_PYKLIP_DIFFRENDER_COMPLETE": "bash_complete",
            "COMP_WORDS": f"pyklip-diffrender reduce {words}",
            "COMP_CWORD": str(1 + len(words.split())),
        },
    )
    assert done.stdout.splitlines() == [completed], done.stderr


# -- doctor --------------------------------------------------------------------------------------


@pytest.mark.slow
def test_doctor_reports_versions_data_machine_and_a_fit(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delenv("STPSF_PATH", raising=False)
    status = main(["doctor"])
    lines = capsys.readouterr().out.splitlines()
    assert status == int(any(line.startswith("FAIL") for line in lines))
    assert f"ok    torch {version('torch')}" in lines
    assert any(line.startswith("ok    data files: ") for line in lines)
    assert any("of memory are free" in line for line in lines)
    assert any("STPSF_PATH is not set" in line and line.startswith("note") for line in lines)
    assert any(line.startswith("ok    self-test in") for line in lines)


def test_doctor_fails_with_a_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STPSF_PATH", str(tmp_path))
    for checks, words in (
        (doctor.check_libraries(["torchh"]), "torchh cannot be imported"),
        (doctor.check_data(["nowhere"]), "data files cannot be read"),
        (doctor.check_stpsf(), "which has no version.txt"),
        ([doctor.memory_check(1e9)], "1.0 GB of memory are free; the demo"),
        ([doctor.disk_check(1e8)], "0.1 GB are free on the disk"),
        # Without the wavefront, a fit recovers nothing of it.
        (doctor.check_fit(wavefront=False), "Do not use results"),
    ):
        (failed,) = (each for each in checks if each.state == "FAIL")
        assert words in failed.text
    assert doctor.memory_check(8e9).text == "8.0 GB of memory are free"
    assert doctor.memory_check(None).state == "note"


def test_the_plan_says_what_reading_a_large_file_takes(tmp_path: Path) -> None:
    path = calints(tmp_path / "a_calints.fits")
    sequence = Sequence.from_files([path])
    usual = describe_plan(sequence, ReduceOptions())
    os.truncate(path, 10 * 10**9)  # Sparse: it takes no room.
    assert "1.8 GB of memory" in usual
    assert "8.7 GB of memory" in describe_plan(sequence, ReduceOptions())
