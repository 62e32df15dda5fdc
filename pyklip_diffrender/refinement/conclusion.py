"""The result of a fit: errors of the unknowns about its final state, and the images of the star."""

from __future__ import annotations

import math
from typing import Any

from pyklip_diffrender.refinement.fit_result import Refinement
from pyklip_diffrender.refinement.frame_fit import FrameFit
from pyklip_diffrender.refinement.objective import State
from pyklip_diffrender.refinement.settings import GaussNewton
from pyklip_diffrender.refinement.solver import Solver
from pyklip_diffrender.refinement.status import Status

__all__ = ["conclude"]


def conclude(
    solver: Solver,
    settings: GaussNewton,
    state: State,
    kappa: float,
    status: Status,
    **about: Any,
) -> Refinement:
    """Compute errors and make the result.

    Parameters
    ----------
    solver : Solver
    settings : GaussNewton
        With the prior of the final state.
    state : State
    kappa : float
        Error of the star model that errors include, as a fraction of the star.
    status : Status
    **about
        History and duration of the fit.
    """
    problems = [forward.problem for forward in solver.objective.forwards]
    modes = len(solver.basis) if settings.wavefront else 0
    # Robust weights take a source that is not in the model for an outlier, and a tenth of the light
    # of one of S/N 7 with it.
    robust = solver.objective.robust if kappa else math.inf
    linear = solver.linear_model(state, kappa, modes, robust)
    update = solver.posterior(state)
    assert update.variance is not None
    deviation = update.variance.sqrt()
    priors, ratios = solver.priors, solver.priors.ratios_if_fixed(update, settings)
    if status is Status.CONVERGED and priors.are_improbable(ratios):
        status = Status.PRIOR_MISMATCH
    frames = []
    for k, (problem, point) in enumerate(zip(problems, state.points, strict=True)):
        unknowns = point.unknowns
        own = deviation[state.unknowns.rows[k].rows[: len(linear.frames[k].rows)]]
        values = {n: v.cpu().numpy() for n, v in unknowns.values(point.vector).items()}
        levels = ("flux", "background", *(["pedestal"] if problem.systematics else []))
        for name in levels:
            values[name] = unknowns.start[name].numpy()
        errors = {name: math.nan * value for name, value in values.items()}
        for name in unknowns.ordered:
            values[name] = point.vector[unknowns.where(name)].numpy()
            errors[name] = own[unknowns.where(name)].numpy()
        frames.append(
            FrameFit(
                model=problem.model,
                observation=problem.observation,
                start=problem.start,
                opd=point.opd.cpu().numpy(),
                star=point.star.cpu().numpy(),
                companion_image=(point.total - point.star).cpu().numpy(),
                values=values,
                errors=errors,
                gain=problem.gain.cpu().numpy(),
                coefficients=point.vector[unknowns.where("modes")].numpy(),
            )
        )
    first = state.points[0]
    companions = state.unknowns.where("companions")
    return Refinement(
        frames=tuple(frames),
        initial=problems[0].initial,
        settings=settings,
        basis=solver.basis,
        status=status,
        chi2_per_pixel=solver.objective.chi2_per_pixel(state),
        model_error=kappa,
        companions=first.unknowns.sources(first.vector).numpy(),
        companion_errors=deviation[companions].reshape(-1, 3).numpy(),
        scales=dict(zip(priors.names, priors.scales.tolist(), strict=True)),
        prior_ratios=ratios,
        effective_parameters=update.effective,
        log_evidence=update.log_evidence,
        stored_linear=linear,
        systematics=problems[0].systematics,
        **about,
    )
