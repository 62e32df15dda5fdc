"""The marginalised algebra, against the same written out with full covariance matrices."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from pyklip_diffrender.errors import ShapeError
from pyklip_diffrender.linear.model import LinearFrame, LinearModel, Unknown

NY, NX = 6, 7
SHARED, DRIFT = 6, 2


def random(*shape, seed):
    return torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def frame(k, rows, drift, first_mode):
    weight = 0.5 + random(NY, NX, seed=10 + k).abs()
    weight[1, 2] = 0.0
    return LinearFrame(
        residual=torch.where(weight > 0, random(NY, NX, seed=20 + k), 0.0),
        weight=weight,
        jacobian=random(len(rows), NY, NX, seed=30 + k).float(),
        rows=torch.tensor(rows),
        drift=torch.tensor([drift], dtype=torch.int64),
        first_mode=first_mode,
        common=torch.zeros(NY, NX, dtype=torch.float64),
    )


def dense(model):
    """Whitened Jacobian (unknowns, pixels), data about the prior's mean, prior covariance."""
    size = len(model.vector)
    columns, data = [], []
    for part in model.frames:
        jacobian = torch.zeros(size, NY * NX, dtype=torch.float64)
        white = (part.jacobian.double() * part.weight).flatten(1)
        for row, unknown in enumerate(part.rows.tolist()):
            jacobian[unknown] += white[row]
        for k, unknown in enumerate(part.drift[0].tolist()):
            jacobian[unknown] += white[part.first_mode + k]
        columns.append(jacobian)
        data.append((part.weight * part.residual).flatten())
    jacobian = torch.cat(columns, dim=1)
    return (
        jacobian,
        torch.cat(data) + jacobian.T @ (model.vector - model.mean),
        torch.diag(model.deviation**2),
    )


def noise(model):
    """Covariance of the noise of all whitened pixels, with the errors that they share."""
    c = torch.stack([(part.weight * part.common).flatten() for part in model.frames])
    # c = s g / sqrt(1 + g^2 s^2), the other way round: g^2 s s^T = c c^T / (1 - c^2).
    shared = c[:, None] * c / (1 - (c**2).sum(dim=0))
    frames, pixels = c.shape
    matrix = torch.eye(frames * pixels, dtype=torch.float64)
    for a in range(frames):
        for b in range(frames):
            block = matrix[a * pixels : (a + 1) * pixels, b * pixels : (b + 1) * pixels]
            block.diagonal().add_(shared[a, b])
    return matrix


def covariance(model):
    """Sigma of all whitened pixels, and the data."""
    jacobian, data, prior = dense(model)
    return noise(model) + jacobian.T @ prior @ jacobian, data


@pytest.fixture
def single():
    part = frame(0, list(range(SHARED)), [], 2)
    white = (part.jacobian.double() * part.weight).flatten(1)
    return LinearModel(
        unknowns=tuple(Unknown("modes", k) for k in range(SHARED)),
        frames=(part,),
        vector=random(SHARED, seed=1),
        mean=random(SHARED, seed=2),
        deviation=0.2 + random(SHARED, seed=3).abs(),
        curvature=white @ white.T,
    )


@pytest.fixture
def pair():
    """Two frames: one unknown each, four shared, two of these drift."""
    frames = (frame(0, [0, 2, 3, 4, 5], [6, 7], 3), frame(1, [1, 2, 3, 4, 5], [8, 9], 3))
    model = LinearModel(
        unknowns=(
            Unknown("flux", 0, 0),
            Unknown("flux", 0, 1),
            Unknown("companions", 0),
            Unknown("lyot_rotation", 0),
            Unknown("modes", 0),
            Unknown("modes", 1),
            *(Unknown("drift", k, owner) for owner in (0, 1) for k in (0, 1)),
        ),
        frames=frames,
        vector=random(10, seed=1),
        mean=torch.zeros(10, dtype=torch.float64),
        deviation=0.2 + random(10, seed=3).abs(),
        curvature=torch.zeros(10, 10, dtype=torch.float64),
    )
    jacobian, _, _ = dense(model)
    return replace(model, curvature=jacobian @ jacobian.T)


@pytest.fixture
def patterned(pair):
    """Two frames of one detector, whose pattern multiplies both."""
    star = torch.stack([3 * random(NY, NX, seed=60 + k).abs() for k in range(2)])
    width = 0.1 + random(NY, NX, seed=62).abs()
    seen = sum((part.weight * s) ** 2 for part, s in zip(pair.frames, star, strict=True))
    common = star * width / torch.sqrt(1 + width**2 * seen)
    model = replace(
        pair, frames=tuple(replace(p, common=c) for p, c in zip(pair.frames, common, strict=True))
    )
    jacobian, _, _ = dense(model)
    return replace(model, curvature=jacobian @ torch.linalg.solve(noise(model), jacobian.T))


def test_the_noise_is_that_of_the_full_covariance(patterned):
    model = patterned
    images = {k: random(4, NY, NX, seed=90 + k) for k in range(2)}
    matrix, white = noise(model), stacked(model, images)
    wanted = torch.linalg.solve(matrix, white.T).T
    inverse = model.noise.inverse(images)
    got = torch.cat([inverse[k].flatten(1) for k in range(2)], dim=1)
    torch.testing.assert_close(got, wanted, rtol=1e-9, atol=1e-9)
    whitened = model.noise.whitened(images)
    torch.testing.assert_close(whitened @ whitened.T, white @ wanted.T, rtol=1e-9, atol=1e-9)
    chi2 = model.noise.chi2([each[0] for each in images.values()])
    assert chi2 == pytest.approx(float(white[0] @ wanted[0]), rel=1e-9)
    # What the pattern explains is far from nothing.
    assert chi2 < 0.8 * float((white[0] ** 2).sum())


def stacked(model, templates):
    """Whitened templates over all frames, (k, pixels)."""
    count = len(next(iter(templates.values())))
    return torch.cat(
        [
            (templates.get(k, torch.zeros(count, NY, NX)) * part.weight).flatten(1)
            for k, part in enumerate(model.frames)
        ],
        dim=1,
    ).double()


@pytest.mark.parametrize("name", ["single", "pair", "patterned"])
def test_amplitudes_are_those_of_the_full_covariance(name, request):
    model = request.getfixturevalue(name)
    templates = {k: random(3, NY, NX, seed=50 + k) for k in range(len(model.frames))}
    sigma, data = covariance(model)
    white = stacked(model, templates)
    inverse = torch.linalg.inv(sigma)
    found = model.weigh(templates)
    torch.testing.assert_close(found.numerator, white @ inverse @ data, rtol=1e-5, atol=1e-6)
    wanted = (white @ inverse @ white.T).diagonal()
    torch.testing.assert_close(found.information, wanted, rtol=1e-5, atol=0)
    alone = (white @ torch.linalg.solve(noise(model), white.T)).diagonal()
    torch.testing.assert_close(found.photon, alone, rtol=1e-9, atol=0)
    # The unknowns' freedom costs something, and how much is not the same for all templates.
    lost = found.information / found.photon
    assert float(lost.max()) < 0.99
    assert float(lost.max() - lost.min()) > 0.01
    matrix, vector = model.normal_equations(templates)
    torch.testing.assert_close(matrix, white @ inverse @ white.T, rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(vector, found.numerator, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("name", ["pair", "patterned"])
def test_a_template_may_be_in_one_frame_only(name, request):
    pair = request.getfixturevalue(name)
    templates = {1: random(2, NY, NX, seed=51)}
    sigma, data = covariance(pair)
    white = stacked(pair, templates)
    found = pair.weigh(templates)
    expected = white @ torch.linalg.solve(sigma, data)
    torch.testing.assert_close(found.numerator, expected, rtol=1e-5, atol=1e-6)
    cleaned = torch.cat([part.flatten(1) for part in pair.clean(templates).values()], dim=1)
    expected = torch.linalg.solve(sigma, white.T).T
    torch.testing.assert_close(cleaned, expected, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("name", ["pair", "patterned"])
def test_the_step_leads_to_the_most_probable_unknowns(name, request):
    pair = request.getfixturevalue(name)
    jacobian, data, prior = dense(pair)
    weighed = torch.linalg.solve(noise(pair), jacobian.T).T
    precision = torch.linalg.inv(prior) + weighed @ jacobian.T
    wanted = torch.linalg.solve(precision, weighed @ data)
    got = pair.vector + pair.step - pair.mean
    torch.testing.assert_close(got, wanted, rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(pair.covariance, torch.linalg.inv(precision), rtol=1e-8, atol=1e-10)
    combinations = random(10, 3, seed=80)
    expected = (combinations.T @ torch.linalg.solve(precision, combinations)).diagonal()
    torch.testing.assert_close(pair.variances(combinations), expected, rtol=1e-8, atol=0)


def test_where_the_model_is_linearised_does_not_matter(single):
    """The same data, described from another point: the residual moves by what the unknowns did."""
    moved = single.vector + random(SHARED, seed=9)
    part = single.frames[0]
    change = torch.tensordot(moved - single.vector, part.jacobian.double(), dims=1)
    residual = torch.where(part.weight > 0, part.residual - change, 0.0)
    other = replace(single, frames=(replace(part, residual=residual),), vector=moved)
    templates = {0: random(3, NY, NX, seed=50)}
    torch.testing.assert_close(
        other.weigh(templates).numerator, single.weigh(templates).numerator, rtol=1e-5, atol=1e-5
    )


def test_light_of_a_million_standard_deviations_leaves_no_rounding_errors(single):
    """The light is a multiple of derivatives, so that nothing of it is left."""
    (part,) = single.frames
    light = 1e6 * part.jacobian.double().sum(dim=0) * (part.weight > 0)
    bright = replace(
        single,
        frames=(replace(part, residual=light),),
        deviation=torch.full_like(single.deviation, torch.inf),
    )
    # The normal equations in double precision keep 1e-16 times their condition number; single
    # precision would leave 0.1.
    assert bright.cleaned[0].abs().max() < 1e-4


def test_unknowns_can_be_taken_out_and_their_light_put_back(pair):
    light = {0: random(NY, NX, seed=70).numpy()}
    less = pair.without("companions", light)
    assert less.unknowns == tuple(u for u in pair.unknowns if u.name != "companions")
    assert len(less.unknowns) == len(pair.unknowns) - 1
    first = less.frames[0]
    assert first.rows.tolist() == [0, 2, 3, 4]
    assert first.drift.tolist() == [[5, 6]]
    assert first.first_mode == 2
    seen = first.weight > 0
    added = (first.residual - pair.frames[0].residual)[seen]
    torch.testing.assert_close(added, torch.as_tensor(light[0])[seen])
    assert float(first.residual[~seen].abs().max()) == 0.0
    jacobian, _, _ = dense(less)
    torch.testing.assert_close(less.curvature, jacobian @ jacobian.T)


def test_frames_must_agree_on_the_number_of_templates(pair):
    with pytest.raises(ShapeError, match="one number"):
        pair.weigh({0: random(2, NY, NX, seed=1), 1: random(3, NY, NX, seed=2)})
