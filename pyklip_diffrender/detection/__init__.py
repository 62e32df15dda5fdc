"""Detection of point sources with the wavefront integrated out.

A planet's light and a wavefront error may look alike. Where the fit of the star bends to the
planet, a subtracted frame has lost some of it, and says neither how much nor how sure one can be.
Here the planet is estimated together with everything that describes the star, in closed form:
unbiased, with an error that contains the price of the wavefront's freedom.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence

import numpy as np
import torch
from astropy.table import QTable
from numpy.typing import ArrayLike, NDArray

from pyklip_diffrender.detection.candidates import Candidates, refine_candidates, strongest_peak
from pyklip_diffrender.detection.contrast import (
    contrast_table,
    ring_pixels,
    small_sample_factor,
)
from pyklip_diffrender.detection.excess import excess
from pyklip_diffrender.detection.maps import Group, Maps
from pyklip_diffrender.detection.relinearise import lacking, star_only, with_companions
from pyklip_diffrender.detection.result import Detection, amplitudes
from pyklip_diffrender.detection.templates import Templates
from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.io.units import ARCSEC
from pyklip_diffrender.refinement import Refinement

__all__ = [
    "Candidates",
    "Detection",
    "contrast_curve",
    "detect",
    "measure",
    "small_sample_factor",
]

_log = logging.getLogger(__name__)

_MOST = 20
"""Candidates at most."""

_SOURCE = 5.0
"""S/N from which on `measure` takes it that there is a source."""

_WINGS = 0.4
"""arcsec; nearer than this to a candidate, S/N says nothing about the noise."""


def detect(
    fits: Refinement | Sequence[Refinement],
    *,
    threshold: float = 5.0,
    inner: float = 0.2,
    scatter: float | None = None,
    separations: ArrayLike | None = None,
    relinearise: float = 25.0,
    progress: bool = False,
) -> Detection:
    """Look for point sources in refined frames.

    Parameters
    ----------
    fits : Refinement or sequence of Refinement
        What `refine` gave. Frames that were refined together share what is known of the star;
        others are independent looks at the same sky.
    threshold : float
        S/N of a candidate.
    inner : float
        Candidates are not looked for nearer to the star, arcsec.
    scatter : float, optional
        Factor for all errors. Default, where every fit explains its data, the square root of what
        chi2 is to what noise makes it, less the candidates' light; else the scatter of S/N away
        from candidates. Never below 1.
    separations : array, optional
        Of the contrast curve, arcsec. Default every 0.1 from 0.2 to the nearest edge.
    relinearise : float
        When a candidate's S/N is higher, the star is refined once more with the candidates in
        the model, so that the linear model holds where the star is.
    progress : bool
        Show bars.

    Returns
    -------
    Detection

    Raises
    ------
    IncompatibleSetupError
        For fits without a linear model (only the default method of `refine` makes one), failed
        ones, or frames of a reference star alone.
    """
    given = [fits] if isinstance(fits, Refinement) else list(fits)
    groups = _groups(given)
    maps = Maps(groups, progress)
    found, factor = _search(maps, given, threshold, inner, scatter, Candidates.of_fit(given[0]))
    bright = found.contrasts > relinearise * factor * found.errors[:, 0]
    if bool(bright.any()) and lacking(given, found):
        given = with_companions(given, found, progress)
        groups = _groups(given)
        maps = Maps(groups, progress)
        found, factor = _search(maps, given, threshold, inner, scatter, found)
    grid = groups[0][1].grid
    information = np.where(maps.information > 0, maps.information, np.nan)
    photon = np.where(maps.photon > 0, maps.photon, np.nan) ** -0.5
    error = factor / np.sqrt(information)
    return Detection(
        fits=tuple(given),
        groups=tuple(groups),
        contrast=maps.numerator / information,
        error=error,
        photon_error=photon,
        snr=maps.snr() / factor,
        residual_snr=maps.snr(maps.without(found)) / factor,
        scatter=factor,
        candidates=found,
        threshold=threshold,
        contrast_curve=_curve(given[0], grid, error, photon, separations),
        grid=grid,
    )


def measure(
    fits: Refinement | Sequence[Refinement],
    offsets: ArrayLike,
    *,
    scatter: float | None = None,
    relinearise: float = 25.0,
) -> QTable:
    """Contrast of a point source at given positions, each as if it were the only one.

    Parameters
    ----------
    fits : Refinement or sequence of Refinement
    offsets : (k, 2)
        x, y from the star, arcsec, image orientation of the first frame.
    scatter : float, optional
        Factor for the errors. Default as for `detect`, less the light measured here where its S/N
        is above 5; or 1 for fits that do not explain their data.
    relinearise : float
        See `detect`.

    Returns
    -------
    QTable
        x, y, contrast, contrast_error (with that of the star's flux), snr (without it).

    Raises
    ------
    IncompatibleSetupError, ShapeError
    """
    given = [fits] if isinstance(fits, Refinement) else list(fits)
    table = _measured(given, offsets, scatter)
    bright = table[table["snr"] > relinearise]
    if len(bright):
        places = torch.from_numpy(np.stack([bright["x"].value, bright["y"].value], axis=1))
        contrasts = torch.from_numpy(np.asarray(bright["contrast"]))
        known = Candidates(places, contrasts, torch.zeros(3 * len(bright), 3 * len(bright)))
        table = _measured(with_companions(given, known), offsets, scatter)
    return table


def _measured(fits: Sequence[Refinement], offsets: ArrayLike, scatter: float | None) -> QTable:
    groups = _groups(fits)
    table = amplitudes(groups, offsets, 1.0 if scatter is None else scatter)
    if scatter is None:
        sources = table[table["snr"] > _SOURCE]
        places = np.stack([sources["x"].value, sources["y"].value], axis=1)
        known = Candidates.of_fit(fits[0]).offsets
        factor = _factor(fits, groups, torch.cat([known, torch.from_numpy(places)]))
        table["contrast_error"] *= factor
        table["snr"] /= factor
    return table


def contrast_curve(
    fits: Refinement | Sequence[Refinement],
    separations: ArrayLike | None = None,
    *,
    angles: int = 12,
    scatter: float | None = None,
) -> QTable:
    """The 5-sigma contrast curve alone, from a few positions at each separation.

    Parameters
    ----------
    fits : Refinement or sequence of Refinement
    separations : array, optional
        arcsec; as for `detect`.
    angles : int
        Positions per separation, at most.
    scatter : float, optional
        Factor for the errors; see `measure`. A source that no fit knows as a companion makes the
        default larger; `detect` finds it first.

    Returns
    -------
    QTable
        See `contrast.contrast_table`.
    """
    given = [fits] if isinstance(fits, Refinement) else list(fits)
    groups = _groups(given)
    grid = groups[0][1].grid
    wanted = _separations(grid, separations)
    rings = ring_pixels(grid, wanted, angles)
    rows = np.concatenate([ring[0] for ring in rings])
    columns = np.concatenate([ring[1] for ring in rings])
    information = torch.zeros(len(rows), dtype=torch.float64)
    photon = torch.zeros_like(information)
    for linear, templates in groups:
        images = templates.at_pixels(rows, columns)
        weighed = linear.weigh(images)
        information += weighed.information
        photon += weighed.photon
    ends = np.cumsum([len(ring[0]) for ring in rings])[:-1]
    factor = scatter
    if factor is None:
        factor = _factor(given, groups, Candidates.of_fit(given[0]).offsets)
    errors = np.split(factor * information.numpy() ** -0.5, ends)
    known = np.split(photon.numpy() ** -0.5, ends)
    return contrast_table(wanted, errors, known, _resolution(given[0]))


def _groups(fits: Sequence[Refinement]) -> list[Group]:
    """Fits that share a linear model, with their templates."""
    if not fits:
        raise IncompatibleSetupError("detect: got no fit")
    by_model: dict[int, list[Refinement]] = {}
    for fit in fits:
        if fit.linear is None:
            raise IncompatibleSetupError(
                f"detect: a fit by method {fit.method!r} has no linear model of its unknowns; "
                'use refine(method="gauss-newton"), the default'
            )
        if not fit.status.usable:
            raise IncompatibleSetupError(f"detect: the fit {fit.status.message}")
        by_model.setdefault(id(fit.linear), []).append(fit)
    groups: list[Group] = []
    for members in by_model.values():
        linear = members[0].linear
        if linear is not None and len(members) != len(linear.frames):
            raise IncompatibleSetupError(
                f"detect: got {len(members)} of {len(linear.frames)} frames that were refined "
                "together; give all that refine returned (reference stars too)"
            )
        if not all(fit.observation.reference for fit in members):
            groups.append((star_only(members), Templates(members, fits[0])))
    return groups


def _search(
    maps: Maps,
    fits: Sequence[Refinement],
    threshold: float,
    inner: float,
    scatter: float | None,
    start: Candidates,
) -> tuple[Candidates, float]:
    """Candidates, strongest first, and the factor for the errors."""
    grid = maps.groups[0][1].grid
    pixel = float(np.abs(np.diff(grid[:, :, 0], axis=1)).mean())
    explained = all(fit.status.calibrated for fit in fits)
    found = start
    if len(start):
        found = refine_candidates(maps.groups, start, reach=pixel / 2)
    # A refinement may take something for a companion while its wavefront is still far off.
    while len(found) and float((snrs := found.contrasts / found.errors[:, 0]).min()) < threshold:
        found = found.without(int(snrs.argmin()))
        if len(found):
            found = refine_candidates(maps.groups, found, reach=pixel / 2)
    while True:
        snr = maps.snr(maps.without(found))
        factor = scatter
        if factor is None:
            factor = (
                excess(fits, maps.groups, found.offsets)
                if explained
                else max(1.0, _scatter(snr, grid, found, inner))
            )
        peak = strongest_peak(
            snr / factor, grid, found.offsets, threshold=threshold, inner=inner, apart=pixel
        )
        if peak is None or len(found) >= _MOST:
            return found, factor
        amplitude = float(snr[peak] / np.sqrt(maps.information[peak]))
        found = refine_candidates(
            maps.groups, found.with_one_more(grid[peak], amplitude), reach=pixel / 2
        )
        _log.info("candidates at %s arcsec", found.offsets.tolist())


def _factor(fits: Sequence[Refinement], groups: Sequence[Group], offsets: torch.Tensor) -> float:
    """For the errors, with the light of sources at `offsets` taken out."""
    # Where fits do not explain their data at all, their model error is in their noise already.
    return excess(fits, groups, offsets) if all(fit.status.calibrated for fit in fits) else 1.0


def _scatter(
    snr: NDArray[np.float64], grid: NDArray[np.float64], found: Candidates, inner: float
) -> float:
    """Standard deviation of S/N where there is no source, outliers held back."""
    away = (np.hypot(grid[..., 0], grid[..., 1]) >= inner) & np.isfinite(snr)
    for x, y in found.offsets.tolist():
        away &= np.hypot(grid[..., 0] - x, grid[..., 1] - y) > _WINGS
    values = snr[away]
    scale = 1.4826 * float(np.median(np.abs(values - np.median(values))))
    # Peaks that are candidates yet to be found must not hide themselves.
    return float(np.clip(values, -5 * scale, 5 * scale).std())


def _separations(grid: NDArray[np.float64], separations: ArrayLike | None) -> NDArray[np.float64]:
    if separations is not None:
        return np.atleast_1d(np.asarray(separations, dtype=float))
    edge = min(np.abs(grid[:, 0, 0]).min(), np.abs(grid[:, -1, 0]).min(),
               np.abs(grid[0, :, 1]).min(), np.abs(grid[-1, :, 1]).min())  # fmt: skip
    return np.arange(0.2, edge + 1e-9, 0.1)


def _resolution(fit: Refinement) -> float:
    """lambda/D, arcsec."""
    return fit.model.bandpass.mean_wavelength / fit.model.diameter / ARCSEC


def _curve(
    fit: Refinement,
    grid: NDArray[np.float64],
    error: NDArray[np.float64],
    photon: NDArray[np.float64],
    separations: ArrayLike | None,
) -> QTable:
    wanted = _separations(grid, separations)
    rings = ring_pixels(grid, wanted, most=error.size)
    usable = [np.isfinite(error[ring]) for ring in rings]
    errors = [error[ring][good] for ring, good in zip(rings, usable, strict=True)]
    known = [photon[ring][good] for ring, good in zip(rings, usable, strict=True)]
    return contrast_table(wanted, errors, known, _resolution(fit))
