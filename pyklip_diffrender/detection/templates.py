"""What a planet of contrast 1 looks like in the frames of a fit, wherever it is."""

from __future__ import annotations

import math
from collections.abc import Sequence
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
from pyklip_diffrender.refinement import Refinement

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
    fits : sequence of Refinement
        Sharing a linear model. Reference stars show no planets and are left out.
    origin : Refinement
        The first frame, whose pixels and orientation positions refer to.
    """

    def __init__(self, fits: Sequence[Refinement], origin: Refinement) -> None:
        self.fits = [fit for fit in fits if not fit.observation.reference]
        if not self.fits or origin.observation.reference:
            raise IncompatibleSetupError(
                "detect: expected frames of the target, the first of all included; got a "
                "reference star"
            )
        self.origin = origin
        self.rolls = [_roll(fit, origin) for fit in self.fits]
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
    def _star(fit: Refinement) -> Tensor:
        return fit.optical_values.get("star_offset", torch.zeros(2, dtype=torch.float64)).cpu()

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
            fit = self.fits[k]
            self._sources[k] = PointSources(fit.model, _as_tensor(fit.opd), fit.optical_values)
        return self._sources[k]

    def _aligned(self, k: int) -> bool:
        """Whether planets at the first frame's pixel centres are at pixel centres in frame k."""
        moved = self._axis(self.fits[k]) - self._axis(self.origin)
        return abs(self.rolls[k]) < _ALIGNED and float(moved.abs().max()) < _ALIGNED

    def _axis(self, fit: Refinement) -> Tensor:
        """Place of the star on the pixels, up to a constant."""
        shift = fit.optical_values.get("detector_shift", torch.zeros(2, dtype=torch.float64))
        return shift.cpu() + self._star(fit)

    def at_pixels(self, rows: NDArray[np.int64], columns: NDArray[np.int64]) -> dict[int, Tensor]:
        """Planets at pixel centres of the first frame.

        Returns
        -------
        dict of int to Tensor, (k, ny, nx), float32
            By the frame's place in the linear model.
        """
        offsets = torch.from_numpy(self.grid[rows, columns])
        found = {}
        for k, fit in enumerate(self.fits):
            # Calls of the model are faster on a coarse pupil.
            if self._aligned(k) and self._points(k).route == "lattice":
                images = self._points(k).images(rows, columns)
            else:
                images = self._many(fit, self._turned(k, offsets))
            found[fit.frame] = (float(fit.values["flux"][0]) * images).cpu()
        return found

    def _many(self, fit: Refinement, offsets: Tensor) -> Tensor:
        model = coarse_copy(fit.model, _MANY_NPIX)
        opd = downsample(_as_tensor(fit.opd).to(model.device), model.npix)
        star = self._star(fit)
        values = {n: v for n, v in fit.optical_values.items() if n != "star_offset"}
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
        found = {}
        for k, fit in enumerate(self.fits):
            image = partial(self.image, k)
            rows = []
            for offset in offsets:
                with torch.no_grad():
                    rows.append([image(offset)])
                if slopes:
                    rows[-1] += list(jacfwd(image)(offset).movedim(-1, 0))
            stacked = float(fit.values["flux"][0]) * torch.stack(
                [torch.stack(row) for row in rows], dim=1
            )
            found[fit.frame] = (stacked if slopes else stacked[0]).cpu()
        return found

    def image(self, k: int, offset: Tensor, change: Tensor | None = None) -> Tensor:
        """One planet in the frame of `fits[k]`, as a fraction of the star's light, (ny, nx).

        Parameters
        ----------
        k : int
        offset : Tensor, (2,)
            As for `at`.
        change : Tensor, (npix, npix), optional
            Of the wavefront that was found, m.
        """
        fit = self.fits[k]
        there = {**fit.optical_values, "star_offset": self._star(fit) + self._turned(k, offset)}
        opd = _as_tensor(fit.opd)
        return fit.model(opd if change is None else opd + change, **there).double()


def _roll(fit: Refinement, origin: Refinement) -> float:
    """Degrees by which the sky in a frame is turned, counter-clockwise, from the first one."""
    here, there = fit.observation.position_angles, origin.observation.position_angles
    return 0.0 if here is None or there is None else -float(here[0] - there[0])


def _as_tensor(opd: NDArray[np.float64]) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(opd))
