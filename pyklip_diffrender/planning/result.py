"""What a plan is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from astropy.table import QTable
from numpy.typing import NDArray

from pyklip_diffrender.optics.system import OpticalSystem
from pyklip_diffrender.planning.choice import Choice, Error

__all__ = ["Plan"]


@dataclass(frozen=True, eq=False)
class Plan:
    """The cheapest settings that model a scene's star to within a share of the noise.

    Attributes
    ----------
    model : OpticalSystem
        The system to fit with.
    given : OpticalSystem
        The one that was given, which errors are relative to.
    choice : Choice
        All settings.
    refine_options : dict
        What `refine` is told: ``cycles`` and ``response_npix``.
    informative : ndarray of bool, (ny, nx)
        Pixels that say something about the wavefront.
    table : QTable
        One row for each economy: ``what``, ``chosen``, ``finest``, ``why``, ``error`` as the probe
        measured it, ``worst`` (in the worst pixel), ``verified_error`` of this choice alone at a
        wavefront the probe has not seen (all in units of the pixel noise), ``seconds`` of a
        refinement and ``memory`` with this economy alone.
    budget : float
        Largest rms error, in units of the noise.
    error, verified_error : Error
        Of all together: expected, and measured against the given model.
    seconds, seconds_given : float
        Expected for a refinement on one core, counted from operations: with the plan, and with
        everything as given. Ratios are good, absolute times depend on the machine.
    memory, memory_given : float
        Bytes, expected at most.
    planning_seconds : float
        What the plan itself took.
    seed : int
        Of the wavefronts that were drawn.
    pinned : tuple of str
        Settings that were kept by the caller.
    steps : tuple of str
        Economies that the verification has made finer again.
    final_error : Error, optional
        Of the refined star, against the given model at the wavefront that was found; in the plan
        that comes with a refinement.
    abandoned : bool
        Whether that was too large, so that the fit went on with the model as given.
    """

    model: OpticalSystem
    given: OpticalSystem
    choice: Choice
    refine_options: dict[str, Any]
    informative: NDArray[np.bool_]
    table: QTable
    budget: float
    error: Error
    verified_error: Error
    seconds: float
    seconds_given: float
    memory: float
    memory_given: float
    planning_seconds: float
    seed: int
    pinned: tuple[str, ...] = ()
    steps: tuple[str, ...] = ()
    final_error: Error | None = None
    abandoned: bool = False

    def allows(self, error: Error) -> bool:
        """Whether an error is inside the budget."""
        return error.inside(self.budget)

    def __repr__(self) -> str:
        return (
            f"<Plan: {self.verified_error.rms:.3g} sigma of {self.budget:g}, "
            f"{self.seconds_given / self.seconds:.2g} times cheaper>"
        )

    def __str__(self) -> str:
        shown = self.table["what", "chosen", "finest", "error", "verified_error", "seconds", "why"]
        lines = shown.pformat(
            max_lines=-1, max_width=-1, show_unit=True, align=["<", "<", "<", ">", ">", ">", "<"]
        )
        pixels = self.informative
        lines += [
            "",
            f"error {self.error.rms:.3f} sigma expected, {self.verified_error.rms:.3f} verified "
            f"(worst pixel {self.verified_error.worst:.2f}), budget {self.budget:g}",
            f"about {self.seconds:.2g} s and {self.memory / 1e6:.0f} MB for a refinement on one "
            f"core, as given {self.seconds_given:.2g} s and {self.memory_given / 1e6:.0f} MB",
            f"{int(pixels.sum())} of {pixels.size} pixels say something about the wavefront",
        ]
        if self.steps:
            lines.append(f"made finer by the verification: {', '.join(self.steps)}")
        if self.final_error is not None:
            end = "the fit went on as given" if self.abandoned else "inside the budget"
            lines.append(f"at the wavefront found {self.final_error.rms:.3f} sigma: {end}")
        if self.pinned:
            lines.append(f"kept as asked: {', '.join(self.pinned)}")
        return "\n".join(line.rstrip() for line in lines)

    def summary(self) -> dict[str, Any]:
        """The facts that belong in a header or a log: text and numbers by short names."""
        choice = self.choice
        return {
            "plan_npix": choice.npix,
            "plan_multifidelity": choice.multifidelity,
            "plan_occulter_sampling": choice.occulter_sampling or "as the route has it",
            "plan_wavelengths": choice.wavelengths,
            "plan_dtype": choice.dtype,
            "plan_without": ", ".join(choice.without) or "nothing",
            "plan_cycles": choice.cycles,
            "plan_response_npix": choice.response_npix,
            "plan_pixels": int(self.informative.sum()),
            "plan_budget": self.budget,
            "plan_error": self.error.rms,
            "plan_verified_error": self.verified_error.rms,
            "plan_worst_pixel": self.verified_error.worst,
            "plan_seconds": self.seconds,
            "plan_seconds_given": self.seconds_given,
            "plan_seed": self.seed,
            "plan_final_error": -1.0 if self.final_error is None else self.final_error.rms,
            "plan_abandoned": self.abandoned,
        }
