"""Rows on what the images are for: refinement, S/N map."""

from __future__ import annotations

from functools import cache, partial
from typing import Any

import numpy as np

from benchmarks.speed.case import Accuracy, Case
from benchmarks.speed.rivals import ADAM_STEPS, adam, paper_recipe, star_after_adam
from benchmarks.speed.setting import Setting
from pyklip_diffrender.detection import Detection, detect
from pyklip_diffrender.detection.error_factor import ErrorFactor
from pyklip_diffrender.detection.measurement import contrasts_at
from pyklip_diffrender.detection.templates import Templates
from pyklip_diffrender.refinement import FitSettings, Refinement, refine
from pyklip_diffrender.wavefront.bases import default_basis

REFINEMENT, MAP = "refinement", "S/N map"


def _fit(setting: Setting, start: dict[str, float] | None = None, **changes: Any) -> Refinement:
    """The fit of the frame; the default modes, fewer if quick."""
    options: dict[str, Any] = {"basis": default_basis(6.0 if setting.quick else 24.0), **changes}
    if setting.quick:
        options["max_iterations"] = 10
    measured, settings = setting.measured.cpu().numpy(), FitSettings(**options)
    return refine(setting.model, setting.observation, measured, settings=settings, start=start)


def refinement(setting: Setting) -> list[Case]:
    """The wavefront of one frame that is 40 hours away from the map."""

    def judge(fit: Refinement) -> Accuracy:
        """Error of the star model, background included."""
        sigma = (fit.frames[0].star - setting.star) / setting.noise
        return Accuracy(float(np.sqrt((sigma**2).mean())), float(np.sqrt((sigma**2).mean())))

    def judge_recipe(_: Any) -> Accuracy:
        sigma = setting.judge(star_after_adam(setting)).sigma
        return Accuracy(sigma, sigma)

    start = {"flux": setting.scene.star.photons, "background": 0.0}
    return [
        Case(REFINEMENT, "this package, as it comes", lambda: partial(_fit, setting), judge),
        Case(
            REFINEMENT,
            "this package, the wavefront alone free",
            lambda: partial(_fit, setting, free=(), start=start),
            judge,
            note="alignment and flux known, as in the paper's recipe",
        ),
        Case(
            REFINEMENT,
            f"the paper's recipe, {ADAM_STEPS} Adam steps",
            lambda: adam(paper_recipe(setting.arrays, setting.device), setting.measured, setting),
            judge_recipe,
            reference=True,
            times=ADAM_STEPS,
            note="one step timed, times the number of steps; the error after all steps, taken "
            f"with the multi-fidelity model on {setting.coarse[1]}",
        ),
    ]


def _ring(setting: Setting) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Some positions, x and y in arcsec."""
    radius = np.linspace(0.4, 0.6 if setting.quick else 1.8, 3)
    angle = np.array([0.3, 2.4, 4.5])
    return np.stack([-radius * np.sin(angle), radius * np.cos(angle)], axis=1)


def snr_map(setting: Setting) -> list[Case]:
    """S/N, contrast and its error for a source at every pixel."""
    fit = cache(partial(_fit, setting))

    def judge(detection: Detection) -> Accuracy:
        """S/N on the map against single sources through the fine model, at pixel centres."""
        grid = detection.grid.reshape(-1, 2)
        nearest = [int(np.hypot(*(grid - place).T).argmin()) for place in _ring(setting)]
        single = detection.measure(grid[nearest])["snr"]
        return Accuracy(float(np.abs(detection.snr.reshape(-1)[nearest] - single).max()))

    pixels, places = setting.fov**2, _ring(setting)[:2]
    unscaled = ErrorFactor.constant(1.0)
    return [
        Case(
            MAP,
            f"this package, {pixels} positions",
            lambda: partial(detect, fit(), threshold=8.0, relinearise=np.inf),
            judge,
            note="candidates and contrast curve included",
        ),
        Case(
            MAP,
            "one call of the fine model a position",
            lambda: partial(contrasts_at, Templates(fit()), places, unscaled),
            lambda _: Accuracy(0.0),
            reference=True,
            times=pixels / 2,
            note="two positions timed",
        ),
    ]
