"""Detection of point sources with the wavefront marginalised.

The light of a planet and a wavefront error can look alike. Where the fit of the star bends
towards a planet, a subtracted frame has lost some of its light, and does not say how much. Here a
planet is estimated together with everything that describes the star, in closed form: unbiased,
with an error that contains the price of the wavefront's freedom.
"""

from __future__ import annotations

from pyklip_diffrender.detection.candidates import Candidates
from pyklip_diffrender.detection.contrast import small_sample_factor
from pyklip_diffrender.detection.result import Detection
from pyklip_diffrender.detection.search import contrast_curve, detect, measure

__all__ = [
    "Candidates",
    "Detection",
    "contrast_curve",
    "detect",
    "measure",
    "small_sample_factor",
]
