"""Parts of the propagation that share work: plane waves, and the way behind the occulter."""

from __future__ import annotations

import pytest
import torch

from pyklip_diffrender.instrument import detector_place, nircam_coronagraph
from pyklip_diffrender.linear import ModeFields
from pyklip_diffrender.optics import PupilGrid, Wavefront
from pyklip_diffrender.wavefront import FourierModes, JointBasis, SegmentMotions, random_opd

NPIX = 128
MASK = detector_place("MASK335R", "F444W")
MOVED = {
    "star_offset": (0.02, -0.03),
    "detector_shift": (0.011, -0.02),
    "lyot_shift": (0.003, -0.002),
    "lyot_rotation": 0.2,
    "si_zernikes": torch.linspace(-8e-9, 5e-9, 36, dtype=torch.float64),
}
DETECTORS = [
    {},
    {"pixelscale": MASK.siaf_pixelscale, "shear": MASK.siaf_shear},
    {"pixelscale": (0.05, 0.08), "shear": 0.2, "oversample": 2},
]


def system(**changes):
    settings = {"monochromatic": 4.5e-6, "npix": NPIX, "fov_pixels": (20, 24)}
    return nircam_coronagraph("F444W", **{**settings, **changes})


def start(model, values):
    checked = model.values(values)
    opd = torch.from_numpy(random_opd(5, npix=NPIX).data)
    return model.pupil_field(opd, 4.5e-6, checked), checked


def difference(one, other):
    return float((one - other).abs().max() / other.abs().max())


@pytest.mark.parametrize("detector", DETECTORS)
@pytest.mark.parametrize("values", [{}, MOVED])
def test_plane_waves_are_propagated_as_any_field(detector, values):
    model = system(**detector)
    wavefront, checked = start(model, values)
    waves = model.plane_waves(wavefront, checked, 9)
    grid = wavefront.grid
    for fx, fy in ((0, slice(0, 3)), (3, slice(2, 3)), (-9, slice(8, 10))):
        signs = torch.tensor([1, -1])
        cycles_x = (fx * signs)[:, None, None].expand(2, 2, fy.stop - fy.start)
        cycles_y = (signs[:, None] * torch.arange(fy.start, fy.stop)).expand(cycles_x.shape)
        turns = (
            cycles_x[..., None, None] * grid.x + cycles_y[..., None, None] * grid.y[:, None]
        ) / grid.diameter
        moved = wavefront.field * torch.exp(2j * torch.pi * turns)
        expected = model.propagate(Wavefront(moved, wavefront.wavelength, grid), checked)
        # The light of the outer cells is wrapped, which changes these fields by up to 3e-4.
        assert difference(waves.fields(fx, fy), expected) < 1e-3


@pytest.mark.parametrize("route", ["lattice", "planes"])
@pytest.mark.parametrize("detector", DETECTORS)
@pytest.mark.parametrize("values", [{}, MOVED])
def test_the_way_to_the_detector_may_be_interrupted(route, detector, values):
    model = system(route=route, **detector)
    wavefront, checked = start(model, values)
    whole = model.propagate(wavefront, checked)
    behind = model.behind_occulter(wavefront, checked)
    assert difference(model.to_detector(behind, checked), whole) < 1e-12


def test_what_is_behind_the_occulter_depends_on_what_is_before_it_alone():
    model = system()
    assert model.parameters_behind == {
        "lyot_shift", "lyot_rotation", "si_zernikes", "detector_shift", "blur"
    }  # fmt: skip
    wavefront, checked = start(model, MOVED)
    behind = model.behind_occulter(wavefront, checked)
    other = model.values({**MOVED, "lyot_rotation": 0.4, "detector_shift": (0.0, 0.03)})
    assert torch.equal(model.behind_occulter(wavefront, other).field, behind.field)
    expected = model.propagate(wavefront, other)
    assert difference(model.to_detector(behind, other), expected) < 1e-12


@pytest.mark.parametrize("route", ["lattice", "planes"])
@pytest.mark.parametrize(
    "basis", [JointBasis([SegmentMotions(), FourierModes(4)]), FourierModes(3)]
)
def test_derivatives_are_those_of_modes_propagated_one_by_one(route, basis):
    model = system(route=route)
    wavefront, checked = start(model, MOVED)
    opd = torch.from_numpy(random_opd(5, npix=NPIX).data)
    fields = ModeFields(model, basis, opd, checked)
    count = len(basis)
    modes = model.entrance.on_window(basis.modes(PupilGrid.full(NPIX, model.diameter), 0, count))
    factor = 2j * torch.pi / 4.5e-6 * 1e-9
    moved = Wavefront(modes * factor * wavefront.field, 4.5e-6, wavefront.grid)
    expected = model.propagate(moved, checked).to(torch.complex64)
    seen = torch.zeros(count, dtype=torch.int64)
    for modes, (change,) in fields.batches(10):
        assert 0 < len(modes) <= 10
        assert difference(change, expected[modes]) < (1e-3 if route == "lattice" else 1e-6)
        seen[modes] += 1
    # The modes with fx = 0 may come twice.
    assert (seen > 0).all()
