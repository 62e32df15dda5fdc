"""Search for point sources in refined frames."""

from __future__ import annotations

import logging
from collections.abc import Sequence

import numpy as np
import torch
from astropy.table import QTable
from numpy.typing import ArrayLike, NDArray

from pyklip_diffrender.detection.candidates import Candidates, refine_candidates, strongest_peak
from pyklip_diffrender.detection.contrast import contrast_table, ring_pixels
from pyklip_diffrender.detection.excess import excess
from pyklip_diffrender.detection.maps import Group, Maps
from pyklip_diffrender.detection.relinearise import (
    has_only_reference_stars,
    lacks_candidates,
    with_companions,
)
from pyklip_diffrender.detection.result import Detection, amplitudes
from pyklip_diffrender.detection.templates import Templates
from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.io.units import ARCSEC, to_arcsec
from pyklip_diffrender.refinement import Refinement

__all__ = ["contrast_curve", "detect", "measure"]

Fits = Refinement | Sequence[Refinement]

_log = logging.getLogger(__name__)

_MOST = 20
"""Candidates at most."""

_SOURCE = 5.0
"""S/N from which on `measure` takes it that there is a source."""

_WINGS = 0.4
"""arcsec; nearer than this to a candidate, S/N says nothing about the noise."""


def detect(
    fits: Fits,
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
        Several refinements are independent looks at the same sky.
    threshold : float
        S/N above which a source is a candidate.
    inner : float or Quantity
        Smallest separation at which candidates are looked for, arcsec.
    scatter : float, optional
        Factor by which all errors are multiplied. Default, where every fit explains its data,
        the square root of the reduced chi-squared with the candidates removed; otherwise the
        standard deviation of S/N away from candidates. Never below 1.
    separations : array or Quantity, optional
        Of the contrast curve, arcsec. Default every 0.1 from 0.2 to the nearest edge.
    relinearise : float
        S/N of a candidate above which the star is refined once more with the candidates in the
        model, so that the linear model holds where the star is. Where a fit does not explain its
        data, any candidate may be the reason, and `threshold` takes its place.
    progress : bool
        Show progress bars.

    Returns
    -------
    Detection

    Raises
    ------
    IncompatibleSetupError
        For fits without a linear model (the Adam recipe has none), failed ones, frames of a
        reference star alone, or a threshold or separation that is not positive.

    Examples
    --------
    >>> import pyklip_diffrender as dr
    >>> model = dr.nircam_coronagraph("F444W", monochromatic=4.5e-6, npix=128, fov_pixels=32)
    >>> opd = dr.random_opd(1, npix=128)
    >>> scene = dr.Scene(planets=(dr.Planet(1e-5, 0.6, 120.0),))
    >>> frames = dr.simulate(model, scene, opd, seed=3)
    >>> fit = dr.refine(model, frames, opd, settings=dr.GaussNewton(cycles=6))
    >>> len(dr.detect(fit).table)
    1
    """
    fits = _checked(fits)
    inner = float(to_arcsec(inner, "inner"))
    _require_positive(threshold=threshold, inner=inner, scatter=scatter)
    groups = _groups(fits)
    maps = Maps(groups, progress)
    candidates, factor = _search(maps, fits, threshold, inner, scatter, Candidates.of_fit(fits[0]))
    if not all(fit.status.calibrated for fit in fits):
        relinearise = min(relinearise, threshold)
    bright = candidates.contrasts > relinearise * factor * candidates.errors[:, 0]
    if bool(bright.any()) and lacks_candidates(fits, candidates):
        fits = with_companions(fits, candidates, progress)
        groups = _groups(fits)
        maps = Maps(groups, progress)
        candidates, factor = _search(maps, fits, threshold, inner, scatter, candidates)
    grid = groups[0][1].grid
    information = np.where(maps.information > 0, maps.information, np.nan)
    photon = np.where(maps.photon > 0, maps.photon, np.nan) ** -0.5
    error = factor / np.sqrt(information)
    return Detection(
        fits=tuple(fits),
        groups=tuple(groups),
        contrast=maps.numerator / information,
        error=error,
        photon_error=photon,
        snr=maps.snr() / factor,
        residual_snr=maps.snr(maps.without(candidates)) / factor,
        scatter=factor,
        candidates=candidates,
        threshold=threshold,
        contrast_curve=_curve(fits[0], grid, error, photon, separations),
        grid=grid,
    )


def measure(
    fits: Fits,
    offsets: ArrayLike,
    *,
    scatter: float | None = None,
    relinearise: float = 25.0,
) -> QTable:
    """Contrast of a point source at given positions, each as if it were the only one.

    Parameters
    ----------
    fits : Refinement or sequence of Refinement
    offsets : array or Quantity, (k, 2)
        x, y from the star, arcsec, image orientation of the first frame.
    scatter : float, optional
        Factor by which the errors are multiplied. Default as for `detect`, with sources of S/N
        above 5 removed; 1 for fits that do not explain their data.
    relinearise : float
        See `detect`.

    Returns
    -------
    QTable
        x, y, contrast, contrast_error (with that of the star's flux), snr (without it).

    Raises
    ------
    IncompatibleSetupError
        See `detect`; also for a position outside the field.
    NonFiniteError, ShapeError, UnitError
    """
    fits = _checked(fits)
    _require_positive(scatter=scatter)
    table = _measured(fits, offsets, scatter)
    bright = table[table["snr"] > relinearise]
    if len(bright):
        places = torch.from_numpy(np.stack([bright["x"].value, bright["y"].value], axis=1))
        contrasts = torch.from_numpy(np.asarray(bright["contrast"]))
        known = Candidates(places, contrasts, torch.zeros(3 * len(bright), 3 * len(bright)))
        table = _measured(with_companions(fits, known), offsets, scatter)
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
    fits: Fits,
    separations: ArrayLike | None = None,
    *,
    angles: int = 12,
    scatter: float | None = None,
) -> QTable:
    """The 5-sigma contrast curve alone, from a few positions at each separation.

    Parameters
    ----------
    fits : Refinement or sequence of Refinement
    separations : array or Quantity, optional
        arcsec; as for `detect`.
    angles : int
        Positions per separation, at most.
    scatter : float, optional
        Factor by which the errors are multiplied; see `measure`. A source that no fit knows as a
        companion makes the default larger; `detect` finds it first.

    Returns
    -------
    QTable
        See `contrast.contrast_table`.

    Raises
    ------
    IncompatibleSetupError
        See `detect`; also if no pixel of the field is at any of the separations.
    """
    fits = _checked(fits)
    _require_positive(scatter=scatter)
    groups = _groups(fits)
    grid = groups[0][1].grid
    wanted = _separations(grid, separations)
    rings = ring_pixels(grid, wanted, angles)
    if not any(len(ring[0]) for ring in rings):
        raise IncompatibleSetupError(
            f"separations: got {wanted.tolist()} arcsec, where the frames have no pixel; the "
            f"corners of the field are {np.hypot(grid[..., 0], grid[..., 1]).max():.3g} arcsec "
            "from the star"
        )
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
        factor = _factor(fits, groups, Candidates.of_fit(fits[0]).offsets)
    errors = np.split(factor * information.numpy() ** -0.5, ends)
    known = np.split(photon.numpy() ** -0.5, ends)
    return contrast_table(wanted, errors, known, _resolution(fits[0]))


def _checked(fits: Fits) -> list[Refinement]:
    """The fits in a list, all of them usable."""
    several = [fits] if isinstance(fits, Refinement) else list(fits)
    if not several:
        raise IncompatibleSetupError("detect: got no fit, expected a Refinement")
    for fit in several:
        if not fit.status.usable:
            raise IncompatibleSetupError(f"detect: the fit {fit.status.message}")
    return several


def _require_positive(**values: float | None) -> None:
    """Refuse numbers that are not positive; None stands for a default."""
    for name, value in values.items():
        if value is not None and not value > 0:
            raise IncompatibleSetupError(f"{name}: got {value}, expected a positive number")


def _groups(fits: Sequence[Refinement]) -> list[Group]:
    """Linear model and templates of every fit of the target."""
    origin = fits[0].frames[0]
    return [
        (fit.star_only, Templates(fit, origin)) for fit in fits if not has_only_reference_stars(fit)
    ]


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
    candidates = start
    if len(start):
        candidates = refine_candidates(maps.groups, start, reach=pixel / 2)
    # A refinement may take something for a companion while its wavefront is still far off.
    while (
        len(candidates)
        and float((snrs := candidates.contrasts / candidates.errors[:, 0]).min()) < threshold
    ):
        candidates = candidates.without(int(snrs.argmin()))
        if len(candidates):
            candidates = refine_candidates(maps.groups, candidates, reach=pixel / 2)
    while True:
        snr = maps.snr(maps.without(candidates))
        factor = scatter
        if factor is None:
            factor = (
                excess(fits, maps.groups, candidates.offsets)
                if explained
                else max(1.0, _scatter(snr, grid, candidates, inner))
            )
        peak = strongest_peak(
            snr / factor, grid, candidates.offsets, threshold=threshold, inner=inner, apart=pixel
        )
        if peak is None or len(candidates) >= _MOST:
            return candidates, factor
        amplitude = float(snr[peak] / np.sqrt(maps.information[peak]))
        candidates = refine_candidates(
            maps.groups, candidates.with_one_more(grid[peak], amplitude), reach=pixel / 2
        )
        _log.info("candidates at %s arcsec", candidates.offsets.tolist())


def _factor(fits: Sequence[Refinement], groups: Sequence[Group], offsets: torch.Tensor) -> float:
    """Factor by which errors are multiplied, with the light of sources at `offsets` removed."""
    # Where fits do not explain their data at all, their noise already has a model error in it.
    return excess(fits, groups, offsets) if all(fit.status.calibrated for fit in fits) else 1.0


def _scatter(
    snr: NDArray[np.float64], grid: NDArray[np.float64], candidates: Candidates, inner: float
) -> float:
    """Standard deviation of S/N where there is no source, outliers held back."""
    away = (np.hypot(grid[..., 0], grid[..., 1]) >= inner) & np.isfinite(snr)
    for x, y in candidates.offsets.tolist():
        away &= np.hypot(grid[..., 0] - x, grid[..., 1] - y) > _WINGS
    values = snr[away]
    scale = 1.4826 * float(np.median(np.abs(values - np.median(values))))
    # Peaks that are candidates yet to be candidates must not hide themselves.
    return float(np.clip(values, -5 * scale, 5 * scale).std())


def _separations(grid: NDArray[np.float64], separations: ArrayLike | None) -> NDArray[np.float64]:
    if separations is not None:
        wanted = np.atleast_1d(to_arcsec(separations, "separations"))
        if not (wanted > 0).all():
            raise IncompatibleSetupError(
                f"separations: got {wanted.tolist()} arcsec, expected positive numbers"
            )
        return wanted
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
