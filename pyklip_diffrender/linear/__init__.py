"""The linear model of a fit: derivatives of the image, and the algebra of marginalisation."""

from __future__ import annotations

from pyklip_diffrender.linear.model import LinearModel
from pyklip_diffrender.linear.response import (
    NANOMETRE,
    LastPupil,
    ResponseCache,
    WavefrontResponse,
    coarse_copy,
    downsample,
    field_derivatives,
    image_derivatives,
)

__all__ = [
    "NANOMETRE",
    "LastPupil",
    "LinearModel",
    "ResponseCache",
    "WavefrontResponse",
    "coarse_copy",
    "downsample",
    "field_derivatives",
    "image_derivatives",
]
