"""Simulated observations: the model's image of a scene, with shot and read noise."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from pyklip_diffrender.optics.system import OpticalSystem
from pyklip_diffrender.scene.objects import Planet, Scene
from pyklip_diffrender.scene.observation import Observation

__all__ = ["expected_photons", "planet_photons", "simulate", "star_photons"]


def star_photons(model: OpticalSystem, scene: Scene, opd: Any) -> NDArray[np.float64]:
    """Expected photons of the star alone, (ny, nx)."""
    with torch.no_grad():
        image = model(opd, scene.star_offset)
    return scene.star.photons * image.double().cpu().numpy()


def planet_photons(
    model: OpticalSystem, scene: Scene, planet: Planet, opd: Any
) -> NDArray[np.float64]:
    """Expected photons of one planet, seen through the mask where it is, (ny, nx)."""
    offset = np.add(scene.star_offset, planet.offset)
    with torch.no_grad():
        image = model(opd, tuple(offset))
    return planet.contrast * scene.star.photons * image.double().cpu().numpy()


def expected_photons(model: OpticalSystem, scene: Scene, opd: Any) -> NDArray[np.float64]:
    """Expected photons of star, planets and background, (ny, nx)."""
    total = star_photons(model, scene, opd) + scene.background
    for planet in scene.planets:
        total = total + planet_photons(model, scene, planet, opd)
    return total


def simulate(
    model: OpticalSystem, scene: Scene, opd: Any, *, seed: int, frames: int = 1
) -> Observation:
    """Simulate an observation.

    Parameters
    ----------
    model : OpticalSystem
    scene : Scene
    opd : array, Quantity or OPDMap
        The true wavefront, (npix, npix), m.
    seed : int
        Of the noise; the same seed gives the same frames.
    frames : int
        Independent exposures of the same scene.

    Returns
    -------
    Observation
        In photons. The error is the observer's estimate, sqrt(counts + read noise^2), from
        the frame itself.

    Examples
    --------
    >>> import pyklip_diffrender as dr
    >>> model = dr.nircam_coronagraph("F444W", monochromatic=4.5e-6, npix=128, fov_pixels=24)
    >>> dr.simulate(model, dr.Scene(), dr.random_opd(1, npix=128), seed=1)
    <Observation 'simulation(seed=1)': 1 frame of 24 x 24 pixels, F444W, ph, no date>
    """
    expected = expected_photons(model, scene, opd)
    generator = np.random.default_rng(seed)
    counts = generator.poisson(expected, size=(frames, *expected.shape)).astype(np.float64)
    counts += generator.normal(0.0, scene.read_noise, size=counts.shape)
    error = np.sqrt(np.maximum(counts, 0.0) + scene.read_noise**2)
    return Observation.from_arrays(
        counts,
        error,
        unit="photon",
        pixelscale=model.detector.pixelscale,
        filter=model.setup.get("filter"),
        name=f"simulation(seed={seed})",
    )
