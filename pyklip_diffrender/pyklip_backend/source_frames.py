"""The recorded pixels, errors, flags and headers of a JWST dataset, which pyKLIP does not keep.

`JWSTData.readdata` keeps the base name of each file and frames that a cubic spline has shifted to
the centre of the array. A wavefront fit needs the pixels as the detector recorded them, with their
errors. While the backend is registered, reading a dataset also attaches a `SourceFrames` to it, and
reading its library of reference stars attaches the paths of their files. Frames of one place and
orientation are a `Pointing`.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from pyklip_diffrender.io.files import open_fits, read_image
from pyklip_diffrender.io.headers import fits_text, header_number, merged_header
from pyklip_diffrender.io.units import native_float64
from pyklip_diffrender.scene.aligned_frames import SHIFTS
from pyklip_diffrender.scene.exposure import beginning, middle
from pyklip_diffrender.scene.frame_file import FrameFile
from pyklip_diffrender.scene.integrations import pointings
from pyklip_diffrender.scene.jwst_files import single_precision, unflagged
from pyklip_diffrender.scene.observation import Observation, frames_in

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

    # One for each frame.
    details: list[FrameDetails]
    # (N, ny, nx), before resampling; NaN where the flags say NON_SCIENCE.
    data: NDArray[np.floating[Any]]
    # (N, ny, nx), standard deviations from ERR in the unit of `data`.
    error: NDArray[np.floating[Any]]
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
    files: dict[Path, FrameFile]

    def __deepcopy__(self, memo: dict[int, Any]) -> SourceFrames:
        """Itself: it never changes, so copies of a dataset can share it."""
        return self

    @property
    def pixelscale(self) -> float:
        """Arcsec per pixel."""
        return float(np.sqrt(self.details[0].header["PIXAR_A2"]))

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

    @functools.wraps(readdata)
    def readdata_and_source(self: Any, filepaths: Any) -> None:
        readdata(self, filepaths)
        try:
            setattr(self, ATTRIBUTE, read_source(self, filepaths))
        except (KeyError, ValueError, OSError) as error:
            # The dataset itself is complete without the source frames.
            setattr(self, REASON, str(error))

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
    files = [_File.read(Path(path).absolute(), dataset) for path in paths]
    first = files[0]
    middle = (np.array(first.as_read.shape[::-1]) - 1) / 2.0
    shifted = align_and_scale(first.as_read, new_center=middle, old_center=first.center)

    source = SourceFrames(
        details=[each.details for each in files for _ in each.centers],
        data=_joined([each.frames.data for each in files]),
        error=_joined([each.frames.error for each in files]),
        usable=_joined([each.frames.valid for each in files]),
        centers=np.concatenate([each.centers for each in files]),
        aligned=np.array(dataset.input),
        aligned_centers=np.array(dataset.centers),
        filenames=tuple(str(name) for name in dataset.filenames),
        files={each.file.path: each.file for each in files},
    )
    same_shape = source.data.shape == source.aligned.shape
    if not same_shape or not _is_close(shifted, source.aligned[0]):
        raise ValueError(f"{paths[0]}: pyKLIP shifted these frames in a way not known here")
    return source


def _joined(stacks: Sequence[NDArray[Any]]) -> NDArray[Any]:
    """Frames of all files, (N, ny, nx), without a copy if there is a single file."""
    return stacks[0] if len(stacks) == 1 else np.concatenate(stacks)


def _is_close(one: NDArray[Any], other: NDArray[Any]) -> bool:
    """Whether two frames differ by no more than rounding."""
    scale = np.max(np.abs(other), where=np.isfinite(other), initial=0.0)
    return np.allclose(one, other, rtol=0.0, atol=_SHIFT_ROUNDING * scale, equal_nan=True)


class FrameDetails(NamedTuple):
    """Details of one frame, from its file, that an `Observation` of several does not hold."""

    path: Path
    header: fits.Header  # primary and SCI header merged
    first_pixel: tuple[int, int] | None  # detector column and row, where known
    star_offset: tuple[float, float] | None  # x, y from the occulter, arcsec, as the file says


class _File(NamedTuple):
    """The frames of one file; see `SourceFrames`."""

    file: FrameFile
    details: FrameDetails
    frames: Observation  # all integrations, as in `SourceFrames`
    centers: NDArray[np.float64]
    as_read: NDArray[np.floating[Any]]  # (ny, nx), the first one as pyKLIP reads it
    center: NDArray[np.float64]  # (2,), and its star

    @classmethod
    def read(cls, path: Path, dataset: Any) -> _File:
        """Read a file, plane by plane, as `reduce` does; KeyError without a SCI extension."""
        with open_fits(path, images=False) as hdus:
            file = FrameFile.in_hdus(hdus, path)
            primary, science = hdus[0].header, hdus["SCI"].header
            frames = Observation(**frames_in(hdus, path, every_integration=True, compact=True))
            single = science["BITPIX"] == -32
            as_read = read_image(hdus["SCI"], path, single_precision if single else native_float64)
            as_read = as_read[np.newaxis] if as_read.ndim == 2 else as_read
            if "DQ" in hdus:
                good = read_image(
                    hdus["DQ"], path, lambda flags: unflagged(flags, path.name, NON_SCIENCE)
                )
                as_read[~np.broadcast_to(good, as_read.shape)] = np.nan
        file = replace(file, frames=frames.means())
        aligned = any(name in hdus for name in SHIFTS)
        # The gaps of frames that are put back are where they were before the shift.
        frames.data[~(frames.valid if aligned else np.isfinite(as_read))] = np.nan
        frames.error[~frames.valid] = 0.0
        header = merged_header(primary, science, path.name)
        # As pyKLIP finds the centre: the given keywords, else CRPIX, plus the dither if requested.
        keywords = (dataset.center_kw_x, "CRPIX1"), (dataset.center_kw_y, "CRPIX2")
        center = np.array([science.get(key, science.get(crpix)) - 1 for key, crpix in keywords])
        if dataset.center_include_offset:
            offset = np.array([primary["XOFFSET"], primary["YOFFSET"]])
            center = center + offset / np.sqrt(science["PIXAR_A2"])
        centers = np.tile(center.astype(float), (len(as_read), 1))
        if aligned:
            # Frames are back on the pixels of the detector, so that flat-field errors are, too.
            stated = [
                header_number(header, key if key in header else crpix, file.name)
                for key, crpix in (("STARCENX", "CRPIX1"), ("STARCENY", "CRPIX2"))
            ]
            centers += frames.center - (np.array(stated, dtype=float) - 1)
        details = FrameDetails(path, header, frames.first_pixel, frames.star_offset)
        return cls(file, details, frames, centers, as_read[0].copy(), center)


def keeping_references(readpsflib: Callable[..., None]) -> Callable[..., None]:
    """Wrap `JWSTData.readpsflib` so that the dataset also knows the paths of the files."""

    @functools.wraps(readpsflib)
    def readpsflib_and_paths(self: Any, psflib_filepaths: Any, *args: Any, **kw: Any) -> None:
        readpsflib(self, psflib_filepaths, *args, **kw)
        several = [psflib_filepaths] if isinstance(psflib_filepaths, str) else psflib_filepaths
        setattr(self, REFERENCES, tuple(str(Path(path).resolve()) for path in several))

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


def recorded_frames(
    source: SourceFrames, places: NDArray[np.intp] | None, dataset: Any, imgs: NDArray[Any]
) -> tuple[NDArray[np.float64], NDArray[np.bool_], NDArray[np.float64], NDArray[np.float64]]:
    """Recorded pixels plus what was added to `imgs` (n, ny, nx) since reading.

    Returns data, mask of valid pixels and errors, (n, ny, nx), and x, y of the star, (n, 2).
    Frame by frame, so that the changes of all frames are not in memory at once. `places` (n,) say
    where the frames are in `source`. Raises NotRecordedError if no recorded pixels correspond to
    the dataset's.
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
    # pyKLIP's frames are now = S recorded + added, where S shifts the star to the middle of the
    # array. So added = now - S recorded, and the fit takes recorded + S^-1 added, where S^-1 shifts
    # it back: only what was added has been interpolated, and not the noise.
    data = native_float64(source.data[places])
    error = native_float64(source.error[places])
    valid = source.usable[places] & np.isfinite(data)
    moved = native_float64(dataset.centers) - source.aligned_centers[places]
    for i, frame in enumerate(places):
        now, before = native_float64(imgs[i]), native_float64(source.aligned[frame])
        # Pixels that were NaN when they were read belong to flagged ones, whatever was filled in.
        change = np.where(np.isfinite(before), now - before, 0.0)
        _require_same(change, error[i], source.usable[frame])
        shift = {"new_center": source.centers[frame], "old_center": source.aligned_centers[frame]}
        masked = np.isnan(now) & np.isfinite(before)
        added = np.where(np.isfinite(change), change, 0.0)
        peak = np.max(np.abs(before), where=np.isfinite(before), initial=0.0)
        if np.abs(added).max() > _SINGLE_PRECISION_ERROR * peak:
            # Nothing is known beyond the edge of the shifted frame; assume nothing was added.
            data[i] += np.nan_to_num(align_and_scale(added, **shift))
        if masked.any():
            # A pixel masked by hand invalidates every recorded pixel that contributed to it.
            valid[i] &= np.nan_to_num(align_and_scale(masked.astype(float), **shift)) < 0.1
    return data, valid, error, source.centers[places] + moved


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
        files.setdefault(each.path.name, []).append(k)
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
