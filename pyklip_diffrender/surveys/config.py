"""The configuration of a survey: a TOML file, checked as a whole before any work."""

from __future__ import annotations

import math
import os
import re
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from functools import partial
from pathlib import Path
from typing import Any

from pyklip_diffrender.errors import CorruptFileError, DiffrenderError, IncompatibleSetupError
from pyklip_diffrender.io.files import read_text
from pyklip_diffrender.io.units import full_circle
from pyklip_diffrender.options import OPTIONS, SharedOptions
from pyklip_diffrender.scene.associations import matches
from pyklip_diffrender.wavefront.opd_map import FLAT

__all__ = [
    "CheckedTable",
    "Config",
    "Injections",
    "Options",
    "SequenceConfig",
    "as_count",
    "as_list",
    "as_number",
    "as_positive",
    "as_table",
    "as_text",
    "list_of",
    "only",
    "read_config",
    "short",
]


# A table of a configuration whose values are checked one by one, with all mistakes collected.

Convert = Callable[[Any], Any]
"""Takes a value, and raises ValueError if it is not as expected."""


class CheckedTable:
    """A table of the file, whose keys are taken one by one.

    Parameters
    ----------
    content : mapping
        Anything else is a mistake.
    place : str
        Name of the table in messages; "" for the whole file.
    folder : Path
        Of the file, to which paths are relative.
    problems : list of str
        All mistakes are added to it.
    """

    def __init__(self, content: Any, place: str, folder: Path, problems: list[str]) -> None:
        self.place, self.folder, self.problems = place, folder, problems
        if not isinstance(content, Mapping):
            self.complain("", content, "a table with keys")
            content = {}
        self.content = dict(content)
        self.known: list[str] = []

    def complain(self, key: str, value: Any, expected: str) -> None:
        """Add a mistake: the value of a key, or of the table for ""."""
        where = ": ".join(filter(None, [self.place, key]))
        self.problems.append(f"{where}: got {short(value)}, expected {expected}")

    def take(self, key: str, default: Any, expected: str, convert: Convert) -> Any:
        """Value of a key; `convert` raises ValueError for one that is not as expected."""
        self.known.append(key)
        if key not in self.content:
            return default
        value = self.content.pop(key)
        try:
            return convert(value)
        except (ValueError, OverflowError):
            self.complain(key, value, expected)
            return default

    def table(self, key: str) -> CheckedTable:
        """The table of a key; empty if there is none."""
        self.known.append(key)
        where = ": ".join(filter(None, [self.place, key]))
        return CheckedTable(self.content.pop(key, {}), where, self.folder, self.problems)

    def existing(self, value: Any) -> Path:
        """A path that exists, relative to the configuration's folder."""
        path = self.folder / as_text(value)
        try:
            exists = path.exists()
        except OSError as error:  # Such as a name that is too long.
            raise ValueError(str(path)) from error
        if not exists:
            raise ValueError(str(path))
        return path.absolute()

    def matching(self, value: Any) -> list[Path]:
        """Paths of a pattern, or the one that exists, relative to the configuration's folder."""
        found = matches(self.folder / as_text(value))
        return [self.existing(str(path.absolute())) for path in found]

    def finish(self) -> None:
        """Complain about keys that nobody took."""
        for key in self.content:
            where = f"{self.place}: " if self.place else ""
            self.problems.append(
                f"{where}got the key {short(key)}, expected one of {', '.join(self.known)}. "
                "Check its name and in which table it is"
            )


def short(value: Any) -> str:
    """A value in at most 80 characters."""
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:77]}..."


def as_text(value: Any) -> str:
    """Printable text, without the spaces around it."""
    if not isinstance(value, str) or not value.strip() or not value.isprintable():
        raise ValueError
    return value.strip()


def as_number(value: Any) -> float:
    """A finite number."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ValueError
    return float(value)


def as_count(value: Any) -> int:
    """A whole number, 0 or more."""
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value < 1_000_000:
        raise ValueError
    return value


def as_table(value: Any) -> dict[str, Any]:
    """A mapping."""
    if not isinstance(value, Mapping):
        raise ValueError
    return dict(value)


def as_list(value: Any) -> list[Any]:
    """A list, which may be empty."""
    if not isinstance(value, list):
        raise ValueError
    return value


def list_of(convert: Convert) -> Callable[[Any], tuple[Any, ...]]:
    """Accept lists whose entries all are as expected."""
    return lambda value: tuple(map(convert, as_list(value)))


def only(convert: Convert, is_allowed: Callable[[Any], object]) -> Convert:
    """Accept some of the values that a converter accepts."""

    def check(value: Any) -> Any:
        converted = convert(value)
        if not is_allowed(converted):
            raise ValueError
        return converted

    return check


as_positive = only(as_number, lambda number: number > 0)


# The configuration of a survey: a TOML file, checked as a whole before any work.

_PIXEL = 0.063
"""arcsec; for the largest separation of an injected planet."""

_MEMORY = re.compile(r"\d+(\.\d+)? ?([kMGT]i?)?B")

_SPECTRA = ("blackbody", "flat", "free")
"""Names of spectra that `combine` knows."""

_SETTINGS = (
    "free", "wavefront", "cycles", "deviations", "drift_cycles", "max_companions",
    "companion_threshold", "companions_if_stalled", "response_npix", "response_wavelengths",
    "max_iterations", "tolerance", "min_model_error", "relinearise", "accurate_steps", "robust",
)  # fmt: skip
"""Fields of GaussNewton whose values TOML can hold."""


@dataclass(frozen=True)
class Options(SharedOptions):
    """Options of `ReduceOptions` for a sequence, as plain values: paths as text, and Jy.

    Attributes
    ----------
    settings : dict
        Arguments of `GaussNewton.nircam`; empty for the defaults of `reduce`.
    """

    settings: Mapping[str, Any] = field(default_factory=dict)

    @property
    def keywords(self) -> dict[str, Any]:
        """Arguments of `ReduceOptions`, but for `settings`."""
        names = (each.name for each in fields(self))
        return {name: getattr(self, name) for name in names if name != "settings"}


@dataclass(frozen=True)
class Injections:
    """Planets to inject: one job for every combination.

    Attributes
    ----------
    contrasts : tuple of float
    separations : tuple of float
        arcsec.
    angles : tuple of float
        Position angles, degrees east of north.
    """

    contrasts: tuple[float, ...] = ()
    separations: tuple[float, ...] = ()
    angles: tuple[float, ...] = (0.0,)


@dataclass(frozen=True)
class SequenceConfig:
    """A target in a filter.

    Attributes
    ----------
    name : str
        For tables and messages; unique.
    is_named : bool
        Whether the configuration has given the name. Tables have target and filter otherwise.
    files : tuple of Path
        Files, association files and folders.
    opd : Path
        A wavefront map, or a folder of maps, of which the nearest in time is used; ``Path("flat")``
        for a flat wavefront.
    target, filter : str or None
        As for `Sequence.from_files`.
    options : Options
    injections : Injections
    """

    name: str
    files: tuple[Path, ...]
    opd: Path
    target: str | None = None
    filter: str | None = None
    options: Options = field(default_factory=Options)
    injections: Injections = field(default_factory=Injections)
    is_named: bool = True


@dataclass(frozen=True)
class Config:
    """The configuration of a survey.

    Attributes
    ----------
    sequences : tuple of SequenceConfig
    workers : int or None
        Processes; None for one per core, 0 for this process alone.
    memory_limit : str or None
        Of each worker, such as "4 GB"; None for an equal share of the machine's.
    spectra : tuple of str
        Spectra of planets for the search over the filters of a star, see `combine`; empty for its
        defaults.
    """

    sequences: tuple[SequenceConfig, ...]
    workers: int | None = None
    memory_limit: str | None = None
    spectra: tuple[str, ...] = ()


def read_config(source: str | os.PathLike[str] | Mapping[str, Any]) -> Config:
    """Read and check a configuration.

    Parameters
    ----------
    source : path or mapping
        A TOML file, or its content. Paths in a file are relative to its folder.

    Returns
    -------
    Config

    Raises
    ------
    CorruptFileError
        If the file is missing or not TOML.
    IncompatibleSetupError
        With everything that is wrong, one line for each mistake.
    """
    if isinstance(source, Mapping):
        name, folder, content = "survey", Path(), dict(source)
    else:
        path = Path(source)
        name, folder = path.name, path.parent
        try:
            content = tomllib.loads(read_text(path))
        except OSError as error:
            raise CorruptFileError(f"{path}: cannot be read ({error.strerror})") from error
        # Deeply nested brackets exhaust the parser's stack.
        except (ValueError, RecursionError) as error:
            raise CorruptFileError(
                f"{path}: not a TOML file ({error}). Correct it; text needs quotes"
            ) from error
    problems: list[str] = []
    config = _config(CheckedTable(content, "", folder, problems))
    if problems:
        raise IncompatibleSetupError("\n  ".join([f"{name}: nothing was started:", *problems]))
    return config


def _config(top: CheckedTable) -> Config:
    workers = top.take("workers", None, "a number of processes, 0 or more", as_count)
    memory = top.take("memory_limit", None, 'text such as "4 GB"', only(as_text, _MEMORY.fullmatch))
    shared = top.table("options")
    options = _options(shared, Options())
    shared.finish()
    injections = _injections(top.table("injections"), Injections())
    together = top.table("combined")
    spectra = together.take(
        "spectra", (), f"a list of {', '.join(map(repr, _SPECTRA))} or existing tables",
        only(list_of(lambda each: each if each in _SPECTRA else str(top.existing(each))), bool),
    )  # fmt: skip
    together.finish()
    listed = top.take("sequence", [], "one or more tables [[sequence]]", as_list)
    sequences: list[SequenceConfig] = []
    for k, each in enumerate(listed, 1):
        table = CheckedTable(each, f"sequence {k}", top.folder, top.problems)
        sequence = _sequence(table, options, injections)
        if sequence is None:
            continue
        if sequence.name in [other.name for other in sequences]:
            table.complain("name", sequence.name, "a name that no other sequence has; add `name`")
        sequences.append(sequence)
    top.finish()
    if not listed and not top.problems:
        top.complain("sequence", "none", "one or more tables [[sequence]] with files and opd")
    return Config(tuple(sequences), workers, memory, spectra)


def _sequence(
    table: CheckedTable, options: Options, injections: Injections
) -> SequenceConfig | None:
    expected = "FITS files, folders of them, patterns such as frames/*_calints.fits or association "
    expected += "files that exist; paths are relative to the folder of the configuration"

    def paths(value: Any) -> tuple[Path, ...]:
        several = value if isinstance(value, list) else [value]
        found = tuple(path for each in several for path in table.matching(each))
        if not found:
            raise ValueError
        return found

    missing: list[Any] = [key for key in ("files", "opd") if key not in table.content]
    for key in missing:
        table.complain(key, "nothing", f'a path, such as {key} = "{key}.fits"')
    files = table.take("files", None, expected, paths)
    opd = table.take(
        "opd", None, "a wavefront map or a folder of maps that exists, or 'flat'",
        lambda value: Path(FLAT) if value == FLAT else table.existing(value),
    )  # fmt: skip
    target = table.take("target", None, "text, the name of the star", as_text)
    filter_ = table.take("filter", None, 'text such as "F444W"', as_text)
    first = files[0] if files else Path("sequence")
    is_named = "name" in table.content
    label = " ".join(filter(None, [target or first.name.split(".")[0], filter_]))
    name = table.take("name", label, "printable text", as_text)
    own = _options(table, options)
    planets = _injections(table.table("injections"), injections)
    edge = own.side * _PIXEL / 2
    for each in planets.separations:
        if each >= edge:
            table.complain("separations", each, f"less than {edge:.2g} arcsec, half of the field")
    table.finish()
    if files is None or opd is None:
        return None
    return SequenceConfig(name, files, opd, target, filter_, own, planets, is_named)


def _options(table: CheckedTable, default: Options) -> Options:
    def pattern(choices: tuple[str, ...], value: Any) -> str:
        if value in choices:
            return str(value)
        # Late, see `_wrong_settings`. Files without patterns are found before any job begins.
        from pyklip_diffrender.pattern import as_request

        try:
            as_request(table.existing(value))
        except DiffrenderError as error:
            raise ValueError(str(error)) from error
        return str(table.existing(value))

    values: dict[str, Any] = {}
    for name in default.keywords:
        each = OPTIONS[name]
        convert = partial(pattern, each.choices) if each.path else each.checked
        values[name] = table.take(name, getattr(default, name), each.expected, convert)
    if values["wide"] and values["disk"]:
        table.complain("", "wide = true and disk = true", "one of them")
        values["disk"] = False
    own = table.take("settings", {}, "a table with arguments of GaussNewton", as_table)
    # Those of a sequence come on top of the survey's.
    settings = {**default.settings, **own}
    wrong = _wrong_settings(settings) if own else []
    where = f"{table.place}: settings"
    table.problems += [f"{where}: {each}" for each in wrong]
    return Options(**values, settings=default.settings if wrong else settings)


def _wrong_settings(settings: Mapping[str, Any]) -> list[str]:
    """Mistakes in arguments of `GaussNewton.nircam`."""
    unknown = sorted(set(settings) - set(_SETTINGS))
    if unknown:
        known = ", ".join(_SETTINGS)
        return [f"got the key {short(key)}, expected one of {known}" for key in unknown]
    if not _is_plain(settings):
        return ["got a date or nan, expected numbers, text, lists and tables"]
    # Late, as everything that waits for PyTorch: workers import this module to unpickle a job.
    from pyklip_diffrender.refinement import GaussNewton

    try:
        GaussNewton.nircam(**settings)
    except DiffrenderError as error:
        return [str(error)]
    except (TypeError, ValueError, AttributeError, OverflowError) as error:
        return [f"got a value of the wrong type ({error}), expected those of GaussNewton"]
    return []


def _injections(table: CheckedTable, default: Injections) -> Injections:
    own = bool(table.content)
    numbers = "a list of positive numbers, such as [1e-5]"
    contrasts = table.take(
        "contrasts", default.contrasts, f"{numbers}, fluxes over the star's and no magnitudes",
        list_of(only(as_positive, lambda contrast: contrast < 1)),
    )  # fmt: skip
    separations = table.take("separations", default.separations, numbers, list_of(as_positive))
    angles = table.take(
        "angles", default.angles, "a list of degrees east of north", only(list_of(as_number), bool)
    )
    if own and bool(contrasts) != bool(separations):
        table.complain("", "one of contrasts and separations", "both, or neither")
    table.finish()
    return Injections(contrasts, separations, tuple(map(full_circle, angles)))


def _is_plain(value: Any) -> bool:
    """Whether a value has only what a record of the job can hold."""
    if isinstance(value, Mapping):
        return all(map(_is_plain, value.values()))
    if isinstance(value, list):
        return all(map(_is_plain, value))
    return isinstance(value, str | int | float) and value == value
