"""Wavefront-sensing files, against stpsf's own loader."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from astropy import units as u
from astropy.io import fits
from astropy.table import Table
from astropy.time import Time
from stpsf_data import pupil, wss_file

from pyklip_diffrender.bridges import from_webbpsf, load_wss_opd, load_wss_opd_by_date, opd_to_hdus
from pyklip_diffrender.errors import (
    CorruptFileError,
    DiffrenderWarning,
    IncompatibleSetupError,
    MissingOPDError,
    UnitError,
)
from pyklip_diffrender.optics.grid import resample
from pyklip_diffrender.wavefront.opd import read_opd
from pyklip_diffrender.wavefront.wss import interpolate_wss

NPIX = 256


@pytest.fixture
def wss(tmp_path):
    path = tmp_path / "R2022081102-NRCA3_FP1-1.fits"
    wss_file(path)
    return path


def test_it_is_the_map_that_stpsf_loads(stpsf_path, wss):
    import stpsf

    instrument = stpsf.NIRCam()
    instrument.filter = "F444W"
    instrument.image_mask, instrument.pupil_mask = "MASK335R", "MASKRND"
    instrument.pupil = str(stpsf_path / f"jwst_pupil_RevW_npix{NPIX}.fits.gz")
    instrument.load_wss_opd(str(wss), verbose=False)
    loaded = load_wss_opd(wss, npix=NPIX)
    truth = instrument.pupilopd[0].data
    instrument.pupilopd.close()
    assert np.abs(loaded.data - truth).max() <= 1e-12
    for turned in (np.flipud, np.fliplr, np.transpose):
        assert np.abs(turned(loaded.data) - truth).max() > 1e-8
    assert loaded.date == Time("2022-08-11T02:00:00")
    assert loaded.aperture == "NRCA3_FP1"
    assert any("sha256" in line for line in loaded.history)
    # Through a file or an HDUList it is the same PSF.
    call = {"monochromatic": 4.5e-6, "oversample": 1, "fov_pixels": 30}
    wanted = from_webbpsf(instrument, **call)()
    instrument.pupilopd = opd_to_hdus(loaded)
    assert np.abs((from_webbpsf(instrument, **call)() - wanted).numpy()).max() < 1e-12 * (
        wanted.max()
    )
    header = opd_to_hdus(loaded)[0].header
    assert header["DATE-OBS"] == "2022-08-11"
    assert header["APERNAME"] == "NRCA3_FP1"
    assert "subtracted SI WFE" in str(header["HISTORY"])


def test_finer_maps_are_placed_as_stpsf_places_them(stpsf_path, wss):
    from stpsf import mast_wss

    hdus = mast_wss.import_wss_opd(str(wss), npix_out=1024)
    loaded = load_wss_opd(wss, npix=1024, backout_si_wfe=False)
    inside = loaded.data != 0
    assert inside.mean() > 0.4
    assert np.abs(loaded.data - hdus[0].data)[inside].max() <= 1e-12
    hdus.close()


def test_without_stpsf_data_the_sum_can_be_read(wss, monkeypatch):
    monkeypatch.delenv("STPSF_PATH", raising=False)
    loaded = load_wss_opd(wss, npix=NPIX, backout_si_wfe=False)
    assert 4e-8 < loaded.data[loaded.data != 0].std() < 1e-7
    with pytest.raises(CorruptFileError, match="backout_si_wfe=False"):
        load_wss_opd(wss, npix=NPIX, backout_si_wfe=True)
    # Unless told otherwise it is read all the same, and said to be another map.
    with pytest.warns(DiffrenderWarning, match=r"as the sensing camera saw.*63 nm.*STPSF_PATH"):
        kept = load_wss_opd(wss, npix=NPIX)
    assert np.array_equal(kept.data, loaded.data)
    assert kept.history[-1].startswith("kept SI WFE")


def test_read_opd_recognises_the_file_by_its_content(stpsf_path, wss, tmp_path, monkeypatch):
    renamed = tmp_path / "map.fits"
    renamed.write_bytes(wss.read_bytes())
    with fits.open(wss) as hdus:
        coarse = hdus["RESULT_PHASE"].data.astype(float) * 1e-6
    # The finest pupil in stpsf's data has 256 samples.
    got, wanted = read_opd(renamed), load_wss_opd(wss, npix=NPIX, backout_si_wfe=True)
    assert np.array_equal(got.data, wanted.data)
    assert got.date == Time("2022-08-11T02:00:00")
    assert got.aperture == "NRCA3_FP1"
    # As it is, on its own samples, if the extension is asked for.
    assert np.allclose(read_opd(renamed, extension="RESULT_PHASE").data, coarse, rtol=1e-7)
    monkeypatch.delenv("STPSF_PATH")
    with pytest.warns(DiffrenderWarning, match="as the sensing camera saw"):
        summed = read_opd(renamed)
    assert summed.shape == (1024, 1024)
    inside = resample(pupil(NPIX), 1024) == 1
    assert np.corrcoef(summed.data[inside], resample(coarse, 1024)[inside])[0, 1] > 0.99
    assert np.corrcoef(summed.data[inside], resample(coarse[::-1], 1024)[inside])[0, 1] < 0.9
    with fits.open(wss) as hdus:
        hdus["RESULT_PHASE"].data[:] = 0
        hdus.writeto(tmp_path / "empty.fits")
    with pytest.raises(CorruptFileError, match="all values of RESULT_PHASE are zero"):
        read_opd(tmp_path / "empty.fits")


def test_interpolation_in_time_warns(wss, tmp_path):
    later = tmp_path / "R2022081402-NRCA3_FP1-1.fits"
    wss_file(later, seed=6, date="2022-08-14T02:00:00")
    maps = [load_wss_opd(path, npix=NPIX, backout_si_wfe=False) for path in (wss, later)]
    with pytest.warns(DiffrenderWarning, match=r"interpolation, 67% of R2022081102"):
        between = interpolate_wss(*maps, "2022-08-12T02:00:00")
    assert np.allclose(between.data, (2 * maps[0].data + maps[1].data) / 3, atol=1e-15)
    assert between.date == Time("2022-08-12T02:00:00")
    with pytest.raises(IncompatibleSetupError, match="not between"):
        interpolate_wss(*maps, "2022-08-15")


FIRST, SECOND = (f"R2022081102-NRCA3_FP1-{k}.fits" for k in (1, 2))

ROWS = [
    # Moment, file, correction and exposure, as MAST lists them: the later analysis first.
    ("2022-08-11T02:00", SECOND, "R2022081102", "V01163040001002002102101"),
    ("2022-08-11T02:00", FIRST, "R2022081102", "V01163040001002002102101"),
    ("2022-08-11T07:00", "R2022083106-NRCA3_FP1-1.fits", "R2022083106", "V01163041001002002102101"),
    ("2022-08-11T09:00", "R2022081103-NRCA3_FP1-1.fits", "R2022081103", "V0116304200100200210210E"),
    ("2022-08-14T02:00", "R2022081402-NRCA3_FP1-1.fits", "R2022081402", "V01163043001002002102101"),
]


@pytest.mark.parametrize("backwards", [False, pytest.param(True, marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    ("date", "choice", "names"),
    [
        ("2022-08-11T08:00", "before", [SECOND]),
        ("2022-08-11T08:00", "nearest", [SECOND]),
        ("2022-08-11T08:00", "closest", [SECOND]),
        ("2022-08-10T08:00", "after", [SECOND]),
        ("2022-08-11T02:00", "after", [SECOND]),
        ("2022-08-11T08:00", "after", ["R2022081402-NRCA3_FP1-1.fits"]),
        ("2022-08-13T08:00", "nearest", ["R2022081402-NRCA3_FP1-1.fits"]),
        ("2022-08-13T08:00", "interpolate", [SECOND, "R2022081402-NRCA3_FP1-1.fits"]),
    ],
)
def test_by_date_through_stpsf(wss, tmp_path, monkeypatch, date, choice, names, backwards):
    """What stpsf leaves out of its tables is not used, and of one sensing the last analysis."""
    from stpsf import mast_wss

    def listed(when, days):
        rows = [
            (Time(moment).mjd, *facts)
            for moment, *facts in ROWS
            if abs((Time(moment) - when).to(u.day)) <= days
        ]
        names = ("date_obs_mjd", "fileName", "corr_id", "obs_id")
        return Table(rows=rows[:: -1 if backwards else 1] or None, names=names)

    fetched = []

    def fetch(name, output_path):
        assert output_path is None
        fetched.append(name)
        path = tmp_path / name
        wss_file(path, date=next(f"{row[0]}:00" for row in ROWS if row[1] == name))
        return str(path)

    monkeypatch.setattr(mast_wss, "mast_wss_date_query", listed)
    monkeypatch.setattr(mast_wss, "mast_retrieve_opd", fetch)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "the wavefront of .* is an interpolation")
        loaded = load_wss_opd_by_date(date, choice, npix=NPIX, backout_si_wfe=False)
    assert fetched == names
    assert loaded.name == " + ".join(names)
    with pytest.raises(MissingOPDError, match=r"no map before that date within 12 days"):
        load_wss_opd_by_date("2022-08-01", "before")


def test_an_archive_that_cannot_be_asked(monkeypatch):
    from stpsf import mast_wss

    def unreachable(when, days):
        raise ConnectionError("no route to host")

    monkeypatch.setattr(mast_wss, "mast_wss_date_query", unreachable)
    with pytest.raises(MissingOPDError, match=r"no route to host.*pass its path to load_wss_opd"):
        load_wss_opd_by_date("2022-08-11T08:00:00")
    with pytest.raises(IncompatibleSetupError, match="got 'latest', expected 'nearest'"):
        load_wss_opd_by_date("2022-08-11T08:00:00", "latest")


def test_files_that_are_something_else(wss, tmp_path):
    path = tmp_path / "other.fits"
    fits.PrimaryHDU(np.zeros((4, 4))).writeto(path)
    with pytest.raises(CorruptFileError, match="no extension RESULT_PHASE"):
        load_wss_opd(path)
    with pytest.raises(CorruptFileError, match="no such file"):
        load_wss_opd(tmp_path / "none.fits")
    with fits.open(wss) as hdus:
        values = hdus["RESULT_PHASE"].data
        hdus["RESULT_PHASE"].data = values * 1000
        hdus.writeto(tmp_path / "nanometres.fits")
        hdus["RESULT_PHASE"].data = values[::-1]
        hdus.writeto(tmp_path / "upside_down.fits")
        hdus["RESULT_PHASE"].data = values
        hdus["RESULT_PHASE"].header["BUNIT"] = "radian"
        hdus.writeto(tmp_path / "radians.fits")
        hdus["RESULT_PHASE"].header["BUNIT"] = "micron"
        date = hdus[0].header["DATE-OBS"]
        hdus[0].header["DATE-OBS"] = "yesterday"
        hdus.writeto(tmp_path / "undated.fits")
        hdus[0].header["DATE-OBS"] = date
        del hdus["RESULT_PHASE"].header["BUNIT"]
        del hdus[0].header["APERNAME"], hdus[0].header["DATE-OBS"]
        hdus.writeto(tmp_path / "R2023010203-NRCA3_FP1-1.fits")
    with pytest.raises(UnitError, match="must be in metres"):
        load_wss_opd(tmp_path / "nanometres.fits", npix=NPIX, backout_si_wfe=False)
    with pytest.warns(DiffrenderWarning, match="upside down"):
        load_wss_opd(tmp_path / "upside_down.fits", npix=NPIX, backout_si_wfe=False)
    with pytest.raises(IncompatibleSetupError, match="'radian'"):
        load_wss_opd(tmp_path / "radians.fits", npix=NPIX, backout_si_wfe=False)
    with pytest.raises(CorruptFileError, match=r"undated\.fits: DATE-OBS.*yesterday"):
        load_wss_opd(tmp_path / "undated.fits", npix=NPIX, backout_si_wfe=False)
    bare = tmp_path / "R2023010203-NRCA3_FP1-1.fits"
    loaded = load_wss_opd(bare, npix=NPIX, backout_si_wfe=False)
    assert loaded.date == Time("2023-01-02")


def test_the_sensing_camera_must_be_known(stpsf_path, wss, tmp_path):
    with fits.open(wss) as hdus:
        del hdus[0].header["APERNAME"]
        hdus.writeto(tmp_path / "nameless.fits")
        hdus[0].header["APERNAME"] = "NRCA3_FP9"
        hdus.writeto(tmp_path / "unknown.fits")
    with pytest.raises(CorruptFileError, match="no APERNAME"):
        load_wss_opd(tmp_path / "nameless.fits", npix=NPIX, backout_si_wfe=True)
    with pytest.raises(CorruptFileError, match="NRCA3_FP9"):
        load_wss_opd(tmp_path / "unknown.fits", npix=NPIX, backout_si_wfe=True)
    with pytest.warns(DiffrenderWarning, match=r"nameless\.fits.*no APERNAME"):
        load_wss_opd(tmp_path / "nameless.fits", npix=NPIX)
