"""The figure of a search: its S/N map and its contrast curve."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

from astropy.table import QTable

from pyklip_diffrender import drawing
from pyklip_diffrender.detection.error_factor import ErrorFactor
from pyklip_diffrender.detection.field import Image
from pyklip_diffrender.scene.observation import Observation

__all__ = ["draw_search"]


class _Search(Protocol):
    """The part of a `Detection` or a `WideField` that is drawn."""

    @property
    def snr(self) -> Image: ...
    @property
    def grid(self) -> Image: ...
    @property
    def table(self) -> QTable: ...
    @property
    def contrast_curve(self) -> QTable: ...
    @property
    def threshold(self) -> float: ...
    @property
    def error_factor(self) -> ErrorFactor: ...
    @property
    def observation(self) -> Observation: ...
    @property
    def north(self) -> float: ...


def draw_search(axes: Sequence[Any], search: _Search, klip: QTable | None = None) -> None:
    """Draw the S/N map with the candidates, and the contrast curve.

    Parameters
    ----------
    axes : two Axes
    search : Detection or WideField
    klip : QTable, optional
        Contrast curve of KLIP on the same frames, see `klip_curve`.
    """
    drawing.search(
        axes,
        search.snr,
        search.grid,
        search.table,
        search.contrast_curve,
        threshold=search.threshold,
        north=None if search.observation.position_angles is None else search.north,
        small_sample=search.error_factor.is_measured,
        klip=klip,
    )
