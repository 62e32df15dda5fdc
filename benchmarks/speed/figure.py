"""The figure of the performance page: error against time."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import product
from typing import Any

import numpy as np
from astropy.table import Table
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.transforms import Bbox

_INK = "#1b1f24"
_OURS, _OTHERS = "#5b3f95", "#c0631a"
_MARKER = 6
"""Half a marker's width, pixels."""


def draw(table: Table) -> Figure:
    """Error against time of every way to make an image, without and with its derivative.

    Parameters
    ----------
    table : Table
        What `run_bench` returned.
    """
    figure = Figure(figsize=(13, 5.2), layout="constrained")
    labelled = []
    for ax, row in zip(figure.subplots(1, 2), ("forward", "forward + backward"), strict=True):
        measured = np.isfinite(table["seconds"]) & (table["error"] > 0)
        selected = table[(table["row"] == row) & measured]
        selected.sort("seconds")
        names: dict[str, tuple[float, float]] = {}
        for line in selected:
            ours = str(line["column"]).startswith(("this package", "multi-fidelity", "coarse"))
            color = _OURS if ours else _OTHERS
            filled = color if line["precision"] == "float64" else "none"
            ax.loglog(line["seconds"], line["error"], "o", color=color, mfc=filled, ms=7)
            if line["precision"] == "float64":  # Next to its own kind in float32.
                name = str(line["column"])
                names[name if ours else name.split(",")[0]] = (line["seconds"], line["error"])
        # Nothing is both faster and better than these.
        order = np.argsort(selected["seconds"])
        best = np.minimum.accumulate(np.asarray(selected["error"])[order])
        front = np.asarray(selected["seconds"])[order]
        ax.step(front, best, where="post", color="0.75", lw=1, zorder=0)
        ax.margins(0.15)
        ax.set_xlabel("seconds", fontsize=9)
        ax.set_title(f"{row[0].upper()}{row[1:]}", fontsize=10, color=_INK, loc="left")
        ax.tick_params(labelsize=8, colors=_INK)
        if row == "forward":
            ax.set_ylabel("largest error / peak", fontsize=9)
            ax.plot([], [], "o", color=_INK, label="float64")
            ax.plot([], [], "o", color=_INK, mfc="none", label="float32")
            ax.legend(frameon=False, fontsize=8)
        labelled.append((ax, names))
    figure.draw_without_rendering()
    for ax, names in labelled:
        _label_apart(ax, names)
    return figure


def _label_apart(ax: Axes, names: Mapping[str, tuple[float, float]]) -> None:
    """Names beside points, inside the axes, where they cover neither points nor each other."""
    middles = ax.transData.transform(np.reshape(list(names.values()), (-1, 2)))
    used: list[Any] = [Bbox.from_extents(*(xy - _MARKER), *(xy + _MARKER)) for xy in middles]
    for name, point in names.items():
        for up, right in product((5, -9, 17, -21, 29, -33), (True, False)):
            label = ax.annotate(
                name, point, xytext=(7 if right else -7, up), textcoords="offset points",
                fontsize=7, ha="left" if right else "right", color=_INK,
            )  # fmt: skip
            box = label.get_window_extent()
            inside = ax.bbox.x0 < box.x0 and box.x1 < ax.bbox.x1
            if inside and not any(box.overlaps(other) for other in used):
                break
            label.remove()
        else:
            label = ax.annotate(name, point, fontsize=7, color=_INK)
            box = label.get_window_extent()
        used.append(box)
