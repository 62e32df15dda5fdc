"""Reductions of a spaceKLIP database: `run_obs` in place of spaceKLIP's own.

spaceKLIP is imported only where one of its functions is needed.
"""

from __future__ import annotations

from pyklip_diffrender.spaceklip.run import run_obs

__all__ = ["run_obs"]
