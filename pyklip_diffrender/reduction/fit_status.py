"""Whether a fit may be subtracted, and what to do about one that has not converged."""

from __future__ import annotations

import math
import warnings

from pyklip_diffrender.errors import DiffrenderWarning, RefinementError
from pyklip_diffrender.refinement import Refinement, Status
from pyklip_diffrender.refinement.fit_result import WHAT_TO_CHECK

MAX_CHI2 = 100.0
"""Default of the largest reduced chi-squared of a plausible fit. Fits of real frames have 0.5 to 6,
12 with a bright disk; with a star in the wrong place it is in the thousands."""

_ADVICE = {
    Status.CONVERGED: "The stated errors and limits can be used as they are.",
    Status.MODEL_MISMATCH: (
        "Errors of candidates are scaled to the scatter in the S/N map, and the reduction takes "
        "part in a combined search. See whether a faint candidate is in every roll and looks like "
        "a point source, and check the filter, the masks and the date of the OPD map. For a "
        "star with a disk, use the option disk."
    ),
    Status.PRIOR_MISMATCH: (
        "The prior was widened to the size of the wavefront, which still exceeds it. Errors of "
        "candidates are scaled to the scatter in the S/N map, and the reduction takes part in a "
        "combined search. Check the OPD map, and take one that is nearer in time."
    ),
    Status.ITERATION_LIMIT: (
        "The result is the best iterate. If chi-squared was still falling in the history of the "
        "fit, repeat it with more steps, such as FitSettings.nircam(max_iterations=80); if it "
        "hardly changed, try an OPD map nearer in time."
    ),
    Status.DIVERGED: (
        "Do not use this result. Check the unit and orientation of the OPD map, the position "
        "of the star and the pixel mask."
    ),
}

_REFERENCES = (
    " The detector pattern was not known: add reference stars, or the pattern.fits of an "
    "earlier reduction."
)


def require_plausible(name: str, result: Refinement, limit: float) -> None:
    """Raise RefinementError for a fit that failed, or has nothing to do with the frames."""
    if not result.status.usable:
        raise RefinementError(f"{name}: the fit ended as {result.status}", result)
    # Per pixel where the degrees of freedom are not known.
    reduced = float(result.reduced_chi2)
    chi2 = reduced if math.isfinite(reduced) else float(result.chi2_per_pixel)
    if chi2 > limit:
        raise RefinementError(
            f"{name}: reduced chi-squared is {chi2:.3g}, above max_chi2={limit:g}: the rendered "
            f"star is not the star in these frames. {WHAT_TO_CHECK} For a companion as bright as "
            "the star's halo, give fit=FitSettings.nircam(companions=...). max_chi2=inf subtracts "
            "whatever was fitted",
            result,
        )


def warn_of_status(name: str, result: Refinement) -> None:
    """Warn of a fit that is usable but has not converged, and say what to do about it."""
    if result.status is not Status.CONVERGED:
        todo = advice(result.status, patterned=result.pattern is not None)
        warnings.warn(
            f"{name}: the fit ended as {result.status} (chi-squared per pixel "
            f"{result.chi2_per_pixel:.3g}). What to do: {todo} See 'Reading a status' in the "
            "documentation",
            DiffrenderWarning,
            stacklevel=2,
        )


def advice(status: Status, *, patterned: bool, remark: str = "") -> str:
    """Advice about the status of a fit, with or without a known detector pattern."""
    missing = _REFERENCES if status is Status.MODEL_MISMATCH and not patterned else ""
    return f"{_ADVICE[status]}{missing} {remark}".rstrip()
