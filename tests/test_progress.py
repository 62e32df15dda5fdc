"""Progress: what a terminal shows, and what goes to the log."""

import logging

from pyklip_diffrender.io import ProgressBar, progress, stage
from pyklip_diffrender.io.progress import numbered_stages


def last_shown(text):
    return [line for line in text.replace("\n", "\r").split("\r") if line.strip()][-1]


def test_a_bar_shows_the_stage_and_what_the_fit_has_reached(capsys):
    with numbered_stages(), stage("place"):
        pass
    with numbered_stages(), stage("place"), ProgressBar("wavefront", shown=True) as bar:
        bar.update(chi2=4.123)
        bar._bar.refresh()
        shown = last_shown(capsys.readouterr().err)
        assert shown.startswith("1. place, chi2 4.12, step 1 [00:0")
        # A bar inside takes no line of its own.
        with ProgressBar("response", 10, shown=True) as inner:
            inner.update(10)
        assert "response" not in capsys.readouterr().err
    with ProgressBar("S/N map", 10, shown=True) as bar:
        bar.update(5)
        bar._bar.refresh()
        assert last_shown(capsys.readouterr().err).startswith("S/N map:  50 % [00:0")
    capsys.readouterr()
    with ProgressBar("S/N map", 10, shown=False) as bar:
        bar.update(10)
    assert capsys.readouterr() == ("", "")


def test_the_log_gets_stages_and_at_most_a_line_a_minute(caplog, monkeypatch):
    now = 1000.0
    monkeypatch.setattr(progress.time, "monotonic", lambda: now)
    with (
        caplog.at_level(logging.INFO),
        numbered_stages(),
        stage("place on the detector"),
        # A part of a numbered work goes on with its numbers.
        numbered_stages(),
        stage("wavefront"),
        ProgressBar("x", shown=False) as bar,
    ):
        for _ in range(9):
            now += 20.0
            bar.update(chi2=3.0)
            with ProgressBar("inside", 3, shown=False) as inner:
                now += 1e-3
                inner.update()
    assert [record.getMessage() for record in caplog.records] == [
        "1. place on the detector", "2. wavefront", "2. wavefront, chi2 3, step 3",
        "2. wavefront, chi2 3, step 6", "2. wavefront, chi2 3, step 9",
    ]  # fmt: skip
