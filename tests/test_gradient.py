"""Derivatives of a fit through the model itself, and accurate steps with them."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

import pyklip_diffrender as dr
from pyklip_diffrender.optics.grid import PupilGrid
from pyklip_diffrender.refinement import FitSettings
from pyklip_diffrender.refinement.accurate_steps import ModelDerivatives, conjugate_gradients
from pyklip_diffrender.refinement.equations import EquationsCache
from pyklip_diffrender.refinement.forward import Forward, FrameDerivatives, Problem, allowance
from pyklip_diffrender.refinement.solver import Solver, StepState
from pyklip_diffrender.scene.detector_pattern import DetectorPattern
from pyklip_diffrender.wavefront import WavefrontPrior
from pyklip_diffrender.wavefront.bases import default_basis

NPIX, SIZE = 64, 32
BASIS = default_basis(3.0)
FREE = ("star_offset", "lyot_shift", "lyot_rotation", "blur", "flux", "background")
SCALES = {"segment": 20.0, "texture": 20.0}


@cache
def solver_of(frames, nlambda=3, **changes):
    """A solver and a state far from the solution, for frames of the same pixels with a pattern."""
    rng = np.random.default_rng(4)
    model = dr.nircam_coronagraph("F444W", nlambda=nlambda, npix=NPIX, fov_pixels=SIZE)
    opd = dr.wavefront.random_opd(3, npix=NPIX)
    zeros = np.zeros((SIZE, SIZE))
    pattern = DetectorPattern(
        zeros, zeros + 0.02, (SIZE / 2, SIZE / 2), 0.02, first_pixel=(600, 1600)
    )
    problems = []
    for _ in range(frames):
        data = 1e9 * model(opd.data).numpy() * (1 + 0.1 * rng.normal(size=(SIZE, SIZE)))
        error = np.sqrt(np.abs(data)) + 40.0
        seen = dr.Observation.from_arrays(data, error, pixelscale=model.detector.pixelscale)
        seen = replace(seen, first_pixel=(600, 1600))
        problems.append(Problem(model, seen, opd, pattern=pattern))
    # The copy is far coarser than the model, at one of its wavelengths.
    coarse = {"response_npix": 32, "response_wavelengths": 1}
    prior = WavefrontPrior(SCALES, fit_scales=False, amplitude_cycles=2.0, amplitude_scale=2.0)
    settings = FitSettings(free=FREE, basis=BASIS, prior=prior, **coarse, **changes)
    solver = Solver(problems, settings, BASIS, progress=False)
    priors = solver.priors_of(settings)
    unknowns = solver.first_unknowns(priors)
    vector = unknowns.initial()
    deviation = solver.prior_deviation(unknowns, priors)
    moves = torch.where(torch.isfinite(deviation), deviation, 0.0).clamp(max=5.0)
    moved = torch.from_numpy(rng.normal(size=len(vector)))
    return solver, solver.objective.at(unknowns, vector + 0.1 * moves * moved)


def gradient(solver, state, *, exact):
    """Minus half the derivative of chi-squared."""
    if exact:
        weights = solver.objective.errors(state, 0.01, 4.0)
        return ModelDerivatives(solver.objective, state, weights).gradient()
    equations = solver.equations.about(state, 0.01, len(BASIS), 4.0, 0.05)
    return equations.gradient - equations.curvature @ equations.current


def slope_along(solver, state, direction, step=1e-4):
    """Minus half the derivative of chi-squared along a direction, by differences."""
    objective = solver.objective
    weights = objective.errors(state, 0.01, 4.0)
    ahead, behind = (
        objective.chi2(objective.at(state.unknowns, state.vector + each * direction), weights)
        for each in (step, -step)
    )
    return -(ahead - behind) / (4 * step)


def units(solver, state):
    """Prior deviations of the unknowns, and values of those without one."""
    unit = solver.prior_deviation(state.unknowns, solver.priors_of(solver.settings))
    return torch.where(torch.isfinite(unit), unit, state.vector.abs()).clamp(max=1e6)


def slopes_by_name(solver, state):
    """A random direction within each group of unknowns, and the slope along it by differences."""
    names = [unknown.name for unknown in state.unknowns.labels()]
    assert {*FREE, "amplitude", "modes"} <= set(names)
    rng = np.random.default_rng(5)
    for name in (*FREE, "amplitude", "modes"):
        which = torch.tensor([each == name for each in names])
        direction = units(solver, state) * torch.from_numpy(rng.normal(size=len(names))) * which
        yield name, direction, slope_along(solver, state, direction)


@pytest.mark.parametrize("frames", [pytest.param(1, marks=pytest.mark.slow), 2])
def test_the_gradient_is_that_of_chi_squared(frames):
    """Against differences of chi-squared, which have an error of 1e-7 of it in these steps."""
    solver, state = solver_of(frames)
    assert solver.objective.shares_pattern == (frames > 1,) * frames
    exact, coarse = (gradient(solver, state, exact=value) for value in (True, False))
    for name, direction, slope in slopes_by_name(solver, state):
        np.testing.assert_allclose(float(exact @ direction), slope, rtol=1e-4, err_msg=name)
        if name == "modes":
            # The coarse one does not pass this test, or there would be no need of the other.
            assert abs(float(coarse @ direction) - slope) > 1e-2 * abs(slope)


def of_the_model_itself(solver):
    """A solver whose coarse copy is the model."""
    settings = replace(solver.settings, response_npix=NPIX, response_wavelengths=9)
    problems = [forward.problem for forward in solver.objective.forwards]
    return Solver(problems, settings, BASIS, progress=False)


@pytest.mark.parametrize("contrast", [3e-4, 0.05])
def test_the_gradient_with_a_companion_is_that_of_chi_squared(contrast):
    """Their images are those of the coarse copy, which is the model in this test.

    The light of a bright one, which outshines the star, depends on all unknowns. Neglected, the
    gradient would be wrong by more than its size.
    """
    coarse, state = solver_of(2)
    solver = of_the_model_itself(coarse)
    companion = dr.Planet(contrast, 0.4, 20.0)
    state = solver.objective.at(*state.unknowns.with_companions([companion], state.vector))
    exact = gradient(solver, state, exact=True)
    where = state.unknowns.where("companions")
    for place, step in zip(range(where.start, where.stop), (1e-6, 1e-4, 1e-4), strict=True):
        moved = torch.zeros(state.unknowns.size, dtype=torch.float64)
        moved[place] = 1.0
        slope = slope_along(solver, state, moved, step)
        np.testing.assert_allclose(float(exact[place]), slope, rtol=1e-3)
    if contrast < 0.01:
        return
    point, copied = state.points[0], gradient(solver, state, exact=False)
    assert (point.total - point.star).sum() > point.light.sum()
    for name, direction, slope in slopes_by_name(solver, state):
        for each in (exact, copied):
            np.testing.assert_allclose(float(each @ direction), slope, rtol=2e-3, err_msg=name)


def test_the_curvature_is_that_of_the_model_whatever_the_copy():
    """Against the equations of a copy that is the model; those of a coarse one are far from it.

    The curvature has five of the nine wavelengths.
    """
    solver, state = solver_of(2, nlambda=9)
    rng = np.random.default_rng(6)
    unit = units(solver, state)
    step = 0.01 * unit * torch.from_numpy(rng.normal(size=len(unit)))
    curved, products = [], []
    for each in (solver, of_the_model_itself(solver)):
        weights = each.objective.errors(state, 0.01, 4.0)
        equations = each.equations.about(state, 0.01, len(BASIS), 4.0, 0.05)
        curved.append(unit * ModelDerivatives(each.objective, state, weights).product(step))
        products.append(unit * (equations.curvature @ step))
    coarse, expected = products
    for each in curved:
        assert (each - expected).norm() < 2e-3 * expected.norm()
    assert (coarse - expected).norm() > 0.1 * expected.norm()


def test_the_curvature_along_the_flux_counts_faint_companions():
    """All light of the frame is in proportion to the flux."""
    solver, state = solver_of(1, nlambda=9)
    companion = dr.Planet(9e-5, 0.4, 20.0)
    state = solver.objective.at(*state.unknowns.with_companions([companion], state.vector))
    (point,) = state.points
    assert not point.unknowns.are_bright(point.vector).any()
    where = state.unknowns.where("flux")
    step = torch.zeros(state.unknowns.size, dtype=torch.float64)
    step[where] = 0.01 * state.vector[where]
    noise = solver.objective.errors(state, 0.01, 4.0)
    background = point.unknowns.level("background", point.vector)
    light = 0.01 * (point.total - background)
    expected = float((light * noise.weight[0] * noise.inverse({0: light})[0]).sum())
    curved = float(step @ ModelDerivatives(solver.objective, state, noise).product(step))
    assert curved == pytest.approx(expected, rel=1e-3)


def with_errors(equations, errors):
    """Equations whose derivatives have other errors."""
    each = zip(equations.derivatives, errors, strict=True)
    return replace(equations, derivatives=tuple(replace(d, error=error) for d, error in each))


def test_derivatives_at_the_same_state_are_used_again(monkeypatch):
    """Those of each frame that are accurate enough, with new ones by companions."""
    solver, state = solver_of(2)
    cache, arguments = solver.equations, (0.01, len(BASIS), 4.0)
    equations = cache.about(state, *arguments, 0.05)
    unknowns, vector = state.unknowns, state.vector
    added = unknowns.with_companions([dr.Planet(3e-5, 0.4, 20.0)], vector)
    later, moved = solver.objective.at(*added), solver.objective.at(unknowns, 1.01 * vector)
    fresh = EquationsCache(solver.objective, solver.objective.forwards[0].responses)
    expected = fresh.about(later, *arguments, 0.05)
    computed, compute = [], FrameDerivatives.at.__func__

    def counted(cls, forward, *others):
        computed.append(solver.objective.forwards.index(forward))
        return compute(cls, forward, *others)

    monkeypatch.setattr(FrameDerivatives, "at", classmethod(counted))
    for errors, new in (((0.03, 0.05), []), ((0.0, 0.06), [1])):
        cache.last, computed[:] = with_errors(equations, errors), []
        again = cache.about(later, *arguments, 0.05)
        assert computed == new
        assert again.derivatives[0].error == errors[0]
        torch.testing.assert_close(again.curvature, expected.curvature)
        torch.testing.assert_close(again.gradient, expected.gradient)
    cache.about(moved, *arguments, 0.05)
    assert computed == [1, 0, 1]


def test_only_frames_of_a_reference_star_may_have_rougher_derivatives():
    solver, state = solver_of(2)
    rough = solver.equations.about(state, 0.01, len(BASIS), 4.0, 0.05)
    forward = solver.objective.forwards[1]
    problem = replace(forward.problem)
    problem.observation = replace(problem.observation, reference=True)
    for each, is_within in ((forward, False), (Forward(problem, forward.responses), True)):
        other = replace(rough.derivatives[1], error=0.04, allowance=allowance(each))
        changed = replace(rough, derivatives=(rough.derivatives[0], other))
        assert changed.is_within(0.01) == is_within


@pytest.mark.parametrize(("earlier", "is_slow"), [(1.1, True), (2.0, False), (0.9, False)])
def test_slow_steps_are_followed_by_accurate_ones(earlier, is_slow):
    """Their gain is nearly that of the step before, with derivatives of another state."""
    solver, state = solver_of(1, accurate_steps=True)

    def step(carried):
        equations = solver.equations.about(state, 0.01, len(BASIS), 4.0, 0.05)
        solver.equations.last = with_errors(equations, (0.01,))
        return solver._quick_step(state, carried, 0.01, len(BASIS), may_repeat=True)

    begun = StepState(solver.priors_of(solver.settings))
    _, gain, carried = step(begun)
    assert gain > 0
    assert not carried.needs_accurate
    assert step(replace(begun, gain=earlier * gain))[2].needs_accurate == is_slow


def test_the_last_step_is_an_accurate_one():
    """One whose gain would end the fit is followed by one with derivatives of the model itself."""
    solver, state = solver_of.__wrapped__(1, accurate_steps=True)  # Its settings change.
    arguments = state, StepState(solver.priors_of(solver.settings)), 0.01, len(BASIS)
    quick = solver.step(*arguments)
    assert not quick.carried.needs_accurate
    solver.settings = replace(solver.settings, tolerance=(1 + 1e-9) * quick.gain)
    last = solver.step(*arguments)
    assert last.carried.needs_accurate
    assert last.gain < quick.gain


def test_a_step_that_gains_little_with_earlier_derivatives_is_not_the_last():
    """Earlier ones may not see the direction in which the most is to gain."""
    solver, state = solver_of.__wrapped__(1, accurate_steps=True)  # Its settings change.
    carried = StepState(solver.priors_of(solver.settings))

    def step(tolerance):
        other = solver.objective.at(state.unknowns, 1.01 * state.vector)
        equations = solver.equations.about(other, 0.01, len(BASIS), 4.0, 0.05)
        stiff = 1e12 * equations.curvature.diagonal()
        stiff[state.unknowns.where("background")] = 0.0
        curvature = equations.curvature + torch.diag(stiff)
        solver.equations.last = replace(equations, curvature=curvature)
        solver.settings = replace(solver.settings, tolerance=tolerance)
        return solver._accurate_step(state, carried, 0.01, len(BASIS))

    gain = step(1e-12).gain
    assert gain > 0
    taken = step(2 * gain)
    assert taken.gain > 1.3 * gain
    noise = solver.objective.errors(state, 0.01, solver.objective.robust)
    before, after = (solver._cost(each, noise, carried.priors) for each in (state, taken.state))
    assert (before - after) / solver.objective.pixels == pytest.approx(taken.gain)


def test_a_marginal_flux_counts_the_volume_of_the_wavefront():
    """The penalty is n log F, which steps know, so that the star is fainter."""
    solver, state = solver_of(2)
    plain = solver.priors_of(solver.settings)
    counted, noise = replace(plain, determined=5e3), solver.objective.errors(state, 0.01, 4.0)
    gradient = solver._volume_gradient(state, counted, state.unknowns.size)
    step = 1e-4 * state.vector * (gradient != 0)
    ahead = solver.objective.at(state.unknowns, state.vector + step)
    before, after = (
        solver._cost(each, noise, counted) - solver._cost(each, noise, plain)
        for each in (state, ahead)
    )
    assert after - before == pytest.approx(5e3 * np.log(1.0001), rel=1e-3)
    assert float(-2 * gradient @ step) == pytest.approx(after - before, rel=1e-3)
    taken = [solver.step(state, StepState(each), 0.01, len(BASIS)) for each in (plain, counted)]
    assert 0.5 * taken[0].state.flux < taken[1].state.flux < 0.99 * taken[0].state.flux


def test_a_long_step_of_flux_and_wavefront_stays_in_the_same_light():
    """A brighter star with a smaller wavefront: the step begins along states of the same light."""
    solver, state = solver_of(2)
    unknowns, change = state.unknowns, 0.3
    scattering = state.vector.clone()
    scattering[unknowns.where("modes")] += solver._modes_of_map
    problem = solver.objective.forwards[0].problem
    grid = PupilGrid.full(NPIX, problem.model.diameter)
    opd = torch.from_numpy(problem.initial.data)
    found = 1e-9 * BASIS.opd(solver._modes_of_map, grid)
    # What the few modes of this basis have of the map.
    assert 0.3 < float((opd * found).sum() / opd.square().sum()) < 1
    begin = unknowns.where("amplitude").start
    step = torch.zeros_like(state.vector)
    step[begin:] = -change / 2 * scattering[begin:]
    for frame, part in zip(unknowns.frames, unknowns.rows, strict=True):
        place = part.rows[frame.where("flux")]
        step[place] = change * state.vector[place]
    moved = solver._moved(state, step)
    assert moved.flux / state.flux == pytest.approx(1 + change)
    torch.testing.assert_close(
        moved.vector[begin:] - state.vector[begin:] + scattering[begin:],
        scattering[begin:] / np.sqrt(1 + change),
    )
    # A short step is as long as it was.
    short = solver._moved(state, 1e-3 * step).vector - state.vector
    torch.testing.assert_close(short, 1e-3 * step, rtol=1e-3, atol=1e-12)


def test_conjugate_gradients_lower_the_function_however_poor_the_preconditioner():
    """And end without a step where there is nothing to gain."""
    rng = np.random.default_rng(9)
    root = torch.from_numpy(rng.normal(size=(30, 30)))
    matrix = root @ root.T
    gradient = torch.from_numpy(rng.normal(size=30))
    x, settled = conjugate_gradients(lambda x: matrix @ x, lambda x: 1e6 * x, gradient)
    assert not settled
    assert float(x @ matrix @ x - 2 * gradient @ x) < 0
    zero = torch.zeros(30, dtype=torch.float64)
    x, settled = conjugate_gradients(lambda x: matrix @ x, lambda x: x, zero)
    assert settled
    assert not x.any()


@pytest.mark.parametrize("accurate", [False, True])
def test_a_step_depends_on_its_arguments_alone(accurate):
    """Not on the steps before it: what these hand on is an argument."""
    solver, state = solver_of(1, relinearise=1e-9, accurate_steps=accurate)
    first = StepState(solver.priors_of(solver.settings), damping=0.3, kappa=0.1)
    once = solver.step(state, first, 0.02, len(BASIS))
    assert once.gain > 0
    # A step along which the damping, the weights and the accuracy change.
    solver.step(once.state, replace(first, needs_accurate=True), 0.1, 0)
    again = solver.step(state, first, 0.02, len(BASIS))
    assert torch.equal(again.state.vector, once.state.vector)
    assert (again.gain, again.carried.damping) == (once.gain, once.carried.damping)
    assert again.carried.needs_accurate == once.carried.needs_accurate
    assert first == StepState(first.priors, damping=0.3, kappa=0.1)
    # What is handed on counts.
    damped = solver.step(state, replace(first, damping=30.0), 0.02, len(BASIS))
    assert not torch.equal(damped.state.vector, once.state.vector)
