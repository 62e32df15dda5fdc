"""Jacobians of the image against differences of the model, and the priors that weigh them."""

import math

import numpy as np
import pytest
import torch
from derivatives import difference, parameter_jacobian
from scipy.stats import multivariate_normal

from pyklip_diffrender.instrument.nircam import nircam_coronagraph
from pyklip_diffrender.linear.response import (
    NANOMETRE,
    LastPupil,
    Reading,
    ResponseCache,
    WavefrontResponse,
    at_few_wavelengths,
    coarse_copy,
    downsample,
)
from pyklip_diffrender.optics.grid import PupilGrid
from pyklip_diffrender.parameters import parameter
from pyklip_diffrender.refinement import FitSettings
from pyklip_diffrender.wavefront import WavefrontPrior, random_opd
from pyklip_diffrender.wavefront.bases import FourierModes, JointBasis, SegmentMotions
from pyklip_diffrender.wavefront.priors import solve_with_evidence

NPIX = 256
BASIS = JointBasis([SegmentMotions(), FourierModes(6)])


def system(**changes):
    settings = {"monochromatic": 4.5e-6, "npix": NPIX, "fov_pixels": (20, 24), **changes}
    return nircam_coronagraph("F444W", **settings)


OPD = torch.from_numpy(random_opd(5, npix=NPIX).data)
VALUES = {  # Off every special point.
    name: torch.tensor(value, dtype=torch.float64)
    for name, value in {
        "star_offset": (0.012, -0.007), "lyot_shift": (0.004, 0.002), "lyot_rotation": (0.3,),
        "blur": (0.02,),
    }.items()
}  # fmt: skip


def slopes(model, opd, modes):
    """Derivatives of the image along changes of the OPD per nm, by central differences."""
    step, grid = 0.05 * NANOMETRE, PupilGrid.full(model.npix)
    changes = torch.cat([BASIS.modes(grid, k, k + 1) for k in modes])
    with torch.no_grad():
        ahead, behind = (model(opd + s * step * changes, **VALUES) for s in (1, -1))
    return (ahead - behind) / 0.1


MODES = [0, 29, 41, 54, 57, 90, len(BASIS) - 1]
SHEARED = {"pixelscale": (0.05, 0.08), "shear": 0.2, "oversample": 2}


@pytest.mark.parametrize(
    ("changes", "npix", "tolerance"),
    [
        ({}, NPIX, 1e-3),
        ({"npix": 128, **SHEARED}, 128, 1e-3),
        ({"npix": 128, "route": "planes"}, 128, 1e-4),
        ({"monochromatic": None, "nlambda": 2}, 128, 0.025),
    ],
    ids=str,
)
def test_wavefront_response_is_the_slope_of_the_fine_model(changes, npix, tolerance):
    """To the wrapped light of the occulter on the same grid; a coarse copy is off by a percent."""
    model = system(**changes)
    opd = downsample(OPD, model.npix)
    response = WavefrontResponse(model, BASIS, opd, VALUES, npix=npix)
    response.store()
    assert response.coarse.npix == npix
    image = response.image(model.fields(opd, **VALUES), VALUES)
    assert image.shape == (len(BASIS), 20, 24)
    expected = slopes(model, opd, MODES)
    error = (image[MODES] - expected).flatten(1).norm(dim=1) / expected.flatten(1).norm(dim=1)
    assert float(error.max()) < tolerance


def test_wavefront_response_takes_the_field_of_the_star_it_is_asked_about():
    """Kept from one wavefront, used at another 12 nm away: the slope there, not the old one."""
    model = system()
    coefficients = torch.zeros(len(BASIS), dtype=torch.float64)
    coefficients[[0, 20, 60, 61]] = torch.tensor([20.0, -20.0, 8.0, 8.0], dtype=torch.float64)
    moved = OPD + BASIS.opd(coefficients, PupilGrid.full(NPIX)) * NANOMETRE
    response = WavefrontResponse(model, BASIS, OPD, VALUES, npix=NPIX)
    response.store()
    there = response.image(model.fields(moved, **VALUES), VALUES)
    here = response.image(model.fields(OPD, **VALUES), VALUES)
    chosen = [29, 41, 57, 90, 110]
    expected = slopes(model, moved, chosen)
    error, old_error = (float((a[chosen] - expected).norm()) for a in (there, here))
    # The field's derivative turns with the pupil's phase, by little: the image's does more.
    assert error < 0.025 * float(expected.norm())
    assert error < 0.6 * old_error
    fields = [2 * field for field in model.fields(OPD, **VALUES)]
    torch.testing.assert_close(response.image(fields, VALUES), 2 * here, rtol=1e-6, atol=0)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["F210M", "F444W"])
def test_the_preset_has_wavelengths_enough_for_the_derivatives_of_a_filter(name):
    """Against nine wavelengths, at the size at which the finest modes reach the edge."""
    settings, basis = FitSettings.nircam(name), FourierModes(8)
    model = nircam_coronagraph(name, npix=128, fov_pixels=36, nlambda=9)
    images = [
        WavefrontResponse(model, basis, downsample(OPD, 128), {}, wavelengths=count).image(
            at_few_wavelengths(model, count).fields(downsample(OPD, 128)), model.values({})
        )
        for count in (settings.response_wavelengths, settings.response_wavelengths - 2, 9)
    ]
    error, with_fewer = (
        float((each - images[-1]).norm() / images[-1].norm()) for each in images[:2]
    )
    assert error < 0.03 < with_fewer


def test_responses_that_are_not_stored_are_the_same():
    """Room for one response: the other is computed again, about its own wavefront."""
    model, start, basis = system(npix=64), downsample(OPD, 64), FourierModes(3)
    fields = model.fields(start, **VALUES)
    last = Reading(ResponseCache(model, basis, npix=64), 0.05, 1, is_last=True)
    assert not last.near(start, VALUES).stored
    every = []
    for memory in (math.inf, 8 * len(basis) * 20 * 24, 100.0):
        cache = ResponseCache(model, basis, npix=64, memory=memory)
        responses = Reading(cache, 0.05, 2, is_last=False)
        places = (start, start + 2e-7 * model.entrance.lit)
        near, far = (responses.near(opd, VALUES) for opd in places)
        assert responses.near(start, VALUES) is near
        assert (near.stored, far.stored) == (memory == math.inf, memory > 1000)
        every.append([each.image(fields, VALUES, 5) for each in (near, far)])
    for others in every[1:]:
        for image, expected in zip(others, every[0], strict=True):
            assert float((image - expected).norm() / expected.norm()) < 1e-6
    assert float((every[0][0] - every[0][1]).norm() / every[0][0].norm()) > 0.01


def stored(response):
    """Derivatives of the field, for each wavelength, in the order of the modes."""
    batches = [changes for _, changes in response._batches()]
    return [torch.cat(each) for each in zip(*batches, strict=True)]


def relative(fields, expected, edge=0):
    """Relative difference of fields, without so many pixels at the edges."""
    inside = slice(edge, -edge or None)
    one, other = (torch.cat(each)[..., inside, inside] for each in (fields, expected))
    return float((one - other).norm() / other.norm())


MOVES = {
    "si_zernikes": 20e-9 * np.cos(3.0 * np.arange(36)),
    "detector_shift": (0.012, -0.015),
    "star_offset": (0.012, -0.01),
}


@pytest.mark.parametrize("route", ["lattice", "planes"])
def test_derivatives_follow_changes_in_the_last_pupil(route):
    """Against derivatives that are computed anew; the errors are those of the field's edges."""
    model = system(npix=64, fov_pixels=(44, 48), route=route)
    start = downsample(OPD, 64)
    before = {**VALUES, "si_zernikes": torch.zeros(36, dtype=torch.float64),
              "detector_shift": torch.tensor([0.02, 0.01], dtype=torch.float64)}  # fmt: skip
    after = before | {name: before[name] + torch.as_tensor(move) for name, move in MOVES.items()}
    kept, anew = (WavefrontResponse(model, BASIS, start, at, npix=64) for at in (before, after))
    kept.store()
    anew.store()
    old, expected = [each.clone() for each in stored(kept)], stored(anew)
    last = LastPupil(kept.coarse)
    assert 0.05 < last.change(before, after) < 1
    kept.follow(last, after)
    followed = stored(kept)
    assert relative(followed, expected) < 0.35 * relative(old, expected)
    assert relative(followed, expected, 12) < 0.2 * relative(old, expected, 12)
    kept.follow(last, before)
    assert relative(stored(kept), old) < 1e-5


@pytest.mark.hard
@pytest.mark.parametrize(
    ("name", "changes"),
    [
        ("star_offset", {}), ("lyot_shift", {"route": "planes"}), ("lyot_rotation", {}),
        ("si_zernikes", {}), ("detector_shift", SHEARED), ("detector_shift", {"route": "planes"}),
        ("blur", {"oversample": 2}),
    ],
)  # fmt: skip
def test_parameter_jacobian_is_the_slope_of_the_model(name, changes):
    model = system(npix=64, **changes)
    small = downsample(OPD, 64)
    entry = parameter(name)
    start = VALUES.get(name, torch.zeros(entry.size, dtype=torch.float64))
    given = {**VALUES, name: start}
    jacobian = parameter_jacobian(model, small, given, (name,))
    assert jacobian.shape == (entry.size, 20, 24)
    for k in range(entry.size > 2, entry.size, 7):  # The first Zernike is piston, unseen.
        # Areas of cut pixels are only once differentiable: the Lyot stop takes small steps.
        step = (1e-5 if name.startswith("lyot") else 1e-3) * entry.prior
        unit = torch.eye(entry.size, dtype=torch.float64)[k]
        expected = difference(lambda v: model(small, **{**given, name: v}), start, unit, step)
        assert float((jacobian[k] - expected).norm() / expected.norm()) < 1e-5


@pytest.mark.parametrize(
    ("filter_name", "mask", "size", "npix"),
    [("F182M", "MASKSWB", 240, 256), ("F480M", "MASKLWB", 80, 128), ("F182M", "MASK335R", 32, 128)],
)
def test_copies_of_the_star_do_not_touch_the_mask(filter_name, mask, size, npix):
    """Images of 128 samples at 1.8 um repeat after 7 arcsec."""
    model = nircam_coronagraph(filter_name, image_mask=mask, npix=512, fov_pixels=size)
    assert coarse_copy(model).npix == npix


def test_derivatives_behind_a_bar_are_as_exact_as_behind_a_round_mask():
    """They need the bar near the field only, a quarter of its length."""
    model = nircam_coronagraph("F210M", image_mask="MASKSWB", npix=256, fov_pixels=32, nlambda=1)
    opd = torch.from_numpy(random_opd(3, npix=256, rms=60e-9).data)
    coarse, exact = (WavefrontResponse(model, FourierModes(4), opd, {}, npix=n) for n in (128, 256))
    coarse.store()
    exact.store()
    assert exact.coarse is model
    assert coarse.coarse.recipe["bar_reach"] == pytest.approx(2.5, abs=0.01)
    fields = model.fields(opd)
    image, expected = coarse.image(fields, {}), exact.image(fields, {})
    assert (image - expected).norm() < 0.01 * expected.norm()


@pytest.fixture
def linear():
    """A whitened problem: 2 parameters, one without a prior, and modes of two kinds."""
    generator = torch.Generator().manual_seed(6)
    modes, data = 160, 500
    group = torch.arange(modes) % 2
    shape = 1 / (1 + torch.linspace(0, 2, modes, dtype=torch.float64))
    scale = torch.tensor([3.0, 0.4], dtype=torch.float64)
    design = torch.randn(data, modes + 2, dtype=torch.float64, generator=generator)
    truth = torch.randn(modes + 2, dtype=torch.float64, generator=generator)
    truth[:2] = torch.tensor([5.0, -0.3], dtype=torch.float64)
    truth[2:] *= scale[group] * shape
    observed = design @ truth + torch.randn(data, dtype=torch.float64, generator=generator)
    return {
        "design": design, "observed": observed, "truth": truth, "group": group, "shape": shape,
        "scale": scale, "fixed": torch.tensor([torch.inf, 0.5], dtype=torch.float64),
    }  # fmt: skip


def solved(linear, scales, iterations):
    design = linear["design"]
    return solve_with_evidence(
        design.T @ design, design.T @ linear["observed"], linear["shape"], linear["group"], scales,
        linear["fixed"], iterations=iterations, errors=True,
    )  # fmt: skip


def test_with_fixed_scales_the_solution_is_that_of_ridge_regression(linear):
    got = solved(linear, linear["scale"], 0)
    deviation = torch.cat([linear["fixed"], linear["scale"][linear["group"]] * linear["shape"]])
    system_ = linear["design"].T @ linear["design"] + torch.diag(deviation**-2)
    expected = torch.linalg.solve(system_, linear["design"].T @ linear["observed"])
    torch.testing.assert_close(got.step, expected, rtol=1e-9, atol=1e-12)
    expected = torch.linalg.inv(system_).diagonal()
    torch.testing.assert_close(got.variance, expected, rtol=1e-8, atol=1e-14)
    torch.testing.assert_close(got.scales, linear["scale"])
    # Posterior variance relative to prior variance, summed, is what the data do not determine.
    share = got.variance / deviation**2
    assert got.effective == pytest.approx(len(share) - float(share.sum()), rel=1e-9)
    away = (got.step - linear["truth"]) / got.variance.sqrt()
    assert float(away.square().mean().sqrt()) == pytest.approx(1.0, abs=0.2)


def test_the_evidence_finds_the_scales(linear):
    start = torch.tensor([0.3, 30.0], dtype=torch.float64)
    got = solved(linear, start, 60)
    # 80 modes of a kind: their rms is known to 8 %, less well where noise is as large.
    torch.testing.assert_close(got.scales, linear["scale"], rtol=0.25, atol=0)
    for factor in (0.8, 1.25):
        for k in (0, 1):
            scales = got.scales.clone()
            scales[k] *= factor
            assert solved(linear, scales, 0).log_evidence < got.log_evidence


def test_the_log_evidence_is_that_of_the_data(linear):
    """Differences between scales equal those of the data's own Gaussian density."""
    proper = {**linear, "fixed": torch.tensor([4.0, 0.5], dtype=torch.float64)}

    def exact(scales):
        deviation = torch.cat([proper["fixed"], scales[proper["group"]] * proper["shape"]])
        weighted = proper["design"] * deviation
        covariance = (weighted @ weighted.T + torch.eye(500)).numpy()
        return float(multivariate_normal(cov=covariance).logpdf(proper["observed"].numpy()))

    one, other = (torch.tensor(s, dtype=torch.float64) for s in ([3.0, 0.4], [2.0, 1.0]))
    got = solved(proper, one, 0).log_evidence - solved(proper, other, 0).log_evidence
    assert got == pytest.approx(exact(one) - exact(other), rel=1e-6)


def test_what_no_wavefront_explains_ends_at_the_ceiling():
    """More modes than the data tell apart, and data far larger than their noise."""
    generator = torch.Generator().manual_seed(4)
    design = torch.randn(60, 40, dtype=torch.float64, generator=generator)
    design = torch.cat([design, design + 1e-9 * design.roll(1, 0)], dim=1)
    observed = 1e8 * torch.randn(60, dtype=torch.float64, generator=generator)
    nothing = torch.zeros(0, dtype=torch.float64)
    one, group = torch.ones(80, dtype=torch.float64), torch.zeros(80, dtype=torch.int64)
    problem = {"design": design, "observed": observed, "shape": one, "group": group}
    got = solved({**problem, "fixed": nothing}, one[:1], 5)
    assert float(got.scales[0]) == 100.0
    assert bool(torch.isfinite(got.step).all() and torch.isfinite(got.variance).all())


def test_the_prior_falls_with_frequency():
    shape = WavefrontPrior(knee=3.0, slope=2.0).shape(BASIS)
    assert (shape[:54] == 1).all()
    at_three = (BASIS.frequencies == 3.0) & (BASIS.group_index == 1)
    assert at_three.any()
    torch.testing.assert_close(shape[at_three], torch.full_like(shape[at_three], 0.5))
    order = BASIS.frequencies[54:].argsort()
    assert (np.diff(shape[54:][order].numpy()) <= 0).all()
