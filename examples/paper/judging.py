"""How what a method leaves of the star is judged, and how spreads are shown.

The paper's annulus SNR, matched filters, the share of the planet's light that was kept, and the
distance of the subtracted star from the true one. Spreads are medians with the 16 and 84
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
from pyklip_diffrender.optics.fast.point_sources import PointSources
from pyklip_diffrender.refinement import Refinement

FIELD = (0.3, 2.3)
"""Inner and outer radius over which the star's error is taken, arcsec."""
AWAY = 0.4
"""Positions of a ring nearer to the planet say nothing about the noise, arcsec."""

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


def pixel(here: Setting, offset: tuple[float, float]) -> tuple[float, float]:
    """x, y in pixels of a position relative to the star."""
    ny, nx = here.model.detector.shape
    scale = here.model.detector.pixelscale
    return (nx - 1) / 2 + offset[0] / scale[0], (ny - 1) / 2 + offset[1] / scale[1]


def separations(here: Setting) -> Image:
    """Of every pixel from the star, arcsec."""
    ny, nx = here.model.detector.shape
    scale = here.model.detector.pixelscale
    y, x = np.indices((ny, nx))
    return np.hypot((x - (nx - 1) / 2) * scale[0], (y - (ny - 1) / 2) * scale[1])


def star_error(here: Setting, shot: Frame, image: Image) -> float:
    """Rms of (subtracted star - true star) / noise, over `FIELD`.

    For KLIP, which has no model of the star, what it took of the planet is part of it.
    """
    radius = separations(here)
    ring = (radius >= FIELD[0]) & (radius <= FIELD[1]) & np.isfinite(image)
    return float(np.sqrt(np.mean(((shot.known_star - image) / shot.noise)[ring] ** 2)))


def paper_snr(here: Setting, image: Image, planet: Planet) -> float:
    """The paper's annulus SNR."""
    return annulus_snr(image, pixel(here, planet.offset), pixel(here, (0.0, 0.0)))


def kept(here: Setting, shot: Frame, image: Image, empty: Image, which: int = 0) -> float:
    """Share of a planet's light that a subtraction kept.

    `empty` is what the method left of the same frame without the planet, so that neither the
    star's noise nor its remains count.
    """
    planet, light = shot.planets[which]
    return throughput(image - empty, light, shot.noise, pixel(here, planet.offset))


class Ring:
    """Matched filters at the planet's separation.

    Parameters
    ----------
    here : Setting
    shot : Frame
    which : int
        Which of its planets is looked at.
    """

    def __init__(self, here: Setting, shot: Frame, which: int = 0) -> None:
        planet, light = shot.planets[which]
        scale = here.model.detector.pixelscale
        ny, nx = here.model.detector.shape
        y, x = np.indices((ny, nx))
        x, y = (x - (nx - 1) / 2) * scale[0], (y - (ny - 1) / 2) * scale[1]
        near = np.hypot(x - planet.offset[0], y - planet.offset[1]) < AWAY
        ring = np.abs(np.hypot(x, y) - planet.separation) <= scale[0] / 2
        rows, columns = np.nonzero(ring & ~near)
        with torch.no_grad():
            points = PointSources(here.model, shot.opd).images(rows, columns)
        self.templates = np.concatenate([light[None] / planet.contrast, points.double().numpy()])
        self.templates[1:] *= Star().photons
        self.weight = 1 / shot.noise**2

    def amplitudes(self, image: Image) -> Image:
        """Contrasts at the planet (first) and elsewhere on the ring."""
        good = np.isfinite(image)
        weighed = self.templates[:, good] * self.weight[good]
        return (weighed @ image[good]) / (weighed * self.templates[:, good]).sum(axis=1)

    def noise(self, empty: Image) -> float:
        """Scatter of the amplitudes in what a method leaves of a frame without the planet.

        Not below the photon noise: a fit that follows the noise makes the ring smoother, but not
        the planet surer.
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
    """S/N of the matched filter that knows the star: nothing can do better."""
    light = shot.planets[0][1]
    weight = 1 / (shot.noise**2 + light)
    return float((weight * light * shot.known_star).sum() / math.sqrt((weight * light**2).sum()))


def photon_snr(shot: Frame) -> float:
    """Expected value of `best_snr`."""
    light = shot.planets[0][1]
    return math.sqrt(float((light**2 / (shot.noise**2 + light)).sum()))


def judged(
    here: Setting,
    shot: Frame,
    left: dict[str, Subtracted],
    empty: dict[str, Subtracted],
) -> list[dict[str, Any]]:
    """One row a method.

    Parameters
    ----------
    here : Setting
    shot : Frame
        With one planet.
    left, empty : dict of str to Subtracted
        What each method leaves, with and without the planet.
    """
    planet = shot.planets[0][0]
    ring = Ring(here, shot)
    rows = []
    for name, result in left.items():
        snr = ring.snr(result.image, empty[name].image)
        if name == "optimal":
            snr = best_snr(shot)
        rows.append(
            {
                "method": name,
                "annulus_snr": paper_snr(here, result.image, planet),
                "matched_snr": snr,
                "throughput": kept(here, shot, result.image, empty[name].image),
                "star_error": star_error(here, shot, result.image),
                "seconds": result.seconds,
            }
        )
    fit = left["Gauss-Newton"].fit
    if fit is not None:
        rows.append(marginalised(here, shot, fit)[0])
    return rows


def marginalised(here: Setting, shot: Frame, fit: Refinement) -> tuple[dict[str, Any], Image]:
    """The planet measured with the wavefront integrated out, and the frame less the star.

    The image is subtracted with what `detect` found by itself in the model. Where it misses the
    planet, the image has lost the same as Gauss-Newton's.
    """
    began = time.perf_counter()
    planet = shot.planets[0][0]
    found = dr.detect(fit)
    there = found.measure([planet.offset])[0]
    image = found.subtracted[0]
    row = {
        "method": "marginalised",
        "annulus_snr": paper_snr(here, image, planet),
        "matched_snr": float(there["snr"]),
        "throughput": float(there["contrast"]) / planet.contrast,
        "star_error": star_error(here, shot, image),
        "seconds": fit.seconds + time.perf_counter() - began,
    }
    return row, image


# -- spreads -------------------------------------------------------------------------------------


def spread(values: Any) -> tuple[float, float, float]:
    """Median, 16 and 84 percentile of what is no NaN; NaN of nothing."""
    good = np.asarray(values, dtype=float)
    good = good[~np.isnan(good)]
    if not good.size:
        return math.nan, math.nan, math.nan
    # Infinite contrasts (a planet that is gone) count, but cannot be interpolated.
    how = "linear" if np.isfinite(good).all() else "nearest"
    middle, low, high = np.percentile(good, (50, 16, 84), method=how)
    return float(middle), float(low), float(high)


def shown(values: Any, form: str = ".1f") -> str:
    """Median and spread as text."""
    middle, low, high = spread(values)
    if math.isnan(middle):
        return ""
    return f"{middle:{form}} ({low:{form}} to {high:{form}})"


def chosen(table: Table, **conditions: Any) -> Table:
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
    there = set(table["method"])
    return [name for name in ORDER if name in there]
