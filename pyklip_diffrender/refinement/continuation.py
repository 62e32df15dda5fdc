"""Fits that go on from one another: with more modes, or with other settings."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.linear.model import Unknown
from pyklip_diffrender.refinement.annealing import Annealing
from pyklip_diffrender.refinement.problem import Problem
from pyklip_diffrender.refinement.result import Refinement
from pyklip_diffrender.refinement.settings import GaussNewton
from pyklip_diffrender.wavefront.bases import default_basis
from pyklip_diffrender.wavefront.priors import WavefrontPrior

__all__ = ["continued", "fit_with_growing_basis", "warm_start"]

_log = logging.getLogger(__name__)

_STRUCTURE = 1.15
"""Reduced chi-squared above which more modes are tried."""

_FOREIGN = 5.0
"""Reduced chi-squared above which modes are not what is missing: something else is in the frame."""


def warm_start(fit: Refinement) -> dict[Unknown, float]:
    """Return where a fit ended, by unknown."""
    assert fit.linear is not None
    return dict(zip(fit.linear.unknowns, fit.linear.vector.tolist(), strict=True))


def continued(fit: Refinement, **changes: Any) -> GaussNewton:
    """Return the settings with which to go on from a fit.

    The prior has the scales that the fit ended with, the companions are those that it found, and
    the basis is as fine as the fit's, or finer.

    Parameters
    ----------
    fit : Refinement
    **changes
        Fields of `GaussNewton` with other values.

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
    return replace(settings, **{**reached, **changes})


def _with_scales(prior: WavefrontPrior, scales: Mapping[str, float], label: str) -> WavefrontPrior:
    """The prior with the scales of a fit; groups that its basis lacks keep their own."""
    return replace(
        prior, scales={n: scales.get(label.format(n), own) for n, own in prior.scales.items()}
    )


def fit_with_growing_basis(
    problems: Sequence[Problem],
    settings: GaussNewton,
    warm: Mapping[Unknown, float] | None = None,
    *,
    seed: int,
    progress: bool,
) -> Refinement:
    """Refine with the settings' basis, or with the first default basis that explains the data.

    The settings of the result start with the basis that it ended with.

    Parameters
    ----------
    problems : sequence of Problem
        One for each frame.
    settings : GaussNewton
    warm : mapping of Unknown to float, optional
        Where to start.
    seed : int
        Recorded with the result.
    progress : bool
        Show progress bars.
    """
    if settings.basis is not None or not settings.cycles:
        basis = settings.basis or default_basis()
        return Annealing(problems, settings, basis, warm, progress).run(seed)
    # A model error that is allowed for may be what is left, and drifts have no room to grow.
    grows = settings.wavefront and settings.min_model_error == 0 and settings.drift is None
    tried = settings.cycles if grows else settings.cycles[:1]
    fit: Refinement | None = None
    for k, cycles in enumerate(tried):
        chosen = replace(settings, cycles=settings.cycles[k:])
        if fit is not None:
            _log.info("structure is left: modes up to %g cycles per pupil", cycles)
            chosen, warm = continued(fit, cycles=settings.cycles[k:]), warm_start(fit)
        earlier = fit
        fit = Annealing(problems, chosen, default_basis(cycles), warm, progress).run(seed)
        if earlier is not None:
            fit = replace(
                fit,
                seconds=fit.seconds + earlier.seconds,
                history=earlier.history + fit.history,
            )
        if not fit.status.usable or not _STRUCTURE < fit.reduced_chi2 < _FOREIGN:
            break
    assert fit is not None
    return fit
