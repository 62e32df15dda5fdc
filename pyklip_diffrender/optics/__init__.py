"""Fourier optics of a coronagraph in torch: pupils, masks, detector, `OpticalSystem`."""

from __future__ import annotations

from pyklip_diffrender.optics.bandpass import Bandpass
from pyklip_diffrender.optics.fast_path import finest_spacing
from pyklip_diffrender.optics.grid import (
    JWST_DIAMETER,
    PupilGrid,
    polygon_coverage,
    resample,
    transform_polygons,
    widen_polygon,
    zernike_basis,
)
from pyklip_diffrender.optics.planes import (
    Cache,
    ChainDetector,
    Detector,
    Effect,
    EntrancePupil,
    GaussianBlur,
    LinearResampling,
    LyotStop,
    MatrixFourier,
    PixelCrosstalk,
    Plane,
    Position,
    Wavefront,
    kernel,
)
from pyklip_diffrender.optics.point_sources import PointSources
from pyklip_diffrender.optics.system import InstrumentSystem, OpticalSystem

__all__ = [
    "JWST_DIAMETER",
    "Bandpass",
    "Cache",
    "ChainDetector",
    "Detector",
    "Effect",
    "EntrancePupil",
    "GaussianBlur",
    "InstrumentSystem",
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
