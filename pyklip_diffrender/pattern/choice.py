"""The choice of the detector pattern: of the library, of reference stars, or none."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np
from astropy import units as u
from astropy.time import Time
from numpy.typing import NDArray
from scipy.ndimage import fourier_shift

from pyklip_diffrender.errors import CorruptFileError, DiffrenderError, IncompatibleSetupError
from pyklip_diffrender.io.files import open_fits, product_in
from pyklip_diffrender.io.progress import stage
from pyklip_diffrender.optics.system import OpticalSystem
from pyklip_diffrender.pattern.library import (
    PatternLibrary,
    combine_libraries,
    known_pattern,
    package_library,
)
from pyklip_diffrender.pattern.measure import (
    KNOWN_MODEL_ERROR,
    flat_of,
    lacks_pattern,
    measure_patterns,
)
from pyklip_diffrender.refinement.fit_result import Refinement
from pyklip_diffrender.refinement.fitting import refine
from pyklip_diffrender.refinement.settings import FitSettings, settings_for
from pyklip_diffrender.scene.admission import epochs_of
from pyklip_diffrender.scene.aligned_frames import shift_frames, shift_variances
from pyklip_diffrender.scene.detector_pattern import DetectorPattern, shows_star
from pyklip_diffrender.scene.exposure import detector_of, image_mask
from pyklip_diffrender.scene.observation import Observation
from pyklip_diffrender.wavefront.opd_map import OPDMap

# Find which pixels of the detector frames show, from the pattern of the flat field itself.
#
# The detector pixels of frames that were shifted without a record are unknown. The residual of a
# fit tells them: it correlates with the known pattern at only one position.

_log = logging.getLogger(__name__)

_REACH_PIXELS = 3.0
"""Pixels by which stars behind the same mask may be apart."""

_COARSE_PIXELS, _FINE_PIXELS = 0.25, 0.05
"""Steps of the search, pixels."""

_PEAK_SCATTERS = 6.0
"""Height of the peak in units of the correlation's scatter elsewhere."""

_PEAK_RADIUS_PIXELS = 1.5
"""Distance from the peak beyond which the correlation measures its scatter, pixels."""

_MODEL_ERROR = 0.05
"""Error of the ratio of residual and star that the pattern does not explain."""

_INNER_ARCSEC = 0.3
"""Smallest separation used, arcsec. Closer in, the ratio is dominated by errors of the model."""


def place_on_detector(fit: Refinement, pattern: DetectorPattern) -> Observation | None:
    """Move the frames of a fit onto the pixels of the detector that a pattern was measured on.

    The frames are of one observation and were fitted without a pattern. The result is shifted by
    less than a pixel and has `first_pixel`; it is None if the pattern is not detected.
    """
    frame, (measured,) = fit.frames[0], measure_patterns(fit)
    observation = frame.observation
    if pattern.first_pixel is None:
        return None
    # Stars behind the same mask are within a few pixels of each other on the detector, so the
    # pattern is first put with its star on the frame's star, to whole pixels. The search then moves
    # it by up to `_REACH_PIXELS` pixels in steps, and about the best place in finer ones.
    start = np.round(np.subtract(measured.center, pattern.center)).astype(int)
    column, row = np.subtract(pattern.first_pixel, start).tolist()
    expected = pattern.at(replace(observation, first_pixel=(column, row)))[0]
    y, x = np.indices(expected.shape)
    scale_x, scale_y = frame.model.detector.pixelscale
    distance = np.hypot((x - measured.center[0]) * scale_x, (y - measured.center[1]) * scale_y)
    # Inverse variances of the ratio, from its noise and from the errors of the model.
    weight = np.where(distance > _INNER_ARCSEC, 1 / (measured.variance + _MODEL_ERROR**2), 0.0)
    steps = np.arange(-_REACH_PIXELS, _REACH_PIXELS + _COARSE_PIXELS / 2, _COARSE_PIXELS)
    coarse = _correlation(measured.value, expected, weight, steps, steps)
    row, column = np.unravel_index(int(coarse.argmax()), coarse.shape)
    best = np.array([steps[column], steps[row]])
    # Beyond its peak the correlation scatters as it would without the pattern.
    elsewhere = np.hypot(*np.meshgrid(steps - best[0], steps - best[1])) > _PEAK_RADIUS_PIXELS
    scatter = float(coarse[elsewhere].std())
    _log.info("pattern seen at %s pixels, correlation %.2f, elsewhere %.3f",
              best, coarse.max(), scatter)  # fmt: skip
    if coarse.max() < _PEAK_SCATTERS * scatter:
        return None
    nearby = np.arange(-_COARSE_PIXELS, _COARSE_PIXELS + _FINE_PIXELS / 2, _FINE_PIXELS)
    fine = _correlation(measured.value, expected, weight, best[0] + nearby, best[1] + nearby)
    row, column = np.unravel_index(int(fine.argmax()), fine.shape)
    moved = start + best + (nearby[column], nearby[row])
    pixels = np.round(moved).astype(int)
    shift = np.broadcast_to(pixels - moved, (len(observation), 2))
    column, row = np.subtract(pattern.first_pixel, pixels).tolist()
    # Masked pixels are filled in, because empty ones would ring into their neighbours.
    valid = observation.valid
    data = shift_frames(np.where(valid, observation.data, frame.star), shift)
    error = np.sqrt(shift_variances(observation.error, valid, shift))
    return replace(
        observation,
        data=np.where(valid, data, 0.0),
        error=np.where(valid, error, 1.0),
        valid=valid,
        center=observation.center + shift,
        first_pixel=(column, row),
    )


def _correlation(
    value: NDArray[np.float64],
    pattern: NDArray[np.float64],
    weight: NDArray[np.float64],
    right: NDArray[np.floating],
    up: NDArray[np.floating],
) -> NDArray[np.float64]:
    """Weighted correlation (up, right) of a ratio (ny, nx) with the pattern, shifted in pixels."""
    # c = sum w v m / sqrt(sum w v^2 sum w m^2), where v and the moved pattern m are without their
    # weighted means, so that neither a background nor an error of the flux counts. A shift is a
    # phase in Fourier space.
    transform = np.fft.fft2(pattern)
    total = weight.sum()
    centred = value - (weight * value).sum() / total
    length = np.sqrt((weight * centred**2).sum())
    correlation = np.empty((len(up), len(right)))
    for row, y in enumerate(up):
        for column, x in enumerate(right):
            moved = np.fft.ifft2(fourier_shift(transform, (y, x))).real
            moved -= (weight * moved).sum() / total
            product = (weight * centred * moved).sum()
            correlation[row, column] = product / (length * np.sqrt((weight * moved**2).sum()))
    return correlation


PatternRequest: TypeAlias = DetectorPattern | PatternLibrary | Literal["auto", "references", "off"]

ReferenceFrames: TypeAlias = Sequence[Observation] | Callable[[], Sequence[Observation]]
"""Frames of reference stars, or a function that reads them where they are needed."""

Origin: TypeAlias = Literal["none", "off", "given", "library", "references", "rolls"]


_ROUGH_SETTINGS: dict[str, Any] = {
    "min_model_error": 0.05,
    "tolerance": 0.05,
    "adapt_prior": False,
    "companions_if_stalled": False,
}
"""Changes to the settings of a fit that only tells which pixels a frame shows. The pattern tells it
as soon as it dominates the residual: in thirteen frames of four stars, places differed by at most
0.05 pixel from the headers or from full fits."""

_OTHER_ROLL_DEG = 1.0
"""Degrees between rolls from which they tell a planet from the pattern: a pixel at 3.6 arcsec."""

_TYPICAL_PATTERN_RMS = 0.03
_TYPICAL_PEDESTAL_MJY_SR = 1.9
"""Rms of the pattern, and pedestal in MJy/sr, that describe the residuals of the library's stars at
all separations."""


@dataclass(frozen=True, eq=False)
class PatternChoice:
    """The pattern that a fit of the target uses, and what goes with it."""

    # Frames of the target, moved onto the pixels of the pattern where their files do not say which
    # pixels they have.
    science: tuple[Observation, ...]
    pattern: DetectorPattern | None
    # Settings of the target's fit.
    settings: FitSettings | None
    # One fit for each reference star that was fitted.
    references: tuple[Refinement, ...] = ()
    # Reference stars that could not be fitted, and why.
    failed: tuple[tuple[str, str], ...] = ()
    # Where the pattern is from: nowhere, because none is known ("none") or none was wanted ("off"),
    # the caller, libraries alone, reference stars (and the library), or the rolls, which share a
    # pattern whose size alone is known.
    origin: Origin = "none"
    # The library that was searched.
    library: PatternLibrary = field(default_factory=PatternLibrary)

    @property
    def label(self) -> str:
        """The origin of the pattern in a few words, with the names of its stars."""
        if self.pattern is None:
            return "none"
        if self.origin in ("given", "rolls"):
            name = self.pattern.name
            return f"given ({name})" if self.origin == "given" else name
        fitted = [frame.observation.target for fit in self.references for frame in fit.frames]
        own = list(dict.fromkeys(fitted))
        others = [n for n in self.pattern.provenance.get("stars", []) if n not in own]
        parts = (("references", own), ("library", others))
        return ", ".join(f"{origin} ({', '.join(names)})" for origin, names in parts if names)

    @property
    def of_other_flat_field(self) -> Observation | None:
        """The first frame that was calibrated with another flat field than the pattern's, if any.

        The frame may show the pattern nevertheless. For a library's pattern, a frame that does not
        state its flat field counts as well.
        """
        if self.origin == "library":
            known = {each.flat for each in self.library.matching(self.science[0])}
            return next((e for e in self.science if None in known or known != {flat_of(e)}), None)
        if self.origin == "given" and self.pattern is not None:
            stated = {self.pattern.flat, None}
            if len(stated) > 1:
                return next((each for each in self.science if flat_of(each) not in stated), None)
        return None

    def is_refuted_by(self, fit: Refinement) -> bool:
        """Whether a fit shows less than half of a library's pattern.

        The log warns if a fit shows less than half of any pattern. Raises IncompatibleSetupError if
        that pattern was given.
        """
        if not lacks_pattern(fit):
            return False
        if self.origin == "given":
            assert self.pattern is not None
            own = sorted({flat_of(each) or "not stated" for each in self.science})
            raise IncompatibleSetupError(
                f"pattern: {fit.frames[0].observation.name} shows less than half of the "
                f"pattern {self.pattern.name!r}. Flat field of the frames: {', '.join(own)}; "
                f"of the pattern: {self.pattern.flat or 'not stated'}. Give a pattern of "
                "frames that were calibrated alike, or 'auto'"
            )
        return self.origin == "library"


def as_request(request: object) -> PatternRequest:
    """Make a request for a pattern; paths lead to files, or to a folder of libraries.

    Raises IncompatibleSetupError for anything else, CorruptFileError for a file without a pattern.
    """
    match request:
        case "auto" | "references" | "off" | DetectorPattern() | PatternLibrary():
            return request
        case str() | os.PathLike():
            path = Path(request)
            if path.is_dir():
                return PatternLibrary.read(path)
            if path.is_file():
                with open_fits(path) as hdus:
                    is_library = "PATVERS" in hdus[0].header
                    what = product_in(hdus) or "no product of pyklip_diffrender"
                    if not is_library and ("INITIAL_OPD" in hdus or "PATTERN" not in hdus):
                        raise CorruptFileError(
                            f"{path.name}: this is {what}, expected a detector pattern, such as "
                            "a pattern.fits, or a library of them"
                        )
                return PatternLibrary.read(path) if is_library else DetectorPattern.read(path)
    raise IncompatibleSetupError(
        f"pattern: got {request!r}, expected 'auto', 'references', 'off', a DetectorPattern, a "
        "PatternLibrary, or an existing file or folder with patterns, such as a pattern.fits"
    )


def choose_pattern(
    science: Sequence[Observation],
    references: ReferenceFrames,
    model: OpticalSystem,
    opd: OPDMap,
    *,
    pattern: PatternRequest = "auto",
    library: bool = True,
    settings: FitSettings | None = None,
    memory: float | None = None,
    progress: bool = False,
    opd_at: Callable[[Time | None], OPDMap] | None = None,
) -> PatternChoice:
    """Choose the detector pattern for `science`, the frames of a target as they will be fitted.

    "auto", or a `PatternLibrary` to search besides the package's, fits `references`, frames of
    other stars or a function that returns them, only where no library has a pattern; "references"
    fits them in any case and uses both. Fits of references start from `opd_at` their date, by
    default from `opd`. `library` is False for frames that do not show the library's pattern.
    Raises DiffrenderError if frames that have to be moved cannot be fitted; a reference star that
    cannot be fitted is left out.
    """
    request = as_request(pattern)
    common: dict[str, Any] = {
        "settings": _limited(settings, science[0], memory),
        "progress": progress,
    }
    fits: list[Refinement] = []
    failed: list[tuple[str, str]] = []
    chosen = request if isinstance(request, DetectorPattern) else None
    origin: Origin = "none" if chosen is None else "given"
    known = PatternLibrary()
    if request == "off":
        origin = "off"
    if chosen is not None and chosen.first_pixel is not None and chosen.value.any():
        name = chosen.name
        science, chosen = _registered(science, chosen, model, opd, common)
        if chosen is None:
            raise IncompatibleSetupError(
                f"pattern {name!r} is not seen in these frames, whose "
                "files do not say which pixels of the detector they show. Give 'auto'"
            )
    if request != "off" and not isinstance(request, DetectorPattern):
        first = science[0]
        known = _library(request) if library else PatternLibrary()
        # In this order: the library's pattern; the reference stars' pattern, whose fits take time;
        # and the rolls' pattern, whose size alone is known.
        if request != "references" and library:
            chosen = known_pattern(first, library=known)
            if chosen is not None:
                science, chosen = _registered(science, chosen, model, opd, common)
                origin = "library"
        if chosen is None and references:
            frames = references() if callable(references) else references
            frames, failed = _with_the_flat_of(first, frames)
            fits, unfitted = _fit_references(frames, model, opd_at or (lambda _: opd), common)
            failed += unfitted
            chosen = known_pattern(first, fits, library=known)
            origin = "references"
        if chosen is None:
            chosen = _unknown_pattern(science)
            origin = "rolls"
        if chosen is None:
            origin = "none"
        _log.info("detector pattern: %s", chosen)
    if chosen is not None and settings is None and science[0].is_nircam:
        settings = replace(settings_for(science[0]), min_model_error=KNOWN_MODEL_ERROR)
    settings = _limited(settings, science[0], memory)
    return PatternChoice(
        tuple(science), chosen, settings, tuple(fits), tuple(failed), origin, known
    )


def pattern_for_visit(
    choice: PatternChoice, science: Sequence[Observation], references: Sequence[Observation]
) -> DetectorPattern | None:
    """The pattern for a fit of all frames of a visit, after the `choice` for the target's fit."""
    # A pattern that was learned from one of the fitted stars would count its frames twice: the
    # pattern of other stars is taken, or else a pattern of unknown values that frames of the same
    # pixels share.
    given = choice.pattern if choice.origin == "given" else None
    if choice.origin == "off" or (
        given is not None and not any(shows_star(given, each) for each in references)
    ):
        return choice.pattern
    if is_known_beside(choice, references):
        patterns = [
            pattern
            for pattern in choice.library.patterns
            if not any(shows_star(pattern, each) for each in references)
        ]
        known = known_pattern(
            science[0], _fits_beside(choice, references), library=PatternLibrary(tuple(patterns))
        )
        if known is not None:
            return known
    first = science[0]
    return _unknown_pattern([*science, *(each for each in references if _alike(each, first))])


def is_known_beside(choice: PatternChoice, references: Sequence[Observation]) -> bool:
    """Whether a choice has a pattern of other frames than these frames of reference stars."""
    return choice.origin == "library" or bool(_fits_beside(choice, references))


def _fits_beside(choice: PatternChoice, references: Sequence[Observation]) -> list[Refinement]:
    """Fits of reference stars that the pattern was learned from, except of these frames."""
    if choice.origin != "references":
        return []
    names = {each.name for each in references}
    return [
        fit
        for fit in choice.references
        if not any(frame.observation.name in names for frame in fit.frames)
    ]


def with_known_pattern(settings: FitSettings) -> FitSettings:
    """Settings of a fit whose detector pattern accounts for the largest part of its error."""
    return replace(settings, min_model_error=min(settings.min_model_error, KNOWN_MODEL_ERROR))


def _library(request: PatternLibrary | str) -> PatternLibrary:
    """The package's library, preceded by a library in the request."""
    if isinstance(request, PatternLibrary):
        return combine_libraries([request, package_library()])
    return package_library()


def _limited(
    settings: FitSettings | None, observation: Observation, memory: float | None
) -> FitSettings | None:
    """Settings with a limit of the memory, if there is one."""
    if memory is None:
        return settings
    return replace(settings or settings_for(observation), memory=memory)


def _unknown_pattern(science: Sequence[Observation]) -> DetectorPattern | None:
    """Return a pattern whose size alone is known, if rolls tell it from a planet."""
    first = science[0]
    same = all(_alike(each, first) for each in science)
    # Files of one roll, such as the segments of an exposure, show a planet on the same pixels.
    # Frames of another star do not show it at all.
    turned = any(abs(each.roll_from(first)) > _OTHER_ROLL_DEG or each.reference for each in science)
    if not turned or not first.is_nircam or first.first_pixel is None or not same:
        return None
    zeros = np.zeros(first.shape)
    x, y = first.center[0]
    return DetectorPattern(
        value=zeros,
        error=zeros + _TYPICAL_PATTERN_RMS,
        center=(float(x), float(y)),
        unknown=_TYPICAL_PATTERN_RMS,
        pedestal=_TYPICAL_PEDESTAL_MJY_SR if first.unit == u.MJy / u.sr else 0.0,
        first_pixel=first.first_pixel,
        filter=first.filter,
        image_mask=image_mask(first.header, first.name),
        detector=detector_of(first.header, first.name),
        flat=flat_of(first),
        name="the rolls themselves",
    )


def _with_the_flat_of(
    first: Observation, references: Sequence[Observation]
) -> tuple[list[Observation], list[tuple[str, str]]]:
    """Frames that show the pattern of a frame; also the stars of the others, and why."""
    own, kept, failed = flat_of(first), list[Observation](), list[tuple[str, str]]()
    for each in references:
        flat = flat_of(each)
        if None in (own, flat) or flat == own:
            kept.append(each)
        else:
            reason = f"calibrated with the flat field {flat} (R_FLAT), the target with {own}"
            failed.append((each.target, reason))
    return kept, list(dict.fromkeys(failed))


def _alike(one: Observation, other: Observation) -> bool:
    """Whether two frames have the same pixels and the same error of the flat field."""
    return (one.first_pixel, one.shape, flat_of(one)) == (
        other.first_pixel,
        other.shape,
        flat_of(other),
    )


def _fit_references(
    references: Sequence[Observation],
    model: OpticalSystem,
    opd_at: Callable[[Time | None], OPDMap],
    common: dict[str, Any],
) -> tuple[list[Refinement], list[tuple[str, str]]]:
    """Fit every reference star at each epoch; also the names of stars that fail, and why."""
    fits, failed = [], []
    for star, frames in _by_star(references).items():
        epochs = epochs_of([each.date for each in frames])
        for chosen in ([frames[k] for k in epoch] for epoch in epochs):
            date = chosen[-1].date
            day = "" if date is None or len(epochs) == 1 else f" of {date.isot[:10]}"
            try:
                with stage(f"reference star {star}{day}"):
                    fits.append(refine(model, chosen, opd_at(date), **common))
            except DiffrenderError as error:
                _log.warning("reference star %s%s is left out: %s", star, day, error)
                failed.append((star, str(error)))
    return fits, failed


def _registered(
    science: Sequence[Observation],
    pattern: DetectorPattern,
    model: OpticalSystem,
    opd: OPDMap,
    common: dict[str, Any],
) -> tuple[Sequence[Observation], DetectorPattern | None]:
    """Move frames onto the pixels of the library's pattern; no pattern if this fails for one."""
    moved = []
    for each in science:
        frame: Observation | None = each
        if each.first_pixel is None:
            with stage(f"place of {each.name} on the detector"):
                frame = place_on_detector(_rough_fit(model, each, opd, **common), pattern)
        if frame is None:
            _log.warning(
                "%s: the file does not say which pixels of the detector its frames show, and the "
                "known detector pattern is not seen in them; it is not used", each.name
            )  # fmt: skip
            return science, None
        moved.append(frame)
    return moved, pattern


def _rough_fit(
    model: OpticalSystem,
    observation: Observation,
    opd: OPDMap,
    *,
    settings: FitSettings | None,
    progress: bool,
    pattern: DetectorPattern | None = None,
) -> Refinement:
    """Fit until the pattern dominates the residual."""
    settings = settings or settings_for(observation)
    settings = replace(settings, cycles=settings.cycles[:1], **_ROUGH_SETTINGS)
    return refine(model, observation, opd, settings=settings, pattern=pattern, progress=progress)


def is_refuted_by_frame(
    choice: PatternChoice, frame: Observation, model: OpticalSystem, opd: OPDMap
) -> bool:
    """Whether a frame alone shows less than half of the pattern, see `is_refuted_by`."""
    rough = _rough_fit(
        model,
        frame,
        opd,
        settings=choice.settings,
        progress=False,
        pattern=choice.pattern,
    )
    return rough.status.usable and choice.is_refuted_by(rough)


def _by_star(observations: Iterable[Observation]) -> dict[str, list[Observation]]:
    stars: dict[str, list[Observation]] = {}
    for each in observations:
        stars.setdefault(each.target, []).append(each)
    return stars


# The fit of a target with the detector pattern that its frames turn out to have.


def fit_with_pattern(
    science: Sequence[Observation],
    references: ReferenceFrames,
    model: OpticalSystem,
    opd: OPDMap,
    fit: Callable[[PatternChoice, bool], Refinement],
    **options: Any,
) -> tuple[PatternChoice, Refinement]:
    """Choose a pattern and fit the target; once more without the library if it is refuted.

    `fit` fits with a choice; its second argument is True without the library. `options` go to
    `choose_pattern`. Returns the last fit and its choice. Raises what `choose_pattern`
    raises, and IncompatibleSetupError for a pattern that was given and is refuted.
    """
    # Only a fit can tell that frames which were calibrated with another flat field do not have the
    # known pattern. Where the headers make that likely, one of these frames is asked before all are
    # fitted: its rough fit takes a tenth of the time of two rolls'.
    choice = choose_pattern(science, references, model, opd, **options)
    frame = choice.of_other_flat_field
    if frame is not None:
        with stage(f"detector pattern in {frame.name}"):
            is_refuted = is_refuted_by_frame(choice, frame, model, opd)
        if is_refuted:
            choice = choose_pattern(science, references, model, opd, library=False, **options)
    result = fit(choice, False)
    if choice.is_refuted_by(result):
        choice = choose_pattern(science, references, model, opd, library=False, **options)
        result = fit(choice, True)
    return choice, result
