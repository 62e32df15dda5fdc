"""Exceptions and warnings of this package.

Messages state the value, what was expected, and the likely fix. Errors about a value
are also `ValueError`, errors about a file are also `OSError`, so that generic
handlers catch them.
"""

from __future__ import annotations

from typing import Any


class DiffrenderError(Exception):
    """Base of all errors of this package."""


class UnitError(DiffrenderError, ValueError):
    """A quantity has no unit where one is needed, or one that does not convert."""


class ShapeError(DiffrenderError, ValueError):
    """An array has the wrong shape."""


class NonFiniteError(DiffrenderError, ValueError):
    """NaN or infinity where a number is needed."""


class NoValidPixelsError(DiffrenderError, ValueError):
    """There are no unmasked pixels to fit."""


class IncompatibleSetupError(DiffrenderError, ValueError):
    """Settings are incompatible, such as a filter and a mask of different channels."""


class MissingOPDError(DiffrenderError, ValueError):
    """A reduction was requested without a starting OPD map."""


class CorruptFileError(DiffrenderError, OSError):
    """A file is missing, truncated, or not of the expected type."""


class MissingFileError(CorruptFileError, FileNotFoundError):
    """There is no such file."""


class ExistingFileError(DiffrenderError, FileExistsError):
    """A file would be replaced, and nobody asked for that with `overwrite`."""


class ArchiveError(DiffrenderError, OSError):
    """The archive cannot be reached, or does not give what it was asked for."""


class RefinementError(DiffrenderError, RuntimeError):
    """A refinement failed.

    Attributes
    ----------
    result : Refinement or None
        The best iterate, for diagnosis.
    """

    def __init__(self, message: str, result: Any = None) -> None:
        super().__init__(message)
        self.result = result


class DiffrenderWarning(UserWarning):
    """Input is suspicious, but not certainly wrong."""
