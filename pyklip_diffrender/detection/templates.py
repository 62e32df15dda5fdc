"""Images of planets of contrast 1 at any position in the frames of a fit."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from torch import Tensor

from pyklip_diffrender.detection.field import Image
from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.instrument.masks import BEYOND_MASK_ARCSEC
from pyklip_diffrender.io.units import rotation_matrix
from pyklip_diffrender.linear.model import LinearModel
from pyklip_diffrender.linear.response import at_half_the_wavelengths
from pyklip_diffrender.optics.bandpass import Bandpass
from pyklip_diffrender.optics.point_sources import PointSources
from pyklip_diffrender.optics.system import OpticalSystem
from pyklip_diffrender.refinement import FrameFit, Refinement

_PLACES_PER_PIXEL = 3
"""Positions of sources per pixel, along x and y, in frames where they are not at pixel centres. A
source that stands a sixth of a pixel from its template loses 0.5 % of its S/N in a map; candidates
are measured with templates of their own."""

_MOST_TEMPLATE_WAVELENGTHS = 4
"""Largest number of wavelengths of the templates of a map where they must be the model's own."""

_BAND_PER_WAVELENGTH = 0.1
"""Width of the part of a bandpass, as a fraction of its mean wavelength, that one wavelength stands
for in the templates of a map. For the filters of NIRCam these differ by an rms of 1 to 3 % from
templates of the whole bandpass, and their amplitudes by 2e-4. Candidates are measured with all."""

_SHIFT_ARCSEC = 5e-4
"""arcsec between images whose difference is a derivative; accurate to 1e-4."""

_MOST_KEPT_IMAGES = 200
"""Largest number of images with derivatives that are kept."""

_SAME_PLACE = 1e-6
"""arcsec, degrees: frames that differ by less have their sources at the same places."""


class Templates:
    """Images of planets in frames that were refined together, in the data's unit.

    Positions are x, y from the star in arcsec, in the frame `origin`, the first one. The others may
    be rolled and have their stars at other positions. `frames` are the target's, by their place in
    the fit, or those at `places` in it.
    """

    def __init__(self, fit: Refinement, places: Sequence[int] | None = None) -> None:
        if places is None:
            places = [k for k, each in enumerate(fit.frames) if not each.observation.reference]
            if fit.frames[0].observation.reference:
                raise IncompatibleSetupError(
                    "fit: expected frames of the target, the first of all included; got a "
                    "reference star"
                )
        self.fit = fit
        self.frames = {k: fit.frames[k] for k in places}
        self.origin = fit.frames[places[0]]
        self.rolls = {
            k: frame.observation.roll_from(self.origin.observation)
            for k, frame in self.frames.items()
        }
        self._sources: dict[tuple[int, int, int], PointSources] = {}
        self._rendered: dict[tuple[float, ...], Tensor] = {}
        self.grid = self.origin.grid
        """x, y of all the first frame's pixels from the star, (ny, nx, 2), arcsec."""

    @property
    def linear(self) -> LinearModel:
        """The linear model of the fit, without companions."""
        return self.fit.star_only

    @staticmethod
    def _star(frame: FrameFit) -> Tensor:
        return frame.optical_values.get("star_offset", torch.zeros(2, dtype=torch.float64)).cpu()

    def _turned(self, k: int, offsets: Tensor) -> Tensor:
        """Positions in frame k, from the star, of positions in the first frame."""
        return offsets @ torch.from_numpy(rotation_matrix(self.rolls[k])).T

    def _points(self, k: int, right: int = 0, up: int = 0) -> PointSources:
        """Sources of frame k, `right` and `up` steps of the fine grid from the pixels' centres."""
        key = (k, right, up)
        if key not in self._sources:
            frame = self.frames[k]
            bandpass = _few_wavelengths(frame.model)
            detector = frame.model.detector
            x, y = (part / _PLACES_PER_PIXEL * scale for part, scale in
                    zip((right, up), detector.pixelscale, strict=True))  # fmt: skip
            self._sources[key] = PointSources(
                frame.model.at_wavelengths(bandpass),
                _as_tensor(frame.opd),
                frame.optical_values,
                offset=(x, y + detector.shear * x),
                wrapped=True,
            )
        return self._sources[key]

    def _aligned(self, k: int) -> bool:
        """Whether planets at the first frame's pixel centres are at pixel centres in frame k."""
        moved = self._axis(self.frames[k]) - self._axis(self.origin)
        return abs(self.rolls[k]) < _SAME_PLACE and float(moved.abs().max()) < _SAME_PLACE

    def _axis(self, frame: FrameFit) -> Tensor:
        """Place of the star on the pixels, up to a constant."""
        shift = frame.optical_values.get("detector_shift", torch.zeros(2, dtype=torch.float64))
        return shift.cpu() + self._star(frame)

    def at_pixels(self, rows: NDArray[np.int64], columns: NDArray[np.int64]) -> dict[int, Tensor]:
        """Planets at pixel centres of the first frame, (k, ny, nx), float32, by frame."""
        offsets = torch.from_numpy(self.grid[rows, columns])
        images = {}
        for k, frame in self.frames.items():
            if self._aligned(k):
                sources = self._points(k).images(rows, columns)
            else:
                sources = self._near(k, self._turned(k, offsets))
            images[k] = (frame.flux * sources).cpu()
        return images

    def pixels_of(self, k: int, offsets: Tensor) -> NDArray[np.float64]:
        """Rows and columns in frame k, (2, n), of positions in the first frame, (n, 2)."""
        return self._pixels(k, self._turned(k, offsets)).numpy()

    def _pixels(self, k: int, offsets: Tensor) -> Tensor:
        """Rows and columns of positions in frame k, (2, n)."""
        frame = self.frames[k]
        detector = frame.model.detector
        first = self._points(k).positions([0], [0])[0].cpu()
        x, y = (self._star(frame) + offsets - first).T
        return torch.stack(
            [(y - detector.shear * x) / detector.pixelscale[1], x / detector.pixelscale[0]]
        )

    def _near(self, k: int, offsets: Tensor) -> Tensor:
        """Sources in frame k, each moved to the nearest of the places in `_points`.

        Sources that are not on the detector have no light.
        """
        detector = self.frames[k].model.detector
        # In thirds of a pixel, a place is 3 times the nearest pixel plus -1, 0 or 1.
        fine = (_PLACES_PER_PIXEL * self._pixels(k, offsets)).round().to(torch.int64)
        pixel = torch.div(fine + _PLACES_PER_PIXEL // 2, _PLACES_PER_PIXEL, rounding_mode="floor")
        part = fine - _PLACES_PER_PIXEL * pixel
        ny, nx = detector.shape
        row, column = pixel
        inside = (row >= 0) & (row < ny) & (column >= 0) & (column < nx)
        images = torch.zeros(len(offsets), ny, nx, dtype=torch.float32)
        for up, right in torch.unique(part[:, inside], dim=1).T.tolist():
            selected = torch.nonzero(inside & (part[0] == up) & (part[1] == right)).flatten()
            images[selected] = (
                self._points(k, right, up).images(row[selected], column[selected]).cpu()
            )
        return images

    def at(self, offsets: Tensor, slopes: bool = False) -> dict[int, Tensor]:
        """Planets at x, y (k, 2) in the first frame, arcsec, with the model as it was fitted.

        They are (k, ny, nx) by frame, or (3, k, ny, nx) with derivatives by x and y; float64.
        """
        images = {}
        for k in self.frames:
            rows = [self._with_slopes(k, offset) for offset in offsets] if slopes else []
            single = [] if slopes else [self._light(k, offset) for offset in offsets]
            images[k] = torch.stack(rows, dim=1) if slopes else torch.stack(single)
        return images

    def _light(self, k: int, offset: Tensor, model: OpticalSystem | None = None) -> Tensor:
        """Light of one planet in frame k, (ny, nx), on the CPU."""
        with torch.no_grad():
            return (self.frames[k].flux * self.image(k, offset, model=model)).cpu()

    def _with_slopes(self, k: int, offset: Tensor) -> Tensor:
        """Light of a planet and its derivatives by x and y, (3, ny, nx), per arcsec."""
        key = (k, *offset.tolist())
        if key not in self._rendered:
            if len(self._rendered) >= _MOST_KEPT_IMAGES:
                self._rendered.clear()
            # Central differences: a fast path renders single stars, but only without forward-mode
            # derivatives, which take three times as long as four more images. Half of the
            # wavelengths change these images by 0.4 % in F444W, and by 4 % in F322W2.
            parts, fewer = [self._light(k, offset)], at_half_the_wavelengths(self.frames[k].model)
            for step in _SHIFT_ARCSEC * torch.eye(2, dtype=torch.float64):
                ahead, behind = (self._light(k, offset + by, fewer) for by in (step, -step))
                parts.append((ahead - behind) / (2 * _SHIFT_ARCSEC))
            self._rendered[key] = torch.stack(parts)
        return self._rendered[key]

    def beyond_mask(self, k: int) -> Tensor:
        """A source that the mask does not dim, at the pixel (ny // 2, nx // 2), (ny, nx).

        It is on neither of the axes, along which bars extend.
        """
        frame = self.frames[k]
        place = self._star(frame) + torch.tensor(BEYOND_MASK_ARCSEC, dtype=torch.float64)
        # The pixel n // 2 of an even number is half a pixel beyond the middle of the array.
        middle = torch.tensor(
            [
                0.0 if n % 2 else scale / 2
                for n, scale in zip(
                    frame.model.detector.shape[::-1], frame.model.detector.pixelscale, strict=True
                )
            ],
            dtype=torch.float64,
        )
        values = {**frame.optical_values, "star_offset": place, "detector_shift": middle - place}
        with torch.no_grad():
            return frame.model(_as_tensor(frame.opd), **values).double().cpu()

    def place_of(self, k: int, offset: Tensor) -> Tensor:
        """Position of a planet from the occulter in frame k, (2,), arcsec."""
        return self._star(self.frames[k]) + self._turned(k, offset)

    def image(
        self,
        k: int,
        offset: Tensor,
        change: Tensor | None = None,
        model: OpticalSystem | None = None,
    ) -> Tensor:
        """One planet at x, y (2,) in frame k, as a fraction of the star's light, (ny, nx).

        `change` is added to the fitted wavefront, (npix, npix), m; `model` is by default the
        frame's.
        """
        frame = self.frames[k]
        values = {**frame.optical_values, "star_offset": self.place_of(k, offset)}
        opd = _as_tensor(frame.opd)
        return (model or frame.model)(opd if change is None else opd + change, **values).double()


def _few_wavelengths(model: OpticalSystem) -> Bandpass:
    """As few wavelengths as the templates of a map need."""
    bandpass = model.bandpass
    if "bandpass" not in model.adjustable:
        return bandpass.thinned(_MOST_TEMPLATE_WAVELENGTHS)
    return bandpass.condensed(max(2, math.ceil(bandpass.width / _BAND_PER_WAVELENGTH)))


def _as_tensor(opd: NDArray[np.float64]) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(opd))


# Frames of several rolls, turned to one orientation and averaged.


def combine_frames(
    templates: Templates,
    images: Mapping[int, Image],
    errors: Mapping[int, Image],
    offsets: Image,
) -> tuple[Image, Image]:
    """Average frames, weighted by their errors, at positions about the star, and their errors.

    Images and standard deviations (inf for invalid pixels) are (ny, nx) by frame, and `offsets`
    (rows, columns, 2) x, y from the star in the first frame, arcsec. Results are (rows, columns),
    NaN where no frame has a valid pixel.
    """
    shape = offsets.shape[:2]
    # Invalid pixels get no weight, but cubic splines reach over them: their images need finite
    # values.
    total, weights = np.zeros((2, *shape))
    for k, image in images.items():
        places = templates.pixels_of(k, torch.from_numpy(offsets.reshape(-1, 2)))
        values, weight = (
            map_coordinates(array, places, order=order, cval=0.0).reshape(shape)
            for array, order in ((image, 3), (errors[k] ** -2.0, 1))
        )
        total += weight * values
        weights += weight
    covered = weights > 0
    safe = np.where(covered, weights, 1.0)
    return np.where(covered, total / safe, np.nan), np.where(covered, safe**-0.5, np.nan)
