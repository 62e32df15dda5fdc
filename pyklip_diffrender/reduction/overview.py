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
    def panels(self) -> tuple[str, ...]:
        """Names of the panels: the image, KLIP's, the most probable image, and the S/N."""
        return (
            "without_star",
            *(() if self.klip is None else ("klip",)),
            # With a disk in the model that image would lack its light.
            *(() if self.images.has_disk else ("most_probable",)),
            "snr",
        )

    def draw(self, ax: Any, panel: str) -> None:
        """Draw one of `panels`; all images of light have the same scale.

        Parameters
        ----------
        ax : Axes
        panel : str
        """
        grid, north = self.images.grid, 0.0 if self.images.oriented else None
        if panel == "snr":
            snr = self.images.turned(self._detection.snr)
            drawing.snr_map(ax, snr, grid, self._places, north, title="S/N", labels=self._labels)
            return
        mean, error = self.images.combined
        image, title = mean, "Without the star"
        if panel == "most_probable":
            image, title = self.images.posterior_mean[0], "Most probable image"
        if panel == "klip" and self.klip is not None:
            image, grid, title = self.klip.image, self.klip.grid, self.klip.label
        drawing.signed_image(
            ax, image, grid, float(np.nanmax(np.abs(mean))), bar=self._unit, title=title,
            places=self._places, linear=_LINEAR * float(np.nanmedian(error)), north=north,
        )  # fmt: skip
        pixel = self.images.grid[0, 1, 0] - self.images.grid[0, 0, 0]
        half = np.abs(self.images.grid).max() + pixel / 2
        ax.set_xlim(-half, half)
        ax.set_ylim(-half, half)

    def kept(self, separations: Sequence[float]) -> tuple[Image, Image | None]:
        """Fractions of a faint source's light that the image and KLIP leave at separations.

        Medians of rings a resolution element wide; KLIP's are those of its best numbers of modes.
        """
        resolution = self._detection.contrast_curve.meta["resolution_arcsec"]
        distance = np.hypot(*np.moveaxis(self.images.grid, -1, 0))
        kept = self.images.throughput
        ours = [
            np.nanmedian(kept[np.abs(distance - each) < resolution / 2]) for each in separations
        ]
        if self.klip is None:
            return np.array(ours), None
        curve = self.klip.curve
        theirs = np.interp(
            separations, curve["separation"].value, curve["throughput"], np.nan, np.nan
        )
        return np.array(ours), np.asarray(theirs)

    def figure(self) -> Any:
        """One figure of the panels but the most probable image, and the contrast curve."""
        panels = [each for each in self.panels if each != "most_probable"]
        figure, axes = drawing.new_figure(1, len(panels) + 1)
        for ax, panel in zip(axes[0], panels, strict=False):
            self.draw(ax, panel)
        draw_curve(axes[0, -1], self._detection, self.klip and self.klip.curve)
        return figure
