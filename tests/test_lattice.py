"""Point sources on the detector's lattice: what the model gives for each of them."""

import pickle

import pytest
import torch

from pyklip_diffrender.errors import IncompatibleSetupError, ShapeError
from pyklip_diffrender.instrument import detector_place
from pyklip_diffrender.instrument.nircam import nircam_coronagraph
from pyklip_diffrender.optics import OpticalSystem
from pyklip_diffrender.optics.planes import Plane
from pyklip_diffrender.optics.point_sources import PointSources
from pyklip_diffrender.wavefront import random_opd

OPD = torch.from_numpy(random_opd(5, npix=128).data)
MASK = detector_place("MASK335R", "F444W")
SIAF = {"pixelscale": MASK.siaf_pixelscale, "shear": MASK.siaf_shear}
MOVED = {
    "detector_shift": (0.011, -0.02),
    "lyot_shift": (0.003, -0.002),
    "lyot_rotation": 0.2,
    "si_zernikes": torch.linspace(-8e-9, 5e-9, 36, dtype=torch.float64),
}


def system(filter="F444W", **changes):
    waves = {} if "nlambda" in changes else {"monochromatic": 4.5e-6}
    return nircam_coronagraph(filter, **{"npix": 128, "fov_pixels": (30, 33), **waves, **changes})


def worst(model, opd, **values):
    """Largest error of the templates at some pixels, each as a fraction of its own peak."""
    sources = PointSources(model, opd, values)
    assert sources.route == "lattice"
    rows, columns = zip(*PIXELS, strict=True)
    images = sources.images(rows, columns)
    assert images.dtype == torch.float32
    errors = []
    for image, position in zip(images, sources.positions(rows, columns), strict=True):
        truth = model(opd, position, **{k: v for k, v in values.items() if k != "star_offset"})
        errors.append(float((image - truth).abs().max() / truth.max()))
    return max(errors)


# Near the axis, at the mask's flank, beyond it, two corners and an edge.
PIXELS = [(15, 16), (15, 20), (9, 25), (2, 3), (0, 0), (29, 32), (0, 17)]


@pytest.mark.parametrize(
    ("settings", "values"),
    [
        ({}, {"star_offset": (0.2, 0.3)}),  # The position is the pixel and not that of the star.
        ({"oversample": 3}, {}),
        ({"pixelscale": (0.04, 0.11), "shear": 0.3}, {}),
        ({"filter": "F335M", "nlambda": 3}, {}),
        ({"filter": "F250M", "nlambda": 2, "oversample": 2, **SIAF}, {}),
        ({"image_mask": None}, {}),
        ({"image_mask": None, "pupil_mask": None, "si_wfe": False, "oversample": 2}, {}),
        ({"pupil_mask": None, "si_wfe": False}, {}),
        ({"dtype": torch.float32}, {}),
        (SIAF, {**MOVED, "blur": 0.02}),
        ({**SIAF, "oversample": 2}, {**MOVED, "blur": 0.02}),
    ],
    ids=str,
)
def test_templates_are_those_of_the_model(settings, values):
    limit = 1e-4 if settings.get("dtype") == torch.float32 else 3e-6
    assert worst(system(**settings), OPD, **values) < limit


def test_an_opd_with_absorption_and_none_at_all():
    assert worst(system(), torch.complex(OPD, 0.4 * OPD.flip(0))) < 3e-6
    assert worst(system(), None) < 1e-5


def test_all_pixels_at_once_are_the_pixels_one_by_one():
    sources = PointSources(system(fov_pixels=(12, 11)), OPD)
    rows, columns = torch.meshgrid(torch.arange(12), torch.arange(11), indexing="ij")
    every = sources.images(rows.flatten(), columns.flatten())
    assert every.shape == (132, 12, 11)
    for k in (0, 17, 66, 131):
        single = sources.images([k // 11], [k % 11])[0]
        torch.testing.assert_close(every[k], single, rtol=1e-5, atol=1e-6 * float(single.max()))
    assert sources.images([], []).shape == (0, 12, 11)


def test_another_kind_of_plane_takes_the_models_own_route():
    class Unknown(Plane):
        name = "unknown"

        def apply(self, wavefront, values, onto):
            return wavefront

    plain = system()
    planes = [*plain.between, Unknown()]
    model = OpticalSystem(plain.entrance, planes, plain.detector, plain.bandpass)
    sources = PointSources(model, OPD)
    assert sources.route == "model"
    places = ([3, 15], [4, 16])
    expected = PointSources(plain, OPD).images(*places)
    torch.testing.assert_close(sources.images(*places), expected, rtol=1e-4, atol=1e-10)


def test_the_mask_is_ignored_where_it_changes_images_by_a_percent_at_most():
    model = system(fov_pixels=(81, 80))
    every = torch.arange(80)
    # With the axis in the middle, and near the right edge.
    for shift, column in ((0.0, 40), (2.2, 60)):
        rows = torch.cat([every, every])
        columns = torch.cat([torch.full_like(every, column), every.flip(0)])
        sources = PointSources(model, OPD, {"detector_shift": (shift, 0.0)})
        assert 2.0 < sources.reach < 2.3
        positions = sources.positions(rows, columns)
        truth = model(OPD, positions, detector_shift=(shift, 0.0))
        difference = (sources.images(rows, columns) - truth).flatten(1).norm(dim=1)
        relative = difference / truth.flatten(1).norm(dim=1)
        outside = positions.norm(dim=1) > sources.reach
        assert 20 < int(outside.sum()) < 140
        assert 1e-4 < float(relative[outside].max()) < 0.01
        assert float(relative[~outside].max()) < 1e-4


@pytest.mark.parametrize(
    ("call", "expected", "complaint"),
    [
        (lambda model: PointSources(model, OPD).images([30], [0]), ShapeError,
         "rows: expected indices from 0 to 29"),
        (lambda model: PointSources(model, OPD).images([0], [-1]), ShapeError, "columns"),
        (lambda model: PointSources(model, OPD).images([0, 1], [0]), ShapeError,
         "2 rows and 1 columns"),
        (lambda model: PointSources(model, torch.stack([OPD, OPD])), ShapeError, "one map"),
        (lambda model: PointSources(model, OPD, {"lyot_shfit": (0, 0)}), TypeError, "lyot_shift"),
    ],
)  # fmt: skip
def test_bad_pixels_and_maps_are_refused(call, expected, complaint):
    with pytest.raises(expected, match=complaint):
        call(system())


def both_routes(**changes):
    """By convolution, and plane by plane with cells so fine that it stands for the truth."""
    fast = system(**changes)
    assert fast.route == "lattice"
    return fast, system(**{"occulter_sampling": 16.0, **changes}, route="planes")


BESIDE = {"star_offset": (0.31, -0.22)}


@pytest.mark.parametrize(
    ("settings", "values"),
    [
        pytest.param({}, {}, marks=pytest.mark.slow),
        ({"oversample": 3}, BESIDE),
        ({"pixelscale": (0.04, 0.11), "shear": 0.2}, BESIDE),
        ({"filter": "F335M", "nlambda": 3}, BESIDE),
        ({"npix": 131, **SIAF}, BESIDE),
        ({"pupil_mask": None}, BESIDE),
        ({**SIAF, "oversample": 2}, {**MOVED, **BESIDE, "blur": 0.02}),
    ],
    ids=str,
)
def test_both_routes_converge_to_one_image(settings, values):
    fast, planes = both_routes(**settings)
    opd = torch.from_numpy(random_opd(5, npix=fast.npix).data)
    truth = planes(opd, **values)
    assert float((fast(opd, **values) - truth).abs().max() / truth.max()) < 3e-8


# torch 2.14 compiles the rules of its own `jvp` by what it calls deprecated.
@pytest.mark.filterwarnings(r"ignore:`torch\.jit\.script` is")
def test_every_kind_of_derivative_is_that_of_the_planes():
    """Reverse, forward, by `jacfwd` with a batch of directions, and a batch of maps by `vmap`."""
    fast, planes = both_routes(fov_pixels=8)
    change = torch.from_numpy(random_opd(6, npix=128).data)
    offset = torch.tensor([0.02, 0.01], dtype=torch.float64)

    def found(model):
        model(OPD)
        variable = OPD.clone().requires_grad_()
        (gradient,) = torch.autograd.grad(model(variable).square().sum(), variable)
        _, forward = torch.func.jvp(model, (OPD,), (change,))
        with torch.autograd.forward_ad.dual_level():
            dual = torch.autograd.forward_ad.make_dual(OPD, change)
            old_style = torch.autograd.forward_ad.unpack_dual(model(dual)).tangent
        jacobian = torch.func.jacfwd(lambda o: model(OPD, o))(offset)
        batch = torch.func.vmap(model)(torch.stack([OPD, change]))
        many = model(torch.stack([OPD, change]))
        return [gradient, forward, old_style, jacobian, batch, many]

    for mine, truth in zip(found(fast), found(planes), strict=True):
        assert float((mine - truth).abs().max() / truth.abs().max()) < 1e-6


def test_a_model_keeps_nothing_of_a_transform():
    model = system()
    image = model(OPD)
    torch.func.jvp(model, (OPD,), (OPD,))
    assert torch.equal(model(OPD), image)
    # What a transform has wrapped cannot be pickled.
    assert torch.equal(pickle.loads(pickle.dumps(model))(OPD), image)


def test_the_route_can_be_chosen():
    assert system().route == "lattice"
    assert system(route="planes").route == "planes"
    assert system().with_fidelity(route="planes").route == "planes"
    # Cells that fit these pixels are needlessly many.
    assert system(pixelscale=0.01).route == "planes"
    assert system(pixelscale=0.01, route="lattice").route == "lattice"
    assert system(image_mask=None).route == "planes"
    with pytest.raises(IncompatibleSetupError, match="one round occulter"):
        system(image_mask=None, route="lattice")
    with pytest.raises(IncompatibleSetupError, match="'fft'"):
        system(route="fft")
