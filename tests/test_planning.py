"""Plans: measured errors are those errors, the budget holds, faint scenes are cheap."""

from __future__ import annotations

import math
import pickle
from dataclasses import fields, replace
from functools import cache

import astropy.units as u
import numpy as np
import poppy
import pytest
import torch
from torch import Tensor

import pyklip_diffrender as dr
from pyklip_diffrender.bridges import from_poppy
from pyklip_diffrender.errors import (
    DiffrenderWarning,
    IncompatibleSetupError,
    MissingOPDError,
    ShapeError,
)
from pyklip_diffrender.instrument.nircam import nircam_coronagraph
from pyklip_diffrender.linear.mode_fields import NANOMETRE
from pyklip_diffrender.linear.response import coarse_copy, coarse_npix, downsample
from pyklip_diffrender.optics.bandpass import Bandpass
from pyklip_diffrender.optics.detector import Detector
from pyklip_diffrender.optics.grid import PupilGrid
from pyklip_diffrender.optics.system import OpticalSystem
from pyklip_diffrender.planning import Economy, ModelError, Option, Plan, coarse_steps, plan, probes
from pyklip_diffrender.planning.noise_model import RidgeResidual
from pyklip_diffrender.planning.systems import CheapSystem
from pyklip_diffrender.planning.trial import PROBED, START, Trial
from pyklip_diffrender.refinement import GaussNewton, refine
from pyklip_diffrender.scene.objects import Planet, Scene, Star
from pyklip_diffrender.scene.observation import Observation
from pyklip_diffrender.scene.simulation import simulate, star_photons
from pyklip_diffrender.wavefront.bases import default_basis
from pyklip_diffrender.wavefront.opd import random_drift, random_opd
from pyklip_diffrender.wavefront.priors import WavefrontPrior

NPIX = 256
CYCLES = (20.0,)
BRIGHT = Scene(star=Star())
FAINT = Scene(star=Star(exposure=36.0))
PLANET = Planet(3e-5, 0.6, 30.0)
SETTINGS = {"cycles": CYCLES}
COARSE = {"cycles": CYCLES, "response_npix": 64}
"""With derivatives so coarse that there is a grid between them and the model's."""


@cache
def model(**changes: object) -> OpticalSystem:
    settings = {"monochromatic": 4.5e-6, "fov_pixels": 24, "npix": NPIX, **changes}
    return nircam_coronagraph("F444W", **settings)


def bare() -> OpticalSystem:
    """The same without a recipe."""
    made = model()
    return OpticalSystem(made.entrance, made.planes, made.detector, made.bandpass)


@cache
def before() -> np.ndarray:
    return random_opd(5, npix=NPIX).data


@cache
def frame(exposure: float = 36.0, seed: int = 3) -> Observation:
    """A star some hours later, and a planet."""
    later = before() + random_drift(6, 40.0, npix=NPIX).data
    scene = Scene(star=Star(exposure=exposure), planets=(PLANET,))
    return simulate(model(), scene, later, seed=seed)


@cache
def faint_plan() -> Plan:
    return plan(model(), frame(), before(), **SETTINGS)


@cache
def bright_plan() -> Plan:
    return plan(model(), BRIGHT, before(), **COARSE)


def trial(scene: Scene | Observation = BRIGHT) -> Trial:
    return Trial(
        model(),
        scene,
        torch.from_numpy(before()),
        {},
        prior=WavefrontPrior(),
        cycles=CYCLES[0],
        response_npix=64,
        model_error=0.0,
        budget=0.1,
        seed=0,
        pins={},
    )


def noise_of(scene: Scene, image: Tensor) -> np.ndarray:
    return np.sqrt(scene.star.photons * image.numpy() + scene.read_noise**2)


def brute_force(change: np.ndarray, image: np.ndarray, noise: np.ndarray) -> float:
    """Rms of a change in photons over the noise, flux and background fitted."""
    design = np.stack([(image / noise).ravel(), (1 / noise).ravel()], axis=1)
    whitened = (change / noise).ravel()
    left = whitened - design @ np.linalg.lstsq(design, whitened, rcond=None)[0]
    return float(np.sqrt(np.mean(left**2)))


def drawn(seed: int, scale: float = 1.0) -> tuple[Tensor, Tensor]:
    """A wavefront change from the default prior: coefficients (nm), and on the model's grid."""
    basis, prior = default_basis(CYCLES[0]), WavefrontPrior()
    scales = torch.tensor([prior.scales[name] for name in basis.groups], dtype=torch.float64)
    deviation = scale * scales[basis.group_index] * prior.shape(basis)
    generator = torch.Generator().manual_seed(seed)
    coefficients = deviation * torch.randn(len(basis), generator=generator, dtype=torch.float64)
    grid = PupilGrid.full(NPIX, model().diameter)
    return coefficients, basis.opd(coefficients * NANOMETRE, grid)


# -- what is measured ----------------------------------------------------------------------------


@pytest.mark.parametrize("multifidelity", [False, True])
def test_a_measured_error_is_that_of_brute_force(multifidelity: bool) -> None:
    here = trial()
    choice = replace(here.finest, npix=128, multifidelity=multifidelity)
    change = here.drift.opd(PROBED, CYCLES[0], PupilGrid.full(NPIX, model().diameter))
    start = torch.from_numpy(before())
    coarse = model(npix=128)

    def rendered(opd: Tensor) -> Tensor:
        if not multifidelity:
            return coarse(downsample(opd, 128))
        both = zip(
            model().fields(start),
            coarse.fields(downsample(opd, 128)),
            coarse.fields(downsample(start, 128)),
            strict=True,
        )
        return sum((fine + here - there).abs() ** 2 for fine, here, there in both)

    truth, image = model()(start + change), model()(start)
    away = BRIGHT.star.photons * (rendered(start + change) - truth).numpy()
    expected = brute_force(away, image.numpy(), noise_of(BRIGHT, image))
    # The plan samples the modes on the coarse pupil; here their means over its pixels are taken.
    assert here.error(choice, PROBED).rms == pytest.approx(expected, rel=0.1)


def test_the_worst_pixel_is_the_largest() -> None:
    here = trial()
    error = here.error(replace(here.finest, npix=128), START)
    assert error.worst > 2 * error.rms
    assert not ModelError(0.05, 2.0).inside(0.1)
    assert ModelError(0.05, 0.9).inside(0.1)


def test_the_error_of_fewer_modes_is_that_of_brute_force() -> None:
    here, start = trial(), torch.from_numpy(before())
    grid = PupilGrid.full(NPIX, model().diameter)
    full, few = (model()(start + here.drift.opd(PROBED, c, grid)) for c in (CYCLES[0], 8.0))
    image = model()(start)
    away = BRIGHT.star.photons * (few - full).numpy()
    expected = brute_force(away, image.numpy(), noise_of(BRIGHT, image))
    found = here.error(replace(here.finest, cycles=8.0), PROBED).rms
    # The same renderings; two ways to solve for flux and background.
    assert found == pytest.approx(expected, rel=1e-6)


def test_drifts_have_the_deviations_of_the_prior() -> None:
    drift = trial().drift
    grid = PupilGrid.full(64, model().diameter)
    maps = torch.stack([drift.opd(k, 2.0, grid) for k in range(100, 300)]) / NANOMETRE
    modes = drift.basis.modes(grid, 0, drift.count(2.0))
    expected = ((drift.deviation[: len(modes)] ** 2)[:, None, None] * modes**2).sum(dim=0)
    # 200 draws of some 170 modes; the variance of a single pixel is known to a tenth.
    assert float(maps.square().mean()) == pytest.approx(float(expected.mean()), rel=0.1)


def test_what_a_fit_leaves_is_that_of_ridge_regression(rng: np.random.Generator) -> None:
    slopes, seen = rng.normal(size=(7, 4, 5)), rng.normal(size=(4, 5))
    found = RidgeResidual(torch.from_numpy(slopes)).residual(torch.from_numpy(seen), 5)
    rows = slopes[:5].reshape(5, -1)
    expected = np.linalg.solve(np.eye(20) + rows.T @ rows, seen.ravel()).reshape(seen.shape)
    # Both are solved in double precision.
    np.testing.assert_allclose(found.numpy(), expected, atol=1e-12)


def test_data_far_from_the_model_widen_the_prior() -> None:
    far = simulate(model(), FAINT, before() + 5 * drawn(1)[1].numpy(), seed=1)
    near = simulate(model(), FAINT, before(), seed=1)

    as_expected = trial(FAINT).drift.deviation

    def scale(observation: Observation) -> float:
        return float((trial(observation).drift.deviation / as_expected).mean())

    assert scale(far) > 2.0
    assert scale(near) < 1.0


# -- systems -------------------------------------------------------------------------------------


def test_a_cheap_system_keeps_its_wavelengths_in_copies() -> None:
    band = Bandpass((4.3e-6, 4.6e-6), (0.5, 0.5))
    cheap = CheapSystem(model(), band)
    assert coarse_copy(cheap, 64).bandpass == band
    assert coarse_npix(cheap, 64) == coarse_copy(cheap, 64).npix == 64
    alone = [model(monochromatic=wave)(before()) for wave in band.wavelengths]
    # The wedge tilt is relative to the mean wavelength of the system that was made.
    assert float((cheap(before()) - sum(alone) / 2).abs().max()) < 0.05 * float(alone[0].max())


def test_coarse_steps_are_exact_where_they_start_and_good_nearby() -> None:
    here, start = coarse_steps(model(), before(), 128), torch.from_numpy(before())
    small, truth = downsample(start, 128), model()(start)
    # Rounding: the coarse field is taken off and added again.
    assert float((here(small) - truth).abs().max()) < 1e-12 * float(truth.max())
    moved = start + drawn(3)[1]
    errors = [
        float((system(downsample(moved, 128)) - model()(moved)).norm())
        for system in (here, model(npix=128))
    ]
    assert errors[0] < 0.2 * errors[1]


def test_copies_of_coarse_steps_are_without_the_constant() -> None:
    small = downsample(torch.from_numpy(before()), 64)
    copy = coarse_copy(coarse_steps(model(), before(), 128), 64)
    assert torch.equal(copy(small), coarse_copy(model(npix=128), 64)(small))


def test_a_changed_detector_has_its_own_transforms() -> None:
    detector = model().detector
    model()(before())
    sheared = replace(detector, shear=0.1)
    wavefront = model().pupil_field(torch.from_numpy(before()), 4.5e-6, {})
    fresh = Detector(**{f.name: getattr(sheared, f.name) for f in fields(sheared) if f.init})
    assert torch.equal(sheared.field(wavefront, {}), fresh.field(wavefront, {}))
    assert not torch.equal(sheared.field(wavefront, {}), detector.field(wavefront, {}))


def test_what_a_system_can_change() -> None:
    assert {"npix", "dtype", "occulter_sampling", "fov_pixels"} <= model().adjustable
    assert CheapSystem(model()).adjustable == model().adjustable
    assert bare().adjustable == CheapSystem(bare()).adjustable == {"bandpass"}


# -- plans ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", [11, 12])
def test_a_bright_star_stays_inside_the_budget_at_wavefronts_of_its_own(seed: int) -> None:
    found = bright_plan()
    coefficients, change = drawn(seed)
    kept = default_basis(found.choice.cycles)
    grid = PupilGrid.full(found.model.npix, model().diameter)
    small = downsample(torch.from_numpy(before()), found.model.npix)
    cheap = found.model(small + kept.opd(coefficients[: len(kept)] * NANOMETRE, grid))
    truth, image = model()(torch.from_numpy(before()) + change), model()(before())
    away = BRIGHT.star.photons * (cheap - truth).numpy()
    assert brute_force(away, image.numpy(), noise_of(BRIGHT, image)) <= found.budget
    assert found.verified_error.inside(found.budget)
    assert found.choice.cycles == CYCLES[0]


def test_a_faint_star_is_several_times_cheaper_and_inside_the_budget() -> None:
    found = faint_plan()
    assert found.verified_error.inside(found.budget)
    assert found.seconds_given > 1.7 * found.seconds
    count = default_basis(CYCLES[0]).frequencies
    assert int((count <= found.choice.cycles).sum()) < 0.4 * len(count)


def test_plans_of_the_same_seed_are_the_same() -> None:
    """But for rounding, which changes with where arrays come to lie in memory."""
    again, first = plan(model(), frame(), before(), **SETTINGS), faint_plan()
    assert again.choice == first.choice
    assert again.verified_error.rms == pytest.approx(first.verified_error.rms, rel=1e-9)
    assert again.verified_error.worst == pytest.approx(first.verified_error.worst, rel=1e-9)


def test_a_plan_explains_itself() -> None:
    found = faint_plan()
    assert set(found.table["what"]) == set(probes.PROBES)
    text = str(found)
    assert all(name in text for name in probes.PROBES)
    assert "sigma" in text
    assert "times cheaper" in repr(found)
    summary = found.summary()
    assert summary["plan_npix"] == found.choice.npix
    assert all(isinstance(value, int | float | str) for value in summary.values())
    shown = found.table[found.table["what"] == "wavefront modes"][0]
    assert shown["error"] <= found.budget
    assert shown["seconds"].to_value("s") < found.seconds_given


def test_a_plan_can_be_sent_to_another_process() -> None:
    found = faint_plan()
    again = pickle.loads(pickle.dumps(found))
    assert again.choice == found.choice
    assert coarse_copy(again.model, 64).npix == 64
    small = downsample(torch.from_numpy(before()), found.model.npix)
    assert torch.equal(again.model(small), found.model(small))


def test_fewer_wavelengths_for_a_faint_star() -> None:
    broad = model(monochromatic=None, nlambda=6)
    found = plan(broad, FAINT, before(), keep={"npix": NPIX}, cycles=(4.0,), response_npix=64)
    assert 1 < found.choice.wavelengths < 6
    assert len(found.model.bandpass.wavelengths) == found.choice.wavelengths
    assert found.verified_error.inside(found.budget)


def test_settings_can_be_kept() -> None:
    found = plan(model(), frame(), before(), keep={"npix": NPIX, "cycles": CYCLES[0]}, **SETTINGS)
    assert (found.choice.npix, found.choice.cycles) == (NPIX, CYCLES[0])
    assert found.pinned == ("npix", "cycles")
    assert found.refine_options == {"cycles": CYCLES}
    with pytest.warns(DiffrenderWarning, match="more than the budget"):
        coarse = plan(
            model(), BRIGHT, before(), keep={"npix": 128, "multifidelity": False}, **SETTINGS
        )
    assert coarse.model.npix == 128
    assert set(coarse.table["why"]) >= {"kept as requested"}


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"keep": {"pupil": 256}}, "settings that a plan chooses: npix"),
        ({"keep": {"npix": 100}}, "npix=100"),
        ({"keep": {"cycles": 5.0}}, "cycles=5.0"),
        ({"error_budget": 0.0}, "error_budget"),
        ({"error_budget": math.nan}, "error_budget"),
        ({"cycles": ()}, "cycles"),
    ],
)
def test_bad_settings_are_refused(changes: dict[str, object], complaint: str) -> None:
    with pytest.raises(IncompatibleSetupError, match=complaint):
        plan(model(), FAINT, before(), **{**SETTINGS, **changes})


def test_bad_input_is_refused() -> None:
    with pytest.raises(MissingOPDError):
        plan(model(), FAINT, None)
    with pytest.raises(IncompatibleSetupError, match="expected a Scene"):
        plan(model(), before(), before())  # type: ignore[arg-type]
    with pytest.raises(ShapeError, match="pixels"):
        plan(model(fov_pixels=20), frame(), before())


def test_a_system_without_a_recipe_can_be_planned_for() -> None:
    found = plan(bare(), FAINT, before(), cycles=(8.0,))
    assert found.choice.npix == NPIX
    assert "the pupil grid of this system is fixed" in str(found)
    assert found.verified_error.inside(found.budget)
    with pytest.raises(IncompatibleSetupError, match="npix=128"):
        plan(bare(), FAINT, before(), keep={"npix": 128}, cycles=(8.0,))


def test_a_system_from_poppy_can_be_planned_for_and_fitted() -> None:
    """Its planes alone have a fixed pupil, and know two wavelengths only."""
    osys = poppy.OpticalSystem(oversample=2, npix=128, verbose=False)
    osys.pupil_diameter = 6.5 * u.m
    osys.add_pupil(poppy.CircularAperture(radius=3.2))
    osys.add_image(poppy.CircularOcculter(radius=0.3))
    osys.add_pupil(poppy.CircularAperture(radius=2.6))
    osys.add_detector(pixelscale=0.063, fov_pixels=20)
    made = from_poppy(osys, [4.4e-6, 4.6e-6])
    middle = CheapSystem(made, Bandpass((4.5e-6,), (1.0,)))
    # poppy's optics are sampled anew at a wavelength between theirs.
    assert torch.equal(middle(None), from_poppy(osys, 4.5e-6)(None))
    system = OpticalSystem(made.entrance, made.planes, made.detector, made.bandpass)
    opd = downsample(torch.from_numpy(before()), 128).numpy()
    observation = simulate(system, Scene(star=Star(exposure=3.6)), opd, seed=1)
    settings = {"cycles": (4.0,), "response_npix": 64}
    found = plan(system, observation, opd, **settings)
    assert (found.choice.npix, found.choice.wavelengths) == (128, 2)
    why = dict(zip(found.table["what"], found.table["why"], strict=True))
    assert why["pupil grid"] == "the pupil grid of this system is fixed"
    assert why["wavelengths"] == "the wavelengths of this system are fixed"
    assert found.verified_error.inside(found.budget)
    free = ("star_offset", "flux", "background")
    fast = GaussNewton(free=free, max_iterations=3, **settings)
    fit = refine(system, observation, opd, settings=fast, plan=found)
    assert fit.plan is not None
    assert fit.plan.final_error is not None


@pytest.mark.parametrize(
    ("name", "options"),
    [
        (
            "pupil grid",
            [{"npix": 128, "multifidelity": m} for m in (False, True)]
            + [{"npix": NPIX, "multifidelity": False}],
        ),
        ("wavefront modes", [{"cycles": c} for c in (6.0, 14.0, CYCLES[0])]),
    ],
)
def test_a_probe_that_claims_too_much_is_caught(
    name: str, options: list[dict[str, object]], monkeypatch: pytest.MonkeyPatch
) -> None:
    boast = Economy(name, tuple(Option(changes) for changes in options))
    monkeypatch.setitem(probes.PROBES, name, lambda here: boast)
    found = plan(model(), BRIGHT, before(), **COARSE)
    assert name in found.steps
    assert found.error.rms == 0.0
    assert found.verified_error.inside(found.budget)
    assert found.choice.cycles == CYCLES[0]
    assert (found.choice.npix, found.choice.multifidelity) != (128, False)
    assert "refined by the verification" in str(found)


# -- in a fit ------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_planned_fit_sees_the_same_planet_on_the_model_as_given() -> None:
    settings = GaussNewton(**SETTINGS)
    exact = refine(model(), frame(), before(), settings=settings, plan="off")
    cheap = refine(model(), frame(), before(), settings=settings, plan=faint_plan())
    assert exact.plan is None
    assert cheap.plan is not None
    assert not cheap.plan.abandoned
    assert cheap.plan.final_error is not None
    assert cheap.plan.final_error.inside(0.1)
    assert cheap.frames[0].coefficients is not None
    assert exact.frames[0].coefficients is not None
    assert len(cheap.frames[0].coefficients) < 0.4 * len(exact.frames[0].coefficients)
    # The contract: the given model, its grid, its star.
    assert cheap.model is model()
    assert cheap.wavefront.shape == (NPIX, NPIX)
    np.testing.assert_allclose(cheap.frames[0].render(), cheap.frames[0].star, rtol=1e-9)
    assert cheap.summary()["plan_npix"] == cheap.plan.choice.npix
    planet = [PLANET.offset]
    there, here = dr.measure(exact, planet)[0], dr.measure(cheap, planet)[0]
    assert abs(here["contrast"] - there["contrast"]) < 0.15 * there["contrast_error"]
    assert here["snr"] == pytest.approx(there["snr"], rel=0.05)


def test_refine_plans_by_itself_and_honours_what_it_was_told() -> None:
    drift = WavefrontPrior({"segment": 1.0, "texture": 1.0}, fit_scales=False)
    settings = GaussNewton(cycles=4.0, drift=drift, max_iterations=3, response_npix=64)
    fit = refine(model(), [frame(), frame(seed=4)], before(), settings=settings)
    assert fit.plan is not None
    # Frames that differ in their wavefronts need the modes of the settings; a correction to the
    # field belongs to one position of the star.
    assert fit.plan.pinned == ("cycles", "multifidelity")
    assert fit.plan.choice.cycles == 4.0
    assert not fit.plan.choice.multifidelity
    # So do a basis of the caller's own, no wavefront at all, and a free amplitude.
    amplitude = WavefrontPrior(amplitude_cycles=2.0, amplitude_scale=1.0)
    for decided in ({"basis": default_basis(2.0)}, {"wavefront": False}, {"prior": amplitude}):
        few = GaussNewton(**{"cycles": 2.0, "max_iterations": 1, "response_npix": 64, **decided})
        assert refine(model(), frame(), before(), settings=few).plan is None


@pytest.mark.slow
def test_a_plan_that_fails_at_the_solution_is_abandoned(caplog: pytest.LogCaptureFixture) -> None:
    keep = {"npix": 128, "multifidelity": False, "cycles": 4.0}
    bright = frame(7200.0)
    with pytest.warns(DiffrenderWarning, match="more than the budget"):
        coarse = plan(model(), bright, before(), keep=keep, cycles=(4.0,), response_npix=64)
    settings = GaussNewton(cycles=4.0, response_npix=64, max_iterations=6)
    fit = refine(model(), bright, before(), settings=settings, plan=coarse)
    assert fit.plan is not None
    assert fit.plan.abandoned
    assert "continues with the full model" in caplog.text
    assert "continued with the full model" in str(fit.plan)
    assert fit.wavefront.shape == (NPIX, NPIX)
    np.testing.assert_allclose(fit.frames[0].render(), fit.frames[0].star, rtol=1e-6)


def test_bad_plans_are_refused() -> None:
    with pytest.raises(IncompatibleSetupError, match="'auto'"):
        refine(model(), frame(), before(), plan="cheap")
    with pytest.raises(IncompatibleSetupError, match="made for"):
        refine(model(npix=128), frame(), before(), plan=faint_plan())


def test_a_simulated_star_is_that_of_the_scene() -> None:
    here = trial(replace(FAINT, background=100.0))
    expected = np.sqrt(star_photons(model(), FAINT, before()) + 100.0 + FAINT.read_noise**2)
    np.testing.assert_allclose(here.noise.sigma.numpy(), expected)
