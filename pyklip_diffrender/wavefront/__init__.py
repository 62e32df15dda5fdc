"""OPD maps, the modes that describe their changes, and priors on the modes."""

from __future__ import annotations

from pyklip_diffrender.wavefront.bases import (
    FourierModes,
    JointBasis,
    SegmentMotions,
    default_basis,
)
from pyklip_diffrender.wavefront.opd import (
    as_opd_map,
    choose_opd,
    opd_for,
    random_drift,
    random_opd,
    read_opd,
)
from pyklip_diffrender.wavefront.opd_map import OPDMap
from pyklip_diffrender.wavefront.priors import WavefrontPrior, solve_with_evidence
from pyklip_diffrender.wavefront.wss import interpolate_wss

__all__ = [
    "FourierModes",
    "JointBasis",
    "OPDMap",
    "SegmentMotions",
    "WavefrontPrior",
    "as_opd_map",
    "choose_opd",
    "default_basis",
    "interpolate_wss",
    "opd_for",
    "random_drift",
    "random_opd",
    "read_opd",
    "solve_with_evidence",
]
