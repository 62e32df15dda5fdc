"""Refinement of a small system: what it recovers, what it must not look at, how it ends."""

from __future__ import annotations

import pickle
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from scipy import optimize

from pyklip_diffrender.errors import (
    DiffrenderWarning,
    IncompatibleSetupError,
    MissingOPDError,
    NonFiniteError,
    RefinementError,
    ShapeError,
)
from pyklip_diffrender.instrument.jwst import maskrnd_openings
from pyklip_diffrender.instrument.nircam import nircam_coronagraph
from pyklip_diffrender.optics.grid import PupilGrid, polygon_coverage
from pyklip_diffrender.optics.system import OpticalSystem
from pyklip_diffrender.refinement import GaussNewton, Status, refine
from pyklip_diffrender.refinement.fit_result import breakdown_explained
from pyklip_diffrender.scene.observation import Observation
from pyklip_diffrender.wavefront.bases import (
    FourierModes,
    JointBasis,
    SegmentMotions,
    default_basis,
)
from pyklip_diffrender.wavefront.opd import random_opd
from pyklip_diffrender.wavefront.priors import WavefrontPrior

NPIX = 128
FLUX = 3e11
BACKGROUND = 500.0
READ_NOISE = 42.0
ALIGNMENT = {"star_offset": (0.008, -0.006), "lyot_shift": (0.006, -0.004), "lyot_rotation": 0.3}
BASIS = JointBasis([SegmentMotions(), FourierModes(6)])
FEW = FourierModes(3)


@dataclass
class Case:
    """A model, an old wavefront, and one frame of a star under a later wavefront."""

    model: OpticalSystem
    opd: np.ndarray
    later: np.ndarray
    star: np.ndarray
    observation: Observation

    @property
    def noise(self):
        return np.sqrt(self.star + BACKGROUND + READ_NOISE**2)

    def error_of(self, star_and_background):
        """Rms of a star model's error in units of the noise."""
        away = (star_and_background - BACKGROUND - self.star) / self.noise
        return float(np.sqrt(np.mean(away**2)))


def observed(star, pixelscale, seed):
    rng = np.random.default_rng(seed)
    counts = rng.poisson(star + BACKGROUND) + rng.normal(0, READ_NOISE, star.shape)
    error = np.sqrt(np.maximum(counts, 0) + READ_NOISE**2)
    return Observation.from_arrays(counts, error, pixelscale=pixelscale, name="test star")


def case(basis, nanometres, alignment, flux=FLUX, **changes):
    settings = {"monochromatic": 4.5e-6, "npix": NPIX, "fov_pixels": 32, **changes}
    model = nircam_coronagraph("F444W", **settings)
    opd = random_opd(3, npix=model.npix).data
    generator = torch.Generator().manual_seed(1)
    size = torch.where(basis.frequencies == 0, nanometres, nanometres / 4)
    change = torch.randn(len(basis), dtype=torch.float64, generator=generator) * size * 1e-9
    later = opd + basis.opd(change, PupilGrid.full(model.npix)).numpy()
    star = flux * model(later, **alignment).numpy()
    return Case(model, opd, later, star, observed(star, model.detector.pixelscale, 2))


@pytest.fixture(scope="module")
def bright():
    return case(BASIS, 2.0, ALIGNMENT)


@pytest.fixture(scope="module")
def fit(bright):
    settings = GaussNewton(basis=BASIS, response_npix=NPIX)
    return refine(bright.model, bright.observation, bright.opd, settings=settings)


@pytest.fixture(scope="module")
def tiny():
    """Few modes, few pixels, a star that is hardly misaligned."""
    return case(FEW, 4.0, {"star_offset": (0.002, -0.001)}, flux=1e10, npix=64, fov_pixels=(24, 20))


def quick(case, observation=None, start=None, **changes):
    return refine(
        case.model,
        case.observation if observation is None else observation,
        case.opd,
        settings=few(**changes),
        start=start,
    )


def few(**changes):
    """Settings of a fit that takes a second."""
    return GaussNewton(**{"basis": FEW, "response_npix": 64, **changes})


@pytest.fixture(scope="module")
def plain(tiny):
    """The small case as it is, for comparisons."""
    return quick(tiny)


def test_gauss_newton_explains_the_data(fit):
    assert fit.status is Status.CONVERGED
    assert fit.status.usable
    # 1024 pixels less about 100 parameters that they determine, and the scatter of chi2.
    expected = 1 - fit.effective_parameters / 1024
    assert fit.chi2_per_pixel == pytest.approx(expected, abs=0.1)
    assert fit.model_error == 0.0


@pytest.mark.hard
def test_gauss_newton_lowers_the_error_of_the_star_to_about_the_noise(bright, fit):
    outdated = FLUX * bright.model(bright.opd).numpy() + BACKGROUND
    aligned = FLUX * bright.model(bright.opd, **ALIGNMENT).numpy() + BACKGROUND
    assert bright.error_of(outdated) > 100
    assert bright.error_of(aligned) > 20
    assert bright.error_of(fit.frames[0].star) < 0.5
    # What no fit may pass: nothing, a turned star, one that is 1 % too bright.
    assert bright.error_of(0 * fit.frames[0].star) > 20
    assert bright.error_of(fit.frames[0].star.T) > 5
    assert bright.error_of(1.01 * fit.frames[0].star) > 0.5


def test_gauss_newton_recovers_alignment_flux_and_background(fit):
    truth = {**ALIGNMENT, "flux": FLUX, "background": BACKGROUND}
    within = {
        "star_offset": 0.001, "lyot_shift": 0.002, "lyot_rotation": 0.1, "flux": 0.03 * FLUX,
        "background": 20.0,
    }  # fmt: skip
    assert set(fit.frames[0].values) == set(truth)
    for name, value in truth.items():
        away = fit.frames[0].values[name] - np.atleast_1d(value)
        assert np.abs(away).max() < within[name], name
        assert np.abs(away / fit.frames[0].errors[name]).max() < 4, name
        assert (fit.frames[0].errors[name] > 0).all()


def test_the_refined_wavefront_is_nearer_to_the_truth(bright, fit):
    """Behind the Lyot stop; what the stop hides stays at the prior."""
    stop = polygon_coverage(maskrnd_openings(), PupilGrid.full(NPIX)).numpy() > 0.5
    before, after = ((map_ - bright.later)[stop].std() for map_ in (bright.opd, fit.wavefront))
    assert after < 0.6 * before


def test_the_history_tells_of_every_iteration(fit):
    assert [entry["iteration"] for entry in fit.history] == list(range(len(fit.history)))
    kappas = [entry["kappa"] for entry in fit.history]
    assert kappas == sorted(kappas, reverse=True)
    wavefront = [entry["wavefront"] for entry in fit.history]
    assert wavefront == sorted(wavefront)
    assert not wavefront[0]
    # The best iterate is given, not the last.
    assert fit.chi2_per_pixel < 1.01 * min(entry["chi2_per_pixel"] for entry in fit.history)


def test_the_parameter_table_has_values_errors_and_units(fit):
    table = fit.parameters
    rows = {row["name"]: row for row in table}
    assert list(rows) == [
        "star_offset[0]", "star_offset[1]", "lyot_shift[0]", "lyot_shift[1]", "lyot_rotation",
        "flux", "background",
    ]  # fmt: skip
    assert [str(rows[n]["unit"]) for n in rows] == ["arcsec"] * 2 + [""] * 2 + ["deg", "ph", "ph"]
    assert float(rows["star_offset[1]"]["value"]) == fit.frames[0].values["star_offset"][1]
    assert float(rows["lyot_rotation"]["error"]) == fit.frames[0].errors["lyot_rotation"][0]


def test_a_pickled_fit_is_the_same_fit(plain):
    written = pickle.dumps(plain)
    again = pickle.loads(written)
    np.testing.assert_array_equal(again.frames[0].star, plain.frames[0].star)
    images = [
        each.model(each.frames[0].opd, **each.frames[0].optical_values) for each in (again, plain)
    ]
    assert torch.equal(*images)
    assert torch.equal(again.linear.covariance, plain.linear.covariance)
    # What these calls have cached is not written.
    assert len(pickle.dumps(plain)) < 1.01 * len(written) < 25e6


def test_alignment_alone_leaves_the_wavefront_as_it_was(tiny, plain):
    got = quick(tiny, wavefront=False)
    np.testing.assert_array_equal(got.wavefront, tiny.opd)
    assert got.status is Status.MODEL_MISMATCH
    assert got.chi2_per_pixel > 3 * plain.chi2_per_pixel


@pytest.mark.parametrize("explained", [True, False])
def test_pixels_have_their_full_weight_where_the_data_are_explained(tiny, explained):
    """Robust weights would take a faint source for an outlier, and some of its light with it."""
    fit = quick(tiny, robust=2.0, wavefront=explained)
    assert (fit.status is Status.CONVERGED) == explained
    share = fit.linear.frames[0].weight.numpy() * fit.frames[0].observation.error[0]
    if explained:
        np.testing.assert_allclose(share, 1.0, rtol=1e-12)
    else:
        assert np.quantile(share, 0.2) < 0.8


def test_what_is_not_free_stays_where_it_was(tiny):
    got = quick(tiny, free=("flux",), start={"star_offset": (0.002, -0.001), "background": 500.0})
    assert got.frames[0].values["star_offset"].tolist() == [0.002, -0.001]
    assert got.frames[0].values["background"].tolist() == [500.0]
    assert np.isnan(got.frames[0].errors["star_offset"]).all()
    assert got.status is Status.CONVERGED
    assert got.frames[0].values["flux"][0] == pytest.approx(1e10, rel=0.02)


def test_frames_of_the_same_star_are_averaged(tiny):
    frames = [observed(tiny.star, tiny.observation.pixelscale, seed) for seed in (11, 12, 13)]
    stack = replace(
        frames[0],
        data=np.concatenate([f.data for f in frames]),
        error=np.concatenate([f.error for f in frames]),
        valid=np.concatenate([f.valid for f in frames]),
        center=np.concatenate([f.center for f in frames]),
    )
    one, three = quick(tiny, frames[0]), quick(tiny, stack)
    assert three.frames[0].residual.shape == (3, 24, 20)
    assert three.frames[0].errors["flux"][0] == pytest.approx(
        one.frames[0].errors["flux"][0] / 3**0.5, rel=0.1
    )


@pytest.mark.slow
def test_an_independent_minimiser_ends_where_gauss_newton_does():
    """The penalised chi-squared written out once more, with reverse-mode gradients."""
    basis = FourierModes(2)
    small = case(basis, 12.0, {}, flux=3e10, npix=64, fov_pixels=24)
    fit = quick(
        small,
        basis=basis,
        prior=WavefrontPrior({"texture": 3.0}, fit_scales=False),
        free=("star_offset", "flux", "background"),
        tolerance=1e-6,
    )
    assert fit.status is Status.CONVERGED
    linear = fit.linear
    data, error = (
        torch.from_numpy(a[0]) for a in (small.observation.data, small.observation.error)
    )
    grid = PupilGrid.full(64)
    modes = basis.modes(grid, 0, len(basis)).double()
    # Unknowns in units in which the problem is well conditioned.
    unit = torch.cat([torch.tensor([1e-3, 1e-3, 1e-2 * 3e10, 10.0]), linear.deviation[4:]]).double()

    def cost(scaled):
        x = (torch.from_numpy(scaled) * unit).requires_grad_()
        change = 1e-9 * torch.tensordot(x[4:], modes, dims=1)
        star = x[2] * small.model(torch.from_numpy(small.opd) + change, star_offset=x[:2]) + x[3]
        away = (x - linear.mean) / linear.deviation
        total = (((data - star) / error) ** 2).sum() + (
            away[torch.isfinite(linear.deviation)] ** 2
        ).sum()
        (gradient,) = torch.autograd.grad(total, x)
        return float(total.detach()), (gradient * unit).numpy()

    start = linear.mean / unit
    found = optimize.minimize(
        cost, start.numpy(), jac=True, method="L-BFGS-B", options={"maxiter": 500}
    )
    ours, first = cost((linear.vector / unit).numpy())[0], cost(start.numpy())[0]
    assert first > 5 * ours
    # What the tolerance leaves, 1e-6 of chi-squared per pixel a step.
    assert abs(ours - found.fun) < 1e-4 * 576
    apart = torch.from_numpy(found.x) * unit - linear.vector
    assert (apart.abs() < 0.05 * linear.covariance.diagonal().sqrt()).all()


def with_junk(tiny, junk):
    """A fit of the small case with 5 % of its pixels masked, and something else in them."""
    valid = np.random.default_rng(4).random(tiny.observation.shape) > 0.05
    data = np.where(valid, tiny.observation.data[0], junk)
    error = np.where(valid, tiny.observation.error[0], abs(junk))
    scale = tiny.observation.pixelscale
    return quick(tiny, Observation.from_arrays(data, error, valid=valid, pixelscale=scale))


@pytest.fixture(scope="module")
def clean(tiny):
    return with_junk(tiny, 0.0)


@pytest.mark.hard
@pytest.mark.parametrize("junk", [1e30, -1e30, np.nan, np.inf])
def test_masked_pixels_change_nothing_bitwise(tiny, clean, junk):
    dirty = with_junk(tiny, junk)
    assert dirty.wavefront.tobytes() == clean.wavefront.tobytes()
    assert dirty.frames[0].star.tobytes() == clean.frames[0].star.tobytes()
    assert dirty.chi2_per_pixel == clean.chi2_per_pixel
    assert dirty.status is clean.status is Status.CONVERGED
    masked = np.isnan(dirty.frames[0].residual[0])
    assert 0.02 < masked.mean() < 0.1
    assert np.array_equal(masked, ~dirty.frames[0].observation.valid[0])


@pytest.mark.hard
@pytest.mark.parametrize("share", [0.05, 0.5])
def test_missing_pixels_cost_precision_not_truth(tiny, plain, share):
    valid = np.random.default_rng(9).random(tiny.observation.shape) > share
    got = quick(tiny, replace(tiny.observation, valid=valid[None]))
    assert got.status is Status.CONVERGED
    assert got.frames[0].values["flux"][0] == pytest.approx(
        1e10, abs=4 * got.frames[0].errors["flux"][0]
    )
    assert got.frames[0].errors["flux"][0] > plain.frames[0].errors["flux"][0]
    # Also where no pixel was seen the star is modelled.
    noise = np.sqrt(tiny.star + BACKGROUND + READ_NOISE**2)
    away = ((got.frames[0].star - BACKGROUND - tiny.star) / noise)[~valid]
    assert np.sqrt(np.mean(away**2)) < 1.0


@pytest.mark.hard
def test_the_same_fit_gives_the_same_bits(tiny, plain):
    first, again = quick(tiny), plain
    assert first.wavefront.tobytes() == again.wavefront.tobytes()
    assert first.frames[0].star.tobytes() == again.frames[0].star.tobytes()
    assert first.history == again.history


def test_too_few_iterations_are_said(bright):
    got = quick(bright, max_iterations=2)
    assert got.status is Status.ITERATION_LIMIT
    assert len(got.history) == 2


@pytest.mark.slow
def test_a_frame_without_a_star_is_no_success(tiny):
    dark = observed(0 * tiny.star, tiny.observation.pixelscale, 3)
    negative = replace(dark, data=-tiny.observation.data)
    got = quick(tiny, negative)
    assert got.status is Status.DIVERGED
    assert not got.status.usable


def test_render_on_another_array_is_a_shifted_render(fit):
    np.testing.assert_allclose(fit.frames[0].render(), fit.frames[0].star, rtol=1e-12)
    # The star, at (15.5, 15.5) of 32 x 32, comes to (8.5, 11.5): 7 columns and 4 rows back.
    moved = fit.frames[0].render((20, 24), center=(8.5, 11.5))
    assert moved.shape == (20, 24)
    np.testing.assert_allclose(moved, fit.frames[0].star[4:24, 7:31], rtol=1e-8)
    # By default the middle of the array is the middle of the array.
    np.testing.assert_allclose(fit.frames[0].render(20), fit.frames[0].star[6:26, 6:26], rtol=1e-8)
    larger = fit.frames[0].render(40)
    np.testing.assert_allclose(larger[4:36, 4:36], fit.frames[0].star, rtol=1e-8)
    np.testing.assert_allclose(
        fit.frames[0].render(background=False),
        fit.frames[0].star - fit.frames[0].values["background"][0],
        rtol=1e-9,
    )


def test_a_star_off_the_middle_of_the_frame_is_followed(tiny):
    """Two columns right and one row down: the same fit, and `render` brings it back."""
    scale = tiny.model.detector.pixelscale
    shift = {"star_offset": (0.002, -0.001), "detector_shift": (2 * scale[0], -scale[1])}
    star = 1e10 * tiny.model(tiny.later, **shift).numpy()
    np.testing.assert_allclose(star[:-1, 2:], tiny.star[1:, :-2], rtol=1e-9)
    away = observed(star, scale, 2)
    away = replace(away, center=np.array([[9.5 + 2, 11.5 - 1]]))
    got = quick(tiny, away)
    assert got.status is Status.CONVERGED
    np.testing.assert_allclose(
        got.frames[0].values["detector_shift"], shift["detector_shift"], rtol=1e-12
    )
    assert (
        abs(got.frames[0].values["star_offset"][0] - 0.002)
        < 4 * got.frames[0].errors["star_offset"][0]
    )
    back = got.frames[0].render(center=(9.5, 11.5))
    np.testing.assert_allclose(back[1:, :-2], got.frames[0].star[:-1, 2:], rtol=1e-8)


def test_a_missing_wavefront_is_an_error_not_a_default(tiny):
    with pytest.raises(MissingOPDError, match="path to an OPD map"):
        refine(tiny.model, tiny.observation, None)


def test_an_observation_of_another_shape_says_what_to_do(tiny):
    frame = np.ones((20, 24))
    turned = Observation.from_arrays(frame, frame, pixelscale=0.0624)
    with pytest.raises(ShapeError, match=r"20 x 24.*24 x 20.*cutout"):
        refine(tiny.model, turned, tiny.opd)


def test_an_unknown_free_parameter_lists_the_known(tiny):
    with pytest.raises(IncompatibleSetupError, match=r"'lyot_shfit'.*lyot_shift"):
        quick(tiny, free=("lyot_shfit",))


@pytest.mark.hard
def test_a_broken_wavefront_is_an_error(tiny):
    bad = tiny.opd.copy()
    bad[20, 20] = np.nan
    with pytest.raises(NonFiniteError, match=r"1 values inside the pupil.*\(20, 20\)"):
        refine(tiny.model, tiny.observation, bad)
    with pytest.raises(ShapeError, match="square"):
        refine(tiny.model, tiny.observation, tiny.opd[:, :50])
    with pytest.warns(DiffrenderWarning, match="nm it would be plausible"):
        refine(tiny.model, tiny.observation, tiny.opd * 1e9, settings=few(max_iterations=1))


def test_derivatives_from_far_away_do_not_end_a_fit():
    """Steps that fail, and the last one, are repeated with accurate derivatives.

    A bright star, and a wavefront that is far from the map. Without the repetition chi-squared ends
    at 1.02 instead of 0.94.
    """
    basis = default_basis(3.0)
    system = nircam_coronagraph("F444W", monochromatic=4.5e-6, npix=64, fov_pixels=32)
    opd, rng = random_opd(3, npix=64), np.random.default_rng(1)
    change = basis.opd(torch.from_numpy(20e-9 * rng.normal(size=len(basis))), PupilGrid.full(64))
    expected = 1e12 * system(torch.from_numpy(opd.data) + change).numpy()
    counts = rng.poisson(expected) + rng.normal(0, 42.0, expected.shape)
    frame = Observation.from_arrays(
        counts, np.sqrt(np.maximum(counts, 0) + 42.0**2), pixelscale=system.detector.pixelscale
    )
    prior = WavefrontPrior({"segment": 20.0, "texture": 20.0}, fit_scales=False)
    chi2 = []
    for relinearise in (0.3, 0.02):
        settings = GaussNewton(
            cycles=3.0, prior=prior, response_npix=64, relinearise=relinearise,
            accurate_steps=relinearise > 0.05,
        )  # fmt: skip
        chi2.append(refine(system, frame, opd, settings=settings).chi2_per_pixel)
    assert chi2[1] < 1.05
    assert chi2[0] < 1.01 * chi2[1]


def test_algebra_that_breaks_down_says_what_to_check():
    with (
        pytest.raises(RefinementError, match=r"roll: the fit broke down.*Check the star's"),
        breakdown_explained("roll"),
    ):
        torch.linalg.cholesky(-torch.eye(2))
