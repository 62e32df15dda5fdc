"""The result at a glance: the frames without the star, KLIP's beside them, and the S/N map."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from astropy.table import QTable
from numpy.typing import NDArray

from pyklip_diffrender import drawing
from pyklip_diffrender.detection import draw_curve
from pyklip_diffrender.reduction.reduction_result import Reduction
from pyklip_diffrender.reduction.sky_images import SkyImages

__all__ = ["Klip", "Overview"]

_log = logging.getLogger(__name__)

Image = NDArray[np.float64]

_LINEAR = 5.0
"""Linear part of the scale for light, standard deviations of the noise."""


@dataclass(frozen=True, eq=False)
class Klip:
    """KLIP on the frames of a reduction.

    Attributes
    ----------
    curve : QTable
        See `klip_curve`.
    image : ndarray, (ny, nx)
        Frames without the star, combined, north up.
    grid : ndarray, (ny, nx, 2)
        x, y of its pixels from the star, arcsec.
    label : str
        References and modes of the image.
    """

    curve: QTable
    image: Image
    grid: Image
    label: str

    @classmethod
    def of(cls, reduction: Reduction) -> Klip | None:
        """KLIP for a reduction; None where it has no references or fails."""
        sequence, detection = reduction.sequence, reduction.detection
        if not sequence.references and len(sequence.science) < 2:
            return None
        # A disk is part of the frames that KLIP would get.
        science = None if reduction.disk is None else sequence.science
        try:
            # pyKLIP is loaded only if it is needed.
            from pyklip_diffrender.reduction.klip_curve import klip_curve, klip_image

            curve = klip_curve(detection, sequence.references)
            modes = int(np.median(curve["modes"]))
            image = klip_image(
                detection, sequence.references, science, modes=modes, north=detection.north
            )
        except Exception as error:  # An addition to the report, which is complete without it.
            _log.warning("the report has no comparison with KLIP: %s", error)
            return None
        return cls(curve, *image)


class Overview:
    """Images with north up, or with the orientation of the first frame where north is not known.

    Parameters
    ----------
    images : SkyImages
    klip : Klip, optional
    """

    def __init__(self, images: SkyImages, klip: Klip | None) -> None:
        self.images, self.klip = images, klip
        detection = images.detection
        self._detection = detection
        self._unit = drawing.unit_label(detection.observation.unit)
        table = detection.candidates
        self._places = np.stack([table["x"].value, table["y"].value], axis=1) @ images.to_sky.T
        self._labels = [f"S/N {each:.1f}" for each in table["snr"]]

    @property
    def panels(self) -> int:
        """Number of panels."""
        return 2 if self.klip is None else 3

    def draw(self, axes: Sequence[Any]) -> None:
        """Draw the combined image, KLIP's at the same scale if there is one, and the S/N map.

        Parameters
        ----------
        axes : sequence of `panels` Axes
        """
        mean, error = self.images.combined
        image, grid = self.images.image, self.images.grid
        north = 0.0 if self.images.oriented else None
        style: dict[str, Any] = {
            "bar": self._unit, "linear": _LINEAR * float(np.nanmedian(error)), "north": north,
            "limit": float(np.nanmax(np.abs(mean))), "places": self._places,
        }  # fmt: skip
        drawing.signed_image(axes[0], image, grid, title="Without the star", **style)
        if self.klip is not None:
            title = self.klip.label
            drawing.signed_image(axes[1], self.klip.image, self.klip.grid, title=title, **style)
            axes[1].set_xlim(axes[0].get_xlim())
            axes[1].set_ylim(axes[0].get_ylim())
        snr = self.images.turned(self._detection.snr)
        drawing.snr_map(axes[-1], snr, grid, self._places, north, title="S/N", labels=self._labels)

    def figure(self) -> Any:
        """One figure of all panels and the contrast curve."""
        figure, axes = drawing.new_figure(1, self.panels + 1)
        self.draw(list(axes[0, :-1]))
        draw_curve(axes[0, -1], self._detection, self.klip and self.klip.curve)
        return figure
