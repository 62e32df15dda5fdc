"""Remarks on a fit, on its OPD map, and on candidates that look like extended light."""

from __future__ import annotations

import math
import warnings

import numpy as np
from astropy.table import QTable
from numpy.typing import NDArray
from scipy.special import gammainc

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
    parts = [_ADVICE[status]]
    if status is Status.MODEL_MISMATCH and not patterned:
        parts.append(
            "The detector pattern was not known: add reference stars, or the pattern.fits of an "
            "earlier reduction."
        )
    return " ".join([*parts, remark]).rstrip()


_CHANCE_PROBABILITY = 0.01
"""Probability below which unrelated sources are not taken to be arranged by chance."""


def looks_extended(candidates: QTable, resolution: float, edge: float) -> str:
    """Say how candidates are arranged like extended light; empty if they may be so by chance.

    `candidates` has x and y from the star, and frame_angle; `resolution` is lambda/D and `edge` the
    largest separation that was searched, arcsec.
    """
    # Sources that have nothing to do with each other have independent position angles, and are
    # spread evenly over the field. The number of candidates alone says nothing.
    count = len(candidates)
    if count < 2:
        return ""
    if count > 2:
        axes = np.sort(candidates["frame_angle"].value % 180)
        gaps = np.diff(axes, append=axes[0] + 180)
        # All axes are in the arc that is left by the largest gap. The probability that n random
        # axes are in an arc a of their circle, a < 1/2, is n a^(n - 1).
        arc = 1 - gaps.max() / 180
        if arc < 0.5 and count * arc ** (count - 1) < _CHANCE_PROBABILITY:
            return "The candidates are in line with the star, like an edge-on disk"
    places = np.stack([candidates["x"].value, candidates["y"].value], axis=1)
    distances = np.hypot(*(places[:, None] - places).T)[np.triu_indices(count, 1)]
    # Each of the n (n - 1) / 2 pairs is within reach of each other with the probability
    # (reach / edge)^2, the ratio of two areas, so that their number is nearly Poisson's.
    reach = 1.5 * resolution  # One extended source is found as several this close.
    expected = len(distances) * (reach / edge) ** 2
    # The probability of n pairs or more is the regularised incomplete gamma function of n.
    if gammainc((distances < reach).sum(), expected) < _CHANCE_PROBABILITY:
        return "Candidates are next to each other, like parts of an extended source"
    return ""


def on_extended_light(candidates: QTable, offsets: NDArray[np.float64], resolution: float) -> str:
    """Say which candidates lie on extended light that was fitted; empty if none does.

    `candidates` has x, y and separation. `offsets` (k, 2) are x, y of the sources of the extended
    light from the star; `resolution` is lambda/D, arcsec.
    """
    if not len(candidates) or not len(offsets):
        return ""
    places = np.stack([candidates["x"].value, candidates["y"].value], axis=1)
    away = np.hypot(*np.moveaxis(places[:, None] - offsets, -1, 0)).min(axis=1)
    near = np.sort(candidates["separation"].value[away < resolution])
    if not len(near):
        return ""
    separations = ", ".join(f"{each:.2f}" for each in near)
    return (
        f"On the extended light, candidates at {separations} arcsec may be parts of it that its "
        "fit has left."
    )
