"""The linear model of a fit: derivatives of the image, and the algebra of marginalisation."""

from __future__ import annotations

from pyklip_diffrender.linear.model import LinearModel

__all__ = ["LinearModel"]
