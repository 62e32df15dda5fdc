"""Every error that this package raises on purpose, in one tree.

A message says what was got, what was expected and the likely fix. Errors about a value
are also `ValueError`, errors about a file are also `OSError`, so that callers who do not
know this package still catch them.
"""

from __future__ import annotations

from typing import Any

__all__ = [
    "CorruptFileError",
    "DiffrenderError",
    "DiffrenderWarning",
    "IncompatibleSetupError",
    "MissingOPDError",
    "NoValidPixelsError",
    "NonFiniteError",
    "RefinementError",
    "ShapeError",
    "UnitError",
]


class DiffrenderError(Exception):
    """Base of all errors of this package."""


class UnitError(DiffrenderError, ValueError):
    """A quantity has no unit where one is needed, or one that does not convert."""


class ShapeError(DiffrenderError, ValueError):
    """An array has a shape that does not fit."""


class NonFiniteError(DiffrenderError, ValueError):
    """NaN or infinity where a number is needed."""


class NoValidPixelsError(DiffrenderError, ValueError):
    """Nothing is left to fit once the masked pixels are taken out."""


class IncompatibleSetupError(DiffrenderError, ValueError):
    """Parts that do not go together, such as a filter that a mask does not take."""


class MissingOPDError(DiffrenderError, ValueError):
    """A reduction was asked for without a wavefront map to start from."""


class CorruptFileError(DiffrenderError, OSError):
    """A file is missing, truncated, or not what its name says."""


class RefinementError(DiffrenderError, RuntimeError):
    """A refinement did not end in a usable result.

    Attributes
    ----------
    result : Refinement or None
        The best iterate, for a look at what went wrong.
    """

    def __init__(self, message: str, result: Any = None) -> None:
        super().__init__(message)
        self.result = result


class DiffrenderWarning(UserWarning):
    """Something is suspicious but not certainly wrong."""
