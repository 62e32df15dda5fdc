"""The covariance of the noise of frames that are fitted together, and its inverse.

The noise of a frame f has three parts, with the starlight s_f and pixels p and q:

1. Noise of the frame and errors of the model that are independent from pixel to pixel. Its
   standard deviation is 1 / w_f.
2. The error of the flat-field pattern, where frames show the same pixels of the detector. A pattern
   m_p with a Gaussian prior of width g_p multiplies the starlight of every frame:
   g_p^2 s_fp s_f'p in pixel p.
3. A relative error of the model that neighbouring pixels share, (kappa s_fp) (kappa s_f'q) K(p - q)
   with K(d) = exp(-d^2 / 2 l^2). A part of it is common to frames of the same pixels, with
   kappa_shared, and each frame has another, with kappa_own.

Without the third part, the covariance of one pixel in all frames is diag(1 / w_f^2) + g^2 s s^T.
Its inverse is diagonal but for one term (the Sherman-Morrison formula),

    C^-1 = W - W c c^T W,    c_f = s_f g / sqrt(1 + g^2 sum_f w_f^2 s_f^2),    W = diag(w_f^2),

so that every inner product loses the product of two images that are summed over frames with the
weights W c. A `Noise` knows the pattern by its c.

With the third part, images are divided by their own noise first. C = w^-1 M w^-1 with

    M = 1 + t t^T / (1 - t^T t) + D (kappa_shared^2 + kappa_own^2 delta_ff') K D',

where t = w c, for t t^T / (1 - t^T t) = g^2 (w s) (w s)^T, and D = diag(w s). K falls to 4e-6
within five pixels, so that M is block tridiagonal in strips of five rows, which `StripFactor`
solves exactly. Frames that do not show the same pixels share nothing and have a factor each.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.linear.frames import LinearFrame, pixel_pieces
from pyklip_diffrender.linear.strips import StripFactor

__all__ = [
    "UNCORRELATED",
    "CorrelatedError",
    "Noise",
    "curvature_of",
    "summed_rows",
    "weighted_rows",
]

_LENGTH = 1.0
"""Pixels over which the relative error of the model is correlated, l."""

_STRIP = 5
"""Rows of a strip, and pixels beyond which errors are not correlated."""

_ROWS = 64
"""Number of unknowns whose derivatives are whitened at a time."""


@dataclass(frozen=True)
class CorrelatedError:
    """Size of the relative error of the model that neighbouring pixels share.

    Attributes
    ----------
    shared : float
        Standard deviation of the part that is common to frames of the same detector pixels, as a
        fraction of the starlight in a pixel.
    own : float
        Standard deviation of the part that differs between frames.

    Raises
    ------
    IncompatibleSetupError
        For a value that is not a number from 0 to 1.
    """

    shared: float = 0.0
    own: float = 0.0

    def __post_init__(self) -> None:
        for name in ("shared", "own"):
            value = getattr(self, name)
            if not 0 <= value <= 1:
                raise IncompatibleSetupError(
                    f"correlated error: got {name}={value}, expected a fraction of the starlight, "
                    "such as 0.014"
                )

    def __bool__(self) -> bool:
        return self.shared > 0 or self.own > 0

    @property
    def total(self) -> float:
        """Standard deviation in one frame, as a fraction of the starlight."""
        return float((self.shared**2 + self.own**2) ** 0.5)


UNCORRELATED = CorrelatedError()
"""No correlated error."""


@dataclass(frozen=True, eq=False)
class Noise:
    """Noise of the pixels of frames that are fitted together, with covariance C.

    Attributes
    ----------
    weight : tuple of Tensor, (ny, nx)
        By frame, w: 1 / standard deviation of the independent noise; 0 for masked pixels.
    common : tuple of Tensor, (ny, nx)
        c of the pattern that the frames share, in the data's unit; 0 if they share none.
    light : tuple of Tensor, (ny, nx)
        Starlight, in the data's unit.
    correlated : CorrelatedError
        Size of the correlated error; the starlight is not needed if it is zero.

    Examples
    --------
    >>> import torch
    >>> from pyklip_diffrender.linear.noise import CorrelatedError, Noise
    >>> ones = torch.ones(8, 8, dtype=torch.float64)
    >>> error = CorrelatedError(shared=0.01)
    >>> noise = Noise((ones,), (0 * ones,), (200 * ones,), error)
    >>> noise.chi2([ones]) < Noise((ones,), (0 * ones,), (200 * ones,)).chi2([ones])
    tensor(True)
    """

    weight: tuple[Tensor, ...]
    common: tuple[Tensor, ...]
    light: tuple[Tensor, ...]
    correlated: CorrelatedError = UNCORRELATED

    def to_cpu(self) -> Noise:
        """Return this noise with all arrays on the CPU."""
        weight, common, light = (
            tuple(each.cpu() for each in part) for part in (self.weight, self.common, self.light)
        )
        return Noise(weight, common, light, self.correlated)

    @cached_property
    def shares_pattern(self) -> bool:
        """Whether the frames share a pattern of the detector."""
        return any(bool((each != 0).any()) for each in self.common)

    @cached_property
    def _pattern_power(self) -> Tensor:
        """t^T t of every pixel, (ny, nx)."""
        products = [(w * c) ** 2 for w, c in zip(self.weight, self.common, strict=True)]
        return torch.stack(products).sum(dim=0)

    @cached_property
    def _factors(self) -> tuple[tuple[tuple[int, ...], StripFactor], ...]:
        """Frames whose noise is correlated, and the factor of their M."""
        every = tuple(range(len(self.weight)))
        groups = [every] if self.shares_pattern else [(k,) for k in every]
        return tuple((group, self._factor(group)) for group in groups)

    def _factor(self, frames: tuple[int, ...]) -> StripFactor:
        ny, nx = self.weight[0].shape
        scaled = torch.stack([(self.weight[k] * self.light[k]).cpu() for k in frames])
        pattern = torch.stack([(self.weight[k] * self.common[k]).cpu() for k in frames])
        # t t^T / (1 - t^T t) is the pattern's part of M.
        pattern = pattern / torch.sqrt(1 - (pattern**2).sum(dim=0))
        count = len(frames)
        between = torch.full((count, count), self.correlated.shared**2, dtype=torch.float64)
        between.diagonal().add_(self.correlated.own**2)
        columns = _kernel(torch.arange(nx), torch.arange(nx))
        rows = torch.arange(ny).split(_STRIP)

        def block(a: int, b: int) -> Tensor:
            spatial = torch.kron(_kernel(rows[a], rows[b]), columns)
            d, e = scaled[:, rows[a]].flatten(1), scaled[:, rows[b]].flatten(1)
            blocks = between[:, None, :, None] * d[:, :, None, None] * e[None, None]
            blocks = blocks * spatial[None, :, None, :]
            if a == b:
                t = pattern[:, rows[a]].flatten(1)
                same = t[:, None] * t[None] + torch.eye(count, dtype=torch.float64)[:, :, None]
                blocks.diagonal(dim1=1, dim2=3).add_(same)
            return blocks.reshape(d.numel(), e.numel())

        places = torch.arange(count * ny * nx).reshape(count, ny, nx)
        return StripFactor(block, [places[:, each].flatten() for each in rows])

    def _summed(self, images: Mapping[int, Tensor]) -> Tensor:
        """Sum of W c x over frames, for images x, (..., ny, nx)."""
        total = torch.zeros_like(next(iter(images.values())))
        for k, image in images.items():
            total += self.weight[k] ** 2 * self.common[k] * image
        return total

    def inverse(self, images: Mapping[int, Tensor]) -> dict[int, Tensor]:
        """C^-1 x over w of images x, (..., ny, nx), by frame; 0 in masked pixels.

        Frames that are missing have no light. Without correlations between frames they are missing
        in the result as well.
        """
        if self.correlated:
            return self._by_factor(images, StripFactor.solve)
        if not self.shares_pattern:
            return {k: self.weight[k].to(x.dtype) * x for k, x in images.items()}
        images = {k: x.double() for k, x in images.items()}
        summed = self._summed(images)
        return {
            k: weight * (images.get(k, torch.zeros(())) - common * summed)
            for k, (weight, common) in enumerate(zip(self.weight, self.common, strict=True))
        }

    def weighted(self, images: Mapping[int, Tensor]) -> dict[int, Tensor]:
        """C^-1 x of images x, as `inverse`."""
        if self.correlated or self.shares_pattern:
            inverse = self.inverse(images)
            return {k: self.weight[k].to(x.dtype) * x for k, x in inverse.items()}
        return {k: (self.weight[k] ** 2).to(x.dtype) * x for k, x in images.items()}

    def whitened(self, images: Mapping[int, Tensor]) -> Tensor:
        """Images in units in which their noise is independent and has a variance of 1.

        Scalar products of the results, (k, pixels of frames), are x^T C^-1 y of the images x and y,
        (k, ny, nx) by frame.
        """
        if self.correlated:
            white = self._by_factor(images, StripFactor.whiten)
        elif not self.shares_pattern:
            white = self.inverse(images)
        else:
            # (1 - a t t^T)^2 = 1 - t t^T = M^-1 with a = 1 / (1 + sqrt(1 - t^T t)).
            summed = self._summed({k: x.double() for k, x in images.items()})
            part = summed / (1 + torch.sqrt(1 - self._pattern_power))
            white = {
                k: weight * (images.get(k, torch.zeros(())) - common * part)
                for k, (weight, common) in enumerate(zip(self.weight, self.common, strict=True))
            }
        return torch.cat([each.flatten(1) for each in white.values()], dim=1)

    def chi2(self, images: Sequence[Tensor]) -> float:
        """x^T C^-1 x of images x, (ny, nx), of all frames."""
        by_frame = dict(enumerate(images))
        if self.correlated:
            return float((self.whitened({k: x[None] for k, x in by_frame.items()}) ** 2).sum())
        total = sum(float(((self.weight[k] * x) ** 2).sum()) for k, x in by_frame.items())
        return total - float((self._summed(by_frame) ** 2).sum()) if self.shares_pattern else total

    def precision(self, frame: int, window: tuple[slice, slice]) -> Tensor:
        """The block of M^-1 of a window of pixels of a frame, (pixels, pixels)."""
        weight, common = self.weight[frame][window], self.common[frame][window]
        if not self.correlated:
            return torch.diag((1 - (weight * common) ** 2).flatten())
        ny, nx = self.weight[frame].shape
        places = torch.arange(ny * nx).reshape(ny, nx)[window].flatten()
        single = torch.zeros(len(places), ny * nx, dtype=torch.float64)
        single[torch.arange(len(places)), places] = 1.0
        frames, factor = next(each for each in self._factors if frame in each[0])
        stacked = torch.zeros(len(places), len(frames), ny * nx, dtype=torch.float64)
        stacked[:, frames.index(frame)] = single
        solved = factor.solve(stacked.flatten(1)).reshape(stacked.shape)
        return solved[:, frames.index(frame)][:, places]

    @cached_property
    def log_determinant(self) -> float:
        """Logarithm of the determinant of M."""
        if self.correlated:
            return sum(factor.log_determinant for _, factor in self._factors)
        return -float(torch.log1p(-self._pattern_power).sum())

    def _by_factor(
        self, images: Mapping[int, Tensor], operation: Callable[[StripFactor, Tensor], Tensor]
    ) -> dict[int, Tensor]:
        """Apply an operation to images over their own noise, all frames of a factor together."""
        example = next(iter(images.values()))
        shape, device = example.shape, example.device
        result = {}
        for frames, factor in self._factors:
            if not any(k in images for k in frames):
                continue
            parts = [
                (self.weight[k].to(example.dtype) * images[k]).cpu()
                if k in images
                else torch.zeros(shape, dtype=example.dtype)
                for k in frames
            ]
            stacked = torch.stack([each.reshape(-1, *shape[-2:]) for each in parts], dim=1)
            done = operation(factor, stacked.flatten(1)).reshape(stacked.shape)
            for place, k in enumerate(frames):
                result[k] = done[:, place].reshape(shape).to(device)
        return result


def summed_rows(frames: Sequence[LinearFrame], unknowns: int) -> Tensor:
    """W c summed over frames with the derivative by every unknown, (unknowns, pixels), float32."""
    total = torch.zeros(unknowns, frames[0].weight.numel(), dtype=torch.float32)
    for frame in frames:
        scale = (torch.ones(()) * (frame.weight**2 * frame.common).float()).flatten()
        for pixels in pixel_pieces(total.shape[1]):
            on_rows = frame.jacobian.flatten(1)[:, pixels] * scale[pixels]
            total[:, pixels] += frame.onto_unknowns(on_rows, unknowns)
    return total


def weighted_rows(frames: Sequence[LinearFrame], noise: Noise, unknowns: int) -> tuple[Tensor, ...]:
    """J C^-1 over w of every frame, with the derivatives J, (unknowns, pixels), float32."""
    rows = _rows_by_unknown(frames, unknowns)
    total = tuple(torch.empty_like(each.flatten(1)) for each in rows.values())
    for start in range(0, unknowns, _ROWS):
        some = slice(start, start + _ROWS)
        inverse = noise.inverse({k: each[some].double() for k, each in rows.items()})
        for k, each in inverse.items():
            total[k][some] = each.flatten(1)
    return total


def curvature_of(frames: Sequence[LinearFrame], noise: Noise, unknowns: int) -> Tensor:
    """J C^-1 J^T with the derivatives J by all unknowns, (unknowns, unknowns), float64."""
    rows = _rows_by_unknown(frames, unknowns)
    parts = []
    for start in range(0, unknowns, _ROWS):
        some = slice(start, start + _ROWS)
        parts.append(noise.whitened({k: each[some].double() for k, each in rows.items()}))
    white = torch.cat(parts)
    return white @ white.T


def _rows_by_unknown(frames: Sequence[LinearFrame], unknowns: int) -> dict[int, Tensor]:
    """Derivatives of the pixels by all unknowns, (unknowns, ny, nx) by frame."""
    return {k: frame.onto_unknowns(frame.jacobian, unknowns) for k, frame in enumerate(frames)}


def _kernel(a: Tensor, b: Tensor) -> Tensor:
    """Correlation between places of pixels along one axis, (len(a), len(b)), float64."""
    distance = (a[:, None] - b).double()
    kernel = torch.exp(-(distance**2) / (2 * _LENGTH**2))
    return torch.where(distance.abs() <= _STRIP, kernel, 0.0)
