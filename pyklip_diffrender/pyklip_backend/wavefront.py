"""The wavefront map that a reduction starts from."""

from __future__ import annotations

import os
from functools import lru_cache
from pathlib import Path

from pyklip_diffrender.errors import MissingOPDError
from pyklip_diffrender.pyklip_backend.settings import OPDLike
from pyklip_diffrender.wavefront.opd import OPDMap, as_opd_map

__all__ = ["starting_opd"]


def starting_opd(opd: OPDLike | None) -> OPDMap:
    """Read the wavefront map that the settings name.

    Raises
    ------
    MissingOPDError
        If there is none, with the ways to give one.
    CorruptFileError, UnitError, ShapeError, NonFiniteError
        As `pyklip_diffrender.wavefront.opd.read_opd`.
    """
    if opd is None:
        raise MissingOPDError(
            "algo='diffrender' starts from a measured wavefront map and none was given. Give a "
            "FITS file, an array in metres or a Quantity, in one of three ways: "
            "register(opd=...) once; `with backend(opd=...):` around klip_dataset; or "
            "dataset.diffrender = DiffrenderSettings(opd=...). For JWST, take the map measured "
            "closest in time to the observation"
        )
    if isinstance(opd, str | os.PathLike):
        path = Path(opd).resolve()
        # A contrast curve reads the same map for each of its 120 reductions.
        state = path.stat() if path.is_file() else None
        return _read(path, state and (state.st_mtime_ns, state.st_size))
    return as_opd_map(opd)


@lru_cache(maxsize=4)
def _read(path: Path, version: tuple[int, int] | None) -> OPDMap:
    """Read a map once for each version of its file."""
    return as_opd_map(path)
