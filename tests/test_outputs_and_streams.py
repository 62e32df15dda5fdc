"""Outputs that cannot be written are refused before any work; programs without standard streams."""

from __future__ import annotations

import io
import sys
from types import ModuleType

import pytest

from pyklip_diffrender.cli import main
from pyklip_diffrender.cli.session import Run
from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.surveys import execution


def link(path, target):
    try:
        path.symlink_to(target)
    except OSError:
        pytest.skip("links cannot be made here")
    return path


def dangling(folder):
    return link(folder / "out", folder / "nowhere")


def inside_dangling(folder):
    return link(folder / "link", folder / "nowhere") / "out"


def loop(folder):
    link(folder / "other", folder / "out")
    return link(folder / "out", folder / "other")


def with_dangling_product(folder):
    (folder / "out").mkdir()
    link(folder / "out" / "report.html", folder / "nowhere")
    return folder / "out"


@pytest.mark.parametrize("make", [dangling, inside_dangling, loop, with_dangling_product])
@pytest.mark.parametrize("overwrite", [False, True])
def test_links_that_lead_nowhere_are_refused_before_the_fit(tmp_path, make, overwrite):
    output = make(tmp_path)
    with pytest.raises(IncompatibleSetupError, match=r"--output: .* is a link to .*, which does"):
        Run().claim_folder(output, ("report.html",), overwrite)
    path = output / "report.html" if make is with_dangling_product else output
    with pytest.raises(IncompatibleSetupError, match=r"OUTPUT: .* is a link to "):
        Run().claim_file(path, overwrite)


def test_a_link_to_a_folder_is_taken(tmp_path):
    (tmp_path / "real").mkdir()
    Run().claim_folder(link(tmp_path / "out", tmp_path / "real"), ("report.html",), False)
    Run().claim_file(tmp_path / "out" / "star.fits", False)


def closed():
    stream = io.StringIO()
    stream.close()
    return stream


class Broken(io.StringIO):
    def flush(self):
        raise OSError("Bad file descriptor")


@pytest.mark.parametrize("stream", [lambda: None, closed, Broken])
@pytest.mark.parametrize(
    "arguments", [["--help"], ["psf", "-o", "no/such/folder/star.fits"], ["nothing"]]
)
def test_a_program_without_standard_streams_ends_as_with_them(
    monkeypatch, capsys, stream,
    arguments,
):  # fmt: skip
    expected = main(arguments)
    monkeypatch.setattr(sys, "stdout", stream())
    monkeypatch.setattr(sys, "stderr", stream())
    assert main(arguments) == expected == {"--help": 0, "psf": 1, "nothing": 2}[arguments[0]]


@pytest.mark.parametrize(
    ("file", "words"),
    [
        ("survey.py", "needs `if __name__ == '__main__':`"),
        ("<stdin>", "came from standard input"),
        (None, "came from standard input"),
    ],
)
def test_a_script_from_standard_input_is_not_told_to_add_a_guard(monkeypatch, file, words):
    script = ModuleType("__main__")
    script.__file__ = file
    monkeypatch.setitem(sys.modules, "__main__", script)
    monkeypatch.delattr(sys, "ps1", raising=False)
    assert words in execution._why_not_spawned()
