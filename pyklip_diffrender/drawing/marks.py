"""Marks on images: labels of axes, circles, a compass."""

from __future__ import annotations

from collections.abc import Sequence
from math import cos, radians, sin
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

if TYPE_CHECKING:
    from astropy.units import UnitBase
    from matplotlib.axes import Axes

__all__ = ["ACCENT", "INK", "circles", "compass", "halo", "label_sky", "unit_label"]

INK = "#1b1f24"
ACCENT = "#0b6e4f"
"""A dark green, distinct from both ends of the red and blue maps."""

_LABELLED = 4
"""Largest number of circles with labels of more than two characters."""

_COMPASS = 30.0
"""From the tail of an arrow to its letter, points."""


def halo() -> list[Any]:
    """Effects that make dark lines and text legible on any image."""
    from matplotlib.patheffects import withStroke

    return [withStroke(linewidth=3.5, foreground="white")]


def label_sky(ax: Axes) -> None:
    """Label axes whose origin is the star, and mark the star with a cross."""
    ax.plot(0, 0, "+", color=INK, ms=11, mew=1.6, label="star", path_effects=halo())
    ax.set_xlabel("x from the star (arcsec)")
    ax.set_ylabel("y from the star (arcsec)")


def circles(ax: Axes, places: ArrayLike, labels: Sequence[str] = ()) -> None:
    """Draw circles around positions (k, 2), with labels unless so many long ones would overlap."""
    x, y = np.reshape(places, (-1, 2)).T
    ax.plot(
        x, y, "o", mfc="none", mec=INK, ms=15, mew=1.6, label="companions", path_effects=halo()
    )  # fmt: skip
    is_short = all(len(label) <= 2 for label in labels)
    shown = labels if is_short or len(x) <= _LABELLED else ()
    for label, place in zip(shown, zip(x, y, strict=True), strict=False):
        ax.annotate(
            label, place, (0, 11), textcoords="offset points", color=INK, ha="center", va="bottom",
            path_effects=halo(),
        )  # fmt: skip


def compass(ax: Axes, position_angle: float) -> None:
    """Draw arrows to north and east in the lower left corner.

    Parameters
    ----------
    ax : Axes
    position_angle : float
        Position angle of the image's +y axis, degrees east of north.
    """
    angle = radians(position_angle)
    # Whichever way the arrows point, they stay inside.
    north, east = (sin(angle), cos(angle)), (-cos(angle), sin(angle))
    margin = 14.0
    x, y = (margin - _COMPASS * min(0.0, north[k], east[k]) for k in range(2))
    for letter, arrow in (("N", north), ("E", east)):
        ax.annotate(
            letter, (x, y), (x + _COMPASS * arrow[0], y + _COMPASS * arrow[1]),
            xycoords="axes points", textcoords="axes points", color=INK, ha="center", va="center",
            path_effects=halo(),
            arrowprops={
                "arrowstyle": "<-", "color": INK, "lw": 1.4, "shrinkB": 0, "path_effects": halo(),
            },
        )  # fmt: skip


def unit_label(unit: UnitBase) -> str:
    """Return a unit as text for a colour bar."""
    names = getattr(unit, "long_names", [])
    return str(names[0] if names else unit.to_string())
