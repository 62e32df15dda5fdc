"""Figures of merit of the subtracted images, and the format of spreads.

The paper's annulus SNR, matched filters, the throughput of the planet, and the
error of the subtracted star. Spreads are medians with the 16 and 84
percentiles over noise realisations.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from astropy.table import Table
from methods import Subtracted
from scene import Frame, Image, Planet, Setting, Star

import pyklip_diffrender as dr
from pyklip_diffrender.detection.metrics import annulus_snr, throughput
from pyklip_diffrender.optics.point_sources import PointSources
from pyklip_diffrender.refinement import Refinement

FIELD = (0.3, 2.3)
"""Inner and outer radius of the region in which the star's error is measured, arcsec."""
AWAY = 0.4
"""Smallest distance from the planet of positions that measure the noise, arcsec."""

ORDER = ("initial", "KLIP", "KLIP, library", "Adam", "Gauss-Newton", "marginalised", "optimal")
COLOURS = {
    "initial": "#9a9a9a",
    "KLIP": "#2d7d46",
    "KLIP, library": "#8fbf6b",
    "Adam": "#c0631a",
    "Gauss-Newton": "#2a6fb0",
    "marginalised": "#5b3f95",
    "optimal": "#1b1f24",
}


def pixel(setup: Setting, offset: tuple[float, float]) -> tuple[float, float]:
    """x, y in pixels of a position relative to the star."""
    ny, nx = setup.model.detector.shape
    scale = setup.model.detector.pixelscale
    return (nx - 1) / 2 + offset[0] / scale[0], (ny - 1) / 2 + offset[1] / scale[1]


def separations(setup: Setting) -> Image:
    """Of every pixel from the star, arcsec."""
    ny, nx = setup.model.detector.shape
    scale = setup.model.detector.pixelscale
    y, x = np.indices((ny, nx))
    return np.hypot((x - (nx - 1) / 2) * scale[0], (y - (ny - 1) / 2) * scale[1])


def star_error(setup: Setting, shot: Frame, image: Image) -> float:
    """Rms of (subtracted star - true star) / noise, over `FIELD`.

    For KLIP, which has no model of the star, this includes the light that it took from the planet.
    """
    radius = separations(setup)
    ring = (radius >= FIELD[0]) & (radius <= FIELD[1]) & np.isfinite(image)
    return float(np.sqrt(np.mean(((shot.known_star - image) / shot.noise)[ring] ** 2)))


def paper_snr(setup: Setting, image: Image, planet: Planet) -> float:
    """The paper's annulus SNR."""
    return annulus_snr(image, pixel(setup, planet.offset), pixel(setup, (0.0, 0.0)))


def throughput_of(setup: Setting, shot: Frame, image: Image, empty: Image, which: int = 0) -> float:
    """Fraction of a planet's light that remains after a subtraction.

    `empty` is the image that the method returns for the same frame without the planet. It removes
    the noise and the residuals of the star.
    """
    planet, light = shot.planets[which]
    return throughput(image - empty, light, shot.noise, pixel(setup, planet.offset))


class Ring:
    """Matched filters at the planet's separation.

    Parameters
    ----------
    here : Setting
    shot : Frame
    which : int
        Index of the planet.
    """

    def __init__(self, setup: Setting, shot: Frame, which: int = 0) -> None:
        planet, light = shot.planets[which]
        scale = setup.model.detector.pixelscale
        ny, nx = setup.model.detector.shape
        y, x = np.indices((ny, nx))
        x, y = (x - (nx - 1) / 2) * scale[0], (y - (ny - 1) / 2) * scale[1]
        close = np.hypot(x - planet.offset[0], y - planet.offset[1]) < AWAY
        ring = np.abs(np.hypot(x, y) - planet.separation) <= scale[0] / 2
        rows, columns = np.nonzero(ring & ~close)
        with torch.no_grad():
            points = PointSources(setup.model, shot.opd).images(rows, columns)
        self.templates = np.concatenate([light[None] / planet.contrast, points.double().numpy()])
        self.templates[1:] *= Star().photons
        self.weight = 1 / shot.noise**2

    def amplitudes(self, image: Image) -> Image:
        """Contrasts at the planet (first) and elsewhere on the ring."""
        good = np.isfinite(image)
        weighed = self.templates[:, good] * self.weight[good]
        return (weighed @ image[good]) / (weighed * self.templates[:, good]).sum(axis=1)

    def noise(self, empty: Image) -> float:
        """Scatter of the amplitudes in the subtracted frame without the planet.

        At least the photon noise: a fit that follows some of the noise makes the ring smoother, but
        does not improve the measurement of the planet.
        """
        good = np.isfinite(empty)
        light = self.templates[0][good]
        photon = float((light**2 * self.weight[good]).sum()) ** -0.5
        return max(float(self.amplitudes(empty)[1:].std()), photon)

    def snr(self, image: Image, empty: Image) -> float:
        """Amplitude at the planet over `noise`."""
        middle = float(self.amplitudes(empty)[1:].mean())
        return (float(self.amplitudes(image)[0]) - middle) / self.noise(empty)


def best_snr(shot: Frame) -> float:
    """S/N of the matched filter for a known star, the highest possible."""
    light = shot.planets[0][1]
    weight = 1 / (shot.noise**2 + light)
    return float((weight * light * shot.known_star).sum() / math.sqrt((weight * light**2).sum()))


def photon_snr(shot: Frame) -> float:
    """Expected value of `best_snr`."""
    light = shot.planets[0][1]
    return math.sqrt(float((light**2 / (shot.noise**2 + light)).sum()))


def judge(
    setup: Setting,
    shot: Frame,
    subtracted: dict[str, Subtracted],
    empty: dict[str, Subtracted],
) -> list[dict[str, Any]]:
    """One row for each method.

    Parameters
    ----------
    here : Setting
    shot : Frame
        With one planet.
    left, empty : dict of str to Subtracted
        Subtracted images of every method, with and without the planet.
    """
    planet = shot.planets[0][0]
    ring = Ring(setup, shot)
    rows = []
    for name, result in subtracted.items():
        snr = ring.snr(result.image, empty[name].image)
        if name == "optimal":
            snr = best_snr(shot)
        rows.append(
            {
                "method": name,
                "annulus_snr": paper_snr(setup, result.image, planet),
                "matched_snr": snr,
                "throughput": throughput_of(setup, shot, result.image, empty[name].image),
                "star_error": star_error(setup, shot, result.image),
                "seconds": result.seconds,
            }
        )
    fit = subtracted["Gauss-Newton"].fit
    if fit is not None:
        rows.append(marginalised(setup, shot, fit)[0])
    return rows


def marginalised(setup: Setting, shot: Frame, fit: Refinement) -> tuple[dict[str, Any], Image]:
    """Measure the planet with the wavefront marginalised; also return the star-subtracted frame.

    The star is subtracted with the candidates of `detect` in the model. If the planet is not among
    them, the image has lost as much of its light as that of Gauss-Newton.
    """
    began = time.perf_counter()
    planet = shot.planets[0][0]
    detection = dr.detect(fit)
    measurement = detection.measure([planet.offset])[0]
    image = detection.subtracted[0]
    row = {
        "method": "marginalised",
        "annulus_snr": paper_snr(setup, image, planet),
        "matched_snr": float(measurement["snr"]),
        "throughput": float(measurement["contrast"]) / planet.contrast,
        "star_error": star_error(setup, shot, image),
        "seconds": fit.seconds + time.perf_counter() - began,
    }
    return row, image


# -- spreads -------------------------------------------------------------------------------------


def spread(values: Any) -> tuple[float, float, float]:
    """Median, 16 and 84 percentile of the values that are not NaN; NaN if there are none."""
    good = np.asarray(values, dtype=float)
    good = good[~np.isnan(good)]
    if not good.size:
        return math.nan, math.nan, math.nan
    # Infinite contrasts (a planet that is gone) count, but cannot be interpolated.
    how = "linear" if np.isfinite(good).all() else "nearest"
    middle, low, high = np.percentile(good, (50, 16, 84), method=how)
    return float(middle), float(low), float(high)


def median_and_spread(values: Any, form: str = ".1f") -> str:
    """Median and spread as text."""
    middle, low, high = spread(values)
    if math.isnan(middle):
        return ""
    return f"{middle:{form}} ({low:{form}} to {high:{form}})"


def select(table: Table, **conditions: Any) -> Table:
    """Rows where the named columns have these values."""
    mask = np.ones(len(table), dtype=bool)
    for name, value in conditions.items():
        column = table[name]
        # Contrasts are small numbers: no absolute tolerance. Tables have five digits.
        numbers = column.dtype.kind == "f"
        same = np.isclose(column, value, rtol=1e-4, atol=0) if numbers else column == value
        mask &= np.asarray(same)
    return table[mask]


def methods_in(table: Table) -> Sequence[str]:
    """Methods of a table, in the usual order."""
    names = set(table["method"])
    return [name for name in ORDER if name in names]


def psnr(image: Image, reference: Image, position: tuple[float, float], size: int = 11) -> float:
    """Peak signal-to-noise ratio in dB over `size` x `size` pixels about `position` (x, y)."""
    x, y = (round(c - (size - 1) / 2) for c in position)
    window = (slice(max(y, 0), y + size), slice(max(x, 0), x + size))
    error = float(np.mean((image[window] - reference[window]) ** 2))
    if error == 0:
        return math.inf
    return 10 * math.log10(float(reference[window].max()) ** 2 / error)
