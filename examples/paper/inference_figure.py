"""The figure of the calibration report: S/N calibration, limit, fluxes."""

from __future__ import annotations

import calibration
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from pages import KINDS, tables

COLOURS = {"measured": "#5b3f95", "generator": "#c0631a"}


def draw() -> Figure:
    """S/N calibration, limit, fluxes."""
    panels = 3 if tables("fluxes") else 2
    figure = Figure(figsize=(5 * panels, 4.4), layout="constrained")
    null_axes, middle, *rest = figure.subplots(1, panels)
    middles = calibration.RINGS[:-1] + 0.1
    for kind, table in tables("calibration").items():
        for hours, style in ((3.0, ":"), (40.0, "-"), (86.0, "--"), (200.0, "-.")):
            part = table[table["hours"] == hours]
            if not len(part):
                continue
            label = f"{KINDS[kind]}, {hours:g} h"
            nulls = [calibration.rms(part[f"null_{r:.1f}"]) for r in calibration.RINGS[:-1]]
            limits = [part[f"limit_{r:.1f}"].mean() for r in calibration.RINGS[:-1]]
            null_axes.plot(middles, nulls, style, color=COLOURS[kind], label=label)
            middle.plot(middles, limits, style, color=COLOURS[kind], label=label)
    null_axes.axhspan(0.85, 1.2, color="0.93", zorder=0)
    null_axes.axhline(1, color="0.5", lw=0.8)
    null_axes.set_ylim(0.6, 1.5)
    titles = (
        (null_axes, "Standard deviation of planet-free S/N"),
        (middle, "5-sigma limit / photon limit"),
        *((ax, "Injected planets: (measured - true) / error") for ax in rest),
    )
    for ax, title in titles:
        ax.set_title(title, fontsize=10, loc="left")
        ax.set_xlabel("pull" if ax in rest else "arcsec", fontsize=9)
    middle.set_ylim(1.0, 1.5)
    null_axes.legend(frameon=False, fontsize=7)
    for ax in rest:
        _draw_pulls(ax)
    return figure


def _draw_pulls(ax: Axes) -> None:
    """Draw the pulls of all injected planets with the normal distribution."""
    edges = np.arange(-4, 4.01, 0.5)
    for kind, table in tables("fluxes").items():
        pull = (table["measured"] - table["contrast"]) / table["error"]
        inside = 100 * np.mean(np.abs(pull) < 1)
        label = f"{KINDS[kind]}: {len(pull)} planets, {inside:.0f} % within 1"
        ax.hist(pull, edges, density=True, histtype="step", color=COLOURS[kind], label=label)
    fine = np.linspace(-4, 4, 201)
    ax.plot(fine, np.exp(-(fine**2) / 2) / np.sqrt(2 * np.pi), color="0.5", lw=0.8)
    ax.set_ylim(0, 0.7)
    ax.legend(frameon=False, fontsize=7)
