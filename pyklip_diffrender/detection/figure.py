"""The figure of a search: its S/N map and its contrast curve."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
from astropy.table import QTable

from pyklip_diffrender import drawing
from pyklip_diffrender.detection.error_factor import ErrorFactor
from pyklip_diffrender.detection.field import Image
from pyklip_diffrender.scene.observation import Observation

__all__ = ["draw_curve", "draw_search"]


class _Search(Protocol):
    """The part of a `Detection` or a `WideField` that is drawn."""

    @property
    def snr(self) -> Image: ...
    @property
    def grid(self) -> Image: ...
    @property
    def candidates(self) -> QTable: ...
    @property
    def contrast_curve(self) -> QTable: ...
    @property
    def threshold(self) -> float: ...
    @property
    def error_factor(self) -> ErrorFactor: ...
    @property
    def observation(self) -> Observation: ...


def draw_search(axes: Sequence[Any], search: _Search) -> None:
    """Draw the S/N map with the candidates, and the contrast curve.

    Parameters
    ----------
    axes : two Axes
    search : Detection or WideField
    """
    table = search.candidates
    drawing.snr_map(
        axes[0], search.snr, search.grid,
        np.stack([table["x"].value, table["y"].value], axis=1),
        search.observation.north,
        title=f"{len(table)} candidate{'' if len(table) == 1 else 's'} above "
        f"S/N {search.threshold:g}",
        labels=[f"S/N {each:.1f}" for each in table["snr"]],
    )  # fmt: skip
    draw_curve(axes[1], search)


def draw_curve(
    ax: Any, search: _Search, klip: QTable | None = None, *, legend_below: bool = False
) -> None:
    """Draw the contrast curve with the candidates.

    Parameters
    ----------
    ax : Axes
    search : Detection or WideField
    klip : QTable, optional
        Contrast curve of KLIP on the same frames, see `klip_curve`.
    legend_below : bool
        See `drawing.contrast_curve`.
    """
    drawing.contrast_curve(
        ax, search.contrast_curve, search.candidates, small_sample=search.error_factor.is_measured,
        klip=klip, legend_below=legend_below,
    )  # fmt: skip
