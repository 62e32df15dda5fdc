"""Every effect of the detector against the library whose numerics it repeats."""

import numpy as np
import pytest
import scipy.ndimage
import torch
from astropy.convolution import convolve
from scipy.interpolate import RegularGridInterpolator

from pyklip_diffrender.bridges.sampled_planes import SplineRotation
from pyklip_diffrender.optics.planes import (
    ChainDetector,
    Detector,
    GaussianBlur,
    LinearResampling,
    PixelCrosstalk,
)

SHAPE = (24, 31)
KERNEL = np.array([[0.01, 0.02, 0.03], [0.04, 0.8, 0.05], [0.06, 0.07, 0.08]])


@pytest.fixture
def image(rng):
    return rng.uniform(size=SHAPE)


def apply(effect, image):
    return effect(torch.from_numpy(image)).numpy()


@pytest.mark.parametrize("sigma", [0.124, 0.126, 1.15, 12.0])
def test_blur_is_that_of_scipy(image, sigma):
    truth = scipy.ndimage.gaussian_filter(image, sigma)
    assert np.abs(apply(GaussianBlur(sigma), image) - truth).max() < 1e-13
    assert np.array_equal(truth, image) == (sigma < 0.125)


@pytest.mark.parametrize("angle", [0.0776, -0.5, 200.0])
def test_rotation_is_that_of_scipy(image, angle):
    truth = scipy.ndimage.rotate(image, angle, reshape=False)
    rotation = SplineRotation(angle, SHAPE)
    assert np.abs(apply(rotation, image) - truth).max() < 1e-12
    twice = apply(rotation, image + 2j * image)
    assert np.abs(twice - (1 + 2j) * truth).max() < 1e-12
    assert rotation(torch.from_numpy(image + 0j).to(torch.complex64)).dtype == torch.complex64


def test_resampling_is_that_of_scipy(image, rng):
    rows = rng.uniform(-2, SHAPE[0] + 1, size=(17, 19))
    columns = rng.uniform(-2, SHAPE[1] + 1, size=(17, 19))
    rows[0, :3], columns[0, :3] = (0, SHAPE[0] - 1, 5), (0, SHAPE[1] - 1, 7)
    axes = tuple(map(np.arange, SHAPE))
    function = RegularGridInterpolator(axes, image, bounds_error=False, fill_value=0)
    found = apply(LinearResampling(rows, columns, SHAPE), image)
    assert np.abs(found - function((rows, columns))).max() < 1e-14


def test_crosstalk_is_that_of_astropy(image):
    truth = convolve(image, KERNEL, boundary="fill", fill_value=0)
    assert np.abs(apply(PixelCrosstalk(KERNEL), image) - truth).max() < 1e-14


Y, X = np.mgrid[:9, :11] * 0.93
EFFECTS = {
    "blur": GaussianBlur(0.7),
    "rotation": SplineRotation(3.0, (9, 11)),
    "resampling": LinearResampling(Y + 0.21, X + 0.33, (9, 11)),
    "crosstalk": PixelCrosstalk(KERNEL),
}


@pytest.mark.parametrize("name", EFFECTS)
def test_adjoints(name):
    """<A u, v> = <u, A* v>, where autograd gives A*."""
    effect, generator = EFFECTS[name], torch.manual_seed(3)
    u, v = torch.randn(2, 9, 11, dtype=torch.float64, generator=generator)
    u.requires_grad_()
    image = effect(u)
    (back,) = torch.autograd.grad(image, u, v)
    assert abs((image * v).sum() - (u * back).sum()) < 1e-12 * image.norm() * v.norm()
    assert torch.allclose(effect(torch.stack([u, 2 * u]))[1], 2 * image, atol=1e-14)


def test_the_width_of_the_blur_can_be_fitted():
    image = torch.rand(7, 8, dtype=torch.float64, generator=torch.manual_seed(4))
    sigma = torch.tensor(0.83, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda s: GaussianBlur(s)(image), (sigma,), eps=1e-6)


def test_a_chain_bins_between_samples_and_pixels(rng):
    fine = rng.uniform(size=(18, 24))
    blur, crosstalk = GaussianBlur(1.3), PixelCrosstalk(KERNEL)
    common = {"shape": (6, 8), "pixelscale": (0.06, 0.06), "oversample": 3,
              "dtype": torch.float64, "device": torch.device("cpu")}  # fmt: skip
    chain = ChainDetector(**common, on_samples=(blur,), on_pixels=(crosstalk,))
    binned = apply(blur, fine).reshape(6, 3, 8, 3).sum(axis=(1, 3))
    found = chain.image(torch.from_numpy(fine), {}).numpy()
    assert np.allclose(found, apply(crosstalk, binned), atol=1e-14)
    # The free blur of a fit is the same with and without a chain behind it.
    values = {"blur": torch.tensor([0.05], dtype=torch.float64)}
    plain = Detector(**common).image(torch.from_numpy(fine), values)
    chained = ChainDetector(**common).image(torch.from_numpy(fine), values)
    assert torch.allclose(chained, plain)
