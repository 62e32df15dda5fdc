"""The paper's recipe, against which the experiments compare: Adam on the pixels of the map."""

from __future__ import annotations

import importlib
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import pyklip_diffrender as dr

FLUX, BACKGROUND = 1e10, 500.0


@pytest.fixture
def recipe(monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).parents[1] / "examples" / "paper"))
    return importlib.import_module("recipe")


@dataclass
class Small:
    """A small model, a map, and a frame under another wavefront."""

    model: dr.OpticalSystem
    opd: NDArray[np.float64]
    frame: dr.Observation


@pytest.fixture(scope="module")
def small():
    model = dr.nircam_coronagraph("F444W", monochromatic=4.5e-6, npix=64, fov_pixels=20)
    before, after = (dr.random_opd(seed, npix=64).data for seed in (1, 2))
    counts = np.random.default_rng(3).poisson(FLUX * model(after).numpy() + BACKGROUND)
    frame = dr.Observation.from_arrays(
        counts, np.sqrt(counts + 1), pixelscale=model.detector.pixelscale
    )
    return Small(model, before, frame)


def test_the_recipe_lowers_the_mean_absolute_error(recipe, small):
    fit = recipe.adam_recipe(
        small.model, small.frame, small.opd, flux=FLUX, background=BACKGROUND, steps=30
    )
    first = FLUX * small.model(small.opd).numpy() + BACKGROUND
    assert fit.losses[0] == pytest.approx(np.abs(first - small.frame.data[0]).mean(), rel=1e-10)
    assert fit.losses == tuple(sorted(fit.losses, reverse=True))
    assert fit.losses[-1] < 0.995 * fit.losses[0]
    assert len(fit.losses) == 30
    # Every step moves a pixel by a little more than the learning rate at most.
    assert 1e-10 < np.abs(fit.wavefront - small.opd).max() < 3.3e-10
    final = FLUX * small.model(fit.wavefront).numpy() + BACKGROUND
    np.testing.assert_allclose(fit.star, final, rtol=1e-10)
    assert np.abs(fit.residual).mean() == pytest.approx(min(fit.losses), rel=1e-10)


def test_the_recipe_does_not_see_masked_pixels(recipe, small):
    valid = np.random.default_rng(4).random(small.frame.shape) > 0.05
    fits = []
    for junk in (0.0, 1e30):
        data = np.where(valid, small.frame.data[0], junk)
        masked = replace(small.frame, data=data[None], valid=valid[None])
        fits.append(recipe.adam_recipe(small.model, masked, small.opd, flux=FLUX, steps=3))
    assert fits[0].wavefront.tobytes() == fits[1].wavefront.tobytes()
    assert fits[0].losses == fits[1].losses
    expected = np.abs(FLUX * small.model(small.opd).numpy() - small.frame.data[0])[valid].mean()
    assert fits[0].losses[0] == pytest.approx(expected, rel=1e-9)
