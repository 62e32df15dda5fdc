"""The recorded pixels, errors, flags and headers of a JWST dataset, which pyKLIP does not keep.

`JWSTData.readdata` keeps the base name of each file and frames that a cubic spline has shifted to
the centre of the array. A wavefront fit needs the pixels as the detector recorded them, with their
errors. While the backend is registered, reading a dataset also attaches a `SourceFrames` to it, and
reading its library of reference stars attaches the paths of their files. Frames of one place and
orientation are a `Pointing`.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from pyklip_diffrender.errors import CorruptFileError, DiffrenderError, NoValidPixelsError
from pyklip_diffrender.io.files import open_fits, read_image
from pyklip_diffrender.io.headers import fits_text, header_number, merged_header
from pyklip_diffrender.io.units import native_float64
from pyklip_diffrender.scene.aligned_frames import SHIFTS
from pyklip_diffrender.scene.exposure import beginning, middle
from pyklip_diffrender.scene.frame_file import FrameFile
from pyklip_diffrender.scene.integrations import pointings
from pyklip_diffrender.scene.jwst_files import BAD_PIXEL_BITS, single_precision, unflagged
from pyklip_diffrender.scene.observation import Observation, frames_in
from pyklip_diffrender.scene.sequence import ExposureSequence

_log = logging.getLogger(__name__)

ATTRIBUTE = "_diffrender_source"
"""Attribute of the dataset that holds its `SourceFrames`."""

REASON = "_diffrender_no_source"
"""Attribute of the dataset that says why it has no `SourceFrames`."""

REFERENCES = "_diffrender_references"
"""Attribute of the dataset with the paths of the files in its library of reference stars."""

NON_SCIENCE = 512
"""The one bit of the JWST data-quality flags that pyKLIP uses: it sets such pixels to NaN."""

_SHIFT_ROUNDING = 1e-4
"""Difference, relative to the brightest pixel, between two shifts of the same frame, one of them
in single precision."""


@dataclass(frozen=True, eq=False)
class SourceFrames:
    """The N frames of a JWST dataset before pyKLIP shifted them, in the order of the dataset.

    Frames that spaceKLIP has aligned are back on the pixels of the detector.
    """

    # One of each per frame: primary and SCI header merged.
    headers: list[fits.Header]
    # (N, ny, nx), before resampling; NaN where the flags say NON_SCIENCE.
    data: NDArray[np.floating[Any]]
    # (N, ny, nx), standard deviations from ERR in the unit of `data`.
    error: NDArray[np.floating[Any]] | None
    # (N, ny, nx), False where a flag excludes the pixel from the fit.
    usable: NDArray[np.bool_]
    # (N, 2), x, y of the star in `data`, 0-indexed.
    centers: NDArray[np.float64]
    # (N, ny, nx), copy of ``dataset.input`` after reading: `data` shifted by pyKLIP.
    aligned: NDArray[np.floating[Any]]
    # (N, 2), copy of ``dataset.centers`` after reading.
    aligned_centers: NDArray[np.float64]
    # ``dataset.filenames`` after reading.
    filenames: tuple[str, ...]
    # Detector column and row of the first pixel of every frame, where known.
    first_pixels: list[tuple[int, int] | None]
    # x, y of the star from the occulter as the file says, arcsec, where it does.
    star_offsets: list[tuple[float, float] | None]
    # The file of every frame.
    paths: list[Path]
    files: dict[Path, FrameFile]
    # What the files were sorted into, if they were judged before pyKLIP read them.
    sequence: ExposureSequence | None = None

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


def why_without_source(dataset: Any) -> str | None:
    """Return why errors and original pixels of a dataset's files are not known.

    None for a dataset that has them, or was not read from files.
    """
    # Attributes of a `JWSTData`, which has read files.
    reads_files = hasattr(dataset, "center_include_offset") and hasattr(dataset, "center_kw_x")
    if hasattr(dataset, ATTRIBUTE) or not reads_files:
        return None
    made_before = "the dataset was made before register() or the backend block. Make it after that"
    return str(getattr(dataset, REASON, made_before))


def read_source(dataset: Any, filepaths: str | Iterable[str]) -> SourceFrames:
    """Read the pixels, errors, flags and headers of the files of a `JWSTData`.

    Raises ValueError if the first frame, shifted as by pyKLIP, is not in ``dataset.input``.
    """
    from pyklip.klip import align_and_scale

    paths = [filepaths] if isinstance(filepaths, str) else list(filepaths)
    files: list[_File] = []
    first = np.empty(0)
    for path in paths:
        file, as_read, center = _read(path, dataset)
        if not files:
            middle = (np.array(as_read.shape[:0:-1]) - 1) / 2.0
            first = align_and_scale(as_read[0], new_center=middle, old_center=center)
        files.append(file)
    counts = [len(file.data) for file in files]
    judged = _JUDGED_FILES.get()
    source = SourceFrames(
        headers=[file.header for file, n in zip(files, counts, strict=True) for _ in range(n)],
        data=_joined([file.data for file in files]),
        error=None
        if any(file.error is None for file in files)
        else _joined([file.error for file in files if file.error is not None]),
        usable=_joined([file.usable for file in files]),
        centers=np.concatenate([file.centers for file in files]),
        aligned=np.array(dataset.input),
        aligned_centers=np.array(dataset.centers),
        filenames=tuple(str(name) for name in dataset.filenames),
        first_pixels=[f.first_pixel for f, n in zip(files, counts, strict=True) for _ in range(n)],
        star_offsets=[f.star_offset for f, n in zip(files, counts, strict=True) for _ in range(n)],
        paths=[f.file.path for f, n in zip(files, counts, strict=True) for _ in range(n)],
        files={each.file.path: each.file for each in files},
        sequence=None if judged is None else judged.sequence,
    )
    same_shape = source.data.shape == source.aligned.shape
    if not same_shape or not _is_close(first, source.aligned[0]):
        raise ValueError(f"{paths[0]}: pyKLIP shifted these frames in a way not known here")
    return source


def _joined(stacks: Sequence[NDArray[Any]]) -> NDArray[Any]:
    """Frames of all files, (N, ny, nx), without a copy if there is a single file."""
    return stacks[0] if len(stacks) == 1 else np.concatenate(stacks)


def _is_close(one: NDArray[Any], other: NDArray[Any]) -> bool:
    """Whether two frames differ by no more than rounding."""
    scale = np.max(np.abs(other), where=np.isfinite(other), initial=0.0)
    return np.allclose(one, other, rtol=0.0, atol=_SHIFT_ROUNDING * scale, equal_nan=True)


class _File(NamedTuple):
    """The frames of one file; see `SourceFrames`."""

    file: FrameFile
    header: fits.Header
    data: NDArray[np.floating[Any]]
    error: NDArray[np.floating[Any]] | None
    usable: NDArray[np.bool_]
    centers: NDArray[np.float64]
    first_pixel: tuple[int, int] | None
    star_offset: tuple[float, float] | None


class OpenedFile(NamedTuple):
    """Contents of a file, for `reduce` and as pyKLIP reads it.

    Attributes
    ----------
    file : FrameFile
    primary, science : Header
    as_read : ndarray, (N, ny, nx)
        The pixels as pyKLIP reads them.
    usable : ndarray of bool, (N, ny, nx)
        Where no flag excludes them from the fit.
    frames : Observation or DiffrenderError or None
        All integrations, with the pixels and errors of `SourceFrames`, or why they cannot be read;
        None for a file without frames.
    aligned : bool
        Whether the file has shifts, which were undone in `frames`.
    """

    file: FrameFile
    primary: fits.Header
    science: fits.Header
    as_read: NDArray[np.floating[Any]]
    usable: NDArray[np.bool_]
    frames: Observation | DiffrenderError | None
    aligned: bool

    @classmethod
    def at(cls, path: str | os.PathLike[str]) -> OpenedFile:
        """Open a file, once, and read it plane by plane; KeyError without a SCI extension."""
        where = Path(path).absolute()
        with open_fits(where, images=False) as hdus:
            file = FrameFile.in_hdus(hdus, where)
            science = hdus["SCI"]
            if not science.is_image:
                raise CorruptFileError(f"{where.name}: SCI is a table, not an image")
            aligned = any(name in hdus for name in SHIFTS)
            frames = None
            if not file.is_product:
                frames, means = _every_integration(hdus, where)
                file = replace(file, frames=means)
            single = science.header["BITPIX"] == -32
            as_read = read_image(science, where, single_precision if single else native_float64)
            as_read = as_read[np.newaxis] if as_read.ndim == 2 else as_read
            as_read[~_without_flags(hdus, where, NON_SCIENCE, as_read.shape)] = np.nan
            if isinstance(frames, Observation):
                usable = frames.valid
                # The gaps of frames that are put back are where they were before the shift.
                frames.data[~(usable if aligned else np.isfinite(as_read))] = np.nan
                frames.error[~usable] = 0.0
            else:
                usable = _without_flags(hdus, where, BAD_PIXEL_BITS, as_read.shape)
            return cls(file, hdus[0].header, science.header, as_read, usable, frames, aligned)


def _every_integration(
    hdus: fits.HDUList, path: Path
) -> tuple[Observation | DiffrenderError, Observation | DiffrenderError]:
    """All integrations of an open file, and their means; or why there are none."""
    try:
        frames = Observation(**frames_in(hdus, path, every_integration=True, compact=True))
        return frames, frames.means()
    except DiffrenderError as error:
        return error, error


def _without_flags(
    hdus: fits.HDUList, path: Path, bits: int, shape: tuple[int, ...]
) -> NDArray[np.bool_]:
    """Pixels of an open file without one of these flags, (N, ny, nx)."""
    if "DQ" not in hdus:
        return np.ones(shape, dtype=bool)
    good = read_image(hdus["DQ"], path, lambda flags: unflagged(flags, path.name, bits))
    return np.broadcast_to(good, shape)


class JudgedFiles(NamedTuple):
    """Files that were opened and judged before pyKLIP reads them, by path."""

    files: Mapping[Path, OpenedFile]
    sequence: ExposureSequence


_JUDGED_FILES: ContextVar[JudgedFiles | None] = ContextVar("judged", default=None)


@contextmanager
def judged_before(files: JudgedFiles) -> Iterator[None]:
    """Take files that were opened already for datasets that are read inside."""
    token = _JUDGED_FILES.set(files)
    try:
        yield
    finally:
        _JUDGED_FILES.reset(token)


def _read(path: str, dataset: Any) -> tuple[_File, NDArray[np.floating[Any]], NDArray[np.float64]]:
    """Read one file as `reduce` does, and its pixels, (N, ny, nx), and star, (2,), as pyKLIP."""
    judged = _JUDGED_FILES.get()
    known = None if judged is None else judged.files.get(Path(path).absolute())
    file, primary, science, as_read, usable, frames, aligned = known or OpenedFile.at(path)
    header = merged_header(primary, science, path)
    # As pyKLIP finds the centre: the given keywords, else CRPIX, plus the dither if requested.
    keywords = (dataset.center_kw_x, "CRPIX1"), (dataset.center_kw_y, "CRPIX2")
    center = np.array([science.get(key, science.get(other)) - 1 for key, other in keywords], float)
    if dataset.center_include_offset:
        offset = np.array([primary["XOFFSET"], primary["YOFFSET"]])
        center += offset / np.sqrt(science["PIXAR_A2"])
    centers = np.tile(center, (len(as_read), 1))
    if isinstance(frames, CorruptFileError | NoValidPixelsError):
        # Such as a file without errors, or a frame whose pixels are all flagged.
        _log.warning("only the pixels and flags are used: %s", frames)
        return _File(file, header, as_read, None, usable, centers, None, None), as_read, center
    if not isinstance(frames, Observation):
        raise frames or CorruptFileError(f"{path}: no frames")
    if aligned:
        # Frames are back on the pixels of the detector, so that flat-field errors are, too.
        stated = [
            header_number(header, key if key in header else other, file.name)
            for key, other in (("STARCENX", "CRPIX1"), ("STARCENY", "CRPIX2"))
        ]
        centers += frames.center - (np.array(stated, dtype=float) - 1)
    read = _File(
        file,
        header,
        frames.data,
        frames.error,
        usable,
        centers,
        frames.first_pixel,
        frames.star_offset,
    )
    return read, as_read, center


def keeping_references(readpsflib: Callable[..., None]) -> Callable[..., None]:
    """Wrap `JWSTData.readpsflib` so that the dataset also knows the paths of the files."""

    def readpsflib_and_paths(self: Any, psflib_filepaths: Any, *args: Any, **kw: Any) -> None:
        readpsflib(self, psflib_filepaths, *args, **kw)
        several = [psflib_filepaths] if isinstance(psflib_filepaths, str) else psflib_filepaths
        setattr(self, REFERENCES, tuple(str(Path(path).resolve()) for path in several))

    readpsflib_and_paths.__name__ = readpsflib.__name__
    readpsflib_and_paths.__doc__ = readpsflib.__doc__
    return readpsflib_and_paths


# The pixels that the files of a `JWSTData` recorded, with what was added to the dataset since.
#
# The frames in ``dataset.input`` of a `JWSTData` were shifted to the centre of the array when they
# were read, which correlates their noise and makes sharp speckles ring. Where the recorded frames
# are known, the fit gets those, plus whatever was added to ``dataset.input`` since (an injected
# companion, for example). Only the subtracted frames are then shifted.

_SINGLE_PRECISION_ERROR = 1e-5
"""Relative difference of pixels that single precision explains."""


class NotRecordedError(Exception):
    """Raised where the recorded pixels are not the dataset's; the message gives the reason."""


class Recorded(NamedTuple):
    """Recorded pixels with what was added to the dataset since, (n, ny, nx), and their star."""

    data: NDArray[np.float64]
    valid: NDArray[np.bool_]
    error: NDArray[np.float64] | None
    centers: NDArray[np.float64]  # (n, 2), x, y
    factor: NDArray[np.float64]  # (n,), of the dataset's frames over the recorded ones


def recorded_frames(
    source: SourceFrames,
    places: NDArray[np.intp] | None,
    dataset: Any,
    index: NDArray[np.intp],
    imgs: NDArray[Any],
) -> Recorded:
    """Recorded pixels plus what was added to `imgs` (n, ny, nx) since reading, in the files' unit.

    Frame by frame, so that the changes of all frames are not in memory at once. `index` and
    `places` (n,) say where the frames are in the dataset and, of all its frames, in `source`.
    Raises NotRecordedError if no recorded pixels correspond to the dataset's.
    """
    from pyklip.klip import align_and_scale

    if places is None:
        raise NotRecordedError("its frames are not those that were read, by their names")
    if imgs.shape[1:] != source.aligned.shape[1:]:
        ny, nx = source.aligned.shape[1:]
        raise NotRecordedError(
            f"its frames have {imgs.shape[2]} x {imgs.shape[1]} pixels, and had {nx} x {ny} when "
            "they were read"
        )
    # pyKLIP's frames are now = factor * (S recorded + added), where S shifts the star to the middle
    # of the array. So added = now / factor - S recorded, and the fit takes recorded + S^-1 added,
    # where S^-1 shifts it back: only what was added has been interpolated, and not the noise.
    rows = places[index]
    data = native_float64(source.data[rows])
    error = None if source.error is None else native_float64(source.error[rows])
    valid = source.usable[rows] & np.isfinite(data)
    centers, factors = native_float64(dataset.centers)[index], np.ones(len(rows))
    moved = centers - source.aligned_centers[rows]
    for i, frame in enumerate(rows):
        now, before = native_float64(imgs[i]), native_float64(source.aligned[frame])
        factors[i] = _factor(now, before)
        # Pixels that were NaN when they were read belong to flagged ones, whatever was filled in.
        change = np.where(np.isfinite(before), now / factors[i] - before, 0.0)
        if error is not None:
            _require_same(change, error[i], source.usable[frame])
        shift = {"new_center": source.centers[frame], "old_center": source.aligned_centers[frame]}
        masked = np.isnan(now) & np.isfinite(before)
        added = np.where(np.isfinite(change), change, 0.0)
        # A changed factor is known to the rounding of single precision.
        peak = np.max(np.abs(before), where=np.isfinite(before), initial=0.0)
        if np.abs(added).max() > _SINGLE_PRECISION_ERROR * peak:
            # Nothing is known beyond the edge of the shifted frame; assume nothing was added.
            data[i] += np.nan_to_num(align_and_scale(added, **shift))
        if masked.any():
            # A pixel masked by hand invalidates every recorded pixel that contributed to it.
            valid[i] &= np.nan_to_num(align_and_scale(masked.astype(float), **shift)) < 0.1
    return Recorded(data, valid, error, source.centers[rows] + moved, factors)


def _factor(now: NDArray[np.float64], before: NDArray[np.float64]) -> float:
    """Factor by which a frame (ny, nx) was multiplied since it was read; 1 if it was not.

    Raises NotRecordedError if it is not positive.
    """
    known = np.isfinite(before) & np.isfinite(now)
    if not known.any():
        return 1.0
    with np.errstate(invalid="ignore"):
        bright = known & (np.abs(before) > np.percentile(np.abs(before[known]), 90))
    if not bright.any():
        return 1.0
    # A frame that was only multiplied has one ratio in all its brightest pixels, to the rounding of
    # single precision. Where the ratios scatter by more, something else was done to it.
    ratios = now[bright] / before[bright]
    factor = float(np.median(ratios))
    # Sources that were added since change few of the brightest pixels.
    if abs(factor - 1) < _SINGLE_PRECISION_ERROR or np.median(
        np.abs(ratios - factor)
    ) > _SINGLE_PRECISION_ERROR * abs(factor):
        return 1.0
    if factor <= 0:
        raise NotRecordedError(f"its frames were multiplied by {factor:.3g} after reading")
    return factor


def _require_same(
    change: NDArray[np.float64], error: NDArray[np.float64], usable: NDArray[np.bool_]
) -> None:
    """Raise NotRecordedError if most pixels of a frame (ny, nx) changed by more than the noise."""
    # Faint sources change few pixels, and another background changes all by the same amount:
    # neither moves the median distance from the median.
    known, scale = change[np.isfinite(change)], error[usable & (error > 0)]
    if not known.size or not scale.size:
        return
    spread = float(np.median(np.abs(known - np.median(known))))
    if spread > float(np.median(scale)):
        raise NotRecordedError(
            "most of its pixels were changed by more than their noise after reading, for "
            "example by a filter"
        )


# Pointings: frames that show the star at one place and orientation, averaged for the fit.


class FrameDetails(NamedTuple):
    """Details of one frame, from its file, that an `Observation` of several does not hold."""

    file: str
    header: fits.Header
    first_pixel: tuple[int, int] | None = None
    star_offset: tuple[float, float] | None = None


@dataclass(frozen=True, eq=False)
class Pointing:
    """Frames that show the star at one place and orientation."""

    frames: NDArray[np.intp]  # their indices among the fitted frames
    observation: Observation  # these frames, with the header of the first

    def __repr__(self) -> str:
        return f"<Pointing: frames {', '.join(map(str, self.frames))} of {self.observation.name!r}>"


def part_of(observation: Observation, which: Any) -> Observation:
    """Some frames of an observation, chosen by an index array or a mask.

    Frames that follow each other are not copied.
    """
    angles = observation.position_angles
    index = np.flatnonzero(which) if which.dtype == bool else which
    if len(index) and (np.diff(index) == 1).all():
        which = slice(index[0], index[-1] + 1)
    return replace(
        observation,
        data=observation.data[which],
        error=observation.error[which],
        valid=observation.valid[which],
        center=observation.center[which],
        position_angles=None if angles is None else angles[which],
    )


def pointings_of(
    observation: Observation, details: Sequence[FrameDetails] | None = None
) -> list[Pointing]:
    """Sort the frames of an observation by file and by place of the star, in order of time.

    The rule is `Observation.pointings`'s. Without `details`, one for each frame, all frames
    are as if from one file.
    """
    known = observation.position_angles
    if details is None:
        groups = list(pointings(observation.center, known))
        return [Pointing(group, _at_one_place(observation, group)) for group in groups]
    files: dict[str, list[int]] = {}
    for k, each in enumerate(details):
        files.setdefault(each.file, []).append(k)
    made = []
    for file, rows in files.items():
        inside = np.array(rows)
        angles = None if known is None else known[inside]
        groups = [inside[each] for each in pointings(observation.center[inside], angles)]
        for k, group in enumerate(groups, 1):
            first = details[group[0]]
            part = replace(
                _at_one_place(observation, group),
                name=file if len(groups) == 1 else f"{file} (pointing {k})",
                header=first.header,
                date=beginning(first.header, file),
                mid_date=middle(first.header, file),
                first_pixel=first.first_pixel,
                star_offset=first.star_offset,
            )
            made.append(Pointing(group, part))
    return sorted(
        made, key=lambda each: 0.0 if each.observation.date is None else each.observation.date.mjd
    )


def _at_one_place(observation: Observation, group: NDArray[np.intp]) -> Observation:
    """Some frames, with their star at one place: what is averaged has one star."""
    part = part_of(observation, group)
    return replace(part, center=np.tile(part.center.mean(axis=0), (len(group), 1)))
