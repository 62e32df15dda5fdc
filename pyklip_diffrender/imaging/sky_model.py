"""The posterior mean of the sky about a star, from all frames of a fit together.

The frames are taken to be d = H s + star + noise. The sky s is an image with north up; H turns and
shifts it onto the pixels of every frame. The linear model of the fit knows the covariance Sigma of
the rest: noise, errors of the flat field, which rolls share, and all that the wavefront, the flux
and the alignment of the star may still be. The prior of the sky is s = T g * u, point sources
anywhere: u is white noise of unit variance, g the core of a point source with sum(g^2) = 1, and T
a constant times the noise of the frames at each pixel. With B = H T g, the posterior mean is

    s = T g * u,    (1 + B^T Sigma^-1 B) u = B^T Sigma^-1 (d - star),

which conjugate gradients solve. Rolls are weighted by their noise, nothing is interpolated before
noise and star are known, and structure that is fixed on the detector is not taken for sky, because
it does not turn with it. The estimate is linear in the data, and its covariance and its response to
a source are those of a linear filter, in closed form. See section 2.7 and chapter 2 of C. E.
Rasmussen and C. K. I. Williams, "Gaussian Processes for Machine Learning" (2006).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from torch import Tensor

from pyklip_diffrender.detection.groups import groups_of
from pyklip_diffrender.imaging.interpolation import interpolation_matrix
from pyklip_diffrender.io.units import ARCSEC
from pyklip_diffrender.refinement import Refinement

__all__ = ["SkyModel"]

Image = NDArray[np.float64]

Light = Sequence[Mapping[int, Tensor]]
"""Images (k, ny, nx) by frame, for every fit."""

_STRENGTH = 2.0
"""Standard deviation of the prior over the noise. Sources much fainter than the noise are
averaged over their image, brighter ones are left as sharp as they are."""

_MARGIN = 1.45
"""Side of the sky over that of the frames, which turn in it."""

_SMOOTH = 2.0
"""Pixels over which the noise is averaged for the prior."""

_TOLERANCE = 1e-3
"""Relative residual at which conjugate gradients end."""

_ITERATIONS = 200

_STEP = 2
"""Pixels between the places at which the throughput is computed."""

_APART = 6
"""Places of one comb are this many steps apart, so far that they do not matter to each other."""

_FEW = 4
"""Number of places in a ring below which its throughput is that of its neighbours."""

_BATCH = 12
"""Right-hand sides that are solved together."""


class SkyModel:
    """The sky in the frames of fits of one target.

    Parameters
    ----------
    fits : sequence of Refinement

    Attributes
    ----------
    shape : tuple of int
        (ny, nx) of the sky.
    center : int
        Row and column of the star in it.
    pixelscale, resolution : float
        Side of a pixel and lambda/D, arcsec.
    grid : ndarray, (ny, nx, 2)
        x, y of the sky's pixels from the star, arcsec; y to the north and x to the west if the
        orientation of the frames is known, else along the axes of the first frame.
    """

    def __init__(self, fits: Sequence[Refinement]) -> None:
        self.groups = groups_of(fits)
        first = fits[0].frames[0]
        self.pixelscale = math.sqrt(math.prod(first.observation.pixelscale))
        side = int(_MARGIN * max(first.observation.shape)) | 1
        self.shape, self.center = (side, side), side // 2
        y, x = np.indices(self.shape) - self.center
        self.grid = self.pixelscale * np.stack([x, y], axis=-1)
        self._onto_frames = [
            {
                k: interpolation_matrix(self.places(frame.grid, frame.observation.position_angle),
                                        self.shape)
                for k, frame in templates.frames.items()
            }
            for _, templates in self.groups
        ]  # fmt: skip
        model = first.model
        self.resolution = float(model.bandpass.mean_wavelength) / model.diameter / ARCSEC
        # The FWHM of a point source is lambda/D.
        width = self.resolution / self.pixelscale / math.sqrt(8 * math.log(2))
        frequency = np.fft.fftfreq(side)[:, None] ** 2 + np.fft.rfftfreq(side) ** 2
        core = np.exp(-2 * (math.pi * width) ** 2 * frequency)
        self._core = core / np.linalg.norm(np.fft.irfft2(core, s=self.shape))
        self._prior = _STRENGTH * self._noise()

    def places(self, offsets: Image, angle: float) -> Image:
        """Place in the sky, (n, 2), of x, y in arcsec from the star in a frame.

        Parameters
        ----------
        offsets : ndarray, (..., 2)
        angle : float
            Position angle of the frame's +y axis, degrees.
        """
        x, y = np.moveaxis(offsets, -1, 0).reshape(2, -1)
        sine, cosine = math.sin(math.radians(angle)), math.cos(math.radians(angle))
        turned = np.stack([x * cosine - y * sine, x * sine + y * cosine], axis=-1)
        return turned / self.pixelscale + self.center

    def _noise(self) -> Image:
        """Standard deviation of the mean of the frames in every pixel, smoothed."""
        information = np.zeros(self.shape)
        for (linear, _), matrices in zip(self.groups, self._onto_frames, strict=True):
            for k, matrix in matrices.items():
                weight = linear.frames[k].weight.numpy().ravel() ** 2
                information += np.asarray(matrix.T @ weight).reshape(self.shape)
        information = gaussian_filter(np.maximum(information, 0.0), _SMOOTH)
        return np.asarray(np.maximum(information, 1e-6 * information.max()) ** -0.5)

    def light(self) -> Light:
        """Light of the frames beside the star, (1, ny, nx) by frame."""
        return [
            {k: linear.frames[k].residual.double()[None] for k in templates.frames}
            for linear, templates in self.groups
        ]

    def in_frame(self, sky: Image, group: int, frame: int) -> Image:
        """A sky on the pixels of a frame, (ny, nx)."""
        linear, _ = self.groups[group]
        image = self._onto_frames[group][frame] @ sky.ravel()
        return np.asarray(image.reshape(linear.frames[frame].residual.shape))

    def _blurred(self, images: Image) -> Image:
        return np.asarray(np.fft.irfft2(np.fft.rfft2(images) * self._core, s=self.shape))

    def _sky(self, white: Image) -> Image:
        """T g * u."""
        return np.asarray(self._prior * self._blurred(white))

    def _white(self, sky: Image) -> Image:
        """The transpose of `_sky`."""
        return self._blurred(self._prior * sky)

    def _rendered(self, sky: Image) -> Light:
        """H s."""
        flat = np.ascontiguousarray(sky.reshape(len(sky), -1).T)
        images = []
        for (linear, _), matrices in zip(self.groups, self._onto_frames, strict=True):
            ny, nx = linear.frames[0].residual.shape
            images.append(
                {
                    k: torch.from_numpy(np.ascontiguousarray((m @ flat).T)).reshape(-1, ny, nx)
                    for k, m in matrices.items()
                }
            )
        return images

    def _collected(self, light: Light) -> Image:
        """H^T Sigma^-1 of images."""
        total: Image | float = 0.0
        for g, (linear, _) in enumerate(self.groups):
            cleaned = linear.clean(light[g])
            for k, matrix in self._onto_frames[g].items():
                whitened = (linear.frames[k].weight * cleaned[k]).flatten(1).numpy()
                total = total + np.asarray(matrix.T @ whitened.T)
        return np.asarray(total).T.reshape(-1, *self.shape)

    def _solved(self, right: Image) -> Image:
        """Solve (1 + B^T Sigma^-1 B) u = b for several b, (k, ny, nx), by conjugate gradients."""

        def norm(images: Image) -> Image:
            return np.asarray((images**2).sum(axis=(1, 2)))

        solution, residual = np.zeros_like(right), right.copy()
        direction, size = right.copy(), norm(right)
        enough = _TOLERANCE**2 * size
        for _ in range(_ITERATIONS):
            if (size <= enough).all():
                break
            product = direction + self._white(self._collected(self._rendered(self._sky(direction))))
            length = size / np.maximum((direction * product).sum(axis=(1, 2)), 1e-300)
            solution += length[:, None, None] * direction
            residual -= length[:, None, None] * product
            previous, size = size, norm(residual)
            direction = residual + (size / np.maximum(previous, 1e-300))[:, None, None] * direction
        return solution

    def estimate(self, light: Light | None = None) -> Image:
        """Posterior mean of the sky.

        Parameters
        ----------
        light : sequence of dict of int to Tensor, (k, ny, nx), optional
            Data minus star by frame for every fit; those of the fits by default.

        Returns
        -------
        ndarray, (k, ny, nx)
        """
        images = self.light() if light is None else light
        return self._sky(self._solved(self._white(self._collected(images))))

    def throughput(self, seed: int = 0) -> Image:
        """Fraction of the peak of a faint point source that the estimate keeps, by separation.

        Sources in combs, with random signs, are measured together. What they change in the star
        at each other's places averages out over the median of a ring of lambda/D.

        Parameters
        ----------
        seed : int
            Of the signs.

        Returns
        -------
        ndarray, (ny, nx)
            For sources at the pixels of the first frame.
        """
        first = self.groups[0][1].origin
        ny, nx = first.observation.shape
        rows, columns = (np.arange(0, n, _STEP) for n in (ny, nx))
        y, x = (each.ravel() for each in np.meshgrid(rows, columns, indexing="ij"))
        comb = (y // _STEP % _APART) * _APART + x // _STEP % _APART
        signs = np.random.default_rng(seed).choice([-1.0, 1.0], len(y))
        kept = np.full(len(y), np.nan)
        angle = first.observation.position_angle
        for some in _batches(np.unique(comb)):
            members = [np.flatnonzero(comb == each) for each in some]
            light, peaks = self._sources(members, y, x, signs)
            skies = self.estimate(light)
            for sky, chosen, peak in zip(skies, members, peaks, strict=True):
                places = self.places(first.grid[y[chosen], x[chosen]], angle)
                seen = interpolation_matrix(places, self.shape) @ sky.ravel()
                kept[chosen] = signs[chosen] * seen / peak
        distance = np.hypot(*np.moveaxis(first.grid, -1, 0)) / self.resolution
        ring = distance[y, x].astype(np.int64)
        known = [k for k in np.unique(ring) if (ring == k).sum() >= _FEW]
        medians = [float(np.median(kept[ring == k])) for k in known]
        return np.asarray(np.interp(distance, np.array(known) + 0.5, medians))

    def _sources(
        self,
        members: Sequence[NDArray[np.int64]],
        rows: NDArray[np.int64],
        columns: NDArray[np.int64],
        signs: Image,
    ) -> tuple[list[dict[int, Tensor]], list[Image]]:
        """Sums of sources as bright as the star, and the peak of each in the first frame."""
        light: list[dict[int, Tensor]] = []
        peaks: list[Image] = []
        for g, (_, templates) in enumerate(self.groups):
            sums: dict[int, list[Tensor]] = {k: [] for k in templates.frames}
            for chosen in members:
                images = templates.at_pixels(rows[chosen], columns[chosen])
                sign = torch.from_numpy(signs[chosen])
                for k, each in images.items():
                    sums[k].append(torch.tensordot(sign, each.double(), dims=1))
                if g == 0:
                    seen = images[min(images)].double().numpy()
                    peaks.append(seen[np.arange(len(chosen)), rows[chosen], columns[chosen]])
            light.append({k: torch.stack(each) for k, each in sums.items()})
        return light, peaks


def _batches(items: NDArray[np.int64]) -> Iterator[NDArray[np.int64]]:
    """Split items into parts that are solved together."""
    for start in range(0, len(items), _BATCH):
        yield items[start : start + _BATCH]
