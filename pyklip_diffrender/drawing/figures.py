"""Figures, their axes, and writing them."""

from __future__ import annotations

from collections.abc import Sequence
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.io.files import replacing

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["axes_for", "new_figure", "panel", "save", "to_png", "wide_panel"]

_PANEL = (4.6, 3.7)
"""Size of a panel, inches: its letters are as large as a page's where it is as wide as a phone."""

_WIDE = (6.8, 5.2)
"""Size of a wide panel, inches."""

_BOX = (0.17, 0.13, 0.6, 0.77)
"""Axes in a panel, the same for all, so that panels side by side are aligned."""


def axes_for(ax: Any, count: int) -> Sequence[Axes]:
    """Return the axes of the caller, or those of a new figure with one row.

    Raises
    ------
    IncompatibleSetupError
        For another number of axes.
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
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    size = (4.6 * columns, 4.0 * rows)
    # Colour bars and their labels are outside the axes that the layout knows.
    figure = Figure(figsize=size, layout=ConstrainedLayoutEngine(compress=True, w_pad=0.15))
    return figure, figure.subplots(rows, columns, squeeze=False)


def panel() -> tuple[Figure, Axes]:
    """Make a figure with one axes, which a page can put beside others of its kind."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=_PANEL)
    return figure, figure.add_axes(_BOX)


def wide_panel() -> tuple[Figure, Axes]:
    """Make a figure with one axes for a curve, which has a page to itself, and its legend."""
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    figure = Figure(figsize=_WIDE, layout=ConstrainedLayoutEngine(w_pad=0.12, h_pad=0.12))
    return figure, figure.subplots()


def save(figure: Figure, path: str | Path, dpi: int = 150) -> None:
    """Write a figure in one step, in the format that the ending of the path names."""
    from matplotlib import rc_context

    form = Path(path).suffix.removeprefix(".").lower()
    # The same figure makes the same file; journals ask for fonts that are no outlines.
    undated = {"pdf": {"CreationDate": None}, "svg": {"Date": None}}.get(form)
    style = rc_context(
        {"pdf.fonttype": 42, "svg.fonttype": "none", "svg.hashsalt": "pyklip_diffrender"}
    )
    with replacing(path) as temporary, style:
        figure.savefig(temporary, dpi=dpi, facecolor="white", format=form, metadata=undated)


def to_png(figure: Figure, dpi: int = 150) -> bytes:
    """Return the file that `save` would write."""
    stream = BytesIO()
    figure.savefig(stream, format="png", dpi=dpi, facecolor="white")
    return stream.getvalue()
