"""Differentiable rendering of a star behind a coronagraph, as an algorithm for pyKLIP.

The names that most scripts need are here; all others are in the packages, such as
``dr.detection.fit_disk``. Each name is loaded when it is first used, so that ``import
pyklip_diffrender`` and ``pyklip-diffrender --help`` wait neither for PyTorch nor for pyKLIP.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from pyklip_diffrender._version import __version__

if TYPE_CHECKING:
    from pyklip_diffrender.archive import fetch_calints
    from pyklip_diffrender.bridges import from_poppy, from_webbpsf
    from pyklip_diffrender.detection import Combination, Detection, combine, detect
    from pyklip_diffrender.instrument.nircam import nircam_coronagraph
    from pyklip_diffrender.optics.system import OpticalSystem
    from pyklip_diffrender.pattern import PatternLibrary, known_pattern, learn_pattern
    from pyklip_diffrender.pyklip_backend import register
    from pyklip_diffrender.reduction import Reduction, reduce
    from pyklip_diffrender.refinement import FitSettings, Refinement, Status, refine
    from pyklip_diffrender.scene.detector_pattern import DetectorPattern
    from pyklip_diffrender.scene.objects import Planet, Scene, Star
    from pyklip_diffrender.scene.observation import Observation
    from pyklip_diffrender.scene.sequence import ExposureSequence
    from pyklip_diffrender.scene.simulation import model_for, simulate
    from pyklip_diffrender.surveys import survey
    from pyklip_diffrender.wavefront.opd import choose_opd, read_opd

__all__ = [
    "Combination",
    "Detection",
    "DetectorPattern",
    "ExposureSequence",
    "FitSettings",
    "Observation",
    "OpticalSystem",
    "PatternLibrary",
    "Planet",
    "Reduction",
    "Refinement",
    "Scene",
    "Star",
    "Status",
    "__version__",
    "choose_opd",
    "combine",
    "detect",
    "fetch_calints",
    "from_poppy",
    "from_webbpsf",
    "known_pattern",
    "learn_pattern",
    "model_for",
    "nircam_coronagraph",
    "read_opd",
    "reduce",
    "refine",
    "register",
    "simulate",
    "survey",
]

_NAMES = {
    "archive": "fetch_calints",
    "bridges": "from_poppy from_webbpsf",
    "detection": "Combination combine detect Detection",
    "instrument.nircam": "nircam_coronagraph",
    "optics.system": "OpticalSystem",
    "pattern": "known_pattern learn_pattern PatternLibrary",
    "pyklip_backend": "register",
    "reduction": "reduce Reduction",
    "refinement": "FitSettings refine Refinement Status",
    "scene.detector_pattern": "DetectorPattern",
    "scene.objects": "Planet Scene Star",
    "scene.observation": "Observation",
    "scene.sequence": "ExposureSequence",
    "scene.simulation": "model_for simulate",
    "surveys": "survey",
    "wavefront.opd": "choose_opd read_opd",
}
"""Public names by the module they are in."""

_SUBMODULES = (
    "archive",
    "bridges",
    "detection",
    "drawing",
    "errors",
    "instrument",
    "io",
    "linear",
    "optics",
    "parameters",
    "pattern",
    "pyklip_backend",
    "reduction",
    "refinement",
    "scene",
    "spaceklip",
    "wavefront",
)
"""Packages and modules with further public names, such as ``dr.drawing.snr_map``."""

_MODULE_OF = {name: module for module, names in _NAMES.items() for name in names.split()}


def __getattr__(name: str) -> Any:
    if name in _SUBMODULES:
        return import_module(f"{__name__}.{name}")
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_MODULE_OF[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*__all__, *_SUBMODULES])
