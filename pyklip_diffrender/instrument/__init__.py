"""JWST and NIRCam from embedded tables: mirror, masks, filters, `nircam_coronagraph`."""

from __future__ import annotations

from pyklip_diffrender.instrument.jwst import (
    TABULATED_GAP,
    is_jwst_pupil,
    jwst_pupil,
    jwst_segments,
    maskrnd_openings,
)
from pyklip_diffrender.instrument.masks import (
    FILTERS,
    MASKS,
    BarMask,
    detector_place,
    filter_shift,
    is_short_wave,
)
from pyklip_diffrender.instrument.nircam import (
    FLIGHT_ALIGNMENT,
    NIRCAM_LW_PIXELSCALE,
    ChromaticAberration,
    internal_wavefront_error,
    nircam_coronagraph,
)
from pyklip_diffrender.instrument.spectrum import (
    filter_bandpass,
    filter_throughput,
    planet_spectra,
    star_flux_density,
)

__all__ = [
    "FILTERS",
    "FLIGHT_ALIGNMENT",
    "MASKS",
    "NIRCAM_LW_PIXELSCALE",
    "TABULATED_GAP",
    "BarMask",
    "ChromaticAberration",
    "detector_place",
    "filter_bandpass",
    "filter_shift",
    "filter_throughput",
    "internal_wavefront_error",
    "is_jwst_pupil",
    "is_short_wave",
    "jwst_pupil",
    "jwst_segments",
    "maskrnd_openings",
    "nircam_coronagraph",
    "planet_spectra",
    "star_flux_density",
]
