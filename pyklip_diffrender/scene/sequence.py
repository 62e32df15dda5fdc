"""Sequences: the rolls of a target and the reference stars that go with them."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from astropy.table import QTable
from astropy.time import Time

from pyklip_diffrender.errors import IncompatibleSetupError, NoValidPixelsError
from pyklip_diffrender.io.html_repr import html_summary
from pyklip_diffrender.scene.admission import (
    EPOCH,
    choose_filter,
    choose_target,
    epochs_of,
    exclude_contradicting,
    exclude_copies,
    exclude_other_setups,
    exclude_unoriented,
    judge_frames,
)
from pyklip_diffrender.scene.admission_table import SHORT, Row, rows_table
from pyklip_diffrender.scene.exposure import Exposure
from pyklip_diffrender.scene.frame_files import (
    FrameFile,
    exclude_unusable,
    exposures_in,
    require_some,
    with_references,
)
from pyklip_diffrender.scene.observation import Observation
from pyklip_diffrender.scene.pixel_checks import why_other_brightness, why_turned
from pyklip_diffrender.scene.window import Window

__all__ = ["Sequence"]

_NEARLY_THE_SAME = 2
"""Pixels by which the stars of two rolls may be apart for one window on the detector."""


@dataclass(frozen=True)
class Sequence:
    """Observations of one target through one filter, with its reference stars.

    Attributes
    ----------
    target : str
        Name of the target.
    science : tuple of Observation
        One for each roll or pointing of the target, in order of time.
    references : tuple of Observation
        Frames of other stars through the same coronagraph, in order of time.
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
    >>> dr.Sequence("HD 1", (frame,))
    <Sequence: HD 1 in F444W, 1 of the target, 0 of reference stars>

    From a folder of files, which the package does not contain:

    >>> dr.Sequence.from_files("calints", target="HD 1")  # doctest: +SKIP
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
            f"<Sequence: {self.target} in {self.filter}, {len(self.science)} of the "
            f"target, {len(self.references)} of reference stars>"
        )

    def _repr_html_(self) -> str:
        facts = {"Filter": self.filter, "Left out": len(self.excluded) or None}
        return html_summary(f"Sequence of {self.target}", facts, self.table, SHORT)

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
    ) -> Sequence:
        """Sort JWST coronagraphic files into target and reference stars.

        Every file is judged by its header and its pixels. What is not a frame of a star behind a
        mask, is there twice, was taken with another set-up than most of the target's frames, or
        contradicts the other frames is excluded with the reason.

        Parameters
        ----------
        files : path or sequence of path
            Stage-2 files (calints), spaceKLIP's aligned files, or a folder with either.
        target : str, optional
            Name of the target (TARGPROP or TARGNAME), in which case, spaces and dashes do not
            matter. Default the star that is not marked as a reference (IS_PSF), if there is just
            one.
        filter : str, optional
            Filter to use. Default the one of all files, if there is just one.
        epoch : str or Time, optional
            Date in the epoch to use, such as "2022-10-03", if the target was observed in several.
            Frames of one epoch are at most 5 days apart, and share a wavefront.
        references : iterable of path
            Further files, of reference stars even if their headers do not say so.

        Returns
        -------
        Sequence
            `table` lists all files, what they are used for and why.

        Raises
        ------
        IncompatibleSetupError
            If target, filter or epoch cannot be decided, with the choices; if frames of the target
            contradict each other, and nothing says which are right.
        NoValidPixelsError
            If no frame of the target is left.
        """
        sequences = cls.by_epoch(files, target=target, filter=filter, references=references)
        return cls._only(sequences, epoch)

    @classmethod
    def of_opened(
        cls,
        files: list[FrameFile],
        references: list[FrameFile],
        *,
        target: str | None = None,
        filter: str | None = None,
    ) -> Sequence:
        """Sort files that were opened, see `from_files`, and fill in their reasons."""
        listed = with_references(files, references)
        exclude_unusable(listed)
        require_some(listed)
        return cls._only(cls._by_epoch(listed, target, filter), None)

    @staticmethod
    def _only(sequences: tuple[Sequence, ...], epoch: str | Time | None) -> Sequence:
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
                "with epoch=..., or take all with Sequence.by_epoch. The command reduce does so"
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
    ) -> tuple[Sequence, ...]:
        """Sort files as `from_files` does, into one sequence for each epoch.

        Frames of the target more than 5 days apart belong to different epochs. A reference star
        belongs to the epochs of the target that it was observed within 5 days of.

        Returns
        -------
        tuple of Sequence
            In order of time.
        """
        return cls._by_epoch(_usable(files, references), target, filter)

    @classmethod
    def by_filter_and_epoch(
        cls,
        files: str | os.PathLike[str] | Iterable[str | os.PathLike[str]],
        *,
        target: str | None = None,
        filter: str | None = None,
        references: Iterable[str | os.PathLike[str]] = (),
    ) -> tuple[Sequence, ...]:
        """Sort files into one sequence for each filter and epoch of the target.

        Arguments are those of `by_epoch`; with `filter` there is one filter.

        Returns
        -------
        tuple of Sequence
            In order of time.
        """
        listed = _usable(files, references)
        if filter is not None:
            return cls._by_epoch(listed, target, filter)
        science, _ = choose_target([replace(each) for each in listed], target)
        names = {each.exposure.filter for each in science} - {None}
        if len(names) < 2:
            return cls._by_epoch(listed, target, next(iter(names), None))
        star = target or science[0].star
        sequences = [
            each
            for name in sorted(filter_ for filter_ in names if filter_ is not None)
            for each in cls._by_epoch([replace(file) for file in listed], star, name)
        ]
        return tuple(sorted(sequences, key=lambda each: _time(each.science[0])))

    @classmethod
    def _by_epoch(
        cls, listed: list[FrameFile], target: str | None, filter: str | None
    ) -> tuple[Sequence, ...]:
        """Sort files that were listed, whose reasons this fills in."""
        choose_filter(listed, filter)
        science, others = choose_target(listed, target)
        exclude_other_setups(science, others)
        star = science[0].star
        together = [*science, *others]
        frames = {id(each): each.read() for each in together if not each.reason}
        judge_frames([each for each in together if not each.reason], frames)
        exclude_copies(together, frames)
        exclude_contradicting(together, frames, why_turned)
        for group in (science, *_by_star(others)):
            exclude_contradicting(group, frames, why_other_brightness)
        exclude_unoriented(science)
        if all(each.reason for each in science):
            reasons = "; ".join(f"{each.name}: {each.reason}" for each in science)
            raise NoValidPixelsError(f"{star}: no frames of the target can be used: {reasons}")
        kept = [each for each in science if not each.reason]
        epochs = epochs_of([each.exposure.date for each in kept])
        return tuple(
            cls._of_epoch(star, [kept[k] for k in epoch], listed, science, frames)
            for epoch in epochs
        )

    @classmethod
    def _of_epoch(
        cls,
        star: str,
        chosen: list[FrameFile],
        listed: list[FrameFile],
        science: list[FrameFile],
        frames: Mapping[int, Observation | None],
    ) -> Sequence:
        """Make the sequence of one epoch, of which `chosen` are the target's frames."""
        dates = [each.exposure.date for each in chosen if each.exposure.date is not None]
        rows, excluded = [], []
        used: dict[str, list[Observation]] = {"target": [], "reference": []}
        for each in listed:
            reason = each.reason
            if not reason and each not in chosen and (each in science or not _near(each, dates)):
                day = min(dates).isot[:10]
                reason = f"of another epoch than the frames of {day}, which have another wavefront"
            if reason:
                excluded.append((each.name, reason))
                rows.append(Row("excluded", each.star, each.exposure, None, reason, each.path))
                continue
            use: Literal["target", "reference"] = "target" if each in chosen else "reference"
            observation = frames[id(each)]
            for part in () if observation is None else observation.pointings():
                part = replace(part, reference=use == "reference")
                used[use].append(part)
                remark = "; ".join(part.remarks)
                rows.append(Row(use, each.star, each.exposure, part, remark, each.path))
        rows.sort(key=lambda row: (("target", "reference", "excluded").index(row.use), row.time))
        return cls(
            star,
            tuple(sorted(used["target"], key=_time)),
            tuple(sorted(used["reference"], key=_time)),
            tuple(excluded),
            tuple(rows),
        )

    @property
    def date(self) -> Time | None:
        """Mean date of the target's frames, None if none of them has one."""
        dates = [each.date for each in self.science if each.date is not None]
        return Time(dates).mean() if dates else None

    @property
    def table(self) -> QTable:
        """One row for each file: what it is used for and why, and what it is.

        Positions of the star behind the mask, `offset_x` and `offset_y`, are NaN where the file
        does not state them.
        """
        rows = self.rows or (*_rows("target", self.science), *_rows("reference", self.references))
        return rows_table(rows)

    def windows(self, shape: tuple[int, int]) -> tuple[Window, ...]:
        """Boxes of `shape` about the star in the frames of the target, one for each observation.

        Rolls whose stars are on nearly the same pixel of the detector have boxes of the same
        pixels, so that they share its pattern.
        """
        windows = [Window.about(each.center.mean(axis=0), shape) for each in self.science]
        places = [
            None if each.first_pixel is None else np.add(each.first_pixel, (window.x, window.y))
            for each, window in zip(self.science, windows, strict=True)
        ]
        first = places[0]
        for k, place in enumerate(places):
            if first is None or place is None:
                continue
            x, y = first - place
            if max(abs(x), abs(y)) <= _NEARLY_THE_SAME:
                windows[k] = Window(windows[k].y + int(y), windows[k].x + int(x), shape)
        return tuple(windows)

    def cutout(self, size: int | tuple[int, int], *, beyond_edges: bool = False) -> Sequence:
        """Cut the pixels about the star out of every frame.

        Rolls whose stars are on nearly the same pixel of the detector are cut alike, see
        `windows`.

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
        others = [Window.about(each.center.mean(axis=0), shape) for each in self.references]
        science, references = (
            tuple(
                each.within(window, beyond_edges=beyond_edges)
                for each, window in zip(frames, windows, strict=True)
            )
            for frames, windows in (
                (self.science, self.windows(shape)),
                (self.references, others),
            )
        )
        return replace(self, science=science, references=references)


def _usable(
    files: str | os.PathLike[str] | Iterable[str | os.PathLike[str]],
    references: Iterable[str | os.PathLike[str]],
) -> list[FrameFile]:
    """Files with the reasons of those that cannot be used, of which some are left."""
    listed = exposures_in(files, references)
    exclude_unusable(listed)
    require_some(listed)
    return listed


def _rows(
    use: Literal["target", "reference"], observations: Iterable[Observation]
) -> Iterable[Row]:
    for each in observations:
        exposure = Exposure.of(each.header, each.name, each.data.shape)
        yield Row(use, each.target, exposure, each)


def _by_star(listed: Iterable[FrameFile]) -> Iterable[list[FrameFile]]:
    stars: dict[str, list[FrameFile]] = {}
    for each in listed:
        stars.setdefault(each.star, []).append(each)
    return stars.values()


def _near(file: FrameFile, dates: list[Time]) -> bool:
    """Whether a frame was taken in the epoch of these dates, as far as is known."""
    date = file.exposure.date
    return date is None or not dates or min(abs(date.mjd - each.mjd) for each in dates) <= EPOCH


def _days(sequences: Iterable[Sequence]) -> str:
    """The epochs of sequences with their files, for messages."""
    return "; ".join(
        f"{'no date' if each.date is None else each.date.isot[:10]} "
        f"({', '.join(dict.fromkeys(frame.name for frame in each.science))})"
        for each in sequences
    )


def _time(observation: Observation) -> float:
    return 0.0 if observation.date is None else float(observation.date.mjd)
