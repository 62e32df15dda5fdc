"""The figure of a survey: the contrast curves of all stars."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pyklip_diffrender.plotting.panels import ACCENT, INK

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["draw_limits"]

_COLORS = ("#0b6e4f", "#b3261e", "#2f5fb3", "#9a5b00", "#6b3fa0", "#1b8a9e", "#7a7a00", "#c0508a")
"""Told apart by readers with colour vision deficiencies with the help of the dashes."""

_DASHES = ("-", "--", "-.", ":")


def draw_limits(
    curves: Sequence[tuple[str, NDArray[np.float64], NDArray[np.float64]]],
    candidates: Sequence[tuple[float, float]],
    sigmas: float,
) -> Figure:
    """Contrast against separation for all stars, with their candidates.

    Parameters
    ----------
    curves : sequence of (str, array, array)
        Name, separations in arcsec, and contrasts. If there are more than there are colours, the
        curves are grey and their median is shown.
    candidates : sequence of (float, float)
        Separation and contrast.
    sigmas : float
        Of the curves.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(5.0, 4.0), layout="constrained")
    ax = figure.add_subplot()
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
    return figure
