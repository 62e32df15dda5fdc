"""Place and mask subtracted frames the way pyKLIP's `klip_parallelized` does."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from astropy.stats import sigma_clipped_stats
from numpy.typing import NDArray

__all__ = ["Annuli", "aligned_before", "annuli_of", "fill", "noise_cube", "place", "slices"]


@dataclass(frozen=True)
class Annuli:
    """The annuli that pyKLIP would use, reduced to what matters without KLIP.

    Attributes
    ----------
    inner, outer : float
        Pixels; r < inner and r >= outer are NaN in a product.
    width : float
        Width in pixels of the narrowest annulus, over which pyKLIP measures noise.
    """

    inner: float
    outer: float
    width: float


def annuli_of(
    imgs: NDArray[Any],
    centers: NDArray[Any],
    inner: float,
    outer: float | None,
    annuli: int | Sequence[tuple[float, float]],
    spacing: str,
) -> Annuli:
    """Find the annuli of frames (n, ny, nx) by pyKLIP's rules.

    Parameters
    ----------
    imgs : ndarray, (n, ny, nx)
    centers : ndarray, (n, 2)
        Star centres x, y.
    inner, outer : float
        IWA and OWA in pixels; `outer` is None for the whole image.
    annuli : int or sequence of (inner, outer)
        Number of annuli, or their radii in pixels.
    spacing : str
        "constant", "log" or "linear".
    """
    from pyklip.klip import define_annuli_bounds

    if np.ndim(annuli):
        inners, outers = np.array(annuli, dtype=float).reshape(-1, 2).T
        return Annuli(inners.min(), outers.max(), (outers - inners).min())
    edge = outer
    if edge is None:
        y, x = np.indices(imgs.shape[1:])
        squared = (x - centers[0][0]) ** 2 + (y - centers[0][1]) ** 2
        bad = np.isnan(imgs[0])
        edge = np.sqrt(np.percentile(squared[bad], 1) if bad.any() else squared.max())
    bounds = [tuple(b) for b in define_annuli_bounds(annuli, inner, edge, spacing)]
    if outer is None:
        bounds[-1] = (bounds[-1][0], imgs.shape[1])
    return Annuli(bounds[0][0], bounds[-1][1], min(b - a for a, b in bounds))


def fill(residual: NDArray[np.float64], good: NDArray[np.bool_]) -> int:
    """Replace flagged pixels by the median of their good neighbours, in place.

    Otherwise the spline that shifts and rotates frames would spread each bad pixel over a dozen
    others. NaN pixels stay NaN; a flagged pixel without a good one within two pixels becomes NaN.

    Parameters
    ----------
    residual : ndarray, (ny, nx)
        Frame minus star.
    good : ndarray of bool, (ny, nx)
        False for flagged pixels.

    Returns
    -------
    int
        Number of pixels replaced.
    """
    trusted = np.where(good, residual, np.nan)
    flagged = np.argwhere(~good & np.isfinite(residual))
    for y, x in flagged:
        for reach in (1, 2):
            near = trusted[max(y - reach, 0) : y + reach + 1, max(x - reach, 0) : x + reach + 1]
            near = near[np.isfinite(near)]
            if near.size:
                break
        residual[y, x] = np.median(near) if near.size else np.nan
    return len(flagged)


def place(
    residual: NDArray[np.float64],
    old_center: NDArray[np.float64],
    new_center: NDArray[np.float64],
    annuli: Annuli,
) -> NDArray[np.float64]:
    """Shift a subtracted frame to the common centre, mask it, and subtract its pedestal.

    The pedestal is the sigma-clipped median, which companions do not change. KLIP makes the mean
    of each section zero, and code that reads its products relies on that.
    """
    from pyklip.klip import align_and_scale

    placed = np.asarray(align_and_scale(residual, new_center=new_center, old_center=old_center))
    y, x = np.indices(placed.shape)
    r = np.hypot(x - new_center[0], y - new_center[1])
    placed[(r < annuli.inner) | (r >= annuli.outer)] = np.nan
    kept = np.isfinite(placed)
    if kept.any():
        placed -= sigma_clipped_stats(placed[kept])[1]
    return placed


def _number_type(dtype: Any) -> np.dtype[Any]:
    """Number type of pyKLIP: single precision unless the call says otherwise."""
    return np.dtype(ctypes.c_float if dtype is None else dtype)


def slices(frames: NDArray[np.float64], count: int, dtype: Any) -> NDArray[Any]:
    """Repeat frames (n, ny, nx) in pyKLIP's number type: (count, n, ny, nx).

    Without a KL cut-off there is one result, but pyKLIP's later steps expect one slice for each
    entry of numbasis.
    """
    return np.repeat(frames.astype(_number_type(dtype))[np.newaxis], count, axis=0)


def noise_cube(
    frames: NDArray[np.float64],
    center: NDArray[np.float64],
    annuli: Annuli,
    count: int,
    numthreads: int | None,
) -> NDArray[np.float64]:
    """Azimuthal scatter of frames (n, ny, nx) as measured by pyKLIP, (count, n, ny, nx)."""
    from pyklip.parallelized import generate_noise_maps

    maps = generate_noise_maps(
        frames, center, annuli.width, IWA=annuli.inner, OWA=annuli.outer, numthreads=numthreads
    )
    return np.repeat(np.asarray(maps)[np.newaxis], count, axis=0)


def aligned_before(
    imgs: NDArray[Any],
    centers: NDArray[Any],
    wavelengths: NDArray[Any],
    center: NDArray[np.float64],
    dtype: Any,
) -> NDArray[Any]:
    """Unsubtracted frames for save_aligned: centred, and scaled to each of the wavelengths.

    Returns
    -------
    ndarray, (wavelengths, n, ny, nx)
    """
    from pyklip.klip import align_and_scale

    return np.array(
        [
            [
                align_and_scale(img, new_center=center, old_center=old, scale_factor=to / at)
                for img, old, at in zip(imgs, centers, wavelengths, strict=True)
            ]
            for to in np.unique(wavelengths)
        ],
        dtype=_number_type(dtype),
    )
