"""The linear model of a fit: derivatives of the image, and the algebra of marginalisation."""

from __future__ import annotations

from pyklip_diffrender.linear.frames import LinearFrame, Unknown
from pyklip_diffrender.linear.last_pupil import LastPupil
from pyklip_diffrender.linear.mode_fields import NANOMETRE, ModeFields
from pyklip_diffrender.linear.model import LinearModel
from pyklip_diffrender.linear.parameter_derivatives import (
    field_derivatives,
    image_derivatives,
    jacobian,
)
from pyklip_diffrender.linear.response import (
    WavefrontResponse,
    coarse_copy,
    coarse_npix,
    downsample,
)
from pyklip_diffrender.linear.response_cache import ResponseCache

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
