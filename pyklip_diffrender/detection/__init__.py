"""Detection of point sources with the wavefront marginalised.

The image of a planet can resemble a wavefront error. A fit of the star alone then absorbs
part of the planet, and the subtracted frame has lost an unknown fraction of its light. Here the
flux of a planet is estimated together with all parameters of the star, in closed form. The result
is unbiased, and its error includes the uncertainty of the wavefront.
"""

from __future__ import annotations

from pyklip_diffrender.detection import metrics
from pyklip_diffrender.detection.association import Hypotheses, Motion, checked_motion
from pyklip_diffrender.detection.candidates import (
    Candidates,
    ReferenceSource,
    sources_of_references,
)
from pyklip_diffrender.detection.combined_result import COMBINED, Combination
from pyklip_diffrender.detection.combined_search import combine
from pyklip_diffrender.detection.deeper import deeper, stated_limits
from pyklip_diffrender.detection.detection_file import image_hdu
from pyklip_diffrender.detection.disk import Disk, fit_disk
from pyklip_diffrender.detection.recovery import (
    completeness,
    contrast_of_completeness,
    measured_planet,
    recover_planets,
    with_planets,
)
from pyklip_diffrender.detection.search import detect
from pyklip_diffrender.detection.search_result import Detection, draw_curve
from pyklip_diffrender.detection.sky_map import SkyMap
from pyklip_diffrender.detection.templates import combine_frames
from pyklip_diffrender.detection.whole_frame import (
    has_bright_pixels_beyond,
    sources_at_edges,
    sources_beyond,
    without_blurred_edges,
)
from pyklip_diffrender.detection.wide_search import WideField, require_outer_pixels, wide_field

__all__ = [
    "COMBINED",
    "Candidates",
    "Combination",
    "Detection",
    "Disk",
    "Hypotheses",
    "Motion",
    "ReferenceSource",
    "SkyMap",
    "WideField",
    "checked_motion",
    "combine",
    "combine_frames",
    "completeness",
    "contrast_of_completeness",
    "deeper",
    "detect",
    "draw_curve",
    "fit_disk",
    "has_bright_pixels_beyond",
    "image_hdu",
    "measured_planet",
    "metrics",
    "recover_planets",
    "require_outer_pixels",
    "sources_at_edges",
    "sources_beyond",
    "sources_of_references",
    "stated_limits",
    "wide_field",
    "with_planets",
    "without_blurred_edges",
]
