"""A fine model near one wavefront, a coarse one for the distance from it."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
import torch
from torch import Tensor

from pyklip_diffrender.errors import IncompatibleSetupError, ShapeError
from pyklip_diffrender.multifidelity import MultiFidelity
from pyklip_diffrender.nircam import nircam_coronagraph
from pyklip_diffrender.opd import random_drift, random_opd
from pyklip_diffrender.optics import OpticalSystem

NPIX = 256


@cache
def model(**changes: object) -> OpticalSystem:
    settings = {"monochromatic": 4.5e-6, "fov_pixels": 24, "npix": NPIX, **changes}
    return nircam_coronagraph("F444W", **settings)


@cache
def wavefronts() -> tuple[Tensor, Tensor]:
    """A map, and what has been added to it 40 hours later."""
    return (
        torch.from_numpy(random_opd(5, npix=NPIX).data),
        torch.from_numpy(random_drift(6, 40.0, npix=NPIX).data),
    )


def error(image: Tensor, truth: Tensor) -> float:
    return float((image - truth).abs().max() / truth.max())


def test_exact_at_the_reference() -> None:
    opd, _ = wavefronts()
    values = {"star_offset": (0.02, -0.01), "lyot_rotation": 0.2}
    mixed = MultiFidelity(model(), opd, values, npix=64)
    truth = model()(opd, **values)
    assert error(mixed(opd), truth) < 1e-12
    assert error(mixed(), truth) < 1e-12


@pytest.mark.parametrize("npix", [64, 128])
def test_a_tenth_of_the_coarse_models_error(npix: int) -> None:
    opd, change = wavefronts()
    truth = model()(opd + change)
    coarse = model(npix=npix)
    alone = coarse(torch.nn.functional.avg_pool2d((opd + change)[None], NPIX // npix)[0])
    mixed = MultiFidelity(model(), opd, npix=npix)
    assert error(mixed(opd + change), truth) < 0.1 * error(alone, truth)


def test_the_error_shrinks_with_the_distance() -> None:
    opd, change = wavefronts()
    mixed = MultiFidelity(model(), opd, npix=64)
    far, near = (error(mixed(opd + k * change), model()(opd + k * change)) for k in (1.0, 0.1))
    assert near < 0.15 * far


def test_moving_the_reference() -> None:
    opd, change = wavefronts()
    mixed = MultiFidelity(model(), opd, npix=64)
    mixed.move(opd + change)
    assert error(mixed(opd + change), model()(opd + change)) < 1e-12


def test_a_coarse_opd_is_the_mean_of_a_fine_one() -> None:
    opd, change = wavefronts()
    mixed = MultiFidelity(model(), opd, npix=64)
    small = torch.nn.functional.avg_pool2d((opd + change)[None], NPIX // 64)[0]
    assert torch.allclose(mixed(small), mixed(opd + change), rtol=1e-12, atol=0)
    assert torch.allclose(mixed((opd + change).numpy()), mixed(small), rtol=1e-12, atol=0)


def test_derivatives_are_those_of_the_fine_model() -> None:
    opd, change = wavefronts()
    weight = torch.from_numpy(np.random.default_rng(2).standard_normal((24, 24)))
    mixed = MultiFidelity(model(), opd, npix=128)
    slopes = []
    for image in (model(), mixed):
        offset = torch.tensor([0.01, 0.02], dtype=torch.float64, requires_grad=True)
        start = (opd + change).clone().requires_grad_()
        found = torch.autograd.grad((weight * image(start, offset)).sum(), (start, offset))
        slopes.append((torch.nn.functional.avg_pool2d(found[0][None], 8), found[1]))
    for exact, rough in zip(*slopes, strict=True):
        assert (exact - rough).norm() < 0.03 * exact.norm()


def test_derivatives_against_differences() -> None:
    opd, change = wavefronts()
    mixed = MultiFidelity(model(), opd, npix=64)
    step = 1e-3 * change
    _, along = torch.func.jvp(mixed, (opd,), (step,))
    numerical = (mixed(opd + step) - mixed(opd - step)) / 2
    assert (along - numerical).norm() < 1e-5 * along.norm()


def test_batches_wavelengths_and_weights() -> None:
    opd, change = wavefronts()
    broad = model(monochromatic=None, nlambda=2, npix=128)
    small, moved = (torch.nn.functional.avg_pool2d(m[None], 2)[0] for m in (opd, change))
    mixed = MultiFidelity(broad, small, npix=64)
    both = torch.stack([small, small + moved])
    truth = broad(both)
    assert error(mixed(both), truth) < 3e-3
    weights = torch.tensor([1.0, 0.0], dtype=torch.float64)
    assert error(mixed(both, weights=weights), broad(both, weights=weights)) < 3e-3


def test_single_precision_differences() -> None:
    opd, change = wavefronts()
    truth = model()(opd + change)
    double, single = (
        MultiFidelity(model(), opd, npix=128, dtype=dtype)(opd + change)
        for dtype in (torch.float64, torch.float32)
    )
    assert single.dtype == torch.float64
    assert error(single, double) < 0.1 * error(double, truth)


def test_what_does_not_fit_is_refused() -> None:
    opd, _ = wavefronts()
    fine = model()
    with pytest.raises(IncompatibleSetupError, match="does not divide"):
        MultiFidelity(fine, opd, npix=100)
    with pytest.raises(IncompatibleSetupError, match="another detector"):
        MultiFidelity(fine, opd, coarse=model(fov_pixels=20, npix=64))
    with pytest.raises(ShapeError, match="one map"):
        MultiFidelity(fine, torch.stack([opd, opd]), npix=64)
    bare = OpticalSystem(fine.entrance, fine.planes, fine.detector, fine.bandpass)
    with pytest.raises(IncompatibleSetupError, match="no recipe"):
        MultiFidelity(bare, opd)
    given = MultiFidelity(bare, opd, coarse=model(npix=64))
    assert given.npix == NPIX
    assert "64 samples" in repr(given)
    assert given.parameters == fine.parameters
    with pytest.raises(ShapeError, match="resample"):
        given(torch.zeros(32, 32))
