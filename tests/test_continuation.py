"""Fits that go on from one another: a plan that is given up, more modes, other settings."""

from __future__ import annotations

import itertools
import math
import warnings
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
import torch

import pyklip_diffrender as dr
from pyklip_diffrender.errors import DiffrenderWarning, IncompatibleSetupError
from pyklip_diffrender.optics.grid import PupilGrid
from pyklip_diffrender.optics.system import OpticalSystem
from pyklip_diffrender.planning import Plan
from pyklip_diffrender.refinement import GaussNewton, Refinement, Status, refine_again
from pyklip_diffrender.refinement import continuation as continuation_module
from pyklip_diffrender.refinement.annealing import Annealing
from pyklip_diffrender.scene.objects import Planet
from pyklip_diffrender.scene.observation import Observation
from pyklip_diffrender.wavefront.bases import FourierModes, default_basis
from pyklip_diffrender.wavefront.opd import random_opd
from pyklip_diffrender.wavefront.priors import WavefrontPrior

NPIX, SIZE, FLUX, READ_NOISE = 128, 24, 2e9, 42.0
OFFSET = (0.002, -0.001)
CYCLES = (4.0, 6.0)
PLANET = Planet(2e-3, 0.6, 30.0)
ROLL = 10.0


@cache
def model() -> OpticalSystem:
    return dr.nircam_coronagraph("F444W", monochromatic=4.5e-6, npix=NPIX, fov_pixels=SIZE)


@cache
def before() -> np.ndarray:
    return random_opd(3, npix=NPIX).data


@cache
def later() -> np.ndarray:
    """Moved by modes that both bases have."""
    basis = default_basis(CYCLES[0])
    generator = torch.Generator().manual_seed(1)
    size = torch.where(basis.frequencies == 0, 1.0, 0.3)
    change = size * torch.randn(len(basis), dtype=torch.float64, generator=generator)
    return before() + basis.opd(1e-9 * change, PupilGrid.full(NPIX)).numpy()


@cache
def star(offset: tuple[float, float] = OFFSET) -> np.ndarray:
    return FLUX * model()(later(), offset).numpy()


@cache
def shot(k: int = 0, planet: Planet | None = None) -> Observation:
    """A frame; later ones are rolled."""
    expected = star()
    if planet is not None:
        turned = replace(planet, position_angle=planet.position_angle - k * ROLL)
        expected = expected + turned.contrast * star(tuple(np.add(OFFSET, turned.offset)))
    rng = np.random.default_rng(20 + k)
    counts = rng.poisson(expected) + rng.normal(0, READ_NOISE, expected.shape)
    return Observation.from_arrays(
        counts,
        np.sqrt(np.maximum(counts, 0) + READ_NOISE**2),
        pixelscale=model().detector.pixelscale,
        position_angles=np.array([k * ROLL]),
        name=f"roll {k}",
    )


@cache
def coarse_plan() -> Plan:
    """Half of the pupil samples: the star is off by 0.8 sigma rms, and fits still converge."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DiffrenderWarning)
        return dr.plan(
            model(),
            shot(),
            before(),
            keep={"npix": NPIX // 2, "cycles": CYCLES[0], "multifidelity": False},
            cycles=CYCLES,
            response_npix=64,
        )


def settings(**changes: object) -> GaussNewton:
    return GaussNewton(**{"cycles": CYCLES, "response_npix": 64, **changes})  # type: ignore[arg-type]


def pulls(fit: Refinement, k: int) -> np.ndarray:
    """Error of the fitted star in frame k, in sigma."""
    return (fit.frames[k].star - star()) / np.sqrt(star() + READ_NOISE**2)


# -- plans ---------------------------------------------------------------------------------------

QUICK = ((False, False, None, 2), (True, True, None, 1))
"""The others need ``--full``."""

BRANCHES = [
    pytest.param(*branch, marks=[] if branch in QUICK else [pytest.mark.slow])
    for branch in itertools.product((False, True), (False, True), (None, PLANET), (1, 2))
]


@pytest.mark.parametrize(("abandoned", "grown", "planet", "count"), BRANCHES)
def test_every_way_a_planned_fit_can_end(
    monkeypatch: pytest.MonkeyPatch,
    abandoned: bool,
    grown: bool,
    planet: Planet | None,
    count: int,
) -> None:
    """Plan kept or given up, basis grown or not, a companion found or not, one frame or two."""
    monkeypatch.setattr(Plan, "allows", lambda plan, error: not abandoned)
    monkeypatch.setattr(continuation_module, "_STRUCTURE", 0.0 if grown else math.inf)
    bases = []

    class Recording(Annealing):
        def __init__(self, *args: Any) -> None:
            super().__init__(*args)
            bases.append((self.problems[0].model.npix, len(self.basis)))

    monkeypatch.setattr(continuation_module, "Annealing", Recording)
    frames = [shot(k, planet) for k in range(count)]
    fit = dr.refine(model(), frames, before(), settings=settings(), plan=coarse_plan())
    few, many = (len(default_basis(cycles)) for cycles in CYCLES)
    # What went on, went on with the basis that was reached.
    assert bases == [
        (NPIX // 2, few),
        *([(NPIX // 2, many)] if grown else []),
        *([(NPIX, many if grown else few)] if abandoned else []),
    ]
    assert fit.status is Status.CONVERGED
    assert fit.plan is not None
    assert fit.plan.abandoned is abandoned
    assert fit.plan.final_error is not None
    assert 0.3 < fit.plan.final_error.rms < 3
    assert len(fit.basis) == bases[-1][1]  # type: ignore[arg-type]
    assert isinstance(fit.settings, GaussNewton)
    assert fit.settings.cycles == CYCLES[grown:]
    assert len(fit.companions) == (planet is not None)
    if planet is not None:
        ((contrast, *place),) = fit.companions
        error = fit.companion_errors[0]
        # The derivatives of two frames come from coarser copies than those of one.
        assert abs(contrast - planet.contrast) < 4 * error[0] + 0.03 * planet.contrast
        assert np.abs(np.array(place) - planet.offset).max() < 0.005
    for k, frame in enumerate(fit.frames):
        # On the model as given, wherever the fit was done.
        assert frame.model is model()
        assert frame.opd.shape == (NPIX, NPIX)
        np.testing.assert_allclose(frame.render(), frame.star, rtol=1e-9)
        # The coarse star was 0.8 sigma off; what was fitted to it is not much further.
        assert np.sqrt(np.mean(pulls(fit, k) ** 2)) < (0.6 if abandoned else 1.5)
    assert len(fit.linear.vector) == len(fit.linear.unknowns)
    again = refine_again(fit, max_iterations=4)
    assert len(again.basis) == len(fit.basis)  # type: ignore[arg-type]
    assert len(again.companions) == len(fit.companions)
    assert again.frames[0].opd.shape == (NPIX, NPIX)
    assert len(dr.measure(fit, [[0.3, -0.5]])) == 1


@pytest.mark.slow
def test_drifts_and_a_known_companion_go_on_when_a_plan_is_given_up(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(Plan, "allows", lambda plan, error: False)
    drift = WavefrontPrior(scales={"segment": 0.5, "texture": 0.02})
    fit = dr.refine(
        model(),
        [shot(k, PLANET) for k in range(2)],
        before(),
        settings=settings(cycles=4.0, drift=drift, drift_cycles=2.0, companions=(PLANET,)),
        plan=coarse_plan(),
    )
    assert fit.status is Status.CONVERGED
    assert fit.plan is not None
    assert fit.plan.abandoned
    assert isinstance(fit.settings, GaussNewton)
    assert fit.settings.drift is not None
    # The scales of both priors went on from where the planned fit had left them.
    assert fit.settings.drift.scales != drift.scales
    assert set(fit.scales) == {"segment", "texture", "segment drift", "texture drift"}
    ((contrast, *_),) = fit.companions
    assert contrast == pytest.approx(PLANET.contrast, rel=0.03)


@pytest.mark.parametrize("allowed", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_a_companion_can_be_added_to_a_planned_fit(
    monkeypatch: pytest.MonkeyPatch, allowed: bool
) -> None:
    monkeypatch.setattr(Plan, "allows", lambda plan, error: allowed)
    faint = replace(PLANET, contrast=3e-4)
    kept = settings(companions_if_stalled=False, grow_basis=False, cycles=4.0)
    fit = dr.refine(model(), shot(0, faint), before(), settings=kept, plan=coarse_plan())
    assert not len(fit.companions)
    again = refine_again(fit, companions=(faint,))
    assert len(again.companions) == 1
    assert abs(again.companions[0, 0] - 3e-4) < 4 * again.companion_errors[0, 0]
    assert again.chi2_per_pixel < fit.chi2_per_pixel
    assert again.frames[0].model is model()
    # A plan that was given up is not tried again.
    assert (again.plan is not None) == allowed


@pytest.mark.slow
def test_a_planned_fit_that_fails_is_on_the_model_as_given() -> None:
    dark = replace(shot(), data=-shot().data)
    fit = dr.refine(model(), dark, before(), settings=settings(), plan=coarse_plan())
    assert fit.status is Status.DIVERGED
    assert fit.frames[0].model is model()
    assert fit.frames[0].opd.shape == (NPIX, NPIX)
    with pytest.raises(IncompatibleSetupError, match="the fit failed"):
        dr.detect(fit)


# -- other settings ------------------------------------------------------------------------------


@pytest.mark.parametrize("change", [{}, {"wavefront": False}], ids=["wavefront", "alignment"])
def test_a_fit_with_a_basis_of_its_own_can_go_on(change: dict[str, bool]) -> None:
    """A basis without segments: the prior of those stays as it was."""
    own = settings(basis=FourierModes(3), max_iterations=6, **change)
    fit = dr.refine(model(), shot(), before(), settings=own)
    assert fit.plan is None
    again = refine_again(fit, wavefront=True, max_iterations=12)
    assert again.chi2_per_pixel < 1.001 * fit.chi2_per_pixel
    assert isinstance(again.settings, GaussNewton)
    scales = again.settings.prior.scales
    assert scales["segment"] == own.prior.scales["segment"]
    assert scales["texture"] == fit.scales["texture"]
    # It began where the other had ended.
    if not change:
        first = again.history[0]["chi2_per_pixel"]
        assert first == pytest.approx(fit.chi2_per_pixel, rel=0.01)
        assert first < 0.9 * fit.history[0]["chi2_per_pixel"]


def test_a_fit_goes_on_from_where_it_ended() -> None:
    """With a smallest error of the model, and a pattern in the frame that no wavefront explains."""
    rng = np.random.default_rng(9)
    frame = shot()
    frame = replace(frame, data=frame.data * (1 + 0.05 * rng.normal(size=frame.data.shape)))
    settings = GaussNewton(
        basis=default_basis(CYCLES[0]), response_npix=64, min_model_error=0.002, robust=4.0,
        companions_if_stalled=False,
        prior=WavefrontPrior({"segment": 10.0, "texture": 6.0}, fit_scales=False),
    )  # fmt: skip
    fit = dr.refine(model(), frame, before(), settings=settings, plan="off")
    assert fit.status is Status.MODEL_MISMATCH
    kappas = [step["kappa"] for step in fit.history]
    assert kappas[0] > 0.05
    assert kappas[-1] == 0.002
    again = refine_again(fit)
    assert {step["kappa"] for step in again.history} == {0.002}
    assert len(again.history) < len(fit.history) / 2
    assert again.chi2_per_pixel == pytest.approx(fit.chi2_per_pixel, rel=0.02)


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        ({"plan": "cheap"}, r"plan: got 'cheap', expected 'auto', 'off' or a Plan"),
        ({"settings": "gauss-newton"}, r"settings: got a str, expected GaussNewton"),
        ({"start": [{}, {}, {}]}, r"start: got 3 dicts for 2 observations"),
    ],
)
def test_arguments_that_do_not_go_together_are_refused(
    arguments: dict[str, object], complaint: str
) -> None:
    with pytest.raises(ValueError, match=complaint):
        dr.refine(model(), [shot(0), shot(1)], before(), **arguments)  # type: ignore[arg-type]


def test_a_plan_for_something_else_is_refused() -> None:
    other = model().with_fidelity(npix=NPIX // 2)
    with pytest.raises(IncompatibleSetupError, match="plan: it was made for"):
        dr.refine(other, shot(), before(), plan=coarse_plan())
    with pytest.raises(IncompatibleSetupError, match="order of the arguments"):
        dr.refine(before(), shot(), model())  # type: ignore[arg-type]


BAD: Sequence[tuple[dict[str, object], str]] = [
    ({"cycles": ()}, r"cycles: got none, expected at least one, such as 24"),
    ({"cycles": (24.0, -1.0)}, r"cycles: got \(24\.0, -1\.0\), expected positive"),
    ({"cycles": math.nan}, r"cycles: got \(nan,\), expected positive"),
    ({"cycles": "fine"}, r"cycles: got .fine., expected a number"),
    ({"free": "flux"}, r"free: got the text 'flux', expected a tuple .*\('flux',\)"),
    ({"own": "flux"}, r"own: got the text 'flux'"),
    ({"max_iterations": 0}, r"max_iterations: got 0, expected a positive"),
    ({"tolerance": -1e-3}, r"tolerance: got -0\.001, expected a positive"),
    ({"robust": 0.0}, r"robust: got 0\.0, expected a positive"),
    ({"relinearise": math.nan}, r"relinearise: got nan"),
    ({"response_npix": -64}, r"response_npix: got -64"),
    ({"min_model_error": -0.01}, r"min_model_error: got -0\.01, expected 0 or more"),
    ({"min_model_error": math.nan}, r"min_model_error: got nan, expected 0 or more"),
    ({"accurate_steps": 0.1}, r"accurate_steps: got 0\.1, expected True or False"),
    ({"grow_basis": None}, r"grow_basis: got None, expected True or False"),
    ({"max_companions": -1}, r"max_companions: got -1, expected 0 or more"),
    ({"companion_threshold": 0.0}, r"companion_threshold: got 0\.0, expected a positive"),
    ({"drift_cycles": -8.0}, r"drift_cycles: got -8\.0, expected a positive"),
    ({"companions": ((1e-5, 0.5, 0.3),)}, r"companions: got .*expected Planets.*from_offset"),
    ({"free": (), "wavefront": False}, r"nothing to fit.*wavefront=True"),
]


@pytest.mark.parametrize(("changes", "complaint"), BAD)
def test_settings_that_cannot_be_are_refused_when_they_are_made(
    changes: dict[str, object], complaint: str
) -> None:
    with pytest.raises(IncompatibleSetupError, match=complaint):
        GaussNewton(**changes)  # type: ignore[arg-type]
    with pytest.raises(IncompatibleSetupError, match=complaint):
        GaussNewton.nircam(**changes)


def test_modes_of_the_preset_reach_the_edge_of_the_fitted_square() -> None:
    expected = {"F444W": 18, "F480M": 16, "F356W": 22, "F250M": 32, "F210M": 18}
    for name, cycles in expected.items():
        assert GaussNewton.nircam(name).cycles == (cycles,)
    assert GaussNewton.nircam() == GaussNewton.nircam("F444W")
    for name in ("F44W", "CLEAR", ""):
        with pytest.raises(IncompatibleSetupError, match=r"filter: got .*F444W"):
            GaussNewton.nircam(name)


@pytest.mark.parametrize("cycles", [6, 6.0, (6,), [6.0], np.float64(6)])
def test_a_single_number_of_cycles_will_do(cycles: object) -> None:
    made = GaussNewton(cycles=cycles, free=["flux"], companions=[PLANET])  # type: ignore[arg-type]
    assert made == GaussNewton(cycles=(6.0,), free=("flux",), companions=(PLANET,))
    assert GaussNewton.nircam(cycles=cycles).cycles == (6.0,)  # type: ignore[arg-type]
