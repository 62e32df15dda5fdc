"""Whether a fit may be subtracted, and what to say about one that has not converged."""

from __future__ import annotations

import math
import warnings
from typing import TYPE_CHECKING

from pyklip_diffrender.errors import DiffrenderWarning, RefinementError

if TYPE_CHECKING:
    from pyklip_diffrender.refinement import Refinement

__all__ = ["MAX_CHI2", "require_plausible", "warn_of_status"]

MAX_CHI2 = 100.0
"""Default of the largest reduced chi-squared of a plausible fit. Fits of real frames have 0.5 to 6,
12 with a bright disk; with a star in the wrong place it is in the thousands."""

_ADVICE = {
    "MODEL_MISMATCH": (
        "usual for real frames whose flat-field pattern is not known. Check the filter, the masks "
        "and the date of the wavefront map; reference frames and systematics='references' help, "
        "and disk=True for a star with a disk"
    ),
    "PRIOR_MISMATCH": (
        "take a wavefront map nearer in time, or let the scales of the prior be fitted "
        "(WavefrontPrior(fit_scales=True))"
    ),
    "ITERATION_LIMIT": (
        "the best iterate was subtracted. Raise max_iterations, for example "
        "fit=GaussNewton.nircam(max_iterations=80)"
    ),
}


def require_plausible(name: str, result: Refinement, limit: float) -> None:
    """Refuse a fit that failed, or that has nothing to do with the frames.

    Raises
    ------
    RefinementError
    """
    from pyklip_diffrender.refinement.status import WHAT_TO_CHECK

    if not result.status.usable:
        raise RefinementError(f"{name}: the fit ended as {result.status}", result)
    chi2 = reduced_chi2(result)
    if chi2 > limit:
        raise RefinementError(
            f"{name}: reduced chi-squared is {chi2:.3g}, above max_chi2={limit:g}: the rendered "
            f"star is not the star in these frames. {WHAT_TO_CHECK} For a companion as bright as "
            "the star's halo, give fit=GaussNewton.nircam(companions=...). max_chi2=inf subtracts "
            "whatever was fitted",
            result,
        )


def reduced_chi2(result: Refinement) -> float:
    """Chi-squared per degree of freedom, or per pixel where that is not known."""
    reduced = float(result.reduced_chi2)
    return reduced if math.isfinite(reduced) else float(result.chi2_per_pixel)


def warn_of_status(name: str, result: Refinement) -> None:
    """Say what to do about a fit that is usable but has not converged.

    Warns
    -----
    DiffrenderWarning
    """
    advice = _ADVICE.get(result.status.name)
    if advice is not None:
        warnings.warn(
            f"{name}: the fit ended as {result.status} (chi-squared per pixel "
            f"{result.chi2_per_pixel:.3g}). What to do: {advice}. See "
            "'Reading a status' in the documentation",
            DiffrenderWarning,
            stacklevel=2,
        )
