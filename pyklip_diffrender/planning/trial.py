"""Renders a scene with the given model and with cheaper ones, and compares."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pyklip_diffrender.linear.response import NANOMETRE, coarse_npix, downsample
from pyklip_diffrender.optics.grid import PupilGrid
from pyklip_diffrender.optics.system import OpticalSystem
from pyklip_diffrender.parameters import parameter
from pyklip_diffrender.planning.build import CheapSystem, build, optional_parts
from pyklip_diffrender.planning.choice import Choice, Economy, Error
from pyklip_diffrender.planning.cost import Workload
from pyklip_diffrender.planning.modes import Modes
from pyklip_diffrender.planning.target import Target
from pyklip_diffrender.scene.objects import Scene
from pyklip_diffrender.scene.observation import Observation
from pyklip_diffrender.wavefront.bases import default_basis
from pyklip_diffrender.wavefront.priors import WavefrontPrior

__all__ = ["PROBED", "START", "VERIFIED", "Trial"]

START, PROBED, VERIFIED = 0, 1, 2
"""Wavefronts: the starting one, the drifted one of the probes, an independent one to verify."""

_ALIGNED = {"star_offset": 2e-3, "lyot_shift": 1e-3, "lyot_rotation": 0.05}
"""Parameters whose misfit at the start says nothing about the wavefront, and steps for their
derivatives: large enough for single precision."""

_FEW = 3
"""Wavelengths at which modes are looked at, at most."""


class Trial:
    """A scene, the given model of it, and what has been rendered so far.

    Parameters
    ----------
    model : OpticalSystem
        As given, the finest.
    subject : Scene or Observation
    opd : Tensor, (npix, npix)
        Starting wavefront, m.
    values : dict of Tensor
        The model's other parameters.
    prior : WavefrontPrior
    cycles : float
        Highest frequency of the finest set of modes.
    response_npix : int
        Pupil samples of the finest derivatives.
    share : float
        Of the star, that the model may miss.
    budget : float
        Error that is allowed, units of the noise.
    seed : int
    pins : mapping
        Fields of `Choice` that are decided.

    Attributes
    ----------
    finest : Choice
        Everything as given.
    likely : Choice
        With the cheapest good options of the economies that were probed.
    """

    def __init__(
        self,
        model: OpticalSystem,
        subject: Scene | Observation,
        opd: Tensor,
        values: dict[str, Tensor],
        *,
        prior: WavefrontPrior,
        cycles: float,
        response_npix: int,
        share: float,
        budget: float,
        seed: int,
        pins: Mapping[str, Any],
    ) -> None:
        self.model, self.opd0, self.values, self.pins = model, opd, values, dict(pins)
        self.seed, self.budget = seed, budget
        self.parts = optional_parts(model)
        response_npix = coarse_npix(model, response_npix)
        self.finest = Choice(
            npix=model.npix,
            multifidelity=False,
            occulter_sampling=model.recipe.get("occulter_sampling"),
            wavelengths=len(model.bandpass.wavelengths),
            dtype="float32" if model.dtype == torch.float32 else "float64",
            without=(),
            cycles=cycles,
            response_npix=response_npix,
            pixels=0.0,
        )
        self.likely = self.finest
        self._systems: dict[Choice, OpticalSystem] = {self.finest.system: model}
        self._images: dict[tuple[Choice, float, int], Tensor] = {}
        self._wavefronts: dict[tuple[int, float, int], Tensor] = {}
        self._fields: dict[int, list[Tensor]] = {}
        image = model.image_of(self.fields(self.finest), values).double()
        self._images[self.finest.system, cycles, START] = image
        if isinstance(subject, Scene):
            target = Target.of_scene(subject, image)
        else:
            target = Target.of_observation(subject, image)
        self.target = target.allowing(share)
        self.basis = default_basis(cycles)
        # What modes do to the star takes fewer wavelengths than the star itself.
        few = self.finest.changed({"wavelengths": min(_FEW, self.finest.wavelengths)})
        self.modes = Modes(
            self.system(few),
            self.target,
            self.basis,
            prior,
            opd,
            self._alignment(),
            self.fields(few),
            cycles=cycles,
            npix=response_npix,
            seed=seed,
            aligned={name: s for name, s in _ALIGNED.items() if name in model.parameters},
        )
        ny, nx = model.detector.shape
        self.work = Workload(
            samples=ny * nx * model.detector.oversample**2,
            pixels=ny * nx,
            lattice=model.route == "lattice",
            device=model.device.type,
            frequencies=self.basis.frequencies,
        )

    def _alignment(self) -> dict[str, Tensor]:
        """The values, with those that are differentiated at their defaults where not given."""
        there = {
            name: np.full(parameter(name).size, parameter(name).default)
            for name in _ALIGNED
            if name in self.model.parameters
        }
        return {**self.model.values(there), **self.values}

    def learn(self, economy: Economy) -> None:
        """Take note of what a probe found."""
        for option in economy.options:
            if option.error.inside(self.budget):
                self.likely = self.likely.changed(option.changes)
                return

    def seconds(self, choice: Choice) -> float:
        """Expected, of a refinement."""
        kept = len(self.parts) - len(choice.without)
        return self.work.seconds(
            choice, informative=float(self.informative(choice).double().mean()), effects=kept
        )

    def fields(self, choice: Choice) -> list[Tensor]:
        """The given model's fields at the start, at the wavelengths of a choice."""
        waves = choice.wavelengths
        if waves not in self._fields:
            fine = self.system(self.finest.changed({"wavelengths": waves}))
            with torch.no_grad():
                self._fields[waves] = fine.fields(self.opd0, **self.values)
        return self._fields[waves]

    def system(self, choice: Choice) -> OpticalSystem:
        """The optical system of a choice."""
        key = choice.system
        if key not in self._systems and choice.multifidelity:
            # E(opd) = E_fine(opd0) + (E_coarse(opd) - E_coarse(opd0)), see `multifidelity`.
            coarse = self.system(choice.changed({"multifidelity": False}))
            assert isinstance(coarse, CheapSystem)
            with torch.no_grad():
                there = coarse.fields(downsample(self.opd0, coarse.npix), **self.values)
            fine = self.fields(choice)
            self._systems[key] = coarse.corrected(
                [exact - rough for exact, rough in zip(fine, there, strict=True)]
            )
        elif key not in self._systems:
            self._systems[key] = build(self.model, choice)
        return self._systems[key]

    def wavefront(self, which: int, cycles: float, npix: int) -> Tensor:
        """One of the wavefronts, with the change up to a frequency only, (npix, npix), m."""
        key = (which, cycles, npix)
        if key not in self._wavefronts:
            opd = downsample(self.opd0, npix)
            if which != START:
                # Seeds of different plans must not share their draws.
                drawn = self.modes.draw(1000 * self.seed + which)
                drawn = torch.where(self.basis.frequencies <= cycles, drawn, 0.0)
                grid = PupilGrid.full(npix, self.model.diameter)
                opd = opd + self.basis.opd(drawn * NANOMETRE, grid).to(opd.device)
            self._wavefronts[key] = opd
        return self._wavefronts[key]

    def image(self, choice: Choice, which: int) -> Tensor:
        """The star as a choice renders one of the wavefronts, (ny, nx), at flux 1."""
        cycles = self.finest.cycles if which == START else choice.cycles
        key = (choice.system, cycles, which)
        if key not in self._images:
            system = self.system(choice)
            opd = self.wavefront(which, cycles, system.npix)
            with torch.no_grad():
                self._images[key] = system(opd, **self.values).double()
        return self._images[key]

    def rendering_error(self, choice: Choice, which: int, base: Choice | None = None) -> Error:
        """How far the star of a choice is from that of the given model, or of another one.

        Of a choice with fewer modes: after a fit of those, where that was prepared.
        """
        change = self.image(choice, which) - self.image(base or self.finest, which)
        left = self.target.unexplained(change)
        if choice.cycles < self.finest.cycles:
            left = self.modes.left(left, choice.cycles)
        return self.target.error(left)

    def informative(self, choice: Choice) -> Tensor:
        """Pixels that say something about the wavefront, (ny, nx), bool.

        Those where the star is expected to change least are left out, as many as together stay
        below ``choice.pixels``.
        """
        if choice.pixels <= 0:
            return torch.ones_like(self.target.valid)
        power = self.modes.upto(choice.cycles).flatten() ** 2
        order = torch.argsort(power)
        summed = torch.cumsum(power[order], dim=0)
        few = summed <= choice.pixels**2 * int(self.target.valid.sum())
        kept = torch.ones_like(self.target.valid).flatten()
        kept[order[few]] = False
        return kept.reshape(self.target.valid.shape)

    def dropped_error(self, choice: Choice, which: int) -> Error:
        """How much the star changes in pixels that are taken to say nothing."""
        if choice.pixels <= 0 or which == START:
            return Error()
        change = self.image(self.finest, which) - self.image(self.finest, START)
        whitened = self.target.in_sigma(change)
        return self.target.error(torch.where(self.informative(choice), 0.0, whitened))

    def response_error(self, choice: Choice, *, others: bool = False) -> Error:
        """What coarse derivatives leave, at most.

        Once a fit has converged the star is known to within the noise or to within what the
        prior allows; a relative error of the derivatives leaves that share of it.
        """
        if choice.response_npix >= self.finest.response_npix:
            return Error()
        known = self.modes.upto(choice.cycles).clamp(max=1.0)
        relative = self.modes.response_error(choice.response_npix, others=others)
        return self.target.error(torch.where(self.target.valid, relative * known, 0.0))

    def verified(self, choice: Choice) -> Error:
        """Error of a choice as a whole, at the start and at a wavefront no probe has seen."""
        if choice == self.finest:
            return Error()
        rendered = Error.largest(self.rendering_error(choice, which) for which in (START, VERIFIED))
        return Error.in_quadrature(
            [
                rendered,
                self.dropped_error(choice, VERIFIED),
                self.response_error(choice, others=True),
            ]
        )
