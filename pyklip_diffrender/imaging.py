"""The posterior mean of the sky about a star, from all frames of a fit together.

The frames are taken to be d = P * (H a) + star + noise. The sky a is an image with north up of the
peaks of point sources; H turns and shifts it onto the pixels of every frame, and P is the image of
a point source with its side lobes, which behind a Lyot stop have most of its light. The linear
model of the fit knows the covariance Sigma of the rest: noise, errors of the flat field, which
rolls share, and all that the wavefront, the flux and the alignment of the star may still be. The
prior is a = T u, point sources anywhere: u is white noise of unit variance, and T is such that
a source of one standard deviation has a S/N of `_PRIOR_SOURCE_SNR`. With B = P * H T, the posterior
mean is

    a = T u,    (1 + B^T Sigma^-1 B) u = B^T Sigma^-1 (d - star),

which conjugate gradients solve. Like the components of a CLEAN map, it is shown as a Gaussian beam
would see it, multiplied by the number with which a source in white noise keeps its peak. Sources
behind the mask, whose images differ from P, and those that resemble starlight keep less.

Rolls are weighted by their noise, nothing is interpolated before noise and star are known, and
structure that is fixed on the detector is not taken for sky, because it does not turn with it. The
estimate is linear in the data, so that its covariance and its response to a source have a
closed form. See section 2.7 and chapter 2 of C. E. Rasmussen and C. K. I.
Williams, "Gaussian Processes for Machine Learning" (2006).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import sparse
from scipy.ndimage import gaussian_filter
from torch import Tensor

from pyklip_diffrender.detection.templates import Templates
from pyklip_diffrender.io.units import ARCSEC
from pyklip_diffrender.optics.grid import fft_convolve
from pyklip_diffrender.refinement import Refinement

# Interpolation of an image at many places, as a sparse matrix.

_KERNEL_REACH = 3
"""Pixels to each side that Lanczos' kernel has."""


def interpolation_matrix(places: NDArray[np.float64], shape: tuple[int, int]) -> sparse.csr_matrix:
    """Make the matrix (n, ny * nx) that interpolates an image at places (n, 2) between its pixels.

    The places are x, y in 0-indexed pixels of an image of `shape` (ny, nx), which is zero beyond
    its edges.
    """
    ny, nx = shape
    # Lanczos' kernel over 3 pixels to each side, the product of kernels in x and y.
    steps = np.arange(1 - _KERNEL_REACH, 1 + _KERNEL_REACH)
    first = np.floor(places).astype(np.int64)
    columns, rows = (first[:, k, None] + steps for k in (0, 1))
    across, up = (_lanczos(places[:, k, None] - pixels) for k, pixels in ((0, columns), (1, rows)))
    weights = up[:, :, None] * across[:, None, :]
    inside = ((rows >= 0) & (rows < ny))[:, :, None] & ((columns >= 0) & (columns < nx))[:, None]
    pixels = rows[:, :, None] * nx + columns[:, None]
    point = np.broadcast_to(np.arange(len(places))[:, None, None], weights.shape)
    entries = weights[inside], (point[inside], pixels[inside])
    return sparse.csr_matrix(entries, shape=(len(places), ny * nx))


def _lanczos(distance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Weights of pixels at distances, (n, pixels), with a sum of 1."""
    weights = np.sinc(distance) * np.sinc(distance / _KERNEL_REACH)
    return np.asarray(weights / weights.sum(axis=1, keepdims=True))


Image = NDArray[np.float64]

Light = Mapping[int, Tensor]
"""Images (k, ny, nx) by frame."""

_PRIOR_SOURCE_SNR = 0.8
"""S/N of a source of one standard deviation of the prior. With less, the image is deeper and not as
sharp, in the limit a matched filter's; with more, it is sharper and noisier."""

_BEAM_FWHM_LAMBDA_D = 0.7
"""FWHM of the beam, lambda/D. With what the prior blurs, a point source has 1.3 to 1.4 lambda/D, as
in the frames."""

_SOURCE_REACH_LAMBDA_D = 10.0
"""lambda/D from the middle of a point source's image to where it is cut."""

_SKY_SIDE_RATIO = 1.45
"""Side of the sky over the side of the frames, which turn in it."""

_NOISE_SMOOTHING_PIXELS = 2.0
"""Pixels over which the noise is averaged for the prior."""

_GRADIENT_TOLERANCE = 1e-3
"""Relative residual at which conjugate gradients end."""

_GRADIENT_ITERATIONS = 200

_THROUGHPUT_STEP_PIXELS = 2
"""Pixels between the places at which the throughput is computed."""

_COMB_STEP = 6
"""Places of one comb are this many steps apart, so far that they do not matter to each other."""

_ERROR_PROBES = 24
"""Fields of random signs from which the error is estimated, to 3 to 10 %."""

_FEWEST_PLACES_PER_RING = 4
"""Number of places in a ring below which it takes its neighbours' value."""

_SOLVED_AT_A_TIME = 12
"""Right-hand sides that are solved together."""


class SkyModel:
    """The sky in the frames of a fit."""

    def __init__(self, fit: Refinement) -> None:
        self.templates = Templates(fit)
        first = self.templates.origin
        self.pixelscale = math.sqrt(math.prod(first.observation.pixelscale))
        side = int(_SKY_SIDE_RATIO * max(first.observation.shape)) | 1
        # `shape` is (ny, nx), and `center` the row and column of the star. `grid` (ny, nx, 2) has
        # x, y from the star in arcsec, with y to the north and x to the west if the orientation of
        # the frames is known, else along the axes of the first frame. `pixelscale` and `resolution`
        # (lambda/D) are in arcsec.
        self.shape, self.center = (side, side), side // 2
        y, x = np.indices(self.shape) - self.center
        self.grid = self.pixelscale * np.stack([x, y], axis=-1)
        self._onto_frames = {
            k: interpolation_matrix(
                self.places(frame.grid, frame.observation.position_angle), self.shape
            )
            for k, frame in self.templates.frames.items()
        }
        model = first.model
        self.resolution = float(model.bandpass.mean_wavelength) / model.diameter / ARCSEC
        reach = math.ceil(_SOURCE_REACH_LAMBDA_D * self.resolution / self.pixelscale)
        self._source = self._point_source(reach)
        # In white noise n, a source of peak T has a S/N of T |P| / n, so that T =
        # `_PRIOR_SOURCE_SNR` n / |P|.
        self._prior = _PRIOR_SOURCE_SNR * self._noise() / np.linalg.norm(self._source)
        self._beam, self._response = self._beam_and_response()

    def _point_source(self, reach: int) -> Image:
        """Image of a point source beyond the mask, (k, k) with k odd and a peak of 1."""
        image = self.templates.beyond_mask(min(self.templates.frames)).numpy()
        row, column = (n // 2 for n in image.shape)
        reach = min(reach, *((n - 1) // 2 for n in image.shape))
        cut = image[row - reach : row + reach + 1, column - reach : column + reach + 1]
        return np.asarray(cut / cut.max())

    def _beam_and_response(self) -> tuple[Image, Image]:
        """Transforms of the beam, and of a point source in white noise as it shows it."""
        width = _BEAM_FWHM_LAMBDA_D * self.resolution / self.pixelscale / math.sqrt(8 * math.log(2))
        frequency = np.fft.fftfreq(self.shape[0])
        beam = np.exp(-2 * (math.pi * width) ** 2 * (frequency[:, None] ** 2 + frequency**2))
        source = self._source
        # In white noise B^T Sigma^-1 B is a convolution with the transform s^2 p, where s is the
        # strength of the prior and p the power of P / |P|. The estimate is therefore a filter that
        # keeps s^2 p / (1 + s^2 p) of each frequency. Its value in the middle is the mean over
        # frequencies, by which the beam is divided so that a peak stays 1.
        power = np.abs(np.fft.fft2(source / np.linalg.norm(source), s=self.shape)) ** 2
        kept = _PRIOR_SOURCE_SNR**2 * power / (1 + _PRIOR_SOURCE_SNR**2 * power)
        peak = (beam * kept).mean()
        return np.asarray(beam / peak), np.asarray(beam * kept / peak)

    def places(self, offsets: Image, angle: float) -> Image:
        """Place in the sky, (n, 2), of x, y in arcsec from the star in a frame, (..., 2).

        `angle` is the position angle of the frame's +y axis, degrees.
        """
        x, y = np.moveaxis(offsets, -1, 0).reshape(2, -1)
        sine, cosine = math.sin(math.radians(angle)), math.cos(math.radians(angle))
        turned = np.stack([x * cosine - y * sine, x * sine + y * cosine], axis=-1)
        return turned / self.pixelscale + self.center

    def _noise(self) -> Image:
        """Standard deviation of the mean of the frames in every pixel, smoothed."""
        information = np.zeros(self.shape)
        for k, matrix in self._onto_frames.items():
            weight = self.templates.linear.frames[k].weight.numpy().ravel() ** 2
            information += np.asarray(matrix.T @ weight).reshape(self.shape)
        information = gaussian_filter(np.maximum(information, 0.0), _NOISE_SMOOTHING_PIXELS)
        return np.asarray(np.maximum(information, 1e-6 * information.max()) ** -0.5)

    def light(self) -> Light:
        """Light of the frames beside the star, (1, ny, nx) by frame."""
        frames = self.templates.linear.frames
        return {k: frames[k].residual.double()[None] for k in self.templates.frames}

    def in_frame(self, sky: Image, frame: int) -> Image:
        """A sky on the pixels of a frame, (ny, nx)."""
        image = self._onto_frames[frame] @ sky.ravel()
        return np.asarray(image.reshape(self.templates.linear.frames[frame].residual.shape))

    def _rendered(self, sky: Image) -> Light:
        """P * (H a)."""
        flat = np.ascontiguousarray(sky.reshape(len(sky), -1).T)
        ny, nx = self.templates.linear.frames[0].residual.shape
        return {
            k: torch.from_numpy(fft_convolve((matrix @ flat).T.reshape(-1, ny, nx), self._source))
            for k, matrix in self._onto_frames.items()
        }

    def _collected(self, light: Light) -> Image:
        """The transpose of `_rendered` on Sigma^-1 of images."""
        total: Image | float = 0.0
        linear = self.templates.linear
        cleaned = linear.clean(light)
        for k, matrix in self._onto_frames.items():
            whitened = (linear.frames[k].weight * cleaned[k]).numpy()
            matched = fft_convolve(whitened, self._source[::-1, ::-1])
            total = total + np.asarray(matrix.T @ matched.reshape(len(matched), -1).T)
        return np.asarray(total).T.reshape(-1, *self.shape)

    def _solved(self, right: Image) -> Image:
        """Solve (1 + B^T Sigma^-1 B) u = b for several b, (k, ny, nx), by conjugate gradients."""

        def norm(images: Image) -> Image:
            return np.asarray((images**2).sum(axis=(1, 2)))

        # All systems have the same matrix, and each its own lengths along its directions.
        solution, residual = np.zeros_like(right), right.copy()
        direction, size = right.copy(), norm(right)
        enough = _GRADIENT_TOLERANCE**2 * size
        for _ in range(_GRADIENT_ITERATIONS):
            if (size <= enough).all():
                break
            seen = self._collected(self._rendered(self._prior * direction))
            product = direction + self._prior * seen
            length = size / np.maximum((direction * product).sum(axis=(1, 2)), 1e-300)
            solution += length[:, None, None] * direction
            residual -= length[:, None, None] * product
            previous, size = size, norm(residual)
            direction = residual + (size / np.maximum(previous, 1e-300))[:, None, None] * direction
        return solution

    def estimate(self, light: Light | None = None) -> Image:
        """Posterior mean of the sky, (k, ny, nx), seen with the beam.

        `light` is data minus star, (k, ny, nx) by frame; by default from the fit.
        """
        images = self.light() if light is None else light
        sources = self._prior * self._solved(self._prior * self._collected(images))
        return self._filtered(sources, self._beam)

    def _filtered(self, images: Image, transform: Image) -> Image:
        product = np.fft.rfft2(images) * transform[:, : self.shape[1] // 2 + 1]
        return np.asarray(np.fft.irfft2(product, s=self.shape))

    def of_sources(self, offsets: Image, peaks: Image, angle: float) -> Image:
        """Known point sources as the estimate would show them in white noise, (ny, nx).

        `offsets` (k, 2) are x, y from the star in a frame, arcsec, with the peaks (k,); `angle` is
        the position angle of the frame's +y axis, degrees.
        """
        sources = interpolation_matrix(self.places(offsets, angle), self.shape).T @ peaks
        return self._filtered(sources.reshape(self.shape), self._response)

    def error(self, seed: int = 0) -> Image:
        """Standard deviation of the estimate by the frames' noise, by separation, (ny, nx)."""
        # With A = (1 + B^T Sigma^-1 B)^-1, the covariance of u is A - A^2. The diagonal of the
        # image's covariance, Q, is the expectation of z * (Q z) for random signs z (C. Bekas,
        # E. Kokiopoulou and Y. Saad 2007, Applied Numerical Mathematics 57, 1214).
        covered = sum(matrix.sum(axis=0) for matrix in self._onto_frames.values())
        # The prior is wide where no frame is, so that those places would hide all others.
        inside = np.asarray(covered).reshape(self.shape) > 0.5
        signs = inside * np.random.default_rng(seed).choice(
            [-1.0, 1.0], (_ERROR_PROBES, *self.shape)
        )
        once = self._solved(self._prior * self._filtered(signs, self._beam))
        covariance = self._filtered(self._prior * (once - self._solved(once)), self._beam)
        distance = np.hypot(*np.moveaxis(self.grid, -1, 0)) / self.resolution
        variance = (signs * covariance).mean(axis=0)[inside]
        variance = _by_ring(variance, distance[inside], distance)
        return np.asarray(np.sqrt(np.maximum(variance, 0.0)))

    def throughput(self, seed: int = 0) -> Image:
        """Fraction of the peak of a faint point source that the estimate keeps, by separation.

        It is (ny, nx), for sources at the pixels of the first frame.
        """
        # Sources in combs, with random signs, are measured together. What they change in the star
        # at each other's places averages out over the median of a ring of lambda/D.
        first = self.templates.origin
        ny, nx = first.observation.shape
        rows, columns = (np.arange(0, n, _THROUGHPUT_STEP_PIXELS) for n in (ny, nx))
        y, x = (each.ravel() for each in np.meshgrid(rows, columns, indexing="ij"))
        row, column = (each // _THROUGHPUT_STEP_PIXELS % _COMB_STEP for each in (y, x))
        comb = row * _COMB_STEP + column
        signs = np.random.default_rng(seed).choice([-1.0, 1.0], len(y))
        kept = np.full(len(y), np.nan)
        angle = first.observation.position_angle
        combs = np.unique(comb)
        for start in range(0, len(combs), _SOLVED_AT_A_TIME):
            some = combs[start : start + _SOLVED_AT_A_TIME]
            members = [np.flatnonzero(comb == each) for each in some]
            skies = self.estimate(self._sources(members, y, x, signs))
            for sky, chosen in zip(skies, members, strict=True):
                places = self.places(first.grid[y[chosen], x[chosen]], angle)
                seen = interpolation_matrix(places, self.shape) @ sky.ravel()
                kept[chosen] = signs[chosen] * seen
        distance = np.hypot(*np.moveaxis(first.grid, -1, 0)) / self.resolution
        return _by_ring(kept, distance[y, x], distance)

    def _sources(
        self,
        members: Sequence[NDArray[np.int64]],
        rows: NDArray[np.int64],
        columns: NDArray[np.int64],
        signs: Image,
    ) -> Light:
        """Sums of sources with peaks of 1 or -1 in the first frame."""
        sums: dict[int, list[Tensor]] = {k: [] for k in self.templates.frames}
        for chosen in members:
            images = self.templates.at_pixels(rows[chosen], columns[chosen])
            # Sources behind the mask would otherwise be lost among the others.
            peak = images[min(images)].double().amax(dim=(1, 2))
            weight = torch.from_numpy(signs[chosen]) / peak
            for k, image in images.items():
                sums[k].append(torch.tensordot(weight, image.double(), dims=1))
        return {k: torch.stack(images) for k, images in sums.items()}


def _by_ring(values: Image, at: Image, distance: Image) -> Image:
    """Medians of values in rings of width 1 at the distances `at`, interpolated to others."""
    ring = at.astype(np.int64)
    known = [k for k in np.unique(ring) if (ring == k).sum() >= _FEWEST_PLACES_PER_RING]
    medians = [float(np.median(values[ring == k])) for k in known]
    return np.asarray(np.interp(distance, np.array(known) + 0.5, medians))
