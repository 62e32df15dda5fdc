"""Refinement of a small system: what it recovers, what it must not look at, how it ends."""

import pickle
from copy import copy
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy import optimize

import pyklip_diffrender as dr
from benchmarks.noisy_stars import READ_NOISE, DriftedStar, drifted_star
from pyklip_diffrender import errors
from pyklip_diffrender.instrument.masks import lyot_openings
from pyklip_diffrender.optics.grid import PupilGrid, polygon_coverage
from pyklip_diffrender.refinement import FitSettings, Status, refine
from pyklip_diffrender.refinement.fit_result import breakdown_explained
from pyklip_diffrender.wavefront import random_opd
from pyklip_diffrender.wavefront.bases import (
    FourierModes,
    JointBasis,
    SegmentMotions,
    default_basis,
)
from pyklip_diffrender.wavefront.priors import WavefrontPrior

NPIX = 128
FLUX = 3e11
BACKGROUND = 500.0
ALIGNMENT = {"star_offset": (0.008, -0.006), "lyot_shift": (0.006, -0.004), "lyot_rotation": 0.3}
BASIS = JointBasis([SegmentMotions(), FourierModes(6)])
FEW = FourierModes(3)
OFFSET = (0.002, -0.001)


class Case(DriftedStar):
    """With one frame of a star that is not aligned, and background."""

    def align(self, **alignment):
        self.truth = self.star(**alignment)
        self.noise = np.sqrt(self.truth + BACKGROUND + READ_NOISE**2)
        self.observation = self.seen(2)
        return self

    def seen(self, seed, star=None):
        light = self.truth if star is None else star
        return self.observed(light + BACKGROUND, seed, name="test star")

    def error_of(self, star_and_background):
        """Rms of a star model's error in units of the noise."""
        away = (star_and_background - BACKGROUND - self.truth) / self.noise
        return float(np.sqrt(np.mean(away**2)))


@pytest.fixture(scope="module")
def bright():
    return drifted_star(NPIX, 32, BASIS, 2.0, 0.5, 1, FLUX, Case).align(**ALIGNMENT)


@pytest.fixture(scope="module")
def fit(bright):
    return bright.refined(bright.observation)


@pytest.fixture(scope="module")
def tiny():
    """Few modes, few pixels, a star that is hardly misaligned."""
    return drifted_star(64, (24, 20), FEW, 4.0, 1.0, 1, 1e10, Case).align(star_offset=OFFSET)


def quick(case, observation=None, **changes):
    """A fit that takes a second."""
    frame = case.observation if observation is None else observation
    return case.refined(frame, **{"basis": FEW, "response_npix": 64, **changes})


@pytest.fixture(scope="module")
def plain(tiny):
    """The small case as it is, for comparisons."""
    return quick(tiny)


def test_gauss_newton_explains_the_data_and_tells_of_every_iteration(fit):
    assert fit.status is Status.CONVERGED
    assert fit.status.usable
    # 1024 pixels less about 100 parameters that they determine, and the scatter of chi2.
    expected = 1 - fit.effective_parameters / 1024
    assert fit.chi2_per_pixel == pytest.approx(expected, abs=0.1)
    assert fit.model_error == 0.0
    assert [entry["iteration"] for entry in fit.history] == list(range(len(fit.history)))
    kappas = [entry["kappa"] for entry in fit.history]
    assert kappas == sorted(kappas, reverse=True)
    wavefront = [entry["wavefront"] for entry in fit.history]
    assert wavefront == sorted(wavefront)
    assert not wavefront[0]
    # The best iterate is given, not the last.
    assert fit.chi2_per_pixel < 1.01 * min(entry["chi2_per_pixel"] for entry in fit.history)


@pytest.mark.hard
def test_gauss_newton_lowers_the_error_of_the_star_to_about_the_noise(bright, fit):
    outdated = FLUX * bright.model(bright.opd).numpy() + BACKGROUND
    aligned = FLUX * bright.model(bright.opd, **ALIGNMENT).numpy() + BACKGROUND
    assert bright.error_of(outdated) > 100
    assert bright.error_of(aligned) > 20
    assert bright.error_of(fit.frames[0].star) < 0.5


def test_gauss_newton_recovers_alignment_flux_and_background(fit):
    truth, frame = {**ALIGNMENT, "flux": FLUX, "background": BACKGROUND}, fit.frames[0]
    within = {
        "star_offset": 0.001, "lyot_shift": 0.002, "lyot_rotation": 0.1, "flux": 0.03 * FLUX,
        "background": 20.0,
    }  # fmt: skip
    assert set(frame.values) == set(truth)
    for name, value in truth.items():
        away = frame.values[name] - np.atleast_1d(value)
        assert np.abs(away).max() < within[name], name
        assert np.abs(away / frame.errors[name]).max() < 4, name
        assert (frame.errors[name] > 0).all()
    rows = {row["name"]: row for row in fit.parameters}
    assert list(rows) == [
        "star_offset[0]", "star_offset[1]", "lyot_shift[0]", "lyot_shift[1]", "lyot_rotation",
        "flux", "background",
    ]  # fmt: skip
    assert [str(rows[n]["unit"]) for n in rows] == ["arcsec"] * 2 + [""] * 2 + ["deg", "ph", "ph"]
    assert float(rows["star_offset[1]"]["value"]) == frame.values["star_offset"][1]
    assert float(rows["lyot_rotation"]["error"]) == frame.errors["lyot_rotation"][0]


def test_the_refined_wavefront_is_nearer_to_the_truth(bright, fit):
    """Behind the Lyot stop; what the stop hides stays at the prior."""
    stop = polygon_coverage(lyot_openings("MASKRND"), PupilGrid.full(NPIX)).numpy() > 0.5
    before, after = ((map_ - bright.later)[stop].std() for map_ in (bright.opd, fit.wavefront))
    assert after < 0.6 * before


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


@pytest.mark.parametrize("explained", [True, False])
def test_pixels_have_their_full_weight_where_the_data_are_explained(tiny, plain, explained):
    """Robust weights would take a faint source for an outlier, and some of its light with it."""
    fit = quick(tiny, robust=2.0, wavefront=explained)
    share = fit.linear.frames[0].weight.numpy() * fit.frames[0].observation.error[0]
    if explained:
        assert fit.status is Status.CONVERGED
        np.testing.assert_allclose(share, 1.0, rtol=1e-12)
    else:
        assert fit.status is Status.MODEL_MISMATCH
        assert np.quantile(share, 0.2) < 0.8
        # The alignment alone leaves the wavefront as it was.
        np.testing.assert_array_equal(fit.wavefront, tiny.opd)
        assert fit.chi2_per_pixel > 3 * plain.chi2_per_pixel


def test_what_is_not_free_stays_where_it_was(tiny):
    got = quick(tiny, free=("flux",), start={"star_offset": (0.002, -0.001), "background": 500.0})
    values, errors = got.frames[0].values, got.frames[0].errors
    assert values["star_offset"].tolist() == [0.002, -0.001]
    assert values["background"].tolist() == [500.0]
    assert np.isnan(errors["star_offset"]).all()
    assert got.status is Status.CONVERGED
    assert values["flux"][0] == pytest.approx(1e10, rel=0.02)


def test_frames_of_the_same_star_are_averaged(tiny):
    frames = [tiny.seen(seed) for seed in (11, 12, 13)]
    together = {
        name: np.concatenate([getattr(frame, name) for frame in frames])
        for name in ("data", "error", "valid", "center")
    }
    one, three = quick(tiny, frames[0]), quick(tiny, replace(frames[0], **together))
    assert three.frames[0].residual.shape == (3, 24, 20)
    expected = one.frames[0].errors["flux"][0] / 3**0.5
    assert three.frames[0].errors["flux"][0] == pytest.approx(expected, rel=0.1)


@pytest.mark.slow
def test_an_independent_minimiser_ends_where_gauss_newton_does():
    """The penalised chi-squared written out once more, with reverse-mode gradients."""
    basis = FourierModes(2)
    small = drifted_star(64, 24, basis, 12.0, 3.0, 1, 3e10, Case).align()
    prior = WavefrontPrior({"texture": 3.0}, fit_scales=False)
    free = ("star_offset", "flux", "background")
    fit = quick(small, basis=basis, prior=prior, free=free, tolerance=1e-6)
    assert fit.status is Status.CONVERGED
    linear = fit.linear
    data, error = (torch.from_numpy(getattr(small.observation, k)[0]) for k in ("data", "error"))
    modes = basis.modes(PupilGrid.full(64), 0, len(basis)).double()
    # Unknowns in units in which the problem is well conditioned.
    unit = torch.cat([torch.tensor([1e-3, 1e-3, 1e-2 * 3e10, 10.0]), linear.deviation[4:]]).double()

    def cost(scaled):
        x = (torch.from_numpy(scaled) * unit).requires_grad_()
        change = 1e-9 * torch.tensordot(x[4:], modes, dims=1)
        star = x[2] * small.model(torch.from_numpy(small.opd) + change, star_offset=x[:2]) + x[3]
        away = (x - linear.mean) / linear.deviation
        known = torch.isfinite(linear.deviation)
        total = (((data - star) / error) ** 2).sum() + (away[known] ** 2).sum()
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


@pytest.mark.hard
def test_missing_pixels_cost_precision_not_truth(tiny, plain):
    valid = np.random.default_rng(9).random(tiny.observation.shape) > 0.5
    got = quick(tiny, replace(tiny.observation, valid=valid[None]))
    assert got.status is Status.CONVERGED
    (frame,) = got.frames
    error = frame.errors["flux"][0]
    assert frame.values["flux"][0] == pytest.approx(1e10, abs=4 * error)
    assert error > plain.frames[0].errors["flux"][0]
    assert np.array_equal(np.isnan(frame.residual[0]), ~valid)
    # Also where no pixel was seen the star is modelled.
    away = ((frame.star - BACKGROUND - tiny.truth) / tiny.noise)[~valid]
    assert np.sqrt(np.mean(away**2)) < 1.0


def test_too_few_iterations_are_said(bright):
    got = quick(bright, max_iterations=2)
    assert got.status is Status.ITERATION_LIMIT
    assert len(got.history) == 2


@pytest.mark.slow
def test_a_frame_without_a_star_is_no_success(tiny):
    dark = tiny.seen(3, 0 * tiny.truth)
    negative = replace(dark, data=-tiny.observation.data)
    got = quick(tiny, negative)
    assert got.status is Status.DIVERGED
    assert not got.status.usable


def test_render_on_another_array_is_a_shifted_render(fit):
    (frame,) = fit.frames
    np.testing.assert_allclose(frame.render(), frame.star, rtol=1e-12)
    # The star, at (15.5, 15.5) of 32 x 32, comes to (8.5, 11.5): 7 columns and 4 rows back.
    moved = frame.render((20, 24), center=(8.5, 11.5))
    assert moved.shape == (20, 24)
    np.testing.assert_allclose(moved, frame.star[4:24, 7:31], rtol=1e-8)
    # By default the middle of the array is the middle of the array.
    np.testing.assert_allclose(frame.render(20), frame.star[6:26, 6:26], rtol=1e-8)
    np.testing.assert_allclose(frame.render(40)[4:36, 4:36], frame.star, rtol=1e-8)
    alone = frame.star - frame.values["background"][0]
    np.testing.assert_allclose(frame.render(background=False), alone, rtol=1e-9)


def test_a_star_off_the_middle_of_the_frame_is_followed(tiny):
    """Two columns right and one row down: the same fit, and `render` brings it back."""
    scale = tiny.model.detector.pixelscale
    shift = {"star_offset": (0.002, -0.001), "detector_shift": (2 * scale[0], -scale[1])}
    star = 1e10 * tiny.model(tiny.later, **shift).numpy()
    np.testing.assert_allclose(star[:-1, 2:], tiny.truth[1:, :-2], rtol=1e-9)
    away = replace(tiny.seen(2, star), center=np.array([[9.5 + 2, 11.5 - 1]]))
    got = quick(tiny, away)
    assert got.status is Status.CONVERGED
    (frame,) = got.frames
    moved = frame.values["detector_shift"]
    np.testing.assert_allclose(moved, shift["detector_shift"], rtol=1e-12)
    offset, error = frame.values["star_offset"][0], frame.errors["star_offset"][0]
    assert abs(offset - 0.002) < 4 * error
    back = frame.render(center=(9.5, 11.5))
    np.testing.assert_allclose(back[1:, :-2], frame.star[:-1, 2:], rtol=1e-8)


def holed(opd):
    bad = opd.copy()
    bad[20, 20] = np.nan
    return bad


TURNED = dr.Observation.from_arrays(np.ones((20, 24)), np.ones((20, 24)), pixelscale=0.0624)


@pytest.mark.hard
@pytest.mark.parametrize(
    ("changes", "error", "words"),
    [
        ({"opd": lambda opd: None}, errors.MissingOPDError, "path to an OPD map"),
        ({"opd": holed}, errors.NonFiniteError, r"1 values inside the pupil.*\(20, 20\)"),
        ({"opd": lambda opd: opd[:, :50]}, errors.ShapeError, "square"),
        ({"observation": TURNED}, errors.ShapeError, r"20 x 24.*24 x 20.*cutout"),
        ({"observation": "x.fits"}, errors.IncompatibleSetupError, "got 'x.fits', expected an Obs"),
        ({"observation": ["a.fits", "b.fits"]}, errors.IncompatibleSetupError,
         r"got 'a\.fits'.*science of ExposureSequence.from_files"),
        ({"observation": dr.ExposureSequence("HD 1", (TURNED,))}, errors.IncompatibleSetupError,
         "got ExposureSequence, expected an Observation"),
        ({"observation": np.ones((3, 3))}, errors.IncompatibleSetupError, "got ndarray"),
        ({"free": ("lyot_shfit",)}, errors.IncompatibleSetupError, r"'lyot_shfit'.*lyot_shift"),
    ],
)  # fmt: skip
def test_what_cannot_be_fitted_is_refused(tiny, changes, error, words):
    given = dict(changes)
    changed = copy(tiny)
    changed.opd = given.pop("opd", np.copy)(tiny.opd)
    with pytest.raises(error, match=words):
        quick(changed, **given)


def test_derivatives_from_far_away_do_not_end_a_fit():
    """Steps that fail, and the last one, are repeated with accurate derivatives.

    A bright star, and a wavefront that is far from the map. Without the repetition chi-squared ends
    at 1.02 instead of 0.94.
    """
    basis = default_basis(3.0)
    system = dr.nircam_coronagraph("F444W", monochromatic=4.5e-6, npix=64, fov_pixels=32)
    opd, rng = random_opd(3, npix=64), np.random.default_rng(1)
    change = basis.opd(torch.from_numpy(20e-9 * rng.normal(size=len(basis))), PupilGrid.full(64))
    expected = 1e12 * system(torch.from_numpy(opd.data) + change).numpy()
    counts = rng.poisson(expected) + rng.normal(0, 42.0, expected.shape)
    error, scale = np.sqrt(np.maximum(counts, 0) + 42.0**2), system.detector.pixelscale
    frame = dr.Observation.from_arrays(counts, error, pixelscale=scale)
    settings = FitSettings(
        cycles=3.0, prior=WavefrontPrior({"segment": 20.0, "texture": 20.0}, fit_scales=False),
        response_npix=64, relinearise=0.3, accurate_steps=True,
    )  # fmt: skip
    assert refine(system, frame, opd, settings=settings).chi2_per_pixel < 0.96


def test_algebra_that_breaks_down_says_what_to_check():
    with (
        pytest.raises(errors.RefinementError, match=r"roll: the fit broke down.*Check the star's"),
        breakdown_explained("roll"),
    ):
        torch.linalg.cholesky(-torch.eye(2))
