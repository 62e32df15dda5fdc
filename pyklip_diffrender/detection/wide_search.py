"""Search for point sources in whole frames, far outside the pixels that a fit takes."""

from __future__ import annotations

import itertools
import logging
import math
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from astropy import units as u
from astropy.io import fits
from astropy.table import QTable, vstack
from numpy.typing import NDArray
from scipy.ndimage import label, map_coordinates
from scipy.optimize import least_squares
from scipy.sparse.csgraph import connected_components

from pyklip_diffrender.detection.candidates import Candidates, with_position_of_star
from pyklip_diffrender.detection.detection_file import image_hdu
from pyklip_diffrender.detection.error_factor import ErrorFactor, Significance, contrast_table
from pyklip_diffrender.detection.field import (
    Image,
    far_from,
    ring_pixels,
    separation_of,
)
from pyklip_diffrender.detection.measurement import candidate_table, in_words
from pyklip_diffrender.detection.search_result import Detection, draw_search
from pyklip_diffrender.detection.whole_frame import EDGE, REACH, WholeFrame
from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.io.files import require_new, write_fits, write_table
from pyklip_diffrender.io.tables import add_columns
from pyklip_diffrender.refinement import star_flux_error
from pyklip_diffrender.scene.observation import Observation
from pyklip_diffrender.scene.product_headers import primary_hdu, world_coordinates
from pyklip_diffrender.scene.simulation import within_field

# The result of a search of whole frames.


@dataclass(frozen=True, eq=False)
class WideField:
    """Sources in whole frames.

    About the star the maps are taken from the `Detection`, with the star marginalised. Elsewhere
    they come from a matched filter on the frames without the star, extrapolated from its fit,
    and without the background. Images have the first frame's pixels.

    Attributes
    ----------
    detection : Detection
        The search of the pixels about the star.
    threshold : float
        Smallest S/N of a candidate.
    contrast, error, snr : ndarray, (ny, nx)
        As in `Detection`; NaN where nothing is known.
    grid : ndarray, (ny, nx, 2)
        x, y of the pixels from the star, arcsec.
    error_factor : ErrorFactor
        Factor by which errors outside the fitted pixels were multiplied.
    candidates : QTable
        Candidates, highest S/N first, including the detection's; columns as in
        `Detection.candidates`, and fit_chi2, shape, fwhm_major, fwhm_minor and axis_angle. An
        extended source, or several that are blended, are one row with the contrast of all of its
        light.
    contrast_curve : QTable
        See `contrast_curve`.
    light : tuple of ndarray, (ny, nx)
        Light of the sources outside the fitted pixels in every frame, in the data's unit.

    Examples
    --------
    With frames and OPD maps in folders, which the package does not contain:

    >>> import pyklip_diffrender as dr
    >>> result = dr.reduce("calints", "maps", wide=True)  # doctest: +SKIP
    >>> print(result.wide)  # doctest: +SKIP
    """

    detection: Detection
    threshold: float
    contrast: Image
    error: Image
    snr: Image
    grid: Image
    error_factor: ErrorFactor
    candidates: QTable
    contrast_curve: QTable
    light: tuple[Image, ...] = ()

    def __repr__(self) -> str:
        ny, nx = self.snr.shape
        return f"<WideField: {nx} x {ny} pixels, {len(self.candidates)} candidates>"

    def __str__(self) -> str:
        """The candidates in words, at most 80 columns wide."""
        return in_words(self.candidates, self.threshold)

    @property
    def observation(self) -> Observation:
        """The first frame, as far as it was fitted."""
        return self.detection.observation

    def subtracted(
        self, whole: Sequence[Observation], cut: Sequence[Observation]
    ) -> tuple[Observation, ...] | None:
        """The fitted pixels without the light of sources outside them.

        Parameters
        ----------
        whole, cut : sequence of Observation
            All frames, and the cutouts that were fitted.

        Returns
        -------
        tuple of Observation or None
            None if there is too little of that light to be seen.
        """
        cleaned, seen = [], 0.0
        for light, frame, part in zip(self.light, map(within_field, whole), cut, strict=True):
            column, row = np.rint(frame.center[0] - part.center[0]).astype(int)
            ny, nx = part.shape
            inside = light[row : row + ny, column : column + nx]
            combined = part.combined()
            ratio = np.where(combined.valid[0], inside / combined.error[0], 0.0)
            seen = max(seen, float(np.sqrt((ratio**2).sum())))
            cleaned.append(replace(part, data=part.data - inside))
        return tuple(cleaned) if seen > self.threshold else None

    def plot(self, ax: Any = None) -> NDArray[Any]:
        """Draw the S/N map with the candidates, and the contrast curve.

        North is up, or +y of the first frame where its orientation is not known. The candidates are
        numbered as in the table.

        Parameters
        ----------
        ax : two Axes, optional
            Axes to draw in; a new figure by default.

        Returns
        -------
        ndarray of Axes, (2,)
        """
        return draw_search(ax, self, [str(k) for k in range(1, len(self.candidates) + 1)])

    def write(self, folder: str | os.PathLike[str], *, overwrite: bool = False) -> list[Path]:
        """Write wide_field.fits (maps), and candidates and contrast curve as ECSV tables.

        Raises
        ------
        ExistingFileError
            If one of the files exists, and `overwrite` is False; it is also an `OSError`.
        """
        folder = Path(folder)
        tables = {
            folder / "wide_field_candidates.ecsv": self.candidates,
            folder / "wide_field_contrast.ecsv": self.contrast_curve,
        }
        written = [folder / "wide_field.fits", *tables]
        require_new(written, overwrite)
        about = self.detection
        wcs = world_coordinates(self.grid, self.observation)
        hdus = fits.HDUList(
            [
                primary_hdu(self.observation, about.provenance, about.sky.mjd),
                image_hdu(self.snr, "SNR", "", wcs),
                image_hdu(self.contrast, "CONTRAST", "", wcs),
                image_hdu(self.error, "CONTRAST_ERROR", "", wcs),
                image_hdu(self.grid[..., 0], "OFFSET_X", "arcsec", wcs),
                image_hdu(self.grid[..., 1], "OFFSET_Y", "arcsec", wcs),
            ]
        )
        write_fits(hdus, written[0])
        for path, table in tables.items():
            write_table(table, path, about.provenance)
        return written


# Search of the whole frames, seamless with the search of the pixels about the star.

_log = logging.getLogger(__name__)

_MOST_SOURCES = 50
"""Largest number of sources."""

_SUBTRACTION_LOBES_ARCSEC = 1.5
"""arcsec from a source within which a peak may be what its subtraction left."""

_LEFT_SNR_RATIO = 0.1
"""Largest part of a source's S/N that it may leave."""

_BLENDED_SADDLE_RATIO = 0.5
"""Part of the fainter peak's S/N that the map has everywhere between two sources that are blended:
of two point sources, those less than about two lambda/D apart."""

_POINT_SOURCE_CHI2 = 2.0
"""Reduced chi-squared, over the squared error factor, up to which a source is fitted
as a point source only."""

_SHAPE_CHI2_GAIN = 25.0
"""Decrease of chi-squared, over the squared error factor, by the shape of an extended source."""

_SMALLEST_FWHM_LAMBDA_D = 0.5
"""Smallest full width at half maximum of an extended source, lambda/D. Errors of the image of a
point source make bright ones slightly narrower or wider."""

_COVERED_SIGMAS = 3.0
"""Standard deviations of an extended source, with the width of a point source, within which peaks
are parts of it."""

_FWHM_SIGMAS = math.sqrt(8 * math.log(2))
"""Full width at half maximum of a Gaussian, in standard deviations."""

_FITTED_ABOUT_SOURCE_PIXELS = 4
"""Pixels about a source that are fitted with it."""

_CURVE_STEP_ARCSEC = 0.1
"""Distance between the separations of the contrast curve, arcsec."""

_COVERED_RING_SHARE = 0.5
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


@dataclass(frozen=True, eq=False)
class _Shape:
    """Covariance of a Gaussian, arcsec^2 along x and y of the first frame."""

    covariance: Image

    @property
    def major(self) -> float:
        """Full width at half maximum along the long axis, arcsec."""
        return float(_FWHM_SIGMAS * np.sqrt(np.linalg.eigvalsh(self.covariance)[1]))

    @property
    def minor(self) -> float:
        """Full width at half maximum along the short axis, arcsec."""
        return float(_FWHM_SIGMAS * np.sqrt(max(np.linalg.eigvalsh(self.covariance)[0], 0.0)))

    @property
    def angle(self) -> float:
        """Angle of the long axis, counter-clockwise from +y, degrees."""
        x, y = np.linalg.eigh(self.covariance)[1][:, 1]
        return float(np.degrees(np.arctan2(-x, y)))


@dataclass(frozen=True, eq=False)
class _Source:
    """A source with the reduced chi-squared of a point source, and its shape if it is none."""

    measurement: _Measurement
    chi2: float
    shape: _Shape | None = None

    def covers(self, places: Image, resolution: float) -> NDArray[np.bool_]:
        """Whether places (k, 2) are within three standard deviations of an extended source."""
        if self.shape is None:
            return np.zeros(len(places), dtype=bool)
        seen = self.shape.covariance + (resolution / _FWHM_SIGMAS) ** 2 * np.eye(2)
        away = places - self.measurement.values[1:]
        squared = np.einsum("ki,ij,kj->k", away, np.linalg.inv(seen), away)
        return np.asarray(squared < _COVERED_SIGMAS**2)


def wide_field(detection: Detection, observations: Sequence[Observation]) -> WideField:
    """Search whole frames for point sources, at most in the field of the mask, 20 arcsec wide.

    Parameters
    ----------
    detection : Detection
        Search of a fit whose frames are cutouts of the observations.
    observations : sequence of Observation
        The target's frames before they were cut, in the order of the fit.

    Returns
    -------
    WideField

    Raises
    ------
    IncompatibleSetupError
        For observations that were not fitted.

    Examples
    --------
    With frames and OPD maps in folders, which the package does not contain:

    >>> import pyklip_diffrender as dr
    >>> frame = dr.Observation.from_fits("roll1_calints.fits")  # doctest: +SKIP
    >>> fit = dr.refine(dr.model_for(frame, 80), frame.cutout(80), "opd.fits")  # doctest: +SKIP
    >>> wide = dr.detection.wide_field(dr.detect(fit), [frame])  # doctest: +SKIP
    """
    threshold = detection.threshold
    frames = _frames(detection, observations)
    grid = frames[0].grid
    window = _window(detection, frames[0])
    rows, columns = window
    outer = frames[0].searches(grid)
    outer[rows, columns] = False
    if not outer.any():
        require_outer_pixels(observations[0], len(detection.grid))
    information, measured, factor, snr = _search(frames, outer, grid, threshold, detection)
    rows_of = _sources(frames, measured, snr, factor, detection)
    # The star's displacement is evaluated at half the height of the fitted frame.
    halfway = torch.tensor([0.0, float(np.abs(detection.grid[..., 1]).max()) / 2])
    found = [each.measurement for each in rows_of]
    sources = with_position_of_star(detection.templates, _candidates(found), halfway.double())
    numerator, _ = _products(frames, [each.residual for each in frames], grid)
    error = factor.of(grid) / np.sqrt(information)
    contrast = numerator / information
    for ours, theirs in ((contrast, detection.contrast), (error, detection.error)):
        ours[rows, columns] = theirs
    calibration = np.zeros((2, len(sources)))
    star = detection.fit.frames[0]
    fitted = detection.scatter * float(star.errors["flux"][0]) / star.flux
    calibration[0] = np.hypot(fitted, star_flux_error(detection.fit))
    table = candidate_table(sources, factor, calibration, detection.sky)
    # As in the table, the highest S/N first.
    order = np.argsort(-sources.snr(factor))
    inner = detection.candidates.copy()
    table["false_alarm_probability"] = np.nan
    scale = factor.of(sources.offsets) ** 2
    _add_shapes(inner, [None] * len(inner), np.full(len(inner), np.nan), detection)
    _add_shapes(
        table,
        [rows_of[k] for k in order],
        (np.array([each.chi2 for each in rows_of]) / scale)[order],
        detection,
    )
    tables = [each for each in (inner, table) if len(each)]
    joined = vstack(tables, metadata_conflicts="silent") if tables else table
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
    """Refuse a frame without pixels to search beyond the fitted square of side `size`.

    Raises `IncompatibleSetupError`.
    """
    ny, nx = observation.shape
    if max(ny, nx) <= size + 2 * EDGE or min(ny, nx) <= 2 * EDGE:
        raise IncompatibleSetupError(
            f"wide: got {ny} x {nx} pixels in {observation.name}, expected more than "
            f"{size + 2 * EDGE} along an axis and {2 * EDGE} along the other: beyond the {size} "
            f"fitted ones, {EDGE} at every edge are not searched. Choose a smaller size, or leave "
            "out wide"
        )


def _frames(detection: Detection, observations: Sequence[Observation]) -> list[WholeFrame]:
    fitted = [each for each in detection.fit.frames if not each.observation.reference]
    names = [each.observation.name for each in fitted]
    if [each.name for each in observations] != names:
        raise IncompatibleSetupError(
            f"observations: got {[each.name for each in observations]}, expected the fitted ones, "
            f"{names}, before they were cut"
        )
    known = detection.sources
    inside = np.column_stack([known.contrasts.numpy(), known.offsets.numpy()])
    return [
        WholeFrame(fit, within_field(each), each.roll_from(observations[0]), inside)
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
) -> tuple[Image, list[_Measurement], ErrorFactor, Image]:
    """Information of contrasts, the sources, the error factor, and the S/N with all sources.

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
    whole: Image | None = None
    while True:
        images = [frame.residual - frame.light(*_light_of(sources)) for frame in frames]
        numerator, information = _products(frames, images, grid)
        information = np.where(outer & (information > 0), information, np.nan)
        snr = numerator / np.sqrt(information)
        whole = snr if whole is None else whole
        places = np.concatenate([known, _light_of(sources)[0]])
        factor = significance.factor(snr, places)
        allowed = np.isfinite(snr) & far_from(grid, places, resolution)
        for source in sources:
            # The subtraction of a bright source leaves residuals.
            near = separation_of(grid - source.values[1:]) < _SUBTRACTION_LOBES_ARCSEC
            allowed &= ~near | (snr > _LEFT_SNR_RATIO * source.snr)
        peak = significance.next_peak(snr, places, threshold, allowed)
        if peak is None or len(sources) >= _MOST_SOURCES:
            break
        contrast = float(numerator[peak] / information[peak])
        fitted = _measured(frames, images, grid[peak], contrast)
        if fitted is None or separation_of(fitted.values[1:] - grid[peak]) > resolution:
            # No point source: its fit fails or leads elsewhere.
            outer = outer & far_from(grid, torch.from_numpy(grid[peak][None]), resolution)
            continue
        sources.append(fitted)
    if len(sources) >= _MOST_SOURCES:
        _log.warning(
            "more than %d sources in the whole field; the fainter are left out", _MOST_SOURCES
        )
    kept = _significant(frames, _refined(frames, sources), factor, threshold)
    return information, kept, factor, np.nan_to_num(whole)


def _products(
    frames: Sequence[WholeFrame], images: Sequence[Image], grid: Image
) -> tuple[Image, Image]:
    """Matched filter of images at the first frame's pixels, from where each frame is searched."""
    total = np.zeros((2, *grid.shape[:2]))
    for frame, image in zip(frames, images, strict=True):
        total += frame.searches(grid) * np.array(frame.on_first(grid, frame.products(image)))
    return total[0], total[1]


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
    fitted = [f.photometry(i, offset, contrast) for f, i in zip(frames, images, strict=True)]
    usable = [each for each in fitted if each is not None]
    if not usable:
        return None
    weights = np.array([errors**-2.0 for _, errors, _ in usable])
    values = np.array([each for each, _, _ in usable])
    return _Measurement(
        (weights * values).sum(axis=0) / weights.sum(axis=0),
        weights.sum(axis=0) ** -1.0,
        float(np.mean([chi2 for _, _, chi2 in usable])),
    )


def _sources(
    frames: Sequence[WholeFrame],
    parts: list[_Measurement],
    snr: Image,
    factor: ErrorFactor,
    detection: Detection,
) -> list[_Source]:
    """Sources with their shapes, each joined from the point sources that are parts of it.

    Sources whose middle is not where the first frame is searched are left out.
    """
    resolution = detection.contrast_curve.meta["resolution_arcsec"]
    labels = _blends(frames[0], parts, snr)

    def source(number: int) -> _Source:
        own = [each for each, k in zip(parts, labels, strict=True) if k == number]
        others = [each for each, k in zip(parts, labels, strict=True) if k != number]
        scale = float(factor.at(separation_of(_light_of(own)[0])).mean()) ** 2
        if len(own) == 1 and own[0].chi2 <= _POINT_SOURCE_CHI2 * scale:
            return _Source(own[0], own[0].chi2)
        images = [frame.residual - frame.light(*_light_of(others)) for frame in frames]
        return _shaped(frames, images, own, scale, resolution)

    places = _light_of(parts)[0]
    sources = {int(number): source(number) for number in np.unique(labels)}
    # The faint outskirts of an extended source may be a peak of their own.
    merged = True
    while merged:
        merged = False
        for number, each in sorted(sources.items(), key=lambda pair: -pair[1].measurement.snr):
            inside = each.covers(places, resolution) & (labels != number)
            if inside.any():
                swallowed = {int(k) for k in labels[inside]}
                labels[np.isin(labels, list(swallowed))] = number
                sources = {k: v for k, v in sources.items() if k not in swallowed}
                sources[number] = source(number)
                merged = True
                break
    kept = []
    for each in sources.values():
        place = each.measurement.values[1:]
        if frames[0].searches(place) and not _is_cut_off(frames[0], each.measurement):
            kept.append(each)
        else:
            _log.info("light at x, y = %.2f, %.2f arcsec is of a source at the edge", *place)
    return kept


def _is_cut_off(first: WholeFrame, source: _Measurement) -> bool:
    """Whether a source is blended with a brighter one outside the searched pixels, or its lobe."""
    column, row = np.rint(first.pixels_of(source.values[1:])).astype(int)
    numerator, information = first.products(first.residual)
    # Where all pixels about one are masked, the numerator is no number to divide.
    snr = np.divide(
        numerator, np.sqrt(information), out=np.zeros_like(numerator), where=information > 0
    )
    about = np.s_[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2]
    height = float(snr[about].max())
    outside = ~first.searches(first.grid)
    near = separation_of(first.grid - source.values[1:]) < _SUBTRACTION_LOBES_ARCSEC
    # The light of sources outside is not subtracted, and neither are their lobes.
    if (outside & near & (_BLENDED_SADDLE_RATIO * snr > height)).any():
        return True
    labels, _ = label(snr >= _BLENDED_SADDLE_RATIO * height)
    own = np.unique(labels[about])
    return bool((np.isin(labels, own[own > 0]) & outside & (snr > height)).any())


def _blends(first: WholeFrame, parts: Sequence[_Measurement], snr: Image) -> NDArray[np.intp]:
    """Label of the source to which each of the parts belongs, (parts,)."""
    places = first.pixels_of(_light_of(parts)[0])[:, ::-1]
    heights = map_coordinates(snr, places.T, order=1)
    linked = np.eye(len(parts), dtype=bool)
    for i, k in itertools.combinations(range(len(parts)), 2):
        steps = np.linspace(0, 1, 2 + int(2 * np.hypot(*(places[i] - places[k]))))
        path = places[i][:, None] * (1 - steps) + places[k][:, None] * steps
        between = map_coordinates(snr, path, order=1).min()
        linked[i, k] = between >= _BLENDED_SADDLE_RATIO * min(heights[i], heights[k])
    return np.asarray(connected_components(linked, directed=False)[1])


def _shaped(
    frames: Sequence[WholeFrame],
    images: Sequence[Image],
    parts: Sequence[_Measurement],
    scale: float,
    resolution: float,
) -> _Source:
    """Fit the image of a point source and of a Gaussian, and choose by chi-squared and width.

    `images` are the data of frames without other sources, and `parts` the point sources that make
    up this one. `scale` is the squared error factor, and `resolution` lambda/D, arcsec.
    """
    places, contrasts = _light_of(parts)
    total = contrasts.sum()
    middle = contrasts @ places / total
    extent = float(separation_of(places - middle).max())
    pixel = float(np.mean(frames[0].observation.pixelscale))
    size = 2 * min(_FITTED_ABOUT_SOURCE_PIXELS + math.ceil(extent / pixel), REACH // 2) + 1
    used = [(f, i) for f, i in zip(frames, images, strict=True) if f.searches(middle)]
    windows = [frame.window_about(middle, size) for frame, _ in used]
    renders = [frame.gaussian(window) for (frame, _), window in zip(used, windows, strict=True)]
    weights = [
        np.where(np.isinf(frame.sigma), 0.0, 1 / frame.sigma)[window]
        for (frame, _), window in zip(used, windows, strict=True)
    ]

    def residuals(values: Image) -> Image:
        # A covariance R R^T with a lower triangle R has no negative eigenvalue.
        root = np.zeros((2, 2))
        root[[0, 1, 1], [0, 0, 1]] = [*values[3:], 0, 0, 0][:3]
        left = [
            weight * (image[window] - values[0] * total * render(values[1:3], root @ root.T))
            for (_, image), window, weight, render in zip(
                used, windows, weights, renders, strict=True
            )
        ]
        return np.concatenate([each.ravel() for each in left])

    # Starting from the brightest part and from all of them.
    brightest = places[np.argmax(contrasts)]
    width = max(extent / 2, pixel / 2)
    point = least_squares(residuals, [1.0, *brightest], method="lm")
    wide = least_squares(residuals, [1.0, *middle, width, 0.0, width], method="lm")
    freedom = max(sum(int((weight > 0).sum()) for weight in weights) - 3, 1)
    root = np.array([[wide.x[3], 0.0], wide.x[4:6]])
    shape = _Shape(root @ root.T)
    gain = 2 * (point.cost - wide.cost)
    is_wide = gain > _SHAPE_CHI2_GAIN * scale and shape.major > _SMALLEST_FWHM_LAMBDA_D * resolution
    best = wide if is_wide else point
    unit = np.array([total, 1.0, 1.0])
    covariance = np.linalg.pinv(best.jac.T @ best.jac)[:3, :3]
    measurement = _Measurement(
        best.x[:3] * unit, covariance.diagonal() * unit**2, 2 * best.cost / freedom
    )
    return _Source(measurement, 2 * point.cost / freedom, shape if is_wide else None)


def _add_shapes(
    table: QTable, sources: Sequence[_Source | None], chi2: Image, detection: Detection
) -> None:
    """Add chi-squared of the point source and the shape to a table of sources.

    Sources in the fitted pixels, None, are not judged.
    """
    shapes = [None if each is None else each.shape for each in sources]
    kinds = ["" if s is None else "extended" if s.shape else "point" for s in sources]

    def numbers(values: Iterable[float]) -> Image:
        return np.array(list(values), dtype=float)

    long, short = (
        numbers(np.nan if each is None else getattr(each, name) for each in shapes)
        for name in ("major", "minor")
    )
    angles = numbers(np.nan if each is None else each.angle + detection.north for each in shapes)
    about = "full width at half maximum along the {} axis of an extended source, a Gaussian"
    add_columns(
        table,
        [
            ("fit_chi2", chi2, None, ".1f",
             "reduced chi-squared of the image of a point source, over the squared error factor; "
             "much above 1 for extended and blended sources"),
            ("shape", np.array(kinds, dtype="U8"), None, "",
             "point, or extended for a source that is no point source, or several that are "
             "blended; empty in the fitted pixels, where shapes are not judged"),
            ("fwhm_major", long, u.arcsec, ".2f", about.format("long")),
            ("fwhm_minor", short, u.arcsec, ".2f", about.format("short")),
            ("axis_angle", angles % 180, u.deg, ".0f",
             "position angle of the long axis, like position_angle"),
        ],
    )  # fmt: skip


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
    outer = np.arange(inner[-1] + _CURVE_STEP_ARCSEC, separation_of(grid).max(), _CURVE_STEP_ARCSEC)
    rings = ring_pixels(grid, np.concatenate([inner, outer]), most=error.size)
    pixel = abs(grid[0, 1, 0] - grid[0, 0, 0])
    kept, errors, photons = [], [], []
    for separation, ring in zip(np.concatenate([inner, outer]), rings, strict=True):
        valid = np.isfinite(error[ring])
        if valid.sum() * pixel < _COVERED_RING_SHARE * 2 * np.pi * separation:
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
