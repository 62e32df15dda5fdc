"""From a sequence of frames to planets: reference stars, pattern, joint fit, search."""

from __future__ import annotations

import logging
import math
import os
import warnings
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any, Unpack

from astropy.table import QTable

from pyklip_diffrender.detection import (
    Detection,
    Disk,
    WideField,
    completeness,
    detect,
    fit_disk,
    recover_planets,
    require_outer_pixels,
    wide_field,
)
from pyklip_diffrender.errors import (
    DiffrenderError,
    DiffrenderWarning,
    RefinementError,
)
from pyklip_diffrender.io.progress import numbered_stages, stage
from pyklip_diffrender.io.units import to_bytes
from pyklip_diffrender.optics.system import OpticalSystem
from pyklip_diffrender.options import ReduceKeywords, ReduceOptions
from pyklip_diffrender.pattern import (
    PatternChoice,
    as_request,
    choose_systematics,
    fit_with_pattern,
    with_known_pattern,
)
from pyklip_diffrender.reduction.products import Checkpoint, ProductFolder, Reduction
from pyklip_diffrender.reduction.reference_star import reference_star_in
from pyklip_diffrender.reduction.visit import Joined, rough_settings, with_references
from pyklip_diffrender.refinement import (
    GaussNewton,
    Refinement,
    quick_settings,
    refine,
    refine_again,
    require_calibrated,
    settings_for,
    to_jansky,
    with_star_flux,
)
from pyklip_diffrender.scene.observation import Observation
from pyklip_diffrender.scene.sequence import Sequence
from pyklip_diffrender.scene.simulation import coarse_arguments, model_for
from pyklip_diffrender.wavefront.opd import OPDMap, wavefront_for

__all__ = [
    "MAX_CHI2",
    "Preparation",
    "prepare",
    "reduce",
    "require_plausible",
    "warn_of_status",
]


# Whether a fit may be subtracted, and what to say about one that has not converged.

MAX_CHI2 = 100.0
"""Default of the largest reduced chi-squared of a plausible fit. Fits of real frames have 0.5 to 6,
12 with a bright disk; with a star in the wrong place it is in the thousands."""

_ADVICE = {
    "MODEL_MISMATCH": (
        "check the filter, the masks and the date of the wavefront map. Where the flat-field "
        "pattern is not known, add reference frames (systematics='references'); for a star with a "
        "disk, set disk=True"
    ),
    "PRIOR_MISMATCH": (
        "take a wavefront map nearer in time, or let the scales of the prior be fitted "
        "(WavefrontPrior(fit_scales=True))"
    ),
    "ITERATION_LIMIT": (
        "the best iterate was subtracted. Raise max_iterations, for example "
        "fit=GaussNewton.nircam(max_iterations=80)"
    ),
}


def require_plausible(name: str, result: Refinement, limit: float) -> None:
    """Raise RefinementError for a fit that failed, or has nothing to do with the frames."""
    from pyklip_diffrender.refinement.fit_result import WHAT_TO_CHECK

    if not result.status.usable:
        raise RefinementError(f"{name}: the fit ended as {result.status}", result)
    chi2 = reduced_chi2(result)
    if chi2 > limit:
        raise RefinementError(
            f"{name}: reduced chi-squared is {chi2:.3g}, above max_chi2={limit:g}: the rendered "
            f"star is not the star in these frames. {WHAT_TO_CHECK} For a companion as bright as "
            "the star's halo, give fit=GaussNewton.nircam(companions=...). max_chi2=inf subtracts "
            "whatever was fitted",
            result,
        )


def reduced_chi2(result: Refinement) -> float:
    """Chi-squared per degree of freedom, or per pixel where that is not known."""
    reduced = float(result.reduced_chi2)
    return reduced if math.isfinite(reduced) else float(result.chi2_per_pixel)


def warn_of_status(name: str, result: Refinement) -> None:
    """Warn of a fit that is usable but has not converged, and say what to do about it."""
    advice = _ADVICE.get(result.status.name)
    if advice is not None:
        warnings.warn(
            f"{name}: the fit ended as {result.status} (chi-squared per pixel "
            f"{result.chi2_per_pixel:.3g}). What to do: {advice}. See "
            "'Reading a status' in the documentation",
            DiffrenderWarning,
            stacklevel=2,
        )


# From a sequence of frames to planets: reference stars, pattern, joint fit, search.

_log = logging.getLogger(__name__)


def reduce(
    sequence: Sequence | str | os.PathLike[str] | Iterable[str | os.PathLike[str]],
    opd: Any,
    *,
    target: str | None = None,
    filter: str | None = None,
    progress: bool = False,
    options: ReduceOptions | None = None,
    output: str | os.PathLike[str] | None = None,
    overwrite: bool = False,
    resume: bool = False,
    **keywords: Unpack[ReduceKeywords],
) -> Reduction:
    """Search a sequence of real frames for planets.

    The flat-field pattern, the error of the model on the detector's pixels, comes from the
    package's library or, where that has none, from fits of the sequence's reference stars. With
    it, all frames of the target are fitted together and searched.

    Parameters
    ----------
    sequence : Sequence, or files as for `Sequence.from_files`
    opd : path, OPDMap, Quantity, array or "flat"
        The wavefront to start from, as for `refine`. Of a folder of maps, the one nearest in time
        to the target's frames is taken; see `choose_map` for other rules. "flat" is for frames
        without a map: the fit then takes longer, and the star's flux is uncertain by 40 % unless
        `star_flux` says it.
    target, filter : str, optional
        See `Sequence.from_files`.
    progress : bool
        Show progress bars.
    options : ReduceOptions, optional
        Options of the reduction, in place of `keywords`.
    output : path, optional
        Folder for the products, as those of `Reduction.write`. They are written as they come: those
        of the fit and the search before wide, disk, injections and completeness begin.
    overwrite : bool
        Replace the products of an earlier reduction in `output`.
    resume : bool
        Go on with a reduction that was interrupted after its products in `output` were written
        for the first time. Frames, map and options must be the same, but for injections and
        completeness. What the frames of reference stars contributed (``Reduction.visit``) is kept;
        fits of reference stars by themselves, for a pattern (``Reduction.references``), are not.
    **keywords
        Options by name, such as ``size=120``: the fields of `ReduceOptions`.

    Returns
    -------
    Reduction

    Raises
    ------
    IncompatibleSetupError
        For options that `ReduceOptions` refuses, and for `star_flux` with frames that are not
        calibrated.
    TypeError
        For a keyword that is no option, or keywords together with `options`.
    ExistingFileError
        If there are products in `output`, and neither `overwrite` nor `resume` allows it; it is
        also an `OSError`.
    DiffrenderError
        If the target cannot be fitted. A reference star that cannot be is left out.

    Examples
    --------
    With frames and wavefront maps in folders, which the package does not contain:

    >>> import pyklip_diffrender as dr
    >>> result = dr.reduce("calints", "maps", target="HIP 65426")  # doctest: +SKIP
    >>> print(result)  # doctest: +SKIP
    """
    if options is None:
        options = ReduceOptions.from_keywords(keywords)
    elif keywords:
        raise TypeError(
            f"reduce() got options and the keywords {', '.join(keywords)}, expected one of the two"
        )
    if not isinstance(sequence, Sequence):
        sequence = Sequence.from_files(sequence, target=target, filter=filter)
    if output is None:
        if overwrite or resume:
            raise TypeError("reduce() got overwrite or resume without output, a folder")
        return prepare(sequence, opd, options).run(progress=progress)
    products = ProductFolder(output, overwrite=overwrite, resume=resume)
    reduction = prepare(sequence, opd, options).run(progress=progress, products=products)
    products.finish(reduction)
    return reduction


def prepare(
    sequence: Sequence,
    opd: Any,
    options: ReduceOptions,
    *,
    model: OpticalSystem | None = None,
) -> Preparation:
    """Check that a sequence can be reduced, and make what the reduction starts from.

    The model is by default that of the frames' filter and mask, with `size` pixels a side, which
    must be inside the frames. With a model, as many pixels as its detector has are fitted; those
    beyond the edges of the frames are masked. Raises as `reduce`.
    """
    reference = reference_star_in(opd)
    if reference is not None:
        for each in sequence.science:
            reference.require_setup_of(each)
        # What its frames say is in the prior already.
        others = tuple(each for each in sequence.references if not reference.has(each))
        sequence, opd = replace(sequence, references=others), reference.wavefront
    wavefront = wavefront_for(opd, sequence.date)
    if options.star_flux is not None:
        for each in sequence.science:
            require_calibrated(each)
    elif not wavefront.data.any() and sequence.science[0].is_nircam:
        _log.warning(
            "without a wavefront map the star's flux, and contrasts with it, may be wrong by 40 %; "
            "give the flux as star_flux (--star-flux)"
        )
    if options.wide:
        require_outer_pixels(sequence.science[0], options.size)
    first, settings, coarser = sequence.science[0], options.settings, {}
    if options.accuracy == "quick":
        settings = quick_settings(first.cutout(options.size))
        coarser = coarse_arguments(first, max(first.shape) if options.wide else options.size)
    if model is None:
        model = model_for(first, options.size, device=options.device, **coarser)
        cut = sequence.cutout(options.size)
    else:
        cut = sequence.cutout(model.detector.shape, beyond_edges=True)
    if reference is not None:
        is_open = options.systematics == "auto"
        pattern = reference.pattern_for(cut.science[0]) if is_open else None
        if options.settings is None:  # Whoever gives settings has chosen the prior.
            settings = reference.settings_for(cut.science[0], settings)
            settings = settings if pattern is None else with_known_pattern(settings)
        if pattern is not None:
            options = replace(options, systematics=pattern)
    return Preparation(sequence, cut, model, wavefront, options, settings)


@dataclass(frozen=True, eq=False)
class Preparation:
    """A reduction that was checked and can begin."""

    # The frames, and the same cut to the fitted pixels.
    whole: Sequence
    sequence: Sequence
    model: OpticalSystem
    # To start from.
    wavefront: OPDMap
    options: ReduceOptions
    # Of the fits; None for those of `refine`.
    settings: GaussNewton | None = None

    def run(self, *, progress: bool = False, products: ProductFolder | None = None) -> Reduction:
        """Fit the star, search the frames, and do what else the options ask for; see `reduce`.

        `products` gets the products as they come, and may have what an interrupted reduction has
        done.
        """
        with numbered_stages():
            return _Run(self, progress, products).result()


@dataclass(frozen=True, eq=False)
class _Run:
    """The steps of a reduction."""

    preparation: Preparation
    progress: bool
    products: ProductFolder | None = None

    def result(self) -> Reduction:
        options, whole = self.preparation.options, self.preparation.whole.science
        saved: Checkpoint | None = None
        detection: Detection | None = None
        disk: Disk | None = None
        wide: WideField | None = None
        injections: QTable | None = None
        fractions: QTable | None = None
        done: frozenset[str] = frozenset()
        if self.products is not None:
            saved = self.products.begin(
                self.preparation.sequence, self.preparation.wavefront, options
            )
        if saved is None:
            for_pattern = options.references == "pattern" or options.systematics == "references"
            for_pattern = for_pattern or (options.disk and options.references == "joint")
            choice, fit = fit_with_pattern(
                self.preparation.sequence.science,
                self.preparation.sequence.references if for_pattern else (),
                self.preparation.model,
                self.preparation.wavefront,
                self._first_fit,
                systematics=options.systematics,
                settings=self.preparation.settings,
                memory=options.memory,
                progress=self.progress,
            )
            label = choice.label
            fit, visit, detection = self._with_references(fit, choice)
        else:
            choice, label, done = self._choice(saved), saved.pattern, saved.done
            fit, visit, detection = saved.fit, saved.visit, saved.detection
            disk, injections, fractions = saved.disk, saved.injections, saved.completeness
        sequence = replace(self.preparation.sequence, science=choice.science)

        def reduction() -> Reduction:
            assert detection is not None
            return Reduction(
                sequence,
                detection.fits[0],
                detection,
                choice.references,
                choice.systematics,
                choice.failed,
                label,
                visit,
                wide,
                disk,
                injections,
                fractions,
                options.accuracy,
            )

        def keep(name: str) -> None:
            if self.products is not None and self._has_more_after(name):
                with stage(f"products after the stage {name}"):
                    self.products.keep(name, reduction(), choice)

        if saved is None and (self.products is not None or not options.disk):
            with stage("search"):
                # Where limits with and without the reference stars were compared, it was searched.
                detection = detection or self._search(fit)
            keep("search")
        if options.disk and "disk" not in done:
            with stage("extended light, and wavefront without it"):
                disk = fit_disk(fit, progress=self.progress)
                fit = disk.fit
            with stage("search without extended light"):
                detection = self._search(fit, disk)
            keep("disk")
        assert detection is not None
        if options.wide:
            with stage("whole frames"):
                wide = wide_field(detection, whole)
            cleaned = None if "wide" in done else wide.subtracted(whole, sequence.science)
            if cleaned is not None:
                with stage("star and search without the light of sources beyond the fitted pixels"):
                    fit, visit, again = self._with_references(self._fit(cleaned, choice), choice)
                    detection = again or self._search(fit)
                    wide = wide_field(detection, whole)
            if "wide" not in done:
                keep("wide")
        has_limits = bool(len(detection.contrast_curve))
        if options.injections and has_limits and not self._has(injections, options.injections):
            with stage(f"{options.injections} injected planets"):
                injections = self._inject(detection, choice, disk)
            if injections is not None:
                keep("injections")
        if options.completeness and has_limits and fractions is None:
            with stage("completeness"):
                fractions = completeness(detection, progress=self.progress)
            keep("completeness")
        self._require_plausible(detection.fits[0])  # It may have been fitted with companions.
        return reduction()

    @staticmethod
    def _has(injections: QTable | None, count: int) -> bool:
        return injections is not None and len(injections) == count

    def _has_more_after(self, name: str) -> bool:
        """Whether the options ask for stages after one."""
        options = self.preparation.options
        stages = {
            "search": True,
            "disk": options.disk,
            "wide": options.wide,
            "injections": bool(options.injections),
            "completeness": options.completeness,
        }
        later = list(stages)[list(stages).index(name) + 1 :]
        return any(stages[each] for each in later)

    def _choice(self, saved: Checkpoint) -> PatternChoice:
        """The choice of the pattern of an interrupted reduction, without fits of other stars."""
        options = self.preparation.options
        # The pattern of reference stars or of the caller was stored. That of the library is looked
        # up again, which moves the frames onto its pixels if need be.
        known = as_request(options.systematics)
        if saved.origin != "library":
            known = saved.systematics or "off"
        choice = choose_systematics(
            self.preparation.sequence.science,
            (),
            self.preparation.model,
            self.preparation.wavefront,
            systematics=known,
            settings=self.preparation.settings,
            memory=None if options.memory is None else to_bytes(options.memory, "memory"),
            progress=self.progress,
        )
        return replace(choice, settings=saved.settings, failed=saved.failed, origin=saved.origin)

    def _first_fit(self, choice: PatternChoice, again: bool) -> Refinement:
        without = ", without the library's flat-field pattern" if again else ""
        with stage(f"wavefront{without}"):
            return self._fit(choice.science, choice)

    def _fit(self, science: Iterable[Observation], choice: PatternChoice) -> Refinement:
        """Fit the frames of the target; roughly, if reference stars are to join them."""
        options, settings = self.preparation.options, choice.settings
        if self._joins_early(choice):
            settings = rough_settings(settings or settings_for(choice.science[0]))
        fit = refine(
            self.preparation.model,
            tuple(science),
            self.preparation.wavefront,
            settings=settings,
            start=options.start,
            systematics=choice.systematics,
            progress=self.progress,
        )
        self._require_plausible(fit)
        if options.star_flux is None:
            return fit
        flux, error = to_jansky(options.star_flux), options.star_flux_error
        return with_star_flux(fit, flux, error, progress=self.progress)

    @property
    def _joining(self) -> tuple[Observation, ...]:
        """Frames of reference stars that are fitted together with the target's."""
        options = self.preparation.options
        # The light of a disk would have to be told from the wavefront of other stars first.
        joins = options.references == "joint" and not options.disk
        return self.preparation.sequence.references if joins else ()

    def _joins_early(self, choice: PatternChoice) -> bool:
        """Whether the fit of the target alone is only the beginning of that of all frames."""
        # Where the library knows the pattern, the target alone may have the deeper limits, so it is
        # fitted to the end and both fits are searched.
        return bool(self._joining) and choice.origin != "library"

    def _with_references(self, fit: Refinement, choice: PatternChoice) -> Joined:
        """Fit target and reference stars together."""
        memory = self.preparation.options.memory
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
                    widen_prior=full.widen_prior,
                    progress=self.progress,
                )
            joined = joined._replace(fit=whole)
        return joined

    def _require_plausible(self, fit: Refinement) -> None:
        limit = self.preparation.options.max_chi2
        if limit is not None:
            require_plausible(fit.frames[0].observation.name, fit, limit)

    def _search(self, fit: Refinement, disk: Disk | None = None) -> Detection:
        return detect(
            fit,
            threshold=self.preparation.options.threshold,
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
            return recover_planets(detection, self.preparation.options.injections, search)
        except DiffrenderError as error:  # The reduction is complete without it.
            _log.warning("no planets were injected: %s", error)
            return None
