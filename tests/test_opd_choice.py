"""Choosing an OPD map by its date."""

import logging

import numpy as np
import pytest
from astropy.io import fits
from astropy.time import Time

from benchmarks.stpsf_data import wss_file
from pyklip_diffrender import errors
from pyklip_diffrender.io import sensing_date
from pyklip_diffrender.optics.grid import resample
from pyklip_diffrender.reduction import ReduceOptions
from pyklip_diffrender.reduction.pipeline import prepare
from pyklip_diffrender.scene.observation import Observation
from pyklip_diffrender.scene.sequence import ExposureSequence
from pyklip_diffrender.wavefront import random_opd
from pyklip_diffrender.wavefront.opd import choose_opd, opd_for, read_opd
from pyklip_diffrender.wavefront.wss import interpolate_wss

NPIX = 64

# Kept without stpsf's data, which is not the subject here.
pytestmark = pytest.mark.filterwarnings("ignore:.*as the sensing camera saw")


def write_map(path, seed, npix=NPIX, **cards):
    hdu = fits.PrimaryHDU(random_opd(seed, npix=npix).data * 1e9)
    hdu.header["BUNIT"] = "nm"
    hdu.header.update({key.replace("_", "-"): value for key, value in cards.items()})
    hdu.writeto(path)
    return path


@pytest.fixture(autouse=True)
def without_stpsf_data(monkeypatch):
    monkeypatch.delenv("STPSF_PATH", raising=False)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Maps of 1 August (header), 11 August (a file of MAST) and 21 August (file name)."""
    maps = tmp_path_factory.mktemp("maps")
    write_map(maps / "first.fits.gz", 1, DATE_OBS="2022-08-01", TIME_OBS="12:00:00")
    wss_file(maps / "R2022081102-NRCA3_FP1-1.fits", date="2022-08-11T12:00:00")
    write_map(maps / "opd_2022-08-21.fits", 3)
    return maps


@pytest.mark.parametrize(
    ("date", "rule", "name", "note"),
    [
        ("2022-08-07", "nearest", "R2022081102-NRCA3_FP1-1.fits", "4.5 days after"),
        ("2022-08-10T12:00", "before", "first.fits.gz", "9.0 days before"),
        ("2022-08-12", "after", "opd_2022-08-21.fits", "9.0 days after"),
        ("2022-08-21", "interpolate", "opd_2022-08-21.fits", "0.0 days"),
        ("2022-10-21", "nearest", "opd_2022-08-21.fits", "61.0 days before"),
    ],
)
def test_the_rule_decides(folder, date, rule, name, note):
    opd = choose_opd(folder, date, rule)
    assert opd.name == name
    assert np.array_equal(opd.data, read_opd(folder / name).data)
    assert note in opd.history[-1]
    assert "of 3 maps" in opd.history[-1]
    assert opd.days_after(date) == pytest.approx((opd.date - Time(date)).to_value("day"))


def test_interpolation_is_linear_in_time_at_the_finer_sampling(tmp_path):
    write_map(tmp_path / "a_2022-08-01.fits", 1, npix=32)
    write_map(tmp_path / "b_2022-08-11.fits", 2, npix=64)
    with pytest.warns(errors.DiffrenderWarning, match=r"interpolation, 80% of a_2022-08-01\.fits"):
        opd = choose_opd(tmp_path, "2022-08-03", "interpolate")
    first, second = (read_opd(path).data for path in sorted(tmp_path.iterdir()))
    np.testing.assert_allclose(opd.data, 0.8 * resample(first, 64) + 0.2 * second, atol=1e-18)
    assert opd.date == Time("2022-08-03")
    assert "2.0 days before" in opd.history[-1]
    assert "8.0 days after" in opd.history[-1]
    maps = [read_opd(path) for path in sorted(tmp_path.iterdir())]
    with pytest.raises(errors.IncompatibleSetupError, match="not between"):
        interpolate_wss(*maps, "2022-08-15")


@pytest.mark.parametrize(
    ("date", "rule", "side"),
    [("2022-07-01", "before", "before"), ("2022-09-01", "interpolate", "after")],
)
def test_no_map_on_that_side(folder, date, rule, side):
    with pytest.raises(errors.MissingOPDError, match=rf"{side} {date}.*2022-08-01 to 2022-08-21"):
        choose_opd(folder, date, rule)


def test_other_files_are_skipped_and_logged(tmp_path, caplog):
    write_map(tmp_path / "first.fits", 1, DATE_OBS="2022-08-01", TIME_OBS="12:00:00")
    write_map(tmp_path / "undated.fits", 4)
    write_map(tmp_path / "frames_2022-08-05.fits", 5, BUNIT="MJy/sr")
    fits.PrimaryHDU(np.ones((3, 8, 8))).writeto(tmp_path / "cube_2022-08-05.fits")
    cut = (tmp_path / "first.fits").read_bytes()[:3000]
    (tmp_path / "cut_2022-08-05.fits").write_bytes(cut)
    (tmp_path / "notes_2022-08-05.txt").write_text("nothing")
    with caplog.at_level(logging.INFO):
        assert choose_opd(tmp_path, "2022-08-05").name == "first.fits"
    said = {record.args[0]: record.getMessage() for record in caplog.records if record.args}
    assert "no date" in said["undated.fits"]
    assert "BUNIT is 'MJy/sr'" in said["frames_2022-08-05.fits"]
    assert "no square image" in said["cube_2022-08-05.fits"]
    assert "not a complete FITS file" in said["cut_2022-08-05.fits"]
    assert "notes" not in caplog.text


def test_without_any_map_it_is_an_error(tmp_path):
    with pytest.raises(errors.MissingOPDError, match=r"none of its 0 FITS files"):
        choose_opd(tmp_path, "2022-08-05")
    write_map(tmp_path / "undated.fits", 4)
    for folder, rule, error, words in (
        (tmp_path, "nearest", errors.MissingOPDError, r"none of its 1 FITS files.*DATE-OBS"),
        (tmp_path / "nowhere", "nearest", errors.MissingOPDError, "no such folder"),
        (tmp_path, "closest", errors.IncompatibleSetupError, "'closest', expected one of nearest"),
    ):
        with pytest.raises(error, match=words):
            choose_opd(folder, "2022-08-05", rule)


def test_of_one_sensing_the_last_analysis_is_used(tmp_path, caplog):
    """In whatever order the files were written or are listed."""
    for number in (2, 10, 1):
        name = f"R2022081102-NRCA3_FP1-{number}.fits"
        wss_file(tmp_path / name, seed=number, date="2022-08-11T12:00:00")
    write_map(tmp_path / "opd.fits", 1, DATE_OBS="2022-08-01", TIME_OBS="12:00:00")
    opd = choose_opd(tmp_path, "2022-08-12", "before")
    assert opd.name == "R2022081102-NRCA3_FP1-10.fits"
    assert np.array_equal(opd.data, read_opd(tmp_path / opd.name).data)
    said = "in place of R2022081102-NRCA3_FP1-1.fits, R2022081102-NRCA3_FP1-2.fits"
    assert said in opd.history[-1]
    assert said in caplog.text
    # A later correction of it.
    wss_file(tmp_path / "O2022081103-NRCA3_FP1-1.fits", date="2022-08-11T12:00:00")
    assert choose_opd(tmp_path, "2022-08-11").name == "O2022081103-NRCA3_FP1-1.fits"


@pytest.mark.parametrize(
    ("cards", "name", "reason"),
    [
        ({"CORR_ID": "R2022083106"}, "renamed.fits", "R2022083106 has known faults"),
        ({}, "R2022083106-NRCA3_FP1-1.fits", "R2022083106 has known faults"),
        ({"OBS_ID": "V0116304200100200210210E"}, "R2022083105-NRCA3_FP1-1.fits", "in F187N"),
    ],
)
def test_maps_that_stpsf_leaves_out_are_skipped(tmp_path, caplog, cards, name, reason):
    wss_file(tmp_path / name, date="2022-08-31T12:00:00")
    wss_file(tmp_path / "R2022081102-NRCA3_FP1-1.fits", date="2022-08-11T12:00:00")
    good = {"CORR_ID": "R2022083107", "OBS_ID": "V01445001001002002102106"}
    caplog.set_level(logging.INFO)
    for given, chosen in ((cards, "R2022081102-NRCA3_FP1-1.fits"), (good, name)):
        with fits.open(tmp_path / name, mode="update") as hdus:
            hdus[0].header.update(given)
        assert choose_opd(tmp_path, "2022-08-31").name == chosen
    assert reason in caplog.text


def test_a_map_of_another_epoch_is_a_warning_with_the_days(folder):
    with pytest.warns(errors.DiffrenderWarning, match=r"opd_2022-08-21\.fits.* 223 days before"):
        choose_opd(folder, "2023-04-01")
    path = folder / "opd_2022-08-21.fits"
    with pytest.warns(errors.DiffrenderWarning, match=r" 232 days after the frames of 2022-01-01"):
        opd_for(path, Time("2022-01-01"))
    assert opd_for(path, Time("2022-08-01")).name == path.name


def test_a_folder_needs_the_date_of_the_frames(folder):
    assert opd_for(folder, Time("2022-08-01")).name == "first.fits.gz"
    with pytest.raises(errors.IncompatibleSetupError, match="the frames have no date"):
        opd_for(folder, None)
    with pytest.raises(errors.CorruptFileError, match=r"is a folder.*choose_opd"):
        read_opd(folder)


def test_a_reduction_takes_the_nearest_map_of_a_folder(folder):
    ones, facts = np.ones((8, 8)), {"pixelscale": 0.063, "filter": "F444W"}
    dates = (Time("2022-08-10"), Time("2022-08-18"))
    frames = tuple(Observation.from_arrays(ones, ones, date=date, **facts) for date in dates)
    sequence = ExposureSequence("star", frames)
    assert sequence.date == Time("2022-08-14")
    prepared = prepare(sequence, folder, ReduceOptions(size=8))
    assert prepared.wavefront.name == "R2022081102-NRCA3_FP1-1.fits"


@pytest.mark.parametrize(
    ("cards", "name", "expected"),
    [
        ({"DATE-OBS": "2022-08-11", "TIME-OBS": "02:00:00"}, "x", "2022-08-11T02:00:00"),
        ({"DATE-OBS": "2022-08-11T03:00:00", "TIME-OBS": "02:00"}, "x", "2022-08-11T03:00:00"),
        ({"DATE-BEG": "2022-08-11T04:00:00"}, "opd_2022-08-14", "2022-08-11T04:00:00"),
        ({}, "opd_2022-08-14.fits.gz", "2022-08-14T00:00:00"),
        ({}, "R2022081402-NRCA3_FP1-1.fits", "2022-08-14T00:00:00"),
        ({}, "opd_20220814.fits", "2022-08-14T00:00:00"), ({}, "jw0120220814.fits", None),
        ({}, "opd_2022-19-39.fits", None), ({}, "opd.fits", None),
    ],
)  # fmt: skip
def test_dates_of_maps(cards, name, expected):
    date = sensing_date(fits.Header(cards), name)
    assert (date and date.isot[:19]) == expected
