"""Planets that have bent the wavefront of a fit so far that the search does not list them.

A planet that is missing in the model of a fit can end it at a wrong wavefront, whose residuals hide
the planet and can look like another one. Such fits do not explain their data, even with the
candidates of a search. The highest peaks of the S/N that are left, without the factor that their
own scatter has raised, are then tried as companions.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence

import numpy as np

from pyklip_diffrender.detection.candidates import Candidates
from pyklip_diffrender.detection.field import far_from, pixel_width, reaching
from pyklip_diffrender.detection.groups import has_only_reference_stars
from pyklip_diffrender.detection.maps import Maps
from pyklip_diffrender.detection.relinearise import with_companions
from pyklip_diffrender.refinement import Refinement, Status
from pyklip_diffrender.refinement.companions import local_maxima

__all__ = ["with_raised_peaks"]

_log = logging.getLogger(__name__)

_PEAKS = 3
"""Largest number of peaks that are tried, each with a fit of its own."""

_APART = 2.0
"""Pixels between a candidate and a peak that is not what its subtraction left."""

_LOWEST = 5.0
"""S/N of a peak that is tried, without a factor."""

_BETTER = 0.9
"""Largest ratio of chi-squared with a companion to that without it. A planet that ends a fit at a
wrong wavefront dominates chi-squared; errors of the model do not go away with one companion."""

_UNEXPLAINED = (Status.MODEL_MISMATCH, Status.ITERATION_LIMIT)


def with_raised_peaks(
    fits: Sequence[Refinement],
    maps: Maps,
    candidates: Candidates,
    inner: float,
    progress: bool = False,
) -> list[Refinement] | None:
    """Refine the star again with the candidates and one of the highest peaks as companions.

    The first one that explains the data ends the search.

    Parameters
    ----------
    fits : sequence of Refinement
    maps : Maps
        Of these fits.
    candidates : Candidates
    inner : float
        Smallest separation of a peak, arcsec.
    progress : bool
        Show progress bars.

    Returns
    -------
    list of Refinement or None
        The fits with the companion that lowers chi-squared most; None if none lowers it enough, or
        if the fits explain their data.
    """
    if not _unexplained(fits):
        return None
    snr = maps.snr(maps.without(candidates))
    allowed = reaching(maps.grid, inner)
    allowed &= far_from(maps.grid, candidates.offsets, _APART * pixel_width(maps.grid))
    best, least = None, _BETTER * _chi2(fits)
    for peak in local_maxima(snr, allowed, _LOWEST, size=7)[:_PEAKS]:
        contrast = float(snr[peak] / np.sqrt(maps.information[peak]))
        tried = candidates.with_one_more(maps.grid[peak], contrast)
        refined = with_companions(fits, tried, progress)
        _log.info("a companion at %s lowers chi-squared to %.3g", maps.grid[peak], _chi2(refined))
        if all(fit.status.usable for fit in refined) and _chi2(refined) < least:
            best, least = refined, _chi2(refined)
            if not _unexplained(best):
                break
    return best


def _unexplained(fits: Sequence[Refinement]) -> bool:
    return any(fit.status in _UNEXPLAINED and fit.chi2_per_pixel > 1 for fit in fits)


def _chi2(fits: Sequence[Refinement]) -> float:
    """Mean chi-squared per pixel of the fits of the target."""
    of_target = [fit for fit in fits if not has_only_reference_stars(fit)]
    return float(np.mean([fit.chi2_per_pixel for fit in of_target]))
