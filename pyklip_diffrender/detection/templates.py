"""What a planet of contrast 1 looks like in the frames of a fit, wherever it is."""

from __future__ import annotations

import math
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.io.units import ARCSEC
from pyklip_diffrender.linear.forward_mode import jacfwd
from pyklip_diffrender.linear.response import coarse_copy, downsample
from pyklip_diffrender.optics.fast.point_sources import PointSources
from pyklip_diffrender.refinement import FrameFit, Refinement

__all__ = ["Templates"]

_MANY_NPIX = 256
"""Pupil samples for the many sources of frames whose positions are not the pixels' centres."""

_ALIGNED = 1e-6
"""arcsec, degrees: frames that differ by less have their sources at the same places."""


class Templates:
    """Images of planets in frames that were refined together, in the data's unit.

    Positions are x, y from the star in arcsec, as the first frame has them: the others may be
    rolled, and have their stars elsewhere.

    Parameters
    ----------
    fit : Refinement
        Reference stars among its frames show no planets and are left out.
    origin : FrameFit
        The frame whose pixels and orientation positions refer to.

    Attributes
    ----------
    frames : dict of int to FrameFit
        Frames of the target, by their place in the fit.
    """

    def __init__(self, fit: Refinement, origin: FrameFit) -> None:
        self.fit, self.origin = fit, origin
        self.frames = {
            k: frame for k, frame in enumerate(fit.frames) if not frame.observation.reference
        }
        if not self.frames or origin.observation.reference:
            raise IncompatibleSetupError(
                "detect: expected frames of the target, the first of all included; got a "
                "reference star"
            )
        self.rolls = {
            k: frame.observation.roll_from(origin.observation) for k, frame in self.frames.items()
        }
        self._sources: dict[int, PointSources] = {}
        ny, nx = origin.model.detector.shape
        rows, columns = np.divmod(np.arange(ny * nx), nx)
        detector = origin.model.detector
        x, y = (
            (axis.reshape(-1, detector.oversample).mean(dim=1) / ARCSEC).cpu().numpy()
            for axis in detector.axes(origin.optical_values)
        )
        star = self._star(origin).numpy()
        self.grid = np.stack(
            [x[columns] - star[0], y[rows] + detector.shear * x[columns] - star[1]], axis=-1
        ).reshape(ny, nx, 2)
        """x, y of all the first frame's pixels from the star, (ny, nx, 2), arcsec."""

    @staticmethod
    def _star(frame: FrameFit) -> Tensor:
        return frame.optical_values.get("star_offset", torch.zeros(2, dtype=torch.float64)).cpu()

    def _turned(self, k: int, offsets: Tensor) -> Tensor:
        """Positions in frame k, from the star, of positions in the first frame."""
        angle = math.radians(self.rolls[k])
        turn = torch.tensor(
            [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]],
            dtype=torch.float64,
        )
        return offsets @ turn.T

    def _points(self, k: int) -> PointSources:
        if k not in self._sources:
            frame = self.frames[k]
            self._sources[k] = PointSources(
                frame.model, _as_tensor(frame.opd), frame.optical_values
            )
        return self._sources[k]

    def _aligned(self, k: int) -> bool:
        """Whether planets at the first frame's pixel centres are at pixel centres in frame k."""
        moved = self._axis(self.frames[k]) - self._axis(self.origin)
        return abs(self.rolls[k]) < _ALIGNED and float(moved.abs().max()) < _ALIGNED

    def _axis(self, frame: FrameFit) -> Tensor:
        """Place of the star on the pixels, up to a constant."""
        shift = frame.optical_values.get("detector_shift", torch.zeros(2, dtype=torch.float64))
        return shift.cpu() + self._star(frame)

    def at_pixels(self, rows: NDArray[np.int64], columns: NDArray[np.int64]) -> dict[int, Tensor]:
        """Planets at pixel centres of the first frame.

        Returns
        -------
        dict of int to Tensor, (k, ny, nx), float32
            By the frame's place in the linear model.
        """
        offsets = torch.from_numpy(self.grid[rows, columns])
        images = {}
        for k, frame in self.frames.items():
            # Calls of the model are faster on a coarse pupil.
            if self._aligned(k) and self._points(k).route == "lattice":
                sources = self._points(k).images(rows, columns)
            else:
                sources = self._many(frame, self._turned(k, offsets))
            images[k] = (frame.flux * sources).cpu()
        return images

    def _many(self, frame: FrameFit, offsets: Tensor) -> Tensor:
        model = coarse_copy(frame.model, _MANY_NPIX)
        opd = downsample(_as_tensor(frame.opd).to(model.device), model.npix)
        star = self._star(frame)
        values = {n: v for n, v in frame.optical_values.items() if n != "star_offset"}
        with torch.no_grad():
            parts = [model(opd, star + part, **values).float() for part in offsets.split(8)]
        return torch.cat(parts)

    def at(self, offsets: Tensor, slopes: bool = False) -> dict[int, Tensor]:
        """Planets anywhere, with the model as fine as it was fitted.

        Parameters
        ----------
        offsets : Tensor, (k, 2), float64
            x, y from the star in the first frame, arcsec.
        slopes : bool
            Also the derivatives with respect to x and y.

        Returns
        -------
        dict of int to Tensor, (k, ny, nx), or (3, k, ny, nx) with slopes; float64
        """
        images = {}
        for k, frame in self.frames.items():
            image = partial(self.image, k)
            rows = []
            for offset in offsets:
                with torch.no_grad():
                    rows.append([image(offset)])
                if slopes:
                    rows[-1] += list(jacfwd(image)(offset).movedim(-1, 0))
            stacked = frame.flux * torch.stack([torch.stack(row) for row in rows], dim=1)
            images[k] = (stacked if slopes else stacked[0]).cpu()
        return images

    def image(self, k: int, offset: Tensor, change: Tensor | None = None) -> Tensor:
        """One planet in frame k, as a fraction of the star's light, (ny, nx).

        Parameters
        ----------
        k : int
        offset : Tensor, (2,)
            As for `at`.
        change : Tensor, (npix, npix), optional
            Of the fitted wavefront, m.
        """
        frame = self.frames[k]
        star = self._star(frame) + self._turned(k, offset)
        there = {**frame.optical_values, "star_offset": star}
        opd = _as_tensor(frame.opd)
        return frame.model(opd if change is None else opd + change, **there).double()


def _as_tensor(opd: NDArray[np.float64]) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(opd))
