"""The command line: what it writes, what it refuses before any work, and where errors go."""

import io
import json
import logging
import re
import shutil
import sys
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from astropy.io import fits
from small_files import calints

from benchmarks.synthetic_searches import searched, write_searched
from pyklip_diffrender import errors
from pyklip_diffrender.cli import main
from pyklip_diffrender.cli.session import claim_file, claim_folder
from pyklip_diffrender.reduction import ReduceOptions
from pyklip_diffrender.reduction.pipeline import Preparation
from pyklip_diffrender.reduction.products import ProductFolder
from pyklip_diffrender.wavefront.opd import random_opd

# The package has the command under the name of its module.
application = import_module("pyklip_diffrender.cli.application")


@lru_cache(maxsize=1)
def wavefront():
    """A wavefront, nm."""
    return random_opd(3, npix=128).data * 1e9


def opd_file(path):
    fits.PrimaryHDU(wavefront(), fits.Header({"BUNIT": "nm"})).writeto(path)
    return path


@pytest.mark.parametrize("command", ["demo", "reduce", "learn"])
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
        (["reduce", "x", "--opd", "y"], "Missing option '-o'"),
        (["reduce", "x", "-o", "y"], "'--opd'. Name the FITS file of an OPD map"),
        (["learn", "x", "-o", "y"], "flat to start without one"),
        (["reduce", "x", "-o", "y", "--opd", "z", "--opd-date", "closest"], "nearest"),
        (["reduce", "x", "-o", "y", "--opd", "z", "--threshold", "-3"], "threshold: got -3"),
        (["reduce", "x", "-o", "y", "--opd", "z", "--star", "12"], "'--star' requires 2 arguments"),
        (["reduce", "x", "-o", "y", "--opd", "z", "--disk", "--wide"], "wide, disk: got both"),
        (["reduce", "x", "-o", "y", "--opd", "z", "--pattern", "no.fits"], "pattern: got"),
        (["reduce", "x", "-o", "y", "--opd", "z", "--opd-folder", "x"], "--opd-folder"),
        (["demo", "--threads", "0"], "--threads"),
        (["learn", "x", "-o", "y", "--opd", "z", "--size", "0"], "--size"),
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
    assert shown.out == ""
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("extra", "words"),
    [
        ([], ["nowhere.fits", "no such file"]),
        (["--device", "abacus"], ["--device: PyTorch"]),
        (["-o", "nowhere/library.fits"], ["there is no folder"]),
        (["-o", "."], ["is a folder, expected a file"]),
    ],
)
def test_errors_go_to_stderr_and_nothing_is_written(tmp_path, monkeypatch, capsys, extra, words):
    monkeypatch.chdir(tmp_path)
    assert main(["learn", "nowhere.fits", "--opd", "flat", "-o", "library.fits", *extra]) == 1
    shown = capsys.readouterr()
    assert shown.out == ""
    assert shown.err.startswith("pyklip-diffrender: ")
    assert all(word in shown.err for word in words)
    assert list(tmp_path.iterdir()) == []


def test_a_broken_file_leaves_no_product(tmp_path, capsys):
    frames, products = calints(tmp_path / "calints.fits", np.ones((2, 90, 90))), tmp_path / "out"
    frames.write_bytes(frames.read_bytes()[: frames.stat().st_size // 2])
    opd = opd_file(tmp_path / "opd.fits")
    assert main(["reduce", str(frames), "--opd", str(opd), "-o", str(products)]) == 1
    assert "calints.fits" in capsys.readouterr().err
    assert not products.exists()


@pytest.mark.parametrize("command", ["demo", "reduce"])
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
    assert "overwrite" in shown
    if command != "demo":
        assert main([*arguments, "--overwrite"]) == 1
        assert "nowhere.fits" in capsys.readouterr().err
    assert path.read_text() == "mine"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.skipif(sys.platform == "win32", reason="links take privileges there")
@pytest.mark.parametrize("place", ["dangling", "inside", "loop", "product"])
def test_links_that_lead_nowhere_are_refused_before_the_fit(tmp_path, place):
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
        claim_folder(output, ("report.html",))
    with pytest.raises(errors.IncompatibleSetupError, match=r"--output: .* is a link to "):
        claim_file(product if place == "product" else output)


@pytest.mark.skipif(sys.platform == "win32", reason="links take privileges there")
def test_a_link_to_a_folder_is_taken(tmp_path):
    (tmp_path / "real").mkdir()
    (tmp_path / "out").symlink_to(tmp_path / "real")
    claim_folder(tmp_path / "out", ("report.html",))
    claim_file(tmp_path / "out" / "star.fits")


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
    """A folder of OPD maps from before and after the frames."""
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
    return ["reduce", str(frames / "one_calints.fits"), *reducing[2:]]


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
    assert f"OPD map: {sensed}" in lines
    assert lines[-4:] == [
        "1. wavefront", "2. reference stars and target together", "3. search", "4. products",
    ]  # fmt: skip
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
        (["--star-flux", "0.4 Jy"], "star_flux: one_calints.fits is not calibrated"),
        (["--opd", "flat", "--opd-date", "before"], "--opd-date is for --opd FOLDER"),
        (["--size", "9"], "Choose a smaller size"),
        (["--opd", "nowhere.fits"], "nowhere.fits: no such file"),
        (["--filter", "F356W"], "filter: got 'F356W'"),
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
    assert reduced == []
    assert not (tmp_path / "products").exists()


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


def test_another_run_into_the_folder_keeps_its_products(tmp_path, reducing, reduced, capsys):
    """One run begins, another one begins and ends, and the first one ends."""
    products = tmp_path / "products"
    arguments = [*reducing, "--overwrite"]
    assert main(reducing) == 0
    reduced.meanwhile = lambda: main([*arguments, "--threshold", "7"])
    reduced.writes = lambda folder: (folder / "summary.json").write_text(
        json.dumps({**SUMMARY, "run": len(reduced)})
    )
    capsys.readouterr()
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        assert main(arguments) == 1
    shown = capsys.readouterr()
    aside = products / "products-2"
    assert f"wrote {aside / 'report.html'} and" in shown.out
    assert f"{products} while this run was computing: these are kept" in shown.err
    assert shown.err.rstrip().endswith(f"the products of this run are in {aside}")
    runs = [json.loads((each / "summary.json").read_text())["run"] for each in (products, aside)]
    # The second run ended first, and the third one, which had begun before, last.
    assert runs == [2, 3]
    assert [each.given.options.threshold for each in reduced] == [5, 7, 5]
    assert not [each for each in products.iterdir() if each.name.startswith(".")]


def test_another_run_over_several_filters_keeps_its_products(
    tmp_path, both_filters, reduced, capsys
):
    products, place = tmp_path / "products", (0.6, 0.35)
    made = {
        "F356W": searched("F356W", 2, [(*place, 4.0)]),
        "F444W": searched("F444W", 1, [(*place, 4.2)], north=20.0),
    }
    reduced.writes = lambda folder: write_searched(made[reduced[-1].given.sequence.filter], folder)
    reduced.meanwhile = lambda: main(both_filters)
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        assert main([*both_filters, "--spectra", "flat"]) == 1
    assert "products-2" in capsys.readouterr().err.splitlines()[-1]
    assert len(reduced) == 4
    # The other run searched with all spectra, and this one, beside it, with one.
    for above in (products, products / "products-2"):
        content = json.loads((above / "comparison.json").read_text(encoding="utf-8"))
        spectra = [each["name"] for each in content["combined"]["spectra"]]
        assert (spectra == ["flat"]) == (above != products)
        assert fits.getdata(above / "combined.fits", "SNR").shape[0] == len(spectra)
        reports = [above / each["folder"] / "summary.json" for each in content["reductions"]]
        assert all(each.exists() for each in reports)
        page = (above / "comparison.html").read_text(encoding="utf-8")
        assert all(f'"{each["folder"]}/report.html"' in page for each in content["reductions"])


SUMMARY = {
    "sentence": "One companion.",
    "status": {
        "name": "MODEL_MISMATCH", "message": "converged, but", "advice": "Use the option disk.",
    },
}  # fmt: skip


@dataclass
class StubReduction:
    """Writes what a reduction writes, as far as the command line reads it."""

    given: Preparation
    progress: bool
    writes: Callable[[Path], object] | None = None

    def write(self, folder):
        path = folder / "summary.json"
        if self.writes is not None:
            self.writes(folder)
        else:
            path.write_text(json.dumps(SUMMARY))
        return [each for each in folder.iterdir() if each.is_file()]


class Reduced(list[StubReduction]):
    """What fits and searches were given, and how they end."""

    error: BaseException | None = None
    interrupted = False
    """Whether fits are interrupted when the first products are written."""
    writes: Callable[[Path], object] | None = None
    meanwhile: Callable[[], int] | None = None
    """What happens while the next fit runs, with its exit status."""


@pytest.fixture
def reduced(monkeypatch):
    """Stub for the fits and searches."""
    made = Reduced()

    def stub(given, *, progress, keep):
        print("a library says hello")
        if isinstance(made.error, errors.RefinementError):
            for _ in range(2):
                warnings.warn("the map is old", errors.DiffrenderWarning, stacklevel=1)
        if made.error is not None:
            raise made.error
        meanwhile, made.meanwhile = made.meanwhile, None
        if meanwhile is not None:
            assert meanwhile() == 0
        made.append(StubReduction(given, progress, made.writes))
        if made.interrupted:
            keep(made[-1])
            raise KeyboardInterrupt
        return made[-1]

    monkeypatch.setattr(Preparation, "run", stub)
    monkeypatch.setattr(ProductFolder, "keep", lambda self, each: self.replace(each.write))
    return made


def test_reduce_passes_its_options_on_and_names_the_products(tmp_path, reducing, reduced, capsys):
    options = ["--opd-date", "before", "--threshold", "4", "--pattern", "off"]
    options += ["--memory", "2 GB", "--injections", "7", "--star-flux-error", "0.1"]
    assert main([*reducing, *options]) == 0
    shown = capsys.readouterr()
    # Names of the command line, and the page to open.
    assert "One companion.\nMODEL_MISMATCH: converged, but.\nUse the option disk.\n" in shown.out
    assert f"wrote {tmp_path / 'products/report.html'} and 0 more files\n" in shown.out
    (call,) = reduced
    assert call.given.wavefront.name == "opd_2022-07-20.fits"
    assert call.given.options == ReduceOptions(
        size=8, threshold=4.0, pattern="off", memory="2 GB", injections=7, star_flux_error=0.1
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
    assert "star_flux: one_calints.fits is not calibrated" in shown.err
    assert main([*arguments, "--star-flux", "0.4 Jy"]) == 2
    assert "both say how bright the star is" in capsys.readouterr().err


def test_general_options_go_with_every_command(detecting, reduced, capsys, monkeypatch):
    threads = []
    monkeypatch.setattr(torch, "set_num_threads", threads.append)
    handlers = list(logging.root.handlers)
    assert main([*detecting, "-q", "--threads", "1"]) == 0
    assert threads == [1]
    assert capsys.readouterr().err == ""
    # What the run changed is as it was.
    assert logging.root.handlers == handlers


@pytest.mark.parametrize(("map_", "said"), [("opd_2022-07-25.fits", 0), ("opd_2022-07-01.fits", 1)])
def test_a_map_older_than_a_week_has_a_remark(tmp_path, detecting, capsys, map_, said):
    """The frames are of 2022-07-30."""
    opd_file(tmp_path / map_)
    assert main([*detecting, "--opd", str(tmp_path / map_), "--dry-run"]) == 0
    assert capsys.readouterr().err.count("sensed 29 days before the frames. JWST's is") == said


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
    failing = ["learn", "x", "--opd", "flat", "-o", "no/such/library.fits"]
    for arguments, status in ((["--help"], 0), (failing, 1), (["x"], 2)):
        assert main(arguments) == status


def test_an_interrupted_run_keeps_what_it_has_written(tmp_path, detecting, reduced, capsys):
    arguments, products = [*detecting, "-q"], tmp_path / "products"
    products.mkdir()
    (products / "notes.txt").write_text("mine")
    reduced.interrupted = True
    assert main(arguments) == 130
    assert "interrupted; products that were written are complete" in capsys.readouterr().err
    assert sorted(each.name for each in products.iterdir()) == ["notes.txt", "summary.json"]


def test_mast_is_asked_for_the_map_of_the_date(detecting, reduced, capsys, monkeypatch):
    asked = []

    def retrieve(date, choice):
        asked.append((date.isot[:19], choice))
        if choice == "after":
            raise errors.MissingOPDError("no OPD map from MAST (no route to host)")
        return random_opd(1, npix=64)

    monkeypatch.setattr("pyklip_diffrender.cli.reducing.load_wss_opd_by_date", retrieve)
    arguments = [*detecting, "--opd", "mast"]
    assert main(arguments) == 0
    assert reduced[0].given.wavefront.name == "random_opd(seed=1)"
    capsys.readouterr()
    assert main([*arguments, "--opd-date", "after", "--overwrite"]) == 1
    assert "no route to host" in capsys.readouterr().err
    assert asked == [("2022-07-30T02:03:04", "nearest"), ("2022-07-30T02:03:04", "after")]


def test_a_disk_without_room_is_found_before_the_work(reducing, reduced, capsys, monkeypatch):
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(total=1e12, free=2e7))
    assert main(reducing) == 1
    assert "got 20 MB of room on the disk, expected at least 100 MB" in capsys.readouterr().err
    assert reduced == []


@pytest.mark.skipif(sys.platform != "linux", reason="Linux has a folder that takes no files.")
def test_a_folder_that_takes_no_files(reducing, reduced, capsys):
    assert main([*reducing, "-o", "/proc/x"]) == 1
    shown = capsys.readouterr().err
    assert "/proc/x cannot be written" in shown
    assert "room" not in shown
    assert reduced == []


def test_doctor_reports_versions_data_and_machine(monkeypatch, capsys):
    assert main(["doctor"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line[:6] for line in lines] == ["ok    "] * 3
    words = (f", torch {version('torch')}, ", "patterns", "processors")
    assert all(word in line for word, line in zip(words, lines, strict=True))

    def broken():
        raise OSError("no such file")

    monkeypatch.setattr(application, "CHECKS", (broken, application.check_data))
    assert main(["doctor"]) == 1
    first, second = capsys.readouterr().out.splitlines()
    assert first == "FAIL  OSError: no such file"
    assert second.startswith("ok    ")


def test_doctor_fails_where_a_library_is_missing():
    with pytest.raises(ModuleNotFoundError, match="torchh"):
        application.check_libraries(["torchh"])
