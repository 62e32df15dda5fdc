"""Fourier optics of a coronagraph in torch: pupils, masks, detector, `OpticalSystem`."""

from __future__ import annotations

from pyklip_diffrender.optics.bandpass import Bandpass
from pyklip_diffrender.optics.system import InstrumentSystem, OpticalSystem

__all__ = ["Bandpass", "InstrumentSystem", "OpticalSystem"]
