"""The result at a glance: the frames without the star, KLIP's beside them, and the S/N map."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from astropy.convolution import Gaussian2DKernel, interpolate_replace_nans
from astropy.table import QTable
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from pyklip_diffrender import drawing
from pyklip_diffrender.detection import combine_frames, draw_curve
from pyklip_diffrender.io.geometry import rotation_matrix
from pyklip_diffrender.reduction.result import Reduction

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
            from pyklip_diffrender.pyklip_backend.klip import klip_curve, klip_image

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
    reduction : Reduction
    klip : Klip, optional
    """

    def __init__(self, reduction: Reduction, klip: Klip | None) -> None:
        detection = reduction.detection
        self._detection, self.klip = detection, klip
        self._templates = detection.groups[0][1]
        observation = detection.observation
        self._oriented = observation.position_angles is not None
        self._unit = drawing.unit_label(observation.unit)
        to_sky = rotation_matrix(detection.north)
        half = max(observation.shape) // 2
        y, x = np.mgrid[-half : half + 1, -half : half + 1]
        scale = np.sqrt(np.prod(observation.pixelscale))
        self.grid = scale * np.stack([x, y], axis=-1)
        self._on_frame = self.grid @ to_sky
        table = detection.candidates
        self._places = np.stack([table["x"].value, table["y"].value], axis=1) @ to_sky.T
        self._labels = [f"S/N {each:.1f}" for each in table["snr"]]
        self.image, self._error = self._combined(reduction)

    def _combined(self, reduction: Reduction) -> tuple[Image, Image]:
        """Frames minus the star, and the error of their mean."""
        images, errors = {}, {}
        lights: Sequence[Any] = [0.0] * len(self._templates.frames)
        if reduction.disk is not None:
            lights = reduction.disk.light
        left = zip(self._templates.frames.items(), self._detection.subtracted, lights, strict=True)
        for (k, frame), subtracted, light in left:
            filled = interpolate_replace_nans(subtracted, Gaussian2DKernel(1.0))
            images[k] = np.nan_to_num(filled) + light
            error = frame.observation.combined().error[0]
            errors[k] = np.where(np.isfinite(subtracted), error, np.inf)
        return combine_frames(self._templates, images, errors, self._on_frame)

    def _snr(self) -> Image:
        """The S/N map, interpolated."""
        first = min(self._templates.frames)
        places = self._templates.pixels_of(first, torch.from_numpy(self._on_frame.reshape(-1, 2)))
        turned = map_coordinates(self._detection.snr, places, order=1, cval=np.nan)
        return np.asarray(turned.reshape(self.grid.shape[:2]))

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
        linear = _LINEAR * float(np.nanmedian(self._error))
        style: dict[str, Any] = {
            "bar": self._unit, "linear": linear, "north": 0.0 if self._oriented else None,
            "limit": float(np.nanmax(np.abs(self.image))), "places": self._places,
        }  # fmt: skip
        drawing.signed_image(axes[0], self.image, self.grid, title="Without the star", **style)
        if self.klip is not None:
            image, grid, title = self.klip.image, self.klip.grid, self.klip.label
            drawing.signed_image(axes[1], image, grid, title=title, **style)
            axes[1].set_xlim(axes[0].get_xlim())
            axes[1].set_ylim(axes[0].get_ylim())
        drawing.snr_map(
            axes[-1], self._snr(), self.grid, self._places, style["north"], title="S/N",
            labels=self._labels,
        )  # fmt: skip

    def figure(self) -> Any:
        """One figure of all panels and the contrast curve."""
        figure, axes = drawing.new_figure(1, self.panels + 1)
        self.draw(list(axes[0, :-1]))
        draw_curve(axes[0, -1], self._detection, self.klip and self.klip.curve)
        return figure
