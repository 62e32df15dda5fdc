"""OPD maps, the modes that describe their changes, and priors on the modes."""

from __future__ import annotations

from pyklip_diffrender.wavefront.opd import random_opd
from pyklip_diffrender.wavefront.opd_map import OPDMap
from pyklip_diffrender.wavefront.priors import WavefrontPrior

__all__ = ["OPDMap", "WavefrontPrior", "random_opd"]
