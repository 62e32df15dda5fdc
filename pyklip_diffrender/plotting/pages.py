"""Figures of one panel each, which a page can put side by side or below each other."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pyklip_diffrender.plotting.panels import (
    ACCENT,
    INK,
    detector_extent,
    draw_compass,
    extent_of,
    label_sky,
    light_norm,
    mark,
    show,
    turned,
    unit_label,
)
from pyklip_diffrender.plotting.results import plot_detection, plot_disk

if TYPE_CHECKING:
    from astropy.table import QTable
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from pyklip_diffrender.detection import Detection, Disk, WideField

__all__ = ["draw_disk", "draw_injections", "draw_search", "draw_star", "draw_wavefronts"]

_SIZE = (4.6, 3.7)
"""Of a panel, inches: its letters are as large as a page's where it is as wide as a phone."""

_BOX = (0.17, 0.13, 0.6, 0.77)
"""Of the axes in a panel: the same for all, so that panels side by side are aligned."""

_LIMIT = 5.0
"""Of the scale for residuals, standard deviations."""


def draw_search(detection: Detection | WideField, klip: QTable | None = None) -> list[Figure]:
    """The S/N map with the candidates, and the contrast curve, perhaps with that of KLIP."""
    figures, axes = _panels(2)
    plot_detection(detection, axes, klip)
    # There is no room below these axes, but limits are high at small separations alone.
    axes[1].legend(frameon=False, loc="upper right", fontsize="small")
    return figures


def draw_disk(disk: Disk) -> list[Figure]:
    """The frames without the star, and the extended light."""
    figures, axes = _panels(2)
    plot_disk(disk, axes)
    return figures


def draw_star(detection: Detection, frame: int = 0) -> list[Figure]:
    """Draw a frame, the model of its star, and the residual, in which candidates are kept.

    Parameters
    ----------
    found : Detection
    frame : int
        Which of the frames of the first fit.
    """
    part, first = detection.fits[0].frames[frame], detection.fits[0].frames[0].observation
    observation = part.observation.combined()
    valid, noise = observation.valid[0], observation.error[0]
    data = np.where(valid, observation.data[0], np.nan)
    extent = detector_extent(part.model.detector, part.optical_values)
    unit, norm = unit_label(observation.unit), light_norm(data, noise[valid])
    figures, axes = _panels(3)
    # Powers of ten in the logarithmic part; those of the linear part would overlap.
    decades = np.arange(np.ceil(np.log10(norm.linear_width)), np.log10(norm.vmax))
    light = {"bar": unit, "cmap": "magma", "norm": norm, "ticks": [0.0, *10.0**decades]}
    show(axes[0], data, extent, title="Data", **light)
    show(axes[1], part.star, extent, title="Model of the star", **light)
    show(
        axes[2], detection.subtracted[frame] / noise, extent,
        bar="standard deviations of the noise", title="Residual",
        cmap="RdBu_r", vmin=-_LIMIT, vmax=_LIMIT,
    )  # fmt: skip
    places = np.stack([detection.table["x"].value, detection.table["y"].value], axis=1)
    mark(axes[2], turned(places, observation, first))
    for ax in axes:
        label_sky(ax)
        if observation.position_angles is not None:
            draw_compass(ax, observation.position_angle)
    return figures


def draw_wavefronts(
    before: NDArray[np.float64], after: NDArray[np.float64], diameter: float
) -> list[Figure]:
    """A wavefront before and after the fit, and the change.

    Parameters
    ----------
    before, after : ndarray, (npix, npix)
        nm; NaN outside the pupil.
    diameter : float
        Side of the maps, m.
    """
    middles = (np.arange(len(before)) + 0.5) * diameter / len(before) - diameter / 2
    extent = extent_of(middles, middles)
    largest = _limit(before, after)
    figures, axes = _panels(3)
    for ax, map_, title, limit in zip(
        axes,
        (before, after, after - before),
        ("Before the fit", "After the fit", "Change"),
        (largest, largest, _limit(after - before)),
        strict=True,
    ):
        show(
            ax, map_, extent, bar="wavefront error (nm)", title=title, cmap="RdBu_r",
            vmin=-limit, vmax=limit,
        )  # fmt: skip
        ax.set_facecolor("white")
        ax.set_xlabel("x in the entrance pupil (m)")
        ax.set_ylabel("y in the entrance pupil (m)")
    return figures


def draw_injections(planets: QTable) -> Figure:
    """Recovered over injected contrast of planets against separation.

    Parameters
    ----------
    planets : QTable
        See `recover_planets`.
    """
    (figure,), (ax,) = _panels(1)
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
    return figure


def _limit(*maps: NDArray[np.float64]) -> float:
    """Of a scale that few pixels exceed; positive even for maps of zeros."""
    return float(np.nanpercentile(np.abs(maps), 99.5)) or 1.0


def _panels(count: int) -> tuple[list[Figure], list[Axes]]:
    """Figures with one axes each, and these axes."""
    from matplotlib.figure import Figure

    figures = [Figure(figsize=_SIZE) for _ in range(count)]
    return figures, [figure.add_axes(_BOX) for figure in figures]
