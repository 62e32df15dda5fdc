"""All work on an accelerator, without one: nothing mixes devices, and the results are the same.

The device is pretended, see `pretend_device`; tests/test_gpu.py runs on a real one.
"""

from __future__ import annotations

import device_work as work
import numpy as np
import poppy
import pytest
import torch
from device_work import QUICK, SIZE, fitted, frame, model_on, opd, reached, settings
from pretend_device import DEVICE, pretended

import pyklip_diffrender as dr
from pyklip_diffrender.bridges import from_poppy
from pyklip_diffrender.bridges.sampled_planes import SplineRotation
from pyklip_diffrender.detection import wide_field, with_planets
from pyklip_diffrender.optics import GaussianBlur, LinearResampling, PixelCrosstalk
from pyklip_diffrender.refinement import Refinement
from pyklip_diffrender.scene import Systematics


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
        (work.gradient, 1e-9),
        (work.response, 1e-5),
        (work.fit_gradient, 1e-9),
        pytest.param(work.parameter_derivatives, 1e-9, marks=pytest.mark.slow),
        pytest.param(work.point_sources, 1e-5, marks=pytest.mark.slow),
        pytest.param(
            lambda device: reached(fitted(device, [frame()], {"max_iterations": 10})), 1e-4,
            marks=pytest.mark.slow
        ),
        pytest.param(
            lambda device: work.search(device, work.rolls()), 2e-3, marks=pytest.mark.slow
        ),
    ],
    ids=["gradient", "response", "gradient of a fit", "parameters", "point sources",
         "a fit of everything", "a search of rolls with a reference star"],
)  # fmt: skip
def test_results_are_those_of_the_processor(compute, rtol):
    agree(compute, rtol)


@pytest.mark.slow
def test_every_plane_and_effect_of_the_detector():
    def planes(device):
        model = model_on(device, occulter_sampling=3.0)
        fields = model.debug(opd(), **work.tensors(model))
        return [np.abs(field.cpu().numpy()).ravel() for field in fields.values()]

    def effects(device):
        smooth = torch.as_tensor(opd() * 1e9, device=device)
        kernel = np.arange(1.0, 10.0).reshape(3, 3)
        rows, columns = np.mgrid[: work.NPIX, : work.NPIX]
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
        system = poppy.OpticalSystem(npix=work.NPIX, pupil_diameter=6.5)
        system.add_pupil(poppy.CircularAperture(radius=3.0))
        system.add_pupil(poppy.ZernikeWFE("aberrations", radius=3.2, coefficients=[0, 0, 0, 1e-7]))
        system.add_image(poppy.BandLimitedCoron(kind="circular", sigma=5.0))
        system.add_pupil(poppy.SecondaryObscuration(secondary_radius=0.7))
        system.add_detector(pixelscale=0.06, fov_pixels=SIZE)
        model = from_poppy(system, 4.5e-6, trainable=("aberrations",), device=device)
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
        (observation,) = with_planets(fit.frames, [work.PLANET])
        assert observation.data.shape == (1, SIZE, SIZE)
        read = Refinement.read(fit.write(tmp_path / f"{device}.fits"))
        assert read.model.device.type == "cpu"
        np.testing.assert_array_equal(read.frames[0].star, fit.frames[0].star)
        found = wide_field(detection, [whole])
        return [float(np.nanstd(found.contrast)), float(np.nanmedian(found.error))]

    agree(reduced, rtol=1e-3)


@pytest.mark.slow
def test_systematics():
    seen = frame()
    pattern = 0.01 * np.sin(np.arange(SIZE**2).reshape(SIZE, SIZE))
    known = Systematics(pattern, 0.1 * np.abs(pattern), tuple(seen.center[0]), 0.5)

    def corrected(device):
        start = opd()
        fit = dr.refine(
            model_on(device), [seen, frame(1)], start, settings=settings(**QUICK), systematics=known
        )
        learned = dr.learn_systematics([fitted(device, [frame(k)], QUICK) for k in (0, 1)])
        return [*reached(fit), float(np.std(learned.pattern))]

    agree(corrected, rtol=1e-4)
