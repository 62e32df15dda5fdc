"""Rows on one image: forward, and forward with the derivative."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from functools import partial
from importlib.util import find_spec
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.speed.case import Accuracy, Case, missing
from benchmarks.speed.rivals import hcipy_image, load, paper_recipe, prysm_image
from benchmarks.speed.setting import CELLS, WAVELENGTH, Arrays, Setting, coarse_steps
from pyklip_diffrender.errors import DiffrenderError
from pyklip_diffrender.instrument.nircam import NIRCAM_LW_PIXELSCALE
from pyklip_diffrender.linear.response import downsample
from pyklip_diffrender.optics.system import OpticalSystem

FORWARD, STEP = "forward", "forward + backward"

_NAMES = {torch.float64: "float64", torch.float32: "float32"}


def _models(setting: Setting) -> Iterator[tuple[str, torch.dtype, Callable[[], OpticalSystem]]]:
    """This package at several fidelities: name, precision, how to make it."""
    for dtype in _NAMES:
        yield (
            f"this package, {setting.npix}",
            dtype,
            partial(setting.model.with_fidelity, dtype=dtype),
        )
    for npix in setting.coarse[::-1]:
        for dtype in _NAMES:
            mixed = partial(coarse_steps, setting.model, setting.measured, npix, dtype)
            yield f"multi-fidelity, {npix}", dtype, mixed
    coarsest = setting.coarse[-1]
    coarse_model = partial(setting.model.with_fidelity, npix=coarsest)
    yield f"coarse alone, {coarsest}", torch.float64, coarse_model


def _of_fine(make: Callable[[], OpticalSystem]) -> Callable[[Tensor], Tensor]:
    """The image as a function of the wavefront on the fine grid, whatever that of the model."""
    model = make()
    return lambda opd: model(downsample(opd, model.npix))


def _without_derivatives(
    make: Callable[[], OpticalSystem], setting: Setting
) -> Callable[[], Tensor]:
    image = _of_fine(make)

    def work() -> Tensor:
        with torch.no_grad():
            return image(setting.opd)

    return work


def _captured(make: Callable[[], OpticalSystem], setting: Setting) -> Callable[[], Tensor]:
    """The forward model as one CUDA graph: no time is lost to starting its many small kernels."""
    work = _without_derivatives(make, setting)
    side = torch.cuda.Stream()
    side.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(side):
        for _ in range(3):
            work()
    torch.cuda.current_stream().wait_stream(side)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        image = work()

    def replay() -> Tensor:
        graph.replay()
        return image

    return replay


def forward(setting: Setting) -> list[Case]:
    """One image of the star, monochromatic, by everyone."""
    cases = []
    for name, dtype, make in _models(setting):
        cases.append(
            Case(
                FORWARD,
                name,
                partial(_without_derivatives, make, setting),
                setting.judge,
                precision=_NAMES[dtype],
                memory=dtype == torch.float64,
            )
        )
        if torch.device(setting.device).type == "cuda" and "multi" in name:
            cases.append(
                Case(
                    FORWARD,
                    name,
                    partial(_captured, make, setting),
                    setting.judge,
                    precision=_NAMES[dtype],
                    mode="graph",
                )
            )
    if torch.device(setting.device).type != "cuda":
        cases.append(missing(FORWARD, "this package as a CUDA graph", "--device names no GPU"))
    cases.append(
        Case(FORWARD, "the paper's recipe", lambda: _paper(setting), setting.judge, memory=True)
    )
    for name, rival in (("prysm", prysm_image), ("hcipy", hcipy_image)):
        try:
            load(name)
        except ImportError as error:
            cases.append(missing(FORWARD, name, f"{error} (extra 'bench')"))
            continue
        cases.append(
            Case(
                FORWARD,
                f"{name}, {CELLS} cells per lambda/D",
                partial(_on_arrays, rival, setting),
                lambda image: setting.judge(_scaled(image, setting)),
                memory=True,
            )
        )
    cases.append(
        Case(
            FORWARD,
            "poppy, FFT, oversample 4",
            lambda: _poppy(setting),
            setting.judge,
            reference=True,
            memory=True,
        )
    )
    return cases + _stpsf_cases(setting)


def _paper(setting: Setting) -> Callable[[], Tensor]:
    image = paper_recipe(setting.arrays, setting.device)

    def work() -> Tensor:
        with torch.no_grad():
            return image(setting.opd)

    return work


def _on_arrays(rival: Callable[[Arrays], Callable[[], Any]], setting: Setting) -> Callable[[], Any]:
    return rival(setting.arrays)


def _scaled(image: Any, setting: Setting) -> Any:
    """Codes differ in what they count light in: the factor that fits the truth best."""
    return image * (float((image * setting.truth).sum()) / float((image**2).sum()))


def _poppy(setting: Setting) -> Callable[[], Any]:
    from benchmarks.speed.plain import plain_poppy

    arrays = setting.arrays
    return plain_poppy(
        arrays.amplitude,
        arrays.opd,
        arrays.stop,
        diameter=arrays.diameter,
        wavelength=WAVELENGTH,
        pixelscale=NIRCAM_LW_PIXELSCALE,
        fov_pixels=setting.fov,
        oversample=4,
    )


def _stpsf_cases(setting: Setting) -> list[Case]:
    """calc_psf, and this package's model of the same instrument."""
    name = "stpsf calc_psf, fft_oversample 4"
    if find_spec("stpsf") is None:
        return [missing(FORWARD, name, "stpsf is not installed (extra 'webbpsf')")]
    if setting.data is None:
        return [missing(FORWARD, name, "no data directory (--stpsf-path or STPSF_PATH)")]
    os.environ["STPSF_PATH"] = str(setting.data)
    from benchmarks.speed.plain import plain_stpsf
    from pyklip_diffrender.bridges import from_webbpsf

    try:
        instrument = plain_stpsf(setting.data, 256 if setting.quick else setting.npix)
    except DiffrenderError as error:
        return [missing(FORWARD, name, str(error))]
    call: dict[str, Any] = {
        "monochromatic": WAVELENGTH,
        "fov_pixels": setting.fov,
        "fft_oversample": 4,
        "detector_oversample": 1,
        "add_distortion": False,
    }
    reference: list[Any] = []

    def judge(image: Any) -> Accuracy:
        if not reference:
            with torch.no_grad():
                reference.append(from_webbpsf(instrument, occulter_sampling=16.0, **call)().numpy())
        difference = np.asarray(image) - reference[0]
        return Accuracy(float(np.abs(difference).max() / reference[0].max()))

    def converted() -> Callable[[], Tensor]:
        model = from_webbpsf(instrument, occulter_sampling=3.0, **call)
        opd = model.opd(None)

        def image() -> Tensor:
            with torch.no_grad():
                return model(opd)

        return image

    note = "of stpsf's own arrays; the error is to 16 cells per lambda/D"
    return [
        Case(
            FORWARD,
            name,
            lambda: lambda: np.asarray(instrument.calc_psf(**call)["DET_SAMP"].data),
            judge,
            reference=True,
            memory=True,
            note=note,
        ),
        Case(FORWARD, "this package from the stpsf object", converted, judge, note=note),
    ]


def step(setting: Setting) -> list[Case]:
    """The loss of the paper and its derivative with respect to every sample of the fine OPD."""
    data = torch.from_numpy(setting.observation.data[0]).to(setting.device)
    photons = setting.scene.star.photons

    def differentiated(
        make: Callable[[], Callable[[Tensor], Tensor]],
    ) -> Callable[[], tuple[Tensor, Tensor]]:
        image = make()
        opd = setting.opd.clone().requires_grad_()

        def work() -> tuple[Tensor, Tensor]:
            result = image(opd)
            loss = (photons * result - data).abs().mean()
            (slope,) = torch.autograd.grad(loss, opd)
            return result, slope

        return work

    cases = []
    for name, dtype, make in _models(setting):
        if "alone" not in name:
            cases.append(
                Case(
                    STEP,
                    name,
                    partial(differentiated, partial(_of_fine, make)),
                    lambda answer: setting.judge(answer[0]),
                    precision=_NAMES[dtype],
                    memory=dtype == torch.float64,
                )
            )
    cases.append(
        Case(
            STEP,
            "the paper's recipe",
            lambda: differentiated(lambda: paper_recipe(setting.arrays, setting.device)),
            lambda answer: setting.judge(answer[0]),
            reference=True,
            memory=True,
        )
    )
    return cases
