"""Detection on a small system: calibrated, unbiased, and honest where the model is wrong."""

from __future__ import annotations

import gc
import logging
import math
from dataclasses import dataclass, field, replace
from functools import cache

import numpy as np
import pytest
import torch
from astropy import units as u
from astropy.coordinates import SkyCoord
from astropy.io import fits as astropy_fits
from astropy.table import QTable
from astropy.time import Time
from astropy.units import Unit
from astropy.wcs import WCS
from matplotlib.figure import Figure
from numpy.typing import NDArray

import pyklip_diffrender as dr
from pyklip_diffrender.detection import Detection
from pyklip_diffrender.detection.candidates import with_companions
from pyklip_diffrender.errors import (
    CorruptFileError,
    DiffrenderError,
    IncompatibleSetupError,
)
from pyklip_diffrender.linear.model import Unknown
from pyklip_diffrender.optics.grid import PupilGrid
from pyklip_diffrender.optics.system import OpticalSystem
from pyklip_diffrender.refinement import GaussNewton, Refinement, Status, refine
from pyklip_diffrender.scene.objects import Planet
from pyklip_diffrender.scene.observation import Observation
from pyklip_diffrender.scene.product_headers import world_coordinates
from pyklip_diffrender.wavefront.bases import FourierModes, JointBasis, SegmentMotions
from pyklip_diffrender.wavefront.opd import random_opd
from pyklip_diffrender.wavefront.priors import WavefrontPrior

FLUX = 3e11
READ_NOISE = 42.0
WHERE = Planet(0.0, 0.7, 60.0)
FAINT = replace(WHERE, contrast=2e-6)
"""Below the S/N at which the star is refined again."""


Image = NDArray[np.float64]


@dataclass
class World:
    """A model, an old wavefront and a later one; fits and detections are made once."""

    model: OpticalSystem
    opd: Image
    later: Image
    basis: JointBasis
    _made: dict[object, Refinement | Detection] = field(default_factory=dict, init=False)

    def expected(self, *planets, offset=(0.0, 0.0)):
        """Expected photons of star and planets."""
        total = FLUX * self.model(self.later, offset).numpy()
        for planet in planets:
            place = tuple(np.add(offset, planet.offset))
            total = total + planet.contrast * FLUX * self.model(self.later, place).numpy()
        return total

    def observed(self, expected, seed, **details):
        rng = np.random.default_rng(seed)
        counts = rng.poisson(expected) + rng.normal(0, READ_NOISE, expected.shape)
        error = np.sqrt(np.maximum(counts, 0) + READ_NOISE**2)
        scale = self.model.detector.pixelscale
        return Observation.from_arrays(counts, error, pixelscale=scale, **details)

    def fitted(self, seed, *planets, **changes):
        key = ("fit", seed, planets, tuple(sorted(changes.items())))
        if key not in self._made:
            observation = self.observed(self.expected(*planets), seed)
            self._made[key] = self.refined(observation, **changes)
        return self._made[key]

    def detected(self, seed, *planets, **changes):
        key = ("detection", seed, planets, tuple(sorted(changes.items())))
        if key not in self._made:
            self._made[key] = dr.detect(self.fitted(seed, *planets, **changes))
        return self._made[key]

    def refined(self, observation, **changes):
        settings = GaussNewton(**{"basis": self.basis, "response_npix": self.model.npix, **changes})
        return refine(self.model, observation, self.opd, settings=settings)


def drifted(npix, size, cycles):
    model = dr.nircam_coronagraph("F444W", monochromatic=4.5e-6, npix=npix, fov_pixels=size)
    basis = JointBasis([SegmentMotions(), FourierModes(cycles)])
    opd = random_opd(3, npix=npix).data
    generator = torch.Generator().manual_seed(1)
    deviation = 1e-9 * torch.where(basis.frequencies == 0, 2.0, 0.15)
    change = deviation * torch.randn(len(basis), dtype=torch.float64, generator=generator)
    return World(model, opd, opd + basis.opd(change, PupilGrid.full(npix)).numpy(), basis)


@pytest.fixture(scope="module")
def world():
    """Small enough for a fit in half a second."""
    return drifted(64, 32, 4.0)


@pytest.fixture(scope="module")
def large():
    """With as many modes as bright companions need, which a wavefront must not imitate."""
    return drifted(128, 40, 8.0)


@pytest.fixture(scope="module")
def empty(world):
    """Three frames without a planet."""
    return [world.detected(seed) for seed in range(3)]


@pytest.fixture(scope="module")
def one(world):
    """A planet of S/N 44 or so."""
    return world.detected(11, replace(WHERE, contrast=1e-5))


def radius(found):
    return np.asarray(np.hypot(found.grid[..., 0], found.grid[..., 1]))


@pytest.mark.parametrize(
    ("size", "count"), [("world", 3), pytest.param("large", 6, marks=pytest.mark.study)]
)
def test_snr_scatters_by_one_where_there_is_nothing(request, size, count):
    empty = [request.getfixturevalue(size).detected(seed) for seed in range(count)]
    inside = radius(empty[0]) > 0.25
    values = np.concatenate([found.snr[inside] for found in empty])
    # Some 40 independent positions a frame: the deviation of three is known to 7 %.
    assert values.std() == pytest.approx(1.0, abs=0.12)
    assert abs(values.mean()) < 0.15
    # chi2 of a thousand pixels is known to 4.5 %.
    assert all(1.0 <= found.scatter < 1.06 for found in empty)
    assert all(len(found.sources) == 0 for found in empty)


def test_the_freedom_of_the_wavefront_costs_something_everywhere(empty):
    ratio = empty[0].error / empty[0].photon_error
    seen = radius(empty[0]) > 0.25
    assert ratio[seen].min() > 1.0
    assert 1.02 < np.median(ratio[seen]) < 2.0


FEW = JointBasis([SegmentMotions(), FourierModes(4)])


@cache
def small():
    """A system whose fits take less than a second, and an old wavefront."""
    model = dr.nircam_coronagraph("F444W", monochromatic=4.5e-6, npix=64, fov_pixels=32)
    return model, random_opd(3, npix=64).data


@cache
def pulls(seed):
    """Errors of a planet's contrast, x and y over those stated; new wavefront, place and noise.

    None for the position of a planet that is not above the threshold.
    """
    model, opd = small()
    generator = torch.Generator().manual_seed(seed)
    size = torch.where(FEW.frequencies == 0, 1.0, 0.15)
    change = torch.randn(len(FEW), dtype=torch.float64, generator=generator) * size * 1e-9
    later = opd + FEW.opd(change, PupilGrid.full(64)).numpy()
    flux, planet = 3e10, Planet(1.2e-5, 0.5 + 0.1 * (seed % 4), 47.0 * seed)
    world = World(model, opd, later, JointBasis([FEW]))
    frame = world.observed(flux / FLUX * world.expected(planet), seed)
    fit = refine(model, frame, opd, settings=GaussNewton(basis=FEW, response_npix=64))
    found = dr.detect(fit)
    row = found.measure([planet.offset])[0]
    contrast = float((row["contrast"] - planet.contrast) / row["contrast_error"])
    if len(found.candidates) != 1:
        return contrast, None, None
    there = found.candidates[0]
    x, y = (
        float((there[axis].value - true) / there[f"{axis}_error"].value)
        for axis, true in zip("xy", planet.offset, strict=True)
    )
    return contrast, x, y


@pytest.mark.slow
def test_contrast_and_place_of_planets_are_unbiased_and_their_errors_right():
    """Errors that are wrong by a factor of 1.4 do not pass.

    The deviation of 32 pulls is known to 13 %, of 64 to 9 %.
    """
    count, within = 32, 1.4**0.5
    contrast, x, y = zip(*(pulls(seed) for seed in range(count)), strict=True)
    places = np.array([pull for pull in (*x, *y) if pull is not None])
    assert len(places) > 1.7 * count
    for drawn in (np.array(contrast), places):
        assert abs(drawn.mean()) < 3 / len(drawn) ** 0.5
        assert 1 / within < drawn.std() < within


@pytest.mark.parametrize(
    ("size", "contrast"),
    [
        ("world", 1e-3),
        pytest.param("large", 2e-5, marks=pytest.mark.slow),
        pytest.param("large", 1e-3, marks=pytest.mark.slow),
    ],
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


@pytest.mark.slow
def test_what_a_fit_took_for_a_companion_need_not_be_one(world):
    observation = world.observed(world.expected(), 4)
    fit = world.refined(observation, companions=(replace(WHERE, contrast=1e-6),))
    assert len(fit.companions) == 1
    assert len(dr.detect(fit).candidates) == 0


def test_a_prior_that_is_held_too_narrow_is_widened(world):
    observation = world.observed(world.expected(), 4)
    likely = world.fitted(4)
    assert not likely.prior_ratios
    narrow = {name: scale / 3 for name, scale in likely.scales.items()}
    held = WavefrontPrior(narrow, fit_scales=False)
    fit = world.refined(observation, prior=held, widen_prior=True)
    assert fit.status is Status.CONVERGED
    # Too few modes of the texture are determined.
    assert fit.scales["segment"] == pytest.approx(likely.scales["segment"], rel=0.15)
    assert fit.scales["texture"] == pytest.approx(narrow["texture"])
    assert fit.settings.prior.scales == pytest.approx(fit.scales)
    # The steps after it are in the history.
    unwidened = world.refined(observation, prior=held)
    assert unwidened.status is Status.PRIOR_MISMATCH
    assert not unwidened.status.calibrated
    assert [record["iteration"] for record in fit.history] == list(range(len(fit.history)))
    assert len(fit.history) > len(unwidened.history)
    # A prior that holds is left alone.
    right = WavefrontPrior(likely.scales, fit_scales=False)
    kept = world.refined(observation, prior=right, widen_prior=True)
    assert kept.status is Status.CONVERGED
    assert kept.scales == pytest.approx(likely.scales)


def test_the_prior_of_the_amplitude_is_widened_as_well(world):
    absorbing = 6e-9 * torch.randn(
        len(world.basis), dtype=torch.float64, generator=torch.Generator().manual_seed(2)
    )
    absorbing *= world.basis.frequencies > 0
    grid = PupilGrid.full(world.model.npix)
    later = torch.from_numpy(world.later) + 1j * world.basis.opd(absorbing, grid)
    observation = world.observed(FLUX * world.model(later).numpy(), 4)
    narrow = WavefrontPrior(
        {"segment": 0.7, "texture": 0.1}, fit_scales=False,
        amplitude_cycles=4.0, amplitude_scale=2.0, amplitude_slope=0.0,
    )  # fmt: skip
    before = world.refined(observation, prior=narrow)
    fit = world.refined(observation, prior=narrow, widen_prior=True)
    assert before.status is Status.PRIOR_MISMATCH
    assert before.prior_ratios["amplitude"] > 3
    assert fit.status is Status.CONVERGED
    assert fit.prior_ratios["amplitude"] == pytest.approx(1.0, abs=0.15)
    widened = fit.settings.prior.amplitude_scale / narrow.amplitude_scale
    assert widened == pytest.approx(before.prior_ratios["amplitude"], rel=0.15)


def test_a_planet_does_not_make_the_noise_larger(world):
    planet = FAINT
    quiet, fit = world.fitted(5), world.fitted(5, planet)
    noise, found = world.detected(5), world.detected(5, planet)
    assert len(found.sources) == 1
    assert len(fit.companions) == 0
    # Its light would be structure that no mode explains.
    assert fit.reduced_chi2 > 1.06 * quiet.reduced_chi2
    assert found.scatter == pytest.approx(noise.scatter, rel=0.01)
    # The same where positions are given, once or more often.
    once, thrice = (dr.measure(fit, [planet.offset] * count) for count in (1, 3))
    assert found.measure([planet.offset])["snr"] == pytest.approx(once["snr"], rel=0.01)
    assert thrice["snr"].tolist() == pytest.approx([once["snr"][0]] * 3, rel=1e-4)


def test_weights_for_outliers_do_not_hide_structure(world):
    fit = world.refined(world.observed(world.expected(), 5), robust=3.0)
    assert fit.reduced_chi2 > 1.02
    assert dr.detect(fit).scatter == pytest.approx(math.sqrt(fit.reduced_chi2), rel=1e-6)


@pytest.mark.slow
def test_a_model_that_is_wrong_inflates_the_errors(world):
    """A wavefront that moved more than the prior allows at frequencies that are not fitted."""
    rough = FourierModes(12.0, 7.0)
    generator = torch.Generator().manual_seed(5)
    change = torch.randn(len(rough), dtype=torch.float64, generator=generator) * 2e-9
    moved = world.later + rough.opd(change, PupilGrid.full(world.model.npix)).numpy()
    other = replace(world, later=moved)
    fit = other.fitted(3)
    assert fit.status is Status.MODEL_MISMATCH
    found = dr.detect(fit, threshold=math.inf)
    assert found.scatter >= 1.0
    assert found.snr[radius(found) > 0.25].std() < 1.3


def test_a_planet_is_found_where_it_is(one):
    assert len(one.sources) == 1
    row = one.candidates[0]
    for axis, true in zip("xy", WHERE.offset, strict=True):
        error = row[f"{axis}_error"].to_value("arcsec")
        assert 0 < error < 0.02
        assert abs(row[axis].to_value("arcsec") - true) < 4 * error
    assert abs(row["contrast"] - 1e-5) < 4 * row["contrast_error"]
    assert row["separation"].to_value("arcsec") == pytest.approx(0.7, abs=0.02)
    assert row["position_angle"].to_value("deg") == pytest.approx(60.0, abs=2.0)
    assert row["snr"] > 8


def test_a_candidate_has_the_signal_to_noise_of_the_map_where_it_is(world):
    """Near the mask, the uncertain position adds to the error of the contrast, but not here."""
    near = dr.Planet(6e-5, 0.3, 60.0)
    found = world.detected(5, near)
    assert len(found.sources) == 1
    snr = found.candidates["snr"][0]
    assert snr == pytest.approx(found.measure(found.sources.offsets)["snr"][0], rel=1e-3)
    assert found.candidates["contrast"][0] / own_error(found) < 0.95 * snr


def test_no_candidate_is_nearer_than_the_smallest_separation(world):
    """The same S/N, by which the planet was found, counts for nothing inside it."""
    found = world.detected(5, FAINT)
    assert len(found.sources) == 1
    assert len(found.fits[0].companions) == 0
    beyond = dr.detect(found.fits, inner=0.8)
    # Without the planet as a source the map keeps all of its light.
    assert np.nanmax(beyond.snr[radius(beyond) < 0.8]) > 8
    assert len(beyond.candidates) == 0


@pytest.mark.parametrize(("inner", "candidates"), [(0.695, 1), (0.72, 0)])
def test_the_place_of_a_source_counts_and_not_that_of_its_pixel(world, inner, candidates):
    """The source is measured at 0.705 arcsec. The centre of its pixel is at 0.685."""
    found = dr.detect(world.fitted(5, FAINT), inner=inner)
    peak = np.unravel_index(np.nanargmax(found.snr), found.snr.shape)
    assert radius(found)[peak] == pytest.approx(0.685, abs=1e-3)
    assert len(found.candidates) == candidates


def test_the_planet_is_gone_from_the_map_without_candidates(one):
    near = np.hypot(one.grid[..., 0] - WHERE.offset[0], one.grid[..., 1] - WHERE.offset[1]) < 0.15
    assert one.snr[near].max() > 8
    assert np.abs(one.residual_snr[near]).max() < 3.5


def test_the_error_of_a_contrast_knows_that_of_the_stars_flux(world):
    """A contrast is relative to the star's light; whether there is a source at all is not."""
    fit = world.fitted(5, FAINT)
    row, scaled = (dr.measure(fit, [WHERE.offset], scatter=factor)[0] for factor in (1.0, 2.0))
    relative = fit.frames[0].errors["flux"][0] / fit.frames[0].values["flux"][0]
    assert 1e-4 < relative < 0.05
    expected = row["contrast"] * math.hypot(relative, 1 / row["snr"])
    # At this S/N the flux's share is small, but far above rounding.
    assert row["contrast_error"] == pytest.approx(expected, rel=1e-8)
    assert expected > (1 + 1e-6) * row["contrast"] / row["snr"]
    # And what makes all errors larger makes this one larger.
    assert scaled["contrast_error"] == pytest.approx(2 * row["contrast_error"], rel=1e-8)


def own_error(found):
    """The error of the first candidate's contrast without that of the calibration."""
    factor = found.error_factor.of(found.sources.offsets)
    return float(factor[0] * found.sources.errors[0, 0])


@pytest.mark.slow
def test_the_error_of_a_bright_contrast_knows_that_of_the_sources_image(large):
    """As far as wavefronts that are as probable as the one that was found change its light."""
    found = large.detected(7, replace(WHERE, contrast=8e-5))
    (linear, templates), fit = found.groups[0], found.fits[0]
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
    planets = [Planet(1e-5, 0.6, angle) for angle in (0.0, 120.0, 240.0)]
    fit = world.fitted(5, *planets)
    monkeypatch.setattr("pyklip_diffrender.detection.search._MAX_CANDIDATES", 2)
    with caplog.at_level(logging.WARNING, "pyklip_diffrender"):
        found = dr.detect(fit, relinearise=5.0, scatter=1.0)
    assert len(found.sources) == 2
    assert found.fits[0] is fit
    assert "2 candidates, the most that are looked for" in caplog.text


@pytest.mark.slow
def test_two_planets_closer_than_a_beam_are_fitted_together(large):
    pair = (Planet(1.5e-4, 0.80, 60.0), Planet(1e-4, 0.80, 51.0))
    found = dr.detect(large.fitted(12, *pair))
    assert len(found.sources) == 2
    for planet in pair:
        away = np.hypot(*(found.sources.offsets.numpy() - planet.offset).T)
        nearest = int(np.argmin(away))
        assert away[nearest] < 0.02
        contrast = float(found.sources.contrasts[nearest])
        assert abs(contrast - planet.contrast) < 4 * float(found.sources.errors[nearest, 0])
        assert contrast == pytest.approx(planet.contrast, rel=0.3)


@pytest.mark.slow
def test_a_bright_ring_keeps_its_light(large):
    """Of known shape, though no wavefront explains it; what is merely subtracted loses some."""
    angles = np.arange(0, 360, 9.0)
    places = [Planet(1.0, 0.75, angle).offset for angle in angles]
    light = sum(large.model(large.later, place).numpy() for place in places) * FLUX / len(places)
    observation = large.observed(large.expected() + 1e-4 * light, 17)
    fit = large.refined(observation)
    assert fit.status is not Status.CONVERGED
    amplitude, error = dr.detect(fit, threshold=math.inf).measure_shape(1e-4 * light)
    assert abs(amplitude - 1) < max(0.02, 4 * error)
    assert error < 0.05
    weight = light / observation.error[0] ** 2
    assert (weight * fit.frames[0].residual[0]).sum() / (weight * 1e-4 * light).sum() < 0.95


@pytest.mark.slow
def test_a_planet_on_the_edge_of_the_field_is_measured(large):
    planet = Planet(1e-4, 1.2, 90.0)
    table = dr.measure(large.fitted(14, planet), [planet.offset])
    assert abs(float(table["contrast"][0]) - 1e-4) < 4 * float(table["contrast_error"][0])


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


@pytest.mark.slow
def test_independent_looks_add_their_information(world):
    fits = [world.fitted(seed, FAINT) for seed in (5, 20, 21)]
    single = [float(dr.measure(fit, [WHERE.offset])["contrast_error"][0]) for fit in fits]
    (joint,) = dr.measure(fits, [WHERE.offset])
    # Of the errors' excess over the noise, which is taken from all together, 4 % are known.
    expected = np.sum(np.array(single) ** -2.0) ** -0.5
    assert joint["contrast_error"] == pytest.approx(expected, rel=0.04)
    assert abs(joint["contrast"] - FAINT.contrast) < 4 * joint["contrast_error"]


def test_rolled_frames_share_the_star_and_turn_the_planet(world):
    """The sky turns with the roll, the speckles stay: a shared wavefront is known better."""
    # The same sky, at position angles that count from north: it turns back in the frame.
    turned = replace(FAINT, position_angle=50.0)
    frames = [
        world.observed(world.expected(planet), seed, position_angles=np.array([angle]))
        for planet, seed, angle in ((FAINT, 5, 100.0), (turned, 31, 110.0))
    ]
    together = world.refined(frames)
    apart = [world.fitted(5, FAINT), world.refined(frames[1])]
    joint = dr.measure(together, [FAINT.offset])
    # The frame of the first one is as it would be without an angle: the angles' difference counts.
    origin = replace(apart[0].frames[0], observation=frames[0])
    apart[0] = replace(apart[0], frames=(origin,))
    separate = dr.measure(apart, [FAINT.offset])
    for table in (joint, separate):
        away = abs(float(table["contrast"][0]) - FAINT.contrast)
        assert away < 4 * float(table["contrast_error"][0])
    assert joint["contrast_error"][0] < separate["contrast_error"][0]
    wrong = dr.measure(together, [replace(FAINT, position_angle=70.0).offset])
    assert float(wrong["snr"][0]) < 0.6 * float(joint["snr"][0])


def test_a_reference_star_helps_and_shows_no_planet(world):
    target = world.observed(world.expected(FAINT), 5)
    reference = replace(world.observed(4 * world.expected(), 41), reference=True)
    fit = world.refined([target, reference])
    alone = dr.measure(world.fitted(5, FAINT), [FAINT.offset])
    both = dr.measure(fit, [FAINT.offset])
    away = abs(float(both["contrast"][0]) - FAINT.contrast)
    assert away < 4 * float(both["contrast_error"][0])
    assert both["contrast_error"][0] < 0.99 * alone["contrast_error"][0]
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
    generator = torch.Generator().manual_seed(8)
    change = torch.zeros(len(world.basis), dtype=torch.float64)
    change[:54] = 1e-9 * torch.randn(54, dtype=torch.float64, generator=generator)
    drift = world.basis.opd(change, PupilGrid.full(world.model.npix)).numpy()
    moved = replace(world, later=world.later + drift)
    frames = [world.observed(world.expected(), 60), moved.observed(moved.expected(), 61)]
    linked = world.refined(
        frames, drift=WavefrontPrior(scales={"segment": 0.5, "texture": 0.02}), drift_cycles=2.0
    )
    shared = world.refined(frames)
    assert linked.chi2_per_pixel < 0.8 * shared.chi2_per_pixel
    assert linked.chi2_per_pixel < 1.2
    assert linked.scales["segment drift"] == pytest.approx(0.7, abs=0.35)
    apart = linked.frames[1].opd - linked.frames[0].opd
    assert np.std(apart) > 0.2e-9


def test_the_contrast_curve_is_five_times_the_error_of_the_map(world, empty):
    table = empty[0].contrast_curve
    assert set(table.colnames) >= {"separation", "contrast", "known_star", "small_sample"}
    assert (np.diff(table["separation"].to_value("arcsec")) > 0).all()
    assert (table["contrast"] > table["known_star"]).all()
    assert (table["lowest"] <= table["contrast"]).all()
    assert (table["highest"] >= table["contrast"]).all()
    quick = dr.contrast_curve(empty[0].fits[0], separations=[0.5, 0.8], angles=200)
    for row in quick:
        k = int(np.argmin(np.abs(table["separation"] - row["separation"])))
        assert row["contrast"] == pytest.approx(table["contrast"][k], rel=1e-6)


def test_products_can_be_read_by_others(one, tmp_path):
    paths = one.write(tmp_path / "products")
    assert [path.name for path in paths] == ["detection.fits", "candidates.ecsv", "contrast.ecsv"]
    with astropy_fits.open(paths[0], checksum=True) as hdus:
        np.testing.assert_allclose(hdus["SNR"].data, one.snr, rtol=1e-6)
        assert hdus["OFFSET_X"].header["BUNIT"] == "arcsec"
        np.testing.assert_allclose(hdus["SUBTRACTED", 1].data, one.subtracted[0], rtol=1e-6)
        assert Unit(hdus["SUBTRACTED"].header["BUNIT"]) == Unit("photon")
        assert hdus[0].header["DRSTAT"] == "CONVERGED"
        assert hdus[0].header["DRVERS"] == dr.__version__
        # astropy warns of checksums that do not hold, and warnings are errors.
        assert all(hdu.verify_checksum() == hdu.verify_datasum() == 1 for hdu in hdus)
    table = QTable.read(paths[1], format="ascii.ecsv")
    assert table["separation"].unit == "arcsec"
    assert table.meta["scatter"] == one.scatter
    curve = QTable.read(paths[2], format="ascii.ecsv")
    assert len(curve) == len(one.contrast_curve)


def oriented(found):
    """The same detection, as if it had been made in a frame of known date and orientation."""
    (fit,) = found.fits
    (frame,) = fit.frames
    known = {"position_angles": np.array([33.0]), "date": Time("2023-01-02T03:04:05.678")}
    header = astropy_fits.Header({"TARGPROP": "HD 1", "CRVAL1": 311.3, "CRVAL2": -31.3})
    observation = replace(frame.observation, filter="F444W", header=header, **known)
    return replace(found, fits=(replace(fit, frames=(replace(frame, observation=observation),)),))


def test_the_images_are_on_the_sky_where_the_table_says(one, tmp_path):
    found = oriented(one)
    planet = found.candidates[0]
    # The nearest pixel, and from there the rest of the way.
    nearest = (np.hypot(found.grid[..., 0] - planet["x"].value,
                        found.grid[..., 1] - planet["y"].value)).argmin()  # fmt: skip
    row, column = np.unravel_index(nearest, found.snr.shape)
    step = (np.array([planet["x"].value, planet["y"].value]) - found.grid[row, column]) / (
        found.observation.pixelscale
    )
    pixel = np.array([column, row]) + step
    maps, fit = found.write(tmp_path)[0], found.fits[0].write(tmp_path / "fit.fits", linear=False)
    images = {
        maps: ("SNR", "SUBTRACTED", "DATA"),
        fit: ("DATA", "ERROR", "VALID", "STAR", "COMPANIONS", "GAIN"),
    }
    for path, names in images.items():
        with astropy_fits.open(path) as hdus:
            assert hdus[0].header["OBJECT"] == "HD 1"
            assert hdus[0].header["DRSTAT"] == "CONVERGED"
            for name in names:
                wcs = WCS(hdus[name].header)
                place = wcs.pixel_to_world(*pixel)
                east, north = SkyCoord(311.3, -31.3, unit="deg").spherical_offsets_to(place)
                assert east.arcsec == pytest.approx(planet["delta_ra"].value, abs=2e-4)
                assert north.arcsec == pytest.approx(planet["delta_dec"].value, abs=2e-4)
    with astropy_fits.open(fit) as hdus:
        units = {name: Unit(hdus[name].header["BUNIT"]) for name in ("DATA", "ERROR", "STAR")}
        assert set(units.values()) == {Unit("photon")}
        assert "CTYPE1" not in hdus["OPD"].header


def test_without_a_position_on_the_sky_the_coordinates_are_arcsec_from_the_star(one):
    wcs = WCS(world_coordinates(one.grid, one.observation))
    np.testing.assert_allclose(wcs.pixel_to_world_values(7, 3), one.grid[3, 7], atol=1e-9)


def test_a_detection_survives_the_file(one, tmp_path):
    first = oriented(one)
    again = Detection.read(first.write(tmp_path / "first")[0].parent)
    for name in ("snr", "residual_snr", "contrast", "error", "photon_error", "grid"):
        np.testing.assert_array_equal(getattr(again, name), getattr(first, name))
    for ours, theirs in zip(again.subtracted, first.subtracted, strict=True):
        np.testing.assert_array_equal(ours, theirs)
    assert [repr(again), str(again), again.scatter] == [repr(first), str(first), first.scatter]
    for ours, theirs in (
        (again.candidates, first.candidates),
        (again.contrast_curve, first.contrast_curve),
    ):
        assert ours.meta == theirs.meta
        assert ours.colnames == theirs.colnames
        for name in ours.colnames:
            np.testing.assert_array_equal(ours[name], theirs[name])
            assert ours[name].unit == theirs[name].unit
    assert again.north == 33.0
    assert again.observation.date == first.observation.date
    assert again.observation.target == "HD 1"
    left, right = again.plot(Figure().subplots(1, 2))
    assert left.get_title(loc="left").startswith("1 candidate above")
    assert len(right.lines) == len(first.plot(Figure().subplots(1, 2))[1].lines)
    # A copy of a copy is the same file.
    again.write(tmp_path / "again")
    for name in ("detection.fits", "candidates.ecsv", "contrast.ecsv"):
        copy = (tmp_path / "again" / name).read_bytes()
        assert copy == (tmp_path / "first" / name).read_bytes()


def test_a_detection_from_a_file_measures_with_its_fit(world, one, tmp_path):
    folder = one.write(tmp_path)[0].parent
    places = [[0.3, 0.6], *one.sources.offsets.tolist()]
    expected = one.measure(places)
    with pytest.raises(IncompatibleSetupError, match=r"no fit\.fits.*read\(path, fit=fit\)"):
        Detection.read(folder).measure(places)
    with pytest.raises(IncompatibleSetupError, match="not the one that was searched"):
        Detection.read(folder, fit=world.fitted(0))
    one.fits[0].write(folder / "fit.fits", linear=False)
    with pytest.raises(IncompatibleSetupError, match=r"with derivatives=True \(--derivatives\)"):
        Detection.read(folder).measure(places)
    one.fits[0].write(folder / "fit.fits", overwrite=True)
    for again in (Detection.read(folder), Detection.read(folder, fit=one.fits)):
        table = again.measure(places)
        for name in table.colnames:
            np.testing.assert_array_equal(table[name], expected[name])


@pytest.mark.parametrize(
    ("name", "message"),
    [("FACTS", "no FACTS"), ("PHOTON_ERROR", "PHOTON_ERROR"), ("SNR", "shapes"), ("none", "such")],
)
def test_a_file_without_a_part_is_no_detection(empty, name, message, tmp_path):
    path = empty[0].write(tmp_path)[0]
    if name == "none":
        path.unlink()
    else:
        with astropy_fits.open(path) as hdus:
            if name == "SNR":
                hdus[name].data = hdus[name].data[1:]
            else:
                del hdus[name]
            hdus.writeto(path, overwrite=True, checksum=True)
    with pytest.raises(CorruptFileError, match=message):
        Detection.read(path)


def test_a_refinement_is_no_detection(one, tmp_path):
    path = one.fits[0].write(tmp_path / "fit.fits", linear=False)
    with pytest.raises(CorruptFileError, match="not a complete Detection"):
        Detection.read(path)


def kept(image, star, light, error):
    """Share of a planet's light that is in a subtracted frame, and not its noise's or star's."""
    good = np.isfinite(image)
    weight = (light / error**2)[good]
    return float((weight * (image - star)[good]).sum() / (weight * light[good]).sum())


def test_a_frame_keeps_the_light_of_candidates(world):
    light = world.expected(FAINT) - world.expected()
    found = world.detected(5, FAINT)
    assert len(found.sources) == 1
    fit = found.fits[0]
    assert not len(fit.companions)
    # What is left of the star and its noise, were it known.
    noise = fit.frames[0].observation.data[0] - world.expected() - light
    error = fit.frames[0].observation.error[0]
    assert kept(fit.frames[0].residual[0], noise, light, error) < 0.9
    (image,) = found.subtracted
    assert kept(image, noise, light, error) == pytest.approx(1.0, abs=0.06)
    # A fit that has the planet from the start leaves the same.
    (renewed,) = with_companions(found.fits, found.sources)
    away = radius(found) > 0.25
    difference = ((image - renewed.frames[0].residual[0]) / error)[away]
    closed = ((fit.frames[0].residual[0] - renewed.frames[0].residual[0]) / error)[away]
    assert difference.std() < 0.05
    assert difference.std() < 0.2 * closed.std()


def test_a_bright_companions_frame_is_what_its_own_fit_leaves(world):
    """The star is found in single precision once more; of 1e-3 that must not show."""
    found = world.detected(7, replace(WHERE, contrast=1e-3))
    (fit,) = found.fits
    assert len(fit.companions) == len(found.sources) == 1
    difference = (found.subtracted[0] - fit.frames[0].residual[0]) / fit.frames[
        0
    ].observation.error[0]
    assert difference[radius(found) > 0.25].std() < 0.05


@pytest.fixture(scope="module")
def reference(large):
    """A brighter star, fitted on its own."""
    return large.refined(replace(large.observed(4 * large.expected(), 72), reference=True))


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
    apart = dr.detect([large.refined(frame) for frame in (frames[0], frames[2])])
    np.testing.assert_allclose(apart.subtracted[1], apart.fits[1].frames[0].residual[0], atol=1e-9)


def test_positions_may_have_a_unit(one):
    plain = one.measure([[-0.485, 0.353]])
    for offsets in ([[-485, 353]] * u.mas, [[-0.485, 0.353]] * u.arcsec):
        for table in (one.measure(offsets), dr.measure(one.fits, offsets, scatter=one.scatter)):
            for name in plain.colnames:
                np.testing.assert_allclose(table[name], plain[name], rtol=1e-12)


def test_a_position_outside_the_field_is_refused(one):
    """Such as one that somebody else calls arcsec, and means degrees or pixels."""
    corner = one.grid[0, 0]
    assert np.isfinite(one.measure([corner])["contrast"][0])
    for far in (1.1 * corner, [[0.7, 0.35]] * u.deg, [0.0, -2.5], [-30.0, 5.0]):
        with pytest.raises(IncompatibleSetupError, match=r"offsets: got .*from the star; .*u\.mas"):
            one.measure(far)
        with pytest.raises(IncompatibleSetupError, match="offsets"):
            dr.measure(one.fits, far)


REFUSED = [
    (lambda one: dr.detect([]), "no fit"),
    (lambda one: dr.detect(replace(one.fits[0], stored_linear=None)), "linear=False.*Fit the fra"),
    (lambda one: one.measure([0.1, 0.2, 0.3]), r"\(k, 2\)"),
    (lambda one: one.measure([[np.nan, 0.2]]), "offsets"),
    (lambda one: one.measure([[1.0, 2.0]] * u.m), "offsets"),
    (lambda one: dr.detect(one.fits, inner=1 * u.m), "inner"),
]
CALLS = {
    "threshold: got": lambda fit, value: dr.detect(fit, threshold=value),
    "inner: got": lambda fit, value: dr.detect(fit, inner=value),
    "scatter: got": lambda fit, value: dr.detect(fit, scatter=value),
    "separations: got": lambda fit, value: dr.detect(fit, separations=[0.5, value]),
    "separations: got ": lambda fit, value: dr.contrast_curve(fit, [value]),
    "scatter: got ": lambda fit, value: dr.contrast_curve(fit, [0.5], scatter=value),
    "scatter: got.": lambda fit, value: dr.measure(fit, [[0.5, 0.5]], scatter=value),
}


@pytest.mark.parametrize(("call", "words"), REFUSED)
def test_what_cannot_be_searched_or_measured_is_refused(one, call, words):
    with pytest.raises(DiffrenderError, match=words):
        call(one)


@pytest.mark.parametrize("value", [-1.0, 0.0, math.nan])
@pytest.mark.parametrize("words", CALLS)
def test_numbers_that_cannot_be_are_refused(one, words, value):
    with pytest.raises(IncompatibleSetupError, match=f"{words}.*positive"):
        CALLS[words](one.fits[0], value)


def test_a_contrast_curve_outside_the_field_is_refused(one):
    fit = one.fits[0]
    with pytest.raises(IncompatibleSetupError, match=r"separations: got \[5\.0, 6\.0\].*corners"):
        dr.contrast_curve(fit, [5.0, 6.0])
    # What is partly inside has rows for that part.
    curve = dr.contrast_curve(fit, [500.0, 5000.0] * u.mas)
    assert curve["separation"].to_value("arcsec").tolist() == [0.5]


@pytest.mark.slow
def test_all_errors_have_the_factor_of_their_position(empty):
    """A fit that does not explain its data is searched with the scatter of its S/N."""
    (fit,) = empty[0].fits
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
    # The functions for a few positions multiply their errors likewise.
    offsets = np.array([[0.3, 0.1], [0.0, -0.8]])
    for table in (found.measure(offsets), dr.measure(mismatch, offsets)):
        errors = table["contrast"] / table["snr"]
        known = plain.measure(offsets)
        np.testing.assert_allclose(
            errors * known["snr"] / known["contrast"], factor.of(offsets), rtol=1e-6
        )
    again = dr.contrast_curve(mismatch, curve["separation"])
    np.testing.assert_allclose(again["contrast"], curve["contrast"], rtol=1e-6)
