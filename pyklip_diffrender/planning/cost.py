"""Seconds and bytes of a refinement, from counts of operations.

Counted and not timed: a plan must come out the same on a busy machine. The rates are those of one
core (2026); what differs between machines is nearly the same for all options.
"""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from pyklip_diffrender.planning.choice import Choice

__all__ = ["Workload"]

_FULL_STEPS = 6
"""Linearisations of a fit that the wavefront takes part in."""

_DERIVATIVES = 4
"""How often a fit propagates derivatives by the alignment: before those steps and per response."""

_RENDERS = 10
"""Stars that a fit renders."""

_SOLVES = 12
_INVERSES = 6

_PER_PIXEL_OF_PUPIL = 4.5e-2 / 1024**2
_PER_FIELD = 3e-3
_WAVEFRONT = 3.3e-2 / 1024**2
"""Seconds to sum the modes on a sample of the pupil."""

_SLOPES = 3e-2
"""Seconds for the derivatives of the field with respect to the alignment."""

_PER_MODE = 4e-4
_PER_MODE_SAMPLE = 6e-8
_MATRIX_PER_MODE_SAMPLE = 8e-8
"""Seconds for a mode's response on a pupil's sample, plane by plane."""

_PRODUCT = 1.1e-11
_CHOLESKY = 8.2e-12
_INVERSE = 7.5e-12
_PER_SLOPE = 8e-9
_PER_SLOPE_AND_WAVE = 4e-9
_PER_EFFECT = 5e-9


@dataclass(frozen=True)
class Workload:
    """What does not depend on the choice.

    Attributes
    ----------
    samples : int
        Detector samples.
    pixels : int
        Detector pixels.
    lattice : bool
        Whether the model takes the route "lattice".
    device : str
        "cpu" or another.
    frequencies : Tensor, (modes,)
        Of the finest basis, cycles across the pupil.
    """

    samples: int
    pixels: int
    lattice: bool
    device: str
    frequencies: Tensor

    def modes(self, cycles: float) -> int:
        """Number of modes up to a frequency."""
        return int((self.frequencies <= cycles).sum())

    def seconds(self, choice: Choice, *, informative: float = 1.0, effects: int = 0) -> float:
        """Of a refinement.

        Parameters
        ----------
        choice : Choice
        informative : float
            Share of the pixels that say something about the wavefront.
        effects : int
            Optional parts that are left in.
        """
        modes, waves = self.modes(choice.cycles), choice.wavelengths
        # Graphics cards have at most half their speed in double precision.
        speed = 0.5 if choice.dtype == "float32" and self.device != "cpu" else 1.0
        sampling = choice.occulter_sampling or 4.0
        occulter = 1.0 if self.lattice else sampling / 4
        pupil = _PER_PIXEL_OF_PUPIL * choice.npix**2 * occulter
        render = waves * speed * (_PER_FIELD + pupil) + _WAVEFRONT * choice.npix**2
        mode = _PER_MODE + _PER_MODE_SAMPLE * self.samples
        if not self.lattice:
            mode += _MATRIX_PER_MODE_SAMPLE * choice.response_npix**2
        slopes = modes * self.samples
        return (
            _RENDERS * render
            + waves * modes * mode
            + _DERIVATIVES * waves * _SLOPES
            + _FULL_STEPS * slopes * (_PER_SLOPE + waves * _PER_SLOPE_AND_WAVE)
            + _FULL_STEPS * effects * slopes * _PER_EFFECT
            + _FULL_STEPS * _PRODUCT * modes**2 * self.pixels * informative
            + (_SOLVES * _CHOLESKY + _INVERSES * _INVERSE) * modes**3
        )

    def memory(self, choice: Choice) -> float:
        """Bytes at most: the response, the Jacobian twice, the equations, the pupil's fields."""
        modes = self.modes(choice.cycles)
        real = 4 if choice.dtype == "float32" else 8
        return (
            8.0 * choice.wavelengths * modes * self.samples
            + 12.0 * modes * self.pixels
            + 32.0 * modes**2
            + 8.0 * real * choice.npix**2
        )
