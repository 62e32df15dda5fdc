"""The factor by which errors of a search are multiplied, against simulated maps of S/N."""

from __future__ import annotations

from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy import stats
from scipy.ndimage import gaussian_filter

from pyklip_diffrender.detection import search
from pyklip_diffrender.detection.error_factor import ErrorFactor, scatter_profile
from pyklip_diffrender.detection.maps import Maps

PIXEL = 0.06
RESOLUTION = 0.15
Image = NDArray[np.float64]


def field(size: int = 80) -> Image:
    """x, y of the pixels from the star, arcsec."""
    axis = PIXEL * (np.arange(size) - (size - 1) / 2)
    return np.stack(np.meshgrid(axis, axis), axis=-1)


def snr_map(seed: int, scale: Image) -> Image:
    """Gaussian noise, smooth over a resolution element, with a standard deviation of `scale`."""
    white = np.random.default_rng(seed).normal(size=scale.shape)
    smooth = gaussian_filter(white, RESOLUTION / PIXEL / 2.355)
    return np.asarray(scale * smooth / smooth.std())


def test_errors_follow_the_scatter_of_the_snr_at_their_separation() -> None:
    grid = field()
    distance = np.hypot(grid[..., 0], grid[..., 1])
    scale = 1 + 1.5 * np.exp(-((distance / 0.8) ** 2))
    ratios = []
    for seed in range(20):
        snr = snr_map(seed, scale)
        factor = scatter_profile(snr, grid, torch.zeros(0, 2), 0.2, RESOLUTION)
        ratios.append([factor.at(s) / (1 + 1.5 * np.exp(-((s / 0.8) ** 2))) for s in (0.6, 1.2, 2)])
    # Rings are a little broad, and pulled towards the whole field.
    np.testing.assert_allclose(np.mean(ratios, axis=0), 1, atol=0.12)
    assert np.std(ratios, axis=0).max() < 0.12
    # One factor for the whole map would be wrong by 60 % near the star.
    assert snr_map(0, scale).std() < 0.75 * scale[distance < 0.6].mean()


def test_where_the_errors_are_right_the_factor_is_nearly_one() -> None:
    grid = field()
    factors = [
        scatter_profile(snr_map(seed, np.ones((80, 80))), grid, torch.zeros(0, 2), 0.2, RESOLUTION)
        .at_least(1.0)
        .at([0.4, 1.0, 2.0])
        for seed in range(20)
    ]
    assert np.mean(factors) < 1.06
    assert np.max(factors) < 1.25


def test_sources_do_not_raise_their_own_threshold() -> None:
    grid, ones = field(), np.ones((80, 80))
    source = np.hypot(grid[..., 0] - 1.0, grid[..., 1]) < 0.12
    snr = snr_map(3, ones)
    known = torch.tensor([[1.0, 0.0]], dtype=torch.float64)
    alone = scatter_profile(snr, grid, known, 0.2, RESOLUTION)
    masked = scatter_profile(np.where(source, 300.0, snr), grid, known, 0.2, RESOLUTION)
    np.testing.assert_allclose(masked.factors, alone.factors)
    unmasked = scatter_profile(np.where(source, 300.0, snr), grid, known[:0], 0.2, RESOLUTION)
    assert float(unmasked.at(1.0)) == pytest.approx(float(alone.at(1.0)), abs=0.35)


def test_factors_are_interpolated_and_never_below_their_floor() -> None:
    factor = ErrorFactor(np.array([0.5, 1.0]), np.array([2.0, 0.8]), np.full(2, 50.0))
    np.testing.assert_allclose(factor.at([0.1, 0.75, 3.0]), [2.0, 1.4, 0.8])
    offsets = torch.tensor([[0.3, 0.4], [0.0, -1.0]], dtype=torch.float64)
    np.testing.assert_allclose(factor.of(offsets), [2.0, 0.8])
    np.testing.assert_allclose(factor.at_least(1.0).factors, [2.0, 1.0])
    assert factor.typical == pytest.approx(1.4)
    assert factor.is_needed
    assert not ErrorFactor.constant(1.0).is_needed


def test_noise_exceeds_the_threshold_as_rarely_as_gaussian_noise() -> None:
    measured = ErrorFactor(np.array([0.4, 2.0]), np.ones(2), np.array([10.0, 50.0]))
    threshold = measured.threshold(3.0, [0.4, 2.0])
    assert threshold[0] > threshold[1] > 3.0
    np.testing.assert_allclose(measured.false_alarm(threshold, [0.4, 2.0]), stats.norm.sf(3.0))
    # The variance of this noise was drawn from few values, like that of a ring.
    rng = np.random.default_rng(5)
    count = 400_000
    scatter = np.sqrt(rng.chisquare(10, count) / 10)
    exceeded = np.mean(rng.normal(size=count) / scatter > threshold[0])
    assert exceeded == pytest.approx(stats.norm.sf(3.0), rel=0.15)
    known = ErrorFactor.constant(1.5)
    np.testing.assert_allclose(known.threshold(3.0, [0.4, 2.0]), 3.0)


def test_the_scatter_of_a_ring_is_as_well_known_as_its_positions_are_many() -> None:
    grid, ones = field(), np.ones((80, 80))
    distance = np.hypot(grid[..., 0], grid[..., 1])
    ring = np.abs(distance - 0.6) < 0.2
    maps = [snr_map(seed, ones) for seed in range(300)]
    variances = [(each[ring] ** 2).mean() for each in maps]
    positions = 2 * np.mean(variances) ** 2 / np.var(variances)
    factor = scatter_profile(maps[0], grid, torch.zeros(0, 2), 0.2, RESOLUTION)
    freedom = float(np.interp(0.6, factor.separations, factor.freedom))
    # 20 for the scatter of the whole field. Real S/N is smoother than this noise.
    assert 0.5 * positions < freedom - 20 < positions


def test_a_map_without_valid_pixels_needs_no_factor() -> None:
    factor = scatter_profile(np.full((80, 80), np.nan), field(), torch.zeros(0, 2), 0.2, RESOLUTION)
    assert not factor.is_needed


def test_a_source_near_the_star_is_judged_without_its_own_light(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    grid, ones = field(), np.ones((80, 80))
    distance = np.hypot(grid[..., 0] - 0.4, grid[..., 1])
    quiet = snr_map(1, ones)
    snr = quiet + 6.5 * np.exp(-((distance / 0.1) ** 2))
    peak = np.unravel_index(np.argmax(np.where(distance < 0.2, snr, 0)), snr.shape)

    def factor(_s: Image, _m: object, _f: object, known: torch.Tensor, inner: float) -> ErrorFactor:
        return scatter_profile(snr, grid, known, inner, RESOLUTION).at_least(1.0)

    monkeypatch.setattr(search, "_error_factor", factor)
    none = torch.zeros(0, 2, dtype=torch.float64)
    raised = factor(snr, None, None, none, 0.2)
    threshold = 0.97 * snr[peak]
    assert search._next_peak(snr, grid, none, raised, threshold, 0.2) is None
    maps = cast(Maps, SimpleNamespace(grid=grid))
    hidden = search._hidden_peak(snr, snr, maps, [], none, raised, threshold, 0.2)
    assert hidden == peak
    quiet_factor = factor(quiet, None, None, none, 0.2)
    assert search._hidden_peak(quiet, quiet, maps, [], none, quiet_factor, 5.0, 0.2) is None
