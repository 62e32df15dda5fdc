"""The covariance of the noise of frames that are fitted together, and its inverse.

The noise of a frame f has two parts, with the starlight s_f and pixels p:

1. Noise of the frame and errors of the model that are independent from pixel to pixel. Its
   standard deviation is 1 / w_f.
2. The error of the flat-field pattern, where frames show the same pixels of the detector. A pattern
   m_p with a Gaussian prior of width g_p multiplies the starlight of every frame:
   g_p^2 s_fp s_f'p in pixel p.

The covariance of one pixel in all frames is diag(1 / w_f^2) + g^2 s s^T. Its inverse is diagonal
but for one term (the Sherman-Morrison formula),

    C^-1 = W - W c c^T W,    c_f = s_f g / sqrt(1 + g^2 sum_f w_f^2 s_f^2),    W = diag(w_f^2),

so that every inner product loses the product of two images that are summed over frames with the
weights W c. A `Noise` knows the pattern by its c. For images that are divided by their own noise,
C^-1 = w M^-1 w with M^-1 = 1 - t t^T and t = w c.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from pyklip_diffrender.linear.frames import LinearFrame, pixel_pieces

__all__ = [
    "Noise",
    "summed_rows",
]


@dataclass(frozen=True, eq=False)
class Noise:
    """Noise of the pixels of frames that are fitted together, with covariance C.

    Attributes
    ----------
    weight : tuple of Tensor, (ny, nx)
        By frame, w: 1 / standard deviation of the independent noise; 0 for masked pixels.
    common : tuple of Tensor, (ny, nx)
        c of the pattern that the frames share, in the data's unit; 0 if they share none.

    Examples
    --------
    >>> import torch
    >>> from pyklip_diffrender.linear.noise import Noise
    >>> ones = torch.ones(8, 8, dtype=torch.float64)
    >>> Noise((ones, ones), (0 * ones, 0 * ones)).chi2([ones, ones])
    128.0

    A pattern may explain what the frames have in common:

    >>> Noise((ones, ones), (0.7 * ones, 0.7 * ones)).chi2([ones, ones]) < 10
    True
    """

    weight: tuple[Tensor, ...]
    common: tuple[Tensor, ...]

    @cached_property
    def shares_pattern(self) -> bool:
        """Whether the frames share a pattern of the detector."""
        return any(bool((each != 0).any()) for each in self.common)

    @cached_property
    def _pattern_power(self) -> Tensor:
        """t^T t of every pixel, (ny, nx)."""
        products = [(w * c) ** 2 for w, c in zip(self.weight, self.common, strict=True)]
        return torch.stack(products).sum(dim=0)

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
        if self.shares_pattern:
            inverse = self.inverse(images)
            return {k: self.weight[k].to(x.dtype) * x for k, x in inverse.items()}
        return {k: (self.weight[k] ** 2).to(x.dtype) * x for k, x in images.items()}

    def whitened(self, images: Mapping[int, Tensor]) -> Tensor:
        """Images in units in which their noise is independent and has a variance of 1.

        Scalar products of the results, (k, pixels of frames), are x^T C^-1 y of the images x and y,
        (k, ny, nx) by frame.
        """
        if not self.shares_pattern:
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
        total = sum(float(((self.weight[k] * x) ** 2).sum()) for k, x in by_frame.items())
        return total - float((self._summed(by_frame) ** 2).sum()) if self.shares_pattern else total


def summed_rows(frames: Sequence[LinearFrame], unknowns: int) -> Tensor:
    """W c summed over frames with the derivative by every unknown, (unknowns, pixels), float32."""
    total = torch.zeros(unknowns, frames[0].weight.numel(), dtype=torch.float32)
    for frame in frames:
        scale = (torch.ones(()) * (frame.weight**2 * frame.common).float()).flatten()
        for pixels in pixel_pieces(total.shape[1]):
            on_rows = frame.jacobian.flatten(1)[:, pixels] * scale[pixels]
            total[:, pixels] += frame.onto_unknowns(on_rows, unknowns)
    return total
