"""Read FITS files with clear errors, and write files completely or not at all."""

from __future__ import annotations

import gzip
import hashlib
import io
import os
import secrets
import shutil
import warnings
import zlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from importlib import resources
from pathlib import Path
from typing import Any

from astropy.io import fits
from astropy.table import Table
from astropy.utils.exceptions import AstropyUserWarning

from pyklip_diffrender.errors import (
    CorruptFileError,
    DiffrenderWarning,
    ExistingFileError,
    MissingFileError,
)

__all__ = [
    "embedded_table",
    "open_fits",
    "replacing",
    "require_new",
    "sha256",
    "write_fits",
    "write_table",
]

_GZIP = b"\x1f\x8b"


@contextmanager
def open_fits(path: str | os.PathLike[str]) -> Iterator[fits.HDUList]:
    """Open a FITS file (gzipped or not) and read all of it.

    Raises
    ------
    MissingFileError
        If there is no such file; it is also a `FileNotFoundError`.
    CorruptFileError
        If the file is truncated, or not FITS, if a card cannot be read, or if data do
        not match DATASUM.

    Warns
    -----
    DiffrenderWarning
        If only a header does not match its CHECKSUM, as after editing it without an update of the
        checksum.
    """
    path = Path(path)
    if not path.is_file():
        raise MissingFileError(f"{path}: no such file")
    try:
        content = path.read_bytes()
        if content.startswith(_GZIP):
            # Not by astropy, which mistakes a truncated stream for the end of the file.
            content = gzip.decompress(content)
        with warnings.catch_warnings():
            # Astropy only warns of truncated data.
            warnings.filterwarnings(
                "error", message="(?s).*(truncated|corrupt)", category=AstropyUserWarning
            )
            hdus = fits.open(io.BytesIO(content), lazy_load_hdus=False)
            for number, hdu in enumerate(hdus):
                _require_sound(hdu, number, path)
    except CorruptFileError:
        raise
    except (
        OSError, EOFError, ValueError, TypeError, KeyError, zlib.error, AstropyUserWarning,
        fits.VerifyError,
    ) as error:  # fmt: skip
        raise CorruptFileError(
            f"{path} ({path.stat().st_size} bytes): not a complete FITS file ({error}). "
            "Fetch it again"
        ) from error
    yield hdus


def _require_sound(hdu: Any, number: int, path: Path) -> None:
    """Check the cards, the checksums and the data of an HDU."""
    # Damaged HDUs and those of unknown type have no data or no checksums.
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
    # Before the data are scaled, because the checksums are those of the bytes.
    if hdu.verify_datasum() == 0:
        raise CorruptFileError(
            f"{path}: the data of extension {number} do not have the checksum in its header "
            "(DATASUM). Fetch it again, or delete the card if somebody changed them on purpose"
        )
    if hdu.verify_checksum() == 0:
        warnings.warn(
            f"{path}: the header of extension {number} was changed after its checksum was made "
            "(CHECKSUM); the data were not",
            DiffrenderWarning,
            stacklevel=5,
        )
    _ = hdu.data


def require_new(paths: Iterable[str | os.PathLike[str]], overwrite: bool) -> None:
    """Check, before anything is written, that no file is replaced unless that is wanted.

    Raises
    ------
    ExistingFileError
        If one of the files exists, and `overwrite` is False.
    """
    existing = [str(path) for path in paths if os.path.lexists(path)]
    if existing and not overwrite:
        verb = "exists" if len(existing) == 1 else "exist"
        raise ExistingFileError(
            f"{', '.join(existing)} {verb}; choose another place, or replace with overwrite=True"
        )


@contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Temporary path for a file that replaces `path` if the block succeeds.

    It is in the same folder, so that the replacement is one step, and has the same suffix, on which
    some writers depend (``.fits.gz``, ``.png``). The product has the permissions of the file that
    it replaces, or those of any new file.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    suffix = "".join(path.suffixes)
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(8)}{suffix}")
    # Files of `tempfile` can only be read by their owner. The mode of a plain new file follows from
    # the umask, which cannot be read without changing it for all threads.
    temporary.touch(exist_ok=False)
    try:
        yield temporary
        if path.exists():
            shutil.copymode(path, temporary)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def write_fits(hdus: fits.HDUList, path: str | os.PathLike[str]) -> None:
    """Write a FITS file with checksums in one step, so that it is never incomplete."""
    hdus.update_extend()
    for hdu in hdus:
        # Without the time, which astropy would note: the same content is the same file.
        hdu.add_checksum(when="checksum of the extension")
    with replacing(path) as temporary:
        hdus.writeto(temporary, overwrite=True)


def sha256(path: str | os.PathLike[str]) -> str:
    """Hash of a file's bytes, for provenance."""
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()


def write_table(table: Table, path: Path) -> None:
    """Write a table as ECSV, whole or not at all; an existing file is replaced."""
    with replacing(path) as temporary:
        table.write(temporary, format="ascii.ecsv", overwrite=True)


def embedded_table(name: str) -> Table:
    """Read one of the package's own ECSV tables; its provenance is in ``table.meta``."""
    source = resources.files("pyklip_diffrender") / "instrument" / "data" / f"{name}.ecsv"
    return Table.read(source.read_text(encoding="utf-8"), format="ascii.ecsv")
