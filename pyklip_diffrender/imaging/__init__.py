"""Images of the sky about a star: everything that is neither the star nor the detector."""

from __future__ import annotations

from pyklip_diffrender.imaging.products import SkyImages, sky_images
from pyklip_diffrender.imaging.sky import SkyModel

__all__ = ["SkyImages", "SkyModel", "sky_images"]
