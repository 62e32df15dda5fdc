"""Every optical row of the stability table, held to its limits, and what has no number."""

from __future__ import annotations

from itertools import pairwise

import pytest
import torch
from hard_cases import DTYPES, small, system, wavefront, worst
from stability_optics import ROWS

from pyklip_diffrender.parameters import OPTICAL_PARAMETERS
from pyklip_diffrender.scene import Planet, Scene, expected_photons, planet_photons, star_photons

pytestmark = pytest.mark.hard

BITS = ("float64", "float32")


@pytest.mark.parametrize("bits", BITS)
@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.case)
def test_a_row_of_the_table_keeps_its_limit(row, bits):
    k = BITS.index(bits)
    assert row.measure(DTYPES[k]) <= row.limits[k]


@pytest.mark.parametrize("dtype", DTYPES, ids=BITS)
def test_finer_cells_change_the_image_less_and_less(dtype):
    """To the rounding of the type, where all are as good."""
    exact = small(occulter_sampling=16.0, route="planes")(wavefront())
    errors = [
        worst(small(occulter_sampling=s, dtype=dtype, route="planes")(wavefront()), exact)
        for s in (1.0, 1.5, 2.0, 4.0, 8.0)
    ]
    floor = 0.0 if dtype == torch.float64 else 5e-6
    assert all(fine <= max(coarse, floor) for coarse, fine in pairwise(errors))
    assert errors[0] > 1e-4
    assert errors[-1] < max(1e-8, floor)


def test_the_star_comes_through_as_it_leaves_the_axis():
    """The null is on the axis; 100 mas off twice the light passes."""
    model = small(si_wfe=False)
    light = [float(model(None, (mas * 1e-3, 0.0)).sum()) for mas in (0, 1, 10, 50, 100)]
    assert light == sorted(light)
    assert light[0] < 0.01 * float(small(si_wfe=False, image_mask=None)(None).sum())
    assert light[4] > 1.5 * light[0]


def watched(image):
    """Backward, with an error at the first NaN that any step produces."""
    # Torch warns whenever the mode is on.
    with pytest.warns(UserWarning, match="Anomaly Detection"):
        watch = torch.autograd.detect_anomaly(check_nan=True)
    with watch:
        ((image - 1) ** 2).sum().backward()


@pytest.mark.parametrize("dtype", DTYPES, ids=BITS)
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


@pytest.mark.parametrize("dtype", DTYPES, ids=BITS)
@pytest.mark.parametrize("name", [p.name for p in OPTICAL_PARAMETERS])
def test_every_parameter_has_a_gradient_at_exactly_zero(name, dtype):
    """Where fits start: on the axis, nothing moved, no blur."""
    model = small(npix=64, fov_pixels=8, dtype=dtype)
    size = {p.name: p.size for p in OPTICAL_PARAMETERS}[name]
    value = torch.zeros(size, dtype=torch.float64, requires_grad=True)
    watched(1e5 * model(None, **{name: value}))
    assert torch.isfinite(value.grad).all()
    # A blur of 0 is a minimum of the sharpness; everything else has a slope.
    assert bool(value.grad.any()) == (name != "blur")


def test_outside_the_pupil_the_gradient_is_exactly_zero():
    model = system(torch.float64)
    opd = wavefront().clone().requires_grad_()
    model(opd).sum().backward()
    amplitude = model.entrance.grid.crop(model.entrance.amplitude, model.entrance.full)
    assert not opd.grad[amplitude == 0].any()
    assert opd.grad[amplitude > 0.5 * amplitude.max()].abs().min() > 0


def light(model, *planets):
    """What planets add to a scene, photons."""
    scene = Scene(planets=planets)
    return expected_photons(model, scene, wavefront()) - star_photons(model, scene, wavefront())


@pytest.mark.parametrize("dtype", DTYPES, ids=BITS)
def test_a_planet_at_the_edge_is_cut_not_wrapped(dtype):
    """Half of it beyond the field: the pixels are those of a wider field."""
    planet = Planet(1e-3, 15.5 * 0.062424185, 90.0)
    narrow = light(system(dtype), planet)
    wide = light(small(fov_pixels=64), planet)
    assert worst(narrow, wide[16:48, 16:48]) < 1e-5
    assert narrow[:, 0].max() == narrow.max()
    # Nothing of it on the other side: what would be wrapped would be as bright as the peak.
    assert narrow[:, -4:].max() < 0.01 * narrow.max()
    assert 0.3 < narrow.sum() / wide.sum() < 0.7


@pytest.mark.parametrize("dtype", DTYPES, ids=BITS)
def test_two_planets_closer_than_a_beam_add_up(dtype):
    """50 mas apart, a third of a beam."""
    pair = Planet(1e-4, 0.60, 30.0), Planet(2e-4, 0.65, 30.0)
    model = system(dtype)
    alone = [planet_photons(system(torch.float64), Scene(), p, wavefront()) for p in pair]
    assert worst(light(model, *pair), alone[0] + alone[1]) < 1e-5
    assert worst(alone[0] * 3, alone[0] + alone[1]) > 0.01


@pytest.mark.parametrize("dtype", DTYPES, ids=BITS)
def test_a_planet_under_the_occulter_is_dimmed(dtype):
    """At 0.3 arcsec a few percent come through, as the plain FFT has it."""
    near, far = (
        light(system(dtype), Planet(1e-3, separation, 90.0)).max() for separation in (0.3, 0.9)
    )
    assert 0.01 < near / far < 0.1
