"""`Plan`: the chosen settings, the reasons for them, and the time they save."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from astropy import units as u
from astropy.table import QTable

from pyklip_diffrender.io.html_repr import html_summary
from pyklip_diffrender.optics.system import OpticalSystem
from pyklip_diffrender.planning.choice import Choice, Economy, ModelError, Option
from pyklip_diffrender.planning.trial import Trial

__all__ = ["Plan", "plan_table"]


@dataclass(frozen=True, eq=False)
class Plan:
    """The cheapest settings that model a scene's star to within a fraction of the noise.

    Attributes
    ----------
    model, given : OpticalSystem
        The system to fit with, and the full system, to which errors are relative.
    choice : Choice
        All settings.
    refine_options : dict
        Arguments for `refine`: ``cycles``.
    table : QTable
        One row per economy: ``what``, ``chosen``, ``finest``, ``why``; the rms ``error`` that it
        causes alone and that of the ``worst`` pixel, in units of the noise; ``seconds`` of a
        refinement with it alone.
    budget : float
        Largest rms error, in units of the noise.
    error, verified_error : ModelError
        Of all settings together: expected, and measured against the full model.
    seconds, seconds_given : float
        Estimated for a refinement on one core from the number of operations: with the plan, and
        with the full model. Ratios are accurate, absolute times depend on the machine.
    seed : int
        Random seed of the drifts.
    pinned, steps : tuple of str
        Settings fixed by the caller, and economies that the verification refined.
    final_error : ModelError, optional
        Of the refined star against the full model, at the fitted wavefront; only in the plan of a
        `Refinement`.
    abandoned : bool
        Whether that was too large, so that the fit continued with the full model.

    Examples
    --------
    >>> import pyklip_diffrender as dr
    >>> model = dr.nircam_coronagraph("F444W", monochromatic=4.5e-6, npix=128, fov_pixels=24)
    >>> scene = dr.Scene(star=dr.Star(w2_magnitude=11.0))
    >>> plan = dr.plan(model, scene, dr.random_opd(1, npix=128))
    >>> plan.table.colnames
    ['what', 'chosen', 'finest', 'error', 'worst', 'seconds', 'why']
    """

    model: OpticalSystem
    given: OpticalSystem
    choice: Choice
    refine_options: dict[str, Any]
    table: QTable
    budget: float
    error: ModelError
    verified_error: ModelError
    seconds: float
    seconds_given: float
    seed: int
    pinned: tuple[str, ...] = ()
    steps: tuple[str, ...] = ()
    final_error: ModelError | None = None
    abandoned: bool = False

    def allows(self, error: ModelError) -> bool:
        """Whether an error is inside the budget."""
        return error.inside(self.budget)

    def __repr__(self) -> str:
        return (
            f"<Plan: {self.verified_error.rms:.3g} sigma of {self.budget:g}, "
            f"{self.seconds_given / self.seconds:.2g} times cheaper>"
        )

    def _repr_html_(self) -> str:
        return html_summary(
            "Plan",
            {
                "Error": f"{self.verified_error.rms:.3g} sigma of {self.budget:g} allowed",
                "Time of a refinement": f"about {self.seconds:.2g} s on one core, "
                f"{self.seconds_given:.2g} s with the full model",
            },
            self.table,
            self.table.colnames,
        )

    def __str__(self) -> str:
        lines = self.table.pformat(
            max_lines=-1, max_width=-1, show_unit=True, align=["<", "<", "<", ">", ">", ">", "<"]
        )
        lines += [
            "",
            f"error {self.error.rms:.3f} sigma expected, {self.verified_error.rms:.3f} verified "
            f"(worst pixel {self.verified_error.worst:.2f}), budget {self.budget:g}",
            f"about {self.seconds:.2g} s for a refinement on one core, "
            f"{self.seconds_given:.2g} s with the full model",
        ]
        if self.steps:
            lines.append(f"refined by the verification: {', '.join(self.steps)}")
        if self.final_error is not None:
            end = "the fit continued with the full model" if self.abandoned else "inside the budget"
            lines.append(f"at the solution {self.final_error.rms:.3f} sigma: {end}")
        if self.pinned:
            lines.append(f"kept as requested: {', '.join(self.pinned)}")
        return "\n".join(line.rstrip() for line in lines)

    def summary(self) -> dict[str, Any]:
        """Values for a header or a log, by short names."""
        facts: dict[str, Any] = {
            **vars(self.choice),
            "budget": self.budget,
            "error": self.error.rms,
            "verified_error": self.verified_error.rms,
            "worst_pixel": self.verified_error.worst,
            "seconds": self.seconds,
            "seconds_given": self.seconds_given,
            "seed": self.seed,
            "final_error": -1.0 if self.final_error is None else self.final_error.rms,
            "abandoned": self.abandoned,
        }
        return {f"plan_{name}": value for name, value in facts.items()}


def _label(name: str, choice: Choice) -> str:
    """The setting of a choice that belongs to an economy, in words."""
    return {
        "pupil grid": f"{choice.npix}" + " for differences" * choice.multifidelity,
        "wavelengths": f"{choice.wavelengths}",
        "wavefront modes": f"to {choice.cycles:g} cycles",
    }[name]


def _why(trial: Trial, economy: Economy, option: Option) -> str:
    if economy.note:
        return economy.note
    if any(name in trial.pins for name in option.changes):
        return "kept as requested"
    place = economy.options.index(option)
    if place == 0:
        return "the cheapest is good enough"
    before = economy.options[place - 1]
    label, error = _label(economy.name, replace(trial.finest, **before.changes)), before.error
    if not error.inside(trial.budget):
        return f"{label}: {error.rms:.2g} sigma (worst pixel {error.worst:.2g})"
    return f"{label}: {error.rms:.2g} sigma, too much with the others, or no faster"


def plan_table(trial: Trial, economies: Sequence[Economy], picked: Sequence[Option]) -> QTable:
    """The table of a plan, see `Plan`; `picked` holds the option chosen of each economy."""
    rows = []
    for economy, option in zip(economies, picked, strict=True):
        choice = replace(trial.finest, **option.changes)
        rows.append(
            {
                "what": economy.name,
                "chosen": _label(economy.name, choice),
                "finest": _label(economy.name, trial.finest),
                "error": option.error.rms,
                "worst": option.error.worst,
                "seconds": trial.seconds(choice) * u.s,
                "why": _why(trial, economy, option),
            }
        )
    table = QTable(rows=rows)
    for name in ("error", "worst", "seconds"):
        table[name].info.format = ".3g"
    return table
