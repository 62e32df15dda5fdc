"""Differentiable rendering of a star behind a coronagraph, as an algorithm for pyKLIP.

Every public name is loaded when it is first used, so that ``import pyklip_diffrender`` and
``pyklip-diffrender --help`` wait neither for PyTorch nor for pyKLIP.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from pyklip_diffrender._version import __version__

if TYPE_CHECKING:
    from pyklip_diffrender.archive import fetch_calints, list_calints
    from pyklip_diffrender.bridges import from_poppy, from_webbpsf
    from pyklip_diffrender.detection import (
        Combination,
        Detection,
        Disk,
        WideField,
        combine,
        completeness,
        detect,
        fit_disk,
        wide_field,
    )
    from pyklip_diffrender.instrument.nircam import nircam_coronagraph
    from pyklip_diffrender.instrument.spectrum import star_flux_density
    from pyklip_diffrender.linear.model import LinearModel
    from pyklip_diffrender.optics.system import OpticalSystem
    from pyklip_diffrender.pattern import (
        PatternLibrary,
        combine_libraries,
        known_systematics,
        learn_library,
        learn_systematics,
    )
    from pyklip_diffrender.pyklip_backend import (
        DiffrenderSettings,
        backend,
        observation_from_dataset,
        register,
        unregister,
    )
    from pyklip_diffrender.reduction import Reduction, reduce
    from pyklip_diffrender.refinement import (
        GaussNewton,
        Refinement,
        Status,
        refine,
    )
    from pyklip_diffrender.scene.objects import Planet, Scene, Star
    from pyklip_diffrender.scene.observation import Observation
    from pyklip_diffrender.scene.sequence import Sequence
    from pyklip_diffrender.scene.simulation import model_for, simulate
    from pyklip_diffrender.scene.systematics import Systematics
    from pyklip_diffrender.surveys import survey
    from pyklip_diffrender.wavefront.opd import choose_map, random_opd, read_opd
    from pyklip_diffrender.wavefront.priors import WavefrontPrior, learn_prior

__all__ = [
    "Combination",
    "Detection",
    "DiffrenderSettings",
    "Disk",
    "GaussNewton",
    "LinearModel",
    "Observation",
    "OpticalSystem",
    "PatternLibrary",
    "Planet",
    "Reduction",
    "Refinement",
    "Scene",
    "Sequence",
    "Star",
    "Status",
    "Systematics",
    "WavefrontPrior",
    "WideField",
    "__version__",
    "backend",
    "choose_map",
    "combine",
    "combine_libraries",
    "completeness",
    "detect",
    "fetch_calints",
    "fit_disk",
    "from_poppy",
    "from_webbpsf",
    "known_systematics",
    "learn_library",
    "learn_prior",
    "learn_systematics",
    "list_calints",
    "model_for",
    "nircam_coronagraph",
    "observation_from_dataset",
    "random_opd",
    "read_opd",
    "reduce",
    "refine",
    "register",
    "simulate",
    "star_flux_density",
    "survey",
    "unregister",
    "wide_field",
]

_NAMES = {
    "archive": "fetch_calints list_calints",
    "bridges": "from_poppy from_webbpsf",
    "detection": "Combination combine completeness detect Detection Disk fit_disk "
    "wide_field WideField",
    "instrument.nircam": "nircam_coronagraph",
    "instrument.spectrum": "star_flux_density",
    "linear.model": "LinearModel",
    "optics.system": "OpticalSystem",
    "pyklip_backend": "backend DiffrenderSettings observation_from_dataset register unregister",
    "reduction": "reduce Reduction",
    "pattern": "combine_libraries known_systematics learn_library learn_systematics PatternLibrary",
    "refinement": "GaussNewton refine Refinement Status",
    "scene.objects": "Planet Scene Star",
    "scene.observation": "Observation",
    "scene.simulation": "model_for simulate",
    "scene.sequence": "Sequence",
    "scene.systematics": "Systematics",
    "wavefront.opd": "choose_map random_opd read_opd",
    "surveys": "survey",
    "wavefront.priors": "learn_prior WavefrontPrior",
}
"""Public names by the module they are in."""

_SUBMODULES = (
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
