"""``algo="diffrender"`` with reference stars: which pattern is used, and from which frames."""

import copy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from backend_scene import OPD, RIPPLE, calints, in_place_of_fits, psf, reduced, render
from pyklip.instruments.JWST import JWSTData

from pyklip_diffrender.errors import DiffrenderWarning, IncompatibleSetupError
from pyklip_diffrender.instrument.nircam import nircam_coronagraph
from pyklip_diffrender.pyklip_backend import (
    DiffrenderSettings,
    observation_from_dataset,
    register,
    subtract_by_refinement,
    unregister,
)
from pyklip_diffrender.pyklip_backend.dataset_frames import frames_of
from pyklip_diffrender.scene.observation import Observation

CARDS = {"SUBSTRT1": 492, "SUBSTRT2": 1502, "DETECTOR": "NRCALONG"}
TARGET = {"TARGPROP": "TARGET", "IS_PSF": False, **CARDS}
REFERENCE = {"TARGPROP": "REF", "IS_PSF": True, **CARDS}

pytestmark = pytest.mark.usefixtures("offline", "registered")


@pytest.fixture
def files(tmp_path, rng):
    """Two rolls of the target and a reference star."""
    paths = [str(tmp_path / f"jw0118400{k}_calints.fits") for k in range(3)]
    for path, roll, cards in zip(paths, (0, 10, 0), (TARGET, TARGET, REFERENCE), strict=True):
        calints(path, rng, roll, **cards)
    return paths


def reduce(dataset, folder, **kw):
    """Header of the product."""
    kw = {"mode": "ADI+RDI", "psf_library": dataset.psflib, "numbasis": [1], **kw}
    return reduced(dataset, folder, **kw)["x-KLmodes-all.fits"][1]


def gathered(dataset, library=()):
    return frames_of(dataset, np.asarray(dataset.input), DiffrenderSettings(), library)


def test_rolls_are_pointings_with_the_headers_of_their_files(files):
    frames = gathered(JWSTData(files[:2]))
    assert [each.frames.tolist() for each in frames.pointings] == [[0, 1], [2, 3]]
    assert [each.observation.position_angle for each in frames.pointings] == [0.0, 10.0]
    for pointing, path in zip(frames.pointings, files, strict=False):
        expected = Observation.from_fits(path)
        observation = pointing.observation
        assert (observation.target, observation.is_nircam) == ("TARGET", True)
        assert observation.first_pixel == expected.first_pixel == (491, 1501)
        assert observation.name.startswith(Path(path).name)
        np.testing.assert_array_equal(observation.data[observation.valid],
                                      expected.data[expected.valid])  # fmt: skip


def test_reference_frames_in_the_dataset_stay_out_of_the_products(files, tmp_path):
    dataset = JWSTData([files[2], files[0], files[1]])
    with pytest.warns(DiffrenderWarning, match=r"2 of 6 frames .* reference star"):
        frames = gathered(dataset)
    assert [each.target for each in frames.references] == ["REF"]
    assert frames.references[0].reference
    assert [each.count for each in frames.references] == [2]
    np.testing.assert_array_equal(frames.usable, [False, False, True, True, True, True])
    with pytest.warns(DiffrenderWarning, match="reference star"):
        reduce(dataset, tmp_path / "out", mode="ADI")
    shown = np.isfinite(dataset.output[0, :, 0]).any(axis=(1, 2))
    np.testing.assert_array_equal(shown, frames.usable)


def test_frames_that_spaceklip_shifted_are_put_back(files, tmp_path, caplog):
    path = files[0]
    with fits.open(path) as hdus:
        # As spaceKLIP does, bad pixels are repaired before the frames are shifted.
        hdus["SCI"].data[:, 30, 30] = hdus["SCI"].data[:, 30, 31]
        shifts = np.array([[0.3, -0.4], [0.3, -0.4]])
        hdus.append(fits.ImageHDU(shifts, name="IMSHIFTS"))
        hdus.append(fits.ImageHDU(np.array([[0.1, 0.2], [0.1, 0.2]]), name="MASKOFFS"))
        hdus.writeto(tmp_path / "aligned_calints.fits")
    expected = Observation.from_fits(tmp_path / "aligned_calints.fits")
    dataset = JWSTData([str(tmp_path / "aligned_calints.fits")])
    assert caplog.text == ""
    observation = observation_from_dataset(dataset)
    np.testing.assert_allclose(observation.data, expected.data, rtol=1e-6, atol=1e-5)
    np.testing.assert_array_equal(observation.valid, expected.valid)
    np.testing.assert_allclose(observation.center, expected.center)
    assert np.abs(observation.center - (20.7, 25.2)).max() > 0.2
    (pointing,) = gathered(dataset).pointings
    assert pointing.observation.first_pixel == expected.first_pixel
    assert pointing.observation.star_offset == expected.star_offset
    # The star is where the unshifted frame has it, so that none is left after the subtraction.
    reduce(dataset, tmp_path, mode="ADI", psf_library=None, skip_derot=True)
    assert np.nanmax(np.abs(dataset.output)) < 0.02 * 1000


def test_a_dithered_star_is_behind_the_mask_where_the_header_says(files):
    fits.setval(files[0], "XOFFSET", value=0.02)
    (pointing,) = gathered(JWSTData([files[0]])).pointings
    expected = Observation.from_fits(files[0])
    assert pointing.observation.star_offset == expected.star_offset == (0.02, 0.0)
    np.testing.assert_allclose(pointing.observation.center, expected.center)


def written(folder, rng, roll, common, wrong):
    """Write a file for each of some cards, and return their paths."""
    paths = [folder / f"other_{k}_calints.fits" for k in range(len(wrong))]
    for path, cards in zip(paths, wrong.values(), strict=True):
        calints(path, rng, roll, **{**common, **cards})
    return paths


def assert_left_out(caught, wrong):
    """Assert that each file is named with its reason in a warning."""
    said = [str(each.message) for each in caught]
    for k, reason in enumerate(wrong):
        assert [each for each in said if f"other_{k}_calints.fits: is not used" in each
                and reason in each], (reason, said)  # fmt: skip


def test_references_that_do_not_belong_are_left_out(files, tmp_path, rng):
    wrong = {
        "mask is MASK430R, not MASK335R": {"CORONMSK": "MASKA430R"},
        # A star's own planets would become part of the pattern.
        "a reference frame that shows the target itself": {"TARGPROP": "target"},
    }
    later = {"of another epoch": {"DATE-BEG": "2023-07-30T01:02:03"}}
    (tmp_path / "later").mkdir()
    (other,) = written(tmp_path / "later", rng, 0.0, REFERENCE, later)
    library = [Path(files[2]), *written(tmp_path, rng, 0.0, REFERENCE, wrong), other]
    with pytest.warns(DiffrenderWarning) as caught:
        frames = gathered(JWSTData(files[:2]), library)
    assert_left_out(caught, wrong)
    assert any("of another epoch" in str(each.message) for each in caught)
    assert [each.name for each in frames.references] == [library[0].name, other.name]
    assert frames.usable.all()


def test_frames_that_do_not_belong_stay_out(files, tmp_path, rng):
    wrong = {
        "EXP_TYPE is NRC_TACONFIRM": {"EXP_TYPE": "NRC_TACONFIRM"},
        "another set-up than most of the target's frames": {"CORONMSK": "MASKA430R"},
    }
    others = written(tmp_path, rng, 20.0, TARGET, wrong)
    with pytest.warns(DiffrenderWarning) as caught:
        frames = gathered(JWSTData([*map(str, others), *files[:2]]))
    assert_left_out(caught, wrong)
    np.testing.assert_array_equal(frames.usable, [False] * 4 + [True] * 4)
    assert len(frames.pointings) == 2


def test_a_file_that_is_there_twice_is_used_once(files):
    with pytest.warns(DiffrenderWarning, match="2 frames are in the dataset twice"):
        frames = gathered(JWSTData([*files[:2], files[0]]))
    np.testing.assert_array_equal(frames.usable, [True, True, True, True, False, False])


def test_a_deviating_integration_stays_out(files, tmp_path, rng):
    """One that is flagged entirely, or dim, costs neither its file's errors nor the star's flux."""
    path = tmp_path / "cube_calints.fits"
    calints(path, rng, 20.0, nints=8, **TARGET)
    with fits.open(path, mode="update") as hdus:
        hdus["DQ"].data[2] = 1
        hdus["SCI"].data[5] *= 0.6
    with pytest.warns(DiffrenderWarning) as caught:
        frames = gathered(JWSTData([str(path), *files[:2]]))
    (remark,) = {str(each.message) for each in caught}
    assert "integration 3 of 8 is left out" in remark
    assert "0.60 times as bright" in remark
    np.testing.assert_array_equal(np.flatnonzero(~frames.usable), [2, 5])
    assert frames.noise == "ERR"


def test_the_files_of_the_library_reach_the_fit(files, tmp_path, monkeypatch, capsys):
    seen = []

    def subtract(observation, opd, settings, **context):
        seen.append(context["references"])
        context["tell"]("at work")
        subtraction = render(observation, opd, settings)
        return replace(subtraction, pattern="references (REF)", references=2)

    in_place_of_fits(monkeypatch, subtract)
    unregister()
    register(opd=OPD)
    dataset = copy.deepcopy(JWSTData(files[:2], files[2:]))
    header = reduce(dataset, tmp_path / "out")
    ((used,), *_) = seen
    assert (used.name, used.target, used.reference) == (Path(files[2]).name, "REF", True)
    assert (header["DRPATTRN"], header["DRREFS"]) == ("references (REF)", 2)
    assert "at work" not in capsys.readouterr().out
    reduce(dataset, tmp_path / "out", mode="ADI", verbose=True)
    assert seen[1] == ()
    assert "diffrender: at work\n" in capsys.readouterr().out


def test_references_that_are_asked_for_must_be_there():
    model = nircam_coronagraph("F444W", fov_pixels=32, npix=64, monochromatic=4.4e-6)
    light = 1000 * psf(15.5, 15.5, (32, 32))
    frame = Observation.from_arrays(
        [light, light], np.ones((2, 32, 32)), pixelscale=0.0624, filter="F444W",
        header=fits.Header({"TARGPROP": "TARGET", "INSTRUME": "NIRCAM"}), first_pixel=(0, 0),
    )  # fmt: skip
    settings = DiffrenderSettings(pattern="references", model=model)
    with pytest.raises(IncompatibleSetupError, match=r"psflib_filepaths after register\(\)"):
        subtract_by_refinement(frame, OPD, settings)


@pytest.fixture
def maps(tmp_path):
    """Two dated maps, 49 hours before and 47 hours after the frames."""
    folder = tmp_path / "maps"
    folder.mkdir()
    for date in ("2022-07-28", "2022-08-01"):
        cards = fits.Header({"BUNIT": "m", "DATE-OBS": f"{date}T00:00:00"})
        fits.PrimaryHDU(RIPPLE, cards).writeto(folder / f"map_{date}.fits")
    return folder


def test_the_map_of_a_folder_is_chosen_by_the_date(maps, files, tmp_path):
    unregister()
    register(subtractor=render, opd=maps)
    header = reduce(JWSTData(files[:2]), tmp_path / "out", mode="ADI")
    assert header["DROPD"] == "map_2022-08-01.fits"
    assert header["DROPDDAT"].startswith("2022-08-01")
    assert header["DROPDHRS"] == pytest.approx(46.966, abs=0.001)


def test_a_folder_needs_a_date_of_the_frames(maps, files, tmp_path):
    unregister()
    undated = JWSTData(files[:2])
    register(opd=maps, subtractor=render)
    with pytest.raises(IncompatibleSetupError, match="frames have no date") as raised:
        reduce(undated, tmp_path / "out", mode="ADI")
    assert "made before register()" in raised.value.__notes__[0]


def test_a_flux_calibration_is_refused_before_the_fit(files, tmp_path):
    dataset = JWSTData(files[:2])
    before = dict(vars(dataset))
    with pytest.raises(IncompatibleSetupError, match="JWSTData has no flux calibration"):
        reduce(dataset, tmp_path / "out", mode="ADI", calibrate_flux=True)
    assert vars(dataset) == before
    assert list((tmp_path / "out").iterdir()) == []
