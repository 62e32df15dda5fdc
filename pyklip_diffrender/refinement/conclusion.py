"""The result of a fit: errors of the unknowns about its final state, and the images of the star."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch

from pyklip_diffrender.refinement.fit_result import FrameFit, Refinement, Status
from pyklip_diffrender.refinement.forward import (
    Forward,
    FrameDerivatives,
    State,
    allowance,
)
from pyklip_diffrender.refinement.settings import FitSettings, ModePriors
from pyklip_diffrender.refinement.solver import Solver
from pyklip_diffrender.refinement.unknowns import brightest


def derivatives_of(
    fit: Refinement, forwards: Sequence[Forward], error: float
) -> list[FrameDerivatives]:
    """The derivatives of all frames about the final state of a fit, whose error is `error`."""
    modes = len(fit.basis) if fit.settings.wavefront else 0
    derivatives = []
    for forward, frame, linear in zip(forwards, fit.frames, fit.linear.frames, strict=True):
        sources = torch.from_numpy(fit.companions)
        if frame.observation.reference:
            sources = sources[:0]
        allowed = allowance(forward)
        derivatives.append(
            FrameDerivatives(
                jacobian=linear.jacobian,
                modes=modes,
                opd=torch.from_numpy(frame.opd).to(forward.model.device),
                values={name: torch.as_tensor(v) for name, v in frame.values.items()},
                sources=sources,
                bright=brightest(sources),
                error=max(error, allowed),
                allowance=allowed,
            )
        )
    return derivatives


def conclude(
    solver: Solver,
    settings: FitSettings,
    priors: ModePriors,
    state: State,
    kappa: float,
    status: Status,
    **about: Any,
) -> Refinement:
    """Compute errors about a final state, and make the result; `about` has history and duration.

    Settings and priors are the final ones. The errors include the model error `kappa`.
    """
    problems = [forward.problem for forward in solver.objective.forwards]
    modes = len(solver.basis) if settings.wavefront else 0
    # Robust weights take a source that is not in the model for an outlier: a source of S/N 7 loses
    # a tenth of its light.
    robust = solver.objective.robust if kappa else math.inf
    linear = solver.linear_model(state, priors, kappa, modes, robust)
    update = solver.posterior(state, priors)
    assert update.variance is not None
    deviation = update.variance.sqrt()
    ratios = priors.ratios_if_fixed(update, settings)
    if status is Status.CONVERGED and priors.are_improbable(ratios):
        status = Status.PRIOR_MISMATCH
    frames = []
    for k, (problem, point) in enumerate(zip(problems, state.points, strict=True)):
        unknowns = point.unknowns
        own = deviation[state.unknowns.rows[k].rows[: len(linear.frames[k].rows)]]
        values = {n: v.cpu().numpy() for n, v in unknowns.values(point.vector).items()}
        levels = ("flux", "background", *(["pedestal"] if problem.pattern else []))
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
        pattern=problems[0].pattern,
        **about,
    )
