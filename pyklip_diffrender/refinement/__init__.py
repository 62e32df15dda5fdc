"""Refinement of a wavefront until the star that it renders matches the data."""

from __future__ import annotations

from pyklip_diffrender.refinement.fit_result import FrameFit, Refinement, Status
from pyklip_diffrender.refinement.fitting import (
    align_frame,
    jansky_per_unit,
    join_frames,
    refine,
    refine_again,
    require_agreement_of_flux,
    require_calibrated,
    star_flux_error,
    to_jansky,
    with_star_flux,
)
from pyklip_diffrender.refinement.settings import (
    FitSettings,
    coarse_arguments,
    faintness,
    nircam_settings,
    quick_settings,
    settings_for,
)

__all__ = [
    "FitSettings",
    "FrameFit",
    "Refinement",
    "Status",
    "align_frame",
    "coarse_arguments",
    "faintness",
    "jansky_per_unit",
    "join_frames",
    "nircam_settings",
    "quick_settings",
    "refine",
    "refine_again",
    "require_agreement_of_flux",
    "require_calibrated",
    "settings_for",
    "star_flux_error",
    "to_jansky",
    "with_star_flux",
]
