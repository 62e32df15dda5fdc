"""Files: FITS read with a clear error, products written so that nothing is half there."""

from __future__ import annotations

import gzip
import hashlib
import io
import os
import secrets
import shutil
import warnings
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import resources
from pathlib import Path
from typing import Any

from astropy.io import fits
from astropy.table import Table
from astropy.utils.exceptions import AstropyUserWarning

from pyklip_diffrender.errors import CorruptFileError, DiffrenderWarning

__all__ = ["embedded_table", "open_fits", "replacing", "sha256", "write_fits"]

_GZIP = b"\x1f\x8b"


@contextmanager
def open_fits(path: str | os.PathLike[str]) -> Iterator[fits.HDUList]:
    """Open a FITS file (gzipped or not) and read all of it before anything is used.

    Raises
    ------
    CorruptFileError
        If the file is missing, truncated, or not FITS, if a card cannot be read, or if data do
        not have the sum that DATASUM promises.

    Warns
    -----
    DiffrenderWarning
        If only a header differs from its CHECKSUM: that is what many an editor of headers leaves
        behind, and the data are whole.
    """
    path = Path(path)
    if not path.is_file():
        raise CorruptFileError(f"{path}: no such file")
    try:
        content = path.read_bytes()
        if content.startswith(_GZIP):
            # Not left to astropy, which takes an early end of the stream for the last HDU.
            content = gzip.decompress(content)
        with warnings.catch_warnings():
            # Data that end too early are only a warning to astropy; here they are an error.
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
    """Look at all of an HDU once: its cards, its sums, its data."""
    # What astropy takes for a damaged or foreign HDU has no data, or no sums.
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
    # Before the data are scaled: the sums are of the bytes.
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


@contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Give a temporary path that takes the place of `path` only when the block succeeds.

    The temporary file lies in the same folder, so that the replacement is one step, and keeps
    the suffix, so that writers which look at it (``.fits.gz``, ``.png``) do as usual. The product
    has the permissions of the file that it replaces, or those of any new file.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    suffix = "".join(path.suffixes)
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(8)}{suffix}")
    # Not `tempfile`, whose files only their owner can read: the mode of a plain new file follows
    # from the umask, which cannot be read without changing it for all threads.
    temporary.touch(exist_ok=False)
    try:
        yield temporary
        if path.exists():
            shutil.copymode(path, temporary)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def write_fits(hdus: fits.HDUList, path: str | os.PathLike[str]) -> None:
    """Write a FITS file in one step: the old file, or the new one, never a part."""
    with replacing(path) as temporary:
        hdus.writeto(temporary, overwrite=True)


def sha256(path: str | os.PathLike[str]) -> str:
    """Hash of a file's bytes, for provenance."""
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()


def embedded_table(name: str) -> Table:
    """Read one of the package's own ECSV tables; its provenance is in ``table.meta``."""
    source = resources.files("pyklip_diffrender") / "instrument" / "data" / f"{name}.ecsv"
    return Table.read(source.read_text(encoding="utf-8"), format="ascii.ecsv")
