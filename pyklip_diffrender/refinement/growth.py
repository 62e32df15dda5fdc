"""Gauss-Newton with as many modes as the data ask for."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import replace

from pyklip_diffrender.refinement.gauss_newton import GaussNewton
from pyklip_diffrender.refinement.options import GaussNewtonOptions
from pyklip_diffrender.refinement.problem import Problem
from pyklip_diffrender.refinement.result import Refinement
from pyklip_diffrender.scene.objects import Planet
from pyklip_diffrender.wavefront.bases import default_basis

__all__ = ["gauss_newton"]

_log = logging.getLogger(__name__)

_STRUCTURE = 1.15
"""chi2 per pixel, over what it should be, above which more modes are tried."""

_FOREIGN = 5.0
"""The same, above which it is not for lack of modes: something else is in the frame."""


def _leaves_structure(fits: Sequence[Refinement]) -> bool:
    """Whether chi2 is larger than noise and the fitted freedom make it, as for want of modes."""
    return fits[0].status.usable and _STRUCTURE < fits[0].reduced_chi2 < _FOREIGN


def gauss_newton(
    problems: Sequence[Problem], options: GaussNewtonOptions, *, seed: int, progress: bool
) -> list[Refinement]:
    """Refine by damped Gauss-Newton; see `GaussNewton` and `GaussNewtonOptions`."""
    if options.basis is not None or not options.cycles:
        basis = options.basis or default_basis()
        return GaussNewton(problems, replace(options, basis=basis), progress).run(seed)
    found: list[Refinement] = []
    for cycles in options.cycles:
        chosen = replace(options, basis=default_basis(cycles))
        if found:
            _log.info("structure is left: modes to %g cycles", cycles)
            scales = {name: found[0].scales[name] for name in options.prior.scales}
            chosen = replace(
                chosen,
                prior=replace(options.prior, scales=scales),
                planets=_planets(found),
                resume=found[0].linear,
            )
        before, found = found, GaussNewton(problems, chosen, progress).run(seed)
        for earlier, fit in zip(before, found, strict=False):
            fit.seconds += earlier.seconds
            fit.history = earlier.history + fit.history
        # A model error that is allowed for may be what is left, and drifts have no room to grow.
        grows = options.wavefront and options.kappa_floor == 0 and options.drift is None
        if not grows or not _leaves_structure(found):
            break
    return found


def _planets(fits: Sequence[Refinement]) -> tuple[Planet, ...]:
    """Fitted companions; they are given as the first frame has them."""
    science = next((fit for fit in fits if not fit.observation.reference), fits[0])
    return tuple(
        Planet(max(contrast, 0.0), math.hypot(x, y), math.degrees(math.atan2(-x, y)))
        for contrast, x, y in science.companions.tolist()
    )
