"""How a refinement ended, and the error of one whose linear algebra breaks down."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from enum import Enum

import torch

from pyklip_diffrender.errors import RefinementError

__all__ = ["WHAT_TO_CHECK", "Status", "breakdown_explained"]


class Status(Enum):
    """How a refinement ended; the values are the messages.

    Examples
    --------
    >>> from pyklip_diffrender import Status
    >>> [status.name for status in Status if not status.usable]
    ['DIVERGED']
    >>> [status.name for status in Status if status.calibrated]
    ['CONVERGED']
    >>> print(Status.ITERATION_LIMIT)
    ITERATION_LIMIT: stopped at the limit of iterations before it converged
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
    DIVERGED = "the fitted star has no light, or the loss is not a number"

    def __str__(self) -> str:
        return f"{self.name}: {self.value}"

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
        """Whether the fit converged to a model that explains the data.

        The errors of the fit then need no factor. `detect` still multiplies those of sources in
        real frames by the scatter of the S/N, because neighbouring pixels share errors of the model
        that chi-squared does not show.
        """
        return self is Status.CONVERGED


WHAT_TO_CHECK = (
    "Check the star's position in the header (STARCENX/Y, else CRPIX1/2), the filter, the masks "
    "and the errors, and the unit, the orientation and the date of the wavefront map."
)


@contextmanager
def breakdown_explained(name: str) -> Iterator[None]:
    """Turn a breakdown of the linear algebra of a fit into a `RefinementError`.

    Parameters
    ----------
    name : str
        Of the frames, for the message.
    """
    try:
        yield
    except torch.linalg.LinAlgError as error:  # type: ignore[attr-defined]
        raise RefinementError(
            f"{name}: the fit broke down, as it does where the frames show something else than the "
            f"star that the model renders. {WHAT_TO_CHECK} ({error})"
        ) from error
