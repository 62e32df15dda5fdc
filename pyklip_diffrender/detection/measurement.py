"""Measurements in the linear models of refined frames, and their tables."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator

import numpy as np
import torch
from astropy import units as u
from astropy.table import QTable
from numpy.typing import ArrayLike
from torch import Tensor

from pyklip_diffrender.detection.candidates import (
    Candidates,
    Maps,
    calibration_errors,
    without_light,
)
from pyklip_diffrender.detection.error_factor import ErrorFactor, Significance
from pyklip_diffrender.detection.field import (
    Image,
    Positions,
    Sky,
    deviations_and_correlation,
    require_inside,
    separation_of,
)
from pyklip_diffrender.detection.templates import Templates
from pyklip_diffrender.errors import ShapeError
from pyklip_diffrender.io.tables import Column, add_columns
from pyklip_diffrender.io.units import east_and_north, to_arcsec
from pyklip_diffrender.linear.model import LinearModel
from pyklip_diffrender.refinement import Refinement

_STAR_REFINEMENTS = 5
"""Largest number of refinements of the star for a bright extended source."""

_SETTLED_AMPLITUDE_SIGMAS = 0.2
"""The refinements end when its amplitude changes by less than this many standard deviations."""


def contrasts_at(
    templates: Templates, offsets: ArrayLike, factor: ErrorFactor
) -> tuple[QTable, Image]:
    """Contrasts of point sources at x, y (k, 2), one at a time; see `Detection.measure`.

    The table has x, y, contrast, contrast_error and snr, with errors multiplied by the factor of
    their position. The second result is (2, k), see `calibration_errors`.
    """
    places = torch.from_numpy(np.atleast_2d(to_arcsec(offsets, "offsets")))
    if places.ndim != 2 or places.shape[1] != 2:
        raise ShapeError(f"offsets: got shape {tuple(places.shape)}, expected (k, 2)")
    require_inside(places.numpy(), templates.grid)
    products = templates.linear.weigh(templates.at(places))
    factors = factor.of(places)
    error = factors / products.information.sqrt().numpy()
    contrast = (products.numerator / products.information).numpy()
    snr = contrast / error
    calibration = calibration_errors(
        templates, places, torch.from_numpy(snr), torch.from_numpy(factors)
    ).numpy()
    table = QTable(
        {
            "x": places[:, 0].numpy() * u.arcsec,
            "y": places[:, 1].numpy() * u.arcsec,
            "contrast": contrast,
            "contrast_error": np.hypot(error, contrast * calibration[0]),
            "snr": snr,
        }
    )
    return table, calibration


def measured_shape(
    templates: Templates, image: ArrayLike, scatter: float, relinearise: float
) -> tuple[float, float]:
    """Amplitude of an extended source and its error; see `Detection.measure_shape`."""
    light = np.ascontiguousarray(image, dtype=float)
    expected = templates.grid.shape[:2]
    if light.shape != expected:
        raise ShapeError(f"image: got {light.shape}, expected {expected}")
    shape = torch.from_numpy(light)
    amplitude, error = _amplitude(templates.linear, shape)
    total, bright = amplitude, amplitude > relinearise * error
    single_frame = len(templates.fit.frames) == 1
    factor = scatter
    # Light of a bright source biases the wavefront, and part of it is taken for the star. Without
    # the light that was found so far, the next amplitude is what is left.
    for _ in range(_STAR_REFINEMENTS if bright and single_frame else 0):
        fit = without_light(templates.fit, {0: total * light})
        amplitude, error = _amplitude(fit.star_only, shape)
        total += amplitude
        factor = 1.0 if fit.status.calibrated else scatter
        if abs(amplitude) < _SETTLED_AMPLITUDE_SIGMAS * error:
            break
    return total, factor * error


def _amplitude(linear: LinearModel, shape: torch.Tensor) -> tuple[float, float]:
    """Amplitude of an image in the first frame, and its standard deviation."""
    products = linear.weigh({0: shape[None]})
    information = float(products.information[0])
    return float(products.numerator[0]) / information, information**-0.5


def subtracted_frames(templates: Templates, candidates: Candidates) -> tuple[Image, ...]:
    """Star-subtracted frames of the fit; see `Detection.subtracted`."""
    images: list[Image] = []
    linear, light = templates.linear, candidates.light(templates)
    # Candidates are removed before the star is estimated, and added again afterwards.
    cleaned = linear.clean(light) if light else {}
    for k, frame in enumerate(linear.frames):
        residual = linear.cleaned[k]
        if cleaned:
            residual = residual - cleaned[k][0]
        image = residual / frame.weight + light.get(k, torch.zeros(1))[0]
        images.append(torch.where(frame.weight > 0, image, torch.nan).numpy())
    return tuple(images)


# Tables of candidates and of measurements, with what they mean on the sky.

_SNR = "contrast over its error for a known position, without calibration errors"

_AB_ZERO = float(u.AB.to(u.Jy))
"""Flux density of AB magnitude 0, Jy."""


def candidate_table(
    candidates: Candidates, factor: ErrorFactor, calibration: Image, sky: Sky
) -> QTable:
    """Make the table of candidates, highest S/N first; see `Detection.candidates`.

    `calibration` (2, k) has the relative calibration errors of their contrasts and of their fluxes,
    and the errors are multiplied by the factor.
    """
    count = len(candidates)
    contrast = candidates.contrasts.numpy()
    factors = factor.of(candidates.offsets)
    error = factors * candidates.errors.numpy()[:, 0]
    # Of the covariance of all candidates, each one's own part by contrast, x and y.
    shared = candidates.covariance.numpy().reshape(3, count, 3, count)
    covariance = factors[:, None, None] ** 2 * np.einsum("akbk->kab", shared)
    positions = Positions(candidates.offsets.numpy(), covariance[:, 1:, 1:], sky.north or 0.0)
    separation_error, angle_error, polar = deviations_and_correlation(positions.polar_covariance)
    x_error, y_error, _ = deviations_and_correlation(positions.covariance)
    contrast_error = np.hypot(error, contrast * calibration[0])
    columns: list[Column] = [
        *_place(positions, sky),
        *_photometry(contrast, contrast_error, np.hypot(error, contrast * calibration[1]), sky),
        ("snr", candidates.snr(factor), None, ".1f", _SNR),
        ("separation_error", separation_error, u.arcsec, ".4f", "standard deviation"),
        ("position_angle_error", angle_error, u.deg, ".2f", "standard deviation"),
        ("seppa_corr", polar, None, ".3f", "correlation of separation and position angle"),
        *_on_sky(positions, sky),
        *_correlations(covariance, contrast_error, sky),
        *_epoch(count, sky),
        ("frame_angle", positions.frame_angle, u.deg, ".2f",
         "counter-clockwise from +y of the first frame; its error is the position angle's"),
        ("x", positions.offsets[:, 0], u.arcsec, ".4f", "from the star on the first frame"),
        ("y", positions.offsets[:, 1], u.arcsec, ".4f", "from the star on the first frame"),
        ("x_error", x_error, u.arcsec, ".4f", "standard deviation"),
        ("y_error", y_error, u.arcsec, ".4f", "standard deviation"),
    ]  # fmt: skip
    table = _table(columns, first=("separation", "position_angle", "contrast", "snr"))
    return table[np.argsort(-table["snr"])]


def measured_table(raw: QTable, calibration: Image, sky: Sky, sigmas: float) -> QTable:
    """Complete the table of contrasts at given positions; see `Detection.measure`.

    `calibration` (2, k) is as for `candidate_table`, multiplied by the factor of all errors;
    `sigmas` is the S/N of a detection, below which an upper limit is stated.
    """
    offsets = np.stack([raw["x"].value, raw["y"].value], axis=1)
    positions = Positions(offsets, np.zeros((len(raw), 2, 2)), sky.north or 0.0)
    contrast, snr = (np.asarray(raw[name]) for name in ("contrast", "snr"))
    contrast_error = np.array(raw["contrast_error"])
    # The S/N is without calibration errors, and so is this error.
    error = np.divide(contrast, snr, out=contrast_error.copy(), where=snr != 0)
    limit = np.maximum(contrast, 0) + sigmas * contrast_error
    limit = np.where(snr < sigmas, limit, np.nan)
    about = f"contrast (at least 0) and {sigmas:g} errors; NaN where the S/N is {sigmas:g} or more"
    fluxes: list[Column] = []
    if sky.star is not None:
        jansky = limit * sky.star[0]
        fluxes = [("upper_limit_flux_density", jansky, u.Jy, ".3e", "of the upper limit")]
    columns: list[Column] = [
        ("x", raw["x"].value, u.arcsec, ".4f", "from the star on the first frame, as given"),
        ("y", raw["y"].value, u.arcsec, ".4f", "from the star on the first frame, as given"),
        *_photometry(contrast, contrast_error, np.hypot(error, contrast * calibration[1]), sky),
        ("snr", snr, None, ".1f", _SNR),
        ("upper_limit", limit, None, ".3e", about),
        ("upper_limit_delta_mag", magnitudes(limit)[0], u.mag, ".3f", "of the upper limit"),
        *fluxes,
        *_epoch(len(raw), sky),
        *_place(positions, sky),
        *[each for each in _on_sky(positions, sky) if each[0] in ("delta_ra", "delta_dec")],
    ]
    table = _table(columns, first=("x", "y", "contrast", "snr", "upper_limit"))
    table.meta["sigmas"] = sigmas
    return table


def in_words(table: QTable, threshold: float) -> str:
    """A table of candidates in lines of at most 80 characters."""
    lines = [
        f"{row['separation'].value:7.3f} +- {row['separation_error'].value:.3f} arcsec  "
        f"{row['position_angle'].value:6.2f} +- {row['position_angle_error'].value:.2f} deg  "
        f"{row['contrast']:.2e} +- {row['contrast_error']:.1e}  {row['snr']:5.1f}"
        for row in table
    ]
    title = "    separation             position angle     contrast               S/N"
    return "\n".join([title, *lines] if lines else [f"no candidate above S/N {threshold:g}"])


def magnitudes(ratio: Image, error: Image | None = None) -> tuple[Image, Image]:
    """Magnitudes of flux ratios and their errors; NaN for ratios that are not positive."""
    positive = np.where(ratio > 0, ratio, np.nan)
    errors = np.zeros_like(positive) if error is None else error
    return -2.5 * np.log10(positive), 2.5 / np.log(10) * errors / positive


def _place(positions: Positions, sky: Sky) -> Iterator[Column]:
    origin = "east of north" if sky.north is not None else (
        "counter-clockwise from +y of the first frame, whose orientation is not known"
    )  # fmt: skip
    yield "separation", positions.separation, u.arcsec, ".4f", "from the star"
    yield "position_angle", positions.position_angle, u.deg, ".2f", origin


def _on_sky(positions: Positions, sky: Sky) -> Iterator[Column]:
    if sky.north is None:
        return
    east, north = positions.on_sky.T
    east_error, north_error, correlation = deviations_and_correlation(positions.sky_covariance)
    yield "delta_ra", east, u.arcsec, ".4f", "offset to the east, dRA cos(Dec)"
    yield "delta_ra_error", east_error, u.arcsec, ".4f", "standard deviation"
    yield "delta_dec", north, u.arcsec, ".4f", "offset to the north"
    yield "delta_dec_error", north_error, u.arcsec, ".4f", "standard deviation"
    yield "radec_corr", correlation, None, ".3f", "correlation of delta_ra and delta_dec"


def _correlations(covariance: Image, contrast_error: Image, sky: Sky) -> Iterator[Column]:
    """Correlations with which errors of contrasts and offsets make a covariance (k, 3, 3).

    The covariance is of contrast, x and y; the error of the contrast has further parts.
    """
    turn, names = np.eye(3), ("x", "y")
    if sky.north is not None:
        turn[1:, 1:], names = east_and_north(sky.north), ("ra", "dec")
    else:
        *_, correlation = deviations_and_correlation(covariance[:, 1:, 1:])
        yield "xy_corr", correlation, None, ".3f", "correlation of x and y"
    turned = turn @ covariance @ turn.T
    for k, name in enumerate(names, 1):
        # Not known without errors, as are the other correlations.
        with np.errstate(invalid="ignore"):
            values = turned[:, 0, k] / (contrast_error * np.sqrt(turned[:, k, k]))
        about = f"correlation of contrast and {name if sky.north is None else f'delta_{name}'}"
        yield f"contrast_{name}_corr", values, None, ".3f", about


def _photometry(contrast: Image, error: Image, flux_error: Image, sky: Sky) -> Iterator[Column]:
    yield "contrast", contrast, None, ".3e", "flux over the star's, without coronagraph"
    yield "contrast_error", error, None, ".1e", "with errors of the star's flux and the image"
    magnitude, magnitude_error = magnitudes(contrast, error)
    yield "delta_mag", magnitude, u.mag, ".3f", "magnitude difference to the star"
    yield "delta_mag_error", magnitude_error, u.mag, ".3f", "standard deviation"
    if sky.star is None:
        return
    jansky, jansky_error = contrast * sky.star[0], flux_error * sky.star[0]
    yield "flux_density", jansky, u.Jy, ".3e", "in the photometric calibration of the frames"
    yield "flux_density_error", jansky_error, u.Jy, ".1e", "without the calibration's error"
    for system, zero in (("AB", _AB_ZERO), ("Vega", sky.vega)):
        if zero is not None:
            magnitude, magnitude_error = magnitudes(jansky / zero, jansky_error / zero)
            name = f"{system.lower()}_mag"
            yield name, magnitude, u.mag, ".3f", f"{system} magnitude of flux_density"
            yield f"{name}_error", magnitude_error, u.mag, ".3f", "without the calibration's error"


def _epoch(count: int, sky: Sky) -> Iterator[Column]:
    if sky.mjd is None:
        return
    about = "mean mid-exposure of the target's frames, UTC"
    yield "epoch_mjd", np.full(count, sky.mjd), None, ".5f", about
    yield "epoch", np.full(count, sky.date, dtype="U19"), None, "", about


def _table(columns: list[Column], first: tuple[str, ...]) -> QTable:
    """Table of columns, some of them first: a table too wide to print loses its middle."""
    ordered = sorted(columns, key=lambda each: first.index(each[0]) if each[0] in first else 99)
    return add_columns(QTable(), ordered)


# Errors and thresholds of a search, from the residuals of its fit.

_CHI2_RINGS_ARCSEC = (0.2, 0.6, 1.2, 2.0)
"""Separations between which chi-squared is stated, arcsec."""

_DEGENERATE_EIGENVALUE = 1e-6
"""Relative eigenvalue below which sources are degenerate with each other."""


def follows_scatter(fit: Refinement) -> bool:
    """Whether errors are multiplied by the scatter of the S/N, and not by chi-squared alone."""
    # On real frames, and where a fit does not explain its data, errors of the model that
    # neighbouring pixels share do not show in chi-squared.
    return not fit.status.calibrated or fit.frames[0].observation.is_nircam


def significance_of(
    maps: Maps, sources: Tensor, inner: float, scatter: float | None = None
) -> Significance:
    """Errors and thresholds of the S/N map of a fit, with sources at x, y, (k, 2), arcsec.

    `inner` is the smallest separation of a source, arcsec; `scatter` replaces the factor.
    """
    fit = maps.templates.fit
    measured = scatter is None and follows_scatter(fit)
    return Significance(
        maps.grid,
        maps.starlight,
        maps.correlation,
        inner,
        fit.model.resolution,
        error_inflation(maps.templates, sources) if scatter is None else scatter,
        measured,
        maps.structures if measured else 0.0,
    )


def default_factor(templates: Templates, sources: Candidates) -> ErrorFactor:
    """Factor for the errors of sources that were fitted together, as in a search."""
    if not follows_scatter(templates.fit):
        return ErrorFactor.constant(error_inflation(templates, sources.offsets))
    maps = Maps(templates)
    significance = significance_of(maps, sources.offsets, templates.fit.model.resolution)
    return significance.factor(maps.snr(maps.without(sources)), sources.offsets)


def error_inflation(templates: Templates, offsets: Tensor) -> float:
    """Square root of the reduced chi-squared with the light of sources removed, at least 1.

    The sources are at x, y, (k, 2), from the star, arcsec; some may coincide. It is 1 if the fit
    does not explain its data, because its noise then includes a model error.
    """
    fit = templates.fit
    if not fit.status.calibrated:
        return 1.0
    # Unmodelled structure in the residuals biases planet fluxes, so it inflates their errors.
    # Planets are not part of it: one of S/N 20 that is not removed would increase all errors by
    # 3 %. Therefore the sources are fitted together and removed first.
    companions = Candidates.of_fit(fit).offsets
    # A ratio, because robust fits give outliers less weight in their linear models.
    share = _reduced_chi2(templates, offsets) / _reduced_chi2(templates, companions)
    return math.sqrt(max(1.0, fit.reduced_chi2 * share))


def chi2_by_ring(templates: Templates, sources: Tensor, factor: ErrorFactor) -> QTable:
    """Chi-squared per pixel of the target's frames in rings about the star, without the sources.

    The table has inner and outer separation, arcsec, chi-squared per pixel, and the median error
    factor; `sources` are x, y, (k, 2), arcsec.
    """
    squares, distances = [], []
    residuals, _ = _residuals(templates, sources)
    for k, fitted in templates.frames.items():
        used = (templates.linear.frames[k].weight > 0).numpy()
        squares.append(residuals[k].numpy()[used] ** 2)
        distances.append(separation_of(fitted.grid)[used])
    square, distance = np.concatenate(squares), np.concatenate(distances)
    edges = [*(each for each in _CHI2_RINGS_ARCSEC if each < distance.max()), float(distance.max())]
    rows = []
    for low, high in itertools.pairwise(edges):
        ring = (distance >= low) & (distance <= high)
        if ring.any():
            rows.append((low, high, square[ring].mean(), float(factor.at((low + high) / 2))))
    inner, outer, chi2, factors = np.array(rows, dtype=float).reshape(-1, 4).T
    return add_columns(
        QTable(),
        [
            ("inner", inner, u.arcsec, ".2f", "smallest separation from the star"),
            ("outer", outer, u.arcsec, ".2f", "largest separation from the star"),
            ("chi2", chi2, None, ".2f", "per pixel, without the candidates"),
            ("error_factor", factors, None, ".2f", "by which errors were multiplied"),
        ],
    )


def _reduced_chi2(templates: Templates, offsets: Tensor) -> float:
    """Reduced chi-squared of the data after the sources and all unknowns are fitted."""
    pixels = sum(int((frame.weight > 0).sum()) for frame in templates.linear.frames)
    residuals, independent = _residuals(templates, offsets)
    chi2 = sum(float((part**2).sum()) for part in residuals)
    return chi2 / max(pixels - independent, 1)


def _residuals(templates: Templates, offsets: Tensor) -> tuple[list[Tensor], int]:
    """Whitened residuals of all frames, and the number of independent sources in them."""
    linear = templates.linear
    if not len(offsets):
        return list(linear.cleaned), 0
    images = templates.at(offsets)
    matrix, vector = linear.normal_equations(images)
    # Sources that coincide have equal images: the pseudo-inverse shares the light among them, and
    # the rank of the matrix is the number of unknowns that they are.
    contrasts = torch.linalg.pinv(matrix, rtol=_DEGENERATE_EIGENVALUE, hermitian=True) @ vector
    independent = int(torch.linalg.matrix_rank(matrix, rtol=_DEGENERATE_EIGENVALUE, hermitian=True))
    light = {k: torch.tensordot(contrasts, each, dims=1)[None] for k, each in images.items()}
    cleaned = linear.clean(light)
    return [each - cleaned[k][0] for k, each in enumerate(linear.cleaned)], independent
