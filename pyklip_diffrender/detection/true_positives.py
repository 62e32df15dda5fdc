"""Fraction of planets that a search finds, by contrast and separation.

A contrast curve at 5 sigma says how bright a planet is whose S/N is 5 on average: half of them are
found. Here planets of several contrasts are added to the frames, to first order: the maps of a
search are linear in the data, so that the light of a planet changes them by its contrast times a
map that is computed once for each place. Every map is then searched as if nothing were known of
the planet. The true-positive fraction is that of Jensen-Clem et al., AJ 155, 19 (2018), for the
false-positive fraction of the threshold.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from astropy import units as u
from astropy.table import QTable
from numpy.typing import ArrayLike, NDArray

from pyklip_diffrender.detection.error_inflation import significance_of
from pyklip_diffrender.detection.field import Image, curve_separations, far_from
from pyklip_diffrender.detection.groups import groups_of
from pyklip_diffrender.detection.maps import Maps
from pyklip_diffrender.detection.recovery import CLEAR
from pyklip_diffrender.detection.search_result import Detection
from pyklip_diffrender.detection.significance import Significance
from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.io.progress import ProgressBar

__all__ = ["completeness", "contrast_of_completeness"]

_STRENGTHS = tuple(np.geomspace(0.4, 3.0, 12).tolist())
"""Contrasts over the limit with the small-sample correction."""

_GOLDEN = 137.5
"""Degrees between the first planets at neighbouring separations."""

_NEAR = 0.5
"""Distance in lambda/D of a candidate from the planet that it is."""

_BATCH = 64
"""Number of planets whose maps are computed at a time."""

_FRACTIONS = (0.5, 0.95)


def completeness(
    detection: Detection,
    *,
    separations: ArrayLike | None = None,
    strengths: Sequence[float] = _STRENGTHS,
    angles: int = 24,
    inner: float = 0.2,
    progress: bool = False,
) -> QTable:
    """Compute the fraction of planets that the search of a detection would find.

    Planets are as bright as a grid of contrasts, one at a time, at places that have limits and do
    not overlap with candidates. Their own photon noise is neglected, as is the change of the
    wavefront's linearisation: both are small near the limit.

    Parameters
    ----------
    detection : Detection
        With its fits and their linear models.
    separations : array or Quantity, optional
        arcsec; by default every second of the contrast curve from its second on.
    strengths : sequence of float
        Contrasts over the 5-sigma limit with the small-sample correction at the separation.
    angles : int
        Number of planets at every separation.
    inner : float
        Smallest separation of candidates, as in `detect`, arcsec.
    progress : bool
        Show a progress bar.

    Returns
    -------
    QTable
        A row for every separation and contrast: separation, contrast, completeness (the fraction
        found) and planets, the number of trials. `meta` has the threshold in sigmas, the
        probability "false_alarm" that noise has a candidate anywhere in the field, and the lists
        "separation_arcsec", "contrast_50" and "contrast_95" of `contrast_of_completeness`.

    Raises
    ------
    IncompatibleSetupError
        If the detection has no linear models, or no place is free.

    Examples
    --------
    >>> import pyklip_diffrender as dr
    >>> model = dr.nircam_coronagraph("F444W", monochromatic=4.5e-6, npix=128, fov_pixels=32)
    >>> opd = dr.random_opd(1, npix=128)
    >>> frames = dr.simulate(model, dr.Scene(), opd, seed=3)
    >>> fit = dr.refine(model, frames, opd, settings=dr.GaussNewton(cycles=6))
    >>> table = dr.completeness(
    ...     dr.detect(fit), separations=[0.6], strengths=[0.2, 3.0], angles=4
    ... )
    >>> table["completeness"].tolist()
    [0.0, 1.0]
    """
    if not detection.fits:
        raise IncompatibleSetupError(
            "completeness: got a detection without its fits, expected one from detect or reduce"
        )
    maps = Maps(groups_of(detection.fits), progress)
    known = detection.sources
    significance = significance_of(detection.fits, maps, known.offsets, inner)
    residual = maps.without(known)
    curve = detection.contrast_curve
    limit_at, limits = curve["separation"].value, np.asarray(curve["small_sample"])
    chosen = limit_at[1::2] if separations is None else curve_separations(maps.grid, separations)
    free = detection.has_limits & far_from(maps.grid, known.offsets, CLEAR)
    places = [
        _free_places(maps.grid, free, separation, angles, _GOLDEN * n)
        for n, separation in enumerate(chosen)
    ]
    count = sum(map(len, places)) * len(strengths)
    if not count:
        raise IncompatibleSetupError(
            f"separations: got {chosen.tolist()} arcsec, where no place is free of candidates"
        )
    rows = []
    with ProgressBar("completeness", count, shown=progress) as bar:
        for separation, offsets in zip(chosen, places, strict=True):
            if not len(offsets):
                continue
            limit = float(np.exp(np.interp(separation, limit_at, np.log(limits))))
            detected = np.zeros((len(strengths), len(offsets)), dtype=bool)
            for start in range(0, len(offsets), _BATCH):
                part = offsets[start : start + _BATCH]
                changes = maps.response(torch.from_numpy(part))
                for n, (place, change) in enumerate(zip(part, changes, strict=True), start):
                    for s, strength in enumerate(strengths):
                        snr = maps.snr(residual + strength * limit * change)
                        detected[s, n] = _detects(
                            significance, snr, detection, _NEAR * significance.resolution, place
                        )
                        bar.update(1)
            rows += [
                (separation, strength * limit, fraction, len(offsets))
                for strength, fraction in zip(strengths, detected.mean(axis=1), strict=True)
            ]
    table = QTable(
        rows=rows,
        names=("separation", "contrast", "completeness", "planets"),
        dtype=[float, float, float, int],
    )
    table["separation"] = np.asarray(table["separation"]) * u.arcsec
    for name, form in {"separation": ".3f", "contrast": ".2e", "completeness": ".2f"}.items():
        table[name].info.format = form
    table.meta = {
        "threshold": detection.threshold,
        "false_alarm": significance.false_alarm(detection.threshold),
    }
    for fraction in _FRACTIONS:
        reached = contrast_of_completeness(table, fraction)
        table.meta["separation_arcsec"] = reached["separation"].value.tolist()
        table.meta[f"contrast_{100 * fraction:.0f}"] = np.asarray(reached["contrast"]).tolist()
    return table


def contrast_of_completeness(table: QTable, fraction: float) -> QTable:
    """Interpolate the contrast at which a fraction of planets is found.

    Parameters
    ----------
    table : QTable
        From `completeness`.
    fraction : float

    Returns
    -------
    QTable
        Separation and contrast; NaN where the contrasts of the table do not reach the fraction on
        either side.
    """
    rows = []
    for separation in np.unique(table["separation"]):
        part = table[table["separation"] == separation]
        order = np.argsort(part["contrast"])
        contrasts = np.log(np.asarray(part["contrast"])[order])
        # Of more light, more is found; chance may have it otherwise.
        fractions = np.maximum.accumulate(np.asarray(part["completeness"])[order])
        contrast = np.nan
        if fractions[0] <= fraction <= fractions[-1]:
            above = int(np.argmax(fractions >= fraction))
            low = max(above - 1, 0)
            step = fractions[above] - fractions[low]
            share = (fraction - fractions[low]) / step if step else 0.0
            contrast = np.exp(contrasts[low] + share * (contrasts[above] - contrasts[low]))
        rows.append((separation.to_value(u.arcsec), contrast))
    curve = QTable(rows=rows, names=("separation", "contrast"), dtype=[float, float])
    curve["separation"] = np.asarray(curve["separation"]) * u.arcsec
    return curve


def _free_places(
    grid: Image, free: NDArray[np.bool_], separation: float, count: int, start: float
) -> Image:
    """x, y of planets at a separation, evenly spread from an angle on, where pixels are free."""
    angles = np.radians(start) + 2 * np.pi * np.arange(count) / count
    places = separation * np.stack([-np.sin(angles), np.cos(angles)], axis=-1)
    kept = []
    for place in places:
        away = np.hypot(*np.moveaxis(grid - place, -1, 0))
        kept.append(bool(free[np.unravel_index(away.argmin(), away.shape)]))
    return places[kept]


def _detects(
    significance: Significance, snr: Image, detection: Detection, reach: float, place: Image
) -> bool:
    """Whether a search of the map has a candidate within `reach` arcsec of the place."""
    everywhere = np.ones(snr.shape, dtype=bool)
    peaks = significance.significant_peaks(
        snr, detection.sources.offsets, detection.threshold, everywhere
    )
    return any(np.hypot(*(significance.grid[peak] - place)) < reach for peak, _ in peaks)
