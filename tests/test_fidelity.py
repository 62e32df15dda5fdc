"""The fidelity plan: measured errors are those errors, the budget holds, faint scenes are cheap."""

from __future__ import annotations

import math
import pickle
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from torch import Tensor

import pyklip_diffrender as dr
from pyklip_diffrender.errors import (
    DiffrenderWarning,
    IncompatibleSetupError,
    MissingOPDError,
    ShapeError,
)
from pyklip_diffrender.instrument.nircam import nircam_coronagraph
from pyklip_diffrender.instrument.spectrum import filter_bandpass
from pyklip_diffrender.linear.response import NANOMETRE, coarse_copy, coarse_npix, downsample
from pyklip_diffrender.optics.bandpass import Bandpass
from pyklip_diffrender.optics.detector_effects import ChainDetector, GaussianBlur, PixelCrosstalk
from pyklip_diffrender.optics.grid import PupilGrid
from pyklip_diffrender.optics.system import OpticalSystem
from pyklip_diffrender.planning import Economy, Error, Option, Plan, plan, probes
from pyklip_diffrender.planning.absorb import Absorber
from pyklip_diffrender.planning.build import CheapSystem, optional_parts, quadrature
from pyklip_diffrender.planning.trial import PROBED, START, Trial
from pyklip_diffrender.refinement import refine
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
SETTINGS = {"cycles": CYCLES, "response_npix": 128}
COARSE = {"cycles": CYCLES, "response_npix": 64}
"""With derivatives so coarse that there is a grid between them and the model's."""


@cache
def model(**changes: object) -> OpticalSystem:
    settings = {"monochromatic": 4.5e-6, "fov_pixels": 24, "npix": NPIX, **changes}
    return nircam_coronagraph("F444W", **settings)


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


def trial(scene: Scene = BRIGHT, system: OpticalSystem | None = None, **pins: object) -> Trial:
    here = system or model()
    return Trial(
        here,
        scene,
        torch.from_numpy(before()),
        {},
        prior=WavefrontPrior(),
        cycles=CYCLES[0],
        response_npix=64,
        share=0.0,
        budget=0.1,
        seed=0,
        pins=pins,
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
    choice = here.finest.changed({"npix": 128, "multifidelity": multifidelity})
    change = here.basis.opd(
        here.modes.draw(PROBED) * NANOMETRE, PupilGrid.full(NPIX, model().diameter)
    )
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
    assert here.rendering_error(choice, PROBED).rms == pytest.approx(expected, rel=0.1)


def test_the_worst_pixel_is_the_largest() -> None:
    here = trial()
    choice = here.finest.changed({"npix": 128})
    error = here.rendering_error(choice, START)
    assert error.worst > 2 * error.rms
    assert not Error(0.05, 2.0).inside(0.1)
    assert Error(0.05, 0.9).inside(0.1)


def test_expected_change_by_fine_modes_is_that_of_draws() -> None:
    here = trial()
    basis, cut = here.basis, 8.0
    truth = here.image(here.finest, START)
    grid = PupilGrid.full(NPIX, model().diameter)
    squares = []
    for seed in range(12):
        coefficients, _ = drawn(seed)
        fine = torch.where(basis.frequencies > cut, coefficients, 0.0)
        opd = torch.from_numpy(before()) + basis.opd(fine * NANOMETRE, grid)
        squares.append(here.target.in_sigma(model()(opd) - truth) ** 2)
    measured = float(torch.stack(squares).mean().sqrt())
    expected = here.target.error(here.modes.beyond(cut)).rms
    assert expected == pytest.approx(measured, rel=0.35)


def test_what_a_fit_leaves_is_that_of_ridge_regression(rng: np.random.Generator) -> None:
    slopes, seen = rng.normal(size=(7, 4, 5)), rng.normal(size=(3, 4, 5))
    found = Absorber(torch.from_numpy(slopes)).left(torch.from_numpy(seen), 5)
    rows, flat = slopes[:5].reshape(5, -1), seen.reshape(3, -1)
    covariance = np.eye(20) + rows.T @ rows
    expected = np.linalg.solve(covariance, flat.T).T.reshape(seen.shape)
    np.testing.assert_allclose(found.numpy(), expected, atol=1e-12)


def test_data_far_from_the_model_widen_the_prior() -> None:
    far = simulate(model(), FAINT, before() + 5 * drawn(1)[1].numpy(), seed=1)
    near = simulate(model(), FAINT, before(), seed=1)

    def scale(observation: Observation) -> float:
        return trial(observation).modes.scale  # type: ignore[arg-type]

    assert scale(far) > 2.0
    assert scale(near) < 1.0


# -- systems -------------------------------------------------------------------------------------


def test_quadrature_keeps_the_moments() -> None:
    given = filter_bandpass("F444W", 12)
    few = quadrature(given, 4)
    assert len(few.wavelengths) == 4
    assert min(given.wavelengths) < min(few.wavelengths)
    assert max(few.wavelengths) < max(given.wavelengths)
    for power in range(8):
        exact, found = (
            np.dot(band.weights, (np.array(band.wavelengths) / 4.4e-6) ** power)
            for band in (given, few)
        )
        assert found == pytest.approx(exact, rel=1e-10)
    assert quadrature(given, 12) is given
    assert quadrature(given, 1).wavelengths[0] == pytest.approx(given.mean_wavelength)


def test_a_cheap_system_keeps_its_wavelengths_in_copies() -> None:
    band = Bandpass((4.3e-6, 4.6e-6), (0.5, 0.5))
    cheap = CheapSystem(model(), band)
    assert coarse_copy(cheap, 64).bandpass == band
    assert coarse_npix(cheap, 64) == coarse_copy(cheap, 64).npix == 64
    alone = [model(monochromatic=wave)(before()) for wave in band.wavelengths]
    # The wedge tilt is relative to the mean wavelength of the system that was made.
    assert float((cheap(before()) - sum(alone) / 2).abs().max()) < 0.05 * float(alone[0].max())


def test_a_correction_is_exact_where_it_was_taken_and_not_in_copies() -> None:
    here = trial()
    choice = here.finest.changed({"npix": 128, "multifidelity": True})
    image, truth = here.image(choice, START), here.image(here.finest, START)
    assert float((image - truth).abs().max()) < 1e-12 * float(truth.max())
    copy, plain = (
        coarse_copy(here.system(choice.changed({"multifidelity": m})), 64) for m in (True, False)
    )
    small = downsample(torch.from_numpy(before()), 64)
    assert torch.equal(copy(small), plain(small))


def test_parts_that_may_be_left_out() -> None:
    sheared = model(shear=-0.0049)
    assert optional_parts(model()) == ()
    assert optional_parts(sheared) == ("shear",)
    straight = CheapSystem(sheared, without=("shear",))(before())
    assert float((straight - model()(before())).abs().max()) < 1e-9 * float(straight.max())
    with pytest.raises(IncompatibleSetupError, match="no optional part"):
        CheapSystem(model(), without=("shear",))


def test_detector_effects_may_be_left_out() -> None:
    plain = model().detector
    kernel = [[0, 0.01, 0], [0.01, 0.96, 0.01], [0, 0.01, 0]]
    shared = {
        n: getattr(plain, n) for n in ("shape", "pixelscale", "oversample", "dtype", "device")
    }
    chain = ChainDetector(
        **shared, on_samples=(GaussianBlur(0.3),), on_pixels=(PixelCrosstalk(kernel),)
    )
    system = OpticalSystem(model().entrance, model().planes, chain, model().bandpass)
    names = optional_parts(system)
    assert len(names) == 2
    bare = CheapSystem(system, without=names)(before())
    assert float((bare - model()(before())).abs().max()) < 1e-9 * float(bare.max())
    found = plan(system, BRIGHT, before(), cycles=(4.0,), response_npix=64)
    # A crosstalk of 4 % is many sigma of a bright star.
    assert found.choice.without == ()


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
    assert found.memory < 0.5 * found.memory_given


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
    assert found.refine_options == {"cycles": CYCLES, "response_npix": 128}
    with pytest.warns(DiffrenderWarning, match="more than the budget"):
        coarse = plan(
            model(),
            BRIGHT,
            before(),
            keep={"npix": 128, "multifidelity": False, "dtype": torch.float32},
            **SETTINGS,
        )
    assert coarse.model.npix == 128
    assert coarse.model.dtype == torch.float32


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"keep": {"pupil": 256}}, "nothing that a plan chooses"),
        ({"keep": {"npix": 100}}, "npix=100"),
        ({"keep": {"dtype": "int8"}}, "int8"),
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
    bare = OpticalSystem(model().entrance, model().planes, model().detector, model().bandpass)
    found = plan(bare, FAINT, before(), cycles=(4.0,))
    assert found.choice.npix == NPIX
    assert found.verified_error.rms <= found.budget


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
    assert "made finer by the verification" in str(found)


# -- in a fit ------------------------------------------------------------------------------------


def test_a_planned_fit_sees_the_same_planet_on_the_model_as_given() -> None:
    exact = refine(model(), frame(), before(), fidelity="as given", **SETTINGS)
    cheap = refine(model(), frame(), before(), fidelity=faint_plan(), **SETTINGS)
    assert exact.plan is None
    assert cheap.plan is not None
    assert not cheap.plan.abandoned
    assert cheap.plan.final_error is not None
    assert cheap.plan.final_error.inside(0.1)
    assert cheap.coefficients is not None
    assert exact.coefficients is not None
    assert len(cheap.coefficients) < 0.4 * len(exact.coefficients)
    # The contract: the given model, its grid, its star.
    assert cheap.model is model()
    assert cheap.opd.shape == (NPIX, NPIX)
    np.testing.assert_allclose(cheap.render(), cheap.star_image, rtol=1e-9)
    assert cheap.summary()["plan_npix"] == cheap.plan.choice.npix
    planet = [PLANET.offset]
    there, here = dr.measure(exact, planet)[0], dr.measure(cheap, planet)[0]
    assert abs(here["contrast"] - there["contrast"]) < 0.15 * there["contrast_error"]
    assert here["snr"] == pytest.approx(there["snr"], rel=0.05)


def test_refine_plans_by_itself_and_honours_what_it_was_told() -> None:
    settings = {**SETTINGS, "basis": default_basis(4.0), "max_iterations": 5}
    fit = refine(model(), frame(), before(), fidelity="planned", **settings)
    assert fit.plan is not None
    assert "cycles" in fit.plan.pinned
    assert len(fit.coefficients) == len(default_basis(4.0))  # type: ignore[arg-type]


def test_a_plan_that_fails_at_the_solution_is_abandoned(caplog: pytest.LogCaptureFixture) -> None:
    keep = {"npix": 128, "multifidelity": False, "cycles": 4.0}
    bright = frame(7200.0)
    with pytest.warns(DiffrenderWarning, match="more than the budget"):
        coarse = plan(model(), bright, before(), keep=keep, cycles=(4.0,), response_npix=64)
    settings = {"cycles": (4.0,), "response_npix": 64, "max_iterations": 6}
    fit = refine(model(), bright, before(), fidelity=coarse, **settings)
    assert fit.plan is not None
    assert fit.plan.abandoned
    assert "goes on with the model as given" in caplog.text
    assert "as given" in str(fit.plan)
    assert fit.opd.shape == (NPIX, NPIX)
    np.testing.assert_allclose(fit.render(), fit.star_image, rtol=1e-6)


def test_pixels_that_say_nothing_stay_in_the_detection() -> None:
    scene = replace(FAINT, star=Star(exposure=2.0), planets=(replace(PLANET, contrast=1e-3),))
    later = before() + random_drift(6, 40.0, npix=NPIX).data
    observation = simulate(model(), scene, later, seed=1)
    settings = {"cycles": (8.0,), "response_npix": 64}
    few = plan(model(), observation, before(), keep={"pixels": 0.05, "npix": NPIX}, **settings)
    assert 0 < few.informative.sum() < few.informative.size
    both = [
        refine(model(), observation, before(), fidelity=how, **settings)
        for how in ("as given", few)
    ]
    there, here = (dr.measure(fit, [PLANET.offset])[0] for fit in both)
    assert abs(here["contrast"] - there["contrast"]) < 0.15 * there["contrast_error"]
    linear = both[1].linear
    assert linear is not None
    weights = linear.frames[0].weight
    assert bool((weights > 0).all())


def test_bad_fidelity_is_refused() -> None:
    with pytest.raises(IncompatibleSetupError, match="'planned'"):
        refine(model(), frame(), before(), fidelity="cheap")
    with pytest.raises(IncompatibleSetupError, match="made for"):
        refine(model(npix=128), frame(), before(), fidelity=faint_plan())
    with pytest.raises(IncompatibleSetupError, match="as given"):
        refine(model(), frame(), before(), method="adam", fidelity="planned")


def test_a_simulated_star_is_that_of_the_scene() -> None:
    here = trial(replace(FAINT, background=100.0))
    expected = np.sqrt(star_photons(model(), FAINT, before()) + 100.0 + FAINT.read_noise**2)
    np.testing.assert_allclose(here.target.sigma.numpy(), expected)
