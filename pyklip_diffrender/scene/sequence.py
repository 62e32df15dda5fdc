"""Sequences: the rolls of a target and the reference stars that go with them."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from astropy import units as u
from astropy.table import QTable
from astropy.time import Time

from pyklip_diffrender.errors import IncompatibleSetupError, NoValidPixelsError
from pyklip_diffrender.scene.admission import (
    EPOCH,
    Admission,
    admitted,
    choose_filter,
    choose_target,
    epochs_of,
    exposures_in,
    of_other_brightness,
    of_other_setups,
    turned,
    unoriented,
    with_odd_pixels,
    with_references,
)
from pyklip_diffrender.scene.exposure import Exposure
from pyklip_diffrender.scene.frame_file import FrameFile
from pyklip_diffrender.scene.observation import Observation, Window

# The table of admission: one row for each file, what it is used for, and what it is.

OF_ANOTHER_EPOCH = "of another epoch than the target, whose wavefront is another one"
"""Remark on a frame of a reference star that takes no part in the fit of the wavefront."""

SHORT = ("use", "star", "date", "position_angle", "integrations", "file")
"""Columns for a screen."""


@dataclass(frozen=True, eq=False)
class Row:
    """A file in the table of a sequence."""

    use: Literal["target", "reference", "excluded"]
    star: str
    exposure: Exposure
    observation: Observation | None = None  # the frames, unless they are excluded
    remark: str = ""  # why the file is excluded, or what of it was left out
    path: Path | None = None
    is_named: bool = False  # given as a reference star's, and not found in a folder

    @property
    def time(self) -> float:
        """Modified Julian date of the beginning; 0 where it is not known."""
        date = self.exposure.date if self.observation is None else self.observation.date
        return 0.0 if date is None else float(date.mjd)

    def values(self) -> dict[str, object]:
        """Columns of the table."""
        exposure, frames = self.exposure, self.observation
        angle = exposure.position_angle
        offset: tuple[float, float] | None = None
        date, count = exposure.date, exposure.integrations
        if frames is not None:
            angle, offset = frames.north, frames.star_offset
            date, count = frames.date, frames.count
        elif any(exposure.offset):
            offset = exposure.offset
        place = exposure.star.coordinates
        return {
            "use": self.use,
            "star": self.star or next(iter(exposure.star.names), ""),
            "date": "" if date is None else date.isot[:16],
            "position_angle": np.nan if angle is None else angle,
            "integrations": count or 0,
            "file": exposure.name,
            "remark": self.remark,
            "level": exposure.level or "",
            "exp_type": exposure.exposure_type or "",
            "exposure": exposure.identity or "",
            "ra": np.nan if place is None else place[0],
            "dec": np.nan if place is None else place[1],
            "mask": exposure.mask or "",
            "filter": exposure.filter or "",
            "detector": exposure.detector or "",
            "stop": exposure.stop or "",
            "subarray": exposure.subarray or "",
            "offset_x": np.nan if offset is None else offset[0],
            "offset_y": np.nan if offset is None else offset[1],
            "unit": exposure.unit or "",
        }


_COLUMN_UNITS = {
    "position_angle": u.deg, "ra": u.deg, "dec": u.deg, "offset_x": u.arcsec, "offset_y": u.arcsec,
}  # fmt: skip


_SAME_WINDOW_PIXELS = 2
"""Pixels by which the stars of two frames may be apart for one window on the detector."""


@dataclass(frozen=True)
class ExposureSequence:
    """Observations of one target through one filter, with its reference stars.

    Attributes
    ----------
    target : str
        Name of the target.
    science : tuple of Observation
        Frames of the target, one observation for each roll or pointing, in order of time.
    references : tuple of Observation
        Frames of other stars through the same coronagraph, in order of time, of `same_epoch` and
        `other_epochs`.
    excluded : tuple of (str, str)
        Names of the files that were left out, and why.
    rows : tuple of Row
        Kind and use of every file, see `table`. Empty for a sequence that was not made from files.

    Examples
    --------
    >>> import numpy as np
    >>> import pyklip_diffrender as dr
    >>> ones = np.ones((8, 8))
    >>> frame = dr.Observation.from_arrays(ones, ones, pixelscale=0.063, filter="F444W")
    >>> dr.ExposureSequence("HD 1", (frame,))
    <ExposureSequence: HD 1 in F444W, 1 of the target, 0 of reference stars>

    From a folder of files, which the package does not contain:

    >>> dr.ExposureSequence.from_files("calints", target="HD 1")  # doctest: +SKIP
    """

    target: str
    science: tuple[Observation, ...]
    references: tuple[Observation, ...] = ()
    excluded: tuple[tuple[str, str], ...] = ()
    rows: tuple[Row, ...] = ()

    def __post_init__(self) -> None:
        if not self.science:
            raise NoValidPixelsError(f"{self.target}: the sequence has no frames of the target")

    def __repr__(self) -> str:
        return (
            f"<ExposureSequence: {self.target} in {self.filter}, {len(self.science)} of the "
            f"target, {len(self.references)} of reference stars>"
        )

    def __len__(self) -> int:
        """Number of frames of the target and of reference stars."""
        return len(self.science) + len(self.references)

    @property
    def filter(self) -> str | None:
        """Filter of the target's frames."""
        return self.science[0].filter

    @classmethod
    def from_files(
        cls,
        files: str | os.PathLike[str] | Iterable[str | os.PathLike[str]],
        *,
        target: str | None = None,
        filter: str | None = None,
        epoch: str | Time | None = None,
        references: Iterable[str | os.PathLike[str]] = (),
        star: tuple[float, float] | None = None,
    ) -> ExposureSequence:
        """Sort JWST coronagraphic files into target and reference stars.

        Every file is judged by its header and its pixels. What is not a frame of a star behind a
        mask, is there twice, was taken with another set-up than most of the target's frames, or
        contradicts the other frames is excluded with the reason.

        Parameters
        ----------
        files : path or sequence of path
            Stage-2 files (calints), spaceKLIP's aligned files, folders of either, patterns such as
            ``frames/*_calints.fits``, or association files of the archive (``*_asn.json``), of
            which members of the types science and psf are used, by paths relative to the file. With
            both, science is the target and psf are references, whatever the headers say. In a
            folder, association files are not read.
        target : str, optional
            Name of the target (TARGPROP or TARGNAME); case, spaces and dashes do not matter.
            Default the star that is not marked as a reference (IS_PSF), if there is just one.
        filter : str, optional
            Filter to use. Default the one of all files, if there is just one.
        epoch : str or Time, optional
            Date in the epoch to use, such as "2022-10-03", if the target was observed in several.
            Frames of one epoch are at most 5 days apart, and share a wavefront.
        references : iterable of path
            Further files, of reference stars even if their headers do not say so, of any epoch and
            programme.
        star : tuple of float, optional
            x, y of the target's star in its files, pixels from 0, in place of what the headers
            say. Whether the files have a star's light there is then not judged. For frames in which
            something else is brighter than the star behind the mask.

        Returns
        -------
        ExposureSequence
            The sequence; its `table` lists all files, what they are used for and why.

        Raises
        ------
        IncompatibleSetupError
            If target, filter or epoch cannot be decided, with the choices; if frames of the target
            contradict each other, and nothing says which are right.
        NoValidPixelsError
            If no frame of the target is left.
        CorruptFileError
            If members of an association are missing.
        """
        sequences = cls.by_epoch(
            files, target=target, filter=filter, references=references, star=star
        )
        return cls._only(sequences, epoch)

    @classmethod
    def of_opened(
        cls,
        files: list[FrameFile],
        references: list[FrameFile],
        *,
        target: str | None = None,
        filter: str | None = None,
    ) -> ExposureSequence:
        """Sort files that were opened, see `from_files`."""
        admission = admitted(with_references(files, references))
        return cls._only(cls._by_epoch(admission, target, filter), None)

    @staticmethod
    def _only(
        sequences: tuple[ExposureSequence, ...], epoch: str | Time | None
    ) -> ExposureSequence:
        """The sequence of an epoch, or the only one."""
        if epoch is not None:
            date = Time(epoch)
            near = [
                (abs(each.date.mjd - date.mjd), k)
                for k, each in enumerate(sequences)
                if each.date is not None and abs(each.date.mjd - date.mjd) <= EPOCH + 1
            ]
            if not near:
                raise IncompatibleSetupError(
                    f"epoch: got {date.isot[:10]}, expected one of {_days(sequences)}"
                )
            return sequences[min(near)[1]]
        if len(sequences) > 1:
            raise IncompatibleSetupError(
                f"{sequences[0].target}: the frames are of {len(sequences)} epochs, whose "
                f"wavefronts differ: {_days(sequences)}. Reduce each of them alone: choose one "
                "with epoch=..., or take all with ExposureSequence.by_epoch. The command reduce "
                "does so"
            )
        return sequences[0]

    @classmethod
    def by_epoch(
        cls,
        files: str | os.PathLike[str] | Iterable[str | os.PathLike[str]],
        *,
        target: str | None = None,
        filter: str | None = None,
        references: Iterable[str | os.PathLike[str]] = (),
        star: tuple[float, float] | None = None,
    ) -> tuple[ExposureSequence, ...]:
        """Sort files as `from_files` does, into one sequence for each epoch.

        Frames of the target more than 5 days apart belong to different epochs. Reference stars go
        with all epochs: for the wavefront with epochs within 5 days, else for the detector
        pattern and KLIP.

        Returns
        -------
        tuple of ExposureSequence
            In order of time.
        """
        return cls._by_epoch(_usable(files, references, star, target, filter), target, filter)

    @classmethod
    def by_filter_and_epoch(
        cls,
        files: str | os.PathLike[str] | Iterable[str | os.PathLike[str]],
        *,
        target: str | None = None,
        filter: str | None = None,
        references: Iterable[str | os.PathLike[str]] = (),
        star: tuple[float, float] | None = None,
    ) -> tuple[ExposureSequence, ...]:
        """Sort files into one sequence for each filter and epoch of the target.

        For the arguments see `by_epoch`; with `filter` there is one filter.

        Returns
        -------
        tuple of ExposureSequence
            In order of time.
        """
        # Stars are told apart for every filter alone. Where there are several filters, frames are
        # judged first, so that none is there only by frames that are left out.
        usable = _usable(files, references, star, target, filter)
        if filter is not None:
            return cls._by_epoch(usable, target, filter)
        chosen, names = _filters_of_target(usable.copy(), target)
        if len(names) > 1:
            usable.apply(with_odd_pixels)
            chosen, names = _filters_of_target(usable.copy(), target)
        names -= {None}
        if len(names) < 2:
            return cls._by_epoch(usable, target, next(iter(names), None))
        sequences = [
            each
            for name in sorted(name for name in names if name is not None)
            for each in cls._by_epoch(usable.copy(), target or chosen, name)
        ]
        return tuple(sorted(sequences, key=lambda each: _time(each.science[0])))

    @classmethod
    def _by_epoch(
        cls, admission: Admission, target: str | None, filter: str | None
    ) -> tuple[ExposureSequence, ...]:
        """Sort files, some of which are left out already."""
        choose_filter(admission, filter)
        star, stars = choose_target(admission, target)
        science, *others = stars.pop(star), *stars.values()
        references = [each for group in others for each in group]
        together = [*science, *references]
        # Only frames that can be used vote for the set-up.
        admission.apply(with_odd_pixels, together)
        admission.apply(of_other_setups, science, references)
        admission.apply(turned, together)
        for group in (science, *others):
            admission.apply(of_other_brightness, group)
        admission.apply(unoriented, science)
        kept = admission.left(science)
        if not kept:
            raise NoValidPixelsError(
                f"{star}: no frames of the target can be used: {admission.in_words(science)}"
            )
        names = {each: star for each in science}
        names |= {each: name for name, group in stars.items() for each in group}
        epochs = epochs_of([each.exposure.date for each in kept])
        return tuple(
            cls._of_epoch(star, [kept[k] for k in epoch], admission, names) for epoch in epochs
        )

    @classmethod
    def _of_epoch(
        cls,
        star: str,
        chosen: list[FrameFile],
        admission: Admission,
        stars: Mapping[FrameFile, str],
    ) -> ExposureSequence:
        """Make the sequence of one epoch; `chosen` are the target's frames."""
        dates = [each.exposure.date for each in chosen if each.exposure.date is not None]
        rows, excluded = [], []
        used: dict[str, list[Observation]] = {"target": [], "reference": []}
        exposures: dict[str, str] = {}
        for each in admission.files:
            name, reason = stars.get(each, ""), admission.reasons.get(each, "")
            if not reason and name == star and each not in chosen:
                day = min(dates).isot[:10]
                reason = f"of another epoch than the frames of {day}, which have another wavefront"
            if reason:
                excluded.append((each.name, reason))
                rows.append(Row("excluded", name, each.exposure, None, reason, each.path))
                continue
            use: Literal["target", "reference"] = "target" if each in chosen else "reference"
            observation = each.observation
            for part in () if observation is None else observation.pointings():
                part = replace(part, reference=use == "reference")
                used[use].append(part)
                # Segments are files of one exposure, whose name has no segment number.
                exposures[part.name] = re.sub(r"-seg\d+", "", each.exposure.identity or part.name)
                remarks = list(part.remarks)
                if not _is_near(each.exposure.date, dates):
                    remarks.append(f"{OF_ANOTHER_EPOCH}: for the detector pattern and KLIP only")
                remark = "; ".join(remarks)
                rows.append(
                    Row(use, name, each.exposure, part, remark, each.path, each.for_reference)
                )
        rows.sort(key=lambda row: (("target", "reference", "excluded").index(row.use), row.time))
        return cls(
            star,
            tuple(sorted(_with_segments_joined(used["target"], exposures), key=_time)),
            tuple(sorted(_with_segments_joined(used["reference"], exposures), key=_time)),
            tuple(excluded),
            tuple(rows),
        )

    @property
    def same_epoch(self) -> tuple[Observation, ...]:
        """Frames of reference stars that share a wavefront with the target's, as far as known."""
        return tuple(each for each in self.references if _is_near(each.date, self._dates))

    @property
    def other_epochs(self) -> tuple[Observation, ...]:
        """Frames of reference stars that have another wavefront than the target's frames."""
        return tuple(each for each in self.references if not _is_near(each.date, self._dates))

    @property
    def _dates(self) -> list[Time]:
        """Known dates of the target's frames."""
        return [each.date for each in self.science if each.date is not None]

    @property
    def date(self) -> Time | None:
        """Mean date of the target's frames, None if none of them has one."""
        return Time(self._dates).mean() if self._dates else None

    @property
    def table(self) -> QTable:
        """One row for each file: what it is used for and why, and what it is.

        Positions of the star behind the mask, `offset_x` and `offset_y`, are NaN where the file
        does not state them.
        """
        rows = self.rows or (*_rows("target", self.science), *_rows("reference", self.references))
        values = [row.values() for row in rows]
        table = QTable({name: [each[name] for each in values] for name in values[0]})
        for name, unit in _COLUMN_UNITS.items():
            table[name] = np.asarray(table[name], dtype=float) * unit
        table["position_angle"].info.format = ".2f"
        return table

    def windows(self, shape: tuple[int, int]) -> tuple[tuple[Window, ...], tuple[Window, ...]]:
        """Boxes of `shape` about the star, one for each observation of target and references.

        Frames whose stars are on nearly the same pixel of the detector as in the first one have
        boxes of the same pixels, so that they share its pattern.

        Returns
        -------
        science, references : tuple of Window
        """
        frames = (*self.science, *self.references)
        windows = [Window.about(each.mean_center, shape) for each in frames]
        places = [
            None if each.first_pixel is None else np.add(each.first_pixel, (window.x, window.y))
            for each, window in zip(frames, windows, strict=True)
        ]
        first = places[0]
        for k, place in enumerate(places):
            if first is None or place is None:
                continue
            # Distance on the detector from this window's first pixel to the first window's.
            x, y = first - place
            if max(abs(x), abs(y)) <= _SAME_WINDOW_PIXELS:
                windows[k] = Window(windows[k].y + int(y), windows[k].x + int(x), shape)
        count = len(self.science)
        return tuple(windows[:count]), tuple(windows[count:])

    def cutout(
        self, size: int | tuple[int, int], *, beyond_edges: bool = False
    ) -> ExposureSequence:
        """Cut the pixels about the star out of every frame, see `windows`.

        Parameters
        ----------
        size : int or tuple of int
            Rows and columns; one number for a square.
        beyond_edges : bool
            Allow pixels beyond the edges of the frames, which are masked.

        Raises
        ------
        ShapeError
            If the pixels are not inside a frame, unless they may be beyond its edges.
        NoValidPixelsError
            If a frame has no valid pixel there.
        """
        shape = (size, size) if isinstance(size, int) else size
        science, references = (
            tuple(
                each.within(window, beyond_edges=beyond_edges)
                for each, window in zip(frames, windows, strict=True)
            )
            for frames, windows in zip(
                (self.science, self.references), self.windows(shape), strict=True
            )
        )
        return replace(self, science=science, references=references)


# What is to be reduced, by the headers of files.


@dataclass(frozen=True)
class Epoch:
    """Frames of one target and filter that share a wavefront, before their pixels are judged."""

    target: str
    filter: str
    date: Time | None  # mean of the target's frames


def epochs_of_files(
    files: Iterable[str | os.PathLike[str]],
    *,
    target: str | None = None,
    filter: str | None = None,
) -> tuple[Epoch, ...]:
    """List the epochs that `ExposureSequence.by_epoch` sorts files into, in order of time.

    Pixels are judged only where the headers leave open which file, filter or target is meant, or
    have several epochs. Raises as `ExposureSequence.from_files`.
    """
    admission = _usable(files, ())
    filter = choose_filter(admission, filter)
    star, stars = choose_target(admission, target)
    science = admission.left(stars[star])
    if len(epochs_of([each.exposure.date for each in science])) > 1:
        admission.apply(with_odd_pixels, science)
        science = admission.left(science)
    dates = [each.exposure.date for each in science]
    epochs = []
    for group in epochs_of(dates):
        known = [date for date in (dates[k] for k in group) if date is not None]
        epochs.append(Epoch(star, filter, Time(known).mean() if known else None))
    return tuple(epochs)


def _usable(
    files: str | os.PathLike[str] | Iterable[str | os.PathLike[str]],
    references: Iterable[str | os.PathLike[str]],
    star: tuple[float, float] | None = None,
    target: str | None = None,
    filter: str | None = None,
) -> Admission:
    """Files without the ones that cannot be used.

    With a `filter`, its frames are read at once, unless the place of their star is still to come.
    """
    listed = exposures_in(files, references, filter if star is None else None)
    if star is not None:
        place = _star_place(star)
        marked = all(each.exposure.reference for each in listed if not each.fault)

        def is_target(file: FrameFile) -> bool:
            if target is not None:
                return file.exposure.star.is_called(target)
            return marked or not file.exposure.reference

        listed = [replace(each, place=place) if is_target(each) else each for each in listed]
    return admitted(listed)


def _filters_of_target(admission: Admission, target: str | None) -> tuple[str, set[str | None]]:
    """Name of the target, and the filters of its frames."""
    chosen, stars = choose_target(admission, target)
    return chosen, {each.exposure.filter for each in admission.left(stars[chosen])}


def _with_segments_joined(
    observations: Iterable[Observation], exposures: Mapping[str, str]
) -> list[Observation]:
    """Join the segments of an exposure that show the star at one place and angle.

    `exposures` is the exposure of every observation by name. How an exposure was cut into files
    then makes no difference.
    """
    joined: list[list[Observation]] = []
    for each in observations:
        for group in joined:
            if exposures[group[0].name] == exposures[each.name] and group[0].continues_in(each):
                group.append(each)
                break
        else:
            joined.append([each])
    return [group[0].followed_by(group[1:]) for group in joined]


def _star_place(star: object) -> tuple[float, float]:
    """Check the position of a star, x, y in pixels."""
    try:
        place = np.asarray(star, dtype=float)
    except (TypeError, ValueError):
        place = np.array([])
    if place.shape != (2,) or not np.isfinite(place).all():
        raise IncompatibleSetupError(
            f"star: got {star!r}, expected two finite numbers, x and y of the star in the target's "
            "files in pixels from 0, such as (150, 174)"
        )
    return float(place[0]), float(place[1])


def _rows(
    use: Literal["target", "reference"], observations: Iterable[Observation]
) -> Iterable[Row]:
    for each in observations:
        exposure = Exposure.of(each.header, each.name, each.data.shape)
        yield Row(use, each.target, exposure, each)


def _is_near(date: Time | None, dates: list[Time]) -> bool:
    """Whether a frame was taken in the epoch of these dates, as far as is known."""
    return date is None or not dates or min(abs(date.mjd - each.mjd) for each in dates) <= EPOCH


def by_reason(excluded: Iterable[tuple[str, str]]) -> list[tuple[str, str]]:
    """Names of files that were left out for one reason, in a few words, with the reason."""
    names: dict[str, list[str]] = {}
    for name, reason in excluded:
        names.setdefault(reason, []).append(name)
    return [
        (f"{len(of)} files, {of[0]} to {of[-1]}" if len(of) > 2 else ", ".join(of), reason)
        for reason, of in names.items()
    ]


def _days(sequences: Iterable[ExposureSequence]) -> str:
    """The epochs of sequences with their files, for messages."""
    return "; ".join(
        f"{'no date' if each.date is None else each.date.isot[:10]} "
        f"({', '.join(dict.fromkeys(frame.name for frame in each.science))})"
        for each in sequences
    )


def _time(observation: Observation) -> float:
    return 0.0 if observation.date is None else float(observation.date.mjd)
