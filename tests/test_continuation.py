"""Fits that go on from one another: more modes, other settings."""

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

import pyklip_diffrender as dr
from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.optics.grid import PupilGrid
from pyklip_diffrender.refinement import FitSettings, Status, refine_again
from pyklip_diffrender.scene.objects import Planet
from pyklip_diffrender.scene.observation import Observation
from pyklip_diffrender.wavefront import WavefrontPrior, random_opd
from pyklip_diffrender.wavefront.bases import FourierModes, default_basis

NPIX, SIZE, FLUX, READ_NOISE = 128, 24, 2e9, 42.0
OFFSET = (0.002, -0.001)
CYCLES = (4.0, 6.0)
PLANET = Planet(2e-3, 0.6, 30.0)
ROLL = 10.0


@cache
def model():
    return dr.nircam_coronagraph("F444W", monochromatic=4.5e-6, npix=NPIX, fov_pixels=SIZE)


@cache
def before():
    return random_opd(3, npix=NPIX).data


@cache
def later(cycles=CYCLES[0]):
    """Moved by modes up to `cycles`; by default those that both bases have."""
    basis = default_basis(cycles)
    generator = torch.Generator().manual_seed(1)
    size = torch.where(basis.frequencies == 0, 1.0, 0.3)
    size[basis.frequencies > CYCLES[0]] = 6.0
    change = size * torch.randn(len(basis), dtype=torch.float64, generator=generator)
    return before() + basis.opd(1e-9 * change, PupilGrid.full(NPIX)).numpy()


@cache
def star(offset=OFFSET, cycles=CYCLES[0]):
    return FLUX * model()(later(cycles), offset).numpy()


@cache
def shot(k=0, planet=None, cycles=CYCLES[0]):
    """A frame; later ones are rolled."""
    expected = star(cycles=cycles)
    if planet is not None:
        turned = replace(planet, position_angle=planet.position_angle - k * ROLL)
        expected = expected + turned.contrast * star(tuple(np.add(OFFSET, turned.offset)))
    rng = np.random.default_rng(20 + k)
    counts = rng.poisson(expected) + rng.normal(0, READ_NOISE, expected.shape)
    error = np.sqrt(np.maximum(counts, 0) + READ_NOISE**2)
    return Observation.from_arrays(
        counts, error, pixelscale=model().detector.pixelscale, name=f"roll {k}",
        position_angles=np.array([k * ROLL]),
    )  # fmt: skip


def settings(**changes):
    return FitSettings(**{"cycles": CYCLES, "response_npix": 64, **changes})


@pytest.mark.parametrize(
    ("grown", "count"), [pytest.param(True, 1, marks=pytest.mark.slow), (False, 2)]
)
def test_every_way_a_fit_can_go_on(grown, count):
    """Basis grown, where the wavefront has finer modes, or not, one frame or two."""
    frames = [shot(k, cycles=CYCLES[grown]) for k in range(count)]
    fit = dr.refine(model(), frames, before(), settings=settings())
    assert fit.status is Status.CONVERGED
    assert len(fit.basis) == len(default_basis(CYCLES[grown]))
    assert fit.settings.cycles == CYCLES[grown:]
    truth = star(cycles=CYCLES[grown])
    for frame in fit.frames:
        np.testing.assert_allclose(frame.render(), frame.star, rtol=1e-9)
        pulls = (frame.star - truth) / np.sqrt(truth + READ_NOISE**2)
        # Most of a star model's error is that of the modes that the data determine.
        assert np.sqrt(np.mean(pulls**2)) < 0.6
    assert len(fit.linear.vector) == len(fit.linear.unknowns)
    again = refine_again(fit, max_iterations=4)
    assert len(again.basis) == len(fit.basis)
    assert len(dr.detect(fit).measure([[0.3, -0.5]])) == 1


@pytest.mark.slow
def test_drifts_and_a_known_companion_go_on():
    drift = WavefrontPrior(scales={"segment": 0.5, "texture": 0.02})
    own = settings(cycles=4.0, drift=drift, drift_cycles=2.0, companions=(PLANET,))
    fit = dr.refine(model(), [shot(k, PLANET) for k in range(2)], before(), settings=own)
    assert fit.status is Status.CONVERGED
    assert set(fit.scales) == {"segment", "texture", "segment drift", "texture drift"}
    again = refine_again(fit, max_iterations=4)
    # The scales of both priors go on from where the fit had left them.
    assert again.settings.drift.scales != drift.scales
    ((contrast, *_),) = again.companions
    assert contrast == pytest.approx(PLANET.contrast, rel=0.03)


def test_a_companion_can_be_added_to_a_fit():
    faint = replace(PLANET, contrast=3e-4)
    kept = settings(companions_if_stalled=False, cycles=4.0)
    fit = dr.refine(model(), shot(0, faint), before(), settings=kept)
    assert not len(fit.companions)
    again = refine_again(fit, companions=(faint,))
    assert len(again.companions) == 1
    assert abs(again.companions[0, 0] - 3e-4) < 4 * again.companion_errors[0, 0]
    assert again.chi2_per_pixel < fit.chi2_per_pixel
    with pytest.raises(IncompatibleSetupError, match="the fit ended as DIVERGED"):
        dr.detect(replace(fit, status=Status.DIVERGED))


@pytest.mark.parametrize("wavefront", [True, False], ids=["wavefront", "alignment"])
def test_a_fit_with_a_basis_of_its_own_can_go_on(wavefront):
    """A basis without segments: the prior of those stays as it was."""
    own = settings(basis=FourierModes(3), max_iterations=6, wavefront=wavefront)
    fit = dr.refine(model(), shot(), before(), settings=own)
    again = refine_again(fit, wavefront=True, max_iterations=12)
    assert again.chi2_per_pixel < 1.001 * fit.chi2_per_pixel
    assert isinstance(again.settings, FitSettings)
    scales = again.settings.prior.scales
    assert scales["segment"] == own.prior.scales["segment"]
    assert scales["texture"] == fit.scales["texture"]
    # It began where the other had ended.
    if wavefront:
        first = again.history[0]["chi2_per_pixel"]
        assert first == pytest.approx(fit.chi2_per_pixel, rel=0.01)
        assert first < 0.9 * fit.history[0]["chi2_per_pixel"]


def test_a_fit_goes_on_from_where_it_ended():
    """With a smallest error of the model, and a pattern in the frame that no wavefront explains."""
    rng = np.random.default_rng(9)
    frame = shot()
    frame = replace(frame, data=frame.data * (1 + 0.05 * rng.normal(size=frame.data.shape)))
    settings = FitSettings(
        basis=default_basis(CYCLES[0]), response_npix=64, min_model_error=0.002, robust=4.0,
        companions_if_stalled=False,
        prior=WavefrontPrior({"segment": 10.0, "texture": 6.0}, fit_scales=False),
    )  # fmt: skip
    fit = dr.refine(model(), frame, before(), settings=settings)
    assert fit.status is Status.MODEL_MISMATCH
    kappas = [step["kappa"] for step in fit.history]
    assert kappas[0] > 0.05
    assert kappas[-1] == 0.002
    again = refine_again(fit)
    assert {step["kappa"] for step in again.history} == {0.002}
    assert len(again.history) < len(fit.history) / 2
    assert again.chi2_per_pixel == pytest.approx(fit.chi2_per_pixel, rel=0.02)


def test_arguments_that_do_not_go_together_are_refused():
    frames = [shot(0), shot(1)]
    with pytest.raises(IncompatibleSetupError, match=r"settings: got a str, expected FitSettings"):
        dr.refine(model(), frames, before(), settings="gauss-newton")
    with pytest.raises(IncompatibleSetupError, match="order of the arguments"):
        dr.refine(before(), shot(), model())


BAD = [
    ({"cycles": ()}, r"cycles: got none, expected at least one, such as 24"),
    ({"cycles": (24.0, -1.0)}, r"cycles: got \(24\.0, -1\.0\), expected positive"),
    ({"cycles": math.nan}, r"cycles: got \(nan,\), expected positive"),
    ({"cycles": "fine"}, r"cycles: got .fine., expected a number"),
    ({"free": "flux"}, r"free: got the text 'flux', expected a tuple .*\('flux',\)"),
    ({"max_iterations": 0}, r"max_iterations: got 0, expected a positive"),
    ({"tolerance": -1e-3}, r"tolerance: got -0\.001, expected a positive"),
    ({"robust": 0.0}, r"robust: got 0\.0, expected a positive"),
    ({"relinearise": math.nan}, r"relinearise: got nan"),
    ({"response_npix": -64}, r"response_npix: got -64"),
    ({"min_model_error": -0.01}, r"min_model_error: got -0\.01, expected 0 or more"),
    ({"accurate_steps": 0.1}, r"accurate_steps: got 0\.1, expected True or False"),
    ({"max_companions": -1}, r"max_companions: got -1, expected 0 or more"),
    ({"companion_threshold": 0.0}, r"companion_threshold: got 0\.0, expected a positive"),
    ({"drift_cycles": -8.0}, r"drift_cycles: got -8\.0, expected a positive"),
    ({"companions": ((1e-5, 0.5, 0.3),)}, r"companions: got .*expected Planets.*from_offset"),
    ({"free": (), "wavefront": False}, r"nothing to fit.*wavefront=True"),
]


@pytest.mark.parametrize(("changes", "complaint"), BAD)
def test_settings_that_cannot_be_are_refused_when_they_are_made(changes, complaint):
    with pytest.raises(IncompatibleSetupError, match=complaint):
        FitSettings(**changes)
    with pytest.raises(IncompatibleSetupError, match=complaint):
        FitSettings.nircam(**changes)


def test_modes_of_the_preset_reach_the_edge_of_the_fitted_square():
    expected = {"F444W": 18, "F480M": 16, "F356W": 22, "F250M": 32, "F210M": 18}
    assert {name: FitSettings.nircam(name).cycles[0] for name in expected} == expected
    assert FitSettings.nircam() == FitSettings.nircam("F444W")
    with pytest.raises(IncompatibleSetupError, match=r"filter: got .*F444W"):
        FitSettings.nircam("F44W")


@pytest.mark.parametrize("cycles", [6, [6.0], np.float64(6)])
def test_a_single_number_of_cycles_will_do(cycles):
    made = FitSettings(cycles=cycles, free=["flux"], companions=[PLANET])
    assert made == FitSettings(cycles=(6.0,), free=("flux",), companions=(PLANET,))
    assert FitSettings.nircam(cycles=cycles).cycles == (6.0,)
