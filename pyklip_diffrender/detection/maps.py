"""Amplitude and information of a planet at every pixel, with the star marginalised."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from pyklip_diffrender.detection.candidates import Candidates
from pyklip_diffrender.detection.field import Image
from pyklip_diffrender.detection.groups import Group
from pyklip_diffrender.io.progress import ProgressBar

__all__ = ["Maps"]

_BATCH = 320
"""Number of templates that are rendered at a time."""

_STORE = 1e9
"""Largest number of bytes of templates that are stored; otherwise they are rendered again."""

_REACH = 5
"""Largest distance at which the autocorrelation of the S/N is computed, pixels."""

_PLACES = 4
"""Number of rows, and of columns, of places at which it is computed."""


class Maps:
    """Inner products with a planet p at every pixel of the first frame.

    Parameters
    ----------
    groups : sequence of (LinearModel, Templates)
    progress : bool
        Show progress bars.

    Attributes
    ----------
    numerator, information, photon : ndarray, (ny, nx)
        p . Sigma^-1 r, p . Sigma^-1 p and p . p, see `linear.model.TemplateProducts`.
    starlight : ndarray, (ny, nx)
        Star over noise, averaged over the pixels with the squared S/N that a planet has in each.
    """

    def __init__(self, groups: Sequence[Group], progress: bool = False) -> None:
        self.groups, self.progress = tuple(groups), progress
        self.grid = self.groups[0][1].grid
        ny, nx = self.shape = self.grid.shape[:2]
        frames = sum(len(templates.frames) for _, templates in self.groups)
        self._stores = 4.0 * frames * (ny * nx) ** 2 <= min(_STORE, self._spare())
        self._stored: dict[tuple[int, int], dict[int, Tensor]] = {}
        total, light = np.zeros((3, ny * nx)), np.zeros((2, ny * nx))
        steps = np.linspace(0, 1, _PLACES + 2)[1:-1]
        rows, columns = np.meshgrid((ny * steps).astype(int), (nx * steps).astype(int))
        self._places = rows.ravel(), columns.ravel()
        cleaned = self._cleaned(
            [templates.at_pixels(*self._places) for _, templates in self.groups]
        )
        between = np.zeros((len(rows.ravel()), ny * nx))
        for g, pixels, images in self._batches("S/N map"):
            total[:, pixels] += torch.stack(self.groups[g][0].weigh(images)).numpy()
            light[:, pixels] += self._starlight(g, images)
            between[:, pixels] += _products(cleaned[g], images)
        self._between = between.reshape(-1, ny, nx)
        self.numerator, self.information, self.photon = total.reshape(3, ny, nx)
        with np.errstate(invalid="ignore"):
            self.starlight = (light[0] / light[1]).reshape(ny, nx)

    def _starlight(self, g: int, images: Mapping[int, Tensor]) -> Image:
        """Squared S/N of planets, with and without the star over noise of each pixel, (2, k)."""
        linear, templates = self.groups[g]
        total = np.zeros((2, len(next(iter(images.values())))))
        for k, planets in images.items():
            fitted, weight = templates.frames[k], linear.frames[k].weight
            star = torch.from_numpy(fitted.star - fitted.values["background"][0])
            squares = weight.square()
            columns = torch.stack([squares * weight * star, squares]).flatten(1).to(planets.dtype)
            total += (columns @ planets.flatten(1).square().T).double().numpy()
        return total

    @cached_property
    def correlation(self) -> Image:
        """Autocorrelation of the S/N of noise, by distance in pixels, mean over the field."""
        side = 2 * _REACH + 1
        total, count = np.zeros((2, side, side))
        # Behind the mask the information is 0, and by rounding may be below it.
        information = np.pad(np.maximum(self.information, 0.0), _REACH)
        for row, column, products in zip(*self._places, self._between, strict=True):
            window = np.s_[row : row + side, column : column + side]
            size = np.sqrt(information[window] * self.information[row, column].clip(0.0))
            total += np.divide(
                np.pad(products, _REACH)[window], size, out=np.zeros_like(size), where=size > 0
            )
            count += size > 0
        return np.divide(total, count, out=np.zeros_like(total), where=count > 0)

    def _spare(self) -> float:
        """Bytes that the settings of the fits leave beside the linear models."""
        models = sum(
            4.0 * frame.jacobian.numel() for linear, _ in self.groups for frame in linear.frames
        )
        return min(each.fit.settings.memory_beside(models) for _, each in self.groups)

    def _batches(self, name: str) -> Iterator[tuple[int, slice, dict[int, Tensor]]]:
        """Index of the group, flat indices of pixels, and their templates by frame."""
        ny, nx = self.shape
        pixels = ny * nx * len(self.groups)
        with ProgressBar(name, pixels, shown=self.progress) as progress_bar:
            for g, (_, templates) in enumerate(self.groups):
                for start in range(0, ny * nx, _BATCH):
                    index = np.arange(start, min(start + _BATCH, ny * nx))
                    images = self._stored.get((g, start))
                    if images is None:
                        images = templates.at_pixels(*np.divmod(index, nx))
                        if self._stores:
                            self._stored[g, start] = images
                    yield g, slice(start, start + len(index)), images
                    progress_bar.update(len(index))

    def without(self, candidates: Candidates) -> Image:
        """The numerator after candidates are removed from the data, (ny, nx)."""
        if not len(candidates):
            return self.numerator
        light = [candidates.light(templates) for _, templates in self.groups]
        return np.asarray(self.numerator - self.change(light)[0])

    def response(self, offsets: Tensor) -> Image:
        """Change of the numerator by a planet of contrast 1 at each position, (k, ny, nx).

        Parameters
        ----------
        offsets : Tensor, (k, 2), float64
            x, y from the star, arcsec.
        """
        return self.change([templates.at(offsets) for _, templates in self.groups])

    def change(self, light: Sequence[Mapping[int, Tensor]]) -> Image:
        """Change of the numerator by images that are added to the data, (k, ny, nx).

        Parameters
        ----------
        light : sequence of mapping of int to Tensor, (k, ny, nx)
            Images by frame, for each group.
        """
        cleaned = self._cleaned(light)
        ny, nx = self.shape
        total = np.zeros((len(cleaned[0][0]), ny * nx))
        for g, pixels, images in self._batches("candidates"):
            total[:, pixels] += _products(cleaned[g], images)
        return total.reshape(-1, ny, nx)

    def _cleaned(self, light: Sequence[Mapping[int, Tensor]]) -> list[dict[int, Tensor]]:
        """C^-1 of the parts of images that the unknowns cannot reproduce, by group and frame."""
        return [
            {k: linear.frames[k].weight * image for k, image in linear.clean(part).items()}
            for (linear, _), part in zip(self.groups, light, strict=True)
        ]

    def snr(self, numerator: Image | None = None) -> Image:
        """Amplitude over its standard deviation; NaN where there is no information."""
        information = np.where(self.information > 0, self.information, np.nan)
        return (self.numerator if numerator is None else numerator) / np.sqrt(information)


def _products(cleaned: Mapping[int, Tensor], planets: Mapping[int, Tensor]) -> Image:
    """Inner products of images with planets, summed over the frames, (images, planets)."""
    total = torch.tensor(0.0, dtype=torch.float64)
    for k, images in planets.items():
        total = total + (cleaned[k].float().flatten(1) @ images.flatten(1).T).double()
    return np.asarray(total.numpy())
