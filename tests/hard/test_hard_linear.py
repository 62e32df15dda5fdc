"""Linear stages have adjoints: <A u, v> = <u, A* v>, the derivative that a gradient needs."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from hard_cases import DTYPES, WAVELENGTH, small

from pyklip_diffrender.bridges.image_masks import (
    BoxPart,
    FourierMask,
    SampledOcculter,
    SeparablePart,
)
from pyklip_diffrender.io import ARCSEC
from pyklip_diffrender.optics import JWST_DIAMETER, MatrixFourier, PupilGrid, Wavefront

pytestmark = pytest.mark.hard

N = 48
GRID = PupilGrid(N, JWST_DIAMETER, (3, 44), (5, 47))
ONTO = PupilGrid(N, JWST_DIAMETER, (6, 40), (8, 45))
LIMITS = {torch.float64: 1e-10, torch.float32: 1e-4}
"""float32 holds 6e-8 a product; thousands are added up, with signs."""


def model(dtype):
    return small(npix=N, fov_pixels=(10, 13), oversample=2, dtype=dtype)


def of_plane(plane_of):
    """A plane between two windows. Planes keep transforms of one type: a new one for each."""

    def make(dtype):
        plane = plane_of(dtype)

        def stage(field):
            return plane.apply(Wavefront(field, WAVELENGTH, GRID), {}, ONTO).field

        return stage, GRID.shape

    return make


def onto_detector(shear, shift):
    def make(dtype):
        detector = replace(model(dtype).detector, shear=shear)
        values = {"detector_shift": torch.tensor([0.01, 0.02])} if shift else {}
        return (
            lambda field: detector.field(Wavefront(field, WAVELENGTH, GRID), values),
            GRID.shape,
        )

    return make


def pixels(dtype):
    """Blur and binning; real."""
    detector = model(dtype).detector
    values = {"blur": torch.tensor([0.05], dtype=torch.float64)}
    return lambda light: detector.image(light, values), (20, 26)


def whole(dtype):
    system = model(dtype)
    grid = system.entrance.grid
    return lambda field: system.propagate(Wavefront(field, WAVELENGTH, grid), {}), grid.shape


def gaussian(x, y, wavelength):
    return torch.exp(-(x**2) / 0.02 - (y - 0.1) ** 2 / 0.05)


def bar(x):
    return torch.exp(-((x - 0.1) ** 2) / 0.02)


STAGES = {
    "occulter": of_plane(lambda dtype: model(dtype).planes[0]),
    "Lyot stop": of_plane(lambda dtype: model(dtype).planes[1]),
    "internal aberration": of_plane(lambda dtype: model(dtype).planes[2]),
    "detector": onto_detector(0.0, False),
    "sheared detector": onto_detector(0.02, False),
    "shifted detector": onto_detector(0.0, True),
    "blur and binning": pixels,
    "whole coronagraph": whole,
    "sampled mask": of_plane(
        lambda _: SampledOcculter(
            [BoxPart(gaussian, (-1.0, 1.0, -1.5, 1.2))], 3.0, JWST_DIAMETER, "box", GRID
        )
    ),
    "bar": of_plane(
        lambda _: SampledOcculter([SeparablePart(bar, None, 3.0)], 3.0, JWST_DIAMETER, "bar", GRID)
    ),
    "padded FFT": of_plane(
        lambda _: FourierMask(
            lambda _: torch.linspace(0, 1, (3 * N) ** 2).reshape(3 * N, 3 * N).double(),
            3, N, JWST_DIAMETER, "padded",
        )
    ),
}  # fmt: skip


@pytest.mark.parametrize("dtype", DTYPES, ids=["float64", "float32"])
@pytest.mark.parametrize("name", STAGES)
def test_a_stage_and_its_derivative_are_adjoint(name, dtype):
    stage, shape = STAGES[name](dtype)
    generator = torch.Generator().manual_seed(2)
    kind = dtype if name == "blur and binning" else dtype.to_complex()

    def noise(*shape):
        return torch.randn(*shape, dtype=kind, generator=generator)

    before = noise(*shape).requires_grad_()
    after = stage(before)
    weight = noise(*after.shape)
    (back,) = torch.autograd.grad(after, before, weight)
    left = torch.vdot(weight.flatten(), after.detach().flatten())
    right = torch.vdot(back.flatten(), before.detach().flatten())
    scale = float(weight.norm() * after.detach().norm())
    assert abs(complex(left - right)) <= LIMITS[dtype] * max(abs(complex(left)), 0.01 * scale)
    # Linear: twice the field is twice the field, and the derivative is the stage itself.
    other = noise(*shape)
    together = stage(before.detach() + 2 * other)
    apart = after.detach() + 2 * stage(other)
    assert float((together - apart).norm()) <= LIMITS[dtype] * float(together.norm())
    assert float(after.detach().norm()) > 0


@pytest.mark.parametrize("name", ["sampled mask", "bar", "padded FFT"])
def test_a_mask_that_has_seen_single_precision_is_as_good_in_double(name):
    used, shape = STAGES[name](torch.float64)
    fresh, _ = STAGES[name](torch.float64)
    field = torch.randn(shape, dtype=torch.complex128, generator=torch.Generator().manual_seed(2))
    assert used(field.to(torch.complex64)).dtype == torch.complex64
    assert torch.equal(used(field), fresh(field))


@pytest.mark.parametrize("dtype", DTYPES, ids=["float64", "float32"])
@pytest.mark.parametrize(("rows", "columns"), [(8, 9), (9, 8), (1, 5), (2, 1)])
@pytest.mark.parametrize("window", [(0, N), (3, 44)], ids=["symmetric", "window"])
def test_transform_and_inverse_are_adjoint(rows, columns, window, dtype):
    """The inverse is written by hand."""
    grid = PupilGrid(N, JWST_DIAMETER, window, window)
    x, y = (
        (torch.arange(n, dtype=torch.float64) - (n - 1) / 2) * 0.06 * ARCSEC
        for n in (columns, rows)
    )
    generator = torch.Generator().manual_seed(5)

    def noise(*shape):
        return torch.randn(*shape, dtype=dtype.to_complex(), generator=generator)

    pupil, image = noise(*grid.shape), noise(rows, columns)
    transform = MatrixFourier(grid, x, y, WAVELENGTH, dtype.to_complex(), shear=0.03)
    there = transform.forward(pupil)
    back = transform.inverse(image, 1.0) * grid.spacing**2
    left = torch.vdot(image.flatten(), there.flatten())
    right = torch.vdot(back.flatten(), pupil.flatten())
    assert abs(complex(left - right)) <= LIMITS[dtype] * float(image.norm() * there.norm())
