"""The original pixels, errors, flags and headers of JWST files, which pyKLIP does not keep.

`JWSTData.readdata` keeps the base name of each file and frames that a cubic spline has shifted to
the centre of the array. A wavefront fit needs the pixels as the detector recorded them, with their
errors. While the backend is registered, reading a dataset also attaches a `SourceFrames` to it, and
reading its library of reference stars attaches the paths of their files. A dataset that was read
before gets its `SourceFrames` from the files, if these can be found.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from pyklip_diffrender.errors import CorruptFileError, NoValidPixelsError
from pyklip_diffrender.io.files import open_fits
from pyklip_diffrender.io.headers import fits_text, merged_header
from pyklip_diffrender.scene.detector_pixels import SHIFTS
from pyklip_diffrender.scene.frame_files import FrameFile
from pyklip_diffrender.scene.jwst_files import BAD_PIXEL_BITS
from pyklip_diffrender.scene.observation import Observation
from pyklip_diffrender.scene.sequence import Sequence

__all__ = [
    "ATTRIBUTE",
    "REFERENCES",
    "JudgedFiles",
    "OpenedFile",
    "SourceFrames",
    "attach_source",
    "judged_before",
    "keeping_references",
    "keeping_source",
    "read_source",
    "why_without_source",
]

logger = logging.getLogger(__name__)

ATTRIBUTE = "_diffrender_source"
"""Attribute of the dataset that holds its `SourceFrames`."""

REASON = "_diffrender_no_source"
"""Attribute of the dataset that says why it has no `SourceFrames`."""

REFERENCES = "_diffrender_references"
"""Attribute of the dataset with the paths of the files in its library of reference stars."""

NON_SCIENCE = 512
"""The one bit of the JWST data-quality flags that pyKLIP uses: it sets such pixels to NaN."""

_ROUNDING = 1e-4
"""Difference, relative to the brightest pixel, between two shifts of the same frame, one of them
in single precision."""


@dataclass(frozen=True, eq=False)
class SourceFrames:
    """The N frames of a JWST dataset before pyKLIP shifted them, in the order of the dataset.

    Frames that spaceKLIP has aligned are back on the pixels of the detector.

    Attributes
    ----------
    headers : list of Header
        One per frame: primary and SCI header merged.
    data : ndarray, (N, ny, nx)
        Pixels before resampling; NaN where the flags say NON_SCIENCE.
    error : ndarray, (N, ny, nx), or None
        Standard deviations from ERR, in the unit of `data`.
    usable : ndarray of bool, (N, ny, nx)
        False where a flag excludes the pixel from the fit.
    centers : ndarray, (N, 2)
        Star centres x, y in `data`, 0-indexed.
    aligned : ndarray, (N, ny, nx)
        Copy of ``dataset.input`` after reading: `data` shifted by pyKLIP.
    aligned_centers : ndarray, (N, 2)
        Copy of ``dataset.centers`` after reading.
    filenames : tuple of str
        ``dataset.filenames`` after reading.
    first_pixels : list of (int, int) or None
        Detector column and row of the first pixel of every frame, where known.
    star_offsets : list of (float, float) or None
        x, y of the star from the occulter as the file says, arcsec, where it does.
    paths : list of Path
        The file of every frame.
    files : dict of Path to FrameFile
        The files, as they were read.
    sequence : Sequence or None
        The sequence that the files were sorted into, if they were before pyKLIP read them.
    """

    headers: list[fits.Header]
    data: NDArray[np.floating[Any]]
    error: NDArray[np.float64] | None
    usable: NDArray[np.bool_]
    centers: NDArray[np.float64]
    aligned: NDArray[np.floating[Any]]
    aligned_centers: NDArray[np.float64]
    filenames: tuple[str, ...]
    first_pixels: list[tuple[int, int] | None]
    star_offsets: list[tuple[float, float] | None]
    paths: list[Path]
    files: dict[Path, FrameFile]
    sequence: Sequence | None = None

    def __deepcopy__(self, memo: dict[int, Any]) -> SourceFrames:
        """Itself: it never changes, so copies of a dataset can share it."""
        return self

    @property
    def pixelscale(self) -> float:
        """Arcsec per pixel."""
        return float(np.sqrt(self.headers[0]["PIXAR_A2"]))

    def places(self, dataset: Any) -> NDArray[np.intp] | None:
        """Return where the frames of a dataset are among these; None if one is not.

        Frames of a dataset may have been left out, or put into another order.
        """
        # While products are written, names are as FITS headers can hold them.
        names, read = (
            [fits_text(name) for name in each] for each in (dataset.filenames, self.filenames)
        )
        if names == read:
            return np.arange(len(names))
        where = {name: k for k, name in reversed(list(enumerate(read)))}
        if len(set(names)) < len(names) or not set(names) <= set(where):
            return None
        return np.array([where[name] for name in names])


def keeping_source(readdata: Callable[..., None]) -> Callable[..., None]:
    """Wrap `JWSTData.readdata` so that it also attaches a `SourceFrames` to the dataset."""

    def readdata_and_source(self: Any, filepaths: Any) -> None:
        readdata(self, filepaths)
        try:
            setattr(self, ATTRIBUTE, read_source(self, filepaths))
        except (KeyError, ValueError, OSError) as error:
            # The dataset itself is complete without the source frames.
            setattr(self, REASON, str(error))

    readdata_and_source.__name__ = readdata.__name__
    readdata_and_source.__doc__ = readdata.__doc__
    return readdata_and_source


def attach_source(dataset: Any, files: Any = None) -> None:
    """Attach a `SourceFrames` to a `JWSTData` that was read before `register`, if possible.

    Parameters
    ----------
    dataset : pyklip.instruments.Instrument.Data
    files : path or sequence of path, optional
        Files or folders in which the dataset's files are looked for by name, beside the current
        folder.
    """
    if hasattr(dataset, ATTRIBUTE) or hasattr(dataset, REASON) or not _reads_files(dataset):
        return
    several = [files] if isinstance(files, str | os.PathLike) else list(files or ())
    known: dict[str, str] = {}
    for path in [Path(), *map(Path, several)]:
        inside = path.iterdir() if path.is_dir() else [path]
        known |= {each.name: str(each) for each in inside}
    # pyKLIP appends the number of the integration to the name of the file.
    names = list(dict.fromkeys(str(each).rpartition("_INT")[0] for each in dataset.filenames))
    missing = [name for name in names if name not in known]
    if missing:
        return
    try:
        setattr(dataset, ATTRIBUTE, read_source(dataset, [known[n] for n in names], late=True))
    except (KeyError, ValueError, OSError) as error:
        setattr(dataset, REASON, str(error))
    else:
        logger.info("the files of the dataset were read again: it was made before register()")


def why_without_source(dataset: Any) -> str | None:
    """Return why errors and original pixels of a dataset's files are not known.

    None for a dataset that has them, or was not read from files.
    """
    if hasattr(dataset, ATTRIBUTE) or not _reads_files(dataset):
        return None
    reason = getattr(dataset, REASON, None)
    if reason is not None:
        return str(reason)
    return (
        "the dataset was made before register() or the backend block. Make it after that, or say "
        "where its files are: DiffrenderSettings(files=...)"
    )


def _reads_files(dataset: Any) -> bool:
    """Whether a dataset is a `JWSTData`, which has read files."""
    return hasattr(dataset, "center_include_offset") and hasattr(dataset, "center_kw_x")


def read_source(
    dataset: Any, filepaths: str | Iterable[str], *, late: bool = False
) -> SourceFrames:
    """Read the pixels, errors, flags and headers of the files of a `JWSTData`.

    Parameters
    ----------
    dataset : JWSTData
    filepaths : str or iterable of str
    late : bool
        The dataset was not just filled: its frames may have been changed, left out or reordered
        since, so that all frames are shifted again.

    Raises
    ------
    ValueError
        If shifting these pixels as pyKLIP does not reproduce ``dataset.input``.
    """
    from pyklip.klip import align_and_scale

    paths = [filepaths] if isinstance(filepaths, str) else list(filepaths)
    files = [_read(path, dataset) for path in paths]
    counts = [len(file.data) for file in files]
    middle = (np.array(files[0].data.shape[:0:-1]) - 1) / 2.0

    def shifted(file: _File, frame: int) -> NDArray[np.float64]:
        return np.asarray(
            align_and_scale(file.as_read[frame], new_center=middle, old_center=file.center_read)
        )

    aligned, centers = np.array(dataset.input), np.array(dataset.centers)
    names = tuple(str(name) for name in dataset.filenames)
    if late:
        aligned = np.array([shifted(f, k) for f in files for k in range(len(f.data))], np.float32)
        centers = np.tile(middle, (len(aligned), 1))
        names = tuple(
            f"{Path(path).name}_INT{k + 1}"
            for path, n in zip(paths, counts, strict=True)
            for k in range(n)
        )
    judged = _JUDGED.get()
    source = SourceFrames(
        headers=[file.header for file, n in zip(files, counts, strict=True) for _ in range(n)],
        data=np.concatenate([file.data for file in files]),
        error=None
        if any(file.error is None for file in files)
        else np.concatenate([file.error for file in files if file.error is not None]),
        usable=np.concatenate([file.usable for file in files]),
        centers=np.concatenate([file.centers for file in files]),
        aligned=aligned,
        aligned_centers=centers,
        filenames=names,
        first_pixels=[f.first_pixel for f, n in zip(files, counts, strict=True) for _ in range(n)],
        star_offsets=[f.star_offset for f, n in zip(files, counts, strict=True) for _ in range(n)],
        paths=[f.file.path for f, n in zip(files, counts, strict=True) for _ in range(n)],
        files={each.file.path: each.file for each in files},
        sequence=None if judged is None else judged.sequence,
    )
    if not late:
        same_shape = source.data.shape == aligned.shape
        if not same_shape or not _is_close(shifted(files[0], 0), aligned[0]):
            raise ValueError(f"{paths[0]}: pyKLIP shifted these frames in a way not known here")
    return source


def _is_close(one: NDArray[Any], other: NDArray[Any]) -> bool:
    """Whether two frames differ by no more than rounding."""
    scale = np.max(np.abs(other), where=np.isfinite(other), initial=0.0)
    return np.allclose(one, other, rtol=0.0, atol=_ROUNDING * scale, equal_nan=True)


class _File(NamedTuple):
    """The frames of one file; see `SourceFrames`."""

    file: FrameFile
    header: fits.Header
    data: NDArray[np.floating[Any]]
    error: NDArray[np.float64] | None
    usable: NDArray[np.bool_]
    centers: NDArray[np.float64]
    first_pixel: tuple[int, int] | None
    star_offset: tuple[float, float] | None
    as_read: NDArray[Any]
    """The frames, and their star's x, y, as pyKLIP reads them."""
    center_read: NDArray[np.float64]


class OpenedFile(NamedTuple):
    """What a file holds, for `reduce` and as pyKLIP reads it."""

    file: FrameFile
    primary: fits.Header
    science: fits.Header
    pixels: NDArray[Any]
    flags: NDArray[Any]
    aligned: bool

    @classmethod
    def at(cls, path: str | os.PathLike[str]) -> OpenedFile:
        """Open a file, once.

        Raises
        ------
        CorruptFileError, KeyError
            If it cannot be read, or has no SCI extension.
        """
        where = Path(path).absolute()
        with open_fits(where) as hdus:
            return cls(
                FrameFile.in_hdus(hdus, where, frames=True),
                hdus[0].header,
                hdus["SCI"].header,
                hdus["SCI"].data,
                hdus["DQ"].data if "DQ" in hdus else np.zeros((), np.uint32),
                any(name in hdus for name in SHIFTS),
            )


class JudgedFiles(NamedTuple):
    """Files that were opened and judged before pyKLIP reads them, by path."""

    files: Mapping[Path, OpenedFile]
    sequence: Sequence


_JUDGED: ContextVar[JudgedFiles | None] = ContextVar("judged", default=None)


@contextmanager
def judged_before(files: JudgedFiles) -> Iterator[None]:
    """Take files that were opened already for datasets that are read inside."""
    token = _JUDGED.set(files)
    try:
        yield
    finally:
        _JUDGED.reset(token)


def _read(path: str, dataset: Any) -> _File:
    """Read one file as `reduce` does, for the star's position that pyKLIP has read."""
    judged = _JUDGED.get()
    known = None if judged is None else judged.files.get(Path(path).absolute())
    file, primary, science, pixels, flags, aligned = known or OpenedFile.at(path)
    header = merged_header(primary, science, path)
    as_read = np.array(pixels)
    as_read = as_read[np.newaxis] if as_read.ndim == 2 else as_read
    flags = np.broadcast_to(flags, as_read.shape)
    as_read[(flags & NON_SCIENCE) != 0] = np.nan
    # As pyKLIP finds the centre: the given keywords, else CRPIX, plus the dither if requested.
    keywords = (dataset.center_kw_x, "CRPIX1"), (dataset.center_kw_y, "CRPIX2")
    center = np.array([science.get(key, science.get(other)) - 1 for key, other in keywords], float)
    if dataset.center_include_offset:
        offset = np.array([primary["XOFFSET"], primary["YOFFSET"]])
        center += offset / np.sqrt(science["PIXAR_A2"])
    centers = np.tile(center, (len(as_read), 1))
    frames = file.frames
    if isinstance(frames, CorruptFileError | NoValidPixelsError):
        # Such as a file without errors, or a frame of which all pixels are flagged.
        logger.warning("only the pixels and flags are used: %s", frames)
        usable = (flags & BAD_PIXEL_BITS) == 0
        return _File(file, header, as_read, None, usable, centers, None, None, as_read, center)
    if not isinstance(frames, Observation):
        raise frames or CorruptFileError(f"{path}: no frames")
    if aligned:
        # Frames are back on the pixels of the detector, so that flat-field errors are, too.
        stated = [
            header.get(f"STARCEN{axis}", header.get(f"CRPIX{k}"))
            for k, axis in ((1, "X"), (2, "Y"))
        ]
        centers += frames.center - (np.array(stated, dtype=float) - 1)
    # The gaps of frames that are put back are where they were before the shift.
    seen = frames.valid if aligned else np.isfinite(as_read)
    return _File(
        file,
        header,
        np.where(seen, frames.data, np.nan),
        np.where(frames.valid, frames.error, 0.0),
        frames.valid,
        centers,
        frames.first_pixel,
        frames.star_offset,
        as_read,
        center,
    )


def keeping_references(readpsflib: Callable[..., None]) -> Callable[..., None]:
    """Wrap `JWSTData.readpsflib` so that the dataset also knows the paths of the files."""

    def readpsflib_and_paths(self: Any, psflib_filepaths: Any, *args: Any, **kw: Any) -> None:
        readpsflib(self, psflib_filepaths, *args, **kw)
        several = [psflib_filepaths] if isinstance(psflib_filepaths, str) else psflib_filepaths
        setattr(self, REFERENCES, tuple(str(Path(path).resolve()) for path in several))

    readpsflib_and_paths.__name__ = readpsflib.__name__
    readpsflib_and_paths.__doc__ = readpsflib.__doc__
    return readpsflib_and_paths
