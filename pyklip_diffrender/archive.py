"""Calibrated coronagraphic frames of NIRCam from the archive MAST, by programme and target."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

import numpy as np
from astropy import units as u
from astropy.table import QTable, Table

from pyklip_diffrender.errors import ArchiveError, DiffrenderWarning, IncompatibleSetupError
from pyklip_diffrender.io.files import open_fits, replacing
from pyklip_diffrender.io.headers import same_name, unknown_name
from pyklip_diffrender.io.progress import ProgressBar

_TOKEN = "MAST_API_TOKEN"

_SIZE_NOT_STATED = -1
"""Size of a file for which the archive states none."""


def _mast() -> Any:
    """The observations of MAST in astroquery; ArchiveError where that is not installed."""
    try:
        from astroquery import mast
    except ImportError as error:
        raise ArchiveError(
            "files from the archive need astroquery, which is not installed: "
            "python -m pip install astroquery"
        ) from error
    return mast.Observations


def cache_folder() -> Path:
    """Folder for files from the archive: ``pyklip_diffrender/mast`` in the user's cache."""
    cache = os.environ.get("XDG_CACHE_HOME")
    return (Path(cache) if cache else Path.home() / ".cache") / "pyklip_diffrender" / "mast"


def list_calints(
    program: int | str,
    target: str | None = None,
    *,
    filter: str | None = None,
    folder: str | os.PathLike[str] | None = None,
) -> QTable:
    """List the calints files of a programme without fetching them.

    Parameters
    ----------
    program, target, filter, folder
        See `fetch_calints`.

    Returns
    -------
    QTable
        file, filter, size (MB), access ("PUBLIC", or MAST's word for proprietary data), whether the
        file is complete in the folder, and the archive's uri.

    Raises
    ------
    ArchiveError, IncompatibleSetupError
        See `fetch_calints`.

    Examples
    --------
    This needs a network:

    >>> import pyklip_diffrender as dr
    >>> print(dr.archive.list_calints(1184, "G-7-34", filter="F444W"))  # doctest: +SKIP
    """
    observations = _mast()
    try:
        number = int(program)
    except ValueError as error:
        raise IncompatibleSetupError(
            f"program: got {program!r}, expected the number of a JWST programme, such as 1184"
        ) from error
    with _asking():
        observed = observations.query_criteria(
            obs_collection="JWST",
            instrument_name="NIRCAM/CORON",
            # The archive has used both spellings.
            proposal_id=[str(number), f"{number:05d}"],
            calib_level=[2, 3],
        )
    if not len(observed):
        raise ArchiveError(f"MAST has no coronagraphic frames of NIRCam of programme {number}")
    chosen = _chosen(observed, target, filter)
    with _asking():
        products = observations.get_unique_product_list(chosen)
    if len(products):
        products = products[[_is_calints(row, filter) for row in products]]
    if not len(products):
        raise ArchiveError(
            f"MAST has no calints files for these {len(chosen)} observations of programme {number}"
        )
    return _listing(products, _inside(folder, number))


def fetch_calints(
    program: int | str,
    target: str | None = None,
    *,
    filter: str | None = None,
    folder: str | os.PathLike[str] | None = None,
    progress: bool = False,
) -> list[Path]:
    """Fetch the calints files of a programme from MAST, for `reduce` or `ExposureSequence`.

    Needs the extra ``archive`` (astroquery) and a network. Files of reference stars come along
    where the archive associates them with the target. Proprietary files need a token of MAST in the
    environment variable MAST_API_TOKEN.

    Files that are in the folder with the size that the archive states are not fetched again. The
    archive does not state with which version of the calibration (CAL_VER in the header) a file was
    made: delete the files that are to be replaced by newer ones.

    Parameters
    ----------
    program : int or str
        Number of the programme.
    target : str, optional
        Name of the star in the archive. Default all stars of the programme.
    filter : str, optional
        Filter, such as "F444W". Default all.
    folder : path, optional
        Default ``cache_folder() / program``.
    progress : bool
        Show a progress bar.

    Returns
    -------
    list of Path

    Raises
    ------
    ArchiveError
        Without astroquery or a network, if nothing is found or everything is proprietary, or if a
        file does not arrive. Files that have arrived are kept, and the next call goes on.
    IncompatibleSetupError
        For a target or a filter that the programme does not have.

    Warns
    -----
    DiffrenderWarning
        If some of the files are proprietary; they are left out.

    Examples
    --------
    This needs a network:

    >>> import pyklip_diffrender as dr
    >>> files = dr.fetch_calints(1184, "G-7-34", filter="F444W")  # doctest: +SKIP
    >>> result = dr.reduce(files, "maps")  # doctest: +SKIP
    """
    listing = list_calints(program, target, filter=filter, folder=folder)
    listing = _permitted(listing)
    inside = _inside(folder, int(program))
    with ProgressBar("files from MAST", len(listing), shown=progress) as bar:
        for count, row in enumerate(listing):
            if not row["complete"]:
                try:
                    _download(row, inside / row["file"])
                except ArchiveError as error:
                    raise ArchiveError(
                        f"{error}. {count} of {len(listing)} files are complete in {inside}; the "
                        "same call goes on from there"
                    ) from error
            bar.update(1)
    return [inside / name for name in listing["file"]]


def _download(row: Any, path: Path) -> None:
    """Fetch a file under another name, and give it its own once it is complete."""
    with replacing(path) as temporary:
        temporary.unlink()  # Some releases of astroquery would go on with what is there.
        with _asking():
            status, message, _ = _mast().download_file(
                row["uri"], local_path=str(temporary), cache=False, verbose=False
            )
        if status != "COMPLETE":
            raise ArchiveError(f"{path.name} was not fetched ({message or status})")
        size, expected = temporary.stat().st_size, row["bytes"]
        if expected == _SIZE_NOT_STATED:
            with open_fits(temporary):  # Raises an exception for a part of a file.
                pass
        elif size != expected:
            raise ArchiveError(f"{path.name}: {size} of {expected} bytes arrived")


def _permitted(listing: QTable) -> QTable:
    """The files that may be fetched."""
    public = np.asarray(listing["access"]) == "PUBLIC"
    needed = ~public & ~np.asarray(listing["complete"])
    if not needed.any():
        return listing
    token = os.environ.get(_TOKEN)
    if token:
        with _asking():
            _mast().login(token=token)
        return listing
    names = ", ".join(listing["file"][needed])
    reason = f"proprietary, and there is no token of MAST in {_TOKEN}: {names}"
    if needed.all():
        raise ArchiveError(f"all files are {reason}")
    warnings.warn(f"left out, because they are {reason}", DiffrenderWarning, stacklevel=3)
    return listing[~needed]


@contextmanager
def _asking() -> Iterator[None]:
    """Turn what goes wrong between here and the archive into errors that say so."""
    from astroquery import exceptions
    from requests import RequestException

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", exceptions.NoResultsWarning)
            yield
    except (
        RequestException,  # Astroquery lets these through.
        ConnectionError,
        exceptions.TimeoutError,
        exceptions.RemoteServiceError,
    ) as error:
        raise ArchiveError(
            f"MAST cannot be reached ({type(error).__name__}: {error}). Check the network, or "
            "download the files from https://mast.stsci.edu and pass them"
        ) from error


def _chosen(observed: Table, target: str | None, filter: str | None) -> Table:
    """Observations of a star through a filter."""
    for key, choice, column, names in (
        ("target", target, "target_name", lambda value: [str(value)]),
        ("filter", filter, "filters", lambda value: str(value).split(";")),
    ):
        if choice is None:
            continue
        keep = [any(same_name(choice, each) for each in names(value)) for value in observed[column]]
        if not any(keep):
            known = {each for value in observed[column] for each in names(value)}
            raise unknown_name(key, choice, known)
        observed = observed[keep]
    return observed


def _is_calints(row: Any, filter: str | None) -> bool:
    """Whether a product is a calints file; associations also list files of other filters."""
    filters = str(row["filters"]).split(";") if "filters" in row.colnames else []
    return str(row["productFilename"]).endswith("_calints.fits") and (
        filter is None or not filters or any(same_name(filter, each) for each in filters)
    )


def _listing(products: Table, folder: Path) -> QTable:
    names = [str(name) for name in products["productFilename"]]
    for name in names:
        if {PurePosixPath(name).name, PureWindowsPath(name).name} != {name.lstrip(".")}:
            raise ArchiveError(
                f"MAST lists a product called {name!r}, expected the name of a file without a "
                "folder. Report it to the archive, and download the files that you need by hand"
            )
    sizes = np.ma.filled(np.ma.asarray(products["size"]), _SIZE_NOT_STATED).astype(np.int64)
    complete = [
        (folder / name).is_file() and size in (_SIZE_NOT_STATED, (folder / name).stat().st_size)
        for name, size in zip(names, sizes, strict=True)
    ]
    listing = QTable(
        {
            "file": names,
            "filter": [str(each) for each in products["filters"]],
            "size": sizes / 1e6 * u.Mbyte,
            "access": [str(each) for each in products["dataRights"]],
            "complete": complete,
            "bytes": sizes,
            "uri": [str(each) for each in products["dataURI"]],
        }
    )
    listing["size"].info.format = ".1f"
    listing.sort("file")
    return listing


def _inside(folder: str | os.PathLike[str] | None, program: int) -> Path:
    return cache_folder() / str(program) if folder is None else Path(folder)
