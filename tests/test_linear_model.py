"""The marginalised algebra, against the same written out with full covariance matrices."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from pyklip_diffrender.linear.model import LinearFrame, LinearModel, Unknown

NY, NX = 6, 7
SHARED = 6


def random(*shape, seed):
    return torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def frame(k, rows, drift, first_mode):
    weight = 0.5 + random(NY, NX, seed=10 + k).abs()
    weight[1, 2] = 0.0
    return LinearFrame(
        residual=torch.where(weight > 0, random(NY, NX, seed=20 + k), 0.0), weight=weight,
        jacobian=random(len(rows), NY, NX, seed=30 + k).float(), rows=torch.tensor(rows),
        drift=torch.tensor([drift], dtype=torch.int64), first_mode=first_mode,
        common=torch.zeros(NY, NX, dtype=torch.float64),
    )  # fmt: skip


def dense(model):
    """Whitened Jacobian (unknowns, pixels), data about the prior's mean, prior covariance."""
    columns, data, count = [], [], len(model.vector)
    for part in model.frames:
        # The last row is of rows without an unknown.
        jacobian = torch.zeros(count + 1, NY * NX, dtype=torch.float64)
        white = (part.jacobian.double() * part.weight).flatten(1)
        drifting = [(part.first_mode + k, u) for k, u in enumerate(part.drift[0].tolist())]
        for row, unknown in [*enumerate(part.rows.tolist()), *drifting]:
            jacobian[unknown] += white[row]
        columns.append(jacobian[:count])
        data.append((part.weight * part.residual).flatten())
    jacobian = torch.cat(columns, dim=1)
    about_mean = torch.cat(data) + jacobian.T @ (model.vector - model.mean)
    return jacobian, about_mean, torch.diag(model.deviation**2)


def noise(model):
    """Covariance of the noise of all whitened pixels, with the errors that they share."""
    c = torch.stack([(part.weight * part.common).flatten() for part in model.frames])
    # c = s g / sqrt(1 + g^2 s^2), the other way round: g^2 s s^T = c c^T / (1 - c^2).
    shared = c[:, None] * c / (1 - (c**2).sum(dim=0))
    pixels = c.shape[1]
    matrix = torch.eye(len(c) * pixels, dtype=torch.float64)
    for a, b in np.ndindex(len(c), len(c)):
        block = matrix[a * pixels : (a + 1) * pixels, b * pixels : (b + 1) * pixels]
        block.diagonal().add_(shared[a, b])
    return matrix


def covariance(model):
    """Sigma of all whitened pixels, and the data."""
    jacobian, data, prior = dense(model)
    return noise(model) + jacobian.T @ prior @ jacobian, data


def with_curvature(model):
    jacobian, _, _ = dense(model)
    return replace(model, curvature=jacobian @ torch.linalg.solve(noise(model), jacobian.T))


def made(unknowns, *frames):
    size = len(unknowns)
    return with_curvature(LinearModel(
        unknowns=tuple(unknowns), frames=frames, vector=random(size, seed=1),
        mean=random(size, seed=2), deviation=0.2 + random(size, seed=3).abs(),
        curvature=torch.zeros(size, size, dtype=torch.float64),
    ))  # fmt: skip


@pytest.fixture
def single():
    return made([Unknown("modes", k) for k in range(SHARED)], frame(0, list(range(SHARED)), [], 2))


@pytest.fixture
def pair():
    """Two frames: one unknown each, four shared, two of these drift."""
    frames = (frame(0, [0, 2, 3, 4, 5], [6, 7], 3), frame(1, [1, 2, 3, 4, 5], [8, 9], 3))
    names = ("flux", 0, 0), ("flux", 0, 1), ("companions", 0), ("lyot_rotation", 0), ("modes", 0)
    drifting = (Unknown("drift", k, owner) for owner in (0, 1) for k in (0, 1))
    return made([*(Unknown(*each) for each in names), Unknown("modes", 1), *drifting], *frames)


@pytest.fixture
def patterned(pair):
    """Two frames of one detector, whose pattern multiplies both."""
    star = torch.stack([3 * random(NY, NX, seed=60 + k).abs() for k in range(2)])
    width = 0.1 + random(NY, NX, seed=62).abs()
    seen = sum((part.weight * s) ** 2 for part, s in zip(pair.frames, star, strict=True))
    common = star * width / torch.sqrt(1 + width**2 * seen)
    parts = (replace(p, common=c) for p, c in zip(pair.frames, common, strict=True))
    return with_curvature(replace(pair, frames=tuple(parts)))


def stacked(model, templates):
    """Whitened templates over all frames, (k, pixels)."""
    nothing = torch.zeros_like(next(iter(templates.values())))
    parts = [
        (templates.get(k, nothing) * part.weight).flatten(1) for k, part in enumerate(model.frames)
    ]
    return torch.cat(parts, dim=1).double()


@pytest.mark.parametrize(
    ("name", "shown"),
    [("single", [0]), ("pair", [0, 1]), ("pair", [1]), ("patterned", [0, 1]), ("patterned", [1])],
)
def test_amplitudes_are_those_of_the_full_covariance(name, shown, request):
    """Of templates in all frames, or in the second only."""
    model = request.getfixturevalue(name)
    templates = {k: random(3, NY, NX, seed=50 + k) for k in shown}
    sigma, data = covariance(model)
    white = stacked(model, templates)
    inverse = torch.linalg.inv(sigma)
    found = model.weigh(templates)
    torch.testing.assert_close(found.numerator, white @ inverse @ data, rtol=1e-5, atol=1e-6)
    wanted = white @ inverse @ white.T
    torch.testing.assert_close(found.information, wanted.diagonal(), rtol=1e-5, atol=0)
    alone = (white @ torch.linalg.solve(noise(model), white.T)).diagonal()
    torch.testing.assert_close(found.photon, alone, rtol=1e-9, atol=0)
    # The unknowns' freedom costs something, and how much is not the same for all templates.
    lost = found.information / found.photon
    assert float(lost.max()) < 0.99
    assert float(lost.max() - lost.min()) > 0.01
    cleaned = torch.cat([part.flatten(1) for part in model.clean(templates).values()], dim=1)
    torch.testing.assert_close(cleaned, white @ inverse, rtol=1e-5, atol=1e-5)
    pixels = torch.tensor([[1, 2], [3, 0], [2, 2]])
    single = torch.zeros(3, NY, NX).index_put((torch.arange(3), *pixels.T), torch.ones(()))
    same = (model.weigh_pixels(shown[-1], pixels), model.weigh({shown[-1]: single}))
    torch.testing.assert_close(*same, rtol=1e-5, atol=1e-6)
    if len(shown) == len(model.frames):
        matrix, vector = model.normal_equations(templates)
        torch.testing.assert_close(matrix, wanted, rtol=1e-5, atol=1e-5)
        torch.testing.assert_close(vector, found.numerator, rtol=1e-5, atol=1e-6)


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
    there, here = other.weigh(templates).numerator, single.weigh(templates).numerator
    torch.testing.assert_close(there, here, rtol=1e-5, atol=1e-5)


def test_light_of_a_million_standard_deviations_leaves_no_rounding_errors(single):
    """The light is a multiple of derivatives, so that nothing of it is left."""
    (part,) = single.frames
    light = 1e6 * part.jacobian.double().sum(dim=0) * (part.weight > 0)
    infinite = torch.full_like(single.deviation, torch.inf)
    bright = replace(single, frames=(replace(part, residual=light),), deviation=infinite)
    # The normal equations in double precision keep 1e-16 times their condition number; single
    # precision would leave 0.1.
    assert bright.cleaned[0].abs().max() < 1e-4


def test_unknowns_can_be_taken_out_and_their_light_put_back(pair):
    light = {0: random(NY, NX, seed=70).numpy()}
    less = pair.without("companions", light)
    assert less.unknowns == tuple(u for u in pair.unknowns if u.name != "companions")
    assert len(less.unknowns) == len(pair.unknowns) - 1
    first = less.frames[0]
    assert first.rows.tolist() == [0, len(less.unknowns), 2, 3, 4]
    assert first.drift.tolist() == [[5, 6]]
    assert first.jacobian is pair.frames[0].jacobian
    assert less.names_before_modes(0) == ["flux", "", "lyot_rotation"]
    seen = first.weight > 0
    added = (first.residual - pair.frames[0].residual)[seen]
    torch.testing.assert_close(added, torch.as_tensor(light[0])[seen])
    assert float(first.residual[~seen].abs().max()) == 0.0
    jacobian, _, _ = dense(less)
    torch.testing.assert_close(less.curvature, jacobian @ jacobian.T)
    # The same model with frames that never had the row.
    stays = torch.tensor([0, 2, 3, 4])
    parts = (
        replace(part, jacobian=part.jacobian[stays], rows=part.rows[stays], first_mode=2)
        for part in less.frames
    )
    never, templates = replace(less, frames=tuple(parts)), {1: random(3, NY, NX, seed=71)}
    for method in ("weigh", "response", "clean"):
        torch.testing.assert_close(
            getattr(less, method)(templates), getattr(never, method)(templates)
        )
    assert less.without("flux", {}).unknowns == never.without("flux", {}).unknowns
    torch.testing.assert_close(
        less.without("flux", {}).weigh(templates), never.without("flux", {}).weigh(templates)
    )
