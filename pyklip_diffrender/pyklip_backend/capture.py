"""What pyKLIP's reader of JWST files throws away: the pixels before resampling, ERR, DQ, headers.

`JWSTData.readdata` keeps the base name of each file, and frames shifted to the centre of the
array by a cubic spline. A wavefront fit wants the pixels that the detector recorded, with their
errors. While the backend is registered, reading goes on as ever, and `SourceFrames` is attached
to the dataset as well.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from astropy import units as u
from astropy.io import fits
from numpy.typing import NDArray

from pyklip_diffrender.scene.observation import BAD_PIXEL_BITS

__all__ = [
    "SourceFrames",
    "capture",
    "capturing_readdata",
    "source_frames_of",
]

logger = logging.getLogger(__name__)

ATTRIBUTE = "_diffrender_source"

NON_SCIENCE = 512
"""Bit of the JWST data-quality flags: the one that pyKLIP heeds, it makes such pixels NaN."""


@dataclass(frozen=True, eq=False)
class SourceFrames:
    """The frames of a JWST dataset as its files hold them, N in the order of the dataset.

    Attributes
    ----------
    paths : tuple of Path
        Absolute paths of the files.
    headers : tuple of Header
        One for each frame: the primary header, with what SCI adds to it.
    data : ndarray
        (N, ny, nx) pixels, not resampled; NaN where the flags say NON_SCIENCE.
    error : ndarray or None
        (N, ny, nx) standard deviations from ERR, in the unit of `data`.
    usable : ndarray
        (N, ny, nx) bool, False where a flag says that the pixel must not be fitted.
    centers : ndarray
        (N, 2) star centres [x, y], 0-indexed, in `data`.
    pixelscale : float
        Arcsec per pixel.
    unit : Unit
        Unit of `data`.
    as_read : ndarray
        (N, ny, nx) copy of ``dataset.input`` when it was read: `data` shifted by pyKLIP.
    as_read_centers : ndarray
        (N, 2) copy of ``dataset.centers`` when it was read.
    filenames : tuple of str
        ``dataset.filenames`` when it was read.
    """

    paths: tuple[Path, ...]
    headers: tuple[fits.Header, ...]
    data: NDArray[np.float32]
    error: NDArray[np.float32] | None
    usable: NDArray[np.bool_]
    centers: NDArray[np.float64]
    pixelscale: float
    unit: u.UnitBase
    as_read: NDArray[np.floating[Any]]
    as_read_centers: NDArray[np.float64]
    filenames: tuple[str, ...]

    def __deepcopy__(self, memo: dict[int, Any]) -> SourceFrames:
        """Itself: it never changes, so that copies of a dataset share it."""
        return self

    def belongs_to(self, dataset: Any) -> bool:
        """Whether the dataset still has the frames, shape and centres it was read with."""
        return (
            np.shape(dataset.input) == self.as_read.shape
            and tuple(dataset.filenames) == self.filenames
            and np.array_equal(dataset.centers, self.as_read_centers)
        )


def source_frames_of(dataset: Any) -> SourceFrames | None:
    """Get what was captured when the dataset was read, None if nothing was."""
    found = getattr(dataset, ATTRIBUTE, None)
    return found if isinstance(found, SourceFrames) else None


def capturing_readdata(readdata: Callable[..., None]) -> Callable[..., None]:
    """Wrap `JWSTData.readdata` so that it also leaves a `SourceFrames` on the dataset."""

    def readdata_and_capture(self: Any, filepaths: Any) -> None:
        readdata(self, filepaths)
        try:
            source = capture(self, filepaths)
        except (KeyError, ValueError, OSError) as error:
            # The dataset itself was read; only the extra knowledge is missing.
            logger.warning(
                "the files were read, but not their errors and original pixels: %s", error
            )
        else:
            setattr(self, ATTRIBUTE, source)

    readdata_and_capture.__name__ = readdata.__name__
    readdata_and_capture.__doc__ = readdata.__doc__
    return readdata_and_capture


def capture(dataset: Any, filepaths: str | Iterable[str]) -> SourceFrames:
    """Read the pixels, errors, flags and headers behind a `JWSTData` that was just filled.

    Raises
    ------
    ValueError
        If what is read does not give ``dataset.input`` when it is shifted as pyKLIP does.
    """
    from pyklip.klip import align_and_scale

    paths = [filepaths] if isinstance(filepaths, str) else list(filepaths)
    parts = [_read(path, dataset) for path in paths]
    data = np.concatenate([p.data for p in parts])
    errors = [p.error for p in parts if p.error is not None]
    centers = np.concatenate([p.centers for p in parts])
    as_read = np.array(dataset.input)
    shifted = align_and_scale(data[0], new_center=dataset.centers[0], old_center=centers[0]).astype(
        as_read.dtype
    )
    if data.shape != as_read.shape or not np.array_equal(shifted, as_read[0], equal_nan=True):
        raise ValueError(f"{paths[0]}: pyKLIP shifted these frames in a way not known here")
    return SourceFrames(
        paths=tuple(Path(os.path.abspath(path)) for path in paths),
        headers=tuple(header for p in parts for header in p.headers),
        data=data,
        error=np.concatenate(errors) if len(errors) == len(parts) else None,
        usable=np.concatenate([p.usable for p in parts]),
        centers=centers,
        pixelscale=parts[0].pixelscale,
        unit=parts[0].unit,
        as_read=as_read,
        as_read_centers=np.array(dataset.centers),
        filenames=tuple(dataset.filenames),
    )


@dataclass(frozen=True)
class _File:
    """The frames of one file; attributes as in `SourceFrames`."""

    data: NDArray[np.float32]
    error: NDArray[np.float32] | None
    usable: NDArray[np.bool_]
    centers: NDArray[np.float64]
    headers: list[fits.Header]
    pixelscale: float
    unit: u.UnitBase


def _read(path: str, dataset: Any) -> _File:
    with fits.open(path, memmap=False) as hdus:
        primary, science = hdus[0].header, hdus["SCI"].header
        data = _cube(hdus["SCI"].data)
        error = _cube(hdus["ERR"].data) if "ERR" in hdus else None
        flags = hdus["DQ"].data if "DQ" in hdus else np.zeros(data.shape, np.uint32)
    flags = np.broadcast_to(flags, data.shape)
    data[(flags & NON_SCIENCE) != 0] = np.nan
    pixelscale = float(np.sqrt(science["PIXAR_A2"]))
    # As pyKLIP finds the centre: the named keywords, else CRPIX, plus the dither if asked.
    center = np.array(
        [
            science.get(dataset.center_kw_x, science.get("CRPIX1")) - 1,
            science.get(dataset.center_kw_y, science.get("CRPIX2")) - 1,
        ],
        dtype=np.float64,
    )
    if dataset.center_include_offset:
        center += np.array([primary["XOFFSET"], primary["YOFFSET"]]) / pixelscale
    header = primary.copy()
    header.extend(science, strip=True, unique=True)
    return _File(
        data=data,
        error=error,
        usable=(flags & BAD_PIXEL_BITS) == 0,
        centers=np.tile(center, (len(data), 1)),
        headers=[header] * len(data),
        pixelscale=pixelscale,
        unit=_unit(science.get("BUNIT")),
    )


def _cube(pixels: NDArray[Any]) -> NDArray[np.float32]:
    pixels = np.array(pixels, dtype=np.float32)
    return pixels[np.newaxis] if pixels.ndim == 2 else pixels


def _unit(bunit: str | None) -> u.UnitBase:
    return u.dimensionless_unscaled if bunit is None else u.Unit(bunit, parse_strict="silent")
