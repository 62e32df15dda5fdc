"""Searches of frames that were never fitted: maps of smooth noise with sources in them."""

import json

import numpy as np
import torch
from astropy.io import fits
from astropy.table import QTable
from scipy.ndimage import gaussian_filter, map_coordinates, spline_filter

from pyklip_diffrender.detection import Candidates, Detection
from pyklip_diffrender.detection.error_factor import ErrorFactor
from pyklip_diffrender.detection.field import Sky
from pyklip_diffrender.scene.observation import Observation

PIXEL = 0.063
SMOOTH = 1.2
"""Standard deviation, pixels, of the Gaussian with which white noise is smoothed. That of the
autocorrelation, and so of the image of a source in the map, is the root of two times that."""

RESOLUTION = 0.14
CURVATURE = 1 / (2 * (SMOOTH * PIXEL) ** 2)
"""Of the autocorrelation, per arcsec^2."""


def noise(seed, side):
    """Smooth noise of standard deviation 1, (side, side)."""
    white = np.random.default_rng(seed).normal(size=(side + 20, side + 20))
    # The sum of the squares of the kernel is 1 / (4 pi SMOOTH^2).
    smooth = 2 * np.sqrt(np.pi) * SMOOTH * gaussian_filter(white, SMOOTH, mode="wrap")
    return smooth[10:-10, 10:-10]


def shape_of(away):
    """Image of a source of height 1 in a map of S/N, for offsets (..., 2), arcsec."""
    return np.exp(-CURVATURE * (away**2).sum(axis=-1) / 2)


def found(filter, seed, sources, *, north=0.0, error=1e-6, side=61, threshold=5.0, **options):
    """A detection as a real search makes it: its own candidates, with errors, and what is left.

    `sources` are (east, north, S/N). Those above the threshold are candidates, with the place and
    the height that a fit in this noise has, to first order, and their light is taken off.
    """
    half = (side - 1) / 2
    y, x = (np.indices((side, side)) - half) * PIXEL
    grid = np.stack([x, y], axis=-1)
    quiet = noise(seed, side)
    angle = np.deg2rad(north)
    turn = np.array([[-np.cos(angle), np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    spline = spline_filter(quiet, order=5)
    snr, left, fitted = quiet.copy(), quiet.copy(), []
    for *place, height in sources:
        offset = turn.T @ place
        light = shape_of(grid - offset)
        snr = snr + height * light
        pixel = offset / PIXEL + half
        if not ((pixel >= 0) & (pixel <= side - 1)).all():
            continue

        def at(dx, dy, pixel=pixel):
            where = [[pixel[1] + dy], [pixel[0] + dx]]
            return map_coordinates(spline, where, order=5, prefilter=False)[0]

        measured = height + at(0, 0)
        if measured < threshold:
            left = left + height * light
            continue
        slope = np.array([at(0.1, 0) - at(-0.1, 0), at(0, 0.1) - at(0, -0.1)]) / (0.2 * PIXEL)
        moved = offset + slope / (CURVATURE * height)
        left = left + height * light - measured * shape_of(grid - moved)
        fitted.append((moved, measured))
    known = Candidates.at(np.zeros((0, 2)), np.zeros(0))
    if fitted:
        heights = np.array([each for _, each in fitted])
        deviations = np.repeat(1 / (np.sqrt(CURVATURE) * heights)[None], 2, axis=0)
        known = Candidates(
            torch.tensor(np.array([each for each, _ in fitted])),
            torch.tensor(error * heights),
            torch.diag(torch.tensor(np.append(np.full(len(heights), error), deviations) ** 2)),
            torch.full((len(heights),), error, dtype=torch.float64),
        )
    return made(snr, left, known, grid, filter, error=error, north=north, **options)


def searched(
    filter="F444W", seed=0, sources=(), *, mjd=60000.0, north=0.0, error=1e-6, side=41, star=1.0,
    status="CONVERGED", header=None, known=False, freedom=np.inf, factor=1.0,
):  # fmt: skip
    """A detection whose map has noise, and sources of an S/N at offsets to the east and north.

    With `known`, the sources are candidates of the search itself.
    """
    half = (side - 1) / 2
    y, x = (np.indices((side, side)) - half) * PIXEL
    grid = np.stack([x, y], axis=-1)
    angle = np.deg2rad(north or 0.0)
    turn = np.array([[-np.cos(angle), np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    quiet = noise(seed, side)
    snr = quiet.copy()
    offsets = np.array([turn.T @ source[:2] for source in sources]).reshape(-1, 2)
    for offset, source in zip(offsets, sources, strict=True):
        square = ((grid - offset) ** 2).sum(axis=-1) / (SMOOTH * PIXEL) ** 2
        snr += source[2] * np.exp(-square / 4)
    heights = np.array([source[2] for source in sources])
    own = Candidates.at(offsets, error * heights)
    if known and len(sources):
        own = Candidates(
            own.offsets, own.contrasts, own.covariance, torch.full((len(own),), error / factor)
        )
    none = Candidates.at(np.zeros((0, 2)), np.zeros(0))
    return made(
        snr, quiet if known else snr, own if known else none, grid, filter, mjd=mjd, north=north,
        error=error, star=star, status=status, header=header, freedom=freedom, factor=factor,
    )  # fmt: skip


def made(
    snr, residual, sources, grid, filter, *, mjd=60000.0, north=0.0, error=1e-6, star=1.0,
    status="CONVERGED", header=None, freedom=np.inf, factor=1.0,
):  # fmt: skip
    """A detection of maps of S/N, with and without its candidates."""
    errors = np.full(snr.shape, error)
    constant = ErrorFactor.constant(factor)
    freedoms = np.broadcast_to(freedom, snr.shape)
    measured = ErrorFactor(factor * np.ones(snr.shape), freedoms, grid)
    curve = QTable(
        {"separation": [0.5], "contrast": [5 * error]},
        meta={"sigmas": 5.0, "resolution_arcsec": RESOLUTION},
    )
    count = len(sources)
    detection = Detection(
        stored_fit=None, contrast=snr * errors, error=errors, photon_error=errors, snr=snr,
        residual_snr=residual,
        error_factor=measured if np.isfinite(freedoms).all() else constant,
        sources=sources, false_alarm=np.zeros(count), rings=QTable(), threshold=5.0,
        contrast_curve=curve, has_limits=np.ones(errors.shape, dtype=bool), grid=grid,
    )  # fmt: skip
    observation = Observation.from_arrays(
        snr, errors, pixelscale=PIXEL, filter=filter,
        position_angles=None if north is None else np.array([north]),
        header=fits.Header(header or {}),
    )  # fmt: skip
    sky = Sky(north, mjd, None if star is None else (star, 0.1 * star))
    vars(detection).update(
        observation=observation, sky=sky, provenance={"status": status}, rolls=1, subtracted=(),
        _wcs=(), _digest="", _calibration_errors=np.zeros((2, count)),
    )  # fmt: skip
    return detection


def write_searched(detection, folder):
    """Write the products of a reduction that a search over several reductions reads."""
    detection.write(folder)
    status = str(detection.provenance["status"])
    summary = {
        "target": detection.observation.target, "filter": detection.observation.filter,
        "oriented": True, "epoch_mjd": detection.sky.mjd, "first_date": detection.sky.date,
        "sentence": "No companion.", "candidates": [], "threshold_snr": detection.threshold,
        "contrast_curve": {"sigmas": 5.0, "separation_arcsec": [], "contrast": []},
        "status": {"name": status, "message": "converged", "advice": "Use it."},
    }  # fmt: skip
    (folder / "summary.json").write_text(json.dumps(summary), encoding="utf-8")
    (folder / "report.html").write_text("<p>report</p>", encoding="utf-8")
