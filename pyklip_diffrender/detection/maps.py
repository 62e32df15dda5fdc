"""Amplitude and information of a planet at every pixel, with the wavefront integrated out."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from tqdm import tqdm

from pyklip_diffrender.detection.candidates import Candidates
from pyklip_diffrender.detection.templates import Templates
from pyklip_diffrender.linear.model import LinearModel

__all__ = ["Maps"]

Image = NDArray[np.float64]
Group = tuple[LinearModel, Templates]

_BATCH = 320
_KEEP = 1e9
"""Bytes of templates that are kept for the second look; beyond they are made again."""


class Maps:
    """p . Sigma^-1 r, p . Sigma^-1 p and p . p of a planet p at every pixel of the first frame.

    Parameters
    ----------
    groups : sequence of (LinearModel, Templates)
        Independent of each other: their information adds.
    progress : bool
    """

    def __init__(self, groups: Sequence[Group], progress: bool = False) -> None:
        self.groups, self.progress = tuple(groups), progress
        ny, nx = self.groups[0][1].grid.shape[:2]
        self.shape = (ny, nx)
        frames = sum(len(templates.frames) for _, templates in self.groups)
        self._keeps = 4.0 * frames * (ny * nx) ** 2 <= _KEEP
        self._kept: dict[tuple[int, int], dict[int, Tensor]] = {}
        total = np.zeros((3, ny * nx))
        for linear, where, images in self._batches("S/N map"):
            total[:, where] += torch.stack(linear.weigh(images)).numpy()
        self.numerator, self.information, self.photon = total.reshape(3, ny, nx)

    def _batches(self, name: str) -> Iterator[tuple[LinearModel, slice, dict[int, Tensor]]]:
        ny, nx = self.shape
        bar = tqdm(total=ny * nx * len(self.groups), desc=name, disable=not self.progress)
        for g, (linear, templates) in enumerate(self.groups):
            for start in range(0, ny * nx, _BATCH):
                index = np.arange(start, min(start + _BATCH, ny * nx))
                images = self._kept.get((g, start))
                if images is None:
                    images = templates.at_pixels(*np.divmod(index, nx))
                    if self._keeps:
                        self._kept[g, start] = images
                yield linear, slice(start, start + len(index)), images
                bar.update(len(index))
        bar.close()

    def without(self, candidates: Candidates) -> Image:
        """The numerator once point sources are taken out of the data, (ny, nx)."""
        left = self.numerator.copy().reshape(-1)
        if not len(candidates):
            return left.reshape(self.shape)
        cleaned = {
            id(linear): linear.clean(candidates.light(templates))
            for linear, templates in self.groups
        }
        for linear, where, images in self._batches("candidates"):
            for frame, planets in images.items():
                whitened = (linear.frames[frame].weight * cleaned[id(linear)][frame][0]).float()
                left[where] -= torch.tensordot(planets, whitened, dims=2).double().numpy()
        return left.reshape(self.shape)

    def snr(self, numerator: Image | None = None) -> Image:
        """Amplitude over its standard deviation; NaN where there is no information."""
        top = self.numerator if numerator is None else numerator
        safe = np.where(self.information > 0, self.information, np.nan)
        return top / np.sqrt(safe)
