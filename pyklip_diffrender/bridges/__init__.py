"""Conversions between this package and the user's own poppy and stpsf (webbpsf) objects.

poppy and stpsf are imported when a conversion is first used.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
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

_MODULE_OF = {
    "from_poppy": "bridges.poppy",
    "from_webbpsf": "bridges.webbpsf",
    "load_wss_opd": "wavefront.wss",
    "load_wss_opd_by_date": "wavefront.wss",
    "opd_to_hdus": "wavefront.opd_map",
    "opd_to_poppy": "bridges.poppy",
    "opd_to_webbpsf": "bridges.webbpsf",
}


def __getattr__(name: str) -> Any:
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"pyklip_diffrender.{_MODULE_OF[name]}"), name)
