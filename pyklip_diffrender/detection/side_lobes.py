"""Candidates that are side lobes of a source nearer to the star than the search goes.

Such a source can end a fit at a wrong wavefront, whose residuals elsewhere look like planets.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from pyklip_diffrender.detection.candidates import Candidates, refine_candidates
from pyklip_diffrender.detection.error_factor import ErrorFactor
from pyklip_diffrender.detection.field import Image, pixel_width, separation_of
from pyklip_diffrender.detection.maps import Maps

__all__ = ["side_lobes"]


def side_lobes(
    maps: Maps,
    snr: Image,
    candidates: Candidates,
    factor: ErrorFactor,
    threshold: float,
    inner: float,
) -> Tensor:
    """Which candidates are not significant beside a source within the inner limit, (k,).

    The source starts at the highest peak there, is fitted together with the candidates, and must be
    significant beside them. A planet keeps its S/N, because the two images differ.

    Parameters
    ----------
    maps : Maps
    snr : ndarray, (ny, nx)
        Without the candidates, before errors are multiplied.
    candidates : Candidates
    factor : ErrorFactor
        By which the errors are multiplied.
    threshold : float
        S/N of a source in Gaussian noise.
    inner : float
        Smallest separation of candidates, arcsec.
    """
    none = torch.zeros(len(candidates), dtype=torch.bool)
    if not len(candidates):
        return none
    scaled = np.where(separation_of(maps.grid) < inner, snr / factor.of(maps.grid), -np.inf)
    peak = np.unravel_index(np.nanargmax(scaled), scaled.shape)
    contrast = float(snr[peak] / np.sqrt(maps.information[peak]))
    both = candidates.with_one_more(maps.grid[peak], contrast)
    both = refine_candidates(maps.groups, both, pixel_width(maps.grid) / 2)
    sigmas = both.snr(factor)
    # The map has less of a source between pixels, and of one that the candidates stand for.
    if separation_of(both.offsets.numpy())[-1] >= inner or sigmas[-1] < threshold:
        return none
    return torch.from_numpy(sigmas[:-1] < factor.threshold(threshold, candidates.offsets))
