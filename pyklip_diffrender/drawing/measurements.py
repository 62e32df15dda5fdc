"""A measured source: its pixels, and its way over the sky."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pyklip_diffrender.drawing.figures import ACCENT, INK, halo, label_sky, on_sky
from pyklip_diffrender.drawing.images import show_pixels

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = NDArray[np.float64]

_STAMPS_INCHES = (4.8, 3.9)
"""Size of a figure of four small axes, inches."""


@dataclass(frozen=True, eq=False)
class Stamp:
    """The pixels about a source in one frame; NaN where they are masked or outside of it."""

    x: Array  # (n,), x of the pixels from the star, arcsec; y likewise.
    y: Array
    data: Array  # (n, n), the frame in its unit, as the others are.
    subtracted: Array  # (n, n), without the star and everything else that is not the source.
    model: Array  # (n, n), the source.
    noise: Array  # (n, n), standard deviations of the pixels.
    north: float | None  # Position angle of +y, degrees east of north.


def stamp_panels(stamp: Stamp, unit: str) -> Figure:
    """Draw data, star-subtracted data, model and residual of a source in one frame."""
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    figure = Figure(
        figsize=_STAMPS_INCHES, layout=ConstrainedLayoutEngine(compress=True, w_pad=0.08)
    )
    limit = max(float(np.nanmax(np.abs(stamp.model))), 3 * float(np.nanmedian(stamp.noise)))
    signed: dict[str, Any] = {"cmap": "RdBu_r", "vmin": -limit, "vmax": limit, "bar": unit}
    light = {"cmap": "magma", "bar": unit}
    residual = (stamp.subtracted - stamp.model) / stamp.noise
    sigmas = {"cmap": "RdBu_r", "vmin": -5.0, "vmax": 5.0, "bar": "standard deviations"}
    axes: NDArray[Any] = figure.subplots(2, 2)
    for ax, title, image, style in (
        (axes[0, 0], "Data", stamp.data, light),
        (axes[0, 1], "Without the star", stamp.subtracted, signed),
        (axes[1, 0], "Model", stamp.model, signed),
        (axes[1, 1], "Residual", residual, sigmas),
    ):
        show_pixels(ax, image, stamp.x, stamp.y, title=title, north=stamp.north, **style)
        ax.locator_params(nbins=3)
        for each in (ax, *ax.child_axes):
            each.tick_params(labelsize="small")
        middle = on_sky((stamp.x.mean(), stamp.y.mean()), stamp.north)
        ax.plot(*middle, "+", color=INK, ms=8, path_effects=halo())
        label_sky(ax, stamp.north is not None, fontsize="small")
        ax.label_outer()
    return figure


@dataclass(frozen=True, eq=False)
class Epoch:
    """Sources that were measured at one date."""

    label: str
    # (k, 2), offsets from the star to the east and north, arcsec; errors are their deviations.
    places: Array
    errors: Array
    # (2,), where a source in the background would be that was at the place of the first epoch.
    background: Array | None


def sky_track(ax: Axes, epochs: Sequence[Epoch], start: Array, title: str) -> None:
    """Draw where sources were measured, and the way of one in the background; east is left.

    Epochs are in order of time, and `start` (2,) is the offset at the first of them of the source
    to which the view belongs, arcsec.
    """
    markers = "osD^vP*X"
    way = np.array([start, *(each.background for each in epochs if each.background is not None)])
    ax.plot(*way.T, "--", color=INK, lw=1, label="source in the background")
    near = max(0.15, 1.6 * float(np.abs(way - start).max()))
    for k, each in enumerate(epochs):
        marker = markers[k % len(markers)]
        inside = (np.abs(each.places - start) < near).all(axis=1)
        (x, y), (x_error, y_error) = each.places[inside].T, each.errors[inside].T
        ax.errorbar(
            x, y, y_error, x_error, fmt=marker, color=ACCENT, ms=6, capsize=2, label=each.label
        )
        if each.background is not None:
            ax.plot(*each.background, marker, mfc="white", mec=INK, ms=7, zorder=1)
    ax.set_xlim(start[0] + near, start[0] - near)
    ax.set_ylim(start[1] - near, start[1] + near)
    ax.set_box_aspect(1.0)
    ax.locator_params(nbins=5)
    label_sky(ax, oriented=True)
    ax.set_title(title, color=INK, loc="left")
    ax.legend(frameon=False, fontsize="small")
