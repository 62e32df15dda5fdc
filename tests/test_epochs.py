"""Epochs of a star: candidates that move with it, and sources in the background."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.io import fits

from benchmarks.calints_files import calints
from pyklip_diffrender.cli import main
from pyklip_diffrender.reduction import compare_epochs, write_epochs

MOTION = (0.28, -0.36)
"""Of AU Mic, arcsec per year."""


def summary(mjd: float, places: list[tuple[float, float]], error: float = 0.01) -> dict[str, Any]:
    """What a reduction says about candidates at offsets to the east and north."""
    candidates = [
        {
            "separation_arcsec": float(np.hypot(*place)),
            "separation_error_arcsec": error,
            "position_angle_deg": float(np.degrees(np.arctan2(*place))),
            "position_angle_error_deg": float(np.degrees(error / np.hypot(*place))),
            "snr": 9.0,
            "contrast": 1e-5,
            "contrast_error": 1e-6,
        }
        for place in places
    ]
    return {
        "target": "AU Mic <b>", "oriented": True, "epoch_mjd": mjd, "sentence": "Result.",
        "first_date": "2022-10-03T00:00:00" if mjd < 60000 else "2023-12-02T00:00:00",
        "filter": "F444W", "candidates": candidates,
    }  # fmt: skip


def test_a_companion_moves_with_the_star_and_the_background_stays() -> None:
    years = 425 / 365.25
    bound, sky = np.array([0.8, -0.5]), np.array([-1.2, 1.0])
    first = summary(59855.0, [tuple(bound), tuple(sky)])
    second = summary(
        60280.0,
        [tuple(sky - np.array(MOTION) * years), tuple(bound + np.array([0.01, -0.01])), (2.0, 2.0)],
    )
    pairs = compare_epochs([first, second], MOTION)
    verdicts = {tuple(pair["candidates"]): pair["verdict"] for pair in pairs}
    assert verdicts == {
        (1, 2): "moves with the star",
        (2, 1): "stays on the sky: a source in the background",
    }
    (pair,) = (each for each in pairs if each["candidates"] == [2, 1])
    np.testing.assert_allclose(pair["moved_arcsec"], -np.array(MOTION) * years, atol=1e-9)
    assert pair["chi2_with_sky"] == pytest.approx(0, abs=1e-9)
    # Moved by (0.01, -0.01) with errors of hypot(0.01, 0.003) in each of two epochs.
    (pair,) = (each for each in pairs if each["candidates"] == [1, 2])
    assert pair["chi2_with_star"] == pytest.approx(2e-4 / (2 * 1.09e-4), rel=1e-6)


def test_a_star_that_hardly_moves_tells_nothing() -> None:
    places = [(0.8, -0.5)]
    frames = [summary(59855.0, places), summary(60280.0, places)]
    (pair,) = compare_epochs(frames, (0.002, 0.001))
    assert pair["verdict"].startswith("either")
    (pair,) = compare_epochs(frames, None)
    assert pair["chi2_with_sky"] is None
    assert "not known" in pair["verdict"]
    assert compare_epochs([frames[0] | {"oriented": False}, frames[1]], MOTION) == []


def test_the_page_of_epochs_links_to_each(tmp_path: Path) -> None:
    folders = {
        "2022-10-03": summary(59855.0, [(0.8, -0.5)]), "2023-12-02": summary(60280.0, [(0.8, -0.5)])
    }  # fmt: skip
    html, data = write_epochs(folders, MOTION, tmp_path)
    text = html.read_text(encoding="utf-8")
    assert 'href="2022-10-03/report.html"' in text
    assert "moves with the star" in text
    assert "<b>" not in text
    content = json.loads(data.read_text(encoding="utf-8"))
    assert [each["folder"] for each in content["epochs"]] == list(folders)
    assert content["pairs"][0]["verdict"] == "moves with the star"
    write_epochs({key: summary(59855.0, []) for key in folders}, None, tmp_path)
    assert "No epoch has a candidate" in html.read_text(encoding="utf-8")


def test_the_command_shows_every_epoch_and_every_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    frames = tmp_path / "frames"
    calints(frames / "a.fits")
    calints(frames / "b.fits", observation=2, date="2023-12-01T06:00:00", roll=90.0)
    calints(frames / "ta.fits", observation=3, cards={"EXP_TYPE": "NRC_TACQ"})
    opd = tmp_path / "opd.fits"
    hdu = fits.PrimaryHDU(np.random.default_rng(1).normal(0, 30, (64, 64)))
    hdu.header["BUNIT"] = "nm"
    hdu.writeto(opd)
    options = ["reduce", str(frames), "--opd", str(opd), "-o", str(tmp_path / "out"), "--dry-run"]
    assert main(options) == 0
    shown = capsys.readouterr().out
    assert "epoch 2022-10-03, 2 in all" in shown
    assert "epoch 2023-12-01, 2 in all" in shown
    assert shown.count("left out: ta.fits: EXP_TYPE is NRC_TACQ") == 2
    assert not (tmp_path / "out").exists()
