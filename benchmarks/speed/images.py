"""Rows on one image: forward, and forward with the derivative."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cache, partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks import poppy_reference
from benchmarks.speed.case import Accuracy, Case, missing
from benchmarks.speed.rivals import hcipy_image, load, paper_recipe, prysm_image
from benchmarks.speed.setting import CELLS, WAVELENGTH, Setting, of_stpsf, rendered
from pyklip_diffrender.instrument.nircam import NIRCAM_LW_PIXELSCALE
from pyklip_diffrender.optics.system import OpticalSystem

FORWARD, STEP = "forward", "forward + backward"

_NAMES = {torch.float64: "float64", torch.float32: "float32"}


def _models(setting: Setting) -> Iterator[tuple[str, str, Callable[[], OpticalSystem]]]:
    """This package in both precisions: name, precision, how to make it."""
    for dtype, precision in _NAMES.items():
        make = partial(setting.model.with_fidelity, dtype=dtype)
        yield f"this package, {setting.npix}", precision, make


def forward(setting: Setting) -> list[Case]:
    """One image of the star, monochromatic, by everyone."""

    def ours(make: Callable[[], OpticalSystem]) -> Callable[[], Tensor]:
        return partial(rendered, make(), setting.opd)

    def paper() -> Callable[[], Tensor]:
        return partial(torch.no_grad()(paper_recipe(setting.arrays, setting.device)), setting.opd)

    cases = [
        Case(FORWARD, name, partial(ours, make), setting.judge, precision=precision)
        for name, precision, make in _models(setting)
    ]
    cases.append(Case(FORWARD, "the paper's recipe", paper, setting.judge))
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
                partial(rival, setting.arrays),
                lambda image: setting.judge(_scaled(image, setting)),
            )
        )
    name = "poppy, FFT, oversample 4"
    cases.append(Case(FORWARD, name, lambda: _poppy(setting), setting.judge, reference=True))
    return cases + _stpsf_cases(setting)


def _scaled(image: Any, setting: Setting) -> Any:
    """Codes differ in what they count light in: the factor that fits the truth best."""
    return image * (float((image * setting.truth).sum()) / float((image**2).sum()))


def _poppy(setting: Setting) -> Callable[[], Any]:
    arrays = setting.arrays
    system = poppy_reference.coronagraph(
        arrays.amplitude / arrays.amplitude.max(),
        arrays.opd,
        np.abs(arrays.stop),
        np.angle(arrays.stop) * (WAVELENGTH / (2 * np.pi)),
        oversample=4,
        fov_pixels=setting.fov,
        pixelscale=NIRCAM_LW_PIXELSCALE,
    )
    return lambda: poppy_reference.image(system, WAVELENGTH, 0.0, 0.0)


def _stpsf_cases(setting: Setting) -> list[Case]:
    """calc_psf, and this package's model of the same instrument."""
    name = "stpsf calc_psf, fft_oversample 4"
    if setting.stpsf is None:
        return [missing(FORWARD, name, "no stpsf (extra 'webbpsf'), or no data (STPSF_PATH)")]
    instrument, call = setting.stpsf
    truth = cache(lambda: of_stpsf(setting, 16.0)().numpy())

    def judge(image: Any) -> Accuracy:
        difference = np.asarray(image) - truth()
        return Accuracy(float(np.abs(difference).max() / truth().max()))

    def theirs() -> Any:
        return instrument.calc_psf(**call, fft_oversample=4)["DET_SAMP"].data

    note = "of stpsf's own arrays; the error is to 16 cells per lambda/D"
    own = "this package from the stpsf object"
    return [
        Case(FORWARD, name, lambda: theirs, judge, reference=True, note=note),
        Case(FORWARD, own, lambda: of_stpsf(setting, 3.0), judge, note=note),
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

    def judge(answer: tuple[Tensor, Tensor]) -> Accuracy:
        return setting.judge(answer[0])

    recipe = partial(paper_recipe, setting.arrays, setting.device)
    return [
        *(
            Case(STEP, name, partial(differentiated, make), judge, precision=precision)
            for name, precision, make in _models(setting)
        ),
        Case(STEP, "the paper's recipe", partial(differentiated, recipe), judge, reference=True),
    ]
