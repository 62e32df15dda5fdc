"""Rows of the stability table: how fits of hard data end.

One small star, known exactly, is spoilt in one way a row; the fit starts from an old wavefront.
What counts is the rms error of the fitted star, in units of the noise, over all pixels, seen or
not: a fit that reports success must be right, one that cannot be must say so.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch

import pyklip_diffrender as dr
from benchmarks import noisy_stars
from benchmarks.hard_cases import WAVELENGTH, segment
from pyklip_diffrender.optics.grid import PupilGrid
from pyklip_diffrender.refinement import Refinement, Status
from pyklip_diffrender.wavefront.bases import FourierModes, JointBasis, SegmentMotions

NPIX, SIZE = 64, 24
FLUX, BACKGROUND = 1e11, 500.0
OFFSET = (0.002, -0.001)
FEW = FourierModes(3)
MORE = JointBasis([SegmentMotions(), FEW])

SUCCESS = 0.5
"""Largest error of the star, in sigma, with which a fit may say that it has converged: the
parameters that it determines take up about 40 of 576 pixels, an error of 0.26 sigma."""


@lru_cache(maxsize=2)
def model(dtype=torch.float64):
    """24 x 24 pixels."""
    return dr.nircam_coronagraph(monochromatic=WAVELENGTH, npix=NPIX, fov_pixels=SIZE, dtype=dtype)


@lru_cache(maxsize=1)
def old():
    """The wavefront that fits start from, m."""
    return dr.wavefront.random_opd(3, npix=NPIX).data


@lru_cache(maxsize=1)
def _now():
    size = 4e-9 / (1 + FEW.frequencies)
    change = size * torch.randn(len(FEW), generator=torch.Generator().manual_seed(1))
    return old() + FEW.opd(change.double(), PupilGrid.full(NPIX)).numpy()


def drift_rms():
    """How far the wavefront has moved, rms over the pupil, m."""
    return float((_now() - old())[model().entrance.lit.numpy()].std())


def star(opd=None):
    """The true star, photons."""
    with torch.no_grad():
        return FLUX * model()(_now() if opd is None else opd, OFFSET).numpy()


def noise(truth=None):
    """Standard deviation of every pixel."""
    return np.sqrt((star() if truth is None else truth) + BACKGROUND + noisy_stars.READ_NOISE**2)


def planet(*planets):
    """Their light, photons."""
    with torch.no_grad():
        images = [
            FLUX * p.contrast * model()(_now(), tuple(np.add(OFFSET, p.offset))).numpy()
            for p in planets
        ]
    return sum(images, np.zeros((SIZE, SIZE)))


def observed(truth, seed=2):
    """A frame of it, with noise."""
    return noisy_stars.observed(truth + BACKGROUND, seed, 0.062424185, name="hard case")


def error_of(image, truth=None):
    """Rms error of a star with its background, in sigma."""
    truth = star() if truth is None else truth
    return float(np.sqrt(np.mean(((image - BACKGROUND - truth) / noise(truth)) ** 2)))


def fitted(frame, opd=None, dtype=torch.float64, **options):
    """The fit, from the old wavefront unless another is given."""
    start = options.pop("start", None)
    settings = dr.FitSettings(**{"basis": FEW, "response_npix": NPIX, **options})
    return dr.refine(
        model(dtype), frame, old() if opd is None else opd, settings=settings, start=start
    )


# -- what no image shows -----------------------------------------------------------------------


class Pistons(NamedTuple):
    """A fit with free segments; the mean of their pistons, of unit length, and its error, nm."""

    fit: Refinement
    together: float
    error: float


PRIOR = 4.0
"""nm, of every segment motion."""


def piston_of_segments():
    """18 pistons are free; what they have in common is invisible."""
    prior = dr.wavefront.WavefrontPrior({"segment": PRIOR, "texture": 3.0}, fit_scales=False)
    fit = fitted(observed(star()), basis=MORE, prior=prior)
    found = fit.frames[0].coefficients
    covariance = fit.linear.covariance.numpy()[-len(MORE) :, -len(MORE) :]
    mean = np.zeros(len(MORE))
    mean[:54:3] = 18**-0.5
    return Pistons(fit, float(mean @ found), float(np.sqrt(mean @ covariance @ mean)))


# -- what is done to the frame -----------------------------------------------------------------


def _missing(share):
    frame = observed(star())
    return replace(frame, valid=np.random.default_rng(9).random(frame.data.shape) >= share)


def _saturated(flagged):
    """The brightest 3 % of the pixels are full."""
    frame = observed(star())
    full = float(np.quantile(frame.data, 0.97))
    valid = ~((frame.data >= full) & flagged)
    return replace(frame, data=np.minimum(frame.data, full), valid=valid)


def _hit(flagged, sigma=1000.0, count=10):
    """Hot pixels, or cosmic rays, at 1000 sigma."""
    frame = observed(star())
    where = np.random.default_rng(8).choice(frame.data.size, count, replace=False)
    data, valid = frame.data.copy(), np.ones(frame.data.shape, dtype=bool)
    data.flat[where] += sigma * frame.error.flat[where]
    valid.flat[where] = not flagged
    return replace(frame, data=data, valid=valid)


def _wave(waves):
    return _now() + waves * WAVELENGTH * segment(NPIX).numpy()


class FitRow(NamedTuple):
    """A line of the table of fits, how it may end, and the largest error of its star.

    `run` takes a real dtype and gives the fit and that error, sigma.
    """

    case: str
    trouble: str
    sees: str
    ends: tuple[Status, ...]
    run: Callable
    limit: float = SUCCESS


def _row(case, trouble, sees, make, *ends, limit=SUCCESS, truth=star, start=old, **options):
    def run(dtype):
        fit = fitted(make(), start(), dtype, **options)
        return fit, error_of(fit.frames[0].star, truth())

    return FitRow(case, trouble, sees, ends or (Status.CONVERGED,), run, limit)


_FAILED = (Status.MODEL_MISMATCH, Status.ITERATION_LIMIT, Status.DIVERGED)
_ANY = float("inf")
_BRIGHT = dr.Planet(1e-3, 0.55, 40.0)
_NEAR = dr.Planet(1e-4, 0.3, 40.0)
_EDGE = dr.Planet(1e-3, 11.5 * 0.062424185, 90.0)

FITS = [
    _row("nothing hard", "", "converged", lambda: observed(star())),
    _row("5 % of the pixels missing", "bias", "converged", lambda: _missing(0.05)),
    _row("50 % missing", "bias; wild where nothing was seen", "converged", lambda: _missing(0.5)),
    _row("saturated core, flagged", "bias", "converged", lambda: _saturated(True)),
    _row("saturated core, not flagged", "the wavefront bends to it",
         "converged without these pixels", lambda: _saturated(False)),
    _row("10 pixels at 1000 sigma, flagged", "bias", "converged", lambda: _hit(True)),
    _row("10 pixels at 1000 sigma, not flagged", "the wavefront bends to them",
         "a status that is not success", lambda: _hit(False), *_FAILED, limit=_ANY),
    _row("the same with robust=3", "they outweigh everything else", "converged",
         lambda: _hit(False), robust=3.0),
    _row("planet of 2e-5 at 0.3 arcsec", "the wavefront takes it", "converged",
         lambda: observed(star() + planet(replace(_NEAR, contrast=2e-5)))),
    _row("planet of 1e-4 at 0.3 arcsec", "the wavefront takes it", "a status that is not success",
         lambda: observed(star() + planet(_NEAR)), *_FAILED, limit=_ANY),
    _row("bright planet, 1e-3", "the wavefront takes it", "converged, planet listed",
         lambda: observed(star() + planet(_BRIGHT))),
    _row("the same with max_companions=1", "", "converged, planet listed",
         lambda: observed(star() + planet(_BRIGHT)), max_companions=1),
    _row("planet of 1e-3 at the edge, max_companions=1", "half a planet is taken for a wavefront",
         "converged, planet listed", lambda: observed(star() + planet(_EDGE)), max_companions=1),
    _row("a segment 1.5 waves too high, known", "phase above pi", "converged",
         lambda: observed(star(_wave(1.5))), truth=lambda: star(_wave(1.5)),
         start=lambda: _wave(1.5) + old() - _now()),
    _row("the same, unknown", "a wrong minimum", "a status that is not success",
         lambda: observed(star(_wave(1.5))), *_FAILED, truth=lambda: star(_wave(1.5)),
         limit=_ANY, basis=MORE),
    _row("the start upside down", "a wrong minimum", "a status that is not success",
         lambda: observed(star()), *_FAILED, start=lambda: old()[::-1].copy(), limit=_ANY),
    _row("the start transposed", "a wrong minimum", "a status that is not success",
         lambda: observed(star()), *_FAILED, start=lambda: old().T.copy(), limit=_ANY),
    _row("the start mirrored", "a wrong minimum", "a status that is not success",
         lambda: observed(star()), *_FAILED, start=lambda: old()[:, ::-1].copy(), limit=_ANY),
]  # fmt: skip
