"""The command line: what it writes, what it refuses before any work, and where errors go."""

import io
import json
import logging
import re
import shutil
import sys
import tomllib
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
import torch
from astropy.io import fits
from small_files import calints
from synthetic_searches import searched, write_searched

from pyklip_diffrender import errors
from pyklip_diffrender.cli import main
from pyklip_diffrender.cli.session import Run
from pyklip_diffrender.instrument.nircam import nircam_coronagraph
from pyklip_diffrender.io.files import open_fits
from pyklip_diffrender.reduction import UNFINISHED, Preparation, ProductFolder, ReduceOptions
from pyklip_diffrender.surveys import execution
from pyklip_diffrender.wavefront.opd import random_opd, resample

# The package has the command under the name of its module.
doctor = import_module("pyklip_diffrender.cli.application")

PYTHON = re.compile(r"\w=|\bu\.\w|np\.|\w\(\)|[a-z]_[a-z]+:|=\.\.\.|\ba[n]? [A-Z][a-z]+[A-Z]")
"""Signs of Python in a message."""


@lru_cache(maxsize=1)
def wavefront():
    """A wavefront, nm."""
    return random_opd(3, npix=128).data * 1e9


def opd_file(path):
    fits.PrimaryHDU(wavefront(), fits.Header({"BUNIT": "nm"})).writeto(path)
    return path


@pytest.mark.parametrize("command", ["demo", "reduce", "detect", "psf"])
def test_help_of_a_command_has_sections_and_examples(capsys, command):
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
        (["detect", "x", "-o", "y"], "'--opd'. Name the FITS file of a wavefront map"),
        (["learn", "x", "-o", "y"], "flat to start without one"),
        (["detect", "x", "-o", "y", "--opd", "z", "--opd-date", "closest"], "nearest"),
        (["detect", "x", "-o", "y", "--opd", "z", "--threshold", "-3"], "--threshold: got -3"),
        (["detect", "x", "-o", "y", "--opd", "z", "--star-flux", "9 parsec"], "--star-flux: got"),
        (["detect", "x", "-o", "y", "--opd", "z", "--star-flux-error", "20"], "0.05 for 5 %"),
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
def test_wrong_options_are_usage_errors(tmp_path, monkeypatch, capsys, arguments, words):
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    shown = capsys.readouterr()
    assert words in shown.err
    assert not PYTHON.search(shown.err)
    assert shown.out == ""
    assert list(tmp_path.iterdir()) == []


def test_psf_writes_the_image_of_the_model(tmp_path, capsys, monkeypatch):
    small = partial(nircam_coronagraph, npix=192)  # The command has 1024, which takes seconds.
    monkeypatch.setattr("pyklip_diffrender.instrument.nircam.nircam_coronagraph", small)
    path = tmp_path / "star.fits"
    opd = opd_file(tmp_path / "opd.fits")
    arguments = f"psf -o {path} --monochromatic 4.5e-6 --size 20 --opd {opd}".split()
    path.write_text("mine")
    assert main(arguments) == 1
    assert re.search(rf"{re.escape(str(path))}.*--overwrite", capsys.readouterr().err)
    assert path.read_text() == "mine"
    assert main([*arguments, "--overwrite", "--offset", "0.02", "-0.3"]) == 0
    assert str(path) in capsys.readouterr().out
    with open_fits(path) as hdus:
        image, header = hdus[0].data, hdus[0].header
    wanted = {
        "FILTER": "F444W", "CORONMSK": "MASK335R", "PUPIL": "MASKRND", "STAROFFX": 0.02,
        "STAROFFY": -0.3, "PUPILOPD": "opd.fits", "WAVELEN": 4.5e-6,
    }  # fmt: skip
    assert {name: header[name] for name in wanted} == wanted
    assert header["PIXELSCL"] == pytest.approx(0.062424185)
    with torch.no_grad():
        model = small("F444W", monochromatic=4.5e-6, fov_pixels=20)
        expected = model(resample(1e-9 * wavefront(), 192), (0.02, -0.3)).numpy()
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
        (["--device", "abacus"], ["--device: PyTorch"]),
        (["-o", "nowhere/star.fits"], ["there is no folder"]),
        (["-o", "."], ["is a folder, expected a file"]),
    ],
    ids=lambda value: " ".join(value[:2]) if value[0].startswith("-") else "",
)
def test_errors_go_to_stderr_and_nothing_is_written(tmp_path, monkeypatch, capsys, extra, words):
    monkeypatch.chdir(tmp_path)
    assert main(["psf", "-o", "star.fits", *extra]) == 1
    shown = capsys.readouterr()
    assert shown.out == ""
    assert shown.err.startswith("pyklip-diffrender: ")
    assert not PYTHON.search(shown.err)
    assert all(word in shown.err for word in words)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("percent", [0, 50])
def test_detect_in_a_broken_file_leaves_no_product(tmp_path, capsys, percent):
    frames, products = tmp_path / "calints.fits", tmp_path / "products"
    if percent:
        calints(frames, np.ones((2, 90, 90)))
        frames.write_bytes(frames.read_bytes()[: frames.stat().st_size * percent // 100])
    opd = opd_file(tmp_path / "opd.fits")
    assert main(["detect", str(frames), "--opd", str(opd), "-o", str(products)]) == 1
    assert "calints.fits" in capsys.readouterr().err
    assert not products.exists()


@pytest.mark.parametrize("command", ["demo", "reduce", "detect"])
def test_products_are_refused_before_any_work(tmp_path, capsys, command):
    """The frames do not exist: had they been opened first, the message would be theirs."""
    arguments = [command, "-o", str(tmp_path)]
    if command != "demo":
        arguments += ["nowhere.fits", "--opd", "nowhere_else.fits"]
    path = tmp_path / ("demo.fits" if command == "demo" else "detection.fits")
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


def test_an_output_that_is_a_file_is_refused(tmp_path, capsys):
    path = tmp_path / "products"
    path.write_text("mine")
    arguments = ["reduce", "nowhere.fits", "--opd", "nowhere.fits", "-o", str(path)]
    assert main([*arguments, "--overwrite"]) == 1
    assert f"{path} is a file, expected a folder" in capsys.readouterr().err
    assert path.read_text() == "mine"


@pytest.mark.skipif(sys.platform == "win32", reason="links take privileges there")
@pytest.mark.parametrize("place", ["dangling", "inside", "loop", "product"])
@pytest.mark.parametrize("overwrite", [False, True])
def test_links_that_lead_nowhere_are_refused_before_the_fit(tmp_path, place, overwrite):
    output = tmp_path / ("link/out" if place == "inside" else "out")
    product, other = output / "report.html", tmp_path / "other"
    links = {
        "dangling": {output: "nowhere"}, "inside": {output.parent: "nowhere"},
        "loop": {output: "other", other: "out"}, "product": {product: "nowhere"},
    }  # fmt: skip
    if place == "product":
        output.mkdir()
    for path, target in links[place].items():
        path.symlink_to(target)
    with pytest.raises(errors.IncompatibleSetupError, match=r"--output: .* is a link to .*, which"):
        Run().claim_folder(output, ("report.html",), overwrite)
    with pytest.raises(errors.IncompatibleSetupError, match=r"OUTPUT: .* is a link to "):
        Run().claim_file(product if place == "product" else output, overwrite)


@pytest.mark.skipif(sys.platform == "win32", reason="links take privileges there")
def test_a_link_to_a_folder_is_taken(tmp_path):
    (tmp_path / "real").mkdir()
    (tmp_path / "out").symlink_to(tmp_path / "real")
    Run().claim_folder(tmp_path / "out", ("report.html",), False)
    Run().claim_file(tmp_path / "out" / "star.fits", False)


def closed():
    stream = io.StringIO()
    stream.close()
    return stream


class Broken(io.StringIO):
    def flush(self):
        raise OSError("Bad file descriptor")


@pytest.mark.parametrize("stream", [lambda: None, closed, Broken])
def test_a_program_without_standard_streams_ends_as_with_them(monkeypatch, capsys, stream):
    monkeypatch.setattr(sys, "stdout", stream())
    monkeypatch.setattr(sys, "stderr", stream())
    for arguments, status in ((["--help"], 0), (["psf", "-o", "no/such/star.fits"], 1), (["x"], 2)):
        assert main(arguments) == status


@pytest.mark.parametrize("file", ["survey.py", "<stdin>", None])
def test_a_script_from_standard_input_is_not_told_to_add_a_guard(monkeypatch, file):
    words = "came from standard input"
    if file == "survey.py":
        words = "needs `if __name__ == '__main__':`"
    script = ModuleType("__main__")
    script.__file__ = file
    monkeypatch.setitem(sys.modules, "__main__", script)
    monkeypatch.delattr(sys, "ps1", raising=False)
    assert words in execution._why_not_spawned()


def write_frame(folder, name, **cards):
    data = np.random.default_rng(1).normal(10, 2, (2, 8, 10)).astype(np.float32)
    calints(folder / f"{name}_calints.fits", data, primary={"INSTRUME": None, **cards})


@pytest.fixture
def frames(tmp_path):
    """A folder with frames of a target and of a reference star, and an empty file."""
    folder = tmp_path / "frames"
    folder.mkdir()
    for name, star in (("one", "HIP-1"), ("two", "HIP-2")):
        write_frame(folder, name, TARGPROP=star, IS_PSF=name == "two")
    (folder / "three_calints.fits").write_bytes(b"")
    return folder


@pytest.fixture
def maps(tmp_path):
    """A folder of wavefront maps from before and after the frames."""
    folder = tmp_path / "maps"
    folder.mkdir()
    for day in ("20", "31"):
        opd_file(folder / f"opd_2022-07-{day}.fits")
    return folder


@pytest.fixture
def reducing(tmp_path, frames, maps):
    """Arguments of a reduction of the folder in cut-outs of 8 pixels."""
    products = str(tmp_path / "products")
    return ["reduce", str(frames), "--opd", str(maps), "-o", products, "--size", "8"]


@pytest.fixture
def detecting(frames, reducing):
    """The same of the target's file alone."""
    return ["detect", str(frames / "one_calints.fits"), *reducing[2:]]


@pytest.mark.parametrize("name", ["x_asn.json", "o*_calints.fits"])
def test_frames_by_an_association_or_a_pattern(frames, reducing, capsys, name):
    members = [{"expname": f"{each}_calints.fits", "exptype": kind}
               for each, kind in (("one", "science"), ("two", "psf"))]  # fmt: skip
    content = json.dumps({"asn_type": "coron3", "products": [{"name": "x", "members": members}]})
    (frames / "x_asn.json").write_text(content, encoding="utf-8")
    assert main(["reduce", str(frames / name), *reducing[2:], "--dry-run"]) == 0
    out = capsys.readouterr().out
    assert re.search(r"target +HIP-1 .*one_calints", out)
    assert ("two_calints" in out) == (name == "x_asn.json")


def test_a_dry_run_lists_frames_map_and_steps_and_writes_nothing(tmp_path, reducing, capsys):
    arguments = [*reducing, "--dry-run"]
    assert main(arguments) == 0
    lines = capsys.readouterr().out.splitlines()
    for name, words in (("one", ["target", "HIP-1"]), ("two", ["reference", "HIP-2"])):
        assert next(line for line in lines if f"{name}_calints" in line).split()[:2] == words
    assert any(line.startswith("left out: three_calints.fits: ") for line in lines)
    sensed = "opd_2022-07-31.fits, sensed 2022-07-31T00:00, 0.9 days after the frames"
    assert f"wavefront map: {sensed}" in lines
    steps = [line for line in lines if line[:3] in ("1. ", "2. ", "3. ", "4. ")]
    assert ["wavefront" in steps[0], "star" in steps[1], "search" in steps[2]] == [True] * 3
    assert "GB of memory" in lines[-1]
    assert not (tmp_path / "products").exists()
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
    tmp_path, reducing, reduced, capsys, options, words
):
    answers = []
    for dry in ([], ["--dry-run"]):
        assert main([*reducing, *options, *dry]) != 0
        answers.append(capsys.readouterr().err)
    assert answers[0] == answers[1]
    assert words in answers[0]
    assert not PYTHON.search(answers[0])
    assert reduced == []
    assert not (tmp_path / "products").exists()


def test_a_full_disk_is_noticed_before_the_work(reducing, reduced, capsys, monkeypatch):
    usage = SimpleNamespace(total=1e9, used=1e9 - 1e5, free=1e5)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage)
    assert main(reducing) == 1
    assert "has 0 MB of room, expected at least" in capsys.readouterr().err
    assert reduced == []


def test_an_interrupted_reduction_is_resumed_and_a_finished_one_is_kept(
    tmp_path, reducing, reduced, capsys
):
    products = tmp_path / "products"
    products.mkdir()
    (products / UNFINISHED).write_text("{}")
    reduced.error = KeyboardInterrupt()
    assert main([*reducing, "--resume"]) == 130
    assert "--resume" in capsys.readouterr().err
    reduced.error = None
    # Without the option, nothing is replaced.
    assert main(reducing) == 1
    assert UNFINISHED in capsys.readouterr().err
    assert main([*reducing, "--resume", "--quick"]) == 0
    assert reduced[0].given.options.accuracy == "quick"
    (products / UNFINISHED).unlink()
    assert main([*reducing, "--resume"]) == 0
    assert "this reduction has finished" in capsys.readouterr().out
    assert len(reduced) == 1
    assert main([*reducing, "--resume", "--overwrite"]) == 2
    assert "--resume keeps products" in capsys.readouterr().err


@pytest.fixture
def both_filters(tmp_path, maps):
    """Arguments of a reduction of a folder with a frame of one star in each of two filters."""
    frames = tmp_path / "frames"
    frames.mkdir()
    for name in ("F356W", "F444W"):
        write_frame(frames, name, TARGPROP="HIP-1", FILTER=name)
    options = ["--opd", str(maps), "-o", str(tmp_path / "products"), "--size", "8"]
    return ["reduce", str(frames), *options]


def test_spectra_that_do_not_cover_a_filter_are_an_error_before_any_fit(
    tmp_path, both_filters, reduced, capsys
):
    table = tmp_path / "short.txt"
    table.write_text("# micron Y\n3.0 1\n3.5 2\n4.1 3\n", encoding="utf-8")
    assert main([*both_filters, "--spectra", str(table)]) == 1
    assert re.search(r"Y: .* F444W needs", capsys.readouterr().err)
    assert reduced == []


def test_a_resumed_command_keeps_reductions_and_searches_them_together_again(
    tmp_path, both_filters, reduced, capsys
):
    """Two filters, of which one had finished before the interruption."""
    products, place = tmp_path / "products", (0.6, 0.35)
    made = {
        "F356W": searched("F356W", 2, [(*place, 4.0)]),
        "F444W": searched("F444W", 1, [(*place, 4.2)], north=20.0),
    }
    detection = products / "F356W" / "detection.fits"
    write_searched(made["F356W"], products / "F356W")
    before = detection.stat().st_mtime_ns
    reduced.error = KeyboardInterrupt()
    assert main([*both_filters, "--resume"]) == 130
    assert not (products / "combined.fits").exists()
    reduced.error = None
    reduced.writes = lambda folder: write_searched(made[folder.name], folder)
    assert main([*both_filters, "--resume"]) == 0
    shown = capsys.readouterr().out
    assert f"{products / 'F356W'}: this reduction has finished" in shown
    assert "combined search of 2 reductions: 1 candidate" in shown
    assert detection.stat().st_mtime_ns == before
    assert len(reduced) == 1
    # With nothing left to reduce, the search is made again: now with one spectrum.
    assert main([*both_filters, "--resume", "--spectra", "flat"]) == 0
    assert len(reduced) == 1
    assert fits.getdata(products / "combined.fits", "SNR").shape[0] == 1
    content = json.loads((products / "comparison.json").read_text(encoding="utf-8"))
    assert [each["name"] for each in content["combined"]["spectra"]] == ["flat"]


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

    def write(self, folder, **_):
        folder.mkdir(exist_ok=True)
        path = folder / "summary.json"
        if self.writes is not None:
            self.writes(folder)
        else:
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
def reduced(monkeypatch):
    """Stub for the fits and searches."""
    made = Reduced()

    def stub(given, *, progress, products):
        print("a library says hello")
        if isinstance(made.error, errors.RefinementError):
            for _ in range(2):
                warnings.warn("the map is old", errors.DiffrenderWarning, stacklevel=1)
        if made.error is not None:
            raise made.error
        made.append(StubReduction(given, progress, made.interrupted_writing, made.writes))
        return made[-1]

    monkeypatch.setattr(Preparation, "run", stub)
    monkeypatch.setattr(ProductFolder, "finish", lambda self, each: each.write(self.folder))
    return made


def test_reduce_passes_its_options_on_and_names_the_products(tmp_path, reducing, reduced, capsys):
    options = ["--opd-date", "before", "--threshold", "4", "--systematics", "off"]
    options += ["--memory", "2 GB", "--injections", "7", "--star-flux-error", "0.1"]
    assert main([*reducing, *options]) == 0
    shown = capsys.readouterr()
    # Names of the command line, and the page to open.
    assert "One companion.\nMODEL_MISMATCH: converged, but.\nUse --disk.\n" in shown.out
    assert f"wrote {tmp_path / 'products/report.html'} and 1 more files\n" in shown.out
    (call,) = reduced
    assert call.given.wavefront.name == "opd_2022-07-20.fits"
    assert call.given.options == ReduceOptions(
        size=8, threshold=4.0, systematics="off", memory="2 GB", injections=7, star_flux_error=0.1
    )
    # Not on a terminal: no bar, but the stages.
    assert call.progress is False
    assert "1. products" in shown.err


def test_overwriting_leaves_no_products_of_other_epochs(tmp_path, frames, reducing, reduced):
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
    arguments = [*reducing, "--opd", "flat"]
    assert main(arguments) == 1
    assert main([*arguments, "--overwrite"]) == 0
    left = {str(path.relative_to(products)) for path in products.rglob("*") if path.is_file()}
    assert left == {"summary.json", "2022-01-02/notes.txt", "other/report.html"}
    assert not (products / "2022-07-30").exists()
    assert len(list(frames.iterdir())) == 3


def test_a_spectrum_says_how_bright_the_star_is(tmp_path, reducing, capsys):
    spectrum = tmp_path / "star.txt"
    spectrum.write_text("2.0 0.4\n4.0 0.4\n6.0 0.4\n")
    arguments = [*reducing, "--star-sed", str(spectrum)]
    # These frames have no calibration, so that it goes no further.
    assert main(arguments) == 1
    shown = capsys.readouterr()
    assert "star: 0.4 Jy in F444W, by star.txt" in shown.out
    assert "--star-flux: one_calints.fits is not calibrated" in shown.err
    assert main([*arguments, "--star-flux", "0.4 Jy"]) == 2
    assert "both say how bright the star is" in capsys.readouterr().err


def test_json_is_all_that_goes_to_standard_output(maps, detecting, reduced, capsys):
    assert main([*detecting, "--opd", str(maps / "opd_2022-07-31.fits"), "--json"]) == 0
    shown = capsys.readouterr()
    assert json.loads(shown.out) == SUMMARY
    assert "a library says hello" in shown.err
    assert "One companion." in shown.err


@pytest.mark.parametrize("before", [True, False])
def test_general_options_stand_before_or_after_the_command(
    tmp_path, detecting, reduced, capsys, monkeypatch, before
):
    threads = []
    monkeypatch.setattr(torch, "set_num_threads", threads.append)
    log = tmp_path / "logs" / "run.log"
    general = ["-q", "--threads", "1", "--log-file", str(log)]
    assert main([*general, *detecting] if before else [*detecting, *general]) == 0
    assert threads == [1]
    assert capsys.readouterr().err == ""
    assert re.search(r"opd_2022-07-31\.fits(.|\n)*INFO 1\. products", log.read_text())
    # What the run changed is as it was.
    assert not any(getattr(h, "baseFilename", "") == str(log) for h in logging.root.handlers)


def test_warnings_and_errors_are_messages(tmp_path, detecting, reduced, capsys):
    (tmp_path / "old").mkdir()
    opd_file(tmp_path / "old" / "opd_2020-01-01.fits")
    reduced.error = errors.RefinementError("no fit")
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        assert main([*detecting, "--opd", str(tmp_path / "old"), "-q"]) == 1
    lines = capsys.readouterr().err.splitlines()
    assert "sensed 941 days before the frames" in lines[0]
    assert lines[1:] == ["pyklip-diffrender: warning: the map is old", "pyklip-diffrender: no fit"]


@pytest.mark.parametrize(
    "error",
    [MemoryError("8 GB"), RuntimeError("DefaultCPUAllocator: can't allocate memory: 8 GB")],
    ids=["python", "torch"],
)
def test_too_little_memory_is_a_message(detecting, capsys, reduced, error):
    reduced.error = error
    assert main(detecting) == 1
    assert "pyklip-diffrender: not enough memory; a smaller --size" in capsys.readouterr().err
    # Any other error is a fault of the program, with its traceback.
    reduced.error = RuntimeError("a bug")
    with pytest.raises(RuntimeError, match="a bug"):
        main(detecting)


def test_an_interrupted_run_says_what_it_left(tmp_path, detecting, reduced, capsys):
    arguments, products = [*detecting, "-q"], tmp_path / "products"
    products.mkdir()
    (products / "notes.txt").write_text("mine")
    reduced.interrupted_writing = True
    assert main(arguments) == 130
    assert f"interrupted; these files in {products} are new and complete: summary.json\n" in (
        capsys.readouterr().err
    )
    reduced.error = KeyboardInterrupt()
    assert main([*arguments, "--overwrite"]) == 130
    assert capsys.readouterr().err.strip() == "pyklip-diffrender: interrupted; nothing was written"


def test_mast_is_asked_for_the_map_of_the_date(detecting, reduced, capsys, monkeypatch):
    asked = []

    def retrieve(date, choice):
        asked.append((date.isot[:19], choice))
        if choice == "after":
            raise errors.MissingOPDError("no wavefront map from MAST (no route to host)")
        return random_opd(1, npix=64)

    monkeypatch.setattr("pyklip_diffrender.cli.reducing.load_wss_opd_by_date", retrieve)
    arguments = [*detecting, "--opd", "mast"]
    assert main(arguments) == 0
    assert reduced[0].given.wavefront.name == "random_opd(seed=1)"
    capsys.readouterr()
    assert main([*arguments, "--opd-date", "after", "--overwrite"]) == 1
    assert "no route to host" in capsys.readouterr().err
    assert asked == [("2022-07-30T02:03:04", "nearest"), ("2022-07-30T02:03:04", "after")]


def test_a_written_configuration_gives_the_same_run(
    tmp_path, frames, maps, reducing, reduced, capsys
):
    config = tmp_path / "run.toml"
    arguments = [*reducing, "-q", "--target", "HIP-1", "--star", "5.2,3.5"]
    assert main([*arguments, "--write-config", str(config)]) == 0
    assert capsys.readouterr().out == f"wrote {config}\n"
    assert reduced == []
    content = tomllib.loads(config.read_text())["reduce"]
    assert (content["frames"], content["opd"]) == ([str(frames)], str(maps))
    assert (content["quiet"], content["json"]) == (True, False)
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
def test_a_wrong_configuration_is_a_usage_error(tmp_path, capsys, content, words):
    config, star = tmp_path / "run.toml", tmp_path / "star.fits"
    if content is not None:
        config.write_text(content)
    assert main(["psf", "-o", str(star), "--config", str(config)]) == 2
    assert words.format(config=config) in capsys.readouterr().err
    assert not star.exists()


@pytest.mark.slow
def test_doctor_reports_versions_data_machine_and_a_fit(monkeypatch, capsys):
    monkeypatch.delenv("STPSF_PATH", raising=False)
    status = main(["doctor"])
    shown = capsys.readouterr().out
    assert status == bool(re.search("^FAIL", shown, re.MULTILINE))
    for line in (
        f"ok    torch {version('torch')}$", "ok    data files: ", ".* of memory are free",
        "note .*STPSF_PATH is not set", "ok    self-test in",
    ):  # fmt: skip
        assert re.search(f"^{line}", shown, re.MULTILINE), line


def test_doctor_fails_with_a_sentence(tmp_path, monkeypatch):
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
