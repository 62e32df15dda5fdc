"""The original pixels, errors, flags and headers of JWST files, which pyKLIP does not keep.

`JWSTData.readdata` keeps the base name of each file and frames that a cubic spline has shifted to
the centre of the array. A wavefront fit needs the pixels as the detector recorded them, with their
errors. While the backend is registered, reading a dataset also attaches a `SourceFrames` to it, and
reading its library of reference stars attaches the paths of their files.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from pyklip_diffrender.io.files import open_fits
from pyklip_diffrender.io.headers import merged_header
from pyklip_diffrender.scene.detector_pixels import SHIFTS, first_pixel
from pyklip_diffrender.scene.jwst_files import BAD_PIXEL_BITS, dither
from pyklip_diffrender.scene.noise import calibrated_errors
from pyklip_diffrender.scene.observation import Observation

__all__ = [
    "ATTRIBUTE",
    "REFERENCES",
    "SourceFrames",
    "keeping_references",
    "keeping_source",
    "read_source",
]

logger = logging.getLogger(__name__)

ATTRIBUTE = "_diffrender_source"
"""Attribute of the dataset that holds its `SourceFrames`."""

REFERENCES = "_diffrender_references"
"""Attribute of the dataset with the paths of the files in its library of reference stars."""

NON_SCIENCE = 512
"""The one bit of the JWST data-quality flags that pyKLIP uses: it sets such pixels to NaN."""


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
    """

    headers: list[fits.Header]
    data: NDArray[np.float32]
    error: NDArray[np.float32] | None
    usable: NDArray[np.bool_]
    centers: NDArray[np.float64]
    aligned: NDArray[np.floating[Any]]
    aligned_centers: NDArray[np.float64]
    filenames: tuple[str, ...]
    first_pixels: list[tuple[int, int] | None]
    star_offsets: list[tuple[float, float] | None]

    def __deepcopy__(self, memo: dict[int, Any]) -> SourceFrames:
        """Itself: it never changes, so copies of a dataset can share it."""
        return self

    @property
    def pixelscale(self) -> float:
        """Arcsec per pixel."""
        return float(np.sqrt(self.headers[0]["PIXAR_A2"]))

    def belongs_to(self, dataset: Any) -> bool:
        """Whether the dataset still has the frames, shape and centres it was read with."""
        return (
            np.shape(dataset.input) == self.aligned.shape
            and self.lists(dataset)
            and np.array_equal(dataset.centers, self.aligned_centers)
        )

    def lists(self, dataset: Any) -> bool:
        """Whether the dataset still has the same frames, however they were changed."""
        return tuple(dataset.filenames) == self.filenames


def keeping_source(readdata: Callable[..., None]) -> Callable[..., None]:
    """Wrap `JWSTData.readdata` so that it also attaches a `SourceFrames` to the dataset."""

    def readdata_and_source(self: Any, filepaths: Any) -> None:
        readdata(self, filepaths)
        try:
            setattr(self, ATTRIBUTE, read_source(self, filepaths))
        except (KeyError, ValueError, OSError) as error:
            # The dataset itself is complete without the source frames.
            logger.warning(
                "the files were read, but not their errors and original pixels: %s", error
            )

    readdata_and_source.__name__ = readdata.__name__
    readdata_and_source.__doc__ = readdata.__doc__
    return readdata_and_source


def read_source(dataset: Any, filepaths: str | Iterable[str]) -> SourceFrames:
    """Read the pixels, errors, flags and headers of a `JWSTData` that was just filled.

    Raises
    ------
    ValueError
        If shifting these pixels as pyKLIP does not reproduce ``dataset.input``.
    """
    from pyklip.klip import align_and_scale

    paths = [filepaths] if isinstance(filepaths, str) else list(filepaths)
    files = [_read(path, dataset) for path in paths]
    counts = [len(file.data) for file in files]
    source = SourceFrames(
        headers=[file.header for file, n in zip(files, counts, strict=True) for _ in range(n)],
        data=np.concatenate([file.data for file in files]),
        error=None
        if any(file.error is None for file in files)
        else np.concatenate([file.error for file in files if file.error is not None]),
        usable=np.concatenate([file.usable for file in files]),
        centers=np.concatenate([file.centers for file in files]),
        aligned=np.array(dataset.input),
        aligned_centers=np.array(dataset.centers),
        filenames=tuple(dataset.filenames),
        first_pixels=[f.first_pixel for f, n in zip(files, counts, strict=True) for _ in range(n)],
        star_offsets=[f.star_offset for f, n in zip(files, counts, strict=True) for _ in range(n)],
    )
    first = source.aligned[0]
    shifted = align_and_scale(
        files[0].as_read, new_center=dataset.centers[0], old_center=files[0].center_read
    ).astype(first.dtype)
    same_shape = source.data.shape == source.aligned.shape
    if not same_shape or not np.array_equal(shifted, first, equal_nan=True):
        raise ValueError(f"{paths[0]}: pyKLIP shifted these frames in a way not known here")
    return source


class _File(NamedTuple):
    """The frames of one file; see `SourceFrames`."""

    header: fits.Header
    data: NDArray[np.float32]
    error: NDArray[np.float32] | None
    usable: NDArray[np.bool_]
    centers: NDArray[np.float64]
    first_pixel: tuple[int, int] | None
    star_offset: tuple[float, float] | None
    as_read: NDArray[np.float32]
    """The first frame, and its star's x, y, as pyKLIP reads them."""
    center_read: NDArray[np.float64]


def _read(path: str, dataset: Any) -> _File:
    """Read one file."""
    with open_fits(path) as hdus:
        primary, science = hdus[0].header, hdus["SCI"].header
        data = _cube(hdus["SCI"].data)
        error = _cube(hdus["ERR"].data) if "ERR" in hdus else None
        flags = hdus["DQ"].data if "DQ" in hdus else np.uint32(0)
        header = merged_header(primary, science, path)
        aligned = any(name in hdus for name in SHIFTS)
    flags = np.broadcast_to(flags, data.shape)
    data[(flags & NON_SCIENCE) != 0] = np.nan
    # As pyKLIP finds the centre: the given keywords, else CRPIX, plus the dither if requested.
    keywords = (dataset.center_kw_x, "CRPIX1"), (dataset.center_kw_y, "CRPIX2")
    center = np.array([science.get(key, science.get(other)) - 1 for key, other in keywords], float)
    if dataset.center_include_offset:
        offset = np.array([primary["XOFFSET"], primary["YOFFSET"]])
        center += offset / np.sqrt(science["PIXAR_A2"])
    centers = np.tile(center, (len(data), 1))
    as_read, usable = data[0], (flags & BAD_PIXEL_BITS) == 0
    if not aligned:
        moved = "STARCENX" in header
        origin = None if moved else first_pixel(header, center, data.shape[1:], Path(path).name)
        if error is not None and header.get("INSTRUME") == "NIRCAM":
            # As `Observation.from_fits` does.
            scale = float(np.sqrt(science["PIXAR_A2"]))
            known = usable & np.isfinite(data) & np.isfinite(error) & (error > 0)
            error = calibrated_errors(
                np.where(known, data, 0.0), np.where(known, error, 1.0), known, centers,
                (scale, scale), Path(path).name,
            ).astype(np.float32)  # fmt: skip
            error[~known] = 0.0
        dithered = None if moved else dither(header, Path(path).name)
        return _File(header, data, error, usable, centers, origin, dithered, as_read, center)
    # The shift of the alignment is undone, so that flat-field errors are in their pixels again.
    back = Observation.from_fits(path)
    stated = [
        header.get(f"STARCEN{axis}", header.get(f"CRPIX{k}")) for k, axis in ((1, "X"), (2, "Y"))
    ]
    return _File(
        header,
        np.where(np.isfinite(data), back.data, np.nan).astype(np.float32),
        np.where(back.valid, back.error, 0.0).astype(np.float32),
        back.valid,
        centers + back.center - (np.array(stated, dtype=float) - 1),
        back.first_pixel,
        back.star_offset,
        as_read,
        center,
    )


def _cube(pixels: NDArray[Any]) -> NDArray[np.float32]:
    pixels = np.array(pixels, dtype=np.float32)
    return pixels[np.newaxis] if pixels.ndim == 2 else pixels


def keeping_references(readpsflib: Callable[..., None]) -> Callable[..., None]:
    """Wrap `JWSTData.readpsflib` so that the dataset also knows the paths of the files."""

    def readpsflib_and_paths(self: Any, psflib_filepaths: Any, *args: Any, **kw: Any) -> None:
        readpsflib(self, psflib_filepaths, *args, **kw)
        several = [psflib_filepaths] if isinstance(psflib_filepaths, str) else psflib_filepaths
        setattr(self, REFERENCES, tuple(str(Path(path).resolve()) for path in several))

    readpsflib_and_paths.__name__ = readpsflib.__name__
    readpsflib_and_paths.__doc__ = readpsflib.__doc__
    return readpsflib_and_paths
