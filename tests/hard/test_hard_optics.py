"""Every optical row of the stability table, held to its limits, and what has no number."""

from concurrent.futures import ThreadPoolExecutor

import pytest
import torch

from benchmarks.hard_cases import DTYPES, WAVELENGTH, small, system, threads, wavefront, worst
from benchmarks.stability_optics import ROWS
from pyklip_diffrender.bridges import image_masks as masks
from pyklip_diffrender.io import ARCSEC
from pyklip_diffrender.optics.grid import JWST_DIAMETER, PupilGrid
from pyklip_diffrender.optics.planes import MatrixFourier, Wavefront
from pyklip_diffrender.parameters import OPTICAL_PARAMETERS
from pyklip_diffrender.scene.objects import Planet, Scene
from pyklip_diffrender.scene.simulation import expected_photons, star_photons
from pyklip_diffrender.wavefront import random_opd

pytestmark = pytest.mark.hard

BOTH = pytest.mark.parametrize("dtype", DTYPES, ids=["float64", "float32"])


@BOTH
@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.case)
def test_a_row_of_the_table_keeps_its_limit(row, dtype):
    assert row.measure(dtype) <= row.limits[DTYPES.index(dtype)]


def watched(image):
    """Backward, with an error at the first NaN that any step produces."""
    # Torch warns whenever the mode is on.
    with pytest.warns(UserWarning, match="Anomaly Detection"):
        watch = torch.autograd.detect_anomaly(check_nan=True)
    with watch:
        ((image - 1) ** 2).sum().backward()


@BOTH
def test_no_light_at_all_has_a_gradient(dtype):
    """An absorption of 1 mm leaves a field of exactly 0: |E| and angle(E) would give NaN."""
    model = small(npix=32, fov_pixels=8, dtype=dtype)
    phase = torch.zeros(32, 32, dtype=torch.float64, requires_grad=True)
    absorption = torch.full((32, 32), 1e-3, dtype=torch.float64, requires_grad=True)
    image = model(torch.complex(phase, absorption))
    assert not image.any()
    watched(image)
    for leaf in (phase, absorption):
        assert not leaf.grad.any()


@BOTH
@pytest.mark.parametrize("parameter", OPTICAL_PARAMETERS, ids=lambda parameter: parameter.name)
def test_every_parameter_has_a_gradient_at_exactly_zero(parameter, dtype):
    """Where fits start: on the axis, nothing moved, no blur."""
    model = small(npix=64, fov_pixels=8, dtype=dtype)
    value = torch.zeros(parameter.size, dtype=torch.float64, requires_grad=True)
    watched(1e5 * model(None, **{parameter.name: value}))
    assert torch.isfinite(value.grad).all()
    # A blur of 0 is a minimum of the sharpness; everything else has a slope.
    assert bool(value.grad.any()) == (parameter.name != "blur")


def test_a_planet_at_the_edge_is_cut_not_wrapped():
    """Half of it beyond the field: the pixels are those of a wider field."""
    scene = Scene(planets=(Planet(1e-3, 15.5 * 0.062424185, 90.0),))
    narrow, wide = (
        expected_photons(model, scene, wavefront()) - star_photons(model, scene, wavefront())
        for model in (system(torch.float32), small(fov_pixels=64))
    )
    assert worst(narrow, wide[16:48, 16:48]) < 1e-5
    assert narrow[:, 0].max() == narrow.max()
    # Nothing of it on the other side: what would be wrapped would be as bright as the peak.
    assert narrow[:, -4:].max() < 0.01 * narrow.max()
    assert 0.3 < narrow.sum() / wide.sum() < 0.7


@BOTH
def test_eight_threads_give_the_same_bits_every_time(dtype):
    """And those of one thread but for rounding."""
    model = small(dtype=dtype)
    with threads(8):
        images = [model(wavefront()).numpy() for _ in range(3)]
    assert images[0].tobytes() == images[1].tobytes() == images[2].tobytes()
    with threads(1):
        assert worst(model(wavefront()), images[0]) < (1e-12 if dtype == torch.float64 else 3e-5)


@BOTH
def test_eight_callers_of_one_model_get_what_one_gets(dtype):
    """A fresh model: its constants are built by whoever comes first."""
    serial, shared = (
        small(dtype=dtype, monochromatic=None, nlambda=2, npix=64, fov_pixels=16) for _ in range(2)
    )
    opds = [torch.from_numpy(random_opd(k, npix=64).data) for k in range(8)]
    offsets = [(0.01 * k, -0.005 * k) for k in range(8)]
    expected = [serial(*each).numpy() for each in zip(opds, offsets, strict=True)]
    with ThreadPoolExecutor(8) as pool:
        got = [image.numpy() for image in pool.map(shared, opds, offsets)]
    for image, true in zip(got, expected, strict=True):
        assert worst(image, true) < (1e-12 if dtype == torch.float64 else 1e-5)
    assert worst(expected[1], expected[0]) > 0.1


N = 48
GRID = PupilGrid(N, JWST_DIAMETER, (3, 44), (5, 47))
ONTO = PupilGrid(N, JWST_DIAMETER, (6, 40), (8, 45))
LIMITS = {torch.float64: 1e-10, torch.float32: 1e-4}
"""float32 holds 6e-8 a product; thousands are added up, with signs."""


def gaussian(x, y, wavelength):
    return torch.exp(-(x**2) / 0.02 - (y - 0.1) ** 2 / 0.05)


def bar(x):
    return torch.exp(-((x - 0.1) ** 2) / 0.02)


def padded(wavelength):
    return torch.linspace(0, 1, (3 * N) ** 2).reshape(3 * N, 3 * N).double()


MASKS = {
    "sampled mask": lambda: masks.SampledOcculter(
        [masks.BoxPart(gaussian, (-1.0, 1.0, -1.5, 1.2))], 3.0, JWST_DIAMETER, "box", GRID
    ),
    "bar": lambda: masks.SampledOcculter(
        [masks.SeparablePart(bar, None, 3.0)], 3.0, JWST_DIAMETER, "bar", GRID
    ),
    "padded FFT": lambda: masks.FourierMask(padded, 3, N, JWST_DIAMETER, "padded"),
}


def noise(shape, dtype, seed):
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(*shape, dtype=dtype.to_complex(), generator=generator)


@pytest.mark.parametrize("name", MASKS)
def test_a_mask_that_has_seen_single_precision_is_as_good_in_double(name):
    used, fresh = MASKS[name](), MASKS[name]()
    double = Wavefront(noise(GRID.shape, torch.float64, 2), WAVELENGTH, GRID)
    single = Wavefront(double.field.to(torch.complex64), WAVELENGTH, GRID)
    assert used.apply(single, {}, ONTO).field.dtype == torch.complex64
    assert torch.equal(*(mask.apply(double, {}, ONTO).field for mask in (used, fresh)))


@BOTH
@pytest.mark.parametrize(("rows", "columns"), [(9, 8), (1, 5)])
@pytest.mark.parametrize("window", [(0, N), (3, 44)], ids=["symmetric", "window"])
def test_transform_and_inverse_are_adjoint(rows, columns, window, dtype):
    """The inverse is written by hand."""
    grid = PupilGrid(N, JWST_DIAMETER, window, window)
    x, y = (
        (torch.arange(n, dtype=torch.float64) - (n - 1) / 2) * 0.06 * ARCSEC
        for n in (columns, rows)
    )
    pupil, image = noise(grid.shape, dtype, 5), noise((rows, columns), dtype, 6)
    transform = MatrixFourier(grid, x, y, WAVELENGTH, dtype.to_complex(), shear=0.03)
    there = transform.forward(pupil)
    back = transform.inverse(image, 1.0) * grid.spacing**2
    left = torch.vdot(image.flatten(), there.flatten())
    right = torch.vdot(back.flatten(), pupil.flatten())
    assert abs(complex(left - right)) <= LIMITS[dtype] * float(image.norm() * there.norm())
