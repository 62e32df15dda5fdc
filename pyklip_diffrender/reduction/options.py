"""The options of a reduction, checked before any work."""

from __future__ import annotations

import difflib
import os
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, Literal, Self

from astropy import units as u

from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.io.units import require_bound, to_bytes
from pyklip_diffrender.pattern import PatternRequest, as_request
from pyklip_diffrender.refinement import GaussNewton, to_jansky

__all__ = ["ReduceOptions"]

_REFERENCES = ("joint", "pattern", "off")

_SMALLEST = 8
"""Side of the smallest fitted square, pixels."""


@dataclass(frozen=True)
class ReduceOptions:
    """Options of `reduce`, which the command line and surveys share.

    Parameters
    ----------
    size : int
        Side in pixels of the square about the star that is fitted.
    systematics : Systematics, PatternLibrary, path, "auto", "references" or "off"
        Flat-field pattern, or a file with one (``systematics.fits``); or a library of patterns to
        search besides the package's, its file, or a folder of such files. "auto" takes the pattern
        of the package's library (see `known_systematics`), and fits the reference stars only where
        there is none for these pixels; "references" fits them in any case and uses both. A fit that
        shows less than half of a library's pattern is repeated without libraries. If neither has
        the pattern, rolls on the same pixels are assumed to have one of the usual strength in
        common. With "off" there is no pattern.
    references : {"joint", "pattern", "off"}
        What the frames of reference stars are for. With "joint" they are fitted together with the
        target's, in one likelihood, if that makes the limits deeper; with "pattern" they teach the
        flat-field pattern where the library has none; with "off" they are not used. With `disk`,
        "joint" stands for "pattern".
    settings : GaussNewton, optional
        Settings of the fits; default those of `refine`.
    threshold : float
        S/N of a candidate.
    wide : bool
        Search the whole frames as well, see `wide_field`. If sources beyond the fitted pixels are
        bright enough to be seen in these, the star is fitted once more without their light.
    disk : bool
        Fit extended light about the star, see `fit_disk`, and search the frames without it. The
        limits are those of the positions where a planet would not be taken for a part of it.
    injections : int
        Number of planets to add to the fitted frames, slightly brighter than the limits, to see
        how well they are recovered; see `recover_planets`. Seven of them take as long as the
        fit and the search, fewer where the fitted square is smaller than 80 pixels.
    completeness : bool
        Compute the fraction of planets that the search finds, by contrast and separation; see
        `completeness`. Takes a few minutes for two rolls.
    star_flux : float, str or Quantity, optional
        Flux density of the star in the filter, from a catalogue or a model of its spectrum: Jy, or
        an AB magnitude. Contrasts then refer to it, as spaceKLIP's do. By default the light that
        is diffracted around the mask determines the star's flux, to 10 %, which errors of
        contrasts include. Flux densities of planets do not depend on it. Takes a second, shorter
        fit.
    star_flux_error : float
        Relative error of `star_flux`, at most 1, with that of the photometric calibration of the
        frames.
    accuracy : "full" or "quick"
        "quick" is for a first look: the model has fewer wavelengths and pupil samples, and the fit
        fewer modes, all the fewer the fainter the star is compared with its noise. For one roll of
        G 7-34 it took 0.7 of the time, and limits were 0.94 to 1.07 times those of a full
        reduction; other stars were not measured. Not together with `settings`.
    device : str
        PyTorch device of the optical model.
    memory : float, str or Quantity, optional
        Memory that the process may take, bytes or such as "2 GB"; see `GaussNewton`, whose value
        it replaces.
    start : dict, optional
        Starting values of the fit by parameter name, as for `refine`.
    max_chi2 : float, optional
        Reduced chi-squared of a fit above which the reduction stops with a `RefinementError`; by
        default a fit that does not explain the frames is reported.

    Attributes
    ----------
    star_flux : float or None
        Jy.
    memory : float or None
        Bytes.

    Raises
    ------
    IncompatibleSetupError
        For a value out of bounds, for `settings` of a quick reduction, and for `wide` together with
        `disk`: beyond the fitted pixels a disk would be taken for point sources.
    UnitError, ShapeError, NonFiniteError
        For a flux density, an error or a memory that is none.
    CorruptFileError
        For a file or folder of `systematics` that is damaged or has no pattern.

    Examples
    --------
    >>> from pyklip_diffrender.reduction import ReduceOptions
    >>> ReduceOptions(star_flux="450 mJy").star_flux
    0.45
    """

    size: int = 80
    systematics: PatternRequest | str | os.PathLike[str] = "auto"
    references: str = "joint"
    settings: GaussNewton | None = None
    threshold: float = 5.0
    wide: bool = False
    disk: bool = False
    injections: int = 0
    completeness: bool = False
    star_flux: float | str | u.Quantity | None = None
    star_flux_error: float = 0.05
    accuracy: Literal["full", "quick"] = "full"
    device: str = "cpu"
    memory: float | str | u.Quantity | None = None
    start: Mapping[str, Any] | None = None
    max_chi2: float | None = None

    def __post_init__(self) -> None:
        _require_whole(self.size, "size", _SMALLEST)
        if self.references not in _REFERENCES:
            raise IncompatibleSetupError(
                f"references: got {self.references!r}, expected one of {', '.join(_REFERENCES)}"
            )
        _require_whole(self.injections, "injections", 0)
        require_bound(self.threshold, "threshold", "positive")
        require_bound(self.star_flux_error, "star_flux_error", "positive")
        if self.star_flux_error > 1:
            raise IncompatibleSetupError(
                f"star_flux_error: got {self.star_flux_error:g}, expected a relative error of at "
                f"most 1; {self.star_flux_error:g} % are {self.star_flux_error / 100:g}"
            )
        if self.accuracy not in ("full", "quick"):
            raise IncompatibleSetupError(
                f"accuracy: got {self.accuracy!r}, expected 'full' or 'quick'"
            )
        if self.accuracy == "quick" and self.settings is not None:
            raise IncompatibleSetupError(
                "accuracy, settings: got 'quick' and settings, expected one of them: a first look "
                "chooses its own settings"
            )
        if self.wide and self.disk:
            raise IncompatibleSetupError(
                "wide, disk: got both, expected one of them: beyond the fitted pixels a disk would "
                "be taken for point sources. Reduce the frames twice"
            )
        if self.star_flux is not None:
            object.__setattr__(self, "star_flux", to_jansky(self.star_flux))
        if self.max_chi2 is not None and not self.max_chi2 > 0:
            raise IncompatibleSetupError(
                f"max_chi2: got {self.max_chi2}, expected a positive number; inf for no limit"
            )
        if self.memory is not None:
            object.__setattr__(self, "memory", to_bytes(self.memory, "memory"))
        object.__setattr__(self, "systematics", as_request(self.systematics))

    @classmethod
    def from_keywords(cls, keywords: Mapping[str, Any]) -> Self:
        """Make options from keywords of `reduce`.

        Raises
        ------
        TypeError
            For a keyword that is no option, with the nearest that is one.
        """
        known = [each.name for each in fields(cls)]
        for name in keywords:
            if name not in known:
                near = difflib.get_close_matches(name, known, n=1)
                hint = f". Did you mean {near[0]!r}?" if near else ""
                raise TypeError(
                    f"reduce() got an unexpected keyword argument {name!r}, expected some of "
                    f"{', '.join(known)}{hint}"
                )
        return cls(**keywords)


def _require_whole(value: Any, name: str, least: int) -> None:
    if isinstance(value, bool) or value != int(value) or value < least:
        raise IncompatibleSetupError(
            f"{name}: got {value!r}, expected a whole number of at least {least}"
        )
