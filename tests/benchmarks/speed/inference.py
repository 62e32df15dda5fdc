"""Rows on what the images are for: Jacobian, refinement, S/N map, contrast curve."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache, partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pyklip_diffrender.detection import Detection, contrast_curve, detect, measure
from pyklip_diffrender.linear.response import NANOMETRE, WavefrontResponse, downsample
from pyklip_diffrender.optics.grid import PupilGrid
from pyklip_diffrender.optics.system import OpticalSystem
from pyklip_diffrender.planning import coarse_steps
from pyklip_diffrender.refinement import GaussNewton, Refinement, refine
from pyklip_diffrender.scene.objects import Planet, Scene
from pyklip_diffrender.scene.simulation import planet_photons
from pyklip_diffrender.wavefront.bases import Basis, default_basis
from tests.benchmarks.speed.case import Case, Found
from tests.benchmarks.speed.rivals import paper_recipe
from tests.benchmarks.speed.setting import Setting

__all__ = [
    "CONTRAST",
    "JACOBIAN",
    "MAP",
    "REFINEMENT",
    "contrast",
    "jacobian",
    "refinement",
    "snr_map",
]

JACOBIAN, REFINEMENT = "Jacobian", "refinement"
MAP, CONTRAST = "S/N map", "contrast curve"

_ADAM_STEPS, _LEARNING_RATE = 1000, 1e-11
_SEPARATIONS, _ANGLES = 20, 6


def basis_of(here: Setting) -> Basis:
    """The default modes, fewer if quick."""
    return default_basis(6.0 if here.quick else 24.0)


# -- Jacobian --------------------------------------------------------------------------------------


def jacobian(here: Setting) -> list[Case]:
    """The derivative of the image with respect to all modes."""
    basis = basis_of(here)
    sample = range(0, len(basis), max(1, len(basis) // 4))
    with torch.no_grad():
        fields = here.model.fields(here.opd)

    def response(model: OpticalSystem, npix: int) -> Callable[[], WavefrontResponse]:
        return partial(WavefrontResponse, model, basis, here.opd, {}, npix=npix)

    @lru_cache(maxsize=1)
    def exact() -> Tensor:
        """Of some modes, by the fine model's forward-mode derivative."""
        return torch.stack([_along(here.model, here.opd, basis, k) for k in sample])

    def judge(found: Tensor) -> Found:
        truth = exact()
        return Found(float((found.to(truth.dtype) - truth).norm() / truth.norm()))

    cases = [
        Case(
            JACOBIAN,
            f"this package, {len(basis)} modes on {npix}",
            partial(response, here.model, npix),
            lambda found: judge(found.image(fields, {})[list(sample)]),
            precision="float32",
        )
        for npix in here.coarse[:2]
    ]
    waves = 2 if here.quick else 10
    broad = here.model.with_fidelity(monochromatic=None, nlambda=waves)
    cases.append(
        Case(
            JACOBIAN,
            f"this package, {waves} wavelengths on {here.coarse[0]}",
            lambda: response(broad, here.coarse[0]),
            precision="float32",
            note="error as for one wavelength",
        )
    )
    cases.append(
        Case(
            JACOBIAN,
            f"mode by mode, forward mode on {here.npix}",
            lambda: lambda: _along(here.model, here.opd, basis, 0)[None],
            lambda _: judge(exact()),
            times=len(basis),
            note="one mode timed",
        )
    )

    def differences() -> Callable[[], Tensor]:
        image = paper_recipe(here.arrays, here.device)
        changed = here.opd + NANOMETRE * _mode(here.model, basis, 0).to(here.device)

        def work() -> Tensor:
            with torch.no_grad():
                return image(changed)

        return work

    def judge_differences(_: Any) -> Found:
        image = paper_recipe(here.arrays, here.device)
        with torch.no_grad():
            base = image(here.opd)
            found = [
                image(here.opd + NANOMETRE * _mode(here.model, basis, k).to(here.device)) - base
                for k in sample
            ]
        return judge(torch.stack(found))

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
    here: Setting, observation: Any = None, start: dict[str, float] | None = None, **changes: Any
) -> Refinement:
    options: dict[str, Any] = {"basis": basis_of(here), **changes}
    if here.quick:
        options["max_iterations"] = 10
    return refine(
        here.model,
        observation or here.observation,
        here.measured.cpu().numpy(),
        settings=GaussNewton(**options),
        start=start,
    )


def refinement(here: Setting) -> list[Case]:
    """The wavefront of one frame that is 40 hours away from the map."""
    data = torch.from_numpy(here.observation.data[0]).to(here.device)
    photons = here.scene.star.photons

    def judge(fit: Refinement) -> Found:
        """What the star model misses, background included."""
        sigma = (fit.frames[0].star - here.star) / here.noise
        return Found(float(np.sqrt((sigma**2).mean())), float(np.sqrt((sigma**2).mean())))

    def recipe(image: Callable[[Tensor], Tensor], start: Tensor) -> Callable[[], Tensor]:
        opd = start.clone().requires_grad_()
        optimiser = torch.optim.Adam([opd], lr=_LEARNING_RATE)

        def one() -> Tensor:
            optimiser.zero_grad()
            loss = (photons * image(opd) - data).abs().mean()
            loss.backward()
            optimiser.step()
            return opd

        return one

    def judge_recipe(_: Any) -> Found:
        """All steps, at the pace of the multi-fidelity model, then the fine model's image."""
        coarse = coarse_steps(here.model, here.measured, here.coarse[1])
        small = downsample(here.measured, coarse.npix)
        one = recipe(coarse, small)
        for _step in range(20 if here.quick else _ADAM_STEPS):
            opd = one()
        factor = here.npix // coarse.npix
        change = (opd.detach() - small).repeat_interleave(factor, 0).repeat_interleave(factor, 1)
        with torch.no_grad():
            image = here.model(here.measured + change)
        return Found(here.judge(image).sigma, here.judge(image).sigma)

    known = {"flux": photons, "background": 0.0}
    lean = basis_of(here) if here.quick else default_basis(20.0)
    return [
        Case(REFINEMENT, "this package, as it comes", lambda: partial(_fit, here), judge),
        Case(
            REFINEMENT,
            "this package, the wavefront alone free",
            lambda: partial(_fit, here, free=(), start=known),
            judge,
            note="alignment and flux known, as in the paper's recipe",
        ),
        Case(
            REFINEMENT,
            "this package, the wavefront alone, 20 cycles",
            lambda: partial(_fit, here, free=(), start=known, basis=lean, tolerance=0.1),
            judge,
            note="fewer modes, and a tolerance of 0.1",
        ),
        Case(
            REFINEMENT,
            f"the paper's recipe, {_ADAM_STEPS} Adam steps",
            lambda: recipe(paper_recipe(here.arrays, here.device), here.measured),
            judge_recipe,
            reference=True,
            times=_ADAM_STEPS,
            note="one step timed, times the number of steps; the error after all steps, taken "
            f"with the multi-fidelity model on {here.coarse[1]}",
        ),
    ]


# -- detection -------------------------------------------------------------------------------------


@lru_cache(maxsize=1)
def _fitted(here: Setting) -> Refinement:
    """The fit that all of detection works on."""
    return _fit(here)


def _ring(here: Setting) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Some positions, x and y in arcsec."""
    radius = np.linspace(0.4, 0.6 if here.quick else 1.8, 3)
    angle = np.array([0.3, 2.4, 4.5])
    return np.stack([-radius * np.sin(angle), radius * np.cos(angle)], axis=1)


def snr_map(here: Setting) -> list[Case]:
    """S/N, contrast and its error for a source at every pixel."""
    fit = partial(_fitted, here)

    def judge(found: Detection) -> Found:
        """S/N on the map against single sources through the fine model, at pixel centres."""
        grid = found.grid.reshape(-1, 2)
        near = [int(np.hypot(*(grid - place).T).argmin()) for place in _ring(here)]
        exact = measure(found.fits, grid[near], scatter=found.scatter)["snr"]
        return Found(float(np.abs(found.snr.reshape(-1)[near] - exact).max()))

    pixels = here.fov**2
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
            lambda: (fit(), lambda: measure(fit(), _ring(here)[:2], relinearise=np.inf))[1],
            lambda _: Found(0.0),
            reference=True,
            times=pixels / 2,
            note="two positions timed",
        ),
    ]


def contrast(here: Setting) -> list[Case]:
    """5 sigma contrast at 20 separations and 6 angles."""
    fit = partial(_fitted, here)
    farthest = 0.65 if here.quick else 2.2
    separations = np.linspace(0.3, farthest, _SEPARATIONS)
    radius = 0.5 * (0.3 + farthest)

    def injected() -> tuple[float, float]:
        """Inject at the limit, refine, measure: the measured limit over the closed form's."""
        offset = np.array([[0.0, radius]])
        limit = 5 * float(measure(fit(), offset)["contrast_error"][0])
        planet = Planet(limit, radius, 0.0)
        light = planet_photons(here.model, Scene(), planet, here.opd)
        observation = here.observation
        data = observation.data + light
        again = _fit(here, replace(observation, data=data))
        row = measure(again, offset)[0]
        before = measure(fit(), offset)[0]
        kept = (float(row["contrast"]) - float(before["contrast"])) / limit
        return 5 * float(row["contrast_error"]) / limit, kept

    def judge(_: Any) -> Found:
        ratio, kept = _once()
        return Found(max(abs(ratio - 1), abs(kept - 1)))

    @lru_cache(maxsize=1)
    def _once() -> tuple[float, float]:
        return injected()

    return [
        Case(
            CONTRAST,
            f"this package, {_SEPARATIONS} x {_ANGLES} positions",
            lambda: (fit(), lambda: contrast_curve(fit(), separations, angles=_ANGLES))[1],
            judge,
            note="error: the limit and the light kept of an injected planet, against 1",
        ),
        Case(
            CONTRAST,
            f"{_SEPARATIONS * _ANGLES} injections, each refined again",
            lambda: (fit(), injected)[1],
            lambda _: Found(0.0),
            reference=True,
            times=_SEPARATIONS * _ANGLES,
            note="one injection timed",
        ),
    ]
