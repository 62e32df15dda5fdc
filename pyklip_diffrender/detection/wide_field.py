"""Search of the whole frames, seamless with that of the pixels about the star."""

from __future__ import annotations

import logging
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from astropy.io import fits
from astropy.table import QTable, vstack
from numpy.typing import NDArray
from torch import Tensor

from pyklip_diffrender.detection.candidates import Candidates
from pyklip_diffrender.detection.contrast import contrast_table
from pyklip_diffrender.detection.error_factor import ErrorFactor, scatter_profile
from pyklip_diffrender.detection.field import Image, far_from, ring_pixels, separation_of
from pyklip_diffrender.detection.result import Detection
from pyklip_diffrender.detection.storage import image_hdu
from pyklip_diffrender.detection.tables import candidate_table
from pyklip_diffrender.detection.whole_frames import WholeFrame
from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.io.files import replacing, write_fits
from pyklip_diffrender.refinement.companions import local_maxima
from pyklip_diffrender.scene.observation import Observation

__all__ = ["WideField", "wide_field"]

_log = logging.getLogger(__name__)

_EDGE = 16
"""Pixels at the edge of the frame that are not searched: templates are cut off, and in the first rows
light scattered at the edge of the occulters' substrate appears in frames of every star."""

_MOST = 50
"""Largest number of sources."""

_STEP = 0.1
"""Distance between the separations of the contrast curve, arcsec."""

_COVERED = 0.5
"""Part of a ring that must be in the frame for a limit to be stated."""


@dataclass(frozen=True, eq=False)
class WideField:
    """Point sources in whole frames.

    About the star the maps are those of the `Detection`, with the star marginalised. Elsewhere
    they are those of a matched filter on the frames without the star, extrapolated from its fit,
    and without the background. Images have the first frame's pixels.

    Attributes
    ----------
    detection : Detection
        The search of the pixels about the star.
    contrast, error, snr : ndarray, (ny, nx)
        As those of `Detection`; NaN where nothing is known.
    grid : ndarray, (ny, nx, 2)
        x, y of the pixels from the star, arcsec.
    error_factor : ErrorFactor
        Factor by which errors outside the fitted pixels were multiplied.
    table : QTable
        Candidates, highest S/N first, those of the detection included; columns as in
        `Detection.table`, and fit_chi2.
    contrast_curve : QTable
        See `contrast.contrast_table`.
    """

    detection: Detection
    contrast: Image
    error: Image
    snr: Image
    grid: Image
    error_factor: ErrorFactor
    table: QTable
    contrast_curve: QTable

    def __repr__(self) -> str:
        ny, nx = self.snr.shape
        return f"<WideField: {nx} x {ny} pixels, {len(self.table)} candidates>"

    def write(self, folder: str | os.PathLike[str]) -> list[Path]:
        """Write wide_field.fits (maps), and candidates and contrast curve as ECSV tables."""
        folder = Path(folder)
        hdus = fits.HDUList(
            [
                fits.PrimaryHDU(),
                image_hdu(self.snr, "SNR", ""),
                image_hdu(self.contrast, "CONTRAST", ""),
                image_hdu(self.error, "CONTRAST_ERROR", ""),
                image_hdu(self.grid[..., 0], "OFFSET_X", "arcsec"),
                image_hdu(self.grid[..., 1], "OFFSET_Y", "arcsec"),
            ]
        )
        written = [folder / "wide_field.fits"]
        write_fits(hdus, written[0])
        for name, table in (("candidates", self.table), ("contrast", self.contrast_curve)):
            written.append(folder / f"wide_field_{name}.ecsv")
            with replacing(written[-1]) as temporary:
                table.write(temporary, format="ascii.ecsv", overwrite=True)
        return written


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
    """
    threshold = detection.threshold if threshold is None else threshold
    frames = _frames(detection, observations)
    grid = frames[0].grid
    window = _window(detection, frames[0])
    products = [frame.on_first(grid) for frame in frames]
    numerator, information = (sum(each) for each in zip(*products, strict=True))
    outer = np.ones(grid.shape[:2], dtype=bool)
    outer[_EDGE:-_EDGE, _EDGE:-_EDGE] = False
    outer = ~outer & (information > 0)
    rows, columns = window
    outer[rows, columns] = False
    safe = np.where(outer, information, np.nan)
    snr = numerator / np.sqrt(safe)
    sources, chi2, factor = _search(frames, snr, numerator / safe, grid, threshold, detection)
    error = factor.at(separation_of(grid)) / np.sqrt(safe)
    contrast = numerator / safe
    for ours, theirs in ((contrast, detection.contrast), (error, detection.error)):
        ours[rows, columns] = theirs
    calibration = np.zeros((2, len(sources)))
    star = detection.fits[0].frames[0]
    calibration[0] = float(star.errors["flux"][0]) / star.flux
    table = candidate_table(sources, factor, calibration, detection.sky)
    # As in the table, the highest S/N first.
    order = np.argsort(-_snr(sources, factor))
    inner = detection.table.copy()
    inner["fit_chi2"], table["fit_chi2"] = np.nan, chi2[order]
    tables = [each for each in (inner, table) if len(each)]
    joined = vstack(tables, metadata_conflicts="silent") if tables else table
    joined["fit_chi2"].info.description = (
        "reduced chi-squared of the source's image, over the squared error factor; much above 1 "
        "for extended and blended sources"
    )
    joined.meta = dict(detection.table.meta)
    return WideField(
        detection,
        contrast,
        error,
        contrast / error,
        grid,
        factor,
        joined[np.argsort(-np.asarray(joined["snr"]))],
        _curve(detection, error, information, grid, window, factor),
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
    return [
        WholeFrame(fit, each, each.roll_from(observations[0]))
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
    snr: Image,
    contrast: Image,
    grid: Image,
    threshold: float,
    detection: Detection,
) -> tuple[Candidates, Image, ErrorFactor]:
    """Sources outside the fitted pixels, the chi-squared of their images, the error factor."""
    resolution = detection.contrast_curve.meta["resolution_arcsec"]
    inner = float(np.nanmin(np.where(np.isfinite(snr), separation_of(grid), np.nan)))
    known = detection.candidates.offsets
    peaks: list[tuple[int, int]] = []
    while True:
        places = torch.from_numpy(np.array([grid[peak] for peak in peaks]).reshape(-1, 2))
        factor = scatter_profile(snr, grid, torch.cat([known, places]), inner, resolution)
        factor = factor.at_least(1.0)
        scaled = snr / factor.at(separation_of(grid))
        allowed = np.isfinite(scaled) & far_from(grid, torch.cat([known, places]), 2 * resolution)
        higher = local_maxima(np.nan_to_num(scaled), allowed, threshold, size=5)
        if not higher or len(peaks) >= _MOST:
            break
        peaks.append(higher[0])
    if len(peaks) >= _MOST:
        _log.warning("more than %d sources in the whole field; the fainter are left out", _MOST)
    offsets, contrasts = places.numpy(), np.array([contrast[peak] for peak in peaks])
    return *_measured(frames, offsets, contrasts, factor), factor


def _measured(
    frames: Sequence[WholeFrame], offsets: Image, contrasts: Image, factor: ErrorFactor
) -> tuple[Candidates, Image]:
    """Fit the sources in every frame, and average."""
    count = len(offsets)
    if not count:
        return Candidates.at(offsets, contrasts), np.zeros(0)
    total, weights, chi2 = np.zeros((count, 3)), np.zeros((count, 3)), []
    for frame in frames:
        fitted = frame.photometry(offsets, contrasts)
        pixels = np.stack([fitted["x_fit"], fitted["y_fit"]], axis=-1).astype(float)
        values = np.column_stack([fitted["flux_fit"], frame.offsets_of(pixels)])
        scale = np.abs(np.array(frame.fit.model.detector.pixelscale))
        errors = np.column_stack(
            [fitted["flux_err"], fitted["x_err"] * scale[0], fitted["y_err"] * scale[1]]
        ).astype(float)
        usable = np.isfinite(values).all(axis=1) & (errors > 0).all(axis=1)
        weight = np.where(usable[:, None], errors**-2.0, 0.0)
        total += np.where(weight > 0, weight * values, 0.0)
        weights += weight
        chi2.append(np.where(usable, np.asarray(fitted["reduced_chi2"], dtype=float), np.nan))
    seen: NDArray[np.bool_] = np.asarray((weights > 0).all(axis=1))
    mean = np.where(seen[:, None], total / np.where(weights > 0, weights, 1.0), 0.0)
    mean[~seen] = np.column_stack([contrasts, offsets])[~seen]
    variance = np.where(weights > 0, weights, np.nan) ** -1.0
    sources = replace(
        Candidates.at(mean[:, 1:], mean[:, 0]),
        covariance=torch.diag(torch.from_numpy(variance.T.flatten())),
    )
    return sources, np.nanmean(chi2, axis=0) / factor.of(sources.offsets) ** 2


def _snr(sources: Candidates, factor: ErrorFactor) -> Image:
    errors: Tensor = sources.errors[:, 0]
    return np.asarray(sources.contrasts.numpy() / (errors.numpy() * factor.of(sources.offsets)))


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
        _joined(detection.error_factor, factor, inner[-1]),
        detection.sky.star_jansky,
    )


def _joined(inner: ErrorFactor, outer: ErrorFactor, edge: float) -> ErrorFactor:
    """The inner factor up to the edge, the outer one beyond."""
    near, far = inner.separations <= edge, outer.separations > edge
    return ErrorFactor(
        np.concatenate([inner.separations[near], outer.separations[far]]),
        np.concatenate([inner.factors[near], outer.factors[far]]),
    )
