"""Fits that continue earlier ones, with more modes, a wider prior or other settings."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.linear.frames import Unknown
from pyklip_diffrender.refinement.annealing import Annealing
from pyklip_diffrender.refinement.problem import Problem
from pyklip_diffrender.refinement.result import Refinement
from pyklip_diffrender.refinement.settings import GaussNewton
from pyklip_diffrender.refinement.status import Status
from pyklip_diffrender.wavefront.bases import default_basis
from pyklip_diffrender.wavefront.priors import WavefrontPrior

__all__ = ["continue_from", "fit_in_stages"]

_log = logging.getLogger(__name__)

_STRUCTURE = 1.15
"""Reduced chi-squared above which a fit is repeated with more modes."""

_FOREIGN = 5.0
"""Reduced chi-squared above which more modes would not help, because the frame shows more than the
star."""

_WIDENINGS = 3
"""Largest number of times that a prior is widened. Two rolls of HIP 17695 in F444W needed two."""


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
        If the fit is by another method.
    """
    settings = fit.settings
    if fit.linear is None or not isinstance(settings, GaussNewton) or fit.basis is None:
        raise IncompatibleSetupError(
            f"only a fit by Gauss-Newton can be continued, this one is by {fit.method!r}"
        )
    reached = {
        "prior": _with_scales(settings.prior, fit.scales, "{}"),
        "drift": settings.drift and _with_scales(settings.drift, fit.scales, "{} drift"),
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
    seed: int,
    progress: bool,
) -> Refinement:
    """Refine with the basis of the settings, or the first default basis that explains the data.

    With `GaussNewton.widen_prior`, a prior that turns out to be too narrow is widened. The `cycles`
    of the result's settings begin with those of the last basis.

    Parameters
    ----------
    problems : sequence of Problem
        One for each frame.
    settings : GaussNewton
    warm : mapping of Unknown to float, optional
        Starting values.
    seed : int
        Recorded with the result.
    progress : bool
        Show progress bars.
    """
    fit = _fit_with_growing_basis(problems, settings, warm, seed=seed, progress=progress)
    for _ in range(_WIDENINGS if settings.widen_prior else 0):
        if fit.status is not Status.PRIOR_MISMATCH:
            break
        _log.info("the wavefront is improbable under its prior, by factors %s", fit.prior_ratios)
        adapted, warm = _with_wider_prior(fit)
        assert fit.basis is not None
        again = Annealing(problems, adapted, fit.basis, warm, progress).run(seed)
        if not again.status.usable:
            break
        fit = _with_history_of(fit, again)
    return fit


def _with_wider_prior(fit: Refinement) -> tuple[GaussNewton, dict[Unknown, float]]:
    """Settings and starting values of a fit, with scales raised towards the highest evidence."""
    wider = {name: max(ratio, 1.0) for name, ratio in fit.prior_ratios.items()}
    scales = {name: scale * wider[name] for name, scale in fit.scales.items()}
    settings, warm = continue_from(replace(fit, scales=scales))
    amplitude = settings.prior.amplitude_scale * wider["amplitude"]
    prior = replace(settings.prior, amplitude_scale=amplitude)
    return replace(settings, prior=prior), warm


def _with_history_of(earlier: Refinement, fit: Refinement) -> Refinement:
    """A fit with the time and the iterations of the one that it continues."""
    return replace(
        fit, seconds=fit.seconds + earlier.seconds, history=earlier.history + fit.history
    )


def _fit_with_growing_basis(
    problems: Sequence[Problem],
    settings: GaussNewton,
    warm: Mapping[Unknown, float] | None,
    *,
    seed: int,
    progress: bool,
) -> Refinement:
    pupil = problems[0].model.entrance
    if settings.basis is not None or not settings.cycles:
        basis = settings.basis or default_basis(pupil=pupil)
        return Annealing(problems, settings, basis, warm, progress).run(seed)
    # With an assumed model error the residual need not be missing modes. The number of modes that
    # drift is fixed.
    grows = settings.wavefront and settings.min_model_error == 0 and settings.drift is None
    cycles_to_try = settings.cycles if grows else settings.cycles[:1]
    fit: Refinement | None = None
    for k, cycles in enumerate(cycles_to_try):
        adapted = replace(settings, cycles=settings.cycles[k:])
        if fit is not None:
            _log.info("residuals have structure: adding modes up to %g cycles per pupil", cycles)
            adapted, warm = continue_from(fit, cycles=settings.cycles[k:])
        earlier = fit
        fit = Annealing(problems, adapted, default_basis(cycles, pupil), warm, progress).run(seed)
        if earlier is not None:
            fit = _with_history_of(earlier, fit)
        if not fit.status.usable or not _STRUCTURE < fit.reduced_chi2 < _FOREIGN:
            break
    assert fit is not None
    return fit
