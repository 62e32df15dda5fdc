"""The linear model of a fit: derivatives of the image, and the algebra of marginalisation."""

from __future__ import annotations

from pyklip_diffrender.linear.model import LinearFrame, LinearModel, Unknown
from pyklip_diffrender.linear.response import (
    NANOMETRE,
    LastPupil,
    ModeFields,
    ResponseCache,
    WavefrontResponse,
    coarse_copy,
    coarse_npix,
    downsample,
    field_derivatives,
    image_derivatives,
    jacobian,
)

__all__ = [
    "NANOMETRE",
    "LastPupil",
    "LinearFrame",
    "LinearModel",
    "ModeFields",
    "ResponseCache",
    "Unknown",
    "WavefrontResponse",
    "coarse_copy",
    "coarse_npix",
    "downsample",
    "field_derivatives",
    "image_derivatives",
    "jacobian",
]
