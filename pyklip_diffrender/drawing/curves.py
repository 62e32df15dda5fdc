"""Contrast curves, and what was measured of injected planets."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from astropy.table import QTable
from numpy.typing import NDArray

from pyklip_diffrender.drawing.marks import ACCENT, INK

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["contrast_curve", "injected_planets", "survey_limits"]

_KLIP = "#b3541e"
"""A brown, lighter than the green of the curve that it is drawn beside."""

_COLORS = ("#0b6e4f", "#b3261e", "#2f5fb3", "#9a5b00", "#6b3fa0", "#1b8a9e", "#7a7a00", "#c0508a")
"""Told apart by readers with colour vision deficiencies with the help of the dashes."""

_DASHES = ("-", "--", "-.", ":")


def contrast_curve(
    ax: Axes, curve: QTable, candidates: QTable, *, small_sample: bool, klip: QTable | None = None
) -> None:
    """Draw contrast limits against separation: median, range of angles, and star known exactly.

    Parameters
    ----------
    ax : Axes
    curve : QTable
        Columns separation, contrast, lowest, highest, known_star and small_sample; `meta` has
        "sigmas".
    candidates : QTable
        Columns separation and contrast, with their errors.
    small_sample : bool
        Draw limits with the correction for few samples: of the median, and of KLIP.
    klip : QTable, optional
        Columns separation, contrast and small_sample of KLIP; `meta` may have a "label".
    """
    separation = curve["separation"].value
    ax.fill_between(
        separation, curve["lowest"], curve["highest"], color=ACCENT, alpha=0.15, lw=0,
        label="range of angles",
    )  # fmt: skip
    ax.semilogy(separation, curve["contrast"], color=ACCENT, label="median")
    if small_sample:
        ax.semilogy(separation, curve["small_sample"], ":", color=ACCENT,
                    label="median, few samples")  # fmt: skip
    ax.semilogy(separation, curve["known_star"], "--", color=INK, label="star known exactly")
    if klip is not None:
        label = klip.meta.get("label", "KLIP").replace(" (", "\n(")
        ax.semilogy(klip["separation"].value, klip["contrast"], "s-", color=_KLIP, ms=3.5,
                    label=label)  # fmt: skip
        ax.semilogy(klip["separation"].value, klip["small_sample"], "s:", color=_KLIP, ms=3.5,
                    mfc="white", label="KLIP, few samples")  # fmt: skip
    if len(candidates):
        ax.errorbar(
            candidates["separation"].value, candidates["contrast"], candidates["contrast_error"],
            candidates["separation_error"].value, "o", color=INK, mfc="white", label="candidates",
        )  # fmt: skip
    ax.set_box_aspect(1.0)
    ax.set_xlabel("separation (arcsec)")
    ax.set_ylabel(f"contrast at {curve.meta['sigmas']:g} sigma")
    # Limits are high at small separations alone, so that there is room in this corner.
    ax.legend(frameon=False, loc="upper right", fontsize="small")


def completeness(
    ax: Axes, table: QTable, curve: QTable, half: Sequence[float], most: Sequence[float]
) -> None:
    """Draw the fraction of planets that are found against separation and contrast.

    Parameters
    ----------
    ax : Axes
    table : QTable
        Columns separation, contrast and completeness, with as many contrasts at each separation.
    curve : QTable
        Columns separation and contrast: the limits at 5 sigma.
    half, most : sequence of float
        Contrasts at which 50 and 95 % are found, by separation; may be NaN.
    """
    separation = np.unique(table["separation"].value)
    x, y, fraction = (
        np.asarray(each).reshape(len(separation), -1)
        for each in (table["separation"].value, table["contrast"], table["completeness"])
    )
    mesh = ax.pcolormesh(x, y, fraction, cmap="cividis", vmin=0, vmax=1, shading="nearest")
    ax.figure.colorbar(mesh, ax=ax, label="fraction found", fraction=0.046, pad=0.03)
    ax.plot(separation, most, "-", color="white", label="95 %")
    ax.plot(separation, half, "--", color="white", label="50 %")
    ax.plot(curve["separation"].value, curve["contrast"], ":", color="white", label="5 sigma")
    ax.set_yscale("log")
    ax.set_xlim(x.min(), x.max())
    ax.set_ylim(y.min(), y.max())
    ax.set_box_aspect(1.0)
    ax.set_xlabel("separation (arcsec)")
    ax.set_ylabel("contrast")
    legend = ax.legend(frameon=False, loc="upper right", fontsize="small")
    for text in legend.get_texts():
        text.set_color("white")


def injected_planets(ax: Axes, planets: QTable) -> None:
    """Draw recovered over injected contrast against separation.

    Parameters
    ----------
    ax : Axes
    planets : QTable
        Columns separation, injected, contrast, contrast_error and detected.
    """
    ratio, error = (
        np.asarray(planets[name] / planets["injected"]) for name in ("contrast", "contrast_error")
    )
    separation, detected = planets["separation"].value, np.asarray(planets["detected"])
    for kept, face in ((detected, ACCENT), (~detected, "white")):
        ax.errorbar(
            separation[kept], ratio[kept], error[kept], fmt="o", color=ACCENT, mfc=face, capsize=2
        )
    ax.axhline(1.0, color=INK, ls="--", lw=1)
    ax.set_ylim(0.0, max(2.0, 1.1 * float(np.nanmax(ratio + error))))
    ax.set_xlabel("separation (arcsec)")
    ax.set_ylabel("recovered / injected")


def survey_limits(
    ax: Axes,
    curves: Sequence[tuple[str, NDArray[np.float64], NDArray[np.float64]]],
    candidates: Sequence[tuple[float, float]],
    sigmas: float,
) -> None:
    """Draw contrast limits against separation for all stars, with their candidates.

    Parameters
    ----------
    ax : Axes
    curves : sequence of (str, array, array)
        Name, separations in arcsec, and contrasts. If there are more than there are colours, the
        curves are grey and their median is shown.
    candidates : sequence of (float, float)
        Separation and contrast.
    sigmas : float
        Significance of the limits.
    """
    few = len(curves) <= len(_COLORS)
    for k, (name, separation, contrast) in enumerate(curves):
        # A name is no formula.
        label = name.replace("$", r"\$").lstrip("_") if few else None
        ax.semilogy(
            separation, contrast, _DASHES[k % len(_DASHES)] if few else "-", label=label,
            color=_COLORS[k] if few else INK, lw=1.6 if few else 0.8, alpha=1.0 if few else 0.35,
        )  # fmt: skip
    if not few:
        grid = np.unique(np.concatenate([each for _, each, _ in curves]))
        inside = np.array([np.interp(grid, s, c, np.nan, np.nan) for _, s, c in curves])
        known = np.isfinite(inside).any(axis=0)
        ax.semilogy(
            grid[known], np.nanmedian(inside[:, known], axis=0), color=ACCENT, lw=2.4,
            label=f"median of {len(curves)}",
        )  # fmt: skip
    if candidates:
        ax.semilogy(*zip(*candidates, strict=True), "o", color=INK, mfc="white", label="candidates")
    ax.set_xlabel("separation (arcsec)")
    ax.set_ylabel(f"contrast at {sigmas:g} sigma")
    ax.grid(alpha=0.2, which="both", lw=0.5)
    ax.legend(frameon=False, fontsize=9)
