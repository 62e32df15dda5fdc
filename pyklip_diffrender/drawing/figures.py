"""Figures, their axes and writing them; the marks that they share: labels and circles."""

from __future__ import annotations

from collections.abc import Sequence
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.io.files import replacing
from pyklip_diffrender.io.units import east_and_north

if TYPE_CHECKING:
    from astropy.units import UnitBase
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Marks on images: labels of axes, and circles.

INK = "#1b1f24"
ACCENT = "#0b6e4f"
"""A dark green, distinct from both ends of the red and blue maps."""


def halo() -> list[Any]:
    """Effects that make dark lines and text legible on any image."""
    from matplotlib.patheffects import withStroke

    return [withStroke(linewidth=3.5, foreground="white")]


def on_sky(places: ArrayLike, north: float | None) -> NDArray[np.float64]:
    """Turn x, y from the star (..., 2) into what axes show: offsets to the east and to the north.

    `north` is the position angle of the image's +y axis, degrees east of north; x and y come back
    as they are where it is None.
    """
    offsets = np.asarray(places, dtype=float)
    return offsets if north is None else offsets @ east_and_north(north).T


def label_sky(ax: Axes, oriented: bool, **style: Any) -> None:
    """Label axes whose origin is the star: offsets to the east and north, or x and y."""
    for label, name in (
        (ax.set_xlabel, "ΔRA cos Dec (arcsec)" if oriented else "x from the star (arcsec)"),
        (ax.set_ylabel, "ΔDec (arcsec)" if oriented else "y from the star (arcsec)"),
    ):
        label(name, **style)


def circles(ax: Axes, places: ArrayLike, labels: Sequence[str] = ()) -> None:
    """Draw circles around positions (k, 2), with labels unless so many long ones would overlap."""
    x, y = np.reshape(places, (-1, 2)).T
    ax.plot(
        x, y, "o", mfc="none", mec=INK, ms=15, mew=1.6, label="companions", path_effects=halo()
    )  # fmt: skip
    is_short = all(len(label) <= 2 for label in labels)
    shown = labels if is_short or len(x) <= 4 else ()
    for label, place in zip(shown, zip(x, y, strict=True), strict=False):
        ax.annotate(
            label, place, (0, 11), textcoords="offset points", color=INK, ha="center", va="bottom",
            path_effects=halo(),
        )  # fmt: skip


def unit_label(unit: UnitBase) -> str:
    """Return a unit as text for a colour bar."""
    names = getattr(unit, "long_names", [])
    return str(names[0] if names else unit.to_string())


# Figures, their axes, and writing them.


def axes_for(ax: Any, count: int) -> Sequence[Axes]:
    """Return the axes of the caller, or of a new figure with one row.

    Raises `IncompatibleSetupError` for another number of axes than `count`.
    """
    if ax is None:
        from matplotlib import pyplot

        size = (4.6 * count, 4.0)
        ax = pyplot.subplots(1, count, figsize=size, layout="compressed")[1]
    axes: list[Axes] = list(np.ravel(ax))
    if len(axes) != count:
        raise IncompatibleSetupError(
            f"ax: got {len(axes)} axes, expected {count}, such as pyplot.subplots(1, {count})[1]"
        )
    return axes


def new_figure(rows: int, columns: int) -> tuple[Figure, NDArray[Any]]:
    """Make a figure for a file, with a grid of axes, (rows, columns)."""
    # Colour bars and their labels are outside the axes that the layout knows.
    figure = constrained((4.6 * columns, 4.0 * rows), compress=True, w_pad=0.15)
    return figure, figure.subplots(rows, columns, squeeze=False)


def constrained(inches: tuple[float, float], **layout: Any) -> Figure:
    """Make a figure whose layout leaves room for all labels."""
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    return Figure(figsize=inches, layout=ConstrainedLayoutEngine(**layout))


def panel() -> Axes:
    """Make the axes of a figure that a page can put beside others of its kind."""
    from matplotlib.figure import Figure

    # Letters are as large as a page's where it is as wide as a phone. All have the same axes, so
    # that they are aligned.
    return Figure(figsize=(4.6, 3.7)).add_axes((0.17, 0.13, 0.6, 0.77))


def wide_panel() -> Axes:
    """Make the axes of a figure for a curve, which has a page to itself, and its legend."""
    return constrained((6.8, 5.2), w_pad=0.12, h_pad=0.12).subplots()


def save(figure: Figure, path: str | Path, dpi: int = 150) -> None:
    """Write a figure in one step, in the format that the ending of the path names."""
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=dpi, facecolor="white", format=Path(path).suffix[1:])


def to_png(figure: Figure) -> bytes:
    """Return the file that `save` would write."""
    stream = BytesIO()
    figure.savefig(stream, format="png", dpi=150, facecolor="white")
    return stream.getvalue()
