"""The pyKLIP backend: ``algo="diffrender"`` in `klip_dataset`.

Importing this package does not import pyKLIP; `register` and `backend` do.
"""

from __future__ import annotations

from pyklip_diffrender.pyklip_backend.backend_settings import DiffrenderSettings
from pyklip_diffrender.pyklip_backend.dataset_frames import observation_from_dataset
from pyklip_diffrender.pyklip_backend.registration import (
    backend,
    is_registered,
    register,
    unregister,
)
from pyklip_diffrender.pyklip_backend.subtract import Fit, Subtraction, subtract_by_refinement

__all__ = [
    "DiffrenderSettings",
    "Fit",
    "Subtraction",
    "backend",
    "is_registered",
    "observation_from_dataset",
    "register",
    "subtract_by_refinement",
    "unregister",
]
