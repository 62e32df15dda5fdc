"""Time of a refinement, from counts of operations.

Operations are counted, not timed, so that a plan is the same on a busy machine. The rates are those
of one core in 2026; another machine scales nearly all options alike.
"""

from __future__ import annotations

import torch

from pyklip_diffrender.optics.system import OpticalSystem
from pyklip_diffrender.planning.choice import Choice

__all__ = ["seconds"]

_RENDERS = 10
"""Star images that a fit renders."""

_STEPS = 6
"""Linearisations of a fit that include the wavefront."""


def seconds(
    model: OpticalSystem, choice: Choice, *, modes: int, effects: int, response_npix: int
) -> float:
    """Expected time of a refinement on one core, s.

    Parameters
    ----------
    model : OpticalSystem
        As given.
    choice : Choice
    modes : int
        Number of wavefront modes up to ``choice.cycles``.
    effects : int
        Number of optional parts that are kept.
    response_npix : int
        Pupil samples of the copy that computes derivatives.
    """
    waves, planes = choice.wavelengths, model.route == "planes"
    pixels = model.detector.shape[0] * model.detector.shape[1]
    samples = pixels * model.detector.oversample**2
    pupil = (choice.npix / 1024) ** 2
    occulter = (choice.occulter_sampling or 4.0) / 4 if planes else 1.0
    # Graphics cards have at most half their speed in double precision.
    single = choice.dtype == torch.float32 and model.device.type != "cpu"
    field = (3e-3 + 4.5e-2 * pupil * occulter) * (0.5 if single else 1.0)
    response = 4e-4 + 6e-8 * samples + (8e-8 * response_npix**2 if planes else 0.0)
    row = samples * (8e-9 + 4e-9 * waves + 5e-9 * effects)
    return (
        _RENDERS * (waves * field + 3.3e-2 * pupil)  # The second sums the modes on the pupil.
        + waves * modes * response
        + waves * 4 * 3e-2  # Derivatives by the alignment.
        + _STEPS * modes * (row + 1.1e-11 * modes * pixels)  # Jacobian and its square.
        + 1.4e-10 * modes**3  # Solutions and inverses.
    )
