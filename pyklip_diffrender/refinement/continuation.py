"""Fits that continue earlier ones, with more modes or other settings."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from pyklip_diffrender.linear.frames import Unknown
from pyklip_diffrender.refinement.annealing import Annealing
from pyklip_diffrender.refinement.fit_result import Refinement
from pyklip_diffrender.refinement.frame_fit import FrameFit
from pyklip_diffrender.refinement.problem import Problem, starting_values
from pyklip_diffrender.refinement.settings import GaussNewton
from pyklip_diffrender.refinement.status import breakdown_explained
from pyklip_diffrender.scene.agreement import require_agreement
from pyklip_diffrender.scene.observation import Observation
from pyklip_diffrender.scene.systematics import Systematics
from pyklip_diffrender.wavefront.bases import default_basis
from pyklip_diffrender.wavefront.priors import WavefrontPrior

__all__ = ["continue_from", "fit_in_stages", "join_frames", "refine_again"]

_log = logging.getLogger(__name__)

_STRUCTURE = 1.15
"""Reduced chi-squared above which a fit is repeated with more modes."""

_FOREIGN = 5.0
"""Reduced chi-squared above which more modes would not help, because the frame shows more than the
star."""


def continue_from(fit: Refinement, **changes: Any) -> tuple[GaussNewton, dict[Unknown, float]]:
    """Return the settings and the starting values with which to continue a fit.

    The prior has the final scales of the fit, and the companions are those of the fit.

    Parameters
    ----------
    fit : Refinement
    **changes
        Fields of `GaussNewton` with other values.

    Returns
    -------
    settings : GaussNewton
    warm : dict of Unknown to float
        Final values of the unknowns.

    Raises
    ------
    IncompatibleSetupError
        If the fit was read from a file without its linear model.
    """
    settings = fit.settings
    reached = {
        "prior": _with_scales(settings.prior, fit.scales, "{}"),
        "drift": settings.drift and _with_scales(settings.drift, fit.scales, "{} drift"),
        "dither_drift": settings.dither_drift
        and _with_scales(settings.dither_drift, fit.scales, "{} dither"),
        "companions": fit.planets,
    }
    warm = dict(zip(fit.linear.unknowns, fit.linear.vector.tolist(), strict=True))
    return replace(settings, **{**reached, **changes}), warm


def _with_scales(prior: WavefrontPrior, scales: Mapping[str, float], label: str) -> WavefrontPrior:
    """Replace the scales of a prior by those of a fit; other groups keep theirs."""
    return replace(
        prior, scales={n: scales.get(label.format(n), scale) for n, scale in prior.scales.items()}
    )


def fit_in_stages(
    problems: Sequence[Problem],
    settings: GaussNewton,
    warm: Mapping[Unknown, float] | None = None,
    *,
    progress: bool,
) -> Refinement:
    """Refine with the basis of the settings, or the first default basis that explains the data.

    The `cycles` of the result's settings begin with those of the last basis.

    Parameters
    ----------
    problems : sequence of Problem
        One for each frame.
    settings : GaussNewton
    warm : mapping of Unknown to float, optional
        Starting values.
    progress : bool
        Show progress bars.
    """
    pupil = problems[0].model.entrance
    if settings.basis is not None or not settings.cycles:
        basis = settings.basis or default_basis(pupil=pupil)
        return Annealing(problems, settings, basis, warm, progress).run()
    # The number of modes that drift is fixed.
    grows = settings.wavefront and settings.grow_basis and settings.drift is None
    cycles_to_try = settings.cycles if grows else settings.cycles[:1]
    fit: Refinement | None = None
    for k, cycles in enumerate(cycles_to_try):
        adapted = replace(settings, cycles=settings.cycles[k:])
        if fit is not None:
            _log.info("residuals have structure: adding modes up to %g cycles per pupil", cycles)
            adapted, warm = continue_from(fit, cycles=settings.cycles[k:])
        earlier = fit
        fit = Annealing(problems, adapted, default_basis(cycles, pupil), warm, progress).run()
        if earlier is not None:
            seconds, history = earlier.seconds + fit.seconds, earlier.history + fit.history
            fit = replace(fit, seconds=seconds, history=history)
        if not fit.status.usable or not _STRUCTURE < fit.reduced_chi2 < _FOREIGN:
            break
    assert fit is not None
    return fit


def refine_again(fit: Refinement, *, progress: bool = False, **changes: Any) -> Refinement:
    """Continue a refinement with other settings.

    Parameters
    ----------
    fit : Refinement
    progress : bool
        Show progress bars.
    **changes
        Fields of `GaussNewton` with other values, such as `companions`.

    Raises
    ------
    IncompatibleSetupError
        If the fit was read from a file without its linear model.
    """
    settings, warm = continue_from(fit, **changes)
    problems = [
        Problem(frame.model, frame.observation, fit.initial, frame.start, fit.systematics)
        for frame in fit.frames
    ]
    with breakdown_explained(problems[0].observation.name):
        again = fit_in_stages(problems, settings, warm, progress=progress)
    return replace(again, catalogue_error=fit.catalogue_error, catalogue_flux=fit.catalogue_flux)


def join_frames(
    fit: Refinement,
    others: Sequence[Observation],
    settings: GaussNewton,
    *,
    systematics: Systematics | None,
    progress: bool = False,
) -> Refinement:
    """Continue a fit with more frames in its likelihood, such as those of reference stars.

    The wavefront of the fit is near that of the new frames, whose stars are first aligned with it.
    A few steps of all unknowns then take the place of a fit from the map on.

    Parameters
    ----------
    fit : Refinement
    others : sequence of Observation
        Of the shape of the fitted frames.
    settings : GaussNewton
        Those of the fit, with a prior on the drift between frames.
    systematics : Systematics or None
        Pattern of all frames.
    progress : bool
        Show progress bars.

    Raises
    ------
    IncompatibleSetupError
        If the fit was read from a file without its linear model, and for frames that cannot share
        a fit.
    NoValidPixelsError, ShapeError
        For new frames that do not suit the model.
    """
    require_agreement([*(frame.observation for frame in fit.frames), *others])
    settings, reached = continue_from(replace(fit, settings=settings))
    own = (*settings.own, "pedestal")
    count = len(fit.frames)
    warm = {
        # A single frame has no unknowns of its own.
        each._replace(frame=0) if count == 1 and each.name in own else each: value
        for each, value in reached.items()
    }
    problems = [
        Problem(frame.model, frame.observation, fit.initial, frame.start, systematics)
        for frame in fit.frames
    ]
    bad = {
        (frame.observation.first_pixel, frame.observation.shape): ~frame.observation.valid.any(
            axis=0
        )
        for frame in fit.frames
    }
    for k, observation in enumerate(others, count):
        # Pixels that are bad in the fitted frames are bad in all frames.
        known = bad.get((observation.first_pixel, observation.shape))
        if observation.first_pixel is not None and known is not None:
            observation = replace(observation, valid=observation.valid & ~known)
        start = starting_values(fit.model, observation, {})
        aligned = _aligned(fit, observation, start, settings, systematics)
        for name in own:
            values = aligned.values.get(name, ())
            warm |= {Unknown(name, i, k): float(value) for i, value in enumerate(values)}
        problems.append(Problem(fit.model, aligned.observation, fit.initial, start, systematics))
    with breakdown_explained(problems[0].observation.name):
        joined = fit_in_stages(problems, settings, warm, progress=progress)
    return replace(joined, catalogue_error=fit.catalogue_error, catalogue_flux=fit.catalogue_flux)


def _aligned(
    fit: Refinement,
    observation: Observation,
    start: Mapping[str, Any],
    settings: GaussNewton,
    systematics: Systematics | None,
) -> FrameFit:
    """A frame fitted with the wavefront and the shared parameters of another fit."""
    first = fit.frames[0]
    shared = {n: v for n, v in first.values.items() if n in fit.model.parameters}
    own = tuple(name for name in settings.free if name in settings.own)
    alone = replace(
        settings,
        free=own,
        own=own,
        wavefront=False,
        drift=None,
        dither_drift=None,
        companions=(),
        max_companions=0,
        deviations={n: d for n, d in settings.deviations.items() if n in own},
    )
    kept = {n: v for n, v in shared.items() if n not in own}
    problem = Problem(
        fit.model, observation, replace(fit.initial, data=fit.wavefront), {**kept, **start},
        systematics,
    )  # fmt: skip
    return fit_in_stages([problem], alone, progress=False).frames[0]
