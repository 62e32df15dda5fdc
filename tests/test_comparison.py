"""Epochs and filters of a star: candidates that move with it, background sources, colours."""

import json

import numpy as np
import pytest
from astropy.io import fits
from synthetic_searches import searched

import pyklip_diffrender as dr
from benchmarks.calints_files import calints
from pyklip_diffrender.cli import main
from pyklip_diffrender.reduction import (
    combined_rows,
    compare_reductions,
    in_words,
    write_comparison,
)
from pyklip_diffrender.reduction.several import sources_of

MOTION = (0.28, -0.36)
"""Of AU Mic, arcsec per year."""


def summary(mjd, places, error=0.01, filter="F444W", mag=20.0):
    """What a reduction says about candidates at offsets to the east and north."""
    candidates = [
        {
            "separation_arcsec": float(np.hypot(*place)), "separation_error_arcsec": error,
            "position_angle_deg": float(np.degrees(np.arctan2(*place))),
            "position_angle_error_deg": float(np.degrees(error / np.hypot(*place))),
            "snr": 9.0, "contrast": 1e-5, "contrast_error": 1e-6, "ab_mag": mag,
            "ab_mag_error": 0.1,
        }
        for place in places
    ]  # fmt: skip
    return {
        "target": "AU Mic <b>", "oriented": True, "epoch_mjd": mjd, "sentence": "Result.",
        "first_date": "2022-10-03T00:00:00" if mjd < 60000 else "2023-12-02T00:00:00",
        "filter": filter, "candidates": candidates, "threshold_snr": 6.0,
        "contrast_curve": {
            "sigmas": 5.0, "separation_arcsec": [0.4, 1.0], "contrast": [1e-5, 3e-6],
        },
    }  # fmt: skip


def test_filters_of_an_epoch_are_compared_by_place_and_colour():
    """One source in both filters, one in the first only, one beyond the curve of the other."""
    long = summary(59855.0, [(0.8, -0.5), (-0.5, 0.5), (1.5, 0.0)], mag=20.0)
    short = summary(59855.1, [(0.81, -0.5)], filter="F210M", mag=21.5)
    pairs = compare_reductions([long, short], MOTION)
    (pair,) = pairs
    assert pair["candidates"] == [1, 1]
    assert pair["verdict"] == "at one place"
    assert pair["colour_mag"] == pytest.approx(-1.5)
    assert pair["colour_error_mag"] == pytest.approx(0.1 * np.sqrt(2))
    sources = sources_of([long, short], pairs)
    assert [[each["candidates"] for each in source["filters"]] for source in sources] == [
        [[1], [1]], [[2], []], [[3], []]
    ]  # fmt: skip
    limits = [source["filters"][1]["limit"] for source in sources]
    assert limits[0] is limits[2] is None
    # Between the two points of the curve, for an S/N of 6.
    fraction = (np.hypot(0.5, 0.5) - 0.4) / 0.6
    assert limits[1] == pytest.approx(1.2 * (1e-5 + fraction * (3e-6 - 1e-5)))
    # Epochs of one filter have no such table, and no colour.
    later = summary(60280.0, [(0.8, -0.5)])
    pairs = compare_reductions([long, later], MOTION)
    assert all(each["colour_mag"] is None for each in pairs)
    assert sources_of([long, later], pairs) == []
    assert sources_of([summary(59855.0, []), short | {"candidates": []}], []) == []


def test_a_companion_moves_with_the_star_and_the_background_stays():
    years = 425 / 365.25
    bound, sky = np.array([0.8, -0.5]), np.array([-1.2, 1.0])
    moved = -np.array(MOTION) * years
    second = summary(60280.0, [sky + moved, bound + np.array([0.01, -0.01]), (2.0, 2.0)])
    pairs = compare_reductions([summary(59855.0, [bound, sky]), second], MOTION)
    found = {tuple(pair["candidates"]): pair for pair in pairs}
    assert {key: pair["verdict"] for key, pair in found.items()} == {
        (1, 2): "moves with the star", (2, 1): "stays on the sky: a source in the background"
    }  # fmt: skip
    np.testing.assert_allclose(found[2, 1]["moved_arcsec"], moved, atol=1e-9)
    assert found[2, 1]["chi2_with_sky"] == pytest.approx(0, abs=1e-9)
    # Moved by (0.01, -0.01) with errors of hypot(0.01, 0.003) in each of two epochs.
    assert found[1, 2]["chi2_with_star"] == pytest.approx(2e-4 / (2 * 1.09e-4), rel=1e-6)


def test_a_star_that_hardly_moves_tells_nothing():
    places = [(0.8, -0.5)]
    frames = [summary(59855.0, places), summary(60280.0, places)]
    (pair,) = compare_reductions(frames, (0.002, 0.001))
    assert pair["verdict"].startswith("either")
    (pair,) = compare_reductions(frames, None)
    assert pair["chi2_with_sky"] is None
    assert "not known" in pair["verdict"]
    assert compare_reductions([frames[0] | {"oriented": False}, frames[1]], MOTION) == []


def test_the_page_of_epochs_links_to_each(tmp_path):
    folders = {
        "2022-10-03": summary(59855.0, [(0.8, -0.5)]), "2023-12-02": summary(60280.0, [(0.8, -0.5)])
    }  # fmt: skip
    html, data = write_comparison(folders, MOTION, tmp_path)
    text = html.read_text(encoding="utf-8")
    assert 'href="2022-10-03/report.html"' in text
    assert "moves with the star" in text
    assert "<b>" not in text
    content = json.loads(data.read_text(encoding="utf-8"))
    assert [each["folder"] for each in content["reductions"]] == list(folders)
    assert content["sources"] == []
    assert content["pairs"][0]["verdict"] == "moves with the star"
    write_comparison({key: summary(59855.0, []) for key in folders}, None, tmp_path)
    assert "There are no candidates" in html.read_text(encoding="utf-8")


def test_the_page_has_a_table_of_candidates_over_filters(tmp_path):
    folders = {
        "F444W": summary(59855.0, [(0.8, -0.5), (-0.5, 0.5)]),
        "F210M": summary(59855.1, [(0.8, -0.5)], filter="F210M", mag=21.5),
    }
    html, data = write_comparison(folders, None, tmp_path)
    text = html.read_text(encoding="utf-8")
    assert 'href="F210M/report.html"' in text
    table = text.partition("Candidates over filters")[2].partition("</section>")[0]
    assert "(1) 20.00 ± 0.10, S/N 9.0</td><td>(1) 21.50 ± 0.10, S/N 9.0" in table
    assert "&lt; 7.7 × 10⁻⁶" in table
    assert len(json.loads(data.read_text(encoding="utf-8"))["sources"]) == 2


def test_the_page_shows_the_combined_search(tmp_path):
    folders = {"2022": summary(59855.0, []), "2023": summary(60280.0, [])}
    found = [
        searched("F444W", 1, [(0.5, 0.45, 9.0)], mjd=59855.0),
        searched("F444W", 2, [(0.5, 0.45, 9.0)], mjd=60280.0),
        searched("F356W", 3, status="MODEL_MISMATCH"),
    ]
    combination = dr.combine(found, proper_motion=MOTION)
    html, data = write_comparison(folders, MOTION, tmp_path, combination)
    text = html.read_text(encoding="utf-8")
    assert "moves with the star" in text
    assert "MODEL_MISMATCH" in text
    content = json.loads(data.read_text(encoding="utf-8"))["combined"]
    assert content == json.loads(json.dumps(combination.to_dict()))
    title, (row,) = combined_rows(content)
    assert len(title) == len(row)
    # At 0.673 arcsec; the place is known to 9 mas.
    assert row[1].startswith(("0.65", "0.66", "0.67", "0.68", "0.69"))
    assert "S/N" in row[title.index("Contrast in F444W")]
    assert "1 candidate\n" in in_words(combination)
    html, data = write_comparison(folders, MOTION, tmp_path, "the star's proper motion <b>")
    assert "no combined search. the star&#39;s" in html.read_text(encoding="utf-8")
    content = json.loads(data.read_text(encoding="utf-8"))
    assert content["combined"] == {"reason": "the star's proper motion <b>"}


def dry_run(folder):
    """Arguments of a dry run on frames in a folder, with a wavefront map that is made here."""
    opd = folder / "opd.fits"
    nanometres = np.random.default_rng(1).normal(0, 30, (64, 64))
    fits.PrimaryHDU(nanometres, fits.Header({"BUNIT": "nm"})).writeto(opd)
    frames, output = str(folder / "frames"), str(folder / "out")
    return ["reduce", frames, "--opd", str(opd), "-o", output, "--dry-run"]


def shows(capsys, *lines):
    """Whether all lines are in what was printed."""
    shown = capsys.readouterr()
    return all(line in shown.out + shown.err for line in lines)


def test_the_command_shows_every_epoch_and_every_file(tmp_path, capsys):
    frames = tmp_path / "frames"
    calints(frames / "a.fits")
    calints(frames / "b.fits", observation=2, date="2023-12-01T06:00:00", roll=90.0)
    calints(frames / "ta.fits", observation=3, cards={"EXP_TYPE": "NRC_TACQ"})
    assert main(dry_run(tmp_path)) == 0
    shown = capsys.readouterr().out
    for date in ("2022-10-03", "2023-12-01"):
        assert f"{date}, one of 2 reductions" in shown
    assert shown.count("left out: ta.fits: EXP_TYPE is NRC_TACQ") == 2
    assert not (tmp_path / "out").exists()


def test_the_command_takes_every_filter_of_the_target(tmp_path, capsys):
    frames = tmp_path / "frames"
    pixel = {"PIXAR_SR": 9.2e-14}
    calints(frames / "a.fits", cards=pixel)
    short = {"FILTER": "F356W", "ACT_ID": "07", **pixel}
    calints(frames / "b.fits", date="2022-10-03T07:00:00", cards=short)
    # A filter of a reference star alone.
    alone = {"FILTER": "F300M", "IS_PSF": True, "ACT_ID": "08"}
    calints(frames / "c.fits", "HD 2", observation=2, cards=alone)
    options = dry_run(tmp_path)
    assert main(options) == 0
    assert shows(capsys, "\nF444W, one of 2 reductions:", "\nF356W, one of 2 reductions:")
    assert main([*options, "--filter", "F356W"]) == 0
    assert not shows(capsys, "one of")
    assert main([*options, "--star-flux", "1 Jy"]) == 1
    assert shows(capsys, "--star-flux: got one flux density for F444W, F356W")
    sed = tmp_path / "star.txt"
    sed.write_text("1 2\n2 0.8\n3 0.4\n4 0.3\n5 0.2\n6 0.1\n", encoding="utf-8")
    assert main([*options, "--star-sed", str(sed)]) == 0
    assert shows(capsys, "Jy in F444W", "Jy in F356W")
    # Spectra are read before the first fit.
    assert main([*options, "--spectra", str(tmp_path / "none.ecsv")]) == 1
    assert shows(capsys, "none.ecsv: no such file")
