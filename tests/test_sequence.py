"""Sequences from files, patterns learned from reference stars, and fits that survive a file."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from astropy.io import fits

import pyklip_diffrender as dr
from benchmarks.calints_files import CENTER, calints
from pyklip_diffrender.errors import CorruptFileError, IncompatibleSetupError, NoValidPixelsError
from pyklip_diffrender.io.headers import same_name
from pyklip_diffrender.pattern import learn_pattern
from pyklip_diffrender.refinement import FitSettings, Refinement, refine
from pyklip_diffrender.scene.objects import Scene, Star
from pyklip_diffrender.scene.observation import Observation
from pyklip_diffrender.scene.sequence import ExposureSequence
from pyklip_diffrender.scene.simulation import simulate

SIZE = 32
SETTINGS = FitSettings(cycles=6)


@cache
def model():
    return dr.nircam_coronagraph("F444W", monochromatic=4.5e-6, npix=64, fov_pixels=SIZE)


@cache
def opd():
    return dr.wavefront.random_opd(1, npix=64)


def pattern():
    """A multiplicative error of the model, 6 % rms, smooth over two pixels or so."""
    rough = np.random.default_rng(5).normal(size=(SIZE, SIZE))
    smooth = rough + np.roll(rough, 1, axis=0) + np.roll(rough, 1, axis=1)
    return 0.06 * smooth / smooth.std()


@cache
def frame(star, seed, roll=0.0):
    """A frame of a star whose light the pattern multiplies."""
    clean = simulate(model(), Scene(Star(exposure=20.0)), opd(), seed=seed)
    return replace(
        clean, data=clean.data * (1 + pattern()), header=fits.Header({"TARGPROP": star}),
        name=f"{star} {seed}", position_angles=np.array([roll]),
    )  # fmt: skip


@cache
def reference_fit():
    return refine(model(), [frame("REF", 10), frame("REF", 11)], opd(), settings=SETTINGS)


def test_rolls_are_cut_alike_if_their_stars_are_on_nearly_the_same_pixel():
    ones, facts = np.ones((30, 30)), {"pixelscale": 0.063, "first_pixel": (600, 1600)}
    rolls = [
        Observation.from_arrays(
            np.arange(900.0).reshape(30, 30) + shift, ones, center=(15.0 + shift, 14.6), **facts
        )
        for shift in (0.4, 0.6, 7.0)
    ]
    cut = ExposureSequence("star", tuple(rolls)).cutout(10)
    corners = [(611, 1610), (611, 1610), (618, 1610)]
    assert [roll.cutout(10).first_pixel for roll in rolls] == corners
    near = ExposureSequence(
        "star", (rolls[0], replace(rolls[1], center=rolls[1].center + 0.6))
    ).cutout(10)
    assert near.science[1].first_pixel == near.science[0].first_pixel == (611, 1610)
    np.testing.assert_allclose(near.science[1].center, [[5.2, 5.2]])
    assert near.science[1].data[0, 0, 0] == rolls[1].data[0, 10, 11]
    # Farther apart, each has its star in the middle.
    assert cut.science[2].first_pixel == (618, 1610)


@pytest.mark.parametrize(
    ("first", "second", "same"),
    [
        ("V-AU-MIC", "au mic", True), ("V* AU Mic", "V-AU-MIC", True),
        ("V-AU-MIC", "AU_Mic", True), ("* bet Pic", "BET-PIC", True),
        ("V 1298 Tau", "V1298-TAU", True), ("HIP-17695", "HIP 1769", False),
        ("V1298 Tau", "1298 Tau", False),
    ],
)  # fmt: skip
def test_names_are_the_same_in_any_spelling(first, second, same):
    assert same_name(first, second) is same_name(second, first) is same


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"target": "VEGA"}, r"'VEGA', expected one of 'AU MIC', 'HIP1'$"),
        ({"filter": "F445W"}, r"filter: got 'F445W', expected one of 'F444W'"),
        ({}, "choose one with"),
    ],
)
def test_a_target_that_cannot_be_decided_is_an_error(tmp_path, arguments, words):
    calints(tmp_path / "a.fits", "AU MIC")
    calints(tmp_path / "b.fits", "HIP1", observation=2, cards={"TARG_RA": 20.0})
    with pytest.raises(IncompatibleSetupError, match=words):
        ExposureSequence.from_files(tmp_path, **arguments)


def test_a_filter_is_needed_where_files_have_several(tmp_path):
    with pytest.raises(NoValidPixelsError, match="no FITS files"):
        ExposureSequence.from_files(tmp_path)
    with pytest.raises(IncompatibleSetupError, match="got a int, expected paths of FITS files"):
        ExposureSequence.from_files(3)
    for k, name in enumerate(("F356W", "F444W")):
        calints(tmp_path / f"{name}.fits", observation=k, cards={"FILTER": name})
    with pytest.raises(IncompatibleSetupError, match=r"filter: the files have .*F356W"):
        ExposureSequence.from_files(tmp_path)


def read(path, offsets=None, **cards):
    """A file with these cards, and with `offsets` from the mask in pixels as spaceKLIP has them."""
    calints(path, integrations=2, cards={"XOFFSET": None, "YOFFSET": None, **cards})
    if offsets is not None:
        fits.append(path, np.array(offsets), fits.Header({"EXTNAME": "MASKOFFS"}))
    return Observation.from_fits(path)


def test_dithers_behind_the_mask_are_read(tmp_path):
    without = read(tmp_path / "a.fits")
    assert without.star_offset is None
    measured = read(tmp_path / "b.fits", [[0.2, -0.1], [0.4, -0.1]])
    pixel = 0.0039**0.5
    np.testing.assert_allclose(measured.star_offset, (0.3 * pixel, -0.1 * pixel), rtol=1e-6)
    dithered = read(tmp_path / "c.fits", XOFFSET=0.02, YOFFSET=-0.01)
    assert dithered.star_offset == (0.02, -0.01)
    expected = without.center + np.array([0.02, -0.01]) / without.pixelscale
    np.testing.assert_allclose(dithered.center, expected)
    # Where somebody has measured the star, the dither is in its position already.
    stated = read(tmp_path / "d.fits", XOFFSET=0.02, STARCENX=13.3, STARCENY=11.8)
    assert stated.star_offset is None
    np.testing.assert_allclose(stated.center[0], (12.3, 10.8))
    # A star that was moved out from behind the mask.
    away = read(tmp_path / "e.fits", XOFFSET=1.5, YOFFSET=-0.01)
    assert away.star_offset is None
    np.testing.assert_array_equal(away.center, without.center)
    np.testing.assert_array_equal(away.center, [CENTER] * 2)


def test_a_dithered_star_is_fitted_where_the_file_says():
    offset = (0.02, -0.01)
    seen = simulate(model(), Scene(star_offset=offset), opd(), seed=4)
    scale = model().detector.pixelscale
    known = replace(seen, star_offset=offset, center=seen.center + np.divide(offset, scale))
    settings = replace(SETTINGS, deviations={"star_offset": 0.001})
    fits_ = [refine(model(), each, opd(), settings=settings) for each in (seen, known)]
    away = [np.abs(fit.frames[0].values["star_offset"] - offset).max() for fit in fits_]
    assert away[1] < 1e-5
    assert away[0] > 3 * away[1]
    assert fits_[1].chi2_per_pixel < 1.1


def test_real_stars_are_off_the_mask_by_what_the_files_say(shared_data):
    """The star moves by a third of a pixel, the mask stays on its pixels of the detector."""
    paths = [p for p in sorted((shared_data / "gto1184").glob("*")) if "_03106_" in p.name]
    frames = [Observation.from_fits(path) for path in paths]
    stars = np.array([each.center.mean(axis=0) + each.first_pixel for each in frames])
    offsets = np.array([each.star_offset for each in frames]) / frames[0].pixelscale
    assert {each.filter for each in frames} == {"F444W"}
    assert len(frames) == 6
    assert np.ptp(stars, axis=0).min() > 0.15
    assert np.ptp(stars - offsets, axis=0).max() < 0.001


def test_a_pattern_is_learned_from_another_star():
    fit = reference_fit()
    assert fit.chi2_per_pixel > 5
    learned = learn_pattern(fit)
    truth = pattern()
    y, x = np.indices(truth.shape) - (SIZE - 1) / 2
    bright = np.hypot(x, y) < 12
    # What looks like wavefront is not in the pattern: most of it is not, and is recovered.
    assert np.corrcoef(learned.value[bright], truth[bright])[0, 1] > 0.8
    assert learned.unknown == pytest.approx(0.05, rel=0.5)
    assert learned.filter == "F444W"


def test_a_pattern_needs_two_frames_of_one_filter():
    single = replace(reference_fit(), frames=reference_fit().frames[:1])
    with pytest.raises(IncompatibleSetupError, match="at least two"):
        learn_pattern(single)


def test_a_pattern_survives_the_file(tmp_path):
    learned = learn_pattern(reference_fit(), name="spring")
    back = dr.DetectorPattern.read(learned.write(tmp_path / "pattern.fits"))
    for name in ("value", "error", "center", "unknown", "filter", "name"):
        np.testing.assert_array_equal(getattr(back, name), getattr(learned, name))
    assert (back.name, back.provenance["stars"]) == ("spring", ["REF"])
    fits.PrimaryHDU().writeto(tmp_path / "other.fits")
    with pytest.raises(CorruptFileError, match="pattern"):
        dr.DetectorPattern.read(tmp_path / "other.fits")


def test_a_refinement_survives_the_file(tmp_path):
    frames = [frame("TARGET", 20), frame("TARGET", 21, roll=10.0)]
    assert frames[1].roll_from(frames[0]) == pytest.approx(-10)
    learned = learn_pattern(reference_fit())
    fit = refine(model(), frames, opd(), settings=SETTINGS, pattern=learned)
    # With the pattern of the other star, the frames are explained.
    assert fit.chi2_per_pixel < 2
    one, two = fit.frames
    seen = (
        replace(one.observation, integrations=(7,)),
        # Segments of an exposure, which the file has as one mean.
        two.observation.followed_by([two.observation] * 2),
    )
    parts = [replace(part, observation=each) for part, each in zip(fit.frames, seen, strict=True)]
    fit = replace(fit, frames=tuple(parts))
    back = Refinement.read(fit.write(tmp_path / "fit.fits"))
    assert [each.observation.count for each in back.frames] == [7, 3]
    assert (back.status, back.settings) == (fit.status, fit.settings)
    for ours, theirs in zip(back.frames, fit.frames, strict=True):
        np.testing.assert_array_equal(ours.star, theirs.star)
        np.testing.assert_array_equal(ours.opd, theirs.opd)
        assert ours.observation.position_angle == theirs.observation.position_angle
        assert ours.observation.target == "TARGET"
    places = [[0.4, 0.5], [0.5, -0.3]]
    again, first = (dr.detect(each).measure(places) for each in (back, fit))
    np.testing.assert_array_equal(again["contrast"], first["contrast"])
    np.testing.assert_array_equal(again["contrast_error"], first["contrast_error"])
