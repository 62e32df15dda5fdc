"""How fine a model has to be for a scene: measured, chosen, verified."""

from __future__ import annotations

from pyklip_diffrender.planning.choice import Choice, Economy, Error, Option
from pyklip_diffrender.planning.planning import plan
from pyklip_diffrender.planning.result import Plan

__all__ = ["Choice", "Economy", "Error", "Option", "Plan", "plan"]
