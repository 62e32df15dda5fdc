"""The options of a reduction, each declared once, with its default, its check and its texts.

An option is a field of `ReduceOptions`. The docstring of that class, the command line, the keys of
surveys, the pyKLIP backend and the page of options in the documentation are made from the fields.
Only type checkers need a second list: `ReduceKeywords`, which a test compares with the fields.

The command line shows its help from this module, so whatever loads numpy or PyTorch is imported in
functions.
"""

from __future__ import annotations

import difflib
import inspect
import math
import os
import textwrap
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from numbers import Real
from typing import TYPE_CHECKING, Any, Literal, Self, TypeAlias, TypedDict, get_args

from pyklip_diffrender.errors import IncompatibleSetupError

if TYPE_CHECKING:
    from astropy import units as u

    from pyklip_diffrender.pattern import PatternRequest
    from pyklip_diffrender.refinement import FitSettings

# How an option is declared.


@dataclass(frozen=True)
class Option:
    """An option: its values, its texts, and where it can be set.

    Attributes
    ----------
    name : str
    default : object
        None for an option that need not be set.
    meaning : str
        Full description, for docstrings and the documentation.
    kind : type
        Type of plain values; by default the type of `default`, unless it is None.
    least : int
        Smallest value of an int.
    most : float
        Largest value of a float, which is above 0.
    choices : tuple of str
        Words among which to choose.
    path : bool
        Whether a path may be given in place of one of `choices`.
    text : bool
        Whether a number may also be a Quantity, or text such as "2 GB".
    stated_type : str
        Type as docstrings state it.
    expected : str
        End of the message about any other value, after "got ..., expected".
    help : str
        Description in the help of the command line.
    metavar : str or None
        Placeholder of the value in the help.
    section : str
        Section of the help.
    flag : str
        Option of the command line. One of another name than the option has no value, and stands for
        the last of two `choices`.
    not_on_command_line, not_in_surveys : str
        Why the command line, or surveys, do not have the option.
    """

    name: str
    default: Any
    meaning: str
    kind: type
    least: int = 0
    most: float = 1e30
    choices: tuple[str, ...] = ()
    path: bool = False
    text: bool = False
    stated_type: str = ""
    expected: str = ""
    help: str = ""
    metavar: str | None = None
    section: str = "Fit and search"
    flag: str = ""
    not_on_command_line: str = ""
    not_in_surveys: str = ""

    def __post_init__(self) -> None:
        quoted = ", ".join(f'"{choice}"' for choice in self.choices)
        texts = {
            "meaning": "",
            "help": "",
            "stated_type": f"{{{quoted}}}" if quoted else self.kind.__name__,
            "expected": {
                bool: "true or false",
                int: f"a whole number, {self.least} or more",
                float: "a positive number",
            }.get(self.kind, f"one of {', '.join(self.choices)}"),
            "flag": _flag(self.name),
        }
        for name, usual in texts.items():  # Each in one line.
            text = " ".join((getattr(self, name) or usual).split())
            object.__setattr__(self, name, text)

    def checked(self, value: Any) -> Any:
        """Return a plain value, such as TOML can hold, as it is stored.

        Values of other kinds, and choices that may be paths, come back as they are.

        Raises
        ------
        IncompatibleSetupError
            For a value that is not allowed.
        """
        if value is None and self.default is None:
            return None
        is_number = isinstance(value, Real) and not isinstance(value, bool)
        if self.kind is bool:
            # numpy has a type of its own.
            allowed = isinstance(value, bool) or type(value).__name__ == "bool"
        elif self.kind is int:
            allowed = is_number and self.least <= value < math.inf and value == int(value)
        elif self.kind is float:
            allowed = is_number and 0 < value <= self.most
        elif self.choices and not self.path:
            allowed = value in self.choices
        else:
            return value
        if not allowed:
            raise IncompatibleSetupError(f"{self.name}: got {value!r}, expected {self.expected}")
        return self.kind(value)

    @property
    def is_switch(self) -> bool:
        """Whether the option of the command line has no value."""
        return self.kind is bool or self.flag != _flag(self.name)

    @property
    def entry(self) -> str:
        """Entry in the section Parameters of a docstring."""
        indent = " " * 4
        text = textwrap.fill(
            self.meaning,
            92,
            initial_indent=indent,
            subsequent_indent=indent,
            break_on_hyphens=False,
        )
        return f"{self.name} : {self.stated_type}\n{text}"


def _flag(name: str) -> str:
    return f"--{name.replace('_', '-')}"


# The options. The metadata of a field are attributes of its `Option`.

References: TypeAlias = Literal["joint", "pattern", "off"]
Accuracy: TypeAlias = Literal["full", "quick"]


SPECTRA = ("blackbody", "flat", "free")
"""Spectra of planets in searches over filters, unless others are asked for."""

SIDE, QUICK_SIDE = 80, 56
"""Default sides of the fitted square, pixels: 80 are 5 arcsec, the reach of the occulter."""


@dataclass(frozen=True)
class SharedOptions:
    """Options of a reduction that surveys have, too: plain values; see `ReduceOptions`."""

    size: int | None = field(default=None, metadata={
        "kind": int, "least": 8, "stated_type": "int, optional",
        "meaning": """Side in pixels of the square about the star that is fitted; default 80, and 56
            for a first look with ``accuracy="quick"``.""",
        "expected": "a whole number of pixels, 8 or more",
        "help": """Side of the fitted square about the star, pixels; default 80, and 56 for a first
            look with --quick.""",
        "metavar": "N",
    })  # fmt: skip
    pattern: PatternRequest | str | os.PathLike[str] = field(default="auto", metadata={
        "choices": ("auto", "references", "off"), "path": True,
        "stated_type": 'DetectorPattern, PatternLibrary, path, "auto", "references" or "off"',
        "meaning": """Detector pattern, or a file with one (``pattern.fits``); or a library of
            patterns to search besides the package's, its file, or a folder of such files. "auto"
            takes the pattern of the package's library (see `known_pattern`), and learns it from
            reference stars where the library has none for these pixels; "references" learns it from
            them in any case and uses both. A fit that shows less than half of a library's pattern
            is repeated without libraries. If neither has the pattern, rolls on the same pixels are
            assumed to have one of the usual strength in common. With "off" there is no pattern.""",
        "expected": "'auto', 'references', 'off', or an existing file or folder with patterns",
        "help": """Detector pattern: auto (the package's library, else the reference stars),
            references (both), off, a folder or file of patterns to search besides the package's
            (command learn), or a pattern.fits of an earlier reduction.""",
        "metavar": "CHOICE",
    })  # fmt: skip
    references: References = field(default="joint", metadata={
        "choices": get_args(References),
        "meaning": """Use of the frames of reference stars. With "joint" frames of the target's
            epoch are fitted together with the target's, in one likelihood, where that makes the
            limits deeper, and frames of other epochs teach the detector pattern where the library
            has none; with "pattern" all of them do; with "off" they are for KLIP only. With `disk`,
            "joint" stands for "pattern". The guide "Detector pattern and reference stars" says what
            each frame is used for.""",
        "help": """Use of the frames of reference stars: in one likelihood with the target's, for
            the detector pattern, or not at all.""",
    })  # fmt: skip
    threshold: float = field(default=5.0, metadata={
        "meaning": "S/N of a candidate.", "help": "S/N of a candidate.", "metavar": "S/N",
    })  # fmt: skip
    wide: bool = field(default=False, metadata={
        "meaning": """Search the whole frames as well, see `wide_field`: of frames of the whole
            detector, the field of the mask, 20 arcsec wide. If sources beyond the fitted pixels are
            bright enough to be seen in these, the star is fitted once more without their light.""",
        "help": "Search the whole frames as well, to their edge or the edge of the mask's field.",
    })  # fmt: skip
    disk: bool = field(default=False, metadata={
        "meaning": """Fit extended light about the star, see `fit_disk`, and search the frames
            without it. The limits are for positions where a planet would not be taken for
            a part of it.""",
        "help": "Fit extended light about the star, such as a disk, together with the star.",
    })  # fmt: skip
    completeness: bool = field(default=False, metadata={
        "meaning": """Compute the fraction of planets that the search finds, by contrast and
            separation; see `completeness`. Takes a few minutes for two rolls.""",
        "help": """Compute the fraction of planets that the search finds, by contrast and
            separation. Takes a few minutes for two rolls.""",
    })  # fmt: skip
    star_flux: float | str | u.Quantity | None = field(default=None, metadata={
        "kind": float, "text": True, "stated_type": "float, str or Quantity, optional",
        "meaning": """Flux density of the star in the filter, from a catalogue or a model of its
            spectrum: Jy, text such as "403 mJy", or an AB magnitude such as "9.8 mag(AB)".
            Contrasts then refer to it, as spaceKLIP's do. By
            default the light that is diffracted around the mask determines the star's flux, to
            10 % (30 % with an old OPD map), which errors of contrasts include; a value that differs
            from it by more than a factor of three is refused after the fit, before the search. Flux
            densities of planets do not depend on it. Takes a second, shorter fit.""",
        "expected": "a flux density in Jy, such as 0.45",
        "help": """Flux density of the star in the filter, such as "0.45 Jy", to which contrasts
            refer; default: what diffracted light says, to 10 % or more.""",
        "metavar": "FLUX", "section": "Brightness of the star",
    })  # fmt: skip
    star_flux_error: float = field(default=0.05, metadata={
        "most": 1.0,
        "meaning": """Relative error of `star_flux`, at most 1, including the photometric
            calibration of the frames.""",
        "expected": "a relative error of at most 1, such as 0.05 for 5 %",
        "help": "Relative error of --star-flux, at most 1.",
        "metavar": "FRACTION", "section": "Brightness of the star",
    })  # fmt: skip

    @property
    def side(self) -> int:
        """Side of the fitted square, pixels: `size`, or the default where it is None."""
        return SIDE if self.size is None else self.size


@dataclass(frozen=True)
class ReduceOptions(SharedOptions):
    """Options of `reduce`, which the command line and surveys share.

    Parameters
    ----------
    (see the fields)

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
        For a flux density or a memory that is none.
    CorruptFileError
        For a file or folder of `pattern` that is damaged or has no pattern.

    Examples
    --------
    >>> from pyklip_diffrender.reduction import ReduceOptions
    >>> ReduceOptions(star_flux="450 mJy").star_flux
    0.45
    """

    settings: FitSettings | None = field(default=None, metadata={
        "stated_type": "FitSettings, optional",
        "meaning": "Settings of the fits; by default as in `refine`.",
        "not_on_command_line": "an object of Python",
        "not_in_surveys": "they have a table with the arguments of FitSettings",
    })  # fmt: skip
    injections: int = field(default=0, metadata={
        "meaning": """Number of planets to add to the fitted frames, slightly brighter than the
            limits, to see how well they are recovered; see `recover_planets`. Seven of them take as
            long as the fit and the search, fewer where the fitted square is smaller than 80
            pixels.""",
        "help": """Add N planets slightly brighter than the limits to the frames, and report how
            well they are recovered. Seven take as long as the fit and the search.""",
        "metavar": "N", "not_in_surveys": "they have a table of planets, with a job for each",
    })  # fmt: skip
    accuracy: Accuracy = field(default="full", metadata={
        "choices": get_args(Accuracy), "stated_type": '"full" or "quick"',
        "meaning": """
            "quick" is for a first look: the model has fewer pupil samples, the fit fewer modes, all
            the fewer the fainter the star is compared with its noise, and fewer pixels. Rolls of G
            7-34 and HIP 17695, and pairs of them, took 0.22 to 0.39 of the time of a full
            reduction, with limits 0.87 to 1.15 times as high, out to 1.7 arcsec, because the
            star's flux is less certain. Not together with `settings`.""",
        "help": "A first look with a coarser model near the star, in a third to half of the time.",
        "flag": "--quick", "not_in_surveys": "they are no first look",
    })  # fmt: skip
    device: str = field(default="cpu", metadata={
        "meaning": "PyTorch device of the optical model.",
        "help": "PyTorch device of the optical model, such as cuda.",
        "section": "General", "not_in_surveys": "their workers compute on processors",
    })  # fmt: skip
    memory: float | str | u.Quantity | None = field(default=None, metadata={
        "kind": float, "text": True, "stated_type": "float, str or Quantity, optional",
        "meaning": """Memory that the process may take, bytes or such as "2 GB"; see `FitSettings`,
            whose value it replaces.""",
        "help": 'Memory that the process may take, such as "2 GB"; default: as much as it needs.',
        "metavar": "SIZE", "not_in_surveys": "their memory_limit says how much a worker has",
    })  # fmt: skip
    start: Mapping[str, Any] | None = field(default=None, metadata={
        "stated_type": "dict, optional",
        "meaning": "Starting values of the fit by parameter name, as for `refine`.",
        "not_on_command_line": "an object of Python",
        "not_in_surveys": "it is for one set of frames",
    })  # fmt: skip
    max_chi2: float | None = field(default=None, metadata={
        "kind": float, "most": math.inf, "stated_type": "float, optional",
        "meaning": """Reduced chi-squared of a fit above which the reduction stops with a
            `RefinementError`; by default a fit that does not explain the frames is reported.""",
        "expected": "a positive number; inf for no limit",
        "not_on_command_line": "the report says how well the fit explains the frames",
        "not_in_surveys": "their table has the chi-squared of every job",
    })  # fmt: skip

    def __post_init__(self) -> None:
        from pyklip_diffrender.io.units import to_bytes
        from pyklip_diffrender.pattern import as_request
        from pyklip_diffrender.refinement import to_jansky

        plain: dict[str, Any] = {name: getattr(self, name) for name in OPTIONS}
        if self.star_flux is not None:
            plain["star_flux"] = to_jansky(self.star_flux)
        if self.memory is not None:
            plain["memory"] = to_bytes(self.memory, "memory")
        for name, value in plain.items():
            object.__setattr__(self, name, OPTIONS[name].checked(value))
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
        object.__setattr__(self, "pattern", as_request(self.pattern))

    @property
    def side(self) -> int:
        """Side of the fitted square, pixels; smaller by default for a first look."""
        return QUICK_SIDE if self.size is None and self.accuracy == "quick" else super().side

    @classmethod
    def from_keywords(cls, keywords: Mapping[str, Any]) -> Self:
        """Make options from keywords of `reduce`.

        Raises
        ------
        TypeError
            For a keyword that is no option, with the nearest that is one.
        """
        for name in keywords:
            if name not in OPTIONS:
                near = difflib.get_close_matches(name, OPTIONS, n=1)
                hint = f". Did you mean {near[0]!r}?" if near else ""
                raise TypeError(
                    f"reduce() got an unexpected keyword argument {name!r}, expected some of "
                    f"{', '.join(OPTIONS)}{hint}"
                )
        return cls(**keywords)


class ReduceKeywords(TypedDict, total=False):
    """Options as keywords of `reduce`.

    Editors and type checkers cannot derive it from a dataclass, so it repeats names and types.
    """

    size: int | None
    pattern: PatternRequest | str | os.PathLike[str]
    references: References
    threshold: float
    wide: bool
    disk: bool
    completeness: bool
    star_flux: float | str | u.Quantity | None
    star_flux_error: float
    settings: FitSettings | None
    injections: int
    accuracy: Accuracy
    device: str
    memory: float | str | u.Quantity | None
    start: Mapping[str, Any] | None
    max_chi2: float | None


OPTIONS = {
    each.name: Option(each.name, each.default, **{"kind": type(each.default), **each.metadata})
    for each in fields(ReduceOptions)
}
"""Options by name, in the order of the fields."""

ReduceOptions.__doc__ = inspect.cleandoc(ReduceOptions.__doc__ or "").replace(
    "(see the fields)", "\n".join(each.entry for each in OPTIONS.values())
)
