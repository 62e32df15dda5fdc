"""The figure of docs/inference.md: S/N calibration, limit, fluxes."""

from __future__ import annotations

import calibration
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from pages import KINDS, tables

COLOURS = {"measured": "#5b3f95", "generator": "#c0631a"}


def rms(values: np.ndarray) -> float:
    """Root mean square over frames."""
    return float(np.sqrt(np.nanmean(np.asarray(values) ** 2)))


def draw() -> Figure:
    """S/N calibration, limit, fluxes."""
    panels = 3 if tables("fluxes") else 2
    figure = Figure(figsize=(5 * panels, 4.4), layout="constrained")
    left, middle, *rest = figure.subplots(1, panels)
    middles = calibration.RINGS[:-1] + 0.1
    for kind, table in tables("calibration").items():
        for hours, style in ((3.0, ":"), (40.0, "-"), (86.0, "--"), (200.0, "-.")):
            part = table[table["hours"] == hours]
            if not len(part):
                continue
            label = f"{KINDS[kind]}, {hours:g} h"
            nulls = [rms(part[f"null_{r:.1f}"]) for r in calibration.RINGS[:-1]]
            limits = [part[f"limit_{r:.1f}"].mean() for r in calibration.RINGS[:-1]]
            left.plot(middles, nulls, style, color=COLOURS[kind], label=label)
            middle.plot(middles, limits, style, color=COLOURS[kind], label=label)
    left.axhspan(0.85, 1.2, color="0.93", zorder=0)
    left.axhline(1, color="0.5", lw=0.8)
    left.set_ylim(0.6, 1.5)
    titles = (
        (left, "Deviation of S/N where there is nothing"),
        (middle, "5-sigma limit / photon limit"),
        *((ax, "Flux of injected planets / true") for ax in rest),
    )
    for ax, title in titles:
        ax.set_title(title, fontsize=10, loc="left")
        ax.set_xlabel("arcsec", fontsize=9)
    middle.set_ylim(1.0, 1.5)
    left.legend(frameon=False, fontsize=7)
    for ax in rest:
        _draw_fluxes(ax)
    return figure


def _draw_fluxes(ax: Axes) -> None:
    for kind, table in tables("fluxes").items():
        part = table[table["contrast"] / table["error"] > 4]
        # Set apart a little, so that they do not hide each other.
        place = part["separation"] + np.linspace(-0.1, 0.1, len(part))
        ratio, error = part["measured"] / part["contrast"], part["error"] / part["contrast"]
        ax.errorbar(
            place, ratio, error, fmt=".", ms=3, lw=0.6, color=COLOURS[kind], label=KINDS[kind]
        )
    ax.axhline(1, color="0.5", lw=0.8)
    ax.set_ylim(0.4, 1.6)
    ax.legend(frameon=False, fontsize=8)
