"""Detection on a small system: calibrated, unbiased, and honest where the model is wrong."""

import gc
import logging
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from astropy import units as u
from astropy.io import fits as astropy_fits
from astropy.table import QTable
from astropy.time import Time
from astropy.units import Unit
from astropy.wcs import WCS
from matplotlib.figure import Figure

import pyklip_diffrender as dr
from benchmarks.noisy_stars import drift, drifted_star
from pyklip_diffrender.detection import Detection
from pyklip_diffrender.detection.candidates import with_companions
from pyklip_diffrender.detection.error_factor import ErrorFactor, Significance
from pyklip_diffrender.errors import CorruptFileError, DiffrenderError, IncompatibleSetupError
from pyklip_diffrender.linear.model import Unknown
from pyklip_diffrender.optics.grid import PupilGrid
from pyklip_diffrender.refinement import Status, annealing, fitting, refine_again
from pyklip_diffrender.refinement.annealing import Annealing
from pyklip_diffrender.scene.objects import Planet
from pyklip_diffrender.scene.product_headers import world_coordinates
from pyklip_diffrender.wavefront.bases import FourierModes, JointBasis, SegmentMotions
from pyklip_diffrender.wavefront.priors import WavefrontPrior

FLUX = 3e11
WHERE = Planet(0.0, 0.7, 60.0)
FAINT = replace(WHERE, contrast=2e-6)
"""Below the S/N at which the star is refined again."""


def drifted(npix, size, cycles, segments=2.0, seed=1, flux=FLUX):
    basis = JointBasis([SegmentMotions(), FourierModes(cycles)])
    return drifted_star(npix, size, basis, segments, 0.15, seed, flux)


@pytest.fixture(scope="module")
def world():
    """Small enough for a fit in half a second."""
    return drifted(64, 32, 4.0)


@pytest.fixture(scope="module")
def large():
    """With as many modes as bright companions need, which a wavefront must not imitate."""
    return drifted(128, 40, 8.0)


@pytest.fixture(scope="module")
def one(world):
    """A planet of S/N 44 or so."""
    return world.detected(11, replace(WHERE, contrast=1e-5))


def radius(found):
    return np.hypot(found.grid[..., 0], found.grid[..., 1])


def test_snr_scatters_by_one_where_there_is_nothing(world):
    empty = [world.detected(seed) for seed in range(3)]
    inside = radius(empty[0]) > 0.25
    values = np.concatenate([found.snr[inside] for found in empty])
    # Some 40 independent positions a frame: the deviation of three is known to 7 %.
    assert values.std() == pytest.approx(1.0, abs=0.12)
    assert abs(values.mean()) < 0.15
    # chi2 of a thousand pixels is known to 4.5 %.
    assert all(1.0 <= found.scatter < 1.06 for found in empty)
    assert all(len(found.sources) == 0 for found in empty)
    # The freedom of the wavefront costs something everywhere.
    ratio = (empty[0].error / empty[0].photon_error)[inside]
    assert ratio.min() > 1.0
    assert 1.02 < np.median(ratio) < 2.0


@pytest.mark.slow
def test_contrast_and_place_of_planets_are_unbiased_and_their_errors_right():
    """New wavefront, place and noise 32 times; errors wrong by a factor of 1.4 do not pass.

    The deviation of 32 pulls is known to 13 %, of 64 to 9 %.
    """
    contrasts, places = [], []
    for seed in range(32):
        world = drifted(64, 32, 4, segments=1.0, seed=seed, flux=3e10)
        planet = Planet(1.2e-5, 0.5 + 0.1 * (seed % 4), 47.0 * seed)
        found = world.detected(seed, planet)
        row = found.measure([planet.offset])[0]
        contrasts.append((row["contrast"] - planet.contrast) / row["contrast_error"])
        if len(found.candidates) == 1:  # Else it is not above the threshold.
            (row,) = found.candidates
            for axis, true in zip("xy", planet.offset, strict=True):
                places.append((row[axis].value - true) / row[f"{axis}_error"].value)
    assert len(places) > 1.7 * 32
    for pulls in (np.array(contrasts), np.array(places)):
        assert abs(pulls.mean()) < 3 / len(pulls) ** 0.5
        assert 1.4**-0.5 < pulls.std() < 1.4**0.5


@pytest.mark.parametrize(
    ("size", "contrast"), [("world", 1e-3), pytest.param("large", 2e-5, marks=pytest.mark.slow)]
)
def test_a_bright_companion_gets_parameters_of_its_own(request, size, contrast):
    """Without them the wavefront bends to it, and nothing converges."""
    world = request.getfixturevalue(size)
    planet = replace(WHERE, contrast=contrast)
    fit = world.fitted(7, planet)
    assert fit.status is Status.CONVERGED
    assert len(fit.companions) == 1
    measured, error = fit.companions[0], fit.companion_errors[0]
    assert measured[0] == pytest.approx(contrast, rel=0.02, abs=4 * error[0])
    assert measured[1:] == pytest.approx(planet.offset, abs=0.005)
    assert fit.frames[0].star == pytest.approx(world.expected(), rel=0.02, abs=100)


def test_a_prior_of_another_size_is_adapted(world, monkeypatch):
    observation = world.observed(world.expected(), 4)
    likely = world.fitted(4)
    assert not likely.prior_ratios
    narrow = {name: scale / 3 for name, scale in likely.scales.items()}
    held = WavefrontPrior(narrow, fit_scales=False)
    fit = world.refined(observation, prior=held, adapt_prior=True)
    assert fit.status is Status.CONVERGED
    assert fit.scales["segment"] == pytest.approx(likely.scales["segment"], rel=0.15)
    assert fit.scales["texture"] == pytest.approx(narrow["texture"])  # Few modes are determined.
    assert fit.settings.prior.scales == pytest.approx(fit.scales)
    unwidened = world.refined(observation, prior=held)
    assert unwidened.status is Status.PRIOR_MISMATCH
    assert [record["iteration"] for record in fit.history] == list(range(len(fit.history)))
    assert len(fit.history) > len(unwidened.history)
    right = WavefrontPrior(likely.scales, fit_scales=False)  # One that holds is left alone.
    kept = world.refined(observation, prior=right, adapt_prior=True)
    assert (kept.status, kept.scales) == (Status.CONVERGED, pytest.approx(likely.scales))
    # One that is too wide is narrowed.
    wide = WavefrontPrior({n: 4 * s for n, s in likely.scales.items()}, fit_scales=False)
    kept, fit = (world.refined(observation, prior=wide, adapt_prior=each) for each in (False, True))
    assert kept.scales == pytest.approx(wide.scales)
    assert fit.scales == pytest.approx(likely.scales, rel=0.1)
    # Also on the way of a fit that continues another, whose last state is the best one then.
    again = refine_again(kept, adapt_prior=True, tolerance=1e-9)
    assert again.chi2_per_pixel == pytest.approx(fit.chi2_per_pixel, abs=5e-3)
    # One that was adapted is not measured again.
    monkeypatch.delattr(Annealing, "_narrowed")
    assert refine_again(fit).scales == pytest.approx(fit.scales)
    with pytest.raises(AttributeError, match="_narrowed"):
        refine_again(kept, adapt_prior=True)


def test_a_prior_that_is_far_too_narrow_reaches_its_size_at_once(world, caplog):
    """The linear model tells how far, so that the wavefront is fitted once more, not more often."""
    likely = world.fitted(4)
    narrow = WavefrontPrior({n: scale / 8 for n, scale in likely.scales.items()}, fit_scales=False)
    with caplog.at_level("INFO", logger="pyklip_diffrender"):
        fit = world.refined(world.observed(world.expected(), 4), prior=narrow, adapt_prior=True)
    assert fit.status is Status.CONVERGED
    # A prior up to a quarter too wide is not narrowed.
    assert 0.85 < fit.scales["segment"] / likely.scales["segment"] < 1.25
    assert caplog.text.count("the wavefront is larger than its prior says") == 1


def test_a_fit_that_goes_on_widens_its_prior_on_the_way(world, monkeypatch):
    """The last steps are then not taken with a narrow prior first, and again with a wider one."""
    likely = world.fitted(4)
    narrow = WavefrontPrior({n: scale / 3 for n, scale in likely.scales.items()}, fit_scales=False)
    held = world.refined(world.observed(world.expected(), 4), prior=narrow)
    assert held.status is Status.PRIOR_MISMATCH
    monkeypatch.setattr(Annealing, "_with_wider_prior", lambda self, end: end)
    again = refine_again(held, adapt_prior=True)
    assert again.status is Status.CONVERGED
    # As for the prior that a first fit adapts at its end.
    assert again.scales["segment"] == pytest.approx(likely.scales["segment"], rel=0.15)
    # Where the noise does not explain the data, the wavefront may not be the reason.
    monkeypatch.setattr(Annealing, "_unexplained", lambda self, state: 0.01)
    kept = refine_again(held, adapt_prior=True)
    assert kept.scales == pytest.approx(narrow.scales)


def test_a_step_after_which_the_priors_change_is_not_the_last(world, monkeypatch):
    """Under other priors, another step may gain more."""
    held = world.refined(world.observed(world.expected(), 4))
    measured = []

    def measure(self, course, gain):
        if not measured:
            priors = replace(course.carried.priors)
            course.carried = replace(course.carried, priors=priors)
        measured.append(gain)

    monkeypatch.setattr(Annealing, "_measure_on_the_way", measure)
    refine_again(held, adapt_prior=True)
    assert len(measured) == 2
    assert measured[0] < held.settings.tolerance


def test_a_rough_fit_that_does_not_explain_its_data_goes_on(world, monkeypatch):
    """It ends at a chi-squared of 0.997 per pixel, which is not enough here, and goes on."""
    monkeypatch.setattr(annealing, "_EXPLAINED_CHI2", 0.97)
    observation = world.observed(world.expected(), 4)
    fine = world.refined(observation, tolerance=0.2)
    monkeypatch.setattr(fitting, "_FINER_TOLERANCE", np.inf)
    rough = world.refined(observation, tolerance=0.2)
    assert (rough.status, fine.status) == (Status.MODEL_MISMATCH, Status.CONVERGED)
    assert fine.history[: len(rough.history)] == rough.history
    assert len(fine.history) > len(rough.history)


def test_the_prior_of_the_amplitude_is_widened_as_well(world):
    absorbing = drift(world.basis, world.model.npix, 0.0, 6.0, 2)
    later = torch.from_numpy(world.later + 1j * absorbing)
    observation = world.observed(FLUX * world.model(later).numpy(), 4)
    narrow = WavefrontPrior(
        {"segment": 0.7, "texture": 0.1}, fit_scales=False,
        amplitude_cycles=4.0, amplitude_scale=2.0, amplitude_slope=0.0,
    )  # fmt: skip
    before, fit = (
        world.refined(observation, prior=narrow, adapt_prior=each) for each in (False, True)
    )
    assert before.status is Status.PRIOR_MISMATCH
    assert before.prior_ratios["amplitude"] > 3
    assert fit.status is Status.CONVERGED
    assert fit.prior_ratios["amplitude"] == pytest.approx(1.0, abs=0.15)
    widened = fit.settings.prior.amplitude_scale / narrow.amplitude_scale
    assert widened == pytest.approx(before.prior_ratios["amplitude"], rel=0.15)


def test_a_planet_does_not_make_the_noise_larger(world):
    quiet, fit = world.fitted(5), world.fitted(5, FAINT)
    noise, found = world.detected(5), world.detected(5, FAINT)
    assert len(found.sources) == 1
    assert len(fit.companions) == 0
    # Its light would be structure that no mode explains.
    assert fit.reduced_chi2 > 1.06 * quiet.reduced_chi2
    assert found.scatter == pytest.approx(noise.scatter, rel=0.01)


def test_weights_for_outliers_do_not_hide_structure(world):
    fit = world.refined(world.observed(world.expected(), 5), robust=3.0)
    assert fit.reduced_chi2 > 1.02
    assert dr.detect(fit).scatter == pytest.approx(math.sqrt(fit.reduced_chi2), rel=1e-6)


def test_a_planet_is_found_where_it_is(one):
    (row,) = one.candidates
    for axis, true in zip("xy", WHERE.offset, strict=True):
        error = row[f"{axis}_error"].to_value("arcsec")
        assert 0 < error < 0.02
        assert abs(row[axis].to_value("arcsec") - true) < 4 * error
    assert abs(row["contrast"] - 1e-5) < 4 * row["contrast_error"]
    assert row["separation"].to_value("arcsec") == pytest.approx(0.7, abs=0.02)
    assert row["position_angle"].to_value("deg") == pytest.approx(60.0, abs=2.0)
    # It is gone from the map without candidates.
    near = np.hypot(*np.moveaxis(one.grid - WHERE.offset, -1, 0)) < 0.15
    assert one.snr[near].max() > 8
    assert np.abs(one.residual_snr[near]).max() < 3.5


def test_a_candidate_has_the_signal_to_noise_of_the_map_where_it_is(world):
    """Near the mask, the uncertain position adds to the error of the contrast, but not here."""
    found = world.detected(5, Planet(6e-5, 0.3, 60.0))
    assert len(found.sources) == 1
    snr = found.candidates["snr"][0]
    assert snr == pytest.approx(found.measure(found.sources.offsets)["snr"][0], rel=1e-3)
    assert found.candidates["contrast"][0] / own_error(found) < 0.95 * snr


@pytest.mark.parametrize(("inner", "candidates"), [(0.695, 1), (0.72, 0)])
def test_the_place_of_a_source_counts_and_not_that_of_its_pixel(world, inner, candidates):
    """The source is measured at 0.705 arcsec. The centre of its pixel is at 0.685."""
    found = dr.detect(world.fitted(5, FAINT), inner=inner)
    peak = np.unravel_index(np.nanargmax(found.snr), found.snr.shape)
    assert radius(found)[peak] == pytest.approx(0.685, abs=1e-3)
    assert len(found.candidates) == candidates
    # Without the planet as a source the map keeps all of its light.
    assert found.snr[peak] > 8


def own_error(found):
    """The error of the first candidate's contrast without that of the calibration."""
    factor = found.error_factor.of(found.sources.offsets)
    return float(factor[0] * found.sources.errors[0, 0])


def test_the_error_of_a_contrast_knows_that_of_the_stars_flux(world):
    """A contrast is relative to the star's light; whether there is a source at all is not."""
    fit = world.fitted(5, FAINT)
    found = (dr.detect(fit, scatter=factor, relinearise=math.inf) for factor in (1.0, 2.0))
    row, scaled = (each.measure([WHERE.offset])[0] for each in found)
    relative = fit.frames[0].errors["flux"][0] / fit.frames[0].values["flux"][0]
    assert 1e-4 < relative < 0.05
    expected = row["contrast"] * math.hypot(relative, 1 / row["snr"])
    # At this S/N the flux's share is small, but far above rounding.
    assert row["contrast_error"] == pytest.approx(expected, rel=1e-8)
    assert expected > (1 + 1e-6) * row["contrast"] / row["snr"]
    # And what makes all errors larger makes this one larger.
    assert scaled["contrast_error"] == pytest.approx(2 * row["contrast_error"], rel=1e-8)


@pytest.mark.slow
def test_the_error_of_a_bright_contrast_knows_that_of_the_sources_image(large):
    """As far as wavefronts that are as probable as the one that was found change its light."""
    found = large.detected(7, replace(WHERE, contrast=8e-5))
    templates, fit = found.templates, found.fit
    linear = templates.linear
    row = found.candidates[0]
    stated = math.sqrt(row["contrast_error"] ** 2 - own_error(found) ** 2) / row["contrast"]
    deviation = linear.covariance.diagonal().sqrt()
    factor = torch.linalg.cholesky(linear.covariance / deviation[:, None] / deviation)
    generator = torch.Generator().manual_seed(2)
    offset, flux = found.sources.offsets[0], linear.unknowns.index(Unknown("flux", 0))
    image, grid = templates.image(0, offset), PupilGrid.full(large.model.npix)
    seen = image * linear.frames[0].weight ** 2
    changes = []
    for _ in range(250):
        drawn = factor @ torch.randn(len(factor), dtype=torch.float64, generator=generator)
        drawn *= deviation
        opd = large.basis.opd(1e-9 * drawn[-len(large.basis) :], grid)
        light = float((seen * templates.image(0, offset, opd)).sum() / (seen * image).sum())
        changes.append(light * (1 + float(drawn[flux] / fit.frames[0].values["flux"][0])))
    # 250 draws know their deviation to 4.5 %.
    assert stated == pytest.approx(float(np.std(changes)), rel=0.12)
    # The star's flux alone would not do.
    assert stated > 1.1 * fit.frames[0].errors["flux"][0] / fit.frames[0].values["flux"][0]


def test_a_search_ends_with_a_number_of_candidates_that_stand_for_something_extended(
    world, monkeypatch, caplog
):
    """Two of three planets, with S/N that would be worth another fit of the star."""
    fit = world.fitted(5, *(Planet(1e-5, 0.6, angle) for angle in (0.0, 120.0, 240.0)))
    monkeypatch.setattr("pyklip_diffrender.detection.search._MAX_CANDIDATES", 2)
    with caplog.at_level(logging.WARNING, "pyklip_diffrender"):
        found = dr.detect(fit, relinearise=5.0, scatter=1.0)
    assert len(found.sources) == 2
    assert found.fit is fit
    assert "2 candidates, the most that are looked for" in caplog.text


@pytest.mark.slow
def test_two_planets_closer_than_a_beam_are_fitted_together(large):
    pair = (Planet(1.5e-4, 0.80, 60.0), Planet(1e-4, 0.80, 51.0))
    found = large.detected(12, *pair)
    sources = found.sources
    assert len(sources) == 2
    order = np.argsort(-sources.contrasts.numpy())
    away = sources.offsets.numpy()[order] - [planet.offset for planet in pair]
    assert np.hypot(*away.T).max() < 0.02
    contrasts, true = sources.contrasts.numpy()[order], [planet.contrast for planet in pair]
    assert (abs(contrasts - true) < 4 * sources.errors.numpy()[order, 0]).all()
    assert contrasts == pytest.approx(true, rel=0.3)


@pytest.mark.slow
def test_a_bright_ring_keeps_its_light(large):
    """Of known shape, though no wavefront explains it; what is merely subtracted loses some."""
    ring = [Planet(1 / 40, 0.75, angle) for angle in np.arange(0, 360, 9.0)]
    light = sum(large.light(part) for part in ring)
    observation = large.observed(large.expected() + 1e-4 * light, 17)
    fit = large.refined(observation)
    assert fit.status is not Status.CONVERGED
    amplitude, error = dr.detect(fit, threshold=math.inf).measure_shape(1e-4 * light)
    assert abs(amplitude - 1) < max(0.02, 4 * error)
    assert error < 0.05
    weight = light / observation.error[0] ** 2
    assert (weight * fit.frames[0].residual[0]).sum() / (weight * 1e-4 * light).sum() < 0.95


@pytest.mark.slow
def test_a_fit_that_is_gone_holds_no_memory(large):
    """Its responses are its largest part; the collector would come for them much too late."""
    shot = large.observed(large.expected(replace(WHERE, contrast=1e-4)), 15)
    short = {"max_iterations": 6, "max_companions": 1}
    dr.detect(large.refined(shot, **short))  # torch keeps some of its first derivative.
    gc.collect()
    gc.disable()
    gc.set_debug(gc.DEBUG_SAVEALL)
    try:
        dr.detect(large.refined(shot, **short))
        gc.collect()
        left = [each for each in gc.garbage if isinstance(each, torch.Tensor)]
    finally:
        gc.set_debug(0)
        gc.garbage.clear()
        gc.enable()
    assert sum(tensor.untyped_storage().nbytes() for tensor in left) < 1e5


def test_rolled_frames_share_the_star_and_turn_the_planet(world):
    """The sky turns with the roll, the speckles stay: a shared wavefront is known better."""
    # The same sky, at position angles that count from north: it turns back in the frame.
    turned = replace(FAINT, position_angle=50.0)
    frames = [
        world.observed(world.expected(planet), seed, position_angles=np.array([angle]))
        for planet, seed, angle in ((FAINT, 5, 100.0), (turned, 31, 110.0))
    ]
    found = dr.detect(world.refined(frames))
    (joint,) = found.measure([FAINT.offset])
    # The frame of the first one is as it would be without an angle.
    apart = [
        dr.detect(fit).measure([planet.offset])[0]
        for fit, planet in ((world.fitted(5, FAINT), FAINT), (world.refined(frames[1]), turned))
    ]
    for row in (joint, *apart):
        assert abs(row["contrast"] - FAINT.contrast) < 4 * row["contrast_error"]
    assert joint["contrast_error"] < sum(row["contrast_error"] ** -2.0 for row in apart) ** -0.5
    (wrong,) = found.measure([replace(FAINT, position_angle=70.0).offset])
    assert wrong["snr"] < 0.6 * joint["snr"]


@pytest.mark.parametrize(("rolls", "left", "count"), [(2, 1, 1), (2, 9, 0), (1, 1, 0)])
def test_side_lobes_do_not_hide_their_source(world, monkeypatch, rolls, left, count):
    """They raise the scatter by which it is judged, and go with it."""
    frames = [world.observed(world.expected(FAINT.rotated(-a)), 5, position_angles=np.array([a]))
              for a in (0.0, 10.0)[:rolls]]  # fmt: skip
    fit = world.refined(frames)
    high = dr.detect(fit, scatter=1.0).measure([FAINT.offset])[0]["snr"] / 4.5
    monkeypatch.setattr(Significance, "factor", lambda self, snr, sources: ErrorFactor.constant(
        left if len(sources) else high))  # fmt: skip
    assert len(dr.detect(fit).candidates) == count


def test_a_reference_star_helps_and_shows_no_planet(world):
    target = world.observed(world.expected(FAINT), 5)
    reference = replace(world.observed(4 * world.expected(), 41), reference=True)
    fit = world.refined([target, reference])
    found = (world.detected(5, FAINT), dr.detect(fit))
    alone, both = (each.measure([FAINT.offset])[0] for each in found)
    assert abs(both["contrast"] - FAINT.contrast) < 4 * both["contrast_error"]
    assert both["contrast_error"] < 0.99 * alone["contrast_error"]
    with pytest.raises(IncompatibleSetupError, match="reference star"):
        dr.detect(replace(fit, frames=fit.frames[::-1]))


def test_dithered_frames_have_star_positions_of_their_own(world):
    offsets = ((0.0, 0.0), (0.015, -0.010))
    frames = [
        world.observed(world.expected(offset=offset), 50 + k) for k, offset in enumerate(offsets)
    ]
    fit = world.refined(frames)
    first, second = fit.frames
    for frame, offset in zip(fit.frames, offsets, strict=True):
        away = np.abs(frame.values["star_offset"] - offset)
        # The wavefront's own tilt, 0.16 mas here, is not to be told from the star's offset.
        assert (away < 4 * frame.errors["star_offset"] + 1.6e-4).all()
    apart = second.values["star_offset"] - first.values["star_offset"]
    np.testing.assert_allclose(apart, offsets[1], atol=5e-5)
    np.testing.assert_array_equal(first.opd, second.opd)
    np.testing.assert_array_equal(first.values["lyot_shift"], second.values["lyot_shift"])


def test_snapshots_may_drift_apart_by_what_the_prior_allows(world):
    later = world.later + drift(world.basis, world.model.npix, 1.0, 0.0, 8)
    moved = replace(world, later=later)
    frames = [world.observed(world.expected(), 60), moved.observed(moved.expected(), 61)]
    linked = world.refined(
        frames, drift=WavefrontPrior(scales={"segment": 0.5, "texture": 0.02}), drift_cycles=2.0
    )
    assert linked.chi2_per_pixel < 0.8 * world.refined(frames).chi2_per_pixel
    assert linked.chi2_per_pixel < 1.2
    assert linked.scales["segment drift"] == pytest.approx(0.7, abs=0.35)
    assert np.std(linked.frames[1].opd - linked.frames[0].opd) > 0.2e-9


def test_the_contrast_curve_is_five_times_the_error_of_the_map(world):
    table = world.detected(0).contrast_curve
    assert (np.diff(table["separation"].to_value("arcsec")) > 0).all()
    assert (table["contrast"] > table["known_star"]).all()
    assert (table["lowest"] <= table["contrast"]).all()
    assert (table["highest"] >= table["contrast"]).all()
    # What is partly outside the field has rows for the part inside.
    partly = dr.detect(world.fitted(0), separations=[500.0, 5000.0] * u.mas).contrast_curve
    assert partly["separation"].to_value("arcsec").tolist() == [0.5]
    k = int(np.argmin(np.abs(table["separation"] - partly["separation"][0])))
    assert partly["contrast"][0] == pytest.approx(table["contrast"][k], rel=1e-6)


def oriented(found):
    """The same detection, as if it had been made in a frame of known date and orientation."""
    (frame,) = found.fit.frames
    known = {"position_angles": np.array([33.0]), "date": Time("2023-01-02T03:04:05.678")}
    header = astropy_fits.Header({"TARGPROP": "HD 1", "CRVAL1": 311.3, "CRVAL2": -31.3})
    observation = replace(frame.observation, filter="F444W", header=header, **known)
    fit = replace(found.fit, frames=(replace(frame, observation=observation),))
    return replace(found, stored_fit=fit)


def test_all_images_are_on_the_sky_where_the_maps_are(one, tmp_path):
    found = oriented(one)
    # Which `tests/test_sky.py` compares with the table.
    expected = WCS(world_coordinates(found.grid, found.observation)).pixel_to_world(7, 3)
    maps, fit = found.write(tmp_path)[0], found.fit.write(tmp_path / "fit.fits", linear=False)
    images = {
        maps: ("SNR", "SUBTRACTED", "DATA"),
        fit: ("DATA", "ERROR", "VALID", "STAR", "COMPANIONS", "GAIN"),
    }
    for path, names in images.items():
        with astropy_fits.open(path) as hdus:
            assert hdus[0].header["OBJECT"] == "HD 1"
            assert hdus[0].header["DRSTAT"] == "CONVERGED"
            for name in names:
                place = WCS(hdus[name].header).pixel_to_world(7, 3)
                assert place.separation(expected).arcsec < 1e-5
    with astropy_fits.open(fit) as hdus:
        units = {Unit(hdus[name].header["BUNIT"]) for name in ("DATA", "ERROR", "STAR")}
        assert units == {Unit("photon")}
        assert "CTYPE1" not in hdus["OPD"].header
    # Without a position on the sky the coordinates are arcsec from the star.
    wcs = WCS(world_coordinates(one.grid, one.observation))
    np.testing.assert_allclose(wcs.pixel_to_world_values(7, 3), one.grid[3, 7], atol=1e-9)


def test_a_detection_survives_the_file(one, tmp_path):
    first = oriented(one)
    paths = first.write(tmp_path / "first")
    names = ["detection.fits", "candidates.ecsv", "contrast.ecsv"]
    assert [path.name for path in paths] == [*names, "astrometry.csv"]
    with astropy_fits.open(paths[0], checksum=True) as hdus:
        np.testing.assert_allclose(hdus["SNR"].data, one.snr, rtol=1e-6)
        assert hdus["OFFSET_X"].header["BUNIT"] == "arcsec"
        np.testing.assert_allclose(hdus["SUBTRACTED", 1].data, one.subtracted[0], rtol=1e-6)
        assert Unit(hdus["SUBTRACTED"].header["BUNIT"]) == Unit("photon")
        assert hdus[0].header["DRVERS"] == dr.__version__
        # astropy warns of checksums that do not hold, and warnings are errors.
        assert all(hdu.verify_checksum() == hdu.verify_datasum() == 1 for hdu in hdus)
    table = QTable.read(paths[1], format="ascii.ecsv")
    assert table["separation"].unit == "arcsec"
    assert table.meta["scatter"] == one.scatter
    again = Detection.read(paths[0].parent)
    for name in ("snr", "residual_snr", "contrast", "error", "photon_error", "grid", "subtracted"):
        np.testing.assert_array_equal(getattr(again, name), getattr(first, name))
    assert [repr(again), str(again), again.scatter] == [repr(first), str(first), first.scatter]
    for name in ("candidates", "contrast_curve"):
        ours, theirs = getattr(again, name), getattr(first, name)
        assert ours.meta == theirs.meta
        assert ours.colnames == theirs.colnames
        for column in ours.colnames:
            np.testing.assert_array_equal(ours[column], theirs[column])
            assert ours[column].unit == theirs[column].unit
    assert again.north == 33.0
    assert again.observation.date == first.observation.date
    assert again.observation.target == "HD 1"
    left, right = again.plot(Figure().subplots(1, 2))
    assert left.get_title(loc="left").startswith("1 candidate above")
    assert len(right.lines) == len(first.plot(Figure().subplots(1, 2))[1].lines)
    # A copy of a copy is the same file.
    again.write(tmp_path / "again")
    for name in names:
        copies = [(tmp_path / folder / name).read_bytes() for folder in ("first", "again")]
        assert copies[0] == copies[1]


def test_a_detection_from_a_file_measures_with_its_fit(world, one, tmp_path):
    folder = one.write(tmp_path)[0].parent
    places = [[0.3, 0.6], *one.sources.offsets.tolist()]
    expected = one.measure(places)
    with pytest.raises(IncompatibleSetupError, match=r"no fit\.fits.*read\(path, fit=fit\)"):
        Detection.read(folder).measure(places)
    with pytest.raises(IncompatibleSetupError, match="not the one that was searched"):
        Detection.read(folder, fit=world.fitted(0))
    one.fit.write(folder / "fit.fits", linear=False)
    with pytest.raises(IncompatibleSetupError, match="with the option derivatives"):
        Detection.read(folder).measure(places)
    one.fit.write(folder / "fit.fits", overwrite=True)
    for again in (Detection.read(folder), Detection.read(folder, fit=one.fit)):
        table = again.measure(places)
        for name in table.colnames:
            np.testing.assert_array_equal(table[name], expected[name])


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("FACTS", "no FACTS"), ("PHOTON_ERROR", "PHOTON_ERROR"), ("SNR", "shapes"),
        ("no file", "such"), ("a fit", "not a complete Detection"),
    ],
)  # fmt: skip
def test_a_file_without_a_part_is_no_detection(one, name, message, tmp_path):
    path = one.write(tmp_path)[0]
    if name == "no file":
        path.unlink()
    elif name == "a fit":
        path = one.fit.write(tmp_path / "fit.fits", linear=False)
    else:
        with astropy_fits.open(path) as hdus:
            if name == "SNR":
                hdus[name].data = hdus[name].data[1:]
            else:
                del hdus[name]
            hdus.writeto(path, overwrite=True, checksum=True)
    with pytest.raises(CorruptFileError, match=message):
        Detection.read(path)


def kept(image, star, light, error):
    """Share of a planet's light that is in a subtracted frame, and not its noise's or star's."""
    good = np.isfinite(image)
    weight = (light / error**2)[good]
    return float((weight * (image - star)[good]).sum() / (weight * light[good]).sum())


def test_a_frame_keeps_the_light_of_candidates(world):
    light = world.expected(FAINT) - world.expected()
    found = world.detected(5, FAINT)
    fit = found.fit
    # What is left of the star and its noise, were it known.
    noise = fit.frames[0].observation.data[0] - world.expected() - light
    error = fit.frames[0].observation.error[0]
    assert kept(fit.frames[0].residual[0], noise, light, error) < 0.9
    (image,) = found.subtracted
    assert kept(image, noise, light, error) == pytest.approx(1.0, abs=0.06)
    # A fit that has the planet from the start leaves the same.
    renewed = with_companions(fit, found.sources)
    away = radius(found) > 0.25
    difference, closed = (
        ((each - renewed.frames[0].residual[0]) / error)[away].std()
        for each in (image, fit.frames[0].residual[0])
    )
    assert difference < min(0.05, 0.2 * closed)


def test_a_bright_companions_frame_is_what_its_own_fit_leaves(world):
    """The star is found in single precision once more; of 1e-3 that must not show."""
    found = world.detected(7, replace(WHERE, contrast=1e-3))
    assert len(found.fit.companions) == len(found.sources) == 1
    (frame,) = found.fit.frames
    difference = (found.subtracted[0] - frame.residual[0]) / frame.observation.error[0]
    assert difference[radius(found) > 0.25].std() < 0.05


@pytest.mark.slow
def test_every_frame_is_subtracted_as_it_was_taken(large):
    """A roll, a masked pixel and a reference star, refined together."""
    planets = [Planet(2e-5, 0.7, 60.0 - turned) for turned in (0.0, 90.0)]
    frames = [
        large.observed(large.expected(planet), 70 + k, position_angles=np.array([90.0 * k]))
        for k, planet in enumerate(planets)
    ]
    frames[1].valid[0, 3, 4] = False
    frames.append(replace(large.observed(4 * large.expected(), 72), reference=True))
    found = dr.detect(large.refined(frames))
    assert len(found.sources) == 1
    assert len(found.subtracted) == 3
    for frame, planet, image in zip(frames, planets, found.subtracted, strict=False):
        light = large.expected(planet) - large.expected()
        noise = frame.data[0] - large.expected() - light
        assert kept(image, noise, light, frame.error[0]) == pytest.approx(1.0, abs=0.06)
    assert np.argwhere(np.isnan(found.subtracted[1])).tolist() == [[3, 4]]
    assert np.abs(found.subtracted[2] / frames[2].error[0]).std() < 1.1


def test_positions_may_have_a_unit_and_are_in_the_field(one):
    plain = one.measure([[-0.485, 0.353]])
    for offsets in ([[-485, 353]] * u.mas, [[-0.485, 0.353]] * u.arcsec):
        table = one.measure(offsets)
        for name in plain.colnames:
            np.testing.assert_allclose(table[name], plain[name], rtol=1e-12)
    # Such as one that somebody else calls arcsec, and means degrees or pixels.
    corner = one.grid[0, 0]
    assert np.isfinite(one.measure([corner])["contrast"][0])
    for far in (1.1 * corner, [[0.7, 0.35]] * u.deg, [-30.0, 5.0]):
        with pytest.raises(IncompatibleSetupError, match=r"offsets: got .*the star; .*u\.mas"):
            one.measure(far)


def test_positions_may_be_separation_and_position_angle(world, one):
    planet, angle = FAINT.rotated(-140.0), np.array([140.0])
    fit = world.refined(world.observed(world.expected(planet), 5, position_angles=angle))
    found = dr.detect(fit)
    expected = found.measure([planet.offset])[0]
    table = found.measure(separation=FAINT.separation, position_angle=FAINT.position_angle)
    for name in ("x", "y", "contrast", "snr", "separation", "position_angle"):
        np.testing.assert_allclose(
            u.Quantity(table[name])[0], u.Quantity(expected[name]), rtol=1e-9
        )
    assert table["position_angle"][0].value == pytest.approx(FAINT.position_angle)
    several = found.measure(
        separation=[600, 900] * u.mas, position_angle=np.deg2rad(FAINT.position_angle) * u.rad
    )
    np.testing.assert_allclose(several["separation"].value, [0.6, 0.9])
    np.testing.assert_allclose(several["position_angle"].value, FAINT.position_angle)
    # Counted from +y of a frame whose orientation is not known.
    (row,) = one.measure(separation=0.6, position_angle=90.0)
    np.testing.assert_allclose([row["x"].value, row["y"].value], [-0.6, 0.0], atol=1e-12)


@pytest.mark.parametrize(
    ("positions", "words"),
    [
        ({}, "got no position, expected either offsets"),
        ({"separation": 0.5}, "got separation, expected either"),
        ({"position_angle": 20.0}, "got position_angle, expected either"),
        ({"offsets": [[0.1, 0.2]], "separation": 0.5, "position_angle": 2.0},
         "got offsets and separation and position_angle, expected either"),
        ({"separation": -0.5, "position_angle": 2.0}, "separation: got -0.5 arcsec.*180 deg"),
        ({"separation": [0.5, 0.6, 0.7], "position_angle": [1, 2]}, r"shapes \(3,\) and \(2,\)"),
        ({"separation": 0.5 * u.m, "position_angle": 2.0}, "separation: got the unit"),
        ({"separation": 0.5, "position_angle": 2.0 * u.s}, "position_angle: got the unit"),
        ({"separation": 0.5, "position_angle": math.nan}, "position_angle: 1 values are NaN"),
        ({"separation": 500, "position_angle": 2.0}, "500 arcsec from the star"),
    ],
)  # fmt: skip
def test_positions_that_are_mixed_or_impossible_are_refused(one, positions, words):
    with pytest.raises(DiffrenderError, match=words):
        one.measure(**positions)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda fit: dr.detect([]), "got a list of 0, expected one Refinement"),
        (lambda fit: dr.detect([fit, fit]), r"list of 2.*refine\(model, \[.*combine\("),
        (lambda fit: dr.detect("fit.fits"), "got a str, expected one Refinement"),
        (lambda fit: dr.detect(replace(fit, stored_linear=None)), "linear=False.*Fit the fra"),
        (lambda fit: dr.detect(fit).measure([0.1, 0.2, 0.3]), r"\(k, 2\)"),
        (lambda fit: dr.detect(fit).measure([[np.nan, 0.2]]), "offsets"),
        (lambda fit: dr.detect(fit).measure([[1.0, 2.0]] * u.m), "offsets"),
        (lambda fit: dr.detect(fit, inner=1 * u.m), "inner"),
        (lambda fit: dr.detect(fit, inner=-1.0), "inner: got.*positive"),
        (lambda fit: dr.detect(fit, threshold=0.0), "threshold: got.*positive"),
        (lambda fit: dr.detect(fit, scatter=math.nan), "scatter: got.*positive"),
        (lambda fit: dr.detect(fit, separations=[0.5, -1.0]), "separations: got.*positive"),
        (lambda fit: dr.detect(fit, separations=[math.nan]), "separations: got.*positive"),
    ],
)
def test_what_cannot_be_searched_or_measured_is_refused(one, call, words):
    with pytest.raises(DiffrenderError, match=words):
        call(one.fit)


@pytest.mark.slow
def test_all_errors_have_the_factor_of_their_position(world):
    """A fit that does not explain its data is searched with the scatter of its S/N."""
    fit = world.detected(0).fit
    # Residuals, and unknowns as far from their priors, three times what they should be.
    frames = tuple(replace(each, residual=3 * each.residual) for each in fit.linear.frames)
    mean = fit.linear.vector - 3 * (fit.linear.vector - fit.linear.mean)
    linear = replace(fit.linear, frames=frames, mean=mean)
    mismatch = replace(fit, stored_linear=linear, status=Status.MODEL_MISMATCH)
    plain, found = dr.detect(mismatch, scatter=1.0, threshold=math.inf), dr.detect(mismatch)
    factor = found.error_factor
    assert factor.is_measured
    # The scatter of 40 positions or so is known to 11 %.
    assert factor.typical == pytest.approx(3.0, rel=0.35)
    np.testing.assert_allclose(found.error, factor.factors * plain.error)
    assert np.isnan(found.false_alarm).all()
    assert found.rings["chi2"][0] == pytest.approx(9.0, rel=0.3)
    curve, limits = found.contrast_curve, plain.contrast_curve
    np.testing.assert_allclose(curve["error_factor"], factor.at(curve["separation"].value))
    # Noise in units of measured errors follows Student's t.
    assert (curve["small_sample"] > 1.05 * curve["contrast"]).all()
    np.testing.assert_allclose(limits["small_sample"], limits["contrast"])
    # Errors at a few positions are multiplied likewise.
    offsets = np.array([[0.3, 0.1], [0.0, -0.8]])
    known = plain.measure(offsets)
    table = found.measure(offsets)
    ratio = table["contrast"] / table["snr"] * known["snr"] / known["contrast"]
    np.testing.assert_allclose(ratio, factor.of(offsets), rtol=1e-6)
