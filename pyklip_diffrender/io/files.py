"""Find and read files with clear errors, and write files completely or not at all."""

from __future__ import annotations

import gzip
import hashlib
import io
import json
import os
import re
import secrets
import shutil
import warnings
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from importlib import resources
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from astropy.io import fits
from astropy.table import Table
from astropy.utils.exceptions import AstropyUserWarning
from numpy.typing import NDArray

from pyklip_diffrender.errors import (
    CorruptFileError,
    DiffrenderWarning,
    ExistingFileError,
    IncompatibleSetupError,
    MissingFileError,
)

_UNPACKED_IN_MEMORY_BYTES = 2**25
"""Bytes up to which a gzipped file is unpacked in memory, which is faster."""

_PACKED = re.compile(r"\.(gz|fz)$", re.IGNORECASE)
"""Suffixes of gzip and fpack."""

_FITS_SUFFIX = re.compile(r"\.(fits?|fts)(\.gz|\.fz)?$", re.IGNORECASE)
"""The suffixes of FITS files that `open_fits` reads."""


def is_fits_name(path: str | os.PathLike[str]) -> bool:
    """Whether a path has the suffix of a FITS file, packed or not, in any case ("B.FIT.GZ")."""
    return _FITS_SUFFIX.search(os.fspath(path)) is not None


def without_fits_suffix(name: str) -> str:
    """Name of a FITS file without the suffix, packed or not; other names are unchanged."""
    return _FITS_SUFFIX.sub("", name)


def unpacked_name(name: str) -> str:
    """Name that a file has when it is unpacked: without the suffix of gzip or fpack."""
    return _PACKED.sub("", name)


def fits_files(folder: str | os.PathLike[str]) -> list[Path]:
    """The FITS files in a folder by their suffixes, sorted by name.

    Hidden files are not among them: the copies with metadata that macOS writes to other systems'
    disks (``._a.fits``), and files that are being written.
    """
    return sorted(
        path
        for path in Path(folder).iterdir()
        if is_fits_name(path) and not path.name.startswith(".") and not path.is_dir()
    )


def read_bytes(path: str | os.PathLike[str]) -> bytes:
    """Content of a file, unpacked if it is gzipped."""
    with _unpacked(Path(path)) as file:
        return file.read()


def read_text(path: str | os.PathLike[str]) -> str:
    """Text of a file in UTF-8, with or without the byte-order mark that editors on Windows add."""
    return Path(path).read_text(encoding="utf-8-sig")


_PRODUCT_EXTENSIONS = {
    "INITIAL_OPD": "a fit",
    "RESIDUAL_SNR": "a search",
    "PATTERN": "a detector pattern",
}
"""Extensions by which products of this package are known; their headers are copied from frames."""


def product_in(hdus: fits.HDUList) -> str:
    """Name of this package's product in an open file, such as "a fit"; empty for other files."""
    header = hdus[0].header
    if "PATVERS" in header:
        return "a library of detector patterns"
    names = [hdu.name for hdu in hdus]
    known = (what for name, what in _PRODUCT_EXTENSIONS.items() if name in names)
    return next(known, "an image" if "DRVERS" in header else "")


@contextmanager
def open_fits(path: str | os.PathLike[str], *, images: bool = True) -> Iterator[fits.HDUList]:
    """Open a FITS file, packed by gzip or fpack or not, and read all of it.

    Without `images`, `read_image` reads them, one plane at a time, so that a file of many
    integrations is never in memory as a whole. MissingFileError, also a FileNotFoundError, if there
    is no such file; CorruptFileError if it is truncated, or not FITS, if a card cannot be read, or
    if data do not match DATASUM; a DiffrenderWarning if only a header does not match its CHECKSUM,
    as after editing it without an update of the checksum.
    """
    path = Path(path)
    if not path.is_file():
        raise MissingFileError(f"{path}: no such file")
    with ExitStack() as stack:
        try:
            file = stack.enter_context(_unpacked(path))
            with warnings.catch_warnings():
                # Astropy only warns of truncated data.
                warnings.filterwarnings(
                    "error", message="(?s).*(truncated|corrupt)", category=AstropyUserWarning
                )
                # Packed images have the checksums of the tables that hold them.
                stored = fits.open(
                    file, memmap=False, lazy_load_hdus=False, disable_image_compression=True
                )
                for number, hdu in enumerate(stored):
                    _require_sound(hdu, number, path)
                file.seek(0)
                hdus = fits.open(file, memmap=False, lazy_load_hdus=False)
                for hdu in hdus:
                    if images or not hdu.is_image:
                        _ = hdu.data
        except CorruptFileError:
            raise
        except BROKEN as error:
            raise _incomplete(path, error) from error
        yield hdus


BROKEN = (
    OSError, EOFError, ValueError, TypeError, KeyError, zlib.error, AstropyUserWarning,
    fits.VerifyError,
)  # fmt: skip
"""Exceptions, and the warning, that astropy raises for files that are cut or damaged."""


def _incomplete(path: Path, error: BaseException) -> CorruptFileError:
    return CorruptFileError(
        f"{path} ({path.stat().st_size} bytes): not a complete FITS file ({error}). Fetch it again"
    )


@contextmanager
def _unpacked(path: Path) -> Iterator[BinaryIO]:
    """The file, or what a gzipped file holds."""
    with path.open("rb") as file:
        if file.read(2) != b"\x1f\x8b":  # The magic number of gzip.
            file.seek(0)
            yield file
            return
        # Not by astropy, which mistakes a truncated stream for the end of the file.
        if path.stat().st_size <= _UNPACKED_IN_MEMORY_BYTES:
            yield io.BytesIO(gzip.decompress(path.read_bytes()))
            return
        file.seek(0)
        with gzip.GzipFile(fileobj=file) as stream:
            while stream.read(2**22):
                pass
            stream.seek(0)
            yield stream  # type: ignore[misc]


def _float64(image: Any) -> NDArray[np.float64]:
    """Copy of an image of a file as contiguous float64 in the machine's byte order."""
    return np.array(image, dtype=np.float64, order="C")


def read_image(
    hdu: Any, path: str | os.PathLike[str], convert: Callable[[Any], NDArray[Any]] = _float64
) -> NDArray[Any]:
    """Read the image of an HDU, plane by plane, into an array of its own; see `open_fits`.

    `convert` makes a plane of the array from a plane of the file; CorruptFileError if that fails.
    """
    shape = tuple(hdu.shape)
    try:
        if len(shape) < 3 or 0 in shape:
            return convert(hdu.data)
        first = convert(hdu.section[0])
        result = np.empty((shape[0], *first.shape), first.dtype)
        result[0] = first
        for k in range(1, shape[0]):
            result[k] = convert(hdu.section[k])
        return result
    except BROKEN as error:
        raise _incomplete(Path(path), error) from error


def _require_sound(hdu: Any, number: int, path: Path) -> None:
    """Check the cards and the checksums of an HDU as it is stored."""
    # Damaged HDUs and HDUs of unknown type have no data or no checksums.
    if not (hasattr(type(hdu), "data") and hasattr(hdu, "verify_datasum")):
        raise CorruptFileError(
            f"{path}: extension {number} does not start as one (XTENSION, SIMPLE). Fetch it again"
        )
    for card in hdu.header.cards:
        try:
            _ = card.value
        except fits.VerifyError as error:
            raise CorruptFileError(
                f"{path}: extension {number} has a card that cannot be read: "
                f"{card.image.strip()!r}. Correct it, or fetch the file again"
            ) from error
    if not hdu.verify_datasum():
        raise CorruptFileError(
            f"{path}: the data of extension {number} do not have the checksum in its header "
            "(DATASUM). Fetch the file again, or delete the card if the data changed on purpose"
        )
    if not hdu.verify_checksum():
        warnings.warn(
            f"{path}: the header of extension {number} was changed after its checksum was made "
            "(CHECKSUM); the data were not",
            DiffrenderWarning,
            stacklevel=5,
        )


def require_new(paths: Iterable[str | os.PathLike[str]], overwrite: bool) -> None:
    """Raise ExistingFileError, before anything is written, for files that must not be replaced."""
    existing = [str(path) for path in paths if os.path.lexists(path)]
    if existing and not overwrite:
        verb = "exists" if len(existing) == 1 else "exist"
        raise ExistingFileError(
            f"{', '.join(existing)} {verb}; choose another place, or replace with the option "
            "overwrite"
        )


class OutputFolder:
    """A folder for the products of a run, in which products of other runs are kept.

    With `overwrite` a run may replace the products that are in the folder when it begins. What
    somebody else writes there until the run ends is not replaced: the products of the run then go
    to a new folder inside, which is on the same disk and can be written to.

    Parameters
    ----------
    folder : path
    names : sequence of str
        Names of the products.
    overwrite : bool

    Attributes
    ----------
    asked : Path
        The folder that was asked for.
    folder : Path
        The folder that is written to.

    Raises
    ------
    ExistingFileError
        If there are products, and `overwrite` is False.
    IncompatibleSetupError
        If the folder is a file.
    """

    def __init__(
        self, folder: str | os.PathLike[str], names: Iterable[str], *, overwrite: bool
    ) -> None:
        self.asked = self.folder = Path(folder)
        if self.folder.exists() and not self.folder.is_dir():
            raise IncompatibleSetupError(f"output: {folder} is a file, expected a folder")
        self._names = tuple(names)
        require_new(self._products(), overwrite)
        # The products that may be replaced, as they are now.
        self._known = stamps(self._products())

    def _products(self) -> list[Path]:
        return [self.folder / name for name in self._names]

    def place(self) -> Path:
        """Return the folder to write to now: a new one if somebody else has written to the old."""
        found = stamps(self._products())
        if any(self._known.get(path) != stamp for path, stamp in found.items()):
            self.folder, self._known = _new_folder_in(self.asked), {}
        return self.folder

    def clear(self, keep: Iterable[Path] = ()) -> None:
        """Remove the products that may be replaced, apart from some to `keep`."""
        found, kept = stamps(self._known), set(keep)
        for path, stamp in self._known.items():
            if path not in kept and found.get(path) == stamp:
                path.unlink()
        self._known = stamps(kept)

    def replace(self, write: Callable[[Path], Iterable[Path]]) -> list[Path]:
        """Put new products in place of the earlier ones, all of them or none.

        `write` writes the products to the folder that it is given, and returns their paths.

        Warns
        -----
        DiffrenderWarning
            If the products are not where they were asked for.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        staged = self.folder / f".{secrets.token_hex(8)}"
        staged.mkdir()
        before = self.folder
        try:
            names = [path.relative_to(staged) for path in write(staged)]
            place = self.place()
            for name in names:
                (place / name).parent.mkdir(exist_ok=True)
                _move(staged / name, place / name)
        finally:
            shutil.rmtree(staged, ignore_errors=True)
        written = [place / name for name in names]
        self.clear(keep=written)
        if place != before:
            warnings.warn(moved_aside(self.asked, place), DiffrenderWarning, stacklevel=3)
        return written


def moved_aside(asked: object, used: object) -> str:
    """Say which folders products were meant for, and which they are in."""
    return (
        f"somebody else has written products to {asked} while this run was computing: these are "
        f"kept, and the products of this run are in {used}"
    )


def stamps(paths: Iterable[Path]) -> dict[Path, tuple[int, int]]:
    """Times (ns) and sizes of the files that exist, which tell whether one was replaced."""
    stamps = {}
    for path in paths:
        with suppress(FileNotFoundError):
            state = path.stat()
            stamps[path] = (state.st_mtime_ns, state.st_size)
    return stamps


def _new_folder_in(folder: Path) -> Path:
    """Make a folder inside `folder`, with the same name and the first free number from 2 on."""
    number = 2
    while True:
        path = folder / f"{folder.absolute().name}-{number}"
        try:
            path.mkdir()
        except FileExistsError:
            number += 1
        else:
            return path


def _move(source: Path, path: Path) -> None:
    """Replace a file in one step; the new file has the permissions of the old file, if any."""
    if path.exists():
        shutil.copymode(path, source)
    os.replace(source, path)


@contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Temporary path, in the same folder, for a file that replaces `path` if the block succeeds."""
    # In the same folder the replacement is one step. The suffix is the same
    # (``.fits.gz``, ``.png``), because some writers depend on it. The product has the permissions
    # of the file that it replaces, or of any new file.
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    suffix = "".join(path.suffixes)
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(8)}{suffix}")
    # Files of `tempfile` can only be read by their owner. The mode of a plain new file follows from
    # the umask, which cannot be read without changing it for all threads.
    temporary.touch(exist_ok=False)
    try:
        yield temporary
        _move(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def write_fits(hdus: fits.HDUList, path: str | os.PathLike[str]) -> None:
    """Write a FITS file with checksums in one step, so that it is never incomplete."""
    hdus.update_extend()
    for hdu in hdus:
        # Without the time, which astropy would note, so that the same content makes the same file.
        hdu.add_checksum(when="checksum of the extension")
    with replacing(path) as temporary:
        hdus.writeto(temporary, overwrite=True)


def write_page(page: Path, html: str, data: Path, content: Mapping[str, Any]) -> None:
    """Write a page of HTML and its content as JSON, each in one step."""
    for path, text in ((page, html), (data, json.dumps(content, indent=2, allow_nan=False) + "\n")):
        with replacing(path) as temporary:
            temporary.write_text(text, encoding="utf-8")


def sha256(path: str | os.PathLike[str]) -> str:
    """Hash of a file's bytes, for provenance."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def write_table(table: Table, path: Path, facts: Mapping[str, Any] | None = None) -> None:
    """Write a table as ECSV, whole or not at all, with `facts` among its metadata.

    An existing file is replaced.
    """
    described = table.copy(copy_data=False)
    described.meta = {**(facts or {}), **table.meta}
    with replacing(path) as temporary:
        described.write(temporary, format="ascii.ecsv", overwrite=True)


def embedded_table(name: str) -> Table:
    """Read one of the package's own ECSV tables; its provenance is in ``table.meta``."""
    source = resources.files("pyklip_diffrender") / "instrument" / "data" / f"{name}.ecsv"
    return Table.read(source.read_text(encoding="utf-8-sig"), format="ascii.ecsv")
