"""The unknowns of a fit, and the values from which they start."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.refinement.forward import (
    Forward,
    Problem,
)
from pyklip_diffrender.refinement.settings import OWN_PARAMETERS, FitSettings, ModePriors
from pyklip_diffrender.refinement.unknowns import FrameUnknowns, Unknowns
from pyklip_diffrender.wavefront.bases import Basis

_PEDESTAL_PRIOR_ERROR = 0.5
"""Relative prior deviation of the pedestal of a known pattern."""

_BRIGHT_PIXEL_RATIO = 0.3
"""Brightness of pixels where the star is bright, relative to its brightest one."""


def first_unknowns(
    forwards: Sequence[Forward], settings: FitSettings, basis: Basis, priors: ModePriors
) -> Unknowns:
    """The unknowns of frames that are fitted together, before companions are added.

    Flux and background start at their best estimates for the starting wavefront. Raises
    `IncompatibleSetupError` if the flux has a prior deviation but no starting value.
    """
    origin = forwards[0].problem.observation
    frames = tuple(
        _frame_unknowns(
            forward, settings, len(basis), len(priors.amplitude),
            forward.problem.observation.roll_from(origin),
        )
        for forward in forwards
    )  # fmt: skip
    own = OWN_PARAMETERS if len(frames) > 1 else ()
    return Unknowns(frames, own, priors.drift, priors.blocks)


def _frame_unknowns(
    forward: Forward, settings: FitSettings, modes: int, amplitude_modes: int, roll: float
) -> FrameUnknowns:
    problem = forward.problem
    free, deviations = settings.free, dict(settings.deviations)
    start = problem.optical_start(tuple(n for n in free if n in problem.model.parameters))
    if problem.has_free_pedestal:
        free = (*free, "pedestal")
        deviations["pedestal"] = _PEDESTAL_PRIOR_ERROR * problem.pedestal
    zero = torch.zeros(1, dtype=torch.float64)
    levels = {"flux": zero, "background": zero, "pedestal": zero + problem.pedestal}
    # The unknowns and their algebra stay on the CPU, wherever the model renders.
    unknowns = FrameUnknowns(
        free,
        {**{n: v.cpu() for n, v in start.items()}, **levels},
        modes,
        amplitude_modes,
        settings.companions,
        roll,
        not problem.observation.reference,
    )
    image = forward.at(unknowns, unknowns.initial()).image
    # With photon-noise weights the faint pixels would dominate this first estimate.
    flat = torch.full_like(problem.sigma, float(problem.sigma.median()))
    # A catalogue's flux is the target's.
    if problem.observation.reference and "flux" not in problem.start:
        deviations.pop("flux", None)
    is_known = "flux" in deviations
    if is_known and "flux" not in problem.start:
        raise IncompatibleSetupError(
            "deviations has 'flux', but start does not: how bright is the star? Give "
            "start={'flux': ...} in the unit of the frames"
        )
    names = tuple(n for n in settings.free if not (is_known and n == "flux"))
    flux, level = problem.flux_and_background(problem.gain * image, flat, names)
    if flux <= 0 and "flux" in names:
        flux = _median_flux(problem, problem.gain * image)
    if is_known:
        deviations["flux"] *= flux
    levels["flux"] = torch.tensor([flux], dtype=torch.float64)
    levels["background"] = torch.tensor([level], dtype=torch.float64)
    return replace(unknowns, start={**unknowns.start, **levels}, deviations=deviations)


def _median_flux(problem: Problem, image: Tensor) -> float:
    """Median flux of the star from the pixels where it is bright.

    Least squares give a negative flux where a companion outshines what the mask leaves of the star.
    """
    bright = problem.valid & (image > _BRIGHT_PIXEL_RATIO * image[problem.valid].max())
    return float((problem.data[bright] / image[bright]).median())
