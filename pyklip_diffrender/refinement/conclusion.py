"""The end of a fit in the form that users see."""

from __future__ import annotations

from typing import Any

import numpy as np
from torch import Tensor

from pyklip_diffrender.linear.model import LinearModel
from pyklip_diffrender.refinement.misfit import Misfit, State
from pyklip_diffrender.refinement.result import Refinement

__all__ = ["as_refinements"]


def as_refinements(
    misfit: Misfit, state: State, linear: LinearModel, deviation: Tensor, **shared: Any
) -> list[Refinement]:
    """One `Refinement` a frame.

    Parameters
    ----------
    misfit : Misfit
    state : State
        Where the fit ended.
    linear : LinearModel
        About that state.
    deviation : Tensor
        Standard deviations of the joint unknowns that `linear` has.
    **shared
        Fields of `Refinement` that are the same for all frames.
    """
    found = []
    for k, (forward, point) in enumerate(zip(misfit.forwards, state.points, strict=True)):
        unknowns, problem = point.unknowns, forward.problem
        own = deviation[state.joint.rows(k)[: len(linear.frames[k].rows)]]
        values = {n: v.cpu().numpy() for n, v in unknowns.values(point.vector).items()}
        for name in ("flux", "background"):
            values[name] = np.array([unknowns.level(name, point.vector)])
        errors = {name: np.full(len(value), np.nan) for name, value in values.items()}
        for name in unknowns.ordered:
            errors[name] = own[unknowns.where(name)].numpy()
        found.append(
            Refinement(
                model=problem.model,
                observation=problem.observation,
                initial=problem.initial,
                start=problem.start,
                opd=point.opd.cpu().numpy(),
                star_image=point.star.cpu().numpy(),
                values=values,
                errors=errors,
                companions=unknowns.sources(point.vector).numpy(),
                companion_errors=own[unknowns.where("companions")].reshape(-1, 3).numpy(),
                companion_image=(point.total - point.star).cpu().numpy(),
                coefficients=point.vector[unknowns.where("modes")],
                linear=linear,
                frame=k,
                method="gauss-newton",
                **shared,
            )
        )
    return found
