"""Sequences from files, patterns learned from reference stars, and fits that survive a file."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import small_files
from astropy import units as u
from astropy.io import fits

from pyklip_diffrender.detection import detect, measure
from pyklip_diffrender.errors import CorruptFileError, IncompatibleSetupError, NoValidPixelsError
from pyklip_diffrender.instrument.nircam import nircam_coronagraph
from pyklip_diffrender.io.headers import same_name
from pyklip_diffrender.pattern import learn_systematics
from pyklip_diffrender.reduction import reduce
from pyklip_diffrender.refinement import GaussNewton, Refinement, refine
from pyklip_diffrender.scene.objects import Planet, Scene, Star
from pyklip_diffrender.scene.observation import Observation
from pyklip_diffrender.scene.sequence import Sequence
from pyklip_diffrender.scene.simulation import simulate
from pyklip_diffrender.scene.systematics import Systematics
from pyklip_diffrender.wavefront.opd import random_opd

SIZE = 32
SETTINGS = GaussNewton(cycles=6)
PLANET = Planet(2e-5, 0.6, 40.0)


@cache
def model():
    return nircam_coronagraph("F444W", monochromatic=4.5e-6, npix=128, fov_pixels=SIZE)


@cache
def opd():
    return random_opd(1, npix=128)


def pattern():
    """A multiplicative error of the model, 6 % rms, smooth over two pixels or so."""
    rough = np.random.default_rng(5).normal(size=(SIZE, SIZE))
    smooth = rough + np.roll(rough, 1, axis=0) + np.roll(rough, 1, axis=1)
    return 0.06 * smooth / smooth.std()


@cache
def frame(star, seed, *, planet=False, roll=0.0):
    """A frame of a star whose light the pattern multiplies."""
    turned = replace(PLANET, position_angle=PLANET.position_angle - roll)
    scene = Scene(Star(exposure=20.0), (turned,) if planet else ())
    clean = simulate(model(), replace(scene, planets=()), opd(), seed=seed)
    both = simulate(model(), scene, opd(), seed=seed)
    data = clean.data * (1 + pattern()) + (both.data - clean.data)
    header = fits.Header({"TARGPROP": star})
    return replace(
        both, data=data, header=header, name=f"{star} {seed}", position_angles=np.array([roll])
    )


@cache
def reference_fit():
    return refine(model(), [frame("REF", 10), frame("REF", 11)], opd(), settings=SETTINGS)


def calints(path, star, roll, date, **cards):
    data = np.random.default_rng(len(star)).normal(10, 1, (2, 24, 24)).astype("f4")
    defaults = {
        "TELESCOP": "JWST", "PUPIL": "MASKRND", "CORONMSK": "MASKA335R",
        "SUBARRAY": "SUB320A335R", "DETECTOR": "NRCALONG", "IS_PSF": False,
    }  # fmt: skip
    primary = {**defaults, "TARGPROP": star, "DATE-BEG": date, **cards}
    place = {"CRPIX1": 13.0, "CRPIX2": 12.0, "PIXAR_A2": 0.0039, "V3I_YANG": 0.05}
    return small_files.calints(path, data, primary=primary, ROLL_REF=roll, **place)


@pytest.fixture
def folder(tmp_path):
    calints(tmp_path / "a.fits", "AU MIC", 75.0, "2022-10-03T09:00:00")
    calints(tmp_path / "b.fits", "AU MIC", 65.0, "2022-10-03T06:00:00")
    calints(tmp_path / "c.fits", "HIP1", 20.0, "2022-10-03T07:00:00", IS_PSF=True)
    return tmp_path


def test_files_are_sorted_by_their_headers(folder):
    sequence = Sequence.from_files(folder)
    assert sequence.target == "AU MIC"
    assert [each.name for each in sequence.science] == ["b.fits", "a.fits"]
    assert [each.name for each in sequence.references] == ["c.fits"]
    assert [each.reference for each in sequence.references] == [True]
    assert sequence.science[1].roll_from(sequence.science[0]) == pytest.approx(-10)
    assert list(sequence.table["use"]) == ["target", "target", "reference"]
    np.testing.assert_allclose(sequence.table["position_angle"].to_value(u.deg)[:2], [65.05, 75.05])
    chosen = Sequence.from_files(folder, target="hip 1")
    assert [each.name for each in chosen.science] == ["c.fits"]
    assert len(chosen.references) == 2
    assert sequence.cutout(10).science[0].shape == (10, 10)


def test_rolls_are_cut_alike_if_their_stars_are_on_nearly_the_same_pixel():
    rolls = [
        Observation.from_arrays(
            np.arange(900.0).reshape(30, 30) + shift,
            np.ones((30, 30)),
            pixelscale=0.063,
            center=(15.0 + shift, 14.6),
            first_pixel=(600, 1600),
        )
        for shift in (0.4, 0.6, 7.0)
    ]
    cut = Sequence("star", tuple(rolls)).cutout(10)
    assert [roll.cutout(10).first_pixel for roll in rolls] == [
        (611, 1610),
        (611, 1610),
        (618, 1610),
    ]
    near = Sequence("star", (rolls[0], replace(rolls[1], center=rolls[1].center + 0.6))).cutout(10)
    assert near.science[1].first_pixel == near.science[0].first_pixel == (611, 1610)
    np.testing.assert_allclose(near.science[1].center, [[5.2, 5.2]])
    assert near.science[1].data[0, 0, 0] == rolls[1].data[0, 10, 11]
    # Farther apart, each has its star in the middle.
    assert cut.science[2].first_pixel == (618, 1610)


def test_what_does_not_belong_is_left_out_with_a_reason(folder):
    calints(
        folder / "d.fits", "HIP1", 20.0, "2022-10-03T08:00:00", CORONMSK="MASKA430R", IS_PSF=True
    )
    calints(folder / "e.fits", "HIP1", 20.0, "2022-10-03T08:00:00", FILTER="F356W", IS_PSF=True)
    (folder / "f.fits").write_bytes(b"not a FITS file")
    sequence = Sequence.from_files(folder, filter="F444W")
    reasons = dict(sequence.excluded)
    assert set(reasons) == {"d.fits", "e.fits", "f.fits"}
    assert "MASKA430R" in reasons["d.fits"]
    assert "F356W" in reasons["e.fits"]
    with pytest.raises(IncompatibleSetupError, match=r"filter: the files have .*F356W"):
        Sequence.from_files(folder)


@pytest.mark.parametrize(
    ("first", "second", "same"),
    [
        ("V-AU-MIC", "au mic", True),
        ("V* AU Mic", "V-AU-MIC", True),
        ("V-AU-MIC", "AU_Mic", True),
        ("* bet Pic", "BET-PIC", True),
        ("V 1298 Tau", "V1298-TAU", True),
        ("HIP-17695", "HIP 1769", False),
        ("V1298 Tau", "1298 Tau", False),
    ],
)
def test_names_are_the_same_in_any_spelling(first, second, same):
    assert same_name(first, second) is same_name(second, first) is same


def test_a_target_that_cannot_be_decided_is_an_error(folder, tmp_path):
    with pytest.raises(IncompatibleSetupError, match=r"'VEGA', expected one of 'AU MIC', 'HIP1'$"):
        Sequence.from_files(folder, target="VEGA")
    with pytest.raises(IncompatibleSetupError, match=r"Did you mean 'AU MIC'\?"):
        Sequence.from_files(folder, target="AU Microscopii")
    with pytest.raises(IncompatibleSetupError, match=r"expected one of 'AU MIC', 'HIP1'$"):
        Sequence.from_files(folder, target="HIP 17695")
    with pytest.raises(IncompatibleSetupError, match=r"filter: got 'F445W'.* mean 'F444W'\?"):
        Sequence.from_files(folder, filter="F445W")
    calints(folder / "g.fits", "HIP2", 20.0, "2022-10-03T08:00:00")
    with pytest.raises(IncompatibleSetupError, match="choose one with"):
        Sequence.from_files(folder)
    empty = tmp_path / "empty"
    empty.mkdir()
    with pytest.raises(NoValidPixelsError, match="no FITS files"):
        Sequence.from_files(empty)


def test_the_position_of_the_star_behind_the_mask_is_read(folder):
    with fits.open(folder / "a.fits") as hdus:
        hdus.append(fits.ImageHDU(np.array([[0.2, -0.1], [0.4, -0.1]]), name="MASKOFFS"))
        hdus.writeto(folder / "h.fits")
    observation = Observation.from_fits(folder / "h.fits")
    pixel = 0.0039**0.5
    np.testing.assert_allclose(observation.star_offset, (0.3 * pixel, -0.1 * pixel), rtol=1e-6)


def test_dithers_behind_the_mask_are_read(folder):
    without = Observation.from_fits(folder / "a.fits")
    assert without.star_offset is None
    for key, value in (("XOFFSET", 0.02), ("YOFFSET", -0.01)):
        fits.setval(folder / "a.fits", key, value=value)
    dithered = Observation.from_fits(folder / "a.fits")
    assert dithered.star_offset == (0.02, -0.01)
    expected = without.center + np.array([0.02, -0.01]) / without.pixelscale
    np.testing.assert_allclose(dithered.center, expected)
    # Where somebody has measured the star, the dither is in its position already.
    for key, value in (("STARCENX", 13.3), ("STARCENY", 11.8)):
        fits.setval(folder / "b.fits", key, value=value)
    fits.setval(folder / "b.fits", "XOFFSET", value=0.02)
    stated = Observation.from_fits(folder / "b.fits")
    assert stated.star_offset is None
    np.testing.assert_allclose(stated.center[0], (12.3, 10.8))
    # A star that was moved out from behind the mask.
    fits.setval(folder / "a.fits", "XOFFSET", value=1.5)
    away = Observation.from_fits(folder / "a.fits")
    assert away.star_offset is None
    np.testing.assert_array_equal(away.center, without.center)


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


@pytest.mark.parametrize("name", [pytest.param("F356W", marks=pytest.mark.slow), "F444W"])
def test_real_stars_are_off_the_mask_by_what_the_files_say(shared_data, name):
    """The star moves by a third of a pixel, the mask stays on its pixels of the detector."""
    files = [Observation.from_fits(path) for path in sorted((shared_data / "gto1184").glob("*"))]
    frames = [each for each in files if each.filter == name]
    stars = np.array([each.center.mean(axis=0) + each.first_pixel for each in frames])
    offsets = np.array([each.star_offset for each in frames]) / frames[0].pixelscale
    assert len(frames) == 6
    assert np.ptp(stars, axis=0).min() > 0.15
    assert np.ptp(stars - offsets, axis=0).max() < 0.001


def test_a_pattern_is_learned_from_another_star():
    fit = reference_fit()
    assert fit.chi2_per_pixel > 5
    learned = learn_systematics(fit)
    truth = pattern()
    y, x = np.indices(truth.shape) - (SIZE - 1) / 2
    bright = np.hypot(x, y) < 12
    # What looks like wavefront is not in the pattern: most of it is not, and is recovered.
    assert np.corrcoef(learned.pattern[bright], truth[bright])[0, 1] > 0.8
    assert learned.unknown == pytest.approx(0.05, rel=0.5)
    assert learned.filter == "F444W"


@pytest.mark.slow
def test_with_the_pattern_the_planet_of_another_star_is_unbiased():
    target = [frame("TARGET", 20, planet=True), frame("TARGET", 21, planet=True, roll=10.0)]
    without = refine(model(), target, opd(), settings=SETTINGS)
    learned = learn_systematics(reference_fit())
    fit = refine(model(), target, opd(), settings=SETTINGS, systematics=learned)
    assert without.chi2_per_pixel > 5
    assert fit.chi2_per_pixel < 2
    (row,) = detect(fit).candidates
    away = (row["contrast"] - PLANET.contrast) / row["contrast_error"]
    assert abs(away) < 3
    assert row["separation"].to_value(u.arcsec) == pytest.approx(0.6, abs=0.01)
    assert row["snr"] > 10


def test_a_pattern_needs_two_frames_of_one_filter():
    single = replace(reference_fit(), frames=reference_fit().frames[:1])
    with pytest.raises(IncompatibleSetupError, match="at least two"):
        learn_systematics(single)


def test_systematics_survive_the_file(tmp_path):
    learned = learn_systematics(reference_fit(), name="spring")
    back = Systematics.read(learned.write(tmp_path / "pattern.fits"))
    np.testing.assert_array_equal(back.pattern, learned.pattern)
    np.testing.assert_array_equal(back.error, learned.error)
    assert (back.center, back.unknown, back.filter) == (
        learned.center, learned.unknown, learned.filter,
    )  # fmt: skip
    assert (back.name, back.provenance["stars"]) == ("spring", ["REF"])
    fits.PrimaryHDU().writeto(tmp_path / "other.fits")
    with pytest.raises(CorruptFileError, match="systematics"):
        Systematics.read(tmp_path / "other.fits")


@cache
def rolled_fit():
    frames = [frame("TARGET", 20, planet=True), frame("TARGET", 21, planet=True, roll=10.0)]
    learned = learn_systematics(reference_fit())
    return refine(model(), frames, opd(), settings=SETTINGS, systematics=learned)


def test_a_refinement_survives_the_file(tmp_path):
    fit = rolled_fit()
    back = Refinement.read(fit.write(tmp_path / "fit.fits"))
    assert (back.status, back.settings) == (fit.status, fit.settings)
    for ours, theirs in zip(back.frames, fit.frames, strict=True):
        np.testing.assert_array_equal(ours.star, theirs.star)
        np.testing.assert_array_equal(ours.opd, theirs.opd)
        assert ours.observation.position_angle == theirs.observation.position_angle
        assert ours.observation.target == "TARGET"
    places = [PLANET.offset, [0.5, -0.3]]
    again, first = measure(back, places), measure(fit, places)
    np.testing.assert_array_equal(again["contrast"], first["contrast"])
    np.testing.assert_array_equal(again["contrast_error"], first["contrast_error"])


def test_a_file_says_of_how_many_integrations_frames_are_the_mean(tmp_path):
    fit = rolled_fit()
    one, two = fit.frames
    frames = (
        replace(one, observation=replace(one.observation, integrations=(7,))),
        # Two segments of an exposure, which the file has as one mean.
        replace(two, observation=two.observation.followed_by([two.observation] * 2)),
    )
    back = Refinement.read(replace(fit, frames=frames).write(tmp_path / "fit.fits", linear=False))
    assert [each.observation.count for each in back.frames] == [7, 3]


def test_reduce_says_what_systematics_it_takes():
    sequence = Sequence("TARGET", (frame("TARGET", 20),))
    with pytest.raises(IncompatibleSetupError, match=r"'maybe', expected 'auto', 'references'"):
        reduce(sequence, opd(), size=SIZE, systematics="maybe")
