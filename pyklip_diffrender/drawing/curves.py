"""Contrast curves, and what was measured of injected planets."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from astropy.table import QTable
from numpy.typing import NDArray

from pyklip_diffrender.drawing.figures import ACCENT, INK, halo

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_KLIP = "#b3541e"
"""A brown, lighter than the green of the curve that it is drawn beside."""

_COLORS = ("#0b6e4f", "#b3261e", "#2f5fb3", "#9a5b00", "#6b3fa0", "#1b8a9e", "#7a7a00", "#c0508a")
"""Told apart by readers with colour vision deficiencies with the help of the dashes."""

_DASHES = ("-", "--", "-.", ":")


def contrast_curve(
    ax: Axes, curve: QTable, candidates: QTable, *, small_sample: bool, klip: QTable | None = None,
    legend_below: bool = False,
) -> None:  # fmt: skip
    """Draw contrast limits against separation: median, range of angles, and star known exactly.

    The axis on the right has the magnitude differences.

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
    legend_below : bool
        Put the legend below the axes, where it hides nothing; the figure must have room for it. By
        default it is in the upper right corner, and the axes are square.
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
    ax.set_xlabel("separation (arcsec)")
    ax.set_ylabel(f"contrast at {curve.meta['sigmas']:g} sigma")
    _magnitude_axis(ax)
    if legend_below:
        ax.grid(alpha=0.25, lw=0.5)
        ax.legend(frameon=False, loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=2,
                  fontsize="small")  # fmt: skip
        return
    ax.set_box_aspect(1.0)
    # Limits are high at small separations alone, so that there is room in this corner.
    ax.legend(frameon=False, loc="upper right", fontsize="small")


def _magnitude_axis(ax: Axes) -> None:
    """Give an axis of contrasts another one on the right, with magnitude differences."""
    from matplotlib.ticker import MaxNLocator, NullLocator, ScalarFormatter

    # The scale is logarithmic in the contrast, and the ticks are at round magnitudes.
    axis = ax.secondary_yaxis(
        "right",
        functions=(
            lambda contrast: -2.5 * np.log10(np.maximum(contrast, 1e-300)),
            lambda magnitude: 10 ** (-0.4 * np.asarray(magnitude)),
        ),
    )
    axis.yaxis.set_major_locator(MaxNLocator(7))
    axis.yaxis.set_minor_locator(NullLocator())
    axis.yaxis.set_major_formatter(ScalarFormatter())
    axis.set_ylabel("magnitude difference")


def completeness(
    ax: Axes, table: QTable, curve: QTable, half: Sequence[float], most: Sequence[float]
) -> None:
    """Draw the fraction of planets that are found against separation and contrast.

    `table` has columns separation, contrast and completeness, with as many contrasts at each
    separation, and `curve` separation and contrast of the limits at 5 sigma. `half` and `most` are
    the contrasts at which 50 and 95 % are found, by separation; may be NaN.
    """
    place, contrast = table["separation"].value, np.asarray(table["contrast"])
    fraction = np.asarray(table["completeness"])
    separation = np.unique(place)
    sides = _edges(separation)
    # Every separation has contrasts of its own, about its limit: a mesh would be skewed.
    for inner, outer, middle in zip(sides[:-1], sides[1:], separation, strict=True):
        at = np.flatnonzero(place == middle)
        at = at[np.argsort(contrast[at])]
        mesh = ax.pcolormesh(
            [inner, outer], np.exp(_edges(np.log(contrast[at]))), fraction[at][:, None],
            cmap="cividis", vmin=0, vmax=1, shading="flat",
        )  # fmt: skip
    ax.figure.colorbar(mesh, ax=ax, label="fraction found", fraction=0.046, pad=0.03)
    for values, dash, label in (
        (np.asarray(most), "-", "95 %"),
        (np.asarray(half), "--", "50 %"),
        (np.interp(separation, curve["separation"].value, curve["contrast"]), ":", "5 sigma"),
    ):
        ax.plot(separation, values, dash, color=INK, marker="o", ms=3, label=label,
                path_effects=halo())  # fmt: skip
    ax.set_yscale("log")
    ax.set_xlim(sides[0], sides[-1])
    ax.set_box_aspect(1.0)
    ax.set_facecolor("0.9")
    ax.set_xlabel("separation (arcsec)")
    ax.set_ylabel("contrast")
    ax.legend(loc="upper center", bbox_to_anchor=(0.5, 1.13), ncols=3, frameon=False,
              fontsize="small")  # fmt: skip


def _edges(middles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Edges of cells about values that rise, halfway between them; a single one has two, too."""
    if len(middles) == 1:
        return np.array([middles[0] - 0.05, middles[0] + 0.05])
    between = (middles[1:] + middles[:-1]) / 2
    first, last = 1.5 * middles[[0, -1]] - 0.5 * middles[[1, -2]]
    return np.array([first, *between, last])


def injected_planets(ax: Axes, planets: QTable) -> None:
    """Draw recovered over injected contrast against separation.

    `planets` has columns separation, injected, contrast, contrast_error and detected.
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
    """Draw contrast limits at `sigmas` against separation for all stars, with their candidates.

    A curve is a name, separations in arcsec and contrasts; a candidate is a separation and a
    contrast. If there are more curves than colours, they are grey and their median is shown.
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
