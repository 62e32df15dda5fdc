"""The result of a search: S/N map and contrast curve."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from astropy.table import QTable
from numpy.typing import NDArray

from pyklip_diffrender.drawing.curves import contrast_curve
from pyklip_diffrender.drawing.images import snr_map

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["search"]

_LABELLED = 4
"""Largest number of candidates that are labelled: the labels of more would overlap."""


def search(
    axes: Sequence[Axes],
    snr: NDArray[np.float64],
    grid: NDArray[np.float64],
    table: QTable,
    curve: QTable,
    *,
    threshold: float,
    north: float | None,
    small_sample: bool,
    klip: QTable | None = None,
) -> None:
    """Draw a map of S/N with the candidates, and the contrast curve.

    Parameters
    ----------
    axes : two Axes
    snr : ndarray, (ny, nx)
    grid : ndarray, (ny, nx, 2)
        x and y of the pixels from the star, arcsec.
    table : QTable
        Candidates: x, y, snr, separation, contrast and their errors.
    curve, small_sample, klip
        See `contrast_curve`.
    threshold : float
        S/N of a candidate.
    north : float or None
        Position angle of +y, degrees.
    """
    labels = [f"S/N {each:.1f}" for each in table["snr"]] if len(table) <= _LABELLED else []
    snr_map(
        axes[0], snr, grid, np.stack([table["x"].value, table["y"].value], axis=1), north,
        title=f"{len(table)} candidate{'' if len(table) == 1 else 's'} above S/N {threshold:g}",
        labels=labels,
    )  # fmt: skip
    contrast_curve(axes[1], curve, table, small_sample=small_sample, klip=klip)
