"""Differentiable rendering of a star behind a coronagraph, as an algorithm for pyKLIP.

Every public name is loaded when it is first used, so that ``import pyklip_diffrender`` and
``pyklip-diffrender --help`` wait neither for PyTorch nor for pyKLIP.
"""

from __future__ import annotations

from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pyklip_diffrender.bridges import from_poppy, from_webbpsf
    from pyklip_diffrender.detection import Detection, contrast_curve, detect, measure
    from pyklip_diffrender.fidelity import Plan, plan
    from pyklip_diffrender.linear_model import LinearModel
    from pyklip_diffrender.memory import keep_freed_memory
    from pyklip_diffrender.nircam import nircam_coronagraph
    from pyklip_diffrender.observation import Observation
    from pyklip_diffrender.opd import drift, random_opd, read_opd
    from pyklip_diffrender.optics import OpticalSystem
    from pyklip_diffrender.priors import WavefrontPrior, learn_prior
    from pyklip_diffrender.pyklip_backend import (
        DiffrenderSettings,
        backend,
        observation_from_dataset,
        register,
        unregister,
    )
    from pyklip_diffrender.refinement import Refinement, Status, refine
    from pyklip_diffrender.scene import Planet, Scene, Star
    from pyklip_diffrender.simulation import simulate

__all__ = [
    "Detection",
    "DiffrenderSettings",
    "LinearModel",
    "Observation",
    "OpticalSystem",
    "Plan",
    "Planet",
    "Refinement",
    "Scene",
    "Star",
    "Status",
    "WavefrontPrior",
    "__version__",
    "backend",
    "contrast_curve",
    "detect",
    "drift",
    "from_poppy",
    "from_webbpsf",
    "keep_freed_memory",
    "learn_prior",
    "measure",
    "nircam_coronagraph",
    "observation_from_dataset",
    "plan",
    "random_opd",
    "read_opd",
    "refine",
    "register",
    "simulate",
    "unregister",
]

_MODULE_OF = {
    "Detection": "detection",
    "DiffrenderSettings": "pyklip_backend",
    "LinearModel": "linear_model",
    "Observation": "observation",
    "OpticalSystem": "optics",
    "Plan": "fidelity",
    "Planet": "scene",
    "Refinement": "refinement",
    "Scene": "scene",
    "Star": "scene",
    "Status": "refinement",
    "WavefrontPrior": "priors",
    "backend": "pyklip_backend",
    "contrast_curve": "detection",
    "detect": "detection",
    "drift": "opd",
    "from_poppy": "bridges",
    "from_webbpsf": "bridges",
    "keep_freed_memory": "memory",
    "learn_prior": "priors",
    "measure": "detection",
    "nircam_coronagraph": "nircam",
    "observation_from_dataset": "pyklip_backend",
    "plan": "fidelity",
    "random_opd": "opd",
    "read_opd": "opd",
    "refine": "refinement",
    "register": "pyklip_backend",
    "simulate": "simulation",
    "unregister": "pyklip_backend",
}
"""The module each public name lives in."""

try:
    __version__ = version("pyklip-diffrender")
except PackageNotFoundError:
    # A source tree that was put on the path without being installed.
    __version__ = "0+unknown"


def __getattr__(name: str) -> Any:
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_MODULE_OF[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
