"""A known pattern of the star model's error: what it spoils, and that it can be taken out."""

from dataclasses import replace
from functools import cache
from itertools import product
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter

import pyklip_diffrender as dr
from benchmarks.noisy_stars import READ_NOISE, drifted_star
from pyklip_diffrender.detection.candidates import Maps
from pyklip_diffrender.detection.templates import Templates
from pyklip_diffrender.errors import IncompatibleSetupError, ShapeError
from pyklip_diffrender.pattern import measure
from pyklip_diffrender.refinement import Status, refine_again
from pyklip_diffrender.scene.detector_pattern import DetectorPattern, require_pattern_of
from pyklip_diffrender.scene.objects import Planet
from pyklip_diffrender.scene.observation import Observation
from pyklip_diffrender.wavefront.bases import FourierModes, JointBasis, SegmentMotions

NPIX, SIZE = 64, 32
BASIS = JointBasis([SegmentMotions(), FourierModes(4)])
RMS = 0.06
PLANET = Planet(3e-5, 0.6, 0.0)
MIDDLE = ((SIZE - 1) / 2, (SIZE - 1) / 2)


def frame(shape, center, **details):
    ones = np.ones(shape)
    return Observation.from_arrays(ones, ones, pixelscale=0.06, center=center, **details)


@pytest.mark.parametrize("shape", [(4, 5), (20, 17)], ids=["smaller", "larger"])
def test_pixels_are_matched_by_the_star(shape):
    """Cutouts that stick out on every side, or do not meet the pattern at all."""
    pattern = 1.0 + np.arange(9 * 12).reshape(9, 12)
    known = DetectorPattern(pattern, 0.01 * pattern, (6.0, 4.0), unknown=0.5)
    for x, y in product([-12.0, -3.0, 0.3, 5.0, 40.0], [-25.0, -2.0, 0.0, 9.0]):
        got, error = known.at(frame(shape, (6.0 + x, 4.0 + y)))
        assert got.shape == error.shape == shape
        row, column = np.indices(shape) - np.reshape([round(y), round(x)], (2, 1, 1))
        inside = (row >= 0) & (row < 9) & (column >= 0) & (column < 12)
        there = pattern[row.clip(0, 8), column.clip(0, 11)]
        np.testing.assert_array_equal(got, np.where(inside, there, 0.0))
        np.testing.assert_array_equal(error, np.where(inside, 0.01 * there, 0.5))


@pytest.mark.parametrize("corner", [(600, 1600), (602, 1597), (597, 1604), (590, 1590)])
def test_pixels_are_matched_on_the_detector_where_both_know_theirs(corner):
    """A pixel keeps its flat field wherever in the frame the star is."""
    rows, columns = np.mgrid[1600:1609, 600:612]
    serial = 1.0 + 1000 * rows + columns
    measured = DetectorPattern(serial, 0.01 * serial, (6.0, 4.0), 0.5, first_pixel=(600, 1600))
    got, error = measured.at(frame((10, 8), (1.0, 7.0), first_pixel=corner))
    rows, columns = np.mgrid[corner[1] : corner[1] + 10, corner[0] : corner[0] + 8]
    known = (rows >= 1600) & (rows < 1609) & (columns >= 600) & (columns < 612)
    assert known.any() == (corner != (590, 1590))
    serial = 1.0 + 1000 * rows + columns
    np.testing.assert_array_equal(got, np.where(known, serial, 0.0))
    np.testing.assert_array_equal(error, np.where(known, 0.01 * serial, 0.5))


def test_another_filter_and_unequal_arrays_are_refused():
    zeros = np.zeros((9, 12))
    known = DetectorPattern(zeros, zeros, (6.0, 4.0), 0.5, filter="F444W")
    require_pattern_of(known, frame((9, 12), (6.0, 4.0), filter="F444W"))
    # Nothing says that they do not go together.
    require_pattern_of(known, frame((9, 12), (6.0, 4.0)))
    with pytest.raises(IncompatibleSetupError, match=r"'pattern'.*F444W.*F356W"):
        require_pattern_of(known, frame((9, 12), (6.0, 4.0), filter="F356W"))
    with pytest.raises(ShapeError, match=r"\(9, 12\) and \(9, 11\)"):
        DetectorPattern(zeros, zeros[:, 1:], (6.0, 4.0), 0.5)


@cache
def star():
    return drifted_star(NPIX, SIZE, BASIS, 1.0, 0.15, 3, 3e10)


@cache
def pattern(seed=1):
    """As smooth as speckles are, rms 6 %."""
    drawn = np.random.default_rng(seed).normal(size=(SIZE, SIZE))
    smooth = gaussian_filter(drawn, 1.0, mode="wrap")
    return RMS * smooth / smooth.std()


def light():
    return star().star()


def known(error=1e-3, seed=1):
    return DetectorPattern(
        pattern(seed), np.full((SIZE, SIZE), error), MIDDLE, RMS, name="measured"
    )


@pytest.mark.slow
def test_a_pattern_hides_planets_and_is_taken_out_where_it_is_known():
    planet = Planet(8e-6, 0.6, 300.0)
    spoilt = star().observed(light() * (1 + pattern()) + star().light(planet), 50)
    without, with_it, wrong = (
        star().refined(spoilt, pattern=each) for each in (None, known(), known(seed=2))
    )
    assert without.status is wrong.status is Status.MODEL_MISMATCH
    assert min(without.reduced_chi2, wrong.reduced_chi2) > 30
    assert with_it.status is Status.CONVERGED
    # 1024 pixels: known to 4.4 %.
    assert with_it.reduced_chi2 == pytest.approx(1.0, abs=0.13)
    rows = [dr.detect(fit).measure([planet.offset])[0] for fit in (without, with_it)]
    left = float(rows[1]["contrast"] / planet.contrast - 1)
    assert abs(left) < 0.12
    assert abs(left) < 2.5 * float(rows[1]["contrast_error"] / planet.contrast)
    assert rows[1]["contrast_error"] < 0.5 * rows[0]["contrast_error"]
    # The star is the one that was observed, pattern included; what is rendered elsewhere has none.
    frame = with_it.frames[0]
    np.testing.assert_array_equal(frame.gain, 1 + pattern())
    noise = np.sqrt(light() + READ_NOISE**2)
    away = (frame.star - light() * (1 + pattern())) / noise
    # What a planet beside it leaves uncertain, and the pattern's own 0.1 %.
    assert np.sqrt(np.mean(away**2)) < 0.6
    rendered = frame.values["background"][0] + frame.gain * frame.render(background=False)
    np.testing.assert_allclose(rendered, frame.star, rtol=1e-9)
    assert with_it.summary()["pattern"] == "measured"
    # It is part of what goes on from the fit.
    assert refine_again(with_it, max_iterations=2).pattern is with_it.pattern


@pytest.mark.slow
def test_the_error_of_a_pattern_counts_as_noise():
    """The frames' own pattern differs from the one that was measured, by what its error says."""
    drawn = 0.02 * np.random.default_rng(8).normal(size=(SIZE, SIZE))
    spoilt = star().observed(light() * (1 + pattern() + drawn) + star().light(PLANET), 51)
    honest, sure = (star().refined(spoilt, pattern=known(error)) for error in (0.02, 1e-6))
    assert honest.status is Status.CONVERGED
    assert honest.reduced_chi2 == pytest.approx(1.0, abs=0.13)
    assert sure.reduced_chi2 > 3
    row = dr.detect(honest).measure([PLANET.offset])[0]
    assert abs(row["contrast"] - PLANET.contrast) < 3 * row["contrast_error"]
    plain = star().refined(star().observed(star().expected(PLANET), 51))
    exact = dr.detect(plain).measure([PLANET.offset])[0]
    assert row["contrast_error"] > 1.2 * exact["contrast_error"]


def test_frames_fitted_together_have_the_pattern_each_at_its_star():
    frames = []
    for k, (x, y) in enumerate(((0, 0), (2, 1))):
        scale = star().model.detector.pixelscale
        moved = star().star(detector_shift=(x * scale[0], y * scale[1]))
        expected = moved * (1 + np.roll(pattern(), (y, x), axis=(0, 1)))
        frames.append(star().observed(expected, 60 + k, center=(MIDDLE[0] + x, MIDDLE[1] + y)))
    fit = star().refined(frames, pattern=known())
    assert fit.status is Status.CONVERGED
    assert fit.reduced_chi2 == pytest.approx(1.0, abs=0.1)
    np.testing.assert_array_equal(fit.frames[1].gain[1:, 2:], 1 + pattern()[:-1, :-2])


@pytest.mark.parametrize("size", [0.6, 0.0])
def test_frames_tell_how_much_of_a_pattern_they_show(size, caplog):
    """Another flat field may have removed a part of the pattern, or all of it."""
    spoilt = star().observed(light() * (1 + size * pattern()) + star().light(PLANET), 53)
    fit = star().refined(spoilt, pattern=known(0.01))
    measured = measure.pattern_size(fit)
    assert measured[0] == pytest.approx(size, abs=0.1)
    assert 0 < measured[1] < 0.05
    assert measure.lacks_pattern(fit) is (size < 0.5)
    warnings = [each.getMessage() for each in caplog.records if each.levelname == "WARNING"]
    assert len(warnings) == (size < 0.5)
    assert all("detector pattern of measured" in each for each in warnings)


def test_a_fit_without_a_known_pattern_says_nothing_about_it():
    spoilt = star().observed(light(), 54)
    zeros = np.zeros((SIZE, SIZE))
    for pattern in (None, DetectorPattern(zeros, zeros + 0.01, MIDDLE, RMS)):
        fit = star().refined(spoilt, pattern=pattern)
        assert measure.pattern_size(fit) is None
        assert not measure.lacks_pattern(fit)


@cache
def rolls(pedestal=0.0):
    """Two rolls of the planet on the same pixels, with a pattern of 3 %."""
    error, frames = 0.5 * pattern(), []
    for k, angle in enumerate((0.0, 60.0)):
        where = {"position_angles": np.array([angle]), "first_pixel": (600, 1600)}
        expected = light() * (1 + error) + star().light(PLANET.rotated(-angle))
        roll = star().observed(expected, 70 + k, **where)
        frames.append(replace(roll, data=roll.data + pedestal * error))
    return frames


def test_a_single_roll_may_show_more_of_a_structure_than_the_pattern_says():
    flat = 0.01 * np.random.default_rng(6).normal(size=(SIZE, SIZE))
    flat[21:24, 22:25] += 0.08
    drawn = DetectorPattern(flat, 0.1 * abs(flat), MIDDLE, 0.01, first_pixel=(600, 1600))
    fits = [star().refined(frames, pattern=drawn) for frames in (rolls()[0], rolls())]
    single, both = (Maps(Templates(fit)) for fit in fits)
    planet = single.templates.at_pixels(np.array([22]), np.array([23]))[0][0].numpy()
    weighted = planet * single.templates.linear.frames[0].weight.numpy() ** 2
    contrast = (weighted * flat * light())[20:25, 21:26].sum() / (weighted * planet).sum()
    snr = contrast * np.sqrt(single.information[22, 23])
    assert single.structures[22, 23] == pytest.approx(snr, rel=0.25)
    assert np.median(single.structures) < 0.05 * snr
    assert not both.structures.any()


def test_frames_of_the_same_pixels_share_what_is_unknown_of_the_pattern():
    zeros = np.zeros((SIZE, SIZE))
    unknown = DetectorPattern(zeros, zeros + 0.5 * RMS, MIDDLE, RMS, first_pixel=(600, 1600))
    shared, apart = (
        star().refined(frames, pattern=unknown)
        for frames in (rolls(), [replace(roll, first_pixel=None) for roll in rolls()])
    )
    assert shared.status is Status.CONVERGED
    assert shared.chi2_per_pixel == pytest.approx(1.0, abs=0.1)
    # The equations that were solved are those of the covariance between the frames.
    linear = shared.linear
    jacobian = torch.stack([
        part.onto_unknowns(part.jacobian.double().flatten(1), len(linear.vector))
        for part in linear.frames
    ])  # fmt: skip
    weight = torch.stack([each.weight.flatten() for each in linear.frames]) ** 2
    common = torch.stack([each.common.flatten() for each in linear.frames])
    summed = (jacobian * (weight * common)[:, None]).sum(dim=0)
    own = torch.einsum("fap,fp,fbp->ab", jacobian, weight, jacobian)
    difference = linear.curvature - (own - summed @ summed.T)
    scale = own.diagonal().sqrt()
    assert float((difference / scale[:, None] / scale).abs().max()) < 1e-5
    assert float((summed @ summed.T).diagonal().div(own.diagonal()).max()) > 0.2
    # The pattern is in the same pixels, the planet is not.
    found = [dr.detect(fit, separations=[0.6]) for fit in (shared, apart)]
    limits = [each.contrast_curve["known_star"][0] for each in found]
    assert limits[0] < 0.9 * limits[1]
    rows = [each.measure([PLANET.offset])[0] for each in found]
    assert rows[0]["snr"] > rows[1]["snr"] > 20
    assert abs(rows[0]["contrast"] - PLANET.contrast) < 3 * rows[0]["contrast_error"]


@pytest.mark.slow
def test_the_pattern_multiplies_the_pedestal(tmp_path):
    pedestal = 1e4
    measured = DetectorPattern(
        0.5 * pattern(), np.full((SIZE, SIZE), 1e-3), MIDDLE, RMS, pedestal=pedestal,
        first_pixel=(600, 1600),
    )  # fmt: skip
    measured = DetectorPattern.read(measured.write(tmp_path / "pattern.fits"))
    assert measured.pedestal == pedestal
    exact, none, low = (
        star().refined(rolls(pedestal), pattern=replace(measured, pedestal=each))
        for each in (pedestal, 0.0, 0.6 * pedestal)
    )
    assert exact.reduced_chi2 == pytest.approx(1.0, abs=0.1)
    assert none.reduced_chi2 > 2
    # A fit has a pedestal of its own in every frame.
    assert low.reduced_chi2 == pytest.approx(exact.reduced_chi2, abs=0.02)
    for frame in low.frames:
        error = frame.errors["pedestal"][0]
        assert error < 0.05 * pedestal
        assert abs(frame.values["pedestal"][0] - pedestal) < 4 * error
    # What a pattern is learned from is what the frames show beyond the star without any pattern.
    for frame in exact.frames:
        light, left, _, valid = measure.light_and_residual(frame)
        expected = (0.5 * pattern() * (light + pedestal))[valid]
        assert (left[valid] @ expected) / (expected @ expected) == pytest.approx(1.0, abs=0.05)
    again = dr.Refinement.read(low.write(tmp_path / "fit.fits"))
    assert again.frames[1].values["pedestal"] == low.frames[1].values["pedestal"]


def fit_of(star, error, pedestal, seed, stated=0.05):
    """Two frames of a star with a pattern on star and pedestal, and noise of 0.05."""
    rng = np.random.default_rng(seed)
    frames = []
    for _ in range(2):
        data = star + error * (star + pedestal) + 0.05 * rng.normal(size=star.shape)
        observation = Observation.from_arrays(
            data, np.full(data.shape, stated), pixelscale=0.063, first_pixel=(600, 1600)
        )
        frames.append(
            SimpleNamespace(
                observation=replace(observation, name=f"star {seed}"), star=star, pedestal=0.0,
                gain=np.ones(star.shape), companion_image=np.zeros(star.shape),
                values={"background": np.zeros(1)},
            )
        )  # fmt: skip
    return SimpleNamespace(frames=tuple(frames), status=Status.CONVERGED)


def halo(size=100):
    y, x = np.indices((size, size)) - (size - 1) / 2
    return 30.0 / (1 + (np.hypot(x, y) / 8) ** 3)


def test_the_pedestal_makes_the_pattern_equally_strong_everywhere():
    """Two frames of a bright star with a pattern of 3 % on star and pedestal."""
    size, pedestal, noise, star = 100, 1.5, 0.05, halo()
    error = 0.03 * np.random.default_rng(9).normal(size=(size, size))
    fit = fit_of(star, error, pedestal, 10)
    frames = fit.frames
    assert measure.pattern_pedestal([fit]) == pytest.approx(pedestal, rel=0.15)
    known = measure.learn_pattern([fit])
    assert known.pedestal == measure.pattern_pedestal([fit])
    # Two frames: 0.05 / sqrt(2) of noise over the light.
    predicted = noise / np.sqrt(2) / (star + known.pedestal)
    pull = (known.value - error) / predicted
    assert 0.5 < pull.std() < 1.05
    assert np.corrcoef(known.value.ravel(), error.ravel())[0, 1] > 0.85
    elsewhere = replace(frames[1].observation, first_pixel=None)
    lost = SimpleNamespace(**{**vars(frames[1]), "observation": elsewhere})
    apart = SimpleNamespace(**{**vars(fit), "frames": (frames[0], lost)})
    assert measure.pattern_pedestal([apart]) == 0


def test_stars_of_different_brightness_tell_the_pedestal_wherever_the_pattern_is_weak():
    """The pattern is half as strong near the star, as where the wavefront has taken a part."""
    star = halo()
    error = 0.03 * np.random.default_rng(3).normal(size=star.shape)
    error[star > 5] /= 2
    fits = [fit_of(star, error, 1.5, 11), fit_of(star / 3, error, 1.5, 12)]
    assert measure.pattern_pedestal(fits[:1]) > 2.5
    assert measure.pattern_pedestal(fits) == pytest.approx(1.5, rel=0.1)
    # Stars of the same brightness do not.
    equal = [fits[0], fit_of(star, error, 1.5, 13)]
    assert measure.pattern_pedestal(equal) > 2.5


def test_a_pattern_is_not_shrunk_by_errors_that_are_too_large():
    star = halo()
    error = 0.03 * np.random.default_rng(4).normal(size=star.shape)
    far = star < 1
    for stated in (0.05, 0.08):
        fits = [fit_of(star, error, 1.5, 20, stated), fit_of(star / 3, error, 1.5, 21, stated)]
        pattern = measure.learn_pattern(fits).value
        # The slope of the truth against the pattern is 1 if it is shrunk as it should be.
        slope = (error * pattern)[far].sum() / (pattern**2)[far].sum()
        assert slope == pytest.approx(1.0, abs=0.05)
