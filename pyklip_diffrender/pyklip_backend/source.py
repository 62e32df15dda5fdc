"""The original pixels, errors, flags and headers of JWST files, which pyKLIP does not keep.

`JWSTData.readdata` keeps the base name of each file and frames that a cubic spline has shifted to
the centre of the array. A wavefront fit needs the pixels as the detector recorded them, with their
errors. While the backend is registered, reading a dataset also attaches a `SourceFrames` to it.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from pyklip_diffrender.io.files import open_fits
from pyklip_diffrender.io.headers import merged_header
from pyklip_diffrender.scene.jwst_files import BAD_PIXEL_BITS

__all__ = ["ATTRIBUTE", "SourceFrames", "keeping_source", "read_source"]

logger = logging.getLogger(__name__)

ATTRIBUTE = "_diffrender_source"
"""Attribute of the dataset that holds its `SourceFrames`."""

NON_SCIENCE = 512
"""The one bit of the JWST data-quality flags that pyKLIP uses: it sets such pixels to NaN."""


@dataclass(frozen=True, eq=False)
class SourceFrames:
    """The N frames of a JWST dataset as its files hold them, in the order of the dataset.

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
    """

    headers: list[fits.Header]
    data: NDArray[np.float32]
    error: NDArray[np.float32] | None
    usable: NDArray[np.bool_]
    centers: NDArray[np.float64]
    aligned: NDArray[np.floating[Any]]
    aligned_centers: NDArray[np.float64]
    filenames: tuple[str, ...]

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
            and tuple(dataset.filenames) == self.filenames
            and np.array_equal(dataset.centers, self.aligned_centers)
        )


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
    headers, data, errors, usable, centers = zip(*(_read(p, dataset) for p in paths), strict=True)
    source = SourceFrames(
        headers=[header for header, frames in zip(headers, data, strict=True) for _ in frames],
        data=np.concatenate(data),
        error=None if any(error is None for error in errors) else np.concatenate(errors),
        usable=np.concatenate(usable),
        centers=np.concatenate(centers),
        aligned=np.array(dataset.input),
        aligned_centers=np.array(dataset.centers),
        filenames=tuple(dataset.filenames),
    )
    first = source.aligned[0]
    shifted = align_and_scale(
        source.data[0], new_center=dataset.centers[0], old_center=source.centers[0]
    ).astype(first.dtype)
    same_shape = source.data.shape == source.aligned.shape
    if not same_shape or not np.array_equal(shifted, first, equal_nan=True):
        raise ValueError(f"{paths[0]}: pyKLIP shifted these frames in a way not known here")
    return source


def _read(path: str, dataset: Any) -> tuple[fits.Header, Any, Any, Any, Any]:
    """Header, pixels, errors or None, usable pixels, and star centres of one file."""
    with open_fits(path) as hdus:
        primary, science = hdus[0].header, hdus["SCI"].header
        data = _cube(hdus["SCI"].data)
        error = _cube(hdus["ERR"].data) if "ERR" in hdus else None
        flags = hdus["DQ"].data if "DQ" in hdus else np.uint32(0)
        header = merged_header(primary, science, path)
    flags = np.broadcast_to(flags, data.shape)
    data[(flags & NON_SCIENCE) != 0] = np.nan
    # As pyKLIP finds the centre: the given keywords, else CRPIX, plus the dither if requested.
    keywords = (dataset.center_kw_x, "CRPIX1"), (dataset.center_kw_y, "CRPIX2")
    center = np.array([science.get(key, science.get(other)) - 1 for key, other in keywords], float)
    if dataset.center_include_offset:
        offset = np.array([primary["XOFFSET"], primary["YOFFSET"]])
        center += offset / np.sqrt(science["PIXAR_A2"])
    return header, data, error, (flags & BAD_PIXEL_BITS) == 0, np.tile(center, (len(data), 1))


def _cube(pixels: NDArray[Any]) -> NDArray[np.float32]:
    pixels = np.array(pixels, dtype=np.float32)
    return pixels[np.newaxis] if pixels.ndim == 2 else pixels
