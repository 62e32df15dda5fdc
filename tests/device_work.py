"""What the package computes on a device, for tests on a pretended one and on a GPU.

Every function takes the arguments of `model_on` and returns arrays that do not depend on the device
beyond rounding.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import torch

import pyklip_diffrender as dr
from pyklip_diffrender.linear import ResponseCache, field_derivatives, image_derivatives
from pyklip_diffrender.optics import PointSources, PupilGrid
from pyklip_diffrender.refinement import GaussNewton
from pyklip_diffrender.refinement.forward import Problem
from pyklip_diffrender.refinement.solver import Solver
from pyklip_diffrender.wavefront import FourierModes, WavefrontPrior

NPIX, SIZE = 64, 24
BASIS = FourierModes(2)
PLANET = dr.Planet(1e-4, 0.5, 120.0)
QUICK = {"free": ("star_offset", "flux", "background"), "max_iterations": 10}
VALUES = {
    "star_offset": (0.01, -0.02),
    "lyot_shift": (0.002, 0.001),
    "lyot_rotation": 0.3,
    "detector_shift": (0.02, 0.01),
    "blur": 0.03,
    "si_zernikes": np.full(36, 2e-9),
}
"""Every parameter of the model, off its default."""


def model_on(device, **changes):
    arguments = {"monochromatic": 4.5e-6, "npix": NPIX, "fov_pixels": SIZE, **changes}
    return dr.nircam_coronagraph("F444W", device=device, **arguments)


def opd():
    return dr.random_opd(1, npix=NPIX).data


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
    chosen = {"free": GaussNewton.nircam().free, "prior": prior, **changes}
    return GaussNewton(basis=BASIS, response_npix=NPIX, **chosen)


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
        *np.asarray(dr.measure(fit, [PLANET.offset])["contrast"]),
        *np.asarray(dr.contrast_curve(fit)["contrast"]),
        float(np.nanstd(detection.subtracted[0])),
    ]


def gradient(device, **changes):
    model = model_on(device, **changes)
    phase = torch.as_tensor(opd(), device=device).requires_grad_()
    values = {name: value.requires_grad_() for name, value in tensors(model).items()}
    model(phase, **values).square().sum().backward()
    return [each.grad.cpu().numpy().ravel() for each in (phase, *values.values())]


def parameter_jacobian(model, opd, values, names, fields=None):
    """Derivatives of the image, (components, ny, nx); the fields may be those of a finer model."""
    slopes = field_derivatives(model, opd, values, names)
    fields = model.fields(opd, **values) if fields is None else fields
    return image_derivatives(model, fields, values, names, slopes)


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
    problem = Problem(model_on(device, **changes), frame(), dr.random_opd(1, npix=NPIX))
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
    responses = ResponseCache(model, BASIS, npix=NPIX // 2)
    with torch.no_grad():
        fields = model.fields(start, **values)
    names = ("star_offset", "lyot_shift", "blur")
    of_modes = responses.near(start, values).image(fields, values, amplitude_modes=3)
    of_parameters = responses.parameters(start, values, names, fields)
    return [each.cpu().numpy().ravel() for each in (of_modes, of_parameters)]
