"""Rows on what the images are for: Jacobian, refinement, S/N map."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.speed.case import Accuracy, Case
from benchmarks.speed.rivals import paper_recipe
from benchmarks.speed.setting import Setting, coarse_steps
from pyklip_diffrender.detection import Detection, detect
from pyklip_diffrender.detection.error_factor import ErrorFactor
from pyklip_diffrender.detection.measurement import contrasts_at
from pyklip_diffrender.detection.templates import groups_of
from pyklip_diffrender.linear.response import NANOMETRE, WavefrontResponse, downsample
from pyklip_diffrender.optics.grid import PupilGrid
from pyklip_diffrender.optics.system import OpticalSystem
from pyklip_diffrender.refinement import FitSettings, Refinement, refine
from pyklip_diffrender.wavefront.bases import Basis, default_basis

JACOBIAN, REFINEMENT = "Jacobian", "refinement"
MAP = "S/N map"

_ADAM_STEPS, _LEARNING_RATE = 1000, 1e-11


def basis_of(setting: Setting) -> Basis:
    """The default modes, fewer if quick."""
    return default_basis(6.0 if setting.quick else 24.0)


# -- Jacobian --------------------------------------------------------------------------------------


def jacobian(setting: Setting) -> list[Case]:
    """The derivative of the image with respect to all modes."""
    basis = basis_of(setting)
    sample = range(0, len(basis), max(1, len(basis) // 4))
    with torch.no_grad():
        fields = setting.model.fields(setting.opd)

    def response(model: OpticalSystem, npix: int) -> Callable[[], WavefrontResponse]:
        return partial(WavefrontResponse, model, basis, setting.opd, {}, npix=npix)

    @lru_cache(maxsize=1)
    def exact() -> Tensor:
        """Derivatives by some modes, from forward mode through the fine model."""
        return torch.stack([_along(setting.model, setting.opd, basis, k) for k in sample])

    def judge(rows: Tensor) -> Accuracy:
        truth = exact()
        return Accuracy(float((rows.to(truth.dtype) - truth).norm() / truth.norm()))

    cases = [
        Case(
            JACOBIAN,
            f"this package, {len(basis)} modes on {npix}",
            partial(response, setting.model, npix),
            lambda derivative: judge(derivative.image(fields, {})[list(sample)]),
            precision="float32",
        )
        for npix in setting.coarse[:2]
    ]
    waves = 2 if setting.quick else 10
    broad = setting.model.with_fidelity(monochromatic=None, nlambda=waves)
    cases.append(
        Case(
            JACOBIAN,
            f"this package, {waves} wavelengths on {setting.coarse[0]}",
            lambda: response(broad, setting.coarse[0]),
            precision="float32",
            note="error as for one wavelength",
        )
    )
    cases.append(
        Case(
            JACOBIAN,
            f"mode by mode, forward mode on {setting.npix}",
            lambda: lambda: _along(setting.model, setting.opd, basis, 0)[None],
            lambda _: judge(exact()),
            times=len(basis),
            note="one mode timed",
        )
    )

    def differences() -> Callable[[], Tensor]:
        image = paper_recipe(setting.arrays, setting.device)
        changed = setting.opd + NANOMETRE * _mode(setting.model, basis, 0).to(setting.device)

        def work() -> Tensor:
            with torch.no_grad():
                return image(changed)

        return work

    def judge_differences(_: Any) -> Accuracy:
        image = paper_recipe(setting.arrays, setting.device)
        with torch.no_grad():
            base = image(setting.opd)
            differences_of_modes = [
                image(setting.opd + NANOMETRE * _mode(setting.model, basis, k).to(setting.device))
                - base
                for k in sample
            ]
        return judge(torch.stack(differences_of_modes))

    cases.append(
        Case(
            JACOBIAN,
            "finite differences of the paper's renderer",
            differences,
            judge_differences,
            reference=True,
            times=len(basis) + 1,
            note="one image timed; steps of 1 nm rms",
        )
    )
    return cases


def _mode(model: OpticalSystem, basis: Basis, k: int) -> Tensor:
    return basis.modes(PupilGrid.full(model.npix, model.diameter), k, k + 1)[0]


def _along(model: OpticalSystem, opd: Tensor, basis: Basis, k: int) -> Tensor:
    """Derivative of the image along one mode, per nm."""
    mode = NANOMETRE * _mode(model, basis, k).to(opd.device)
    return torch.func.jvp(lambda o: model(o), (opd,), (mode,))[1]


# -- refinement ------------------------------------------------------------------------------------


def _fit(
    setting: Setting, observation: Any = None, start: dict[str, float] | None = None, **changes: Any
) -> Refinement:
    options: dict[str, Any] = {"basis": basis_of(setting), **changes}
    if setting.quick:
        options["max_iterations"] = 10
    return refine(
        setting.model,
        observation or setting.observation,
        setting.measured.cpu().numpy(),
        settings=FitSettings(**options),
        start=start,
    )


def refinement(setting: Setting) -> list[Case]:
    """The wavefront of one frame that is 40 hours away from the map."""
    data = torch.from_numpy(setting.observation.data[0]).to(setting.device)
    photons = setting.scene.star.photons

    def judge(fit: Refinement) -> Accuracy:
        """Error of the star model, background included."""
        sigma = (fit.frames[0].star - setting.star) / setting.noise
        return Accuracy(float(np.sqrt((sigma**2).mean())), float(np.sqrt((sigma**2).mean())))

    def recipe(image: Callable[[Tensor], Tensor], start: Tensor) -> Callable[[], Tensor]:
        opd = start.clone().requires_grad_()
        optimiser = torch.optim.Adam([opd], lr=_LEARNING_RATE)

        def step() -> Tensor:
            optimiser.zero_grad()
            loss = (photons * image(opd) - data).abs().mean()
            loss.backward()
            optimiser.step()
            return opd

        return step

    def judge_recipe(_: Any) -> Accuracy:
        """All steps, at the pace of the multi-fidelity model, then the fine model's image."""
        coarse = coarse_steps(setting.model, setting.measured, setting.coarse[1])
        small = downsample(setting.measured, coarse.npix)
        step = recipe(coarse, small)
        for _step in range(20 if setting.quick else _ADAM_STEPS):
            opd = step()
        factor = setting.npix // coarse.npix
        change = (opd.detach() - small).repeat_interleave(factor, 0).repeat_interleave(factor, 1)
        with torch.no_grad():
            image = setting.model(setting.measured + change)
        return Accuracy(setting.judge(image).sigma, setting.judge(image).sigma)

    start = {"flux": photons, "background": 0.0}
    lean = basis_of(setting) if setting.quick else default_basis(20.0)
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
            "this package, the wavefront alone, 20 cycles",
            lambda: partial(_fit, setting, free=(), start=start, basis=lean, tolerance=0.1),
            judge,
            note="fewer modes, and a tolerance of 0.1",
        ),
        Case(
            REFINEMENT,
            f"the paper's recipe, {_ADAM_STEPS} Adam steps",
            lambda: recipe(paper_recipe(setting.arrays, setting.device), setting.measured),
            judge_recipe,
            reference=True,
            times=_ADAM_STEPS,
            note="one step timed, times the number of steps; the error after all steps, taken "
            f"with the multi-fidelity model on {setting.coarse[1]}",
        ),
    ]


# -- detection -------------------------------------------------------------------------------------


@lru_cache(maxsize=1)
def _fitted(setting: Setting) -> Refinement:
    """The fit that all of detection works on."""
    return _fit(setting)


def _ring(setting: Setting) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Some positions, x and y in arcsec."""
    radius = np.linspace(0.4, 0.6 if setting.quick else 1.8, 3)
    angle = np.array([0.3, 2.4, 4.5])
    return np.stack([-radius * np.sin(angle), radius * np.cos(angle)], axis=1)


def snr_map(setting: Setting) -> list[Case]:
    """S/N, contrast and its error for a source at every pixel."""
    fit = partial(_fitted, setting)

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
            lambda: (fit(), lambda: detect(fit(), threshold=8.0, relinearise=np.inf))[1],
            judge,
            note="candidates and contrast curve included",
        ),
        Case(
            MAP,
            "one call of the fine model a position",
            lambda: (fit(), lambda: contrasts_at(groups_of([fit()]), places, unscaled))[1],
            lambda _: Accuracy(0.0),
            reference=True,
            times=pixels / 2,
            note="two positions timed",
        ),
    ]
