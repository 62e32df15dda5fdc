"""How durations grow with the size of the problem, and how far they are from what is possible."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import torch
from scipy.linalg import cholesky
from scipy.linalg.blas import dsyrk
from torch.utils.flop_counter import FlopCounterMode

from pyklip_diffrender.linear.response import WavefrontResponse, downsample
from pyklip_diffrender.planning import coarse_steps
from pyklip_diffrender.refinement import GaussNewton, refine
from pyklip_diffrender.scene.simulation import simulate
from pyklip_diffrender.wavefront.bases import Basis, default_basis
from tests.benchmarks.speed.case import Case
from tests.benchmarks.speed.inference import basis_of
from tests.benchmarks.speed.setting import Setting
from tests.benchmarks.speed.timing import interleaved

__all__ = ["SCALING", "limits", "scaling"]

SCALING = "scaling"


def _image(here: Setting, **changes: Any) -> Callable[[], Callable[[], Any]]:
    def make() -> Callable[[], Any]:
        model = here.model.with_fidelity(**changes)
        opd = torch.nn.functional.avg_pool2d(here.opd[None], here.npix // model.npix)[0]

        def work() -> Any:
            with torch.no_grad():
                return model(opd)

        return work

    return make


def scaling(here: Setting) -> list[Case]:
    """Forward against grid, field and wavelengths; Jacobian against modes; fits against frames."""
    n, field = here.npix, here.fov
    cases = [
        Case(f"{SCALING}: forward, pupil grid", f"{k} samples", _image(here, npix=k), size=k)
        for k in (n // 4, n // 2, n)
    ]
    cases += [
        Case(f"{SCALING}: forward, field", f"{k} pixels", _image(here, fov_pixels=k), size=k)
        for k in (field // 2, field, 2 * field)
    ]
    cases += [
        Case(
            f"{SCALING}: forward, wavelengths",
            f"{k} wavelengths",
            _image(here, monochromatic=None, nlambda=k),
            size=k,
        )
        for k in (2, 4, 8)
    ]
    for cycles in (3.0, 5.0) if here.quick else (6.0, 12.0, 24.0):
        basis = default_basis(cycles)
        cases.append(
            Case(
                f"{SCALING}: Jacobian, modes",
                f"{len(basis)} modes",
                partial(_response, here, basis),
                size=len(basis),
            )
        )
    for count in (1, 2) if here.quick else (1, 2, 4):
        cases.append(
            Case(
                f"{SCALING}: refinement, frames",
                f"{count} frames",
                partial(_frames, here, count),
                size=count,
            )
        )
    return cases


def _response(here: Setting, basis: Basis) -> Callable[[], WavefrontResponse]:
    return partial(WavefrontResponse, here.model, basis, here.opd, {}, npix=here.coarse[0])


def _frames(here: Setting, count: int) -> Callable[[], Any]:
    """Several frames with their own star positions fitted together: 40 pixels, 8 cycles."""
    npix = here.npix // 4
    model = here.host_model.with_fidelity(npix=npix, fov_pixels=here.fov // 2)
    small = torch.nn.functional.avg_pool2d(
        torch.stack([here.opd, here.measured])[None].cpu(), here.npix // npix
    )[0]
    frames = [simulate(model, here.scene, small[0], seed=k) for k in range(count)]
    basis = default_basis(4.0 if here.quick else 8.0)
    settings = GaussNewton(basis=basis, max_iterations=6)
    return lambda: refine(model, frames, small[1].numpy(), settings=settings)


# -- the machine's limit ---------------------------------------------------------------------------


def _rates(device: str) -> dict[str, float]:
    """Operations per second of products, bytes per second of a copy, cosines per second."""
    side = 512
    found = {}
    for dtype, name in ((torch.float64, "float64"), (torch.float32, "float32")):
        a = torch.ones(side, side, dtype=dtype, device=device)
        out = torch.empty_like(a)
        (best,) = interleaved([partial(torch.mm, a, a, out=out)], 0.2, device)
        found[name] = 2 * side**3 / best
    large = torch.ones(2**23, dtype=torch.float64, device=device)
    target = torch.empty_like(large)
    (best,) = interleaved([lambda: target.copy_(large)], 0.2, device)
    found["bytes"] = 2 * 8 * len(large) / best
    angles = torch.linspace(-3, 3, 2**17, dtype=torch.float64, device=device)
    room = torch.empty_like(angles)
    (best,) = interleaved([lambda: torch.cos(angles, out=room)], 0.1, device)
    found["cosines"] = len(angles) / best
    return found


def _products(work: Callable[[], Any]) -> float:
    """Operations of all matrix products in a call."""
    with FlopCounterMode(display=False) as counter:
        work()
    return float(counter.get_total_flops())


def limits(here: Setting) -> list[dict[str, float | str]]:
    """Operations and bytes that cannot be avoided this way, and what they take at the least.

    The rates are measured beside: a product of large matrices, a copy that does not fit into the
    cache, cosines that do.

    Returns
    -------
    list of dict
        what, gflop, cosines, bytes, limit (s, the sum of the three at full rate), seconds.
    """
    rates = _rates(here.device)
    model, basis = here.model, basis_of(here)
    lit = float(model.entrance.lit.sum())
    mixed = coarse_steps(model, here.measured, here.coarse[0], torch.float32)

    def fine() -> Any:
        with torch.no_grad():
            return model(here.opd)

    def coarse() -> Any:
        with torch.no_grad():
            return mixed(downsample(here.opd, mixed.npix))

    def response() -> Any:
        return WavefrontResponse(model, basis, here.opd, {}, npix=here.coarse[0])

    def step() -> Any:
        return torch.autograd.grad(model(opd).sum(), opd)

    opd = here.opd.clone().requires_grad_()
    samples = float(here.npix**2)
    kept = 8.0 * len(basis) * here.fov**2
    modes = 8.0 * len(basis) * here.coarse[0] ** 2
    rows: list[dict[str, float | str]] = []
    for what, work, name, cosines, moved in (
        ("forward", fine, "float64", 2 * lit, 16 * samples),
        ("multi-fidelity forward", coarse, "float32", 2 * lit * (here.coarse[0] / here.npix) ** 2,
         8 * samples),
        # The field and its derivative are complex, and written once and read once.
        ("forward + backward", step, "float64", 2 * lit, (16 + 4 * 16) * samples),
        ("Jacobian", response, "float32", 0.0, 2 * modes + kept),
    ):  # fmt: skip
        work()
        operations = _products(work)
        (taken,) = interleaved([work], 1.0, here.device)
        parts = operations / rates[name], moved / rates["bytes"], cosines / rates["cosines"]
        rows.append(
            {
                "what": what,
                "gflop": operations / 1e9,
                "cosines": cosines,
                "bytes": moved,
                "products_s": parts[0],
                "bytes_s": parts[1],
                "cosines_s": parts[2],
                "limit": sum(parts),
                "seconds": taken,
            }
        )
    count, pixels = len(basis), here.fov**2
    jacobian = np.random.default_rng(1).standard_normal((count, pixels)).T

    def solved() -> Any:
        curvature = dsyrk(1.0, jacobian, trans=True, lower=True)
        return cholesky(curvature + pixels * np.eye(count), lower=True)

    (taken,) = interleaved([solved], 1.0)
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
            "seconds": taken,
        }
    )
    rows.append({"what": "rates of this machine", **rates})
    return rows
