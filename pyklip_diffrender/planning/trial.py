"""Render the star with the full model and with cheaper ones, and compare them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pyklip_diffrender.linear.parameter_derivatives import parameter_jacobian
from pyklip_diffrender.linear.response import (
    WavefrontResponse,
    coarse_copy,
    coarse_npix,
    downsample,
)
from pyklip_diffrender.optics.grid import PupilGrid
from pyklip_diffrender.optics.system import OpticalSystem
from pyklip_diffrender.parameters import parameter
from pyklip_diffrender.planning.choice import Choice, Economy, ModelError
from pyklip_diffrender.planning.noise_model import Drift, NoiseModel, RidgeResidual, least_squares
from pyklip_diffrender.planning.systems import CheapSystem, build
from pyklip_diffrender.scene.objects import Scene
from pyklip_diffrender.scene.observation import Observation
from pyklip_diffrender.wavefront.bases import default_basis
from pyklip_diffrender.wavefront.priors import WavefrontPrior

__all__ = ["PROBED", "START", "Trial"]

START, PROBED, VERIFIED = 0, 1, 2
"""Wavefronts: at the start, after the drift of the probes, after an independent drift."""

_MORE = range(3, 19)
"""Sixteen further drifts, for the change of the star that the prior expects; the change by a single
drift is uncertain by a third."""

_ALIGNMENT = ("star_offset", "lyot_shift", "lyot_rotation")
"""Parameters that contribute to the misfit at the start besides the wavefront."""

_LEAST = 0.3
"""Smallest factor by which the prior is narrowed if the star fits the data well."""

_ROUGH_NPIX, _ROUGH_WAVELENGTHS = 256, 3
"""Pupil samples and wavelengths for differences that hardly depend on them."""


@dataclass
class Trial:
    """A scene, its full model, and the cached renderings.

    Parameters are those of `plan`: `opd0` is on the model's grid in m, `values` are the model's
    other parameters, `cycles` is the highest frequency of the finest modes, `pins` are the settings
    to keep. `response_npix` is raised to what model and field need.

    Attributes
    ----------
    finest : Choice
        The full model.
    rough : Choice
        The same with a coarse pupil and few wavelengths, where possible.
    likely : Choice
        With the cheapest good options of the economies probed so far.
    grids : list of int
        Samples across usable coarser pupils, from coarse to fine.
    noise : NoiseModel
    drift : Drift
    """

    model: OpticalSystem
    subject: Scene | Observation
    opd0: Tensor
    values: dict[str, Tensor]
    prior: WavefrontPrior
    cycles: float
    response_npix: int
    model_error: float
    budget: float
    seed: int
    pins: Mapping[str, Any]

    def __post_init__(self) -> None:
        model = self.model
        self.response_npix = coarse_npix(model, self.response_npix)
        self.finest = self.likely = Choice(
            npix=model.npix,
            multifidelity=False,
            wavelengths=len(model.bandpass.wavelengths),
            cycles=self.cycles,
        )
        halves = [model.npix >> k for k in range(6, 0, -1) if model.npix % (1 << k) == 0]
        # The grid of the derivatives resolves the field; a fixed model keeps its own grid.
        self.grids = [npix for npix in halves if npix >= self.response_npix]
        waves = self.finest.wavelengths
        wavelengths = min(_ROUGH_WAVELENGTHS, waves) if "bandpass" in model.adjustable else waves
        npix = next((npix for npix in self.grids if npix >= _ROUGH_NPIX), model.npix)
        self.rough = replace(self.finest, npix=npix, wavelengths=wavelengths)
        self._systems: dict[Choice, OpticalSystem] = {self.finest.system: model}
        self._images: dict[tuple[Choice, int], Tensor] = {}
        self._fields: dict[int, list[Tensor]] = {}
        self._ridge: RidgeResidual | None = None
        image = model.image_of(self._fine_fields(waves), self.values).double()
        self._images[self.finest, START] = image
        self.noise = NoiseModel.of(self.subject, image, self.model_error)
        self.drift = Drift(self.prior, default_basis(self.cycles, model.entrance), self.seed)
        self.drift.deviation *= self._misfit()

    def _misfit(self) -> float:
        """Rms misfit of the star at the start, relative to the expectation of the prior.

        Taken after aligning star and Lyot stop; 1 if there are no data.
        """
        noise, valid = self.noise, self.noise.valid
        if noise.residual is None:
            return 1.0
        fine, fields = self._few_wavelengths()
        coarse = coarse_copy(fine, self.response_npix)
        names = tuple(name for name in _ALIGNMENT if name in self.model.parameters)
        defaults = {n: np.full(parameter(n).size, parameter(n).default) for n in names}
        values = {**self.model.values(defaults), **self.values}
        small = downsample(self.opd0, coarse.npix)
        rows = parameter_jacobian(coarse, small, values, names, fields)
        columns = [noise.in_sigma(row)[valid] for row in (*rows, noise.image)]
        columns.append(1 / noise.sigma[valid])
        misfit = least_squares(columns, (noise.residual / noise.sigma)[valid])[1]
        # Plus three standard deviations of chi-squared, because it may be small by chance.
        excess = float(misfit.square().mean()) - 1.0 + 3 * math.sqrt(2 / len(misfit))
        start = self.image(self.rough, START)
        changes = [noise.in_sigma(self._rendered(self.rough, k) - start)[valid] for k in _MORE]
        expected = float(torch.stack(changes).square().mean())
        return max(_LEAST, math.sqrt(max(excess, 0.0) / max(expected, 1e-300)))

    def _few_wavelengths(self) -> tuple[OpticalSystem, list[Tensor]]:
        """The full model and its fields at the start, at few wavelengths."""
        waves = self.rough.wavelengths
        return self.system(replace(self.finest, wavelengths=waves)), self._fine_fields(waves)

    def learn(self, economy: Economy) -> None:
        """Update `likely` with the cheapest good option of an economy."""
        for option in economy.options:
            if option.error.inside(self.budget):
                self.likely = replace(self.likely, **option.changes)
                return

    def seconds(self, choice: Choice) -> float:
        """Estimated time of a refinement on one core.

        Operations are counted, not timed, so that plans do not depend on the load of the machine:
        images, derivatives by modes and alignment, Jacobians and their squares, solutions. The
        rates are those of one core in 2026; on another machine nearly all options scale alike.
        """
        detector, waves = self.model.detector, choice.wavelengths
        pixels = detector.shape[0] * detector.shape[1]
        samples = pixels * detector.oversample**2
        modes, pupil = self.drift.count(choice.cycles), (choice.npix / 1024) ** 2
        response = 4e-4 + 6e-8 * samples
        if self.model.route == "planes":
            response += 8e-8 * self.response_npix**2
        jacobian = modes * (samples * (8e-9 + 4e-9 * waves) + 1.1e-11 * modes * pixels)
        images = waves * (3e-3 + 4.5e-2 * pupil) + 3.3e-2 * pupil
        return 10 * images + waves * (modes * response + 0.12) + 6 * jacobian + 1.4e-10 * modes**3

    def _fine_fields(self, wavelengths: int) -> list[Tensor]:
        """The full model's fields at the start, at a number of wavelengths."""
        if wavelengths not in self._fields:
            fine = self.system(replace(self.finest, wavelengths=wavelengths))
            with torch.no_grad():
                self._fields[wavelengths] = fine.fields(self.opd0, **self.values)
        return self._fields[wavelengths]

    def system(self, choice: Choice) -> OpticalSystem:
        """The optical system of a choice."""
        key = choice.system
        if key not in self._systems and choice.multifidelity:
            coarse = self.system(replace(choice, multifidelity=False))
            assert isinstance(coarse, CheapSystem)
            small, fine = downsample(self.opd0, coarse.npix), self._fine_fields(choice.wavelengths)
            self._systems[key] = coarse.stepping_from(fine, small, self.values)
        elif key not in self._systems:
            self._systems[key] = build(self.model, choice)
        return self._systems[key]

    def _rendered(self, choice: Choice, which: int) -> Tensor:
        system = self.system(choice)
        opd = downsample(self.opd0, system.npix)
        if which != START:
            grid = PupilGrid.full(system.npix, system.diameter)
            opd = opd + self.drift.opd(which, choice.cycles, grid).to(opd.device)
        with torch.no_grad():
            return system(opd, **self.values).double()

    def image(self, choice: Choice, which: int) -> Tensor:
        """The star rendered by a choice at one of the wavefronts, (ny, nx), at flux 1."""
        key = (replace(choice, cycles=self.finest.cycles) if which == START else choice, which)
        if key not in self._images:
            self._images[key] = self._rendered(*key)
        return self._images[key]

    def prepare_fit(self, cycles: float) -> None:
        """From now on, measure errors of fewer modes after a fit of the modes up to `cycles`."""
        if self._ridge is None:
            fine, fields = self._few_wavelengths()
            basis, npix = default_basis(cycles, self.model.entrance), self.response_npix
            response = WavefrontResponse(fine, basis, self.opd0, self.values, npix=npix)
            slopes = self.noise.in_sigma(response.image(fields, self.values).double())
            prior = self.drift.deviation[: len(basis)].to(slopes.device)
            self._ridge = RidgeResidual(slopes * prior[:, None, None])

    def error(self, choice: Choice, which: int, base: Choice | None = None) -> ModelError:
        """Error of the star of a choice, relative to the full model or to another choice."""
        change = self.image(choice, which) - self.image(base or self.finest, which)
        residual = self.noise.unexplained(change)
        if choice.cycles < self.finest.cycles and self._ridge:
            residual = self._ridge.residual(residual, self.drift.count(choice.cycles))
        return self.noise.error(residual)

    def verified(self, choice: Choice) -> ModelError:
        """Error of a choice as a whole, at the start and after an independent drift."""
        if choice == self.finest:
            return ModelError()
        return ModelError.largest(self.error(choice, which) for which in (START, VERIFIED))
