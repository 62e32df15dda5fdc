"""Files: FITS read with a clear error, products written so that nothing is half there."""

from __future__ import annotations

import gzip
import hashlib
import io
import os
import tempfile
import warnings
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import resources
from pathlib import Path

from astropy.io import fits
from astropy.table import Table
from astropy.utils.exceptions import AstropyUserWarning

from pyklip_diffrender.errors import CorruptFileError

__all__ = ["embedded_table", "open_fits", "replacing", "sha256", "write_fits"]

_GZIP = b"\x1f\x8b"


@contextmanager
def open_fits(path: str | os.PathLike[str]) -> Iterator[fits.HDUList]:
    """Open a FITS file (gzipped or not) and read all of it before anything is used.

    Raises
    ------
    CorruptFileError
        If the file is missing, truncated, or not FITS.
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
            for hdu in hdus:
                _ = hdu.data
    except (
        OSError, EOFError, ValueError, TypeError, KeyError, zlib.error, AstropyUserWarning
    ) as error:  # fmt: skip
        raise CorruptFileError(
            f"{path} ({path.stat().st_size} bytes): not a complete FITS file ({error}). "
            "Fetch it again"
        ) from error
    yield hdus


@contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Give a temporary path that takes the place of `path` only when the block succeeds.

    The suffix is kept, so that writers which look at it (``.fits.gz``, ``.png``) do as usual.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(
        dir=path.parent, prefix=f".{path.name}.", suffix="".join(path.suffixes)
    )
    os.close(handle)
    temporary = Path(name)
    # mkstemp makes files that only their owner can read; products are for everyone.
    umask = os.umask(0)
    os.umask(umask)
    temporary.chmod(0o666 & ~umask)
    try:
        yield temporary
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
    source = resources.files("pyklip_diffrender") / "data" / f"{name}.ecsv"
    return Table.read(source.read_text(encoding="utf-8"), format="ascii.ecsv")
