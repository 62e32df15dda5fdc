"""How a refinement ended."""

from __future__ import annotations

from enum import Enum

__all__ = ["Status"]


class Status(Enum):
    """How a refinement ended; the values are the messages.

    Examples
    --------
    >>> from pyklip_diffrender import Status
    >>> [status.name for status in Status if not status.usable]
    ['DIVERGED']
    >>> Status.CONVERGED.calibrated
    True
    """

    CONVERGED = "converged, and the model explains the data within their noise"
    MODEL_MISMATCH = (
        "converged, but the model does not explain the data: errors include a model error"
    )
    PRIOR_MISMATCH = (
        "converged, but the wavefront is improbable under a prior that was held fixed, so that "
        "errors are too small; let the prior's scales be fitted (fit_scales=True), or widen them"
    )
    ITERATION_LIMIT = "stopped at the limit of iterations before it converged"
    DIVERGED = "failed: the fitted star has no light, or the loss is not a number"

    @property
    def message(self) -> str:
        """Text of the status: its value."""
        return self.value

    @property
    def usable(self) -> bool:
        """Whether the result may be subtracted."""
        return self is not Status.DIVERGED

    @property
    def calibrated(self) -> bool:
        """Whether the stated errors are reliable without a further factor."""
        return self not in (Status.MODEL_MISMATCH, Status.PRIOR_MISMATCH, Status.DIVERGED)
