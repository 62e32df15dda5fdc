"""The image of the sky about a star: everything that is neither the star nor the detector."""

from __future__ import annotations

from pyklip_diffrender.imaging.sky_model import SkyModel

__all__ = ["SkyModel"]
