"""The report: what it says is what was measured, and headers cannot change the page."""

import json
import re
import shutil
import subprocess
from dataclasses import asdict, replace
from functools import cache
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import torch
from astropy import units as u
from astropy.io import fits
from astropy.table import QTable
from astropy.time import Time
from astropy.wcs import WCS
from markupsafe import escape
from matplotlib import pyplot
from survey_stubs import HOSTILE, Tags

import pyklip_diffrender as dr
from pyklip_diffrender import drawing
from pyklip_diffrender.detection.candidates import Candidates
from pyklip_diffrender.errors import CorruptFileError, DiffrenderWarning, IncompatibleSetupError
from pyklip_diffrender.reduction import pages
from pyklip_diffrender.reduction.pictures import Klip, Overview, ReportPictures, SkyImages
from pyklip_diffrender.reduction.products import page, write_report
from pyklip_diffrender.reduction.remarks import advice, looks_extended
from pyklip_diffrender.reduction.summary import summarise
from pyklip_diffrender.reduction.visit import Contribution, Visit
from pyklip_diffrender.refinement import Status
from pyklip_diffrender.scene.product_headers import world_coordinates
from pyklip_diffrender.scene.sequence import by_reason

PLANET = dr.Planet(2e-5, 0.6, 40.0)
ROLL = 30.0


def reported(reduction, folder, files=()):
    """The paths of the report of a reduction alone, in a folder."""
    overview = Overview(SkyImages(reduction), Klip.of(reduction))
    return write_report(reduction, overview, folder, files)


@cache
def reduction(planet=True, target="HD 1"):
    """Of one frame, whose +y axis is at position angle 30 degrees."""
    model = dr.nircam_coronagraph("F444W", monochromatic=4.5e-6, npix=128, fov_pixels=32)
    opd = replace(dr.wavefront.random_opd(1, npix=128), date=Time("2022-10-01T12:00:00"))
    on_frame = replace(PLANET, position_angle=PLANET.position_angle - ROLL)
    scene = dr.Scene(dr.Star(exposure=20.0), (on_frame,) if planet else ())
    cards = {"TARGPROP": target, "INSTRUME": "TEST", "CRVAL1": 100.0, "CRVAL2": 20.0,
             "CORONMSK": "MASK335R"}  # fmt: skip
    frame = replace(
        dr.simulate(model, scene, opd, seed=3), header=fits.Header(cards), filter="F444W",
        position_angles=np.array([ROLL - 360]), date=Time("2022-10-03T00:00:00"),
        name="frame <1>.fits",
    )  # fmt: skip
    left_out = (("other & co.fits", "taken through F356W, not F444W"),)
    sequence = dr.ExposureSequence(target, (frame,), (), left_out)
    fit = dr.refine(model, [frame], opd, settings=dr.FitSettings(cycles=6))
    return dr.Reduction(sequence, fit, dr.detect(fit), failed=(("HD 2", "too faint"),))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Products whose pictures are no more than the beginning of one, as drawing takes seconds."""
    path = tmp_path_factory.mktemp("products")
    for name in ("wide_field.fits", "pattern.fits"):
        (path / name).write_text("of another star", encoding="utf-8")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("pyklip_diffrender.drawing.to_png", lambda *_, **__: b"\x89PNG")
        written = reduction().write(path, overwrite=True)
    assert [each.name for each in written][-2:] == ["report.html", "summary.json"]
    return path


def sources(places):
    """Candidates at x, y from the star, arcsec."""
    x, y = places.T
    angle = np.rad2deg(np.arctan2(-x, y)) % 360
    return QTable({"x": x * u.arcsec, "y": y * u.arcsec, "frame_angle": angle * u.deg})


def test_products_of_another_reduction_are_removed(folder):
    assert not (folder / "wide_field.fits").exists()
    assert not (folder / "pattern.fits").exists()
    assert (folder / "fit.fits").exists()


def test_products_are_read_back(folder):
    first, again = reduction(), dr.Reduction.read(folder)
    assert str(again) == str(first)
    for name in ("candidates", "contrast_curve"):
        expected, table = getattr(first, name), getattr(again, name)
        assert table.colnames == expected.colnames
        for column in expected.colnames:
            np.testing.assert_array_equal(table[column], expected[column])
    assert again.fit.status is first.fit.status
    assert again.failed == first.failed
    assert again.visit == first.visit
    assert again.sequence.excluded == first.sequence.excluded
    (frame,), (own,) = again.sequence.science, first.fit.frames
    np.testing.assert_array_equal(frame.data[frame.valid], own.observation.data[frame.valid])
    np.testing.assert_array_equal(again.plot()[0].images[0].get_array(), first.detection.snr)
    pyplot.close("all")
    with pytest.raises(IncompatibleSetupError, match=r"without the derivatives.*derivatives=True"):
        again.write(folder / "copy")
    assert not (folder / "copy").exists()


@pytest.mark.slow
def test_products_that_were_read_are_written_alike(tmp_path, monkeypatch):
    monkeypatch.setattr("pyklip_diffrender.drawing.to_png", lambda *_, **__: b"\x89PNG")
    one, other = tmp_path / "one", tmp_path / "other"
    reduction().write(one, derivatives=True)
    again = dr.Reduction.read(one)
    again.write(other, derivatives=True)
    first, second = (json.loads((each / "summary.json").read_text()) for each in (one, other))
    assert first == second
    for name in ("candidates", "contrast"):
        assert (one / f"{name}.ecsv").read_text() == (other / f"{name}.ecsv").read_text()
    (row,) = again.detection.measure(separation=PLANET.separation, position_angle=40.0)
    assert row["snr"] == pytest.approx(reduction().candidates["snr"][0], rel=0.05)


def test_products_that_are_not_read_are_said(folder, tmp_path):
    copy = shutil.copytree(folder, tmp_path / "copy")
    (copy / "disk.fits").write_text("of a disk", encoding="utf-8")
    with pytest.warns(DiffrenderWarning, match=r"disk\.fits is not read"):
        dr.Reduction.read(copy)
    (copy / "summary.json").unlink()
    with pytest.raises(CorruptFileError, match=r"summary\.json: not the summary.*Reduction.write"):
        dr.Reduction.read(copy)


def test_contributions_of_reference_frames_are_read_back():
    frames = (
        Contribution("a.fits", "HD 2", "wavefront", "", 1.2, 0.5, 3.0),
        Contribution("b.fits", "HD 3", "not used", "too faint"),
    )
    visit = Visit(frames, 1.25, "at 0.2 to 0.5 arcsec")
    facts = summarise(replace(reduction(), visit=visit))["visit"]
    np.testing.assert_equal(asdict(Visit.from_facts(json.loads(json.dumps(facts)))), asdict(visit))


def test_limits_of_a_calibrated_star_have_vega_magnitudes(tmp_path):
    detection = replace(reduction().detection)
    vars(detection)["sky"] = replace(detection.sky, star=(0.4, 0.04))
    detection.write(tmp_path)
    curve = QTable.read(tmp_path / "contrast.ecsv")
    # AB less Vega magnitude in F444W: other spectra of Vega agree within 0.02.
    expected = (0.4 * curve["contrast"] * u.Jy).to_value(u.ABmag) - 3.237
    np.testing.assert_allclose(curve["vega_mag"].value, expected, atol=0.02)
    assert "vega_mag" not in dr.Detection.read(tmp_path).contrast_curve.colnames


def test_limits_of_a_reduction_are_those_of_its_curve():
    result = reduction()
    found, curve = result.limits(), result.contrast_curve
    assert (
        found.colnames == result.detection.limits().colnames == ["separation", "contrast", "dmag"]
    )
    np.testing.assert_array_equal(found["contrast"], curve["contrast"])
    np.testing.assert_array_equal(found["separation"], curve["separation"])
    assert found.meta["filter"] == "F444W"


def test_what_is_printed_begins_with_the_sentence_of_the_report(folder):
    summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    printed = str(reduction())
    assert " ".join(printed.split()).startswith(summary["sentence"])
    assert max(map(len, printed.splitlines()[:3])) <= 80


def test_tables_say_what_they_are_of(folder):
    for name in ("contrast", "candidates"):
        meta = QTable.read(folder / f"{name}.ecsv").meta
        assert meta["target"] == "HD 1"
        assert meta["filter"] == "F444W"
        assert meta["image_mask"] == "MASK335R"
        assert meta["opd"] == reduction().fit.initial.name
        assert meta["status"] == reduction().fit.status.name
        assert meta["software"] == dr.__version__
    curve = QTable.read(folder / "contrast.ecsv")
    assert curve.meta["sigmas"] == reduction().contrast_curve.meta["sigmas"]


@pytest.mark.parametrize(
    ("write", "name"),
    [
        (lambda result, path: result.fit.write(path, linear=False), "fit.fits"),
        (lambda result, path: result.detection.write(path.parent), "contrast.ecsv"),
        (lambda result, path: result.detection.write_astrometry(path), "positions.csv"),
        (lambda result, path: result.write(path.parent), "summary.json"),
    ],
    ids=["fit", "detection", "astrometry", "reduction"],
)
def test_no_writer_replaces_a_file_without_being_asked(tmp_path, write, name):
    path = tmp_path / name
    path.write_text("earlier", encoding="utf-8")
    with pytest.raises(OSError, match=rf"{re.escape(name)} exists.*option overwrite"):
        write(reduction(), path)
    assert [each.name for each in tmp_path.iterdir()] == [name]
    assert path.read_text(encoding="utf-8") == "earlier"


@pytest.mark.parametrize("value", ["N/A", "half an hour", True, None, 1234.5, 1234])
def test_a_card_that_is_only_told_does_not_end_a_reduction(value):
    whole = reduction()
    (frame,) = whole.sequence.science
    cards = {"EFFEXPTM": value, "PROGRAM": 1184, "CORONMSK": None, "CRVAL1": 100, "RADESYS": None}
    odd = replace(frame, header=fits.Header({**frame.header, **cards}))
    summary = summarise(replace(whole, sequence=replace(whole.sequence, science=(odd,))))
    known = value if isinstance(value, int | float) and value is not True else None
    assert summary["exposure_s"] == summary["frames"][0]["exposure_s"] == known
    assert (summary["program"], summary["image_mask"]) == ("1184", None)
    json.dumps(summary, allow_nan=False)
    # A coordinate that is a whole number is one.
    wcs = world_coordinates(whole.fit.frames[0].grid, odd)
    assert (wcs["CRVAL1"], wcs["CTYPE1"], wcs["RADESYS"]) == (100.0, "RA---TAN", "ICRS")


def test_the_first_sentence_has_the_numbers_of_the_planet():
    (row,) = reduction().detection.candidates
    said = summarise(reduction())["sentence"]
    numbers = re.fullmatch(
        r"One companion candidate at ([\d.]+) ± ([\d.]+) arcsec, position angle ([\d.]+) ± [\d.]+ "
        r"deg east of north, contrast \(([\d.]+) ± ([\d.]+)\) × 10⁻⁵, S/N ([\d.]+)\.",
        said,
    )
    assert numbers, said
    separation, error, angle, contrast, contrast_error, snr = map(float, numbers.groups())
    assert separation == pytest.approx(row["separation"].to_value(u.arcsec), abs=error)
    assert error == pytest.approx(row["separation_error"].to_value(u.arcsec), rel=0.5)
    assert angle == pytest.approx(row["position_angle"].to_value(u.deg), abs=0.5)
    assert contrast == pytest.approx(1e5 * row["contrast"], abs=contrast_error)
    assert snr == pytest.approx(row["snr"], abs=0.051)
    # And they are the true ones: 40 degrees on the sky, not the 10 degrees on the frame.
    assert angle == pytest.approx(PLANET.position_angle, abs=3)
    assert separation == pytest.approx(PLANET.separation, abs=0.03)


def test_without_a_planet_the_sentence_states_the_limit():
    bare = reduction(planet=False)
    usual = summarise(bare)
    said = usual["sentence"]
    assert said.startswith("No companion above 5 sigma. A planet of contrast ")
    curve = bare.detection.contrast_curve
    # The field ends before 1 arcsec: the limit at 0.5 is the only one.
    limit = np.interp(0.5, curve["separation"].to_value(u.arcsec), curve["contrast"])
    assert f"contrast {pages.scientific(limit)} (" in said
    assert f"({-2.5 * np.log10(limit):.1f} mag fainter than the star) at 0.5 arcsec" in said
    # The limit is that of the threshold, the curve at 5 sigma whatever that is.
    strict = summarise(replace(bare, detection=replace(bare.detection, threshold=10.0)))
    assert pages.scientific(2 * usual["limits"][0]["contrast"]) in strict["sentence"]
    assert strict["limits"] == usual["limits"]


def test_without_orientation_no_north_is_claimed():
    whole = reduction()
    sequence = whole.sequence
    blind = replace(sequence.science[0], position_angles=None)
    summary = summarise(replace(whole, sequence=replace(sequence, science=(blind,))))
    assert "north" not in summary["sentence"]
    assert "counter-clockwise from up in the frame" in summary["sentence"]
    assert summary["frames"][0]["position_angle_deg"] is None


def test_every_status_comes_with_advice():
    for status in Status:
        assert advice(status, patterned=True).endswith(".")
        missing = "reference stars" in advice(status, patterned=False)
        assert missing == (status is Status.MODEL_MISMATCH)


def test_candidates_in_line_suggest_a_disk():
    whole = reduction()
    places = np.array([[0.5, 0.0], [-0.5, 0.02], [0.3, 0.01]])
    errors = torch.full((3,), 1e-6, dtype=torch.float64)
    three = replace(Candidates.at(places, np.full(3, 1e-5)), detection_errors=errors)
    detection = replace(whole.detection, sources=three, false_alarm=np.zeros(3))
    crowded = replace(whole, detection=detection)
    suggestion = "repeat the reduction with the option disk"
    assert len(crowded.detection.candidates) == 3
    assert str(crowded).endswith(f"{suggestion}.")
    assert suggestion in crowded._repr_html_()
    assert suggestion in summarise(crowded)["status"]["advice"]
    said = summarise(crowded)
    assert said["sentence"].startswith("The candidates are in line with the star")
    assert {each["false_alarm_probability"] for each in said["candidates"]} == {None}
    # So does a residual that is not explained by an unknown detector pattern.
    poor = replace(whole, fit=replace(whole.fit, chi2_per_pixel=9.0))
    flat = np.zeros((4, 4))
    patterned = replace(poor, pattern=dr.DetectorPattern(flat, flat, (1.0, 1.0), 0.02))
    assert "far above the noise" in str(patterned)
    hopeless = replace(crowded, fit=replace(whole.fit, chi2_per_pixel=1.2e5))
    assert "the star is behind the mask where the header says" in hopeless.remark
    assert "disk=True" not in hopeless.remark
    # One candidate, an unknown pattern, or light of a disk that was fitted already.
    away = SimpleNamespace(offsets=np.array([[0.0, 0.9], [0.0, -0.9]]))
    fitted = [replace(each, disk=cast(dr.detection.Disk, away)) for each in (crowded, patterned)]
    assert [each.remark for each in (whole, poor, *fitted)] == [""] * 4
    assert "disk" not in str(whole)
    # Sources of the disk 0.1 arcsec from one candidate, and at another.
    on_two = SimpleNamespace(offsets=np.array([[0.5, 0.1], [0.3, 0.01], [0.0, 0.9]]))
    part = replace(crowded, disk=cast(dr.detection.Disk, on_two)).remark
    assert part.startswith("On the extended light, candidates at 0.30, 0.50 arcsec may be parts")


@pytest.mark.parametrize(
    ("places", "reason"),
    [
        ([[0.5, 0.0], [-0.5, 0.02], [0.3, 0.01]], "in line with the star"),
        ([[1.0, 0.0], [1.1, 0.1], [1.0, 0.2], [0.0, -1.0]], "next to each other"),
        ([[0.5, 0.0], [-0.5, 0.5], [0.0, 0.6]], ""),
        ([[1.0, 0.0], [-1.0, 0.0]], ""),
    ],
    ids=["edge-on disk", "arc", "three planets", "two opposite"],
)
def test_extended_light_is_told_by_the_arrangement(places, reason):
    said = looks_extended(sources(np.array(places)), 0.14, 2.4)
    assert reason in said
    assert bool(said) == bool(reason)


@pytest.mark.parametrize(
    ("write", "values", "text"),
    [
        (pages.plus_minus, (0.82345, 0.00213), "0.823 ± 0.002"),
        (pages.plus_minus, (149.64, 0.134), "149.64 ± 0.13"),
        (pages.plus_minus, (149.64, 13.4), "150 ± 13"), (pages.scientific, (0.0,), "0"),
        (pages.plus_minus, (0.5, float("nan")), "0.500 ± nan"),
        (pages.scientific, (4.5e-6,), "4.5 × 10⁻⁶"), (pages.scientific, (9.99e-6,), "1.0 × 10⁻⁵"),
    ],
)  # fmt: skip
def test_errors_decide_on_the_digits(write, values, text):
    assert write(*values) == text


def test_probabilities_of_false_alarms():
    assert [pages.probability(p) for p in (0.25, 3e-5, 1e-300)] == ["0.25", "3.0 × 10⁻⁵", "< 10⁻⁹"]
    (row,) = summarise(reduction())["candidates"]
    assert row["snr"] > 8
    assert 0 <= row["false_alarm_probability"] < 1e-9
    # Nothing is stated where the model does not explain the data.
    unknown = replace(reduction().detection, false_alarm=np.array([np.nan]))
    (row,) = summarise(replace(reduction(), detection=unknown))["candidates"]
    assert row["false_alarm_probability"] is None
    assert pages.probability(None) == "not stated"


def test_the_summary_has_the_numbers_of_the_result(folder):
    summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    result = reduction()
    (row,), (entry,) = result.detection.candidates, summary["candidates"]
    columns = {
        "separation_arcsec": "separation", "position_angle_deg": "position_angle",
        "delta_mag": "delta_mag", "delta_ra_arcsec": "delta_ra",
    }  # fmt: skip
    assert entry["contrast"] == row["contrast"]
    assert {key: entry[key] for key in columns} == {k: row[c].value for k, c in columns.items()}
    assert entry["epoch"] == "2022-10-03T00:00:00"
    assert summary["star"] is None  # Photons of a simulation.
    assert summary["target"] == "HD 1"
    assert summary["status"]["name"] == result.fit.status.name
    assert summary["fit"]["reduced_chi2"] == result.fit.reduced_chi2
    assert summary["opd"]["days_before_first_frame"] == pytest.approx(1.5)
    assert [each["file"] for each in summary["frames"]] == ["frame <1>.fits"]
    reasons = [each["reason"] for each in summary["left_out"]]
    assert reasons == ["taken through F356W, not F444W", "too faint"]
    assert (summary["settings"]["cycles"], summary["settings"]["robust"]) == ([6.0], "inf")
    assert summary["versions"]["pyklip_diffrender"] == dr.__version__
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert summary["sentence"] in page.replace("\u00a0", " ")
    words = Tags(page).words
    at = words.index("Astrometry and photometry")
    offset = pages.plus_minus(entry["delta_ra_arcsec"], entry["delta_ra_error_arcsec"])
    assert offset in words[at:]
    assert "Flux density (Jy)" not in words


@pytest.mark.parametrize(
    ("days", "chi2", "remarks"),
    [
        (6.9, 0.95, ()),
        (-49.7, 0.95, ("The OPD map was sensed 50 days after the frames.",)),
        (49.7, 0.62, ("sensed 50 days before the frames.", "0.62; below 1 because the errors")),
    ],
)
def test_what_a_number_means_is_said_where_it_is_odd(days, chi2, remarks):
    summary = summarise(reduction())
    summary["opd"]["days_before_first_frame"] = days
    summary["fit"]["reduced_chi2"] = chi2
    text = page(summary, ReportPictures())
    assert all(each in text for each in remarks)
    assert ("is a better start" in text) == (abs(days) > 7)
    assert ("below 1 because" in text) == (chi2 < 0.9)


def test_files_that_are_left_out_for_one_reason_are_one_row():
    other = [{"name": f"{name}.fits", "reason": "taken through F356W"} for name in "abcd"]
    summary = summarise(reduction()) | {"left_out": [*other, {"name": "e", "reason": "too faint"}]}
    text = page(summary, ReportPictures())
    assert text.count("taken through F356W") == 1
    assert "4 files, a.fits to d.fits" in text
    assert "b.fits" not in text
    assert by_reason([("a", "x"), ("b", "y"), ("c", "x")]) == [("a, c", "x"), ("b", "y")]


def test_calibrated_frames_have_flux_densities_on_the_page():
    summary = summarise(reduction())
    summary["star"] = {
        "flux_density_Jy": 0.41, "flux_density_error_Jy": 0.05, "source": "diffracted light"
    }  # fmt: skip
    summary["candidates"][0] |= {"flux_density_Jy": 1.2e-4, "flux_density_error_Jy": 1e-5}
    words = Tags(page(summary, ReportPictures())).words
    assert "0.41 ± 0.05 Jy, from its diffracted light" in words
    assert pages.scientific(1.2e-4, 1e-5) in words


def test_every_picture_has_words_and_nothing_is_loaded(folder):
    page = Tags((folder / "report.html").read_text(encoding="utf-8"))
    pictures = [attributes for tag, attributes in page.tags if tag == "img"]
    # Three of the whole, the curve, one of the candidate, three of the frame and of the wavefront.
    assert len(pictures) == 11
    for attributes in pictures:
        assert len(attributes["alt"] or "") > 30
        assert (attributes["src"] or "").startswith("data:image/png;base64,")
    assert not {"script", "link", "iframe", "object"} & {tag for tag, _ in page.tags}
    assert all((a.get("src") or "data:").startswith("data:") for _, a in page.tags)
    picture = pages.Picture(drawing.panel().figure, "")
    assert picture.uri.startswith("data:image/png;base64,iVBOR")
    # Links are to the files beside it.
    linked = {a["href"] for _, a in page.tags if "href" in a}
    assert linked == {each.name for each in folder.iterdir()}
    assert "http" not in " ".join(page.words)


@pytest.mark.slow
def test_a_header_cannot_write_into_the_page(tmp_path, monkeypatch):
    monkeypatch.setattr("pyklip_diffrender.drawing.to_png", lambda *_, **__: b"\x89PNG")
    result = replace(shown()["Reduction"], pattern=None, failed=((HOSTILE, HOSTILE),))
    html, data = reported(result, tmp_path, [tmp_path / HOSTILE.replace("/", "")])
    text = html.read_text(encoding="utf-8")
    assert text.count(str(escape(HOSTILE))) > 8
    tags = Tags(text).tags
    assert not [tag for tag, attributes in tags if tag == "script" or "onerror" in attributes]
    assert len([tag for tag, _ in tags if tag == "img"]) == 11
    assert json.loads(data.read_text(encoding="utf-8"))["target"] == HOSTILE


@pytest.fixture
def _few_pictures(monkeypatch):
    """Draw the S/N map and the contrast curve alone, and not as pixels."""
    monkeypatch.setattr("pyklip_diffrender.drawing.to_png", lambda *_, **__: b"no picture")
    for name in ("_candidate", "_star", "_wavefront"):
        monkeypatch.setattr(f"pyklip_diffrender.reduction.pictures.{name}", lambda *_: [])


@pytest.mark.usefixtures("_few_pictures")
def test_with_reference_frames_klip_is_shown_beside(tmp_path):
    whole = reduction()
    star = replace(whole.sequence.science[0], reference=True)
    noise = star.error * np.random.default_rng(1).standard_normal(star.data.shape)
    sequence = replace(whole.sequence, references=(replace(star, data=star.data + noise),))
    unused = Contribution(star.name, star.target, "not used", "only 1 frame of its star")
    sequence = replace(sequence, excluded=())
    beside = replace(whole, sequence=sequence, failed=(), visit=Visit((unused,)))
    html, data = reported(beside, tmp_path)
    summary = json.loads(data.read_text(encoding="utf-8"))
    curve = summary["klip_curve"]
    assert [each["use"] for each in summary["frames"]] == ["target", "KLIP only"]
    page = " ".join(html.read_text(encoding="utf-8").split())
    assert "1 frame of reference stars: 1 KLIP only" in page
    assert "only 1 frame of its star" in page
    assert "No file was left out, but 1 reference frame took no part in the fit" in page
    assert set(curve) == {
        "sigmas", "separation_arcsec", "contrast", "small_sample", "modes", "throughput",
    }  # fmt: skip
    # Farther out than that there is something left of a planet.
    assert min(curve["contrast"][4:]) > 0
    assert "Squares: KLIP RDI (1 reference frame, 1 mode)" in html.read_text(encoding="utf-8")


def test_images_have_north_up():
    """The planet is at its position angle on the sky in ours, in KLIP's, and in the S/N map."""
    whole = reduction()
    star = replace(whole.sequence.science[0], reference=True)
    # A reference without the planet, which is in the lower left.
    fitted = whole.detection.fit.frames[0]
    alone = replace(star, data=fitted.star[None] + 0.1 * star.error)
    klip = Klip.of(replace(whole, sequence=replace(whole.sequence, references=(alone,))))
    assert klip.label == "KLIP RDI (1 reference frame, 1 mode)"
    images = SkyImages(whole)
    overview = Overview(images, klip)
    wrong = [replace(PLANET, position_angle=angle).offset for angle in (10.0, 70.0, -40.0, 220.0)]
    for image, grid in ((images.combined[0], images.grid), (images.posterior_mean, images.grid),
                        (klip.image, klip.grid),
                        (images.turned(whole.detection.snr), images.grid)):  # fmt: skip
        # Its position on the frame, turned twice, mirrored, and on the other side.
        light, *others = (
            np.nansum(image[np.hypot(*(grid - place).T).T < 0.1]) for place in
            (PLANET.offset, *wrong)
        )  # fmt: skip
        assert light > 2 * np.abs(others).max()
    # Four standard deviations.
    (circled,) = overview._places
    assert np.hypot(*(circled - PLANET.offset)) < 0.05


def test_images_of_the_sky_are_written_with_coordinates(tmp_path):
    whole = reduction()
    images = SkyImages(whole)
    with fits.open(images.write(tmp_path / "images.fits")) as hdus:
        names = [hdu.name for hdu in hdus[1:]]
        assert names == [
            "COMBINED", "COMBINED_ERROR", "THROUGHPUT", "POSTERIOR_MEAN", "POSTERIOR_MEAN_ERROR",
            "CONTRAST", "CONTRAST_ERROR", "SNR",
        ]  # fmt: skip
        (row,) = whole.detection.candidates
        image, wcs = np.nan_to_num(hdus["SNR"].data), WCS(hdus["POSTERIOR_MEAN"].header)
        y, x = np.unravel_index(image.argmax(), image.shape)
        star = wcs.pixel_to_world(images.grid.shape[1] // 2, images.grid.shape[0] // 2)
        peak = wcs.pixel_to_world(int(x), int(y))
        # To a pixel of 0.063 arcsec, at 0.6 arcsec.
        assert star.separation(peak).arcsec == pytest.approx(row["separation"].value, abs=0.07)
        angle = star.position_angle(peak).deg
        assert angle == pytest.approx(row["position_angle"].value, abs=8.0)
        np.testing.assert_array_equal(hdus["POSTERIOR_MEAN"].data, images.posterior_mean)
        # Far from planet and star it scatters as its errors say.
        away = np.hypot(*np.moveaxis(images.grid - PLANET.offset, -1, 0)) > 0.35
        away &= (np.hypot(*np.moveaxis(images.grid, -1, 0)) > 0.3) & np.isfinite(image)
        scatter = (hdus["POSTERIOR_MEAN"].data / hdus["POSTERIOR_MEAN_ERROR"].data)[away].std()
        assert scatter == pytest.approx(1.0, abs=0.3)
        ratio = hdus["CONTRAST"].data[y, x] / hdus["CONTRAST_ERROR"].data[y, x]
        # The ratio of interpolated values, and the interpolated ratio.
        assert ratio == pytest.approx(hdus["SNR"].data[y, x], rel=0.05)
        # The mean has the noise of the frames.
        noise = np.nanmedian(hdus["COMBINED_ERROR"].data)
        assert 0.5 < noise / np.nanmedian(whole.detection.observation.error) < 2


def test_a_first_look_has_no_error_of_the_most_probable_image(tmp_path):
    quick = SkyImages(replace(reduction(), accuracy="quick"))
    with fits.open(quick.write(tmp_path / "images.fits")) as hdus:
        assert "POSTERIOR_MEAN" in hdus
        assert "POSTERIOR_MEAN_ERROR" not in hdus


@pytest.mark.usefixtures("_few_pictures")
def test_injected_planets_and_completeness_have_sections(tmp_path):
    planets = QTable(
        {
            "separation": np.linspace(0.3, 0.9, 4) * u.arcsec,
            "position_angle": np.linspace(0, 300, 4) * u.deg,
            "injected": np.full(4, 1e-5), "contrast": np.linspace(0.9e-5, 1.3e-5, 4),
            "contrast_error": np.full(4, 1.5e-6), "snr": np.full(4, 7.0),
            "detected": np.arange(4) > 0,
        },
        meta={"strength": 1.6},
    )  # fmt: skip
    fractions = QTable(
        {
            "separation": np.repeat([0.4, 0.8], 3) * u.arcsec,
            "contrast": np.array([1, 2, 4, 1, 2, 4]) * 1e-5,
            "completeness": [0.0, 0.5, 1.0, 0.2, 0.6, 0.7], "planets": np.full(6, 10),
        },
        meta={
            "threshold": 5.0, "false_alarm": 1e-4, "separation_arcsec": [0.4, 0.8],
            "contrast_50": [2e-5, 1.75e-5], "contrast_95": [3.8e-5, np.nan],
        },
    )  # fmt: skip
    whole = replace(reduction(), injections=planets, completeness=fractions)
    names = [path.name for path in whole.write(tmp_path)]
    for name, table in (("injections", planets), ("completeness", fractions)):
        assert f"{name}.ecsv" in names
        read = QTable.read(tmp_path / f"{name}.ecsv")
        assert all(list(read[each]) == list(table[each]) for each in table.colnames)
    summary = json.loads((tmp_path / "summary.json").read_text(encoding="utf-8"))
    injections, completeness = summary["injections"], summary["completeness"]
    text = " ".join((tmp_path / "report.html").read_text(encoding="utf-8").split())
    assert len(injections["planets"]) == injections["count"] == 4
    assert "3 of 4 were detected." in text
    # -0.67, 0.22, 1.11 and 2 standard deviations from the truth.
    assert injections["mean_ratio"] == pytest.approx(1.1)
    assert injections["within_one_error"] == 0.5
    assert injections["pull_deviation"] == pytest.approx(np.std([-6, 2, 10, 18], ddof=1) / 9)
    assert "is 1.10 ± 0.09" in text.replace("\u00a0", " ")
    assert completeness["contrast_50"] == [2e-5, 1.75e-5]
    assert completeness["contrast_95"] == [3.8e-5, None]
    assert "has a false candidate in 0.01 % of such fields" in text
    one = summarise(replace(reduction(), injections=planets[:1]))
    assert one["injections"]["pull_deviation"] is None
    text = page(one, ReportPictures())
    assert "0 of 1 were detected." in " ".join(text.split())
    assert "The mean of recovered" not in text


@pytest.mark.usefixtures("_few_pictures")
def test_a_failure_of_klip_does_not_break_the_report(tmp_path, caplog):
    whole = reduction()
    (star,) = whole.sequence.science
    sequence = replace(whole.sequence, references=(star.cutout(10),))
    _, data = reported(replace(whole, sequence=sequence), tmp_path)
    assert "the report has no comparison with KLIP" in caplog.text
    assert json.loads(data.read_text(encoding="utf-8"))["klip_curve"] is None


def test_a_report_that_fails_leaves_the_old_one(tmp_path):
    (tmp_path / "report.html").write_text("old")
    with pytest.raises(AttributeError):
        reported(replace(reduction(), wide=cast(Any, "broken")), tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["report.html"]
    assert (tmp_path / "report.html").read_text() == "old"


@pytest.mark.parametrize(
    ("klip", "said"),
    [
        (
            [4e-5, 4e-6, 1e-5],
            "Without a small-sample correction of either, this reduction is 4.0 times deeper at "
            "0.40 arcsec and KLIP is 1.2 times deeper at 0.80 arcsec; with it, this reduction is "
            "2.0 to 10.0 times deeper at 0.40 to 0.80 arcsec.",
        ),
        ([None, None, None], "no limits can be compared; with it, this reduction is 2.0 to 10.0"),
    ],
    ids=["both", "KLIP has none"],
)
def test_the_report_says_who_is_deeper_where(klip, said):
    curve = {
        "separation_arcsec": [0.4, 0.8], "contrast": [1e-5, 4.8e-6], "small_sample": [2e-5, 5e-6]
    }  # fmt: skip
    # The last of KLIP's separations is beyond the curve.
    other = {
        "separation_arcsec": [0.4, 0.8, 1.2], "contrast": klip, "small_sample": [2e-4, 1e-5, 1e-5]
    }  # fmt: skip
    assert said in pages.depth_against_klip(curve, other)
    assert pages.depth_against_klip(curve, None) == ""
    assert pages.depth_against_klip(curve | {"separation_arcsec": [0.1, 0.2]}, other) == ""


def shown():
    """Objects that notebooks show, of frames with a hostile header and name."""
    whole = reduction()
    header = fits.Header({"TARGPROP": HOSTILE})
    evil = replace(whole.sequence.science[0], header=header, name=HOSTILE, filter=HOSTILE)
    sequence = dr.ExposureSequence(HOSTILE, (evil,), (), ((HOSTILE, HOSTILE),))
    part = replace(whole.fit.frames[0], observation=evil)
    fit = replace(whole.fit, frames=(part,), initial=replace(whole.fit.initial, name=HOSTILE))
    flat = np.zeros((4, 4))
    known = dr.DetectorPattern(
        flat, flat, (1.0, 1.0), 0.02, name=HOSTILE, filter=HOSTILE, provenance={"stars": [HOSTILE]}
    )
    detection = replace(whole.detection, stored_fit=fit)
    again = replace(whole, sequence=sequence, fit=fit, detection=detection, pattern=known)
    wide = dr.detection.WideField(
        detection, 5.0, flat, flat, flat, flat, detection.error_factor, detection.candidates,
        detection.contrast_curve,
    )  # fmt: skip
    disk = dr.detection.Disk(fit, (), flat, flat, flat, np.ones((1, 2)), np.ones(1), flat > 1, 9.0)
    values = (evil, sequence, fit, detection, again, whole.fit.model, known, fit.initial,
              wide, disk)  # fmt: skip
    return {type(value).__name__: value for value in values}


def test_a_notebook_shows_a_small_escaped_summary():
    for name, value in shown().items():
        assert len(repr(value)) < 400
        assert "array(" not in repr(value)
        if name not in ("Refinement", "Detection", "Reduction"):
            continue
        text = value._repr_html_()
        assert len(text) < 4000
        page = Tags(text)
        usual = {"div", "strong", "table", "thead", "tr", "th", "td"}
        assert not {tag for tag, _ in page.tags} - usual
        assert all(set(attributes) <= {"style", "id"} for _, attributes in page.tags)
        said = " ".join(page.words)
        assert name in said
        assert HOSTILE in said


BROWSER = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
)

SCRIPT = """
const page = frame.contentDocument.documentElement;
const pictures = [...page.querySelectorAll("img")];
report.textContent = JSON.stringify({
  scroll: page.scrollWidth, width: page.clientWidth,
  seen: pictures.every(each => each.naturalWidth > 300),
  dark: frame.contentWindow.matchMedia("(prefers-color-scheme: dark)").matches,
  ground: getComputedStyle(page.querySelector("body")).backgroundColor,
});
"""


@pytest.fixture(scope="module")
def whole_page(tmp_path_factory):
    html, _ = reported(reduction(), tmp_path_factory.mktemp("page"))
    return html.read_text(encoding="utf-8")


@pytest.mark.slow
@pytest.mark.skipif(BROWSER is None, reason="needs chromium or google-chrome in PATH")
@pytest.mark.parametrize(("width", "dark"), [(390, False), (1280, True)])
def test_the_page_fits_the_screen(whole_page, tmp_path, width, dark):
    holder, page = tmp_path / "holder.html", escape(whole_page)
    holder.write_text(
        f'<iframe id="frame" style="width:{width}px;height:900px" srcdoc="{page}"></iframe>'
        f'<pre id="report"></pre><script>onload = () => {{ {SCRIPT} }};</script>',
        encoding="utf-8",
    )
    done = subprocess.run(
        [
            str(BROWSER), "--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars",
            "--enable-logging=stderr",
            f"--user-data-dir={tmp_path / 'profile'}", "--virtual-time-budget=5000",
            f"--blink-settings=preferredColorScheme={0 if dark else 1}",
            f"--window-size={width + 100},1000", "--dump-dom", holder.as_uri(),
        ],
        capture_output=True, text=True, check=True, timeout=120,
    )  # fmt: skip
    # Errors and warnings of the page.
    assert ":CONSOLE" not in done.stderr
    (said,) = re.findall(r'<pre id="report">(.+?)</pre>', done.stdout)
    seen = json.loads(said)
    assert (seen["width"], seen["scroll"], seen["seen"]) == (width, width, True)
    ground = "rgb(20, 23, 26)" if dark else "rgb(255, 255, 255)"
    assert (seen["dark"], seen["ground"]) == (dark, ground)


@pytest.mark.slow
@pytest.mark.usefixtures("_few_pictures")
def test_the_search_of_whole_frames_has_a_section_of_its_own(tmp_path):
    inner = reduction().detection
    table = inner.candidates.copy()
    table["fit_chi2"], table["shape"] = 1.3, ""
    for name in ("fwhm_major", "fwhm_minor"):
        table[name] = np.nan * u.arcsec
    table["axis_angle"] = np.nan * u.deg
    wide = dr.detection.WideField(
        inner, 5.0, inner.contrast, inner.error, inner.snr, inner.grid, inner.error_factor, table,
        inner.contrast_curve,
    )  # fmt: skip
    written = replace(reduction(), wide=wide).write(tmp_path)
    assert tmp_path / "wide_field.fits" in written
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "<h2>Whole frames</h2>" in text
    assert "Chi-squared of a point source" in text
    summary = json.loads((tmp_path / "summary.json").read_text(encoding="utf-8"))
    (row,) = summary["wide_field"]["candidates"]
    assert row["fit_chi2"] == 1.3
    assert summary["sentence"].endswith("Nothing was found farther from the star, in the whole "
                                        "frames.")  # fmt: skip
    assert len(summary["wide_field"]["contrast_curve"]["contrast"]) == len(inner.contrast_curve)
    assert summarise(reduction())["wide_field"] is None
