"""Wavefront-sensing files, against stpsf's own loader."""

import numpy as np
import pytest
from astropy import units as u
from astropy.io import fits
from astropy.table import Table
from astropy.time import Time

from benchmarks.stpsf_data import nircam, pupil, wss_file
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

NPIX = 256
FIRST, SECOND = (f"R2022081102-NRCA3_FP1-{k}.fits" for k in (1, 2))
LATER = "R2022081402-NRCA3_FP1-1.fits"


@pytest.fixture
def wss(tmp_path):
    path = tmp_path / "R2022081102-NRCA3_FP1-1.fits"
    wss_file(path)
    return path


def test_it_is_the_map_that_stpsf_loads(stpsf_path, wss):
    instrument = nircam(stpsf_path)
    instrument.load_wss_opd(str(wss), verbose=False)
    loaded = load_wss_opd(wss, npix=NPIX)
    truth = instrument.pupilopd[0].data
    instrument.pupilopd.close()
    assert np.abs(loaded.data - truth).max() <= 1e-12
    assert any("sha256" in line for line in loaded.history)
    # Through a file or an HDUList it is the same PSF.
    call = {"monochromatic": 4.5e-6, "oversample": 1, "fov_pixels": 30}
    wanted = from_webbpsf(instrument, **call)()
    instrument.pupilopd = opd_to_hdus(loaded)
    found = from_webbpsf(instrument, **call)()
    assert float((found - wanted).abs().max()) < 1e-12 * float(wanted.max())
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
    with pytest.raises(CorruptFileError, match="backout_si_wfe=False"):
        load_wss_opd(wss, npix=NPIX, backout_si_wfe=True)
    # Unless told otherwise it is read all the same, and said to be another map.
    with pytest.warns(DiffrenderWarning, match=r"as the sensing camera saw.*63 nm.*STPSF_PATH"):
        summed = read_opd(renamed)
    assert summed.history[-1].startswith("kept SI WFE")
    assert summed.shape == (1024, 1024)
    inside = resample(pupil(NPIX), 1024) == 1
    assert np.corrcoef(summed.data[inside], resample(coarse, 1024)[inside])[0, 1] > 0.99
    assert np.corrcoef(summed.data[inside], resample(coarse[::-1], 1024)[inside])[0, 1] < 0.9


ROWS = [
    # Moment, file, correction and exposure, as MAST lists them: the later analysis first.
    ("2022-08-11T02:00", SECOND, "R2022081102", "V01163040001002002102101"),
    ("2022-08-11T02:00", FIRST, "R2022081102", "V01163040001002002102101"),
    ("2022-08-11T07:00", "R2022083106-NRCA3_FP1-1.fits", "R2022083106", "V01163041001002002102101"),
    ("2022-08-11T09:00", "R2022081103-NRCA3_FP1-1.fits", "R2022081103", "V0116304200100200210210E"),
    ("2022-08-14T02:00", LATER, "R2022081402", "V01163043001002002102101"),
]


@pytest.mark.parametrize(
    ("date", "choice", "names", "order"),
    [
        ("2022-08-11T08:00", "before", [SECOND], 1), ("2022-08-11T08:00", "before", [SECOND], -1),
        ("2022-08-11T08:00", "closest", [SECOND], 1), ("2022-08-11T02:00", "after", [SECOND], 1),
        ("2022-08-11T08:00", "after", [LATER], 1), ("2022-08-13T08:00", "nearest", [LATER], 1),
        ("2022-08-13T08:00", "interpolate", [SECOND, LATER], -1),
    ],
)  # fmt: skip
@pytest.mark.filterwarnings("ignore:the wavefront of .* is an interpolation")
def test_by_date_through_stpsf(wss, tmp_path, monkeypatch, date, choice, names, order):
    """What stpsf leaves out of its tables is not used, and of one sensing the last analysis."""
    from stpsf import mast_wss

    def listed(when, days):
        near = [row for row in ROWS if abs((Time(row[0]) - when).to(u.day)) <= days]
        rows = [(Time(moment).mjd, *facts) for moment, *facts in near]
        names = ("date_obs_mjd", "fileName", "corr_id", "obs_id")
        return Table(rows=rows[::order] or None, names=names)

    fetched = []

    def fetch(name, output_path):
        assert output_path is None
        fetched.append(name)
        path = tmp_path / name
        wss_file(path, date=next(f"{row[0]}:00" for row in ROWS if row[1] == name))
        return str(path)

    monkeypatch.setattr(mast_wss, "mast_wss_date_query", listed)
    monkeypatch.setattr(mast_wss, "mast_retrieve_opd", fetch)
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


def altered(change, tmp_path, name="altered.fits"):
    """A sensing file with a change of its primary header, or of the map."""
    wss_file(tmp_path / name)
    with fits.open(tmp_path / name, mode="update") as hdus:
        change(hdus[0].header, hdus["RESULT_PHASE"])
    return tmp_path / name


REFUSED = {
    "must be in metres": (UnitError, lambda _, image: np.multiply(image.data, 1e3, image.data)),
    "all values of RESULT_PHASE are zero": (CorruptFileError, lambda _, image: image.data.fill(0)),
    "'radian'": (IncompatibleSetupError, lambda _, image: image.header.set("BUNIT", "radian")),
    r"altered\.fits: DATE-OBS.*yesterday": (
        CorruptFileError, lambda header, _: header.set("DATE-OBS", "yesterday")
    ),
    "no APERNAME": (CorruptFileError, lambda header, _: header.remove("APERNAME")),
    "NRCA3_FP9": (CorruptFileError, lambda header, _: header.set("APERNAME", "NRCA3_FP9")),
}  # fmt: skip


@pytest.mark.parametrize("complaint", REFUSED)
def test_files_that_are_something_else(stpsf_path, tmp_path, complaint):
    expected, change = REFUSED[complaint]
    path = altered(change, tmp_path)
    with pytest.raises(expected, match=complaint):
        load_wss_opd(path, npix=NPIX, backout_si_wfe="APER" in complaint or "FP9" in complaint)


def test_odd_files_are_read_with_a_warning(stpsf_path, tmp_path):
    def flip(_, image):
        image.data = image.data[::-1].copy()

    with pytest.warns(DiffrenderWarning, match="upside down"):
        load_wss_opd(altered(flip, tmp_path), npix=NPIX, backout_si_wfe=False)

    def bare(header, image):
        image.header["BUNIT"] = "micron"
        del header["APERNAME"], header["DATE-OBS"]

    path = altered(bare, tmp_path, "R2023010203-NRCA3_FP1-1.fits")
    with pytest.warns(DiffrenderWarning, match=r"R2023010203.*no APERNAME"):
        assert load_wss_opd(path, npix=NPIX).date == Time("2023-01-02")
    fits.PrimaryHDU(np.zeros((4, 4))).writeto(tmp_path / "other.fits")
    for name, complaint in (("other", "no extension RESULT_PHASE"), ("none", "no such file")):
        with pytest.raises(CorruptFileError, match=complaint):
            load_wss_opd(tmp_path / f"{name}.fits")
