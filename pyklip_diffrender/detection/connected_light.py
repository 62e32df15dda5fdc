"""Which light of sources on a grid is extended, and which is that of point sources.

The brightness of the sources is smoothed by a beam of lambda/D. Of all straight lines of a given
length through a position, in all directions, one is brightest at its faintest point: that
brightness is the opening of the image by lines (Soille 2003, Morphological Image Analysis, chapter
4). It keeps what goes on in any direction, however narrow, such as a disk seen edge-on or a ring,
while little is left of a point source, which is dark half a line away.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from pyklip_diffrender.detection.field import Image

__all__ = ["ConnectedLight"]

Mask = NDArray[np.bool_]

_HALF_LINE = 1.5
"""lambda/D, rounded to pixels: the beam leaves at most 2 % of a point source at that distance."""

_DIRECTIONS = 12
"""Number of directions of lines, over half a turn."""

_SHARE = 0.18
"""Least share of the smoothed brightness that the opening keeps of extended light. It was 0.21
or more at the brightest peaks, of S/N 8 to 95, of simulated rings and clouds, which noise breaks up
into clumps, and at most 0.16 for planets of S/N 13 and more 0.4 arcsec from a bright ring."""

_FAINTEST = 1.0
_LEAST = 3.0
"""Standard deviations of one source: extended light is brighter than the first everywhere and than
the second somewhere. The opening of noise was up to 2.9."""

_BESIDE_POINT = 0.2
"""Share of the brightest point source that extended light must have somewhere: errors of the model
left up to 0.1 of a source about simulated companions of 1e-5 to 1e-3."""

_MARGIN = 0.5
"""lambda/D by which regions exceed what is as bright as that."""

_LIMIT = 5.0
"""S/N of a point source that is significant."""


class ConnectedLight:
    """Brightness of sources, smoothed and opened by lines.

    Parameters
    ----------
    snr : ndarray, (ny, nx)
        Light of the source on each pixel over its standard deviation if it were alone.
    resolution : float
        lambda/D, pixels.

    Attributes
    ----------
    smoothed : ndarray, (ny, nx)
        In a beam that keeps the peak of a point source.
    opened : ndarray, (ny, nx)

    Examples
    --------
    A line is extended light, a point source beside it is not:

    >>> import numpy as np
    >>> from pyklip_diffrender.detection.connected_light import ConnectedLight
    >>> snr = np.zeros((32, 32))
    >>> snr[8, 4:28] = snr[20, 16] = 20.0
    >>> is_extended = ConnectedLight(snr, resolution=2.3).is_extended
    >>> bool(is_extended[8, 16]), bool(is_extended[20, 16])
    (True, False)
    """

    def __init__(self, snr: Image, resolution: float) -> None:
        self.resolution = resolution
        width = resolution / np.sqrt(8 * np.log(2))
        self.smoothed = 2 * np.pi * width**2 * ndimage.gaussian_filter(snr, width)
        self.opened = self._opening()

    def _opening(self, peak: float = 0.0) -> Image:
        """The opening at every pixel with a point source added there, (ny, nx)."""
        half = max(1, round(_HALF_LINE * self.resolution))
        along = np.arange(-2 * half, 2 * half + 1)
        source = peak * np.exp(-4 * np.log(2) * (along / self.resolution) ** 2)
        rows, columns = np.indices(self.smoothed.shape)
        best = np.zeros(self.smoothed.shape)
        for angle in np.pi / _DIRECTIONS * np.arange(_DIRECTIONS):
            profiles = [
                ndimage.map_coordinates(
                    self.smoothed,
                    [rows + step * np.sin(angle), columns + step * np.cos(angle)],
                    order=1,
                    mode="nearest",
                )
                + added
                for step, added in zip(along, source, strict=True)
            ]
            faintest = ndimage.minimum_filter1d(profiles, 2 * half + 1, axis=0)
            best = np.maximum(best, faintest[half : 3 * half + 1].max(axis=0))
        return best

    @property
    def is_extended(self) -> Mask:
        """Where light is extended, (ny, nx); nowhere if all of it may be the error of a point."""
        is_extended = self.opened > _SHARE * self.smoothed
        least = max(_LEAST, _BESIDE_POINT * np.where(is_extended, 0, self.smoothed).max())
        return np.asarray(is_extended & (self.opened[is_extended].max(initial=0) > least))

    @property
    def region(self) -> Mask:
        """Where extended light may be, (ny, nx); empty if none is bright enough."""
        labels, _ = ndimage.label(self.opened > _FAINTEST, structure=np.ones((3, 3)))
        return self._with_margin(np.isin(labels, np.setdiff1d(labels[self.opened > _LEAST], 0)))

    @property
    def bright(self) -> Mask:
        """Where light is significant, whatever it is, (ny, nx)."""
        return self._with_margin(self.smoothed > _LIMIT)

    def _with_margin(self, mask: Mask) -> Mask:
        away = ndimage.distance_transform_edt(~mask) if mask.any() else np.inf
        return np.broadcast_to(away <= _MARGIN * self.resolution, mask.shape)

    @property
    def hides_points(self) -> Mask:
        """Where a point source of S/N 5 would count as extended light, (ny, nx)."""
        return np.asarray(self._opening(_LIMIT) > _SHARE * (self.smoothed + _LIMIT))
