"""Scaling of durations with the size of the problem."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from benchmarks.speed.case import Case
from benchmarks.speed.setting import Setting, rendered
from pyklip_diffrender.linear.response import WavefrontResponse, downsample
from pyklip_diffrender.refinement import FitSettings, refine
from pyklip_diffrender.scene.simulation import simulate
from pyklip_diffrender.wavefront.bases import Basis, default_basis

SCALING = "scaling"


def _image(setting: Setting, **changes: Any) -> Callable[[], Callable[[], Any]]:
    return lambda: partial(rendered, setting.model.with_fidelity(**changes), setting.opd)


def scaling(setting: Setting) -> list[Case]:
    """Forward against grid, field and wavelengths; Jacobian against modes; fits against frames."""
    n, field = setting.npix, setting.fov
    cases = [
        Case(f"{SCALING}: forward, pupil grid", f"{k} samples", _image(setting, npix=k), size=k)
        for k in (n // 4, n // 2, n)
    ]
    cases += [
        Case(f"{SCALING}: forward, field", f"{k} pixels", _image(setting, fov_pixels=k), size=k)
        for k in (field // 2, field, 2 * field)
    ]
    cases += [
        Case(
            f"{SCALING}: forward, wavelengths",
            f"{k} wavelengths",
            _image(setting, monochromatic=None, nlambda=k),
            size=k,
        )
        for k in (2, 4, 8)
    ]
    for cycles in (3.0, 5.0) if setting.quick else (6.0, 12.0, 24.0):
        basis = default_basis(cycles)
        cases.append(
            Case(
                f"{SCALING}: Jacobian, modes",
                f"{len(basis)} modes",
                partial(_response, setting, basis),
                size=len(basis),
            )
        )
    for count in (1, 2) if setting.quick else (1, 2, 4):
        cases.append(
            Case(
                f"{SCALING}: refinement, frames",
                f"{count} frames",
                partial(_frames, setting, count),
                size=count,
            )
        )
    return cases


def _response(setting: Setting, basis: Basis) -> Callable[[], None]:
    model, opd, npix = setting.model, setting.opd, setting.coarse[0]
    return lambda: WavefrontResponse(model, basis, opd, {}, npix=npix).store()


def _frames(setting: Setting, count: int) -> Callable[[], Any]:
    """Several frames with their own star positions fitted together: 40 pixels, 8 cycles."""
    npix = setting.npix // 4
    model = setting.host_model.with_fidelity(npix=npix, fov_pixels=setting.fov // 2)
    now, before = (downsample(each.cpu(), npix) for each in (setting.opd, setting.measured))
    frames = [simulate(model, setting.scene, now, seed=k) for k in range(count)]
    basis = default_basis(4.0 if setting.quick else 8.0)
    settings = FitSettings(basis=basis, max_iterations=6)
    return lambda: refine(model, frames, before.numpy(), settings=settings)
