"""Learn a library of detector patterns from the frames of many stars, and test it on each."""

from __future__ import annotations

import hashlib
import json
import logging
import os
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from astropy import units as u
from astropy.io.fits import Header
from astropy.table import QTable

from pyklip_diffrender._version import __version__
from pyklip_diffrender.errors import (
    CorruptFileError,
    DiffrenderError,
    NoValidPixelsError,
    RefinementError,
)
from pyklip_diffrender.io.headers import same_name, unknown_name
from pyklip_diffrender.io.progress import numbered_stages, stage
from pyklip_diffrender.pattern.library import PatternLibrary, known_pattern
from pyklip_diffrender.pattern.measure import (
    KNOWN_MODEL_ERROR,
    flat_of,
    measure_patterns,
    pattern_pedestal,
    pattern_size,
)
from pyklip_diffrender.refinement.fit_file import encoded
from pyklip_diffrender.refinement.fit_result import Refinement
from pyklip_diffrender.refinement.fitting import refine
from pyklip_diffrender.refinement.settings import FitSettings, settings_for
from pyklip_diffrender.scene.admission import admitted, exposures_in, frames_by_star
from pyklip_diffrender.scene.detector_pattern import DetectorPattern
from pyklip_diffrender.scene.exposure import detector_of, image_mask
from pyklip_diffrender.scene.frame_file import FrameFile
from pyklip_diffrender.scene.observation import Observation
from pyklip_diffrender.scene.sequence import ExposureSequence
from pyklip_diffrender.scene.simulation import model_for
from pyklip_diffrender.wavefront.opd import opd_for
from pyklip_diffrender.wavefront.opd_map import OPDMap

_log = logging.getLogger(__name__)

Files = str | os.PathLike[str] | Iterable[str | os.PathLike[str]]

_Fit = tuple[Refinement, tuple[float, float]]
"""A fit, and the size of its pattern in the frames with the error of the size."""

_MODEL_ERROR_ALONE = 0.01
"""Smallest model error, as a fraction of the star, in the fit of a star without a pattern."""


def learn_patterns(
    files: Files,
    opd: Any,
    *,
    stars: Sequence[str] = (),
    filters: Sequence[str] = (),
    size: int = 80,
    settings: FitSettings | None = None,
    folder: str | os.PathLike[str] | None = None,
    device: str = "cpu",
    progress: bool = False,
) -> PatternLibrary:
    """Learn the detector pattern from the frames of many stars.

    Frames are sorted by star, epoch and set-up (detector, mask, filter, flat field). Every star is
    fitted twice: alone, and then with the pattern that the first fits of the other stars show, so
    that less of the wavefront's error is taken for the pattern. The library has the patterns of the
    second fits. How much better they describe a star than fits without a pattern tells how much a
    pattern is worth for a star that it was not learned from.

    Companions are no part of the fits. With three frames or more, a companion of one star is
    rejected as an outlier where the patterns are combined; leave out stars with disks, and stars
    with bright companions if there are few others.

    Parameters
    ----------
    files : path or sequence of path
        Files as for `ExposureSequence.from_files`, of any number of stars, epochs, filters and
        masks. Frames are calibrated (MJy/sr), and say which pixels of the detector they have.
    opd : path, OPDMap, Quantity, array, "flat" or callable
        The wavefront to start from, as for `reduce`; a function gets the `ExposureSequence` of a
        star and returns its `OPDMap`.
    stars, filters : sequence of str
        Names of the stars and filters to use; default all.
    size : int
        Side in pixels of the square about the star that is fitted, and for which the library has
        the pattern.
    settings : FitSettings, optional
        Fit settings; default as in `refine`. The model error is replaced.
    folder : path, optional
        Folder for finished fits. A run with the same frames, headers, map and settings takes the
        fits from there, and fits only further stars.
    device : str
        PyTorch device of the optical model.
    progress : bool
        Show progress bars.

    Returns
    -------
    PatternLibrary
        The library. Its `validation` has for each star and epoch the set-up, the date, the number
        of `frames`, chi-squared per pixel without a pattern (`chi2_alone`) and with the pattern of
        the other stars (`chi2_with_others`), both with the noise of the data alone, and how much of
        that pattern the frames show with its error (`shown`, `shown_error`, see `pattern_size`).
        `chi2_with_others`, `shown` and `shown_error` are NaN for a star without others.

    Raises
    ------
    NoValidPixelsError
        If no star is left.
    IncompatibleSetupError
        For stars or filters that the files do not have.
    RefinementError
        If no star can be fitted.

    Examples
    --------
    With frames and OPD maps in folders, which the package does not contain:

    >>> import pyklip_diffrender as dr
    >>> library = dr.pattern.learn_patterns("calints", "maps", folder="fits")  # doctest: +SKIP
    >>> library.write("patterns.fits")  # doctest: +SKIP
    """
    epochs = list(_epochs(files, opd, stars, filters, size))
    if not epochs:
        raise NoValidPixelsError(
            "no star is left to learn the detector pattern from; the log says why"
        )
    fitter = _Fitter(settings, None if folder is None else Path(folder), device, progress)
    parts = []
    with numbered_stages():
        for setup in dict.fromkeys(each.setup for each in epochs):
            parts.append(_learn([each for each in epochs if each.setup == setup], fitter))
    patterns = [pattern for part, _ in parts for pattern in part]
    if not patterns:
        raise RefinementError(
            f"none of {len(epochs)} fits is good enough to learn the detector pattern from; the "
            "log says why"
        )
    rows = [row for _, part in parts for row in part]
    return PatternLibrary(tuple(patterns), QTable(rows=rows))


@dataclass(frozen=True, eq=False)
class _Epoch:
    """Frames of a star that share a wavefront, cut to the fitted pixels."""

    star: str
    science: tuple[Observation, ...]
    opd: OPDMap

    @property
    def setup(self) -> tuple[str | None, ...]:
        """Detector, mask, filter and flat field, whose frames share a pattern."""
        first = self.science[0]
        mask = image_mask(first.header, first.name)
        return (detector_of(first.header, first.name), mask, first.filter, flat_of(first))

    @property
    def date(self) -> str:
        return min((each.date.isot for each in self.science if each.date is not None), default="")

    def __str__(self) -> str:
        _, mask, filter_, _ = self.setup
        return " ".join(filter(None, (self.star, filter_, mask, self.date[:10])))


@dataclass(frozen=True)
class _Fitter:
    """Fits that are kept in a folder."""

    settings: FitSettings | None
    folder: Path | None
    device: str
    progress: bool

    def fit(
        self, epoch: _Epoch, known: DetectorPattern | None
    ) -> tuple[Refinement, tuple[float, float]]:
        """Fit an epoch, or read the fit; also how much of the pattern it shows."""
        first = epoch.science[0]
        settings = replace(
            self.settings or replace(settings_for(first), max_companions=0),
            min_model_error=_MODEL_ERROR_ALONE if known is None else KNOWN_MODEL_ERROR,
        )
        path = None
        if self.folder is not None:
            digest = _digest(epoch, settings, known)[:16]
            path = self.folder / f"{re.sub(r'[^A-Za-z0-9.+-]+', '_', str(epoch))}_{digest}.fits"
            if path.is_file():
                try:
                    fit = Refinement.read(path)
                except CorruptFileError as error:
                    _log.warning("%s; it is fitted again", error)
                else:
                    _log.info("%s: the fit is taken from %s", epoch, path)
                    return fit, _shown(fit)
        model = model_for(first, max(first.shape), device=self.device)
        others = "" if known is None else ", with the pattern of the others"
        with stage(f"{epoch}{others}"):
            fit = refine(
                model,
                epoch.science,
                epoch.opd,
                pattern=known,
                settings=settings,
                progress=self.progress,
            )
        if path is not None:
            # The linear model is kept only where something is measured with it.
            fit.write(path, linear=known is not None, overwrite=True)
        return fit, _shown(fit)


def _learn(epochs: Sequence[_Epoch], fitter: _Fitter) -> tuple[list[Any], list[dict[str, Any]]]:
    """Patterns of one set-up, and the rows of its validation."""
    alone: dict[_Epoch, Refinement] = {}
    for epoch in epochs:
        fit = _attempt(epoch, None, fitter)
        if fit is not None:
            alone[epoch] = fit[0]
    pedestal = pattern_pedestal(list(alone.values()))
    last, rows = [], []
    for epoch, first in alone.items():
        # The pattern of the others owes nothing to this star's frames and companions, so that
        # chi-squared with it says what a pattern is worth for a star that it was not learned from.
        # In the second fit the wavefront imitates less of the pattern, which is measured again.
        others = [fit for other, fit in alone.items() if not same_name(other.star, epoch.star)]
        library = PatternLibrary(tuple(measure_patterns(others, pedestal)))
        known = known_pattern(epoch.science[0], library=library)
        again = None if known is None else _attempt(epoch, known, fitter)
        chi2, shown = np.nan, (np.nan, np.nan)
        if again is not None:
            chi2, shown = _chi2(again[0]), again[1]
        last.append(first if again is None else again[0])
        detector, mask, filter_, flat = epoch.setup
        row = {
            "star": epoch.star,
            "detector": detector or "",
            "mask": mask or "",
            "filter": filter_ or "",
            "flat": flat or "",
            "date": epoch.date,
            "frames": len(epoch.science),
            "chi2_alone": _chi2(first),
            "chi2_with_others": chi2,
            "shown": shown[0],
            "shown_error": shown[1],
        }
        _log.info("%s: chi-squared per pixel %.2f alone, %.2f with the pattern of the others",
                  epoch, row["chi2_alone"], chi2)  # fmt: skip
        rows.append(row)
    return measure_patterns(last, pattern_pedestal(last)), rows


def _attempt(epoch: _Epoch, known: DetectorPattern | None, fitter: _Fitter) -> _Fit | None:
    """Fit an epoch; None, with a warning, if it fails."""
    try:
        fit = fitter.fit(epoch, known)
    except DiffrenderError as error:
        _log.warning("%s is left out: %s", epoch, error)
        return None
    if not fit[0].status.usable:
        _log.warning("%s is left out: %s", epoch, fit[0].status)
        return None
    return fit


def _epochs(
    files: Files, opd: Any, stars: Sequence[str], filters: Sequence[str], size: int
) -> Iterable[_Epoch]:
    """Sort files, and read the frames of every star, epoch and set-up."""
    admission = admitted(exposures_in(files))
    for each, reason in admission.reasons.items():
        _log.warning("%s is left out: %s", each.name, reason)
    named = [each for each in admission.left() if each.exposure.star.is_known]
    by_star = frames_by_star(named)
    known = {each.exposure.filter for each in admission.left()}
    for choice in filters:
        if not any(same_name(choice, each) for each in known):
            raise unknown_name("filter", choice, known)
    for choice in stars:
        if not any(_is_called(choice, star, frames) for star, frames in by_star.items()):
            raise unknown_name("star", choice, by_star)
    for star, frames in by_star.items():
        if stars and not any(_is_called(choice, star, frames) for choice in stars):
            continue
        for setup in dict.fromkeys(each.exposure.setup for each in frames):
            chosen = [each for each in frames if each.exposure.setup == setup]
            name = chosen[0].exposure.filter
            if filters and not any(same_name(name, each) for each in filters):
                continue
            yield from _of_setup(star, chosen, opd, size)


def _is_called(name: str, star: str, frames: Iterable[FrameFile]) -> bool:
    return same_name(name, star) or any(each.exposure.star.is_called(name) for each in frames)


def _of_setup(star: str, files: Sequence[FrameFile], opd: Any, size: int) -> Iterable[_Epoch]:
    """Epochs of a star with one set-up; the log names the epochs that cannot be used."""
    try:
        sequences = ExposureSequence.by_epoch([each.path for each in files], target=star)
    except DiffrenderError as error:
        _log.warning("%s is left out: %s", star, error)
        return
    find: Callable[[ExposureSequence], OPDMap] = (
        opd if callable(opd) else lambda sequence: opd_for(opd, sequence.date)
    )
    used = {row.path for each in sequences for row in each.rows if row.use == "target"}
    for name, reason in sequences[0].excluded:
        if name not in {path.name for path in used if path is not None}:
            _log.warning("%s is left out: %s", name, reason)
    for sequence in sequences:
        usable = []
        for each in sequence.science:
            if each.first_pixel is None:
                reason = "the file does not say which pixels of the detector its frames show"
            elif each.unit != u.MJy / u.sr:
                reason = f"its unit is {each.unit}, expected calibrated frames in MJy/sr"
            else:
                usable.append(each)
                continue
            _log.warning("%s is left out: %s", each.name, reason)
        if usable:
            cut = replace(sequence, science=tuple(usable), references=()).cutout(size)
            yield _Epoch(star, cut.science, find(sequence))


def _chi2(fit: Refinement) -> float:
    """Chi-squared per pixel with the noise of the data alone."""
    total, count = 0.0, 0
    for frame in fit.frames:
        combined = frame.observation.combined()
        left = combined.data[0] - frame.star - frame.companion_image
        valid = combined.valid[0]
        total += float(((left / combined.error[0])[valid] ** 2).sum())
        count += int(valid.sum())
    return total / count


def _shown(fit: Refinement) -> tuple[float, float]:
    size = None if fit.pattern is None else pattern_size(fit)
    return (np.nan, np.nan) if size is None else size


def _digest(epoch: _Epoch, settings: FitSettings, known: DetectorPattern | None) -> str:
    """Hash of everything that decides the result of a fit: all that frames, map and pattern say."""
    digest = hashlib.sha256(f"{__version__} {json.dumps(encoded(settings))}".encode())
    parts: list[Any] = [*epoch.science, replace(epoch.opd, path=None)]
    for part in [*parts, known] if known is not None else parts:
        for each in fields(part):
            value = getattr(part, each.name)
            if isinstance(value, np.ndarray):
                content = np.ascontiguousarray(value).tobytes()
            else:
                text = value.tostring() if isinstance(value, Header) else repr(value)
                content = text.encode()
            digest.update(f"\n{each.name} {len(content)} ".encode() + content)
    return digest.hexdigest()
