"""Epochs and filters of a star: the page that shows them together, and the command."""

import json

import numpy as np
import pytest
from astropy.io import fits

import pyklip_diffrender as dr
from benchmarks.calints_files import calints
from benchmarks.synthetic_searches import searched
from pyklip_diffrender.cli import main
from pyklip_diffrender.reduction.several import combined_rows, in_words, write_comparison

MOTION = (0.28, -0.36)
"""Of AU Mic, arcsec per year."""


def summary(mjd, places):
    """What a reduction says about candidates at offsets to the east and north."""
    candidates = [
        {
            "separation_arcsec": float(np.hypot(*place)), "separation_error_arcsec": 0.01,
            "position_angle_deg": float(np.degrees(np.arctan2(*place))),
            "position_angle_error_deg": float(np.degrees(0.01 / np.hypot(*place))),
            "snr": 9.0, "contrast": 1e-5, "contrast_error": 1e-6, "ab_mag": 20.0,
            "ab_mag_error": 0.1,
        }
        for place in places
    ]  # fmt: skip
    return {
        "target": "AU Mic <b>", "oriented": True, "epoch_mjd": mjd, "sentence": "Result.",
        "first_date": "2022-10-03T00:00:00" if mjd < 60000 else "2023-12-02T00:00:00",
        "filter": "F444W", "candidates": candidates,
        "contrast_curve": {
            "sigmas": 5.0, "separation_arcsec": [0.5, 1.0, 1.5], "contrast": [1e-5, 2e-6, None],
        },
    }  # fmt: skip


def test_the_page_links_to_each_reduction(tmp_path):
    folders = {
        "2022-10-03": summary(59855.0, [(0.8, -0.5)]), "2023-12-02": summary(60280.0, [(0.8, -0.5)])
    }  # fmt: skip
    html, data = write_comparison(folders, tmp_path, "the star's proper motion <b>")
    text = html.read_text(encoding="utf-8")
    assert 'href="2022-10-03/report.html"' in text
    assert "no combined search. the star&#39;s" in text
    assert "<b>" not in text
    content = json.loads(data.read_text(encoding="utf-8"))
    assert [each["folder"] for each in content["reductions"]] == list(folders)
    assert content["combined"] == {"reason": "the star's proper motion <b>"}
    write_comparison({key: summary(59855.0, []) for key in folders}, tmp_path, "none")
    assert "There are no candidates" in html.read_text(encoding="utf-8")


def test_the_page_shows_the_combined_search(tmp_path):
    folders = {"2022": summary(59855.0, []), "2023": summary(60280.0, [])}
    found = [
        searched("F444W", 1, [(0.5, 0.45, 9.0)], mjd=59855.0),
        searched("F444W", 2, [(0.5, 0.45, 9.0)], mjd=60280.0),
        searched("F356W", 3, status="MODEL_MISMATCH"),
    ]
    combination = dr.combine(found, proper_motion=MOTION)
    html, data = write_comparison(folders, tmp_path, combination)
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
    # The way of a source in the background is drawn for the candidate.
    assert text.count("by the dashed line. A companion stays") == 1
    assert [each["epoch_mjd"] for each in content["sightings"]] == [59855.0, 60280.0]


def test_the_page_has_the_combined_map_and_all_limits_side_by_side(tmp_path, monkeypatch):
    folders = {"2022": summary(59855.0, []), "2023": summary(60280.0, [])}
    found = [searched("F444W", k, [(0.5, 0.45, 9.0)], mjd=59855.0 + k) for k in (1, 2)]
    figures = []
    monkeypatch.setattr("pyklip_diffrender.drawing.to_png", lambda f, **_: figures.append(f) or b"")
    combination = dr.combine(found)
    html, _ = write_comparison(folders, tmp_path, combination)
    assert html.read_text(encoding="utf-8").count("<figure>") == len(figures) == 2
    (ours,), (limits, *_) = figures[0].axes, figures[1].axes
    (row,) = combination.candidates
    (circle,) = (line for line in ours.lines if line.get_label() == "companions")
    place = [row["delta_ra"].value, row["delta_dec"].value]
    np.testing.assert_allclose(np.ravel(circle.get_data()), place, atol=1e-12)
    np.testing.assert_allclose(place, (0.5, 0.45), atol=0.03)
    (image,) = ours.images
    x, y = (image.get_transform() - ours.transData).inverted().transform(place)
    left, right, bottom, top = image.get_extent()
    ny, nx = image.get_array().shape
    pixel = int((y - bottom) / (top - bottom) * ny), int((x - left) / (right - left) * nx)
    assert image.get_array()[pixel] == pytest.approx(row["snr"], rel=0.05)
    drawn = {line.get_label(): line.get_data() for line in limits.lines}
    assert list(drawn) == ["2022-10-03 F444W", "2023-12-02 F444W", "all together, in F444W"]
    np.testing.assert_allclose(drawn["2022-10-03 F444W"][1], [1e-5, 2e-6, np.nan])
    # Each alone has an error of 1e-6 everywhere.
    np.testing.assert_allclose(drawn["all together, in F444W"][1], 5e-6 / np.sqrt(2), rtol=0.01)


def dry_run(folder):
    """Arguments of a dry run on frames in a folder, with an OPD map that is made here."""
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
    # Motion and spectra are checked before the first fit.
    assert main([*options, "--parallax", "70"]) == 2
    assert shows(capsys, "no star has more than 0.7685", "give 70 mas")
    assert main([*options, "--proper-motion", "377", "-90"]) == 2
    assert shows(capsys, "no star is faster", "377 mas/yr")
    motion = ["--proper-motion", "377 mas/yr", "-90 mas/yr", "--parallax", "70 mas"]
    assert main([*options, *motion]) == 0
    assert main([*options, "--spectra", str(tmp_path / "none.ecsv")]) == 1
    assert shows(capsys, "none.ecsv: no such file")
