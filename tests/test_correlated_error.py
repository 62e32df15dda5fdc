"""The size of the error of the model that neighbouring pixels share, and fits that include it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from astropy.io import fits
from scipy.ndimage import gaussian_filter
from torch import Tensor

from pyklip_diffrender.linear import LinearFrame, LinearModel, Unknown
from pyklip_diffrender.linear.noise import UNCORRELATED, CorrelatedError
from pyklip_diffrender.refinement.correlated_error import fitted_correlated_error
from pyklip_diffrender.refinement.fit_file import linear_hdus, linear_of

SIZE, UNKNOWNS = 32, 12
EMPTY = torch.zeros(0, dtype=torch.int64)


def random(*shape: int, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=shape)


def correlated(seed: int) -> np.ndarray:
    """Gaussian noise of variance 1 with the correlation exp(-d^2 / 2) between pixels d apart."""
    white = random(SIZE + 20, SIZE + 20, seed=seed)
    smooth = gaussian_filter(white, 0.5**0.5, mode="wrap", truncate=8)
    # A Gaussian of width 1 / sqrt(2) has the power 1 / (4 pi) / (1 / 2).
    return (smooth * (2 * np.pi) ** 0.5)[10:-10, 10:-10]


def linear_model(error: CorrelatedError, frames: int = 2, shared: bool = True) -> LinearModel:
    """Frames of a bright star in which the error is one draw of its distribution."""
    y, x = np.indices((SIZE, SIZE)) - (SIZE - 1) / 2
    light = 1e4 / (1 + np.hypot(x, y) ** 2 / 20)
    sigma = np.sqrt(light + 100)
    common_part, parts = correlated(1), []
    for k in range(frames):
        relative = error.shared * common_part + error.own * correlated(2 + k)
        residual = light * relative + sigma * random(SIZE, SIZE, seed=10 + k)
        # Smooth changes of the star, which the unknowns explain.
        rows = [
            light * gaussian_filter(random(SIZE, SIZE, seed=30 + j), 4) for j in range(UNKNOWNS)
        ]
        residual = residual + 0.1 * sum(rows)
        parts.append(
            LinearFrame(
                residual=torch.from_numpy(residual),
                weight=torch.from_numpy(1 / sigma),
                jacobian=torch.from_numpy(np.stack(rows)).float(),
                rows=torch.arange(UNKNOWNS),
                drift=EMPTY,
                first_mode=0,
                # Hardly anything, but the frames are of the same pixels.
                common=torch.full((SIZE, SIZE), 1e-9 if shared else 0.0, dtype=torch.float64),
                light=torch.from_numpy(light),
            )
        )
    zeros = torch.zeros(UNKNOWNS, dtype=torch.float64)
    model = LinearModel(
        tuple(Unknown("modes", k) for k in range(UNKNOWNS)),
        tuple(parts),
        vector=zeros,
        mean=zeros,
        deviation=zeros + 1.0,
        curvature=torch.eye(UNKNOWNS, dtype=torch.float64),
    )
    return model.with_correlated_error(UNCORRELATED)


@pytest.mark.parametrize(("shared", "own"), [(0.015, 0.0), (0.012, 0.009)])
def test_the_size_is_that_of_the_frames(shared: float, own: float) -> None:
    """About 700 independent places of S/N near 1 tell the variance to a tenth."""
    fitted = fitted_correlated_error(linear_model(CorrelatedError(shared, own)))
    assert fitted.total == pytest.approx((shared**2 + own**2) ** 0.5, rel=0.15)
    assert fitted.own == pytest.approx(own, abs=0.004)


def test_of_frames_of_other_pixels_only_the_whole_is_known() -> None:
    fitted = fitted_correlated_error(linear_model(CorrelatedError(0.0, 0.015), shared=False))
    assert fitted.shared == pytest.approx(0.015, rel=0.15)
    assert fitted.own == 0


def test_without_an_error_there_is_none() -> None:
    assert fitted_correlated_error(linear_model(UNCORRELATED)) == UNCORRELATED


def test_amplitudes_scatter_as_much_as_their_errors_say() -> None:
    """Of templates of two pixels, which scatter twice as much without the correlated error."""
    model = linear_model(CorrelatedError(0.02), frames=1)
    centres = np.stack(np.meshgrid(*[np.arange(6, 27, 2)] * 2), axis=-1).reshape(-1, 2)
    y, x = np.indices((SIZE, SIZE))
    templates: dict[int, Tensor] = {
        0: torch.from_numpy(
            np.stack([np.exp(-((x - a) ** 2 + (y - b) ** 2) / 4) for a, b in centres])
        ).float()
    }
    scatter = []
    for each in (model, model.with_correlated_error(CorrelatedError(0.02))):
        products = each.weigh(templates)
        scatter.append(float((products.numerator / products.information.sqrt()).std()))
    assert scatter[0] > 1.8
    # 121 templates, some of which overlap.
    assert scatter[1] == pytest.approx(1.0, abs=0.2)


def test_files_keep_the_correlated_error(tmp_path: Path) -> None:
    model = replace(linear_model(CorrelatedError(0.02)), correlated=CorrelatedError(0.014, 0.004))
    fits.HDUList([fits.PrimaryHDU(), *linear_hdus(model)]).writeto(tmp_path / "linear.fits")
    with fits.open(tmp_path / "linear.fits") as hdus:
        again = linear_of(hdus, 2, "linear.fits")
    assert again.correlated == model.correlated
    torch.testing.assert_close(again.frames[1].light, model.frames[1].light)
