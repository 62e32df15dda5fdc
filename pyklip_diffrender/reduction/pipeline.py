"""From a sequence of frames to planets: reference stars, pattern, joint fit, search."""

from __future__ import annotations

import logging
import os
import warnings
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from astropy.table import QTable
from astropy.time import Time

from pyklip_diffrender.detection import (
    Detection,
    Disk,
    WideField,
    completeness,
    detect,
    fit_disk,
    has_bright_pixels_beyond,
    recover_planets,
    require_outer_pixels,
    sources_at_edges,
    sources_beyond,
    wide_field,
    without_blurred_edges,
)
from pyklip_diffrender.errors import DiffrenderError, DiffrenderWarning
from pyklip_diffrender.io.progress import numbered_stages, stage
from pyklip_diffrender.io.tables import html_summary
from pyklip_diffrender.io.units import to_bytes
from pyklip_diffrender.optics.system import OpticalSystem
from pyklip_diffrender.options import ReduceOptions
from pyklip_diffrender.pattern import (
    PatternChoice,
    PatternLibrary,
    fit_with_pattern,
    is_known_beside,
)
from pyklip_diffrender.reduction.pages import remark_on_map
from pyklip_diffrender.reduction.remarks import looks_extended, on_extended_light, require_plausible
from pyklip_diffrender.reduction.visit import (
    Contribution,
    Joined,
    Visit,
    rough_settings,
    with_references,
)
from pyklip_diffrender.refinement import (
    FitSettings,
    Refinement,
    coarse_arguments,
    quick_settings,
    refine,
    refine_again,
    require_agreement_of_flux,
    require_calibrated,
    settings_for,
    to_jansky,
    with_star_flux,
)
from pyklip_diffrender.scene.detector_pattern import DetectorPattern, caveat, require_pattern_of
from pyklip_diffrender.scene.objects import Planet
from pyklip_diffrender.scene.observation import Observation
from pyklip_diffrender.scene.sequence import OF_ANOTHER_EPOCH, ExposureSequence
from pyklip_diffrender.scene.simulation import model_for, within_field
from pyklip_diffrender.wavefront.opd import OUTDATED_DAYS, opd_for
from pyklip_diffrender.wavefront.opd_map import OPDMap

# The result of a reduction.

_ALIGNMENT_STEPS = 4
"""Steps of the alignment with which bright sources beyond the fitted pixels are looked for."""

_UNEXPLAINED_CHI2 = 4.0
"""Chi-squared per pixel above which more is missing than what real frames leave where the detector
pattern is known: at most 1.6 for stars without a disk, 5 to 32 for AU Mic."""

_HOPELESS_CHI2 = 100.0
"""Chi-squared per pixel that no disk explains: the star is misplaced, or the set-up is wrong."""


@dataclass(frozen=True, eq=False)
class ReductionResult:
    """Result of a reduction; `Reduction` documents its attributes, and writes them."""

    sequence: ExposureSequence
    fit: Refinement
    detection: Detection
    references: tuple[Refinement, ...] = ()
    pattern: DetectorPattern | None = None
    failed: tuple[tuple[str, str], ...] = ()
    pattern_origin: str = "none"
    visit: Visit = field(default_factory=Visit)
    wide: WideField | None = None
    disk: Disk | None = None
    injections: QTable | None = None
    completeness: QTable | None = None
    accuracy: str = ReduceOptions.accuracy

    @property
    def reference_frames(self) -> int:
        """Number of integrations of reference stars that wavefront or pattern were fitted to."""
        used = {each.name for each in self.visit.contributions if each.use != "not used"}
        return sum(each.count for each in self.sequence.references if each.name in used)

    @property
    def remark(self) -> str:
        """Advice about a poor fit, or about extended light; else empty."""
        if self.fit.chi2_per_pixel > _HOPELESS_CHI2:
            return (
                "The residual is so far above the noise that something basic is wrong: check that "
                "the star is behind the mask where the header says, that filter and mask are those "
                "of the header, that no frame is damaged, and the unit of the OPD map."
            )
        if self.disk is not None:
            resolution = self.detection.contrast_curve.meta["resolution_arcsec"]
            return on_extended_light(self.detection.candidates, self.disk.offsets, resolution)
        reason = self.extended
        if not reason and self.pattern is not None and self.fit.chi2_per_pixel > _UNEXPLAINED_CHI2:
            reason = "The residual is far above the noise, as it is where the star has a disk"
        if not reason:
            return ""
        return f"{reason}: repeat the reduction with the option disk."

    @cached_property
    def extended(self) -> str:
        """How the candidates are arranged like extended light, such as a disk; else empty."""
        curve = self.detection.contrast_curve
        if self.disk is not None or not len(curve):
            return ""
        resolution = curve.meta["resolution_arcsec"]
        edge = float(curve["separation"][-1].to_value("arcsec"))
        return looks_extended(self.detection.candidates, resolution, edge)

    @property
    def _status(self) -> str:
        """How the fit ended, and whether it was a first look."""
        quick = " (quick: a first look with a coarser model)" if self.accuracy == "quick" else ""
        return f"{self.fit.status}{quick}"

    def __repr__(self) -> str:
        return f"<Reduction of {self.sequence.target}: {self.fit!r}, {self.detection!r}>"

    def __str__(self) -> str:
        known = "none" if self.pattern is None else f"from {self.pattern.name}"
        references = self.visit.in_words() if self.visit.contributions else ""
        lines = (
            repr(self.sequence), self._status, f"detector pattern: {known}", references,
            str(self.search), self.remark,
        )  # fmt: skip
        return "\n".join(filter(None, lines))

    @property
    def search(self) -> Detection | WideField:
        """The search of the whole frames, if it was asked for, else of the fitted pixels."""
        return self.detection if self.wide is None else self.wide

    def _repr_html_(self) -> str:
        facts = {
            "Status": self._status,
            "Frames": f"{len(self.sequence.science)} of the target, "
            f"{len(self.sequence.references)} of reference stars",
            "Filter": self.sequence.filter,
            "Detector pattern": "none" if self.pattern is None else self.pattern.name,
        }
        if self.remark:
            facts["Remark"] = self.remark
        head = html_summary(f"Reduction of {self.sequence.target}", facts)
        return f"{head}\n{self.detection._repr_html_()}"


# From a sequence of frames to planets: reference stars, pattern, joint fit, search.

_log = logging.getLogger(__name__)


def prepare(
    sequence: ExposureSequence,
    opd: Any,
    options: ReduceOptions,
    *,
    model: OpticalSystem | None = None,
) -> Preparation:
    """Check that a sequence can be reduced, and make what the reduction starts from.

    The default model has the frames' filter and mask, and `size` pixels a side, which
    must be inside the frames. With a model, as many pixels as its detector has are fitted; those
    beyond the edges of the frames are masked. Raises as `reduce`.
    """
    wavefront = opd_for(opd, sequence.date)
    is_folder = isinstance(opd, str | os.PathLike) and Path(opd).is_dir()
    days = None if sequence.date is None else wavefront.days_after(sequence.date)
    # An older one has been warned of.
    if days is not None and abs(days) <= OUTDATED_DAYS and (remark := remark_on_map(-days)):
        _log.warning("%s", remark)

    def opd_at(date: Time | None) -> OPDMap:
        """Map nearest to a date, if there is a folder of maps."""
        return opd_for(opd, date) if is_folder and date is not None else wavefront

    if options.star_flux is not None:
        for each in sequence.science:
            require_calibrated(each)
    elif not wavefront.data.any() and sequence.science[0].is_nircam:
        _log.warning(
            "without an OPD map the star's flux, and contrasts with it, may be wrong by 40 %; "
            "give the flux with the option star_flux"
        )
    sequence = _within_field(sequence)
    if options.wide:
        require_outer_pixels(sequence.science[0], options.side)
    first, is_quick = sequence.science[0], options.accuracy == "quick"
    if model is None:
        shape = (options.side, options.side)
        coarser = coarse_arguments(first, shape) if is_quick else {}
        model = model_for(first, options.side, device=options.device, **coarser)
        cut = sequence.cutout(options.side)
    else:
        cut = sequence.cutout(model.detector.shape, beyond_edges=True)
    settings = quick_settings(cut.science[0]) if is_quick else options.settings
    science, references = (
        tuple(map(without_blurred_edges, wholes, cuts))
        for wholes, cuts in ((sequence.science, cut.science), (sequence.references, cut.references))
    )
    cut = replace(cut, science=science, references=references)
    given = options.pattern
    if isinstance(given, DetectorPattern):
        for each in science:
            require_pattern_of(given, each)
        remark = caveat(given, science[0])
        if remark:
            _log.warning("pattern %r: %s", given.name, remark)
    elif isinstance(given, PatternLibrary) and not given.matching(science[0]):
        _log.warning(
            "pattern: none of the %d patterns that were given is of other stars, these pixels, "
            "detector, mask and filter", len(given.patterns)
        )  # fmt: skip
    return Preparation(sequence, cut, model, wavefront, options, settings, opd_at)


def _within_field(sequence: ExposureSequence) -> ExposureSequence:
    """The frames without the pixels beyond the field of their mask, as in a subarray."""
    largest = sequence.science[0].shape
    science, references = (
        tuple(map(within_field, frames)) for frames in (sequence.science, sequence.references)
    )
    if science[0].shape != largest:
        _log.info(
            "frames of %d x %d pixels: of each, the %d x %d about the star are used, the field of "
            "its mask", *largest[::-1], *science[0].shape[::-1]
        )  # fmt: skip
    return replace(sequence, science=science, references=references)


def frames_in_likelihood(
    sequence: ExposureSequence, options: ReduceOptions
) -> tuple[Observation, ...]:
    """Frames of reference stars that may be fitted together with the target's."""
    # The light of a disk would have to be told from the wavefront of other stars first.
    joins = options.references == "joint" and not options.disk
    return sequence.same_epoch if joins else ()


def frames_for_pattern(
    sequence: ExposureSequence, options: ReduceOptions
) -> tuple[Observation, ...]:
    """Frames of reference stars that are fitted for the pattern, where no library has it."""
    if options.pattern == "references" or options.references == "pattern":
        return sequence.references
    if options.references == "off":
        return ()
    return sequence.references if options.disk else sequence.other_epochs


@dataclass(frozen=True, eq=False)
class Preparation:
    """A reduction that was checked and can begin."""

    # The frames, and the same cut to the fitted pixels.
    whole: ExposureSequence
    sequence: ExposureSequence
    model: OpticalSystem
    # To start from.
    wavefront: OPDMap
    options: ReduceOptions
    # Fit settings; None: the defaults of `refine`.
    settings: FitSettings | None = None
    # The wavefront to start from at another date; None for the same at all dates.
    opd_at: Callable[[Time | None], OPDMap] | None = None
    progress: bool = False
    # Gets the products so far, before the next stage begins.
    keep: Callable[[ReductionResult], object] | None = None

    def run(
        self, *, progress: bool = False, keep: Callable[[ReductionResult], object] | None = None
    ) -> ReductionResult:
        """Fit the star, search the frames, and do what else the options ask for; see `reduce`.

        `keep` gets the products so far, before the next stage begins.
        """
        with numbered_stages():
            return replace(self, progress=progress, keep=keep)._result()

    def _result(self) -> ReductionResult:
        options = self.options
        self._require_possible_flux()
        choice, fit = fit_with_pattern(
            self.sequence.science,
            self._teaching,
            self.model,
            self.wavefront,
            self._first_fit,
            pattern=options.pattern,
            settings=self.settings,
            memory=options.memory,
            progress=self.progress,
            opd_at=self.opd_at,
        )
        fit, visit, detection = self._with_references(fit, choice)
        self._say_what_is_unused(visit)
        disk: Disk | None = None
        wide: WideField | None = None
        injections: QTable | None = None
        fractions: QTable | None = None
        sequence = replace(self.sequence, science=choice.science)

        def reduction() -> ReductionResult:
            assert detection is not None
            return ReductionResult(
                sequence,
                detection.fit,
                detection,
                choice.references,
                choice.pattern,
                choice.failed,
                choice.label,
                visit,
                wide,
                disk,
                injections,
                fractions,
                options.accuracy,
            )

        def keep() -> None:
            if self.keep is not None:
                with stage("products so far"):
                    self.keep(reduction())

        if self.keep is not None or not options.disk:
            with stage("search"):
                # Where limits with and without the reference stars were compared, it was searched.
                detection = detection or self._search(fit)
        if options.disk:
            keep()
            with stage("extended light, and wavefront without it"):
                disk = fit_disk(fit, progress=self.progress)
                fit = disk.fit
            with stage("search without extended light"):
                detection = self._search(fit, disk)
        assert detection is not None
        if options.wide:
            keep()
            wide, detection, visit = self._whole_frames(detection, visit, choice)
        has_limits = bool(len(detection.contrast_curve))
        if options.injections and has_limits:
            keep()
            with stage(f"{options.injections} injected planets"):
                injections = self._inject(detection, choice, disk)
        if options.completeness and has_limits:
            keep()
            with stage("completeness"):
                fractions = completeness(detection, progress=self.progress)
        self._require_plausible(detection.fit)  # It may have been fitted with companions.
        return reduction()

    def _whole_frames(
        self, detection: Detection, visit: Visit, choice: PatternChoice
    ) -> tuple[WideField, Detection, Visit]:
        """Search the whole frames; the star is fitted again without the light of what is there."""
        whole = self.whole.science
        with stage("whole frames"):
            wide = wide_field(detection, whole)
        cleaned = wide.subtracted(whole, choice.science)
        if cleaned is not None:
            with stage("star and search without the light of sources beyond the fitted pixels"):
                fit, visit, again = self._with_references(self._fit(cleaned, choice), choice)
                detection = again or self._search(fit)
                wide = wide_field(detection, whole)
        return wide, detection, visit

    @cached_property
    def _beyond(self) -> tuple[Planet, ...]:
        """Bright sources beyond the fitted pixels, to be fitted with the star."""
        whole, cut = self.whole.science, self.sequence.science
        if not any(map(has_bright_pixels_beyond, whole, cut)):
            return ()

        def sources(science: tuple[Observation, ...]) -> tuple[list[Planet], list[Any]]:
            return sources_beyond(self._aligned(science).frames, whole, cut)

        with stage("bright sources beyond the fitted pixels"):
            _, lights = sources(cut)
            # Their light makes the star's flux wrong, and so their contrasts.
            planets, _ = sources(
                tuple(
                    replace(each, data=each.data - light)
                    for each, light in zip(cut, lights, strict=True)
                )
            )
        for each in planets:
            _log.warning(
                "a bright source beyond the fitted pixels is fitted with the star: contrast %.2g, "
                "%.2f arcsec from it",
                each.contrast, each.separation,
            )  # fmt: skip
        return tuple(planets)

    def _aligned(self, science: tuple[Observation, ...]) -> Refinement:
        """Fit place, flux and background of frames with the wavefront of the map."""
        settings = replace(
            self.settings or settings_for(science[0]),
            wavefront=False,
            companions=(),
            max_companions=0,
            companions_if_stalled=False,
            max_iterations=_ALIGNMENT_STEPS,
        )
        return refine(
            self.model,
            science,
            self.wavefront,
            settings=settings,
            start=self.options.start,
            progress=self.progress,
        )

    def _require_possible_flux(self) -> None:
        """Find a flux of the star in a mistaken unit before the wavefront is fitted."""
        stated = self.options.star_flux
        if stated is not None:
            aligned = self._aligned(self.sequence.science)
            if aligned.status.usable:
                require_agreement_of_flux(aligned, to_jansky(stated))

    def _first_fit(self, choice: PatternChoice, again: bool) -> Refinement:
        without = ", without the library's detector pattern" if again else ""
        with stage(f"wavefront{without}"):
            return self._fit(choice.science, choice)

    def _fit(self, science: Iterable[Observation], choice: PatternChoice) -> Refinement:
        """Fit the frames of the target; roughly, if reference stars are to join them."""
        options, settings = self.options, choice.settings
        if self._beyond:
            settings = settings or settings_for(choice.science[0])
            settings = replace(settings, companions=(*settings.companions, *self._beyond))
        if self._joins_early(choice):
            settings = rough_settings(settings or settings_for(choice.science[0]))
        fit = refine(
            self.model,
            tuple(science),
            self.wavefront,
            settings=settings,
            start=options.start,
            pattern=choice.pattern,
            progress=self.progress,
        )
        self._require_plausible(fit)
        fit = self._with_sources_at_edges(fit)
        if options.star_flux is None:
            return fit
        flux, error = to_jansky(options.star_flux), options.star_flux_error
        return with_star_flux(fit, flux, error, progress=self.progress)

    def _with_sources_at_edges(self, fit: Refinement) -> Refinement:
        """Fit the star again with the sources that begin just beyond the fitted pixels."""
        # A fit that has failed has no star beyond its pixels.
        usable = fit.status.usable
        sources = sources_at_edges(fit, self.whole.science) if usable else ()
        if not sources:
            return fit
        for each in sources:
            _log.info(
                "a source just beyond the fitted pixels is fitted with the star: contrast %.2g, "
                "%.2f arcsec from it", each.contrast, each.separation,
            )  # fmt: skip
        with stage("sources just beyond the fitted pixels"):
            return refine_again(fit, companions=(*fit.planets, *sources), progress=self.progress)

    @property
    def _joining(self) -> tuple[Observation, ...]:
        return frames_in_likelihood(self.sequence, self.options)

    @property
    def _teaching(self) -> tuple[Observation, ...]:
        return frames_for_pattern(self.sequence, self.options)

    def _joins_early(self, choice: PatternChoice) -> bool:
        """Whether the fit of the target alone is only the beginning of the fit of all frames."""
        # Where the pattern is known, the target alone may have the deeper limits, so it is fitted
        # to the end and both fits are searched.
        return bool(self._joining) and not is_known_beside(choice, self._joining)

    def _with_references(self, fit: Refinement, choice: PatternChoice) -> Joined:
        """Fit target and reference stars together."""
        memory = self.options.memory
        joined = with_references(
            fit,
            choice,
            self._joining,
            # A pattern of the library may describe these frames better than its linear model says.
            search=None if self._joins_early(choice) else self._search,
            memory=None if memory is None else to_bytes(memory, "memory"),
            progress=self.progress,
        )
        if joined.fit is fit and self._joins_early(choice):
            full = choice.settings or settings_for(choice.science[0])
            with stage("wavefront of the target alone"):
                whole = refine_again(
                    fit,
                    tolerance=full.tolerance,
                    adapt_prior=full.adapt_prior,
                    progress=self.progress,
                )
            joined = joined._replace(fit=whole)
        return joined._replace(visit=self._with_all_references(joined, choice))

    def _with_all_references(self, joined: Joined, choice: PatternChoice) -> Visit:
        """The use of every frame of a reference star, in the joint fit or not."""
        pattern = joined.fit.pattern
        taught = set() if pattern is None else set(pattern.provenance.get("frames", ()))
        fitted = {f.observation.name for fit in choice.references for f in fit.frames} & taught
        known = {each.name: each for each in joined.visit.contributions}
        contributions = []
        for each in self.sequence.references:
            own = known.get(each.name) or Contribution(each.name, each.target, "not used")
            if own.use == "not used" and each.name in fitted:
                is_far = any(each is one for one in self.sequence.other_epochs)
                own = replace(own, use="pattern", reason=OF_ANOTHER_EPOCH if is_far else own.reason)
            elif not own.reason and own.use == "not used":
                own = replace(own, reason=self._why_unused(each, joined.fit, choice))
            contributions.append(own)
        return replace(joined.visit, contributions=tuple(contributions))

    def _why_unused(self, reference: Observation, fit: Refinement, choice: PatternChoice) -> str:
        """Why a frame of a reference star that did not join the target taught no pattern either."""
        if not fit.status.usable:
            return "the fit of the target failed"
        failed = dict(choice.failed).get(reference.target)
        if failed is not None:
            return failed
        if not any(each is reference for each in self._teaching):
            return f"the option references is {self.options.references!r}"
        is_near = any(each is reference for each in self.sequence.same_epoch)
        where = "" if is_near else f"{OF_ANOTHER_EPOCH}, and "
        why = {
            "library": "the library knows the pattern (pattern='references' adds theirs)",
            "given": "the pattern was given",
            "off": "pattern is 'off'",
        }.get(choice.origin, "there are too few frames for a pattern, two at least")
        return where + why

    def _say_what_is_unused(self, visit: Visit) -> None:
        """Log the use of reference frames; warn if none of those that were asked for is used."""
        if not visit.contributions:
            return
        (_log.warning if visit.unused else _log.info)("%s", visit.in_words())
        named = any(row.is_named for row in self.sequence.rows if row.use == "reference")
        asked = named or self.options.pattern == "references"
        if asked and len(visit.unused) == len(visit.contributions):
            warnings.warn(
                f"{self.sequence.target}: no frame of a reference star is used: {visit.in_words()}",
                DiffrenderWarning,
                stacklevel=2,
            )

    def _require_plausible(self, fit: Refinement) -> None:
        limit = self.options.max_chi2
        if limit is not None:
            require_plausible(fit.frames[0].observation.name, fit, limit)

    def _search(self, fit: Refinement, disk: Disk | None = None) -> Detection:
        return detect(
            fit,
            threshold=self.options.threshold,
            without_limits=None if disk is None else disk.hides_points,
            progress=self.progress,
        )

    def _inject(
        self, detection: Detection, choice: PatternChoice, disk: Disk | None
    ) -> QTable | None:
        """Measure injected planets; None, with a message, where that fails."""

        def search(science: Iterable[Observation]) -> Detection:
            if disk is None:
                joined = self._with_references(self._fit(science, choice), choice)
                return joined.detection or self._search(joined.fit)
            # The fitted frames are without the light of the disk: it is put back, and fitted again
            # with the planets there.
            whole = [
                replace(frame, data=frame.data + light)
                for frame, light in zip(science, disk.light, strict=True)
            ]
            again = fit_disk(self._fit(whole, choice))
            return self._search(again.fit, again)

        try:
            return recover_planets(detection, self.options.injections, search)
        except DiffrenderError as error:  # The reduction is complete without it.
            _log.warning("no planets were injected: %s", error)
            return None
