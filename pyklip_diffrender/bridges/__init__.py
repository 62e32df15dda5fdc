"""Conversions between this package and the user's own poppy and stpsf (webbpsf) objects.

stpsf is imported when a conversion first needs it.
"""

from __future__ import annotations

from pyklip_diffrender.bridges.poppy import from_poppy, opd_to_poppy
from pyklip_diffrender.bridges.webbpsf import from_webbpsf, opd_to_webbpsf
from pyklip_diffrender.wavefront.opd_map import opd_to_hdus
from pyklip_diffrender.wavefront.wss import load_wss_opd, load_wss_opd_by_date

__all__ = [
    "from_poppy",
    "from_webbpsf",
    "load_wss_opd",
    "load_wss_opd_by_date",
    "opd_to_hdus",
    "opd_to_poppy",
    "opd_to_webbpsf",
]
