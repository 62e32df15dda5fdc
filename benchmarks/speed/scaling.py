"""Scaling of durations with the size of the problem, and lower limits of durations."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import torch
from scipy.linalg import cholesky
from scipy.linalg.blas import dsyrk
from torch.utils.flop_counter import FlopCounterMode

from benchmarks.speed.case import Case
from benchmarks.speed.inference import basis_of
from benchmarks.speed.setting import Setting, coarse_steps
from benchmarks.speed.timing import interleaved
from pyklip_diffrender.linear.response import WavefrontResponse, downsample
from pyklip_diffrender.refinement import GaussNewton, refine
from pyklip_diffrender.scene.simulation import simulate
from pyklip_diffrender.wavefront.bases import Basis, default_basis

SCALING = "scaling"


def _image(setting: Setting, **changes: Any) -> Callable[[], Callable[[], Any]]:
    def make() -> Callable[[], Any]:
        model = setting.model.with_fidelity(**changes)
        opd = torch.nn.functional.avg_pool2d(setting.opd[None], setting.npix // model.npix)[0]

        def work() -> Any:
            with torch.no_grad():
                return model(opd)

        return work

    return make


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


def _response(setting: Setting, basis: Basis) -> Callable[[], WavefrontResponse]:
    return partial(WavefrontResponse, setting.model, basis, setting.opd, {}, npix=setting.coarse[0])


def _frames(setting: Setting, count: int) -> Callable[[], Any]:
    """Several frames with their own star positions fitted together: 40 pixels, 8 cycles."""
    npix = setting.npix // 4
    model = setting.host_model.with_fidelity(npix=npix, fov_pixels=setting.fov // 2)
    small = torch.nn.functional.avg_pool2d(
        torch.stack([setting.opd, setting.measured])[None].cpu(), setting.npix // npix
    )[0]
    frames = [simulate(model, setting.scene, small[0], seed=k) for k in range(count)]
    basis = default_basis(4.0 if setting.quick else 8.0)
    settings = GaussNewton(basis=basis, max_iterations=6)
    return lambda: refine(model, frames, small[1].numpy(), settings=settings)


# -- the machine's limit ---------------------------------------------------------------------------


def _rates(device: str) -> dict[str, float]:
    """Operations per second of products, bytes per second of a copy, cosines per second."""
    side = 512
    rates = {}
    for dtype, name in ((torch.float64, "float64"), (torch.float32, "float32")):
        a = torch.ones(side, side, dtype=dtype, device=device)
        out = torch.empty_like(a)
        (best,) = interleaved([partial(torch.mm, a, a, out=out)], 0.2, device)
        rates[name] = 2 * side**3 / best
    large = torch.ones(2**23, dtype=torch.float64, device=device)
    target = torch.empty_like(large)
    (best,) = interleaved([lambda: target.copy_(large)], 0.2, device)
    rates["bytes"] = 2 * 8 * len(large) / best
    angles = torch.linspace(-3, 3, 2**17, dtype=torch.float64, device=device)
    room = torch.empty_like(angles)
    (best,) = interleaved([lambda: torch.cos(angles, out=room)], 0.1, device)
    rates["cosines"] = len(angles) / best
    return rates


def _products(work: Callable[[], Any]) -> float:
    """Operations of all matrix products in a call."""
    with FlopCounterMode(display=False) as counter:
        work()
    return float(counter.get_total_flops())


def limits(setting: Setting) -> list[dict[str, float | str]]:
    """Operations and bytes of these methods, and the shortest durations that they allow.

    The rates are measured in the same run: a product of large matrices, a copy that does not fit
    into the cache, cosines that do.

    Returns
    -------
    list of dict
        what, gflop, cosines, bytes, limit (s, the sum of the three at full rate), seconds.
    """
    rates = _rates(setting.device)
    model, basis = setting.model, basis_of(setting)
    lit = float(model.entrance.lit.sum())
    mixed = coarse_steps(model, setting.measured, setting.coarse[0], torch.float32)

    def fine() -> Any:
        with torch.no_grad():
            return model(setting.opd)

    def coarse() -> Any:
        with torch.no_grad():
            return mixed(downsample(setting.opd, mixed.npix))

    def response() -> Any:
        return WavefrontResponse(model, basis, setting.opd, {}, npix=setting.coarse[0])

    def step() -> Any:
        return torch.autograd.grad(model(opd).sum(), opd)

    opd = setting.opd.clone().requires_grad_()
    samples = float(setting.npix**2)
    response_bytes = 8.0 * len(basis) * setting.fov**2
    modes = 8.0 * len(basis) * setting.coarse[0] ** 2
    rows: list[dict[str, float | str]] = []
    for quantity, work, name, cosines, moved in (
        ("forward", fine, "float64", 2 * lit, 16 * samples),
        ("multi-fidelity forward", coarse, "float32",
         2 * lit * (setting.coarse[0] / setting.npix) ** 2, 8 * samples),
        # The field and its derivative are complex, and written once and read once.
        ("forward + backward", step, "float64", 2 * lit, (16 + 4 * 16) * samples),
        ("Jacobian", response, "float32", 0.0, 2 * modes + response_bytes),
    ):  # fmt: skip
        work()
        operations = _products(work)
        (seconds,) = interleaved([work], 1.0, setting.device)
        parts = operations / rates[name], moved / rates["bytes"], cosines / rates["cosines"]
        rows.append(
            {
                "what": quantity,
                "gflop": operations / 1e9,
                "cosines": cosines,
                "bytes": moved,
                "products_s": parts[0],
                "bytes_s": parts[1],
                "cosines_s": parts[2],
                "limit": sum(parts),
                "seconds": seconds,
            }
        )
    count, pixels = len(basis), setting.fov**2
    jacobian = np.random.default_rng(1).standard_normal((count, pixels)).T

    def solved() -> Any:
        curvature = dsyrk(1.0, jacobian, trans=True, lower=True)
        return cholesky(curvature + pixels * np.eye(count), lower=True)

    (seconds,) = interleaved([solved], 1.0)
    operations = count**2 * pixels + count**3 / 3
    rows.append(
        {
            "what": "normal equations of a Gauss-Newton step",
            "gflop": operations / 1e9,
            "cosines": 0.0,
            "bytes": 8.0 * count * pixels,
            "products_s": operations / rates["float64"],
            "bytes_s": 8.0 * count * pixels / rates["bytes"],
            "cosines_s": 0.0,
            "limit": operations / rates["float64"],
            "seconds": seconds,
        }
    )
    rows.append({"what": "rates of this machine", **rates})
    return rows
