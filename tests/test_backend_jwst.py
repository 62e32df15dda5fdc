"""``algo="diffrender"`` on JWSTData: the recorded pixels, errors, flags and headers are used."""

import copy
from pathlib import Path

import numpy as np
import pytest
from astropy import units as u
from astropy.io import fits
from backend_scene import OPD, SHAPE, calints, reduced, render
from pyklip import fakes
from pyklip.instruments.JWST import JWSTData
from pyklip.klip import high_pass_filter

from pyklip_diffrender import pyklip_backend
from pyklip_diffrender.errors import DiffrenderWarning

NATIVE = (20.7, 25.2)
MIDDLE = ((SHAPE[1] - 1) / 2, (SHAPE[0] - 1) / 2)

pytestmark = pytest.mark.usefixtures("offline", "registered")


@pytest.fixture
def files(tmp_path, rng):
    """Two rolls of the target, two integrations each."""
    paths = []
    for i, roll in enumerate((0.0, 10.0, 0.0)):
        path = tmp_path / f"jw0138600{i}_calints.fits"
        calints(path, rng, roll, NATIVE, TARGPROP="TARGET" if i < 2 else "OTHER")
        paths.append(str(path))
    return paths[:2]


@pytest.fixture
def reference(files):
    """Another star, two integrations."""
    return [files[0].replace("jw01386000", "jw01386002")]


def reduce(dataset, folder, **kw):
    return reduced(dataset, folder, **kw)["x-KLmodes-all.fits"]


def test_reading_is_the_same_and_the_reader_is_put_back(files, reference):
    pyklip_backend.unregister()
    plain = JWSTData(files, reference)
    readdata = vars(JWSTData)["readdata"]
    with pyklip_backend.backend(opd=OPD):
        captured = JWSTData(files, reference)
        assert vars(JWSTData)["readdata"] is not readdata
        assert JWSTData.readdata.__doc__ == readdata.__doc__
    assert vars(JWSTData)["readdata"] is readdata
    new = set(vars(captured)) - set(vars(plain))
    assert new == {"_diffrender_source", "_diffrender_references"}
    for name, value in vars(plain).items():
        if isinstance(value, np.ndarray) and value.dtype != object:
            np.testing.assert_array_equal(getattr(captured, name), value)


def test_the_fit_gets_recorded_pixels_errors_flags_and_headers(files, rng):
    dataset = JWSTData(files)
    observation = pyklip_backend.observation_from_dataset(copy.deepcopy(dataset))
    recorded = np.concatenate([fits.getdata(path, "SCI") for path in files])
    good = observation.valid
    np.testing.assert_array_equal(observation.data[good], recorded[good])
    np.testing.assert_allclose(observation.error[good], 0.05, rtol=1e-6)
    # DO_NOT_USE, which pyKLIP leaves in, and NON_SCIENCE.
    assert not good[:, 30, 30].any()
    assert not good[:, 8, 9].any()
    assert good.sum() == good.size - 2 * len(good)
    np.testing.assert_allclose(observation.center, np.tile(NATIVE, (4, 1)))
    np.testing.assert_allclose(observation.position_angles, [0, 0, 10, 10])
    np.testing.assert_allclose(observation.pixelscale, 0.062424185)
    assert (observation.filter, observation.unit) == ("F444W", u.MJy / u.sr)
    assert observation.date.isot.startswith("2022-07-30T01:02:03")
    cards = observation.header
    assert (cards["CORONMSK"], cards["BUNIT"]) == ("MASKA335R", "MJy/sr")


def test_center_keywords_and_dithers(tmp_path, rng):
    path = tmp_path / "a_calints.fits"
    calints(path, rng)
    fits.setval(path, "STARCENX", value=22.0, ext=1)
    fits.setval(path, "STARCENY", value=24.0, ext=1)
    fits.setval(path, "XOFFSET", value=0.062424185)
    for kw, expected in (
        ({}, (22.0, 23.0)),
        ({"center_include_offset": False}, (21.0, 23.0)),
        ({"center_keywords": ["CRPIX1", "CRPIX2"]}, (21.7, 25.2)),
    ):
        observation = pyklip_backend.observation_from_dataset(JWSTData([str(path)], **kw))
        np.testing.assert_allclose(observation.center[0], expected)


def test_products_are_aligned_as_pyklip_aligns_and_keep_its_header(files, reference, tmp_path):
    runs = []
    options = {"save_ints": True, "time_collapse": "weighted-mean"}
    for algo in ("klip", "diffrender"):
        dataset = JWSTData(files, reference)
        runs.append((*reduce(dataset, tmp_path / algo, algo=algo, **options), dataset))
    (klip, klip_header, by_klip), (ours, header, dataset) = runs
    assert set(header) >= set(klip_header)
    for key in set(klip_header) - {"HISTORY"}:
        assert header[key] == klip_header[key]
    assert (header["PSFCENTX"], header["STARCENX"]) == (22.0, 23.0)
    np.testing.assert_array_equal(dataset.output_centers, by_klip.output_centers)
    assert dataset.allints.shape == (2, 1, 4, *SHAPE)
    assert (header["DRPIXELS"], header["DRNOISE"], header["DRFILT"]) == ("recorded", "ERR", "F444W")
    assert ours.shape == klip.shape
    assert header["BUNIT"] == fits.getheader(files[0], "SCI")["BUNIT"] == "MJy/sr"
    assert "not used" in header.comments["PSFPARAM"]
    assert "one image" in header.comments["KLMODE0"]
    assert header["DRFILLED"] == 4
    # The flagged pixel of 5000 does not ring: all is noise.
    assert np.isfinite(ours[0]).sum() > 1000
    assert np.nanstd(ours[0]) < 0.05
    assert np.nanmax(np.abs(ours[0])) < 0.3


def test_companions_injected_after_reading_are_in_what_is_fitted_and_kept(files, tmp_path):
    dataset = JWSTData(files)
    copied = copy.deepcopy(dataset)
    dataset.diffrender = pyklip_backend.DiffrenderSettings(size=24)
    fakes.inject_planet(copied.input, copied.centers, 3.0, copied.wcs, 13.0, 0.0, fwhm=4.0)
    clean, _ = reduce(dataset, tmp_path / "clean", aligned_center=MIDDLE)
    image, header = reduce(copied, tmp_path / "injected", aligned_center=MIDDLE)
    assert header["DRPIXELS"] == "recorded"
    difference = (image - clean)[0]
    j, i = np.indices(SHAPE)
    square = (i - MIDDLE[0]) ** 2 + (j - MIDDLE[1] - 13) ** 2
    truth = 3.0 * np.exp(-4 * np.log(2) * square / 4.0**2)
    stamp = np.s_[31:43, 15:28]
    np.testing.assert_allclose(difference[stamp], truth[stamp], atol=0.2)
    assert difference[stamp].sum() == pytest.approx(truth[stamp].sum(), rel=0.05)
    assert np.abs(clean[0][stamp]).max() < 0.3
    [made] = copied.diffrender_results
    assert made.subtraction.worst.result.valid.sum() == 4 * (clean[0].size - 2)


def test_a_pixel_masked_by_hand_is_not_fitted(files, tmp_path):
    dataset = JWSTData(files)
    dataset.input[0, 14, 12] = np.nan
    observation = pyklip_backend.observation_from_dataset(dataset)
    lost = np.argwhere(~observation.valid[0] & observation.valid[1])
    assert 1 <= len(lost) <= 9
    shift = np.array(NATIVE[::-1]) - MIDDLE[::-1]
    np.testing.assert_allclose(lost.mean(axis=0), np.array([14, 12]) + shift, atol=1.0)
    reduce(dataset, tmp_path, skip_derot=True, aligned_center=MIDDLE)
    assert np.isnan(dataset.output[0, 0, 0, 14, 12])
    assert np.isfinite(dataset.output[0, 1, 0, 14, 12])


def test_a_changed_dataset_is_taken_as_it_is(files, tmp_path):
    dataset = JWSTData(files)
    dataset.pad_input(5)
    with pytest.warns(DiffrenderWarning, match="54 x 58 pixels, and had 44 x 48 when"):
        image, header = reduce(dataset, tmp_path)
    assert (header["DRPIXELS"], header["DRNOISE"]) == ("as given", "estimated")
    assert header["DRFILT"] == "F444W"
    assert image.shape == (2, SHAPE[0] + 10, SHAPE[1] + 10)

    repaired = JWSTData(files)
    repaired.input = np.nan_to_num(repaired.input)
    assert reduce(repaired, tmp_path)[1]["DRPIXELS"] == "recorded"


def test_a_dataset_read_before_registering_still_works(files, tmp_path):
    pyklip_backend.unregister()
    dataset = JWSTData(files)
    with (
        pyklip_backend.backend(opd=OPD, subtractor=render),
        pytest.warns(DiffrenderWarning, match=r"made before register\(\)"),
    ):
        _, header = reduce(dataset, tmp_path / "out", algo="klip")
    assert header["DRPIXELS"] == "as given"
    # The wavelength is one of the table that pyKLIP looked it up in.
    assert header["DRFILT"] == "F444W"


def test_frames_that_were_left_out_moved_or_filtered_after_reading(files):
    dataset = JWSTData(files)
    whole = pyklip_backend.observation_from_dataset(dataset)
    kept = [2, 0]
    for name in ("input", "centers", "filenames", "PAs", "wvs", "wcs", "filenums"):
        setattr(dataset, name, np.asarray(getattr(dataset, name))[kept])
    dataset.centers = dataset.centers + 0.25
    part = pyklip_backend.observation_from_dataset(dataset)
    np.testing.assert_array_equal(part.data, whole.data[kept])
    np.testing.assert_array_equal(part.error, whole.error[kept])
    # Whoever moves the star's position knows better where it is.
    np.testing.assert_allclose(part.center, whole.center[kept] + 0.25)
    dataset.filenames = np.array(["other_INT1", "other_INT2"])
    with pytest.warns(DiffrenderWarning, match="not those that were read, by their names"):
        pyklip_backend.observation_from_dataset(dataset)
    # Filtered and multiplied frames are not taken for recorded ones.
    for change in (lambda frame: high_pass_filter(frame, 10), lambda frame: 2 * frame):
        dataset = JWSTData(files)
        dataset.input = np.array([change(each) for each in dataset.input])
        with pytest.warns(DiffrenderWarning, match="changed by more than their noise"):
            pyklip_backend.observation_from_dataset(dataset)


def test_names_that_headers_cannot_hold(files, tmp_path):
    """Frames and OPD map are called with letters that FITS does not have."""
    named = [
        str(Path(path).rename(tmp_path / f"β Pic größe {k}_calints.fits"))
        for k, path in enumerate(files)
    ]
    wavefront = tmp_path / "карта.fits"
    fits.PrimaryHDU(OPD.data, fits.Header({"BUNIT": "m"})).writeto(wavefront)
    dataset = JWSTData(named)
    dataset.diffrender = pyklip_backend.DiffrenderSettings(opd=wavefront)
    _, header = reduce(dataset, tmp_path / "out")
    assert header["FILE_0"] == "? Pic gro?e 0_calints.fits_INT1.fits"
    assert header["DROPD"] == "?????.fits"
    assert header["DRPIXELS"] == "recorded"
    assert dataset.filenames[0].startswith("β Pic größe 0")


def test_folders_in_the_prefix(files, tmp_path):
    out, dataset = tmp_path / "out", JWSTData(files)
    (out / "sub").mkdir(parents=True)
    reduced(dataset, out, "sub/star")
    assert (out / "sub" / "star-KLmodes-all.fits").is_file()
    assert [path.name for path in out.iterdir()] == ["sub"]
    with pytest.raises(FileNotFoundError, match=r"fileprefix: .*none is not a folder"):
        reduced(dataset, out, "none/star")


def test_files_without_errors_or_flags(tmp_path, rng):
    path = tmp_path / "a_calints.fits"
    calints(path, rng)
    with fits.open(path) as hdus:
        science, primary = hdus["SCI"].copy(), hdus[0].copy()
    science.data = science.data[0]
    fits.HDUList([primary, science]).writeto(path, overwrite=True)
    dataset = JWSTData(str(path))
    with pytest.warns(DiffrenderWarning, match="no ERR extension"):
        observation = pyklip_backend.observation_from_dataset(dataset)
    assert (observation.error > 0).all()
    np.testing.assert_array_equal(
        observation.data[observation.valid], dataset.input[observation.valid]
    )
