"""Fourier optics of a coronagraph in torch: pupils, masks, detector, `OpticalSystem`."""

from __future__ import annotations

from pyklip_diffrender.optics.bandpass import Bandpass
from pyklip_diffrender.optics.grid import (
    JWST_DIAMETER,
    PupilGrid,
    polygon_coverage,
    resample,
    transform_polygons,
    widen_polygon,
)
from pyklip_diffrender.optics.planes import (
    ChainDetector,
    Detector,
    GaussianBlur,
    LinearResampling,
    LyotStop,
    MatrixFourier,
    PixelCrosstalk,
    Plane,
    Wavefront,
)
from pyklip_diffrender.optics.point_sources import PointSources
from pyklip_diffrender.optics.system import InstrumentSystem, OpticalSystem

__all__ = [
    "JWST_DIAMETER",
    "Bandpass",
    "ChainDetector",
    "Detector",
    "GaussianBlur",
    "InstrumentSystem",
    "LinearResampling",
    "LyotStop",
    "MatrixFourier",
    "OpticalSystem",
    "PixelCrosstalk",
    "Plane",
    "PointSources",
    "PupilGrid",
    "Wavefront",
    "polygon_coverage",
    "resample",
    "transform_polygons",
    "widen_polygon",
]
