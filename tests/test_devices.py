"""All work on an accelerator, without one: nothing mixes devices, and the results are the same.

The device is pretended, see `pretend_device`; tests/test_gpu.py runs on a real one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import poppy
import pytest
import torch
from numpy.typing import NDArray
from pretend_device import DEVICE, pretended

import pyklip_diffrender as dr
from pyklip_diffrender.bridges import from_poppy
from pyklip_diffrender.detection import wide_field
from pyklip_diffrender.linear.forward_mode import jacfwd
from pyklip_diffrender.linear.parameter_derivatives import parameter_jacobian
from pyklip_diffrender.linear.response import Responses
from pyklip_diffrender.optics.detector_effects import GaussianBlur, LinearResampling, PixelCrosstalk
from pyklip_diffrender.optics.fast.point_sources import PointSources
from pyklip_diffrender.optics.rotation import SplineRotation
from pyklip_diffrender.optics.system import OpticalSystem
from pyklip_diffrender.refinement import Adam, GaussNewton, Refinement, Systematics
from pyklip_diffrender.wavefront.bases import FourierModes
from pyklip_diffrender.wavefront.priors import WavefrontPrior

Array = NDArray[np.float64]
Work = Callable[[Any], Sequence[Array | float]]

NPIX, SIZE, FLUX = 64, 24, 3e10
PLANET = dr.Planet(1e-4, 0.5, 120.0)
VALUES = {
    "star_offset": (0.01, -0.02),
    "lyot_shift": (0.002, 0.001),
    "lyot_rotation": 0.3,
    "detector_shift": (0.02, 0.01),
    "blur": 0.03,
    "si_zernikes": np.full(36, 2e-9),
}
"""Every parameter of the model, off its default."""


def agree(work: Work, rtol: float = 1e-6) -> None:
    """Compare what a function of a device returns there with what it returns on the processor."""
    expected = work("cpu")
    with pretended():
        got = work(DEVICE)
    for ours, theirs in zip(got, expected, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=rtol, atol=rtol * np.abs(theirs).max())


def model_on(device: Any, **changes: object) -> OpticalSystem:
    settings = {"monochromatic": 4.5e-6, "npix": NPIX, "fov_pixels": SIZE, **changes}
    return dr.nircam_coronagraph("F444W", device=device, **settings)  # type: ignore[arg-type]


def opd() -> Array:
    return dr.random_opd(1, npix=NPIX).data


def tensors(model: OpticalSystem) -> dict[str, torch.Tensor]:
    return model.values(VALUES)


def frame(k: int = 0, *planets: dr.Planet, **details: object) -> dr.Observation:
    """Light of a drifted star, rolled by 20 degrees a frame."""
    scene = dr.Scene(dr.Star(exposure=200.0), planets=planets)
    seen = dr.simulate(model_on("cpu"), scene, dr.random_opd(1, npix=NPIX), seed=3 + k)
    return replace(seen, position_angles=np.full(len(seen), 20.0 * k), **details)  # type: ignore[arg-type]


def settings(**changes: object) -> GaussNewton:
    """A fit of all parameters, of the wavefront and of the pupil's amplitude."""
    chosen: dict[str, object] = {
        "free": GaussNewton.nircam().free,
        "basis": FourierModes(2),
        "prior": WavefrontPrior(amplitude_cycles=1.5, amplitude_scale=1.0),
        "response_npix": NPIX,
        **changes,
    }
    return GaussNewton(**chosen)  # type: ignore[arg-type]


def fitted(device: Any, frames: Sequence[dr.Observation], **changes: object) -> Refinement:
    return dr.refine(model_on(device), frames, opd(), settings=settings(**changes))


# -- the pretended device ------------------------------------------------------------------------


@pytest.mark.parametrize(
    "mistake",
    [
        lambda there, here: there + here,
        lambda there, here: here.mul_(there),
        lambda there, here: there[0] * here,
        lambda there, here: torch.stack([there, here]),
        lambda there, here: torch.where(there > 0, there, here),
        lambda there, here: here[there.long()],
        lambda there, here: torch.zeros_like(there) + torch.zeros(3, device=here.device),
        lambda there, here: there.numpy(),
        lambda there, here: np.asarray(there),
        lambda there, here: jacfwd(lambda x: x * here)(there),
    ],
)
def test_the_pretended_device_refuses_to_mix(mistake: Callable[..., object]) -> None:
    with pretended():
        there, here = torch.ones(3, device=DEVICE), torch.ones(3)
        with pytest.raises((RuntimeError, TypeError), match=r"one device|\.cpu\(\)"):
            mistake(there, here)


def test_the_pretended_device_follows_data() -> None:
    with pretended():
        here = torch.linspace(0, 1, 3, requires_grad=True)
        there = here.to(DEVICE)
        assert (2 * there[torch.tensor([0, 1])]).device == DEVICE
        assert torch.as_tensor([1.0], device=DEVICE).device == DEVICE
        assert there.detach().cpu().numpy().shape == (3,)
        (there * torch.ones(3, device=DEVICE)).sum().backward()
        assert here.grad is not None
        assert here.grad.device == here.device != DEVICE
        assert jacfwd(torch.sin)(there.detach()).device == DEVICE


# -- images and derivatives ----------------------------------------------------------------------


def image(device: Any) -> list[Array]:
    model = model_on(device)
    return [model(opd(), **tensors(model)).cpu().numpy()]


def gradient(device: Any) -> list[Array]:
    model = model_on(device)
    phase = torch.as_tensor(opd(), device=device).requires_grad_()
    values = {name: value.requires_grad_() for name, value in tensors(model).items()}
    model(phase, **values).square().sum().backward()
    return [each.grad.cpu().numpy().ravel() for each in (phase, *values.values())]  # type: ignore[union-attr]


def forward_mode(device: Any) -> list[Array]:
    model = model_on(device)
    start = torch.as_tensor(opd(), device=device)
    return [parameter_jacobian(model, start, tensors(model), tuple(VALUES)).cpu().numpy()]


def point_sources(device: Any) -> list[Array]:
    model = model_on(device)
    sources = PointSources(model, opd(), tensors(model), offset=(0.01, 0.0))
    return [sources.images([3, 12, 20], [12, 12, 4]).cpu().numpy()]


def response(device: Any) -> list[Array]:
    """Linearisation about values on the processor, which is where a fit keeps its unknowns."""
    model = model_on(device)
    values = {name: value.cpu() for name, value in tensors(model).items()}
    start = torch.as_tensor(opd(), device=device)
    responses = Responses(model, FourierModes(2), npix=NPIX // 2)
    with torch.no_grad():
        fields = model.fields(start, **values)
    near = responses.near(start, values, tuple(values))
    slopes = (
        near.image(fields, values, amplitude_modes=3),
        near.parameters(fields, values),
        responses.parameters(start, values, tuple(values), fields),
    )
    return [each.cpu().numpy().ravel() for each in slopes]


@pytest.mark.parametrize(
    "work", [image, gradient, forward_mode, point_sources, response], ids=lambda work: work.__name__
)
def test_images_and_derivatives(work: Work) -> None:
    agree(work, rtol=1e-5 if work in (point_sources, response) else 1e-9)


@pytest.mark.slow
def test_every_plane_and_effect_of_the_detector() -> None:
    def planes(device: Any) -> list[Array]:
        model = model_on(device, occulter_sampling=3.0)
        fields = model.debug(opd(), **tensors(model))
        return [np.abs(field.cpu().numpy()).ravel() for field in fields.values()]

    def effects(device: Any) -> list[Array]:
        smooth = torch.as_tensor(opd() * 1e9, device=device)
        kernel = np.array([[0.01, 0.02, 0.03], [0.04, 0.8, 0.05], [0.06, 0.07, 0.08]])
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
@pytest.mark.parametrize("trainable", [(), ("aberrations",)])
def test_sampled_planes(trainable: tuple[str, ...]) -> None:
    def work(device: Any) -> list[Array]:
        system = poppy.OpticalSystem(npix=NPIX, pupil_diameter=6.5)
        system.add_pupil(poppy.CircularAperture(radius=3.0))
        system.add_pupil(poppy.ZernikeWFE("aberrations", radius=3.2, coefficients=[0, 0, 0, 1e-7]))
        system.add_image(poppy.BandLimitedCoron(kind="circular", sigma=5.0))
        system.add_pupil(poppy.SecondaryObscuration(secondary_radius=0.7))
        system.add_detector(pixelscale=0.06, fov_pixels=SIZE)
        model = from_poppy(system, 4.5e-6, trainable=trainable, device=device)
        return [model(opd(), (0.02, 0.01)).detach().cpu().numpy()]

    agree(work, rtol=1e-9)


# -- fits and searches ---------------------------------------------------------------------------


def reached(fit: Refinement) -> list[float]:
    assert fit.status.usable
    return [fit.chi2_per_pixel, *fit.frames[0].values["star_offset"], fit.frames[0].flux]


QUICK = {"free": ("star_offset", "flux", "background"), "max_iterations": 5}


def test_a_fit() -> None:
    frames = [frame()]
    agree(lambda device: reached(fitted(device, frames, **QUICK)), rtol=1e-5)


@pytest.mark.slow
def test_a_reduction_of_rolls_with_a_reference_star(tmp_path: Path) -> None:
    """Everything that a joint fit and its search consist of."""
    frames = [
        frame(0, PLANET),
        frame(1, PLANET.rotated(20.0)),
        frame(2, reference=True),
    ]

    def work(device: Any) -> list[float]:
        fit = fitted(device, frames, **QUICK, drift=WavefrontPrior(scales={"texture": 0.05}))
        detection = dr.detect(fit, threshold=5.0, inner=0.1)
        assert len(detection.table) > 0
        shape = detection.subtracted()[0]
        detection.left_out()
        detection.measure_shape(np.exp(-(detection.grid**2).sum(axis=-1)))
        detection.write(tmp_path)
        fit.write(tmp_path / "fit.fits")
        assert fit.frames[0].render((SIZE + 4, SIZE)).shape == (SIZE + 4, SIZE)
        measured = dr.measure(fit, [PLANET.offset])
        curve = dr.contrast_curve(fit)
        return [
            *reached(fit),
            *np.asarray(detection.table["contrast"]),
            *np.asarray(measured["contrast"]),
            *np.asarray(curve["contrast"]),
            float(np.nanstd(shape)),
        ]

    agree(work, rtol=2e-3)


@pytest.mark.slow
def test_planning_and_the_full_model() -> None:
    scene = dr.Scene(dr.Star(exposure=20.0))
    seen = dr.simulate(model_on("cpu", npix=256), scene, dr.random_opd(1, npix=256), seed=3)

    def work(device: Any) -> list[float]:
        model = model_on(device, npix=256)
        simple = GaussNewton(cycles=4)
        return reached(dr.refine(model, seen, dr.random_opd(1, npix=256), settings=simple))

    agree(work, rtol=1e-4)


@pytest.mark.slow
def test_adam_and_systematics() -> None:
    seen = frame()
    pattern = 0.01 * np.sin(np.arange(SIZE**2).reshape(SIZE, SIZE))
    known = Systematics(pattern, 0.1 * np.abs(pattern), tuple(seen.center[0]), 0.5)

    def descent(device: Any) -> list[float]:
        fit = dr.refine(model_on(device), seen, opd(), settings=Adam(iterations=5))
        return [record["loss"] for record in fit.history]

    def corrected(device: Any) -> list[float]:
        start = opd()
        fit = dr.refine(
            model_on(device), [seen, frame(1)], start, settings=settings(), systematics=known
        )
        learned = dr.learn_systematics([fitted(device, [frame(k)]) for k in (0, 1)])
        return [*reached(fit), float(np.std(learned.pattern))]

    agree(descent, rtol=1e-6)
    agree(corrected, rtol=1e-4)


@pytest.mark.slow
def test_whole_frames() -> None:
    frames = [dr.simulate(model_on("cpu", fov_pixels=60), dr.Scene(), opd(), seed=3)]

    def work(device: Any) -> list[float]:
        fit = fitted(device, [each.cutout(SIZE) for each in frames])
        found = wide_field(dr.detect(fit), frames)
        return [float(np.nanstd(found.contrast)), float(np.nanmedian(found.error))]

    agree(work, rtol=1e-3)
