"""The methods of star subtraction that the experiments compare on the same frames."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from coarse import coarse_steps
from recipe import AdamFit, adam_recipe
from scene import Frame, Image, Planet, Scene, Setting, Star, planet_photons, star_photons

import pyklip_diffrender as dr
from pyklip_diffrender.demo import simulate_references
from pyklip_diffrender.reduction.klip import klip_rdi
from pyklip_diffrender.refinement import FitSettings, Refinement
from pyklip_diffrender.scene.objects import ALPHA_PICTORIS_W2
from pyklip_diffrender.scene.simulation import simulate
from pyklip_diffrender.wavefront.opd import resample

STEPS = 1000
"""Of Adam, in the paper."""
LATER = 3.0
"""Hours between the target and the reference star, in the paper."""
LIBRARY, LIBRARY_MODES = 50, 30
"""Frames of the large library, and how many modes KLIP takes from it."""
QUICK = {"npix": 256, "fov_pixels": 40}
"""Model of the small versions; inside its 1.25 arcsec the scene is the same."""


@dataclass(frozen=True)
class Subtracted:
    """The result of a subtraction.

    Attributes
    ----------
    image : ndarray, (ny, nx)
        NaN where the method has no result.
    seconds : float
    fit : Refinement or None
    recipe : AdamFit or None
        Of the paper's recipe.
    """

    image: Image
    seconds: float
    fit: Refinement | None = None
    recipe: AdamFit | None = None


# -- frames --------------------------------------------------------------------------------------


def with_planets(setup: Setting, shot: Frame, planets: Iterable[Planet], seed: int) -> Frame:
    """The same frame, with the same noise of the star, and planets with their own noise."""
    rng = np.random.default_rng([seed, 77])
    light = tuple((p, planet_photons(setup.model, Scene(), p, shot.opd)) for p in planets)
    counts = shot.observation.data[0] + sum(rng.poisson(photons) for _, photons in light)
    error = np.sqrt(np.maximum(counts, 0) + Scene().read_noise ** 2)
    observation = dr.Observation.from_arrays(
        counts, error, unit="photon", pixelscale=setup.model.detector.pixelscale, filter="F444W"
    )
    return replace(shot, observation=observation, planets=light)


def references(setup: Setting, hours: float, seed: int) -> Image:
    """Nine dithered frames of alpha Pictoris, three hours after the target."""
    return simulate_references(setup.model, setup.drifted(hours + LATER), seed=10_000 + 100 * seed)


def library(setup: Setting, hours: float, seed: int, count: int = LIBRARY) -> Image:
    """Many frames of alpha Pictoris, (count, ny, nx).

    Kinder to KLIP than an archive is: the same star, the same optics, wavefronts on the target's
    own line of drift within 40 h, pointings within 30 mas.
    """
    rng = np.random.default_rng([seed, 55])
    scene = Scene(star=Star(w2_magnitude=ALPHA_PICTORIS_W2, exposure=400.0))
    # Drift is linear in time; where it is not (the embedded generator), its direction is kept.
    rate = (setup.drifted(hours) - setup.measured) / hours
    frames = []
    for k in range(count):
        radius, angle = 0.030 * math.sqrt(rng.uniform()), rng.uniform(0, 2 * math.pi)
        offset = (radius * math.cos(angle), radius * math.sin(angle))
        opd = setup.measured + rate * max(0.0, hours + rng.uniform(-40, 40))
        at = replace(scene, star_offset=offset)
        shot = simulate(setup.model, at, opd, seed=1_000_000 + 1000 * seed + k)
        frames.append(shot.data[0])
    return np.stack(frames)


# -- methods -------------------------------------------------------------------------------------


def initial(setup: Setting, shot: Frame) -> Subtracted:
    """Subtract the star of the outdated map."""
    began = time.perf_counter()
    star = star_photons(setup.model, Scene(), setup.measured)
    return Subtracted(shot.observation.data[0] - star, time.perf_counter() - began)


def klip(shot: Frame, frames: Image, numbasis: int = 9) -> Subtracted:
    """PyKLIP with the paper's annuli and subsections."""
    began = time.perf_counter()
    image = klip_rdi(shot.observation.data[0], frames, numbasis=numbasis)
    return Subtracted(image, time.perf_counter() - began)


def adam(setup: Setting, shot: Frame, steps: int = STEPS) -> Subtracted:
    """The paper's recipe: every OPD pixel free, Adam, L1, the star's flux known.

    Its steps are taken on a coarse pupil, from the fine model's star at the known map: a twelfth
    of the time. On one frame of the measured maps the star-model error was 1.024 sigma with 256
    samples and 1.025 with all 1024.
    """
    began = time.perf_counter()
    coarse = coarse_steps(setup.model, setup.measured, min(256, setup.model.npix // 2))
    fit = adam_recipe(
        coarse,
        shot.observation,
        resample(setup.measured, coarse.npix),
        flux=Star().photons,
        steps=steps,
    )
    return Subtracted(fit.residual, time.perf_counter() - began, recipe=fit)


def gauss_newton(setup: Setting, shot: Frame, **changes: Any) -> Subtracted:
    """This package's default, or with other settings."""
    began = time.perf_counter()
    settings = FitSettings(**changes)
    fit = dr.refine(setup.model, shot.observation, setup.measured, settings=settings)
    return Subtracted(fit.frames[0].residual[0], time.perf_counter() - began, fit)


def optimal(shot: Frame) -> Subtracted:
    """Subtract the true star."""
    return Subtracted(shot.known_star, math.nan)


def all_of(
    setup: Setting,
    shot: Frame,
    frames: Image,
    steps: int = 0,
    archive: Image | None = None,
    **fit: Any,
) -> dict[str, Subtracted]:
    """Apply every method to a frame.

    Parameters
    ----------
    here : Setting
    shot : Frame
    frames : ndarray, (9, ny, nx)
        KLIP's references.
    steps : int
        Of Adam; 0 leaves it out.
    many : ndarray, optional
        A library, for KLIP once more.
    **fit
        Fields of `FitSettings`.
    """
    subtracted = {"initial": initial(setup, shot), "KLIP": klip(shot, frames)}
    if archive is not None:
        subtracted["KLIP, library"] = klip(shot, archive, min(LIBRARY_MODES, len(archive)))
    if steps:
        subtracted["Adam"] = adam(setup, shot, steps)
    return {
        **subtracted,
        "Gauss-Newton": gauss_newton(setup, shot, **fit),
        "optimal": optimal(shot),
    }
