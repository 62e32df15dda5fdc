"""The configuration of a survey: a TOML file, checked as a whole before any work."""

from __future__ import annotations

import math
import os
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from pyklip_diffrender.errors import CorruptFileError, DiffrenderError, IncompatibleSetupError
from pyklip_diffrender.io.files import read_text
from pyklip_diffrender.io.units import full_circle, to_bytes
from pyklip_diffrender.options import OPTIONS, SPECTRA, Option, SharedOptions
from pyklip_diffrender.scene.associations import matches
from pyklip_diffrender.wavefront.opd_map import FLAT

_PIXEL_ARCSEC = 0.063
"""arcsec; for the largest separation of an injected planet."""

_WORKERS = Option(
    "workers", None, "Processes.", int, expected="a number of processes, 0 or more"
)  # fmt: skip

_NOT_IN_TOML = ("basis", "prior", "drift", "dither_drift", "companions", "memory")
"""Fields of FitSettings that are objects of Python, and the memory, for which surveys have
`memory_limit`."""


@dataclass(frozen=True)
class Options(SharedOptions):
    """Options of `ReduceOptions` for a sequence, as plain values: paths as text, and Jy.

    Attributes
    ----------
    settings : dict
        Arguments of `FitSettings.nircam`; empty for the defaults of `reduce`.
    """

    settings: Mapping[str, Any] = field(default_factory=dict)


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
        An OPD map, or a folder of maps, of which the nearest in time is used; ``Path("flat")``
        for a flat wavefront.
    target, filter : str or None
        As for `ExposureSequence.from_files`.
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
    memory_limit : float or None
        Memory of each worker, bytes; None for an equal share of the machine's.
    spectra : tuple of str
        Spectra of planets for the search over the filters of a star, see `combine`; empty for its
        defaults.
    """

    sequences: tuple[SequenceConfig, ...]
    workers: int | None = None
    memory_limit: float | None = None
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
    reader = _Reader(folder)
    config = reader.config(content)
    if reader.problems:
        raise IncompatibleSetupError(
            "\n  ".join([f"{name}: nothing was started:", *reader.problems])
        )
    return config


Check = Callable[[Any], Any]
"""Returns a value as it is stored, and raises ValueError for one that is not as expected."""

Keys = Mapping[str, tuple[str, Check]]
"""Keys of a table, with what is expected and its check."""


class _Reader:
    """Checks the tables of a configuration, and collects all mistakes."""

    def __init__(self, folder: Path) -> None:
        # To which paths are relative.
        self.folder = folder
        self.problems: list[str] = []

    def complain(self, place: str, value: Any, expected: str) -> None:
        """Add a mistake."""
        self.problems.append(f"{place}: got {_short(value)}, expected {expected}")

    def values(self, content: Any, place: str, keys: Keys) -> dict[str, Any]:
        """Values of the table at a place, which is "" for the whole file; mistakes are left out."""
        if not isinstance(content, Mapping):
            self.complain(place, content, "a table with keys")
            return {}
        values = {}
        for key, value in content.items():
            if key not in keys:
                self.problems.append(
                    f"{place and f'{place}: '}got the key {_short(key)}, expected one of "
                    f"{', '.join(keys)}. Check its name and in which table it is"
                )
                continue
            expected, check = keys[key]
            try:
                values[key] = check(value)
            except (ValueError, OverflowError):
                self.complain(f"{place}: {key}" if place else key, value, expected)
        return values

    def config(self, content: Mapping[str, Any]) -> Config:
        """The whole configuration."""
        top = self.values(content, "", {
            "workers": (_WORKERS.expected, _WORKERS.checked),
            "memory_limit": ('text such as "4 GB"', lambda value: to_bytes(_text(value), "")),
            "options": _TABLE,
            "injections": _TABLE,
            "combined": _TABLE,
            "sequence": ("one or more tables [[sequence]]", _list),
        })  # fmt: skip
        given = self.values(top.pop("options", {}), "options", self.option_keys)
        options = self.options(given, Options(), "options")
        planets = self.injections(top.pop("injections", {}), Injections(), "injections")
        names = ", ".join(map(repr, SPECTRA))
        combined = self.values(top.pop("combined", {}), "combined", {
            "spectra": (f"a list of {names} or existing tables", self.spectra),
        })  # fmt: skip
        if "sequence" not in content:
            self.complain("sequence", "none", "one or more tables [[sequence]] with files and opd")
        sequences: list[SequenceConfig] = []
        for k, each in enumerate(top.pop("sequence", ()), 1):
            sequence = self.sequence(each, f"sequence {k}", options, planets)
            if sequence is None:
                continue
            if sequence.name in [other.name for other in sequences]:
                expected = "a name that no other sequence has; add `name`"
                self.complain(f"sequence {k}: name", sequence.name, expected)
            sequences.append(sequence)
        return Config(tuple(sequences), **top, **combined)

    def sequence(
        self, content: Any, place: str, options: Options, planets: Injections
    ) -> SequenceConfig | None:
        """A sequence, whose own options and planets override the survey's; None without one."""
        given = self.values(content, place, {
            "files": (
                "FITS files, folders of them, patterns such as frames/*_calints.fits or "
                "association files that exist; paths are relative to the folder of the "
                "configuration",
                self.matching,
            ),
            "opd": (
                "an OPD map or a folder of maps that exists, or 'flat'",
                lambda value: Path(FLAT) if value == FLAT else self.existing(value),
            ),
            "target": ("text, the name of the star", _text),
            "filter": ('text such as "F444W"', _text),
            "name": ("printable text", _text),
            "injections": _TABLE,
            **self.option_keys,
        })  # fmt: skip
        own = self.options(given, options, place)
        planets = self.injections(given.pop("injections", {}), planets, f"{place}: injections")
        edge = own.side * _PIXEL_ARCSEC / 2
        for each in planets.separations:
            if each >= edge:
                expected = f"less than {edge:.2g} arcsec, half of the field"
                self.complain(f"{place}: separations", each, expected)
        for key in ("files", "opd"):
            if key not in (content if isinstance(content, Mapping) else given):
                self.complain(f"{place}: {key}", "nothing", f'a path, such as {key} = "{key}.fits"')
        if not {"files", "opd"} <= set(given):
            return None
        first = given["files"][0].name.split(".")[0]
        label = " ".join(filter(None, [given.get("target") or first, given.get("filter")]))
        is_named = "name" in given
        given = {"name": label, **given}
        return SequenceConfig(**given, options=own, injections=planets, is_named=is_named)

    @property
    def option_keys(self) -> Keys:
        """Keys of the options of a reduction, by what these declare."""
        checks = {each.name: OPTIONS[each.name].checked for each in fields(SharedOptions)}
        checks["pattern"] = self.pattern
        return {
            **{name: (OPTIONS[name].expected, check) for name, check in checks.items()},
            "settings": ("a table with arguments of FitSettings", _table),
        }

    def options(self, given: dict[str, Any], default: Options, place: str) -> Options:
        """Options of a table, taken out of its values."""
        own = {each.name: given.pop(each.name) for each in fields(Options) if each.name in given}
        if "settings" in own:
            # Settings of a sequence come on top of the survey's.
            settings = {**default.settings, **own.pop("settings")}
            wrong = _wrong_settings(settings)
            self.problems += [f"{place}: settings: {each}" for each in wrong]
            own |= {} if wrong else {"settings": settings}
        options = replace(default, **own)
        if options.wide and options.disk:
            self.complain(place, "wide = true and disk = true", "one of them")
            options = replace(options, disk=False)
        return options

    def injections(self, content: Any, default: Injections, place: str) -> Injections:
        """Planets of a table."""
        numbers = "a list of positive numbers, such as [1e-5]"
        own = self.values(content, place, {
            "contrasts": (
                f"{numbers}, fluxes over the star's and no magnitudes",
                lambda value: _numbers(value, 0, 1),
            ),
            "separations": (numbers, lambda value: _numbers(value, 0, math.inf)),
            "angles": (
                "a list of degrees east of north",
                lambda value: tuple(map(full_circle, _numbers(_list(value), -math.inf, math.inf))),
            ),
        })  # fmt: skip
        planets = replace(default, **own)
        if content and bool(planets.contrasts) != bool(planets.separations):
            self.complain(place, "one of contrasts and separations", "both, or neither")
        return planets

    def pattern(self, value: Any) -> str:
        """A detector pattern: one of the words for it, or a path."""
        if value in OPTIONS["pattern"].choices:
            return str(value)
        # Late, see `_wrong_settings`. Files without patterns are found before any job begins.
        from pyklip_diffrender.pattern import as_request

        path = self.existing(value)
        try:
            as_request(path)
        except DiffrenderError as error:
            raise ValueError(str(error)) from error
        return str(path)

    def spectra(self, value: Any) -> tuple[str, ...]:
        """Spectra of planets: their names, or paths of tables."""
        return tuple(each if each in SPECTRA else str(self.existing(each)) for each in _list(value))

    def existing(self, value: Any) -> Path:
        """A path that exists."""
        path = self.folder / _text(value)
        try:
            exists = path.exists()
        except OSError as error:  # Such as a name that is too long.
            raise ValueError(str(path)) from error
        if not exists:
            raise ValueError(str(path))
        return path.absolute()

    def matching(self, value: Any) -> tuple[Path, ...]:
        """Paths of a pattern, or those that exist, or of a list of them."""
        several = value if isinstance(value, list) else [value]
        found = [path for each in several for path in matches(self.folder / _text(each))]
        return tuple(self.existing(str(path.absolute())) for path in _list(found))


def _short(value: Any) -> str:
    """A value in at most 80 characters."""
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:77]}..."


def _text(value: Any) -> str:
    """Printable text, without the spaces around it."""
    if not isinstance(value, str) or not value.strip() or not value.isprintable():
        raise ValueError
    return value.strip()


def _numbers(value: Any, least: float, most: float) -> tuple[float, ...]:
    """Numbers of a list, which may be empty, all between two others."""
    if not isinstance(value, list) or not all(
        isinstance(each, int | float) and not isinstance(each, bool) and least < each < most
        for each in value
    ):
        raise ValueError
    return tuple(map(float, value))


def _list(value: Any) -> list[Any]:
    """A list that is not empty."""
    if not isinstance(value, list) or not value:
        raise ValueError
    return value


def _table(value: Any) -> Mapping[str, Any]:
    if not isinstance(value, Mapping):
        raise ValueError
    return value


_TABLE: tuple[str, Check] = ("a table with keys", lambda value: value)
"""A table whose own keys are checked later."""


def _wrong_settings(settings: Mapping[str, Any]) -> list[str]:
    """Mistakes in arguments of `FitSettings.nircam`."""
    # Late, as everything that waits for PyTorch: workers import this module to unpickle a job.
    from pyklip_diffrender.refinement import FitSettings

    known = [each.name for each in fields(FitSettings) if each.name not in _NOT_IN_TOML]
    unknown = sorted(set(settings) - set(known))
    if unknown:
        return [f"got the key {_short(key)}, expected one of {', '.join(known)}" for key in unknown]
    if not _is_plain(settings):
        return ["got a date or nan, expected numbers, text, lists and tables"]
    try:
        FitSettings.nircam(**settings)
    except DiffrenderError as error:
        return [str(error)]
    except (TypeError, ValueError, AttributeError, OverflowError) as error:
        return [f"got a value of the wrong type ({error}), expected the types of FitSettings"]
    return []


def _is_plain(value: Any) -> bool:
    """Whether a value has only what a record of the job can hold."""
    if isinstance(value, Mapping):
        return all(map(_is_plain, value.values()))
    if isinstance(value, list):
        return all(map(_is_plain, value))
    return isinstance(value, str | int | float) and value == value
