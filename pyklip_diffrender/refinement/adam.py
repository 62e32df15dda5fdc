"""The recipe of Feng et al. 2025: Adam on every pixel of the OPD."""

from __future__ import annotations

import math
import time
from typing import Any

import numpy as np
import torch

from pyklip_diffrender.io.progress import ProgressBar
from pyklip_diffrender.refinement.frame_fit import FrameFit
from pyklip_diffrender.refinement.problem import Problem
from pyklip_diffrender.refinement.result import Refinement
from pyklip_diffrender.refinement.settings import Adam
from pyklip_diffrender.refinement.status import Status

__all__ = ["adam"]


def adam(problem: Problem, settings: Adam, *, seed: int, progress: bool) -> Refinement:
    """Refine the OPD pixels with Adam on the mean absolute error; return the best iterate.

    Star offset and alignment keep their starting values, and so do flux and background if `start`
    has them; otherwise these are fitted to the starting star by least squares.
    """
    began = time.perf_counter()
    values = problem.optical_start(())
    start = problem.starting_opd(problem.model.npix)
    opd = start.to(problem.model.dtype).clone().requires_grad_()
    with torch.no_grad():
        image = problem.model(opd, **values).double()
    names = tuple(name for name in ("flux", "background") if name not in problem.start)
    flux, background = problem.flux_and_background(image, problem.sigma, names)
    optimiser = torch.optim.Adam([opd], lr=settings.learning_rate)
    history: list[dict[str, Any]] = []
    best_loss, best = math.inf, start
    with ProgressBar("Adam", settings.iterations, shown=progress) as bar:
        for iteration in range(settings.iterations):
            optimiser.zero_grad()
            star = flux * problem.model(opd, **values) + background
            loss = (star - problem.data)[problem.valid].abs().mean()
            loss.backward()
            value = float(loss.detach())
            history.append({"iteration": iteration, "loss": value})
            if value < best_loss:
                best_loss, best = value, opd.detach().clone()
            optimiser.step()
            bar.update(loss=value)
    with torch.no_grad():
        star = flux * problem.model(best, **values).double() + background
    noise = ((problem.data - star) / problem.sigma)[problem.valid]
    fitted = {name: value.detach().cpu().numpy() for name, value in values.items()}
    fitted |= {"flux": np.array([flux]), "background": np.array([background])}
    frame = FrameFit(
        model=problem.model,
        observation=problem.observation,
        start=problem.start,
        opd=best.detach().double().cpu().numpy(),
        star=star.cpu().numpy(),
        companion_image=np.zeros(problem.observation.shape),
        values=fitted,
        errors={name: math.nan * value for name, value in fitted.items()},
        gain=np.ones(problem.observation.shape),
    )
    return Refinement(
        frames=(frame,),
        initial=problem.initial,
        settings=settings,
        status=Status.COMPLETED if math.isfinite(best_loss) else Status.DIVERGED,
        chi2_per_pixel=float((noise**2).mean()),
        history=history,
        seconds=time.perf_counter() - began,
        seed=seed,
    )
