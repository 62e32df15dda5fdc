"""Fourier optics of a coronagraph in torch: pupils, masks, detector, `OpticalSystem`."""

from __future__ import annotations

from pyklip_diffrender.optics.bandpass import Bandpass
from pyklip_diffrender.optics.detector import Detector
from pyklip_diffrender.optics.detector_effects import (
    ChainDetector,
    Effect,
    GaussianBlur,
    LinearResampling,
    PixelCrosstalk,
)
from pyklip_diffrender.optics.differentiation import Cache, Position
from pyklip_diffrender.optics.fast.occulter import finest_spacing
from pyklip_diffrender.optics.fast.point_sources import PointSources
from pyklip_diffrender.optics.fourier import MatrixFourier, kernel
from pyklip_diffrender.optics.grid import (
    JWST_DIAMETER,
    PupilGrid,
    polygon_coverage,
    resample,
    transform_polygons,
    widen_polygon,
)
from pyklip_diffrender.optics.planes import EntrancePupil, LyotStop, Plane, Wavefront
from pyklip_diffrender.optics.system import OpticalSystem
from pyklip_diffrender.optics.zernike import zernike_basis

__all__ = [
    "JWST_DIAMETER",
    "Bandpass",
    "Cache",
    "ChainDetector",
    "Detector",
    "Effect",
    "EntrancePupil",
    "GaussianBlur",
    "LinearResampling",
    "LyotStop",
    "MatrixFourier",
    "OpticalSystem",
    "PixelCrosstalk",
    "Plane",
    "PointSources",
    "Position",
    "PupilGrid",
    "Wavefront",
    "finest_spacing",
    "kernel",
    "polygon_coverage",
    "resample",
    "transform_polygons",
    "widen_polygon",
    "zernike_basis",
]
