"""Search of the whole frames, seamless with that of the pixels about the star."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from astropy.table import QTable, vstack
from numpy.typing import NDArray

from pyklip_diffrender.detection.candidate_tables import candidate_table
from pyklip_diffrender.detection.candidates import Candidates
from pyklip_diffrender.detection.contrast import contrast_table
from pyklip_diffrender.detection.error_factor import ErrorFactor
from pyklip_diffrender.detection.field import Image, far_from, ring_pixels, separation_of
from pyklip_diffrender.detection.position_errors import with_position_of_star
from pyklip_diffrender.detection.search_result import Detection
from pyklip_diffrender.detection.significance import Significance
from pyklip_diffrender.detection.whole_frames import WholeFrame
from pyklip_diffrender.detection.wide_result import WideField
from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.refinement import star_flux_error
from pyklip_diffrender.scene.observation import Observation

__all__ = ["require_outer_pixels", "wide_field"]

_log = logging.getLogger(__name__)

_EDGE = 16
"""Pixels at the edge of the frame that are not searched: templates are cut off there, and light
scattered by the edge of the occulters' substrate appears in the first rows of every frame."""

_MOST = 50
"""Largest number of sources."""

_LOBES = 1.5
"""arcsec from a source within which a peak may be what its subtraction left."""

_LEFT = 0.1
"""Largest part of a source's S/N that it may leave."""

_STEP = 0.1
"""Distance between the separations of the contrast curve, arcsec."""

_COVERED = 0.5
"""Part of a ring that must be in the frame for a limit to be stated."""


@dataclass(frozen=True, eq=False)
class _Measurement:
    """Contrast, x and y of a source, their variances, and the reduced chi-squared."""

    values: Image
    variance: Image
    chi2: float

    @property
    def snr(self) -> float:
        return float(self.values[0] / np.sqrt(self.variance[0]))


def wide_field(
    detection: Detection, observations: Sequence[Observation], *, threshold: float | None = None
) -> WideField:
    """Search whole frames for point sources.

    Parameters
    ----------
    detection : Detection
        Of one fit; its frames are cutouts of the observations.
    observations : sequence of Observation
        The target's frames before they were cut, in the order of the fit.
    threshold : float, optional
        S/N of a candidate; default that of the detection.

    Returns
    -------
    WideField

    Raises
    ------
    IncompatibleSetupError
        For observations that are not those of the fit, or a detection of several fits.

    Examples
    --------
    With frames and wavefront maps in folders, which the package does not contain:

    >>> import pyklip_diffrender as dr
    >>> frame = dr.Observation.from_fits("roll1_calints.fits")  # doctest: +SKIP
    >>> fit = dr.refine(dr.model_for(frame, 80), frame.cutout(80), "opd.fits")  # doctest: +SKIP
    >>> wide = dr.wide_field(dr.detect(fit), [frame])  # doctest: +SKIP
    """
    threshold = detection.threshold if threshold is None else threshold
    frames = _frames(detection, observations)
    grid = frames[0].grid
    window = _window(detection, frames[0])
    rows, columns = window
    outer = np.zeros(grid.shape[:2], dtype=bool)
    outer[_EDGE:-_EDGE, _EDGE:-_EDGE] = True
    outer[rows, columns] = False
    if not outer.any():
        require_outer_pixels(observations[0], len(detection.grid))
    information, measured, factor = _search(frames, outer, grid, threshold, detection)
    # The star's displacement is that of a source at half the height of the fitted frame.
    halfway = torch.tensor([0.0, float(np.abs(detection.grid[..., 1]).max()) / 2])
    sources = with_position_of_star(detection.groups, _candidates(measured), halfway.double())
    numerator = np.sum(
        [each.on_first(grid, each.products(each.residual))[0] for each in frames], axis=0
    )
    error = factor.of(grid) / np.sqrt(information)
    contrast = numerator / information
    for ours, theirs in ((contrast, detection.contrast), (error, detection.error)):
        ours[rows, columns] = theirs
    calibration = np.zeros((2, len(sources)))
    star = detection.fits[0].frames[0]
    fitted = detection.scatter * float(star.errors["flux"][0]) / star.flux
    calibration[0] = np.hypot(fitted, star_flux_error(detection.fits[0]))
    table = candidate_table(sources, factor, calibration, detection.sky)
    # As in the table, the highest S/N first.
    order = np.argsort(-sources.snr(factor))
    inner = detection.candidates.copy()
    chi2 = np.array([each.chi2 for each in measured]) / factor.of(sources.offsets) ** 2
    inner["fit_chi2"], table["fit_chi2"] = np.nan, chi2[order]
    table["false_alarm_probability"] = np.nan
    tables = [each for each in (inner, table) if len(each)]
    joined = vstack(tables, metadata_conflicts="silent") if tables else table
    joined["fit_chi2"].info.description = (
        "reduced chi-squared of the source's image, over the squared error factor; much above 1 "
        "for extended and blended sources"
    )
    joined.meta = dict(detection.candidates.meta)
    return WideField(
        detection,
        threshold,
        contrast,
        error,
        contrast / error,
        grid,
        factor,
        joined[np.argsort(-np.asarray(joined["snr"]))],
        _curve(detection, error, information, grid, window, factor),
        tuple(frame.light(*_light_of(measured)) for frame in frames),
    )


def require_outer_pixels(observation: Observation, size: int) -> None:
    """Refuse a frame of which a search beyond the fitted square leaves no pixel.

    Parameters
    ----------
    observation : Observation
    size : int
        Side of the fitted square, pixels.

    Raises
    ------
    IncompatibleSetupError
    """
    ny, nx = observation.shape
    if max(ny, nx) <= size + 2 * _EDGE or min(ny, nx) <= 2 * _EDGE:
        raise IncompatibleSetupError(
            f"wide: got {ny} x {nx} pixels in {observation.name}, expected more than "
            f"{size + 2 * _EDGE} along an axis and {2 * _EDGE} along the other: beyond the {size} "
            f"fitted ones, {_EDGE} at every edge are not searched. Choose a smaller size, or leave "
            "out wide"
        )


def _frames(detection: Detection, observations: Sequence[Observation]) -> list[WholeFrame]:
    if len(detection.fits) != 1:
        raise IncompatibleSetupError(
            f"detection: got one of {len(detection.fits)} fits, expected one of a single fit"
        )
    fitted = [each for each in detection.fits[0].frames if not each.observation.reference]
    names = [each.observation.name for each in fitted]
    if [each.name for each in observations] != names:
        raise IncompatibleSetupError(
            f"observations: got {[each.name for each in observations]}, expected those of the fit, "
            f"{names}, before they were cut"
        )
    known = detection.sources
    inside = np.column_stack([known.contrasts.numpy(), known.offsets.numpy()])
    return [
        WholeFrame(fit, each, each.roll_from(observations[0]), inside)
        for fit, each in zip(fitted, observations, strict=True)
    ]


def _window(detection: Detection, first: WholeFrame) -> tuple[slice, slice]:
    """Rows and columns of the detection's pixels in the first whole frame."""
    column, row = np.rint(first.pixels_of(detection.grid[0, 0])).astype(int)
    ny, nx = detection.snr.shape
    whole_ny, whole_nx = first.observation.shape
    if column < 0 or row < 0 or column + nx > whole_nx or row + ny > whole_ny:
        raise IncompatibleSetupError(
            f"observations: the {nx} x {ny} fitted pixels are not inside the {whole_nx} x "
            f"{whole_ny} pixels of {first.observation.name}. Give the frames before they were cut"
        )
    return slice(row, row + ny), slice(column, column + nx)


def _search(
    frames: Sequence[WholeFrame],
    outer: NDArray[np.bool_],
    grid: Image,
    threshold: float,
    detection: Detection,
) -> tuple[Image, list[_Measurement], ErrorFactor]:
    """Information of contrasts, the sources, and the error factor.

    The highest peak is fitted and subtracted, until none is left: sources have side lobes.
    """
    resolution = detection.contrast_curve.meta["resolution_arcsec"]
    known = detection.sources.offsets.numpy()
    significance = Significance(
        grid,
        np.mean([frame.on_first(grid, (frame.starlight,))[0] for frame in frames], axis=0),
        frames[0].correlation,
        float(separation_of(grid)[outer].min()),
        resolution,
    )
    sources: list[_Measurement] = []
    while True:
        images = [frame.residual - frame.light(*_light_of(sources)) for frame in frames]
        products = [
            f.on_first(grid, f.products(image)) for f, image in zip(frames, images, strict=True)
        ]
        numerator, information = (np.sum(each, axis=0) for each in zip(*products, strict=True))
        information = np.where(outer & (information > 0), information, np.nan)
        snr = numerator / np.sqrt(information)
        places = np.concatenate([known, _light_of(sources)[0]])
        factor = significance.factor(snr, places)
        allowed = np.isfinite(snr) & far_from(grid, places, resolution)
        for source in sources:
            # The subtraction of a bright source leaves residuals.
            near = separation_of(grid - source.values[1:]) < _LOBES
            allowed &= ~near | (snr > _LEFT * source.snr)
        peak = significance.next_peak(snr, places, threshold, allowed)
        if peak is None or len(sources) >= _MOST:
            break
        contrast = float(numerator[peak] / information[peak])
        fitted = _measured(frames, images, grid[peak], contrast)
        if fitted is None or separation_of(fitted.values[1:] - grid[peak]) > resolution:
            # No point source: its fit fails or leads elsewhere.
            outer = outer & far_from(grid, torch.from_numpy(grid[peak][None]), resolution)
            continue
        sources.append(fitted)
    if len(sources) >= _MOST:
        _log.warning("more than %d sources in the whole field; the fainter are left out", _MOST)
    return information, _significant(frames, _refined(frames, sources), factor, threshold), factor


def _light_of(sources: Sequence[_Measurement]) -> tuple[Image, Image]:
    """Positions (k, 2) and contrasts (k,)."""
    values = np.array([each.values for each in sources]).reshape(-1, 3)
    return values[:, 1:], values[:, 0]


def _refined(frames: Sequence[WholeFrame], sources: list[_Measurement]) -> list[_Measurement]:
    """Fit every source once more, with all others subtracted."""
    for k, source in enumerate(sources):
        others = _light_of([*sources[:k], *sources[k + 1 :]])
        images = [frame.residual - frame.light(*others) for frame in frames]
        fitted = _measured(frames, images, source.values[1:], source.values[0])
        sources[k] = source if fitted is None else fitted
    return sources


def _significant(
    frames: Sequence[WholeFrame],
    sources: list[_Measurement],
    factor: ErrorFactor,
    threshold: float,
) -> list[_Measurement]:
    """Leave out sources that are faint in a fit beside all others, and fit the rest again.

    Peaks of a background that was not subtracted look like sources one by one.
    """
    while True:
        scatter = factor.at(separation_of(_light_of(sources)[0]))
        kept = [
            each for each, by in zip(sources, scatter, strict=True) if each.snr >= threshold * by
        ]
        if len(kept) == len(sources):
            return kept
        sources = _refined(frames, kept)


def _measured(
    frames: Sequence[WholeFrame], images: Sequence[Image], offset: Image, contrast: float
) -> _Measurement | None:
    """Fit a source in every frame and average; None if it is in none of them."""
    fits = [f.photometry(i, offset, contrast) for f, i in zip(frames, images, strict=True)]
    usable = [each for each in fits if each is not None]
    if not usable:
        return None
    weights = np.array([errors**-2.0 for _, errors, _ in usable])
    values = np.array([each for each, _, _ in usable])
    return _Measurement(
        (weights * values).sum(axis=0) / weights.sum(axis=0),
        weights.sum(axis=0) ** -1.0,
        float(np.mean([chi2 for _, _, chi2 in usable])),
    )


def _candidates(sources: Sequence[_Measurement]) -> Candidates:
    places, contrasts = _light_of(sources)
    variance = np.array([each.variance for each in sources]).reshape(-1, 3)
    return replace(
        Candidates.at(places, contrasts),
        covariance=torch.diag(torch.from_numpy(variance.T.flatten())),
        # Flux and position of a symmetric image hardly depend on each other.
        detection_errors=torch.from_numpy(np.sqrt(variance[:, 0])),
    )


def _curve(
    detection: Detection,
    error: Image,
    information: Image,
    grid: Image,
    window: tuple[slice, slice],
    factor: ErrorFactor,
) -> QTable:
    """Limits from the star to the edge, as far as half of a ring is in the frame."""
    photon = np.where(information > 0, information, np.nan) ** -0.5
    photon[window] = detection.photon_error
    inner = detection.contrast_curve["separation"].to_value("arcsec")
    outer = np.arange(inner[-1] + _STEP, separation_of(grid).max(), _STEP)
    rings = ring_pixels(grid, np.concatenate([inner, outer]), most=error.size)
    pixel = abs(grid[0, 1, 0] - grid[0, 0, 0])
    kept, errors, photons = [], [], []
    for separation, ring in zip(np.concatenate([inner, outer]), rings, strict=True):
        valid = np.isfinite(error[ring])
        if valid.sum() * pixel < _COVERED * 2 * np.pi * separation:
            continue
        kept.append(separation)
        errors.append(error[ring][valid])
        photons.append(photon[ring][valid])
    return contrast_table(
        np.array(kept),
        errors,
        photons,
        detection.contrast_curve.meta["resolution_arcsec"],
        _joined(detection.error_factor, factor, window),
        detection.sky.star_jansky,
    )


def _joined(inner: ErrorFactor, outer: ErrorFactor, window: tuple[slice, slice]) -> ErrorFactor:
    """The inner factor in the fitted pixels, the outer one elsewhere."""
    factors, freedom = outer.factors.copy(), outer.freedom.copy()
    factors[window], freedom[window] = inner.factors, inner.freedom
    return ErrorFactor(factors, freedom, outer.grid)
