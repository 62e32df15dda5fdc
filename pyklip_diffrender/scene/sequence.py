"""Sequences: the rolls of a target and the reference stars that go with them."""

from __future__ import annotations

import os
from collections import Counter, abc
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from astropy import units as u
from astropy.table import QTable
from astropy.time import Time

from pyklip_diffrender.errors import DiffrenderError, IncompatibleSetupError, NoValidPixelsError
from pyklip_diffrender.io.html_repr import html_summary
from pyklip_diffrender.io.names import same_name, unknown_name
from pyklip_diffrender.scene.observation import Observation

__all__ = ["Sequence"]

_SUFFIXES = (".fits", ".fits.gz")

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
        table = self.table
        return html_summary(f"Sequence of {self.target}", facts, table, table.colnames)

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
    ) -> Sequence:
        """Sort JWST coronagraphic files into target and reference stars by their headers.

        Parameters
        ----------
        files : path or sequence of path
            Stage-2 files (calints), spaceKLIP's aligned files, or a folder with either.
        target : str, optional
            Name of the target (TARGPROP), in which case, spaces and dashes do not matter. Default
            the star that is not marked as a reference (IS_PSF), if there is just one.
        filter : str, optional
            Filter to use. Default the one of all files, if there is just one.

        Returns
        -------
        Sequence
            Files that cannot be used are listed in `excluded` with the reason.

        Raises
        ------
        IncompatibleSetupError
            If target or filter cannot be decided, with the choices.
        NoValidPixelsError
            If no frame of the target is left.
        """
        paths = _paths(files)
        observations: list[Observation] = []
        excluded: list[tuple[str, str]] = []
        for path in paths:
            try:
                observations.append(Observation.from_fits(path))
            except DiffrenderError as error:
                excluded.append((path.name, str(error)))
        if not observations:
            reasons = "; ".join(f"{name}: {reason}" for name, reason in excluded)
            raise NoValidPixelsError(f"none of {len(paths)} files can be used: {reasons}")
        filter = _the_only("filter", filter, [each.filter for each in observations])
        through = [each for each in observations if same_name(each.filter, filter)]
        excluded += [
            (each.name, f"taken through {each.filter}, not {filter}")
            for each in observations
            if not same_name(each.filter, filter)
        ]
        if target is None:
            unmarked = [each.target for each in through if not each.header.get("IS_PSF")]
            target = _the_only("target", None, unmarked or [each.target for each in through])
        science = [each for each in through if same_name(each.target, target)]
        if not science:
            raise unknown_name("target", target, [each.target for each in through])
        setup = _setup(science[0])
        references = []
        for each in through:
            if same_name(each.target, target):
                continue
            if _setup(each) == setup:
                references.append(replace(each, reference=True))
            else:
                excluded.append((each.name, f"set-up {_setup(each)} differs from {setup}"))
        return cls(
            science[0].target,
            tuple(sorted(science, key=_time)),
            tuple(sorted(references, key=_time)),
            tuple(excluded),
        )

    @property
    def date(self) -> Time | None:
        """Mean date of the target's frames, None if none of them has one."""
        dates = [each.date for each in self.science if each.date is not None]
        return Time(dates).mean() if dates else None

    @property
    def table(self) -> QTable:
        """One row for each observation: what it is used for, star, date, roll and exposure."""
        rows = [("target", each) for each in self.science]
        rows += [("reference", each) for each in self.references]
        table = QTable(
            {
                "use": [use for use, _ in rows],
                "star": [each.target for _, each in rows],
                "date": ["" if e.date is None else e.date.isot[:16] for _, e in rows],
                "position_angle": [each.position_angle for _, each in rows] * u.deg,
                "integrations": [len(each) for _, each in rows],
                "file": [each.name for _, each in rows],
            }
        )
        table["position_angle"].info.format = ".2f"
        return table

    def cutout(self, size: int) -> Sequence:
        """Cut the `size` x `size` pixels about the star out of every frame.

        Rolls whose stars are on nearly the same pixel of the detector are cut alike, so that
        they share its pattern.
        """
        science = [each.cutout(size) for each in self.science]
        origin = science[0].first_pixel
        for k, cut in enumerate(science):
            if origin is None or cut.first_pixel is None or cut.first_pixel == origin:
                continue
            if np.abs(np.subtract(cut.first_pixel, origin)).max() <= _NEARLY_THE_SAME:
                science[k] = self.science[k].cutout(size, first_pixel=origin)
        return replace(
            self,
            science=tuple(science),
            references=tuple(each.cutout(size) for each in self.references),
        )


def _paths(files: str | os.PathLike[str] | Iterable[str | os.PathLike[str]]) -> list[Path]:
    entries = [files] if isinstance(files, str | os.PathLike) else list(files)
    paths: list[Path] = []
    for each in map(Path, entries):
        if each.is_dir():
            inside = sorted(p for p in each.iterdir() if p.name.endswith(_SUFFIXES))
            if not inside:
                raise NoValidPixelsError(f"{each}: the folder has no FITS files")
            paths += inside
        else:
            paths.append(each)
    if not paths:
        raise NoValidPixelsError("files: got none, expected at least one")
    return paths


def _the_only(key: str, choice: str | None, values: abc.Sequence[str | None]) -> str:
    """Return the requested value, or the only one in the files."""
    counts = Counter(str(value) for value in values)
    if choice is not None:
        if not any(same_name(choice, value) for value in counts):
            raise unknown_name(key, choice, counts)
        return choice
    if len(counts) > 1:
        raise IncompatibleSetupError(
            f"{key}: the files have {', '.join(f'{n} ({c})' for n, c in counts.items())}; choose "
            f"one with {key}=..."
        )
    return next(iter(counts))


def _setup(observation: Observation) -> tuple[str, ...]:
    keys = ("CORONMSK", "PUPIL", "SUBARRAY", "DETECTOR")
    return tuple(str(observation.header.get(key, "")) for key in keys)


def _time(observation: Observation) -> float:
    return 0.0 if observation.date is None else float(observation.date.mjd)
