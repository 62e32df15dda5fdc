"""JWST and NIRCam from embedded tables: mirror, masks, filters, `nircam_coronagraph`."""

from __future__ import annotations

from pyklip_diffrender.instrument.masks import detector_place
from pyklip_diffrender.instrument.nircam import FLIGHT_ALIGNMENT
from pyklip_diffrender.instrument.spectrum import planet_spectra, star_flux_density

__all__ = ["FLIGHT_ALIGNMENT", "detector_place", "planet_spectra", "star_flux_density"]
