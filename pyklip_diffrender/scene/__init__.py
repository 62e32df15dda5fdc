"""Stars and planets, observed frames, and simulated frames."""

from __future__ import annotations

from pyklip_diffrender.scene.detector_pattern import DetectorPattern
from pyklip_diffrender.scene.integrations import calibrated_errors
from pyklip_diffrender.scene.objects import (
    ALPHA_PICTORIS_W2,
    UNOCCULTED_PEAK,
    Planet,
    Scene,
    Star,
)
from pyklip_diffrender.scene.observation import Observation
from pyklip_diffrender.scene.product_headers import world_coordinates
from pyklip_diffrender.scene.sequence import ExposureSequence
from pyklip_diffrender.scene.simulation import (
    expected_photons,
    model_for,
    planet_photons,
    simulate,
    star_photons,
)

__all__ = [
    "ALPHA_PICTORIS_W2",
    "UNOCCULTED_PEAK",
    "DetectorPattern",
    "ExposureSequence",
    "Observation",
    "Planet",
    "Scene",
    "Star",
    "calibrated_errors",
    "expected_photons",
    "model_for",
    "planet_photons",
    "simulate",
    "star_photons",
    "world_coordinates",
]
