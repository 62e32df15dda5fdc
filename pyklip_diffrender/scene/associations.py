"""Files that are meant by paths, folders, patterns of names and association files."""

from __future__ import annotations

import glob
import json
import logging
import os
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from pyklip_diffrender.errors import CorruptFileError, IncompatibleSetupError, NoValidPixelsError
from pyklip_diffrender.io.files import fits_files, read_text

_log = logging.getLogger(__name__)

Role = Literal["science", "psf"]
"""Role of a member of an association: the target, or a reference star."""

_ASSOCIATION_SUFFIX = ".json"
"""Suffix of association files, in any case."""


@dataclass(frozen=True)
class ListedFile:
    """A file that may have frames."""

    path: Path
    role: Role | None = None  # None where its header decides
    reason: str = ""  # why it is left out, or empty


def matches(path: Path) -> list[Path]:
    """The path itself or, where nothing has that name, the files that match it, sorted.

    Patterns are as in `glob`: frames/*_calints.fits, or frames/** for all folders inside.
    """
    if path.exists() or not glob.has_magic(str(path)):
        return [path]
    return sorted(map(Path, glob.glob(str(path), recursive=True)))


def listed_files(
    files: str | os.PathLike[str] | Iterable[str | os.PathLike[str]],
) -> list[ListedFile]:
    """List the files that are meant, in the order in which they were given.

    A folder stands for its FITS files, an association file (`*_asn.json`) for its members of the
    types science and psf, by paths relative to its folder. An association that has both decides
    which star its members show, unless another one disagrees. Associations inside a folder are not
    read. Whether a file exists that was given by name is not looked at.

    Raises `IncompatibleSetupError` for what is no path, `NoValidPixelsError` where there is no
    file, and `CorruptFileError`, with their names, if members of an association are missing.
    """
    entries = list(files) if isinstance(files, Iterable) and not isinstance(files, str) else [files]
    listed: list[ListedFile] = []
    roles: dict[Path, set[Role | None]] = {}
    for entry in entries:
        if not isinstance(entry, str | os.PathLike):
            raise IncompatibleSetupError(
                f"files: got a {type(entry).__name__}, expected paths of FITS files or folders. "
                "Put frames in memory into an ExposureSequence(target, (frame, ...))"
            )
        found = matches(Path(entry))
        if not found:
            raise NoValidPixelsError(f"{entry}: no file has a name of this pattern")
        for path in found:
            if path.is_dir():
                inside = fits_files(path)
                if not inside and found == [Path(entry)]:
                    raise NoValidPixelsError(f"{path}: the folder has no FITS files")
                if any(path.glob("*_asn.json")):
                    _log.info("%s: its association files are not read; give one by name", path)
                listed += map(ListedFile, inside)
            elif path.suffix.lower() == _ASSOCIATION_SUFFIX:
                for member in _members(path):
                    roles.setdefault(member.path, set()).add(member.role)
                    if member not in listed:  # Usually, several associations have it.
                        listed.append(member)
            else:
                listed.append(ListedFile(path))
    if not listed:
        raise NoValidPixelsError("files: got none, expected at least one")
    return [replace(each, role=_agreed(roles.get(each.path, set()))) for each in listed]


def _agreed(roles: set[Role | None]) -> Role | None:
    known = roles - {None}
    return known.pop() if len(known) == 1 else None


def _members(path: Path) -> list[ListedFile]:
    """The members of an association file, last the ones of other types than science and psf."""
    members = _read(path)
    if isinstance(members, str):
        return [ListedFile(path, reason=members)]
    used: list[ListedFile] = []
    left_out: list[ListedFile] = []
    missing = []
    has_both = {"science", "psf"} <= {kind for _, kind in members}
    for name, kind in members:
        member = _beside(path, name)
        if kind not in ("science", "psf"):
            _log.info("%s: %s is %s, and not used", path.name, name, kind)
            reason = f"{path.name} has it as {kind}, neither science nor psf"
            left_out.append(ListedFile(member, reason=reason))
            continue
        if not member.exists():
            missing.append(name)
        is_reference = kind == "psf"
        used.append(ListedFile(member, "psf" if is_reference else "science" if has_both else None))
    if missing:
        more = f" and {len(missing) - 5} more" if len(missing) > 5 else ""
        raise CorruptFileError(
            f"{path}: {len(missing)} of its {len(used)} members for science and psf are not in its "
            f"folder: {', '.join(missing[:5])}{more}. Put them beside it, or give the frames "
            "themselves, also as a pattern such as 'mastDownload/JWST/*/*_calints.fits'"
        )
    return [*used, *left_out]


def _beside(path: Path, name: str) -> Path:
    """Path of a member, which may be packed by gzip."""
    member = path.parent / name
    packed = member.with_name(f"{member.name}.gz")
    return packed if not member.exists() and packed.exists() else member


def _read(path: Path) -> list[tuple[str, str]] | str:
    """Names and types of the members of all products, or why the file has none."""
    try:
        content: Any = json.loads(read_text(path))
        members = [member for product in content["products"] for member in product["members"]]
        return [(_text(each["expname"]), _text(each["exptype"]).lower()) for each in members]
    except OSError as error:
        return f"it cannot be read ({error.strerror or error})"
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        return (
            "it is no FITS file, and no association file, which has products, and for every one "
            f"members with expname and exptype ({type(error).__name__}: {error})"
        )


def _text(value: Any) -> str:
    if not isinstance(value, str) or not value:
        raise TypeError(f"got {value!r}, expected text")
    return value
