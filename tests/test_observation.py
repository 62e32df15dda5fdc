"""Observations: JWST files, data quality, star position, cut-outs, weighted means, bad input."""

import re

import numpy as np
import pytest
import torch
from astropy import units as u
from astropy.io import fits
from small_files import AREA, calints

import pyklip_diffrender as dr
from pyklip_diffrender.errors import (
    CorruptFileError,
    DiffrenderError,
    DiffrenderWarning,
    IncompatibleSetupError,
    NoValidPixelsError,
    ShapeError,
    UnitError,
)
from pyklip_diffrender.io.units import ARCSEC
from pyklip_diffrender.linear.response import coarse_copy
from pyklip_diffrender.optics.fast_path import finest_spacing
from pyklip_diffrender.scene.jwst_files import BAD_PIXEL_BITS
from pyklip_diffrender.scene.observation import Observation


@pytest.fixture
def frames(rng):
    """Two frames of 8 rows and 10 columns: no symmetry that could hide a transposition."""
    return rng.normal(10, 2, size=(2, 8, 10)).astype(np.float32)


def test_a_calints_file_is_read_with_everything_in_it(tmp_path, frames, rng):
    error = rng.uniform(0.5, 2, size=frames.shape).astype(np.float32)
    got = Observation.from_fits(calints(tmp_path / "jw_calints.fits", frames, error))
    np.testing.assert_array_equal(got.data, frames.astype(np.float64))
    np.testing.assert_array_equal(got.error, error.astype(np.float64))
    assert got.data.dtype == got.error.dtype == np.dtype("=f8")
    assert got.valid.all()
    assert got.unit == u.MJy / u.sr
    assert got.pixelscale == pytest.approx((AREA**0.5, AREA**0.5), rel=1e-12)
    assert (got.filter, got.name) == ("F444W", "jw_calints.fits")
    assert got.date.isot == "2022-07-30T02:03:04.500"
    assert (len(got), *got.shape) == (2, 8, 10)
    # Header: both extensions merged.
    assert (got.header["INSTRUME"], got.header["PIXAR_A2"]) == ("NIRCAM", AREA)
    np.testing.assert_allclose(got.position_angles, [100.0 - 0.5] * 2)


def test_the_star_position_is_converted_from_one_indexed_to_zero_indexed(tmp_path, frames):
    for k, (cards, center) in enumerate([
        ({}, [5.0, 4.0]),
        ({"STARCENX": 4.25, "STARCENY": 7.5}, [3.25, 6.5]),
        ({"CRPIX1": None, "CRPIX2": None}, [4.5, 3.5]),
    ]):  # fmt: skip
        got = Observation.from_fits(calints(tmp_path / f"{k}.fits", frames, **cards))
        np.testing.assert_array_equal(got.center, [center] * 2)


def test_data_quality_bits_take_pixels_out(tmp_path, frames):
    bits = np.array([0, 4, 2048, 2**31, 1, 2, 512, 1024, 4 + 1])
    quality = np.zeros(frames.shape, dtype=np.uint32)
    quality[1, 2, :9] = bits
    got = Observation.from_fits(calints(tmp_path / "dq.fits", frames, quality=quality))
    expected = np.ones(frames.shape, dtype=bool)
    expected[1, 2, 4:9] = False
    np.testing.assert_array_equal(got.valid, expected)
    np.testing.assert_array_equal(got.data, np.where(expected, frames, 0.0))
    np.testing.assert_array_equal((bits & BAD_PIXEL_BITS) != 0, ~expected[1, 2, :9])


def test_without_quality_only_nan_is_masked_and_that_is_said(tmp_path, frames):
    frames[0, 1, 2] = np.nan
    path = calints(tmp_path / "nodq.fits", frames, leave_out=("DQ",))
    with pytest.warns(DiffrenderWarning, match=r"nodq\.fits: no DQ"):
        got = Observation.from_fits(path)
    assert np.argwhere(~got.valid).tolist() == [[0, 1, 2]]


@pytest.mark.hard
def test_scaled_integers_equal_their_values(tmp_path, frames):
    counts = np.round(frames * 100).astype(np.int16)
    path = calints(tmp_path / "int16.fits", counts, np.ones_like(frames))
    with fits.open(path, mode="update", do_not_scale_image_data=True) as hdus:
        hdus["SCI"].header["BSCALE"] = 0.25
        hdus["SCI"].header["BZERO"] = 3.0
    np.testing.assert_array_equal(Observation.from_fits(path).data, counts * 0.25 + 3.0)


@pytest.mark.parametrize(
    ("facts", "error", "words"),
    [
        ({"leave_out": ("SCI",)}, CorruptFileError, "no SCI extension"),
        ({"leave_out": ("ERR",)}, CorruptFileError, "no ERR extension"),
        ({"BUNIT": None}, UnitError, "BUNIT.*MJy/sr"),
        ({"BUNIT": ""}, UnitError, "BUNIT.*MJy/sr"),
        ({"BUNIT": "parsnips"}, UnitError, "parsnips.*MJy/sr"),
    ],
)
def test_what_a_file_lacks_is_named(tmp_path, frames, facts, error, words):
    path = calints(tmp_path / "part.fits", frames, **facts)
    with pytest.raises(error, match=rf"part\.fits.*{words}"):
        Observation.from_fits(path)


def test_an_integration_without_a_good_pixel_is_left_out_and_named(tmp_path, frames):
    quality = np.zeros(frames.shape, dtype=np.uint32)
    quality[1] = 1
    got = Observation.from_fits(calints(tmp_path / "half.fits", frames, quality=quality))
    assert len(got) == 1
    assert "integration 2 of 2 is left out: all of its pixels are flagged" in got.remarks[0]
    path = calints(tmp_path / "blind.fits", frames, quality=quality + 1)
    for every in (False, True):
        with pytest.raises(NoValidPixelsError, match=r"blind\.fits: integration 1 of 2 .*flagged"):
            Observation.from_fits(path, every_integration=every)


def test_a_file_without_frames_is_an_error(tmp_path, frames):
    path = calints(tmp_path / "empty.fits", frames)
    with fits.open(path) as hdus:
        cut = [fits.ImageHDU(None, hdu.header, name=hdu.name) for hdu in hdus[1:]]
        primary = hdus[0].copy()
    fits.HDUList([primary, *cut]).writeto(path, overwrite=True)
    with pytest.raises((ShapeError, CorruptFileError), match=r"empty\.fits"):
        Observation.from_fits(path)


@pytest.mark.hard
def test_bad_pixels_become_zero_in_the_copy_only(frames):
    data, error = frames.astype(np.float64), np.ones(frames.shape)
    data[0, 0, 1], data[0, 0, 2] = np.nan, np.inf
    error[0, 0, 3], error[0, 0, 4], error[0, 0, 5] = 0.0, -1.0, np.nan
    valid = np.ones(frames.shape, dtype=bool)
    valid[0, 0, 6] = False
    before = data.copy(), error.copy(), valid.copy()
    got = Observation.from_arrays(data, error, valid=valid, pixelscale=0.06)
    for now, then in zip((data, error, valid), before, strict=True):
        np.testing.assert_array_equal(now, then)
    assert np.flatnonzero(~got.valid[0, 0]).tolist() == [1, 2, 3, 4, 5, 6]
    assert got.valid[0, 1:].all()
    assert not got.data[0, 0, 1:7].any()
    assert (got.error[0, 0, 1:7] == 1).all()


@pytest.mark.parametrize("shape", [(0, 8, 10), (8,), (1, 2, 8, 10), (2, 0, 10)], ids=str)
def test_data_that_are_no_frames_are_refused(shape):
    with pytest.raises(ShapeError, match=rf"data: got shape {re.escape(str(shape))}"):
        Observation.from_arrays(np.ones(shape), np.ones(shape), pixelscale=0.06)


@pytest.mark.parametrize(
    ("arguments", "refusal", "words"),
    [
        ({"error": np.ones((8, 10))}, ShapeError, r"error: got shape \(1, 8, 10\).*\(2, 8, 10\)"),
        ({"valid": np.ones((2, 10, 8))}, ShapeError, r"valid: got shape \(2, 10, 8\)"),
        ({"center": np.ones((3, 2))}, ShapeError, r"center.*\(3, 2\)"),
        ({"pixelscale": (0.06, 0.06, 0.06)}, ShapeError, "pixelscale"),
        ({"unit": "parsnips"}, UnitError, "parsnips"),
        *(({"pixelscale": each}, DiffrenderError, "pixelscale") for each in (np.nan, 0.0, np.inf)),
        ({"valid": np.zeros((2, 8, 10), dtype=bool)}, NoValidPixelsError, "all 80 pixels"),
    ],
)
def test_arrays_that_do_not_go_together_are_refused(frames, arguments, refusal, words):
    with pytest.raises(refusal, match=words):
        Observation.from_arrays(
            frames, **{"error": np.ones(frames.shape), "pixelscale": 0.06} | arguments
        )


def test_a_cutout_is_whole_pixels_about_the_star(frames):
    observation = Observation.from_arrays(
        frames, frames + 1, pixelscale=0.06, center=[[5.0, 4.0], [6.2, 3.9]], name="edge"
    )
    got = observation.cutout(3)
    for name in ("data", "error", "valid"):
        whole = getattr(observation, name)
        np.testing.assert_array_equal(getattr(got, name)[0], whole[0, 3:6, 4:7])
        np.testing.assert_array_equal(getattr(got, name)[1], whole[1, 3:6, 5:8])
    np.testing.assert_allclose(got.center, [[1.0, 1.0], [1.2, 0.9]], atol=1e-12)
    # The star stays within half a pixel of the middle for even sizes too.
    even = observation.cutout(4)
    assert np.abs(even.center - 1.5).max() <= 0.5
    assert even.shape == (4, 4)
    with pytest.raises(ShapeError, match=r"edge: 9 x 9 pixels.*10 x 8"):
        observation.cutout(9)


def test_combined_is_the_mean_of_valid_pixels_weighted_by_frame():
    data = np.array([[[1.0, 2.0, 3.0]], [[5.0, 8.0, 9.0]]])
    error = np.array([[[1.0, 1.0, 2.0]], [[2.0, 1.0, 2.0]]])
    valid = np.array([[[True, False, False]], [[True, True, False]]])
    got = Observation.from_arrays(
        data, error, valid=valid, pixelscale=0.06, center=[[0.0, 0.0], [1.0, 0.5]],
        position_angles=np.array([10.0, 10.0]),
    ).combined()  # fmt: skip
    # Median variances 1 and (4 + 1) / 2: weights 1 and 0.4. (1 + 0.4 x 5) / 1.4 = 15 / 7, and
    # (1 + 0.16 x 4)^0.5 / 1.4 for its error.
    np.testing.assert_allclose(got.data, [[[15 / 7, 8.0, 0.0]]], rtol=1e-12)
    np.testing.assert_allclose(got.error, [[[1.64**0.5 / 1.4, 1.0, 1.0]]], rtol=1e-12)
    np.testing.assert_array_equal(got.valid, [[[True, True, False]]])
    np.testing.assert_allclose(got.center, [[0.5, 0.25]])
    np.testing.assert_array_equal(got.position_angles, [10.0])


def test_the_mean_of_faint_frames_is_not_biased():
    """With weights from every pixel's own counts, it is 2.5 standard deviations too low."""
    counts = np.random.default_rng(7).poisson(5.0, (400, 20, 20)).astype(float)
    error = np.sqrt(np.maximum(counts, 1.0))
    mean = Observation.from_arrays(counts, error, pixelscale=0.06).combined()
    pulls = (mean.data - 5.0) / mean.error
    # 400 pixels: the mean of the pulls scatters by 0.05.
    assert abs(pulls.mean()) < 0.15
    assert 0.9 < pulls.std() < 1.1


def test_frames_that_have_no_model_are_refused():
    ones, facts = np.ones((32, 40)), {"pixelscale": 0.063, "filter": "F444W"}
    frame = Observation.from_arrays(ones, ones, **facts)
    with pytest.raises(ShapeError, match=r"600 x 600 pixels do not fit into 40 x 32\. Choose a"):
        dr.model_for(frame, 600)
    miri = Observation.from_arrays(ones, ones, **facts, header=fits.Header({"INSTRUME": "MIRI"}))
    with pytest.raises(IncompatibleSetupError, match="of MIRI, and only NIRCam"):
        dr.model_for(miri)


@pytest.mark.parametrize(
    ("name", "mask"), [("F250M", "MASKA335R"), ("F444W", "MASKA335R"), ("F356W", "MASKA430R")]
)
def test_few_cells_of_the_occulter_are_enough_for_a_round_mask(name, mask):
    """Star and planet against four cells per lambda/D; one cell per pixel at all wavelengths."""
    header = fits.Header({"INSTRUME": "NIRCAM", "CORONMSK": mask, "PUPIL": "MASKRND"})
    ones = np.ones((40, 40))
    frame = Observation.from_arrays(ones, ones, pixelscale=0.063, filter=name, header=header)
    model = dr.model_for(frame, npix=128, nlambda=3)
    fine = dr.model_for(frame, npix=128, nlambda=3, occulter_sampling=4.0)
    opd = dr.wavefront.random_opd(1, npix=128).data
    for place in ((0.01, 0.02), (0.6, 0.3)):
        with torch.no_grad():
            image, expected = model(opd, place), fine(opd, place)
        assert float((image - expected).abs().max() / expected.max()) < 1e-6
    spacings = [
        finest_spacing(model.between[0], model.detector, wavelength, model.between[0].sampling)
        for wavelength in model.bandpass.wavelengths
    ]
    assert min(spacings) == pytest.approx(min(model.detector.pixelscale) * ARCSEC)
    coarse = coarse_copy(model, 64)
    assert coarse.recipe["occulter_sampling"] == model.recipe["occulter_sampling"] < 1.5
