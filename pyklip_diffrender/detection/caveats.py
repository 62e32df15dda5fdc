"""Caveats about the candidates of a search."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from pyklip_diffrender.detection.relinearise import unconfirmed_companions
from pyklip_diffrender.refinement import Refinement

__all__ = ["caveats", "count_rolls"]


def count_rolls(fits: Sequence[Refinement]) -> int:
    """Number of orientations of the target's frames that differ by more than a degree."""
    angles = sorted(
        each.observation.position_angle
        for fit in fits
        for each in fit.frames
        if not each.observation.reference
    )
    steps = np.diff(angles, append=angles[0] + 360)
    return max(1, int((steps > 1).sum()))


def caveats(detection: Any) -> str:
    """Sources that only the fit of a `Detection` has, and what a single roll cannot tell."""
    fits = detection.fits
    sources = unconfirmed_companions(fits, detection.sources) if fits else ()
    remarks = [
        f"A possible source of contrast {contrast:.1e} at {math.hypot(x, y):.2f} arcsec was "
        "fitted with the star; the search does not confirm it."
        for contrast, x, y in sources
    ]
    if detection.rolls == 1 and detection.observation.is_nircam:
        step = np.rad2deg(detection.contrast_curve.meta["resolution_arcsec"])
        remarks.append(
            "One roll: structure that is fixed on the detector cannot be told from a planet. A "
            f"second roll by 10 degrees would tell them apart beyond {step / 10:.1f} arcsec, where "
            "it moves a planet by more than lambda/D."
        )
    return " ".join(remarks)
