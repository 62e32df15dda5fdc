"""Choose how fine a model must be for a scene, by measuring the errors of cheaper settings."""

from __future__ import annotations

from pyklip_diffrender.planning.choice import Choice, Economy, ModelError, Option
from pyklip_diffrender.planning.planner import plan
from pyklip_diffrender.planning.result import Plan
from pyklip_diffrender.planning.systems import coarse_steps

__all__ = ["Choice", "Economy", "ModelError", "Option", "Plan", "coarse_steps", "plan"]
