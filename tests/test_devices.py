"""All work on an accelerator, a pretended one (`pretend_device`) or with ``-m gpu`` a real one."""

from dataclasses import replace
from functools import cache

import numpy as np
import poppy
import pytest
import torch
from derivatives import parameter_jacobian
from pretend_device import DEVICE, pretended

import pyklip_diffrender as dr
from pyklip_diffrender.bridges import from_poppy
from pyklip_diffrender.bridges.sampled_planes import SplineRotation
from pyklip_diffrender.detection import wide_field, with_planets
from pyklip_diffrender.linear.response import Reading, ResponseCache
from pyklip_diffrender.optics.grid import PupilGrid
from pyklip_diffrender.optics.planes import GaussianBlur, LinearResampling, PixelCrosstalk
from pyklip_diffrender.optics.point_sources import PointSources
from pyklip_diffrender.refinement import FitSettings, Refinement
from pyklip_diffrender.refinement.forward import Problem
from pyklip_diffrender.refinement.solver import Solver
from pyklip_diffrender.scene.detector_pattern import DetectorPattern
from pyklip_diffrender.wavefront import WavefrontPrior
from pyklip_diffrender.wavefront.bases import FourierModes

NPIX, SIZE = 64, 24
BASIS = FourierModes(2)
PLANET = dr.Planet(1e-4, 0.5, 120.0)
QUICK = {"free": ("star_offset", "flux", "background"), "max_iterations": 10}
VALUES = {
    "star_offset": (0.01, -0.02), "lyot_shift": (0.002, 0.001), "lyot_rotation": 0.3,
    "detector_shift": (0.02, 0.01), "blur": 0.03, "si_zernikes": np.full(36, 2e-9),
}  # fmt: skip
"""Every parameter of the model, off its default."""


def model_on(device, **changes):
    arguments = {"monochromatic": 4.5e-6, "npix": NPIX, "fov_pixels": SIZE, **changes}
    return dr.nircam_coronagraph("F444W", device=device, **arguments)


def opd():
    return dr.wavefront.random_opd(1, npix=NPIX).data


def tensors(model):
    return model.values(VALUES)


@cache
def frame(k=0, *planets, **details):
    """A star through a drifted wavefront, rolled by 20 degrees a frame."""
    scene = dr.Scene(dr.Star(exposure=200.0), planets=planets)
    grid = PupilGrid.full(NPIX)
    drifted = opd() + BASIS.opd(3e-9 * torch.linspace(-1, 1, len(BASIS)), grid).numpy()
    seen = dr.simulate(model_on("cpu"), scene, drifted, seed=3 + k)
    return replace(seen, position_angles=np.full(len(seen), 20.0 * k), **details)


def rolls():
    """Two rolls of a star with a planet, and a reference star."""
    return [frame(0, PLANET), frame(1, PLANET.rotated(-20.0)), frame(2, reference=True)]


def settings(**changes):
    """A fit of all parameters, of the wavefront and of the pupil's amplitude."""
    prior = WavefrontPrior(amplitude_cycles=1.5, amplitude_scale=1.0)
    chosen = {"free": FitSettings.nircam().free, "prior": prior, **changes}
    return FitSettings(basis=BASIS, response_npix=NPIX, **chosen)


def fitted(device, frames, changes=None, **model):
    return dr.refine(model_on(device, **model), frames, opd(), settings=settings(**(changes or {})))


def reached(fit):
    assert fit.status.usable
    assert np.any(fit.frames[0].coefficients != 0)
    return [fit.chi2_per_pixel, *fit.frames[0].values["star_offset"], fit.frames[0].flux]


def search(device, frames, **model):
    """A joint fit, its search, measurements and limits."""
    changes = {**QUICK, "drift": WavefrontPrior(scales={"texture": 0.05})}
    fit = fitted(device, frames, changes, **model)
    detection = dr.detect(fit, inner=0.1)
    assert len(detection.candidates) > 0
    return [
        *reached(fit),
        *np.asarray(detection.candidates["contrast"]),
        *np.asarray(detection.measure([PLANET.offset])["contrast"]),
        *np.asarray(detection.contrast_curve["contrast"]),
        float(np.nanstd(detection.subtracted[0])),
    ]


def gradient(device, **changes):
    model = model_on(device, **changes)
    phase = torch.as_tensor(opd(), device=device).requires_grad_()
    values = {name: value.requires_grad_() for name, value in tensors(model).items()}
    model(phase, **values).square().sum().backward()
    return [each.grad.cpu().numpy().ravel() for each in (phase, *values.values())]


def parameter_derivatives(device, **changes):
    model = model_on(device, **changes)
    start = torch.as_tensor(opd(), device=device)
    return [parameter_jacobian(model, start, tensors(model), tuple(VALUES)).cpu().numpy()]


def point_sources(device, **changes):
    model = model_on(device, **changes)
    sources = PointSources(model, opd(), tensors(model), offset=(0.01, 0.0))
    return [sources.images([3, 12, 20], [12, 12, 4]).cpu().numpy()]


def fit_gradient(device, **changes):
    """Through the model itself, by everything that a fit may vary."""
    problem = Problem(model_on(device, **changes), frame(), dr.wavefront.random_opd(1, npix=NPIX))
    solver = Solver([problem], settings(), BASIS, progress=False)
    unknowns = solver.first_unknowns(solver.priors_of(solver.settings))
    (point,) = solver.objective.at(unknowns, unknowns.initial()).points
    pixels = solver.objective.residual(0, point)
    slopes = solver.objective.forwards[0].slopes(point, pixels, torch.zeros(0, 3))
    return [each.numpy() for each in slopes.values()]


def response(device, **changes):
    """Linearisation about values on the processor, which is where a fit keeps its unknowns."""
    model = model_on(device, **changes)
    values = {name: value.cpu() for name, value in tensors(model).items()}
    start = torch.as_tensor(opd(), device=device)
    responses = Reading(ResponseCache(model, BASIS, npix=NPIX // 2), 0.05, 1, is_last=False)
    with torch.no_grad():
        fields = model.fields(start, **values)
    names = ("star_offset", "lyot_shift", "blur")
    of_modes = responses.near(start, values).image(fields, values, amplitude_modes=3)
    of_parameters = responses.parameters(start, values, names, fields)
    return [each.cpu().numpy().ravel() for each in (of_modes, of_parameters)]


def agree(compute, rtol):
    """Compare what a function of a device returns there with what it returns on the processor."""
    expected = compute("cpu")
    with pretended():
        got = compute(DEVICE)
    for ours, theirs in zip(got, expected, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=rtol, atol=rtol * np.abs(theirs).max())


@pytest.mark.parametrize(
    ("compute", "rtol"),
    [
        (gradient, 1e-9),
        (response, 1e-5),
        (fit_gradient, 1e-9),
        pytest.param(
            lambda device: reached(fitted(device, [frame()], {"max_iterations": 10})),
            1e-4,
            marks=pytest.mark.slow,
        ),
        pytest.param(lambda device: search(device, rolls()), 2e-3, marks=pytest.mark.slow),
    ],
    ids=["gradient", "response", "gradient of a fit", "fit", "search of rolls"],
)
def test_results_are_those_of_the_processor(compute, rtol):
    agree(compute, rtol)


@pytest.mark.slow
def test_every_plane_and_effect_of_the_detector():
    def planes(device):
        model = model_on(device, occulter_sampling=3.0)
        fields = model.debug(opd(), **tensors(model))
        return [np.abs(field.cpu().numpy()).ravel() for field in fields.values()]

    def effects(device):
        smooth = torch.as_tensor(opd() * 1e9, device=device)
        kernel = np.arange(1.0, 10.0).reshape(3, 3)
        rows, columns = np.mgrid[:NPIX, :NPIX]
        chain = (
            GaussianBlur(1.2),
            SplineRotation(7.0, smooth.shape),
            PixelCrosstalk(kernel),
            LinearResampling(rows + 0.3, columns - 0.2, smooth.shape),
        )
        return [effect(smooth).cpu().numpy().ravel() for effect in chain]

    agree(planes, rtol=1e-9)
    agree(effects, rtol=1e-9)
    with pretended():
        assert len(model_on(DEVICE).plot(opd=opd())) == 4
        hdus = model_on(DEVICE).calc_psf(nlambda=2)
        assert hdus["DET_SAMP"].data.sum() > 0


@pytest.mark.slow
def test_sampled_planes():
    def rendered(device):
        system = poppy.OpticalSystem(npix=NPIX, pupil_diameter=6.5)
        system.add_pupil(poppy.CircularAperture(radius=3.0))
        system.add_pupil(poppy.ZernikeWFE("aberrations", radius=3.2, coefficients=[0, 0, 0, 1e-7]))
        system.add_image(poppy.BandLimitedCoron(kind="circular", sigma=5.0))
        system.add_pupil(poppy.SecondaryObscuration(secondary_radius=0.7))
        system.add_detector(pixelscale=0.06, fov_pixels=SIZE)
        model = from_poppy(system, 4.5e-6, device=device)
        return [model(opd(), (0.02, 0.01)).detach().cpu().numpy()]

    agree(rendered, rtol=1e-9)


@pytest.mark.slow
def test_what_a_search_leaves_behind(tmp_path):
    """Products, whole frames, and a fit that is read where there is no such device."""
    whole = dr.simulate(model_on("cpu", fov_pixels=60), dr.Scene(), opd(), seed=3)

    def reduced(device):
        fit = fitted(device, [whole.cutout(SIZE)], QUICK)
        detection = dr.detect(fit, inner=0.1)
        detection.write(tmp_path / str(device))
        detection.measure_shape(np.exp(-(detection.grid**2).sum(axis=-1)))
        assert fit.frames[0].render((SIZE + 4, SIZE)).shape == (SIZE + 4, SIZE)
        (observation,) = with_planets(fit.frames, [PLANET])
        assert observation.data.shape == (1, SIZE, SIZE)
        read = Refinement.read(fit.write(tmp_path / f"{device}.fits"))
        assert read.model.device.type == "cpu"
        np.testing.assert_array_equal(read.frames[0].star, fit.frames[0].star)
        found = wide_field(detection, [whole])
        return [float(np.nanstd(found.contrast)), float(np.nanmedian(found.error))]

    agree(reduced, rtol=1e-3)


@pytest.mark.slow
def test_a_pattern():
    seen = frame()
    pattern = 0.01 * np.sin(np.arange(SIZE**2).reshape(SIZE, SIZE))
    known = DetectorPattern(pattern, 0.1 * np.abs(pattern), tuple(seen.center[0]), 0.5)

    def corrected(device):
        start = opd()
        fit = dr.refine(
            model_on(device), [seen, frame(1)], start, settings=settings(**QUICK), pattern=known
        )
        learned = dr.learn_pattern([fitted(device, [frame(k)], QUICK) for k in (0, 1)])
        return [*reached(fit), float(np.std(learned.value))]

    agree(corrected, rtol=1e-4)


def on_gpu(test):
    """Mark a test that runs only with ``-m gpu``."""
    absent = not torch.cuda.is_available()
    return pytest.mark.gpu(pytest.mark.skipif(absent, reason="PyTorch finds no CUDA device")(test))


DTYPES = (torch.float64, torch.float32)


@on_gpu
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize(
    ("compute", "tolerances"),
    [
        (gradient, (1e-9, 2e-4)), (parameter_derivatives, (1e-9, 1e-4)),
        (point_sources, (1e-5, 1e-5)), (response, (1e-5, 1e-4)), (fit_gradient, (1e-9, 2e-4)),
    ],
)  # fmt: skip
def test_images_and_derivatives_on_a_gpu(compute, tolerances, dtype):
    """As a fraction of the rms; on the processor, single precision is off by up to 1.4e-5.

    Sources and responses are computed in single precision in any case.
    """
    got, expected = compute("cuda", dtype=dtype), compute("cpu", dtype=torch.float64)
    for ours, theirs in zip(got, expected, strict=True):
        error = np.linalg.norm(np.subtract(ours, theirs)) / np.linalg.norm(theirs)
        assert error < tolerances[DTYPES.index(dtype)]


@on_gpu
@pytest.mark.parametrize("dtype", DTYPES)
def test_a_search_on_a_gpu(dtype):
    """Chi-squared, position, flux, contrasts and limits of a joint fit of rolls."""
    frames = rolls()
    got, expected = search("cuda", frames, dtype=dtype), search("cpu", frames)
    # Single precision on the processor: up to 4e-4, for positions of 0.1 mas.
    rtol = 1e-3 if dtype == torch.float64 else 1e-2
    np.testing.assert_allclose(got, expected, rtol=rtol, atol=1e-7)


@on_gpu
def test_a_model_is_on_the_gpu_throughout():
    model = model_on("cuda")
    image = model(opd())
    assert image.device.type == model.device.type == "cuda"
    assert model.with_fidelity(npix=128).device.type == "cuda"
    with pytest.raises(RuntimeError, match="device"):
        _ = image + torch.ones(image.shape)
