"""The error of a fit whose linear algebra breaks down."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch

from pyklip_diffrender.errors import RefinementError

__all__ = ["WHAT_TO_CHECK", "breakdown_explained"]

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
