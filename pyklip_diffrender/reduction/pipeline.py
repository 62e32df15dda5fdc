"""From a sequence of frames to planets: reference stars, pattern, joint fit, search."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

from astropy.table import QTable

from pyklip_diffrender.detection import (
    Detection,
    Disk,
    completeness,
    detect,
    fit_disk,
    recover_planets,
    require_outer_pixels,
    wide_field,
)
from pyklip_diffrender.errors import DiffrenderError
from pyklip_diffrender.io.progress import numbered_stages, stage
from pyklip_diffrender.optics.system import OpticalSystem
from pyklip_diffrender.pattern import PatternChoice, fit_with_pattern
from pyklip_diffrender.reduction.options import ReduceOptions
from pyklip_diffrender.reduction.reduction_result import Reduction
from pyklip_diffrender.reduction.verdict import require_plausible
from pyklip_diffrender.refinement import (
    Refinement,
    refine,
    require_calibrated,
    to_jansky,
    with_star_flux,
)
from pyklip_diffrender.scene.observation import Observation
from pyklip_diffrender.scene.real_frames import model_for
from pyklip_diffrender.scene.sequence import Sequence
from pyklip_diffrender.wavefront.map_choice import wavefront_for
from pyklip_diffrender.wavefront.opd import OPDMap

__all__ = ["Preparation", "prepare", "reduce"]

_log = logging.getLogger(__name__)


def reduce(
    sequence: Sequence | str | os.PathLike[str] | Iterable[str | os.PathLike[str]],
    opd: Any,
    *,
    target: str | None = None,
    filter: str | None = None,
    progress: bool = False,
    options: ReduceOptions | None = None,
    **keywords: Any,
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
    **keywords
        Fields of `ReduceOptions`: ``size``, ``systematics``, ``settings``, ``threshold``,
        ``wide``, ``disk``, ``injections``, ``completeness``, ``star_flux``, ``star_flux_error``,
        ``device`` and ``memory``.

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
    return prepare(sequence, opd, options).run(progress=progress)


def prepare(
    sequence: Sequence,
    opd: Any,
    options: ReduceOptions,
    *,
    model: OpticalSystem | None = None,
) -> Preparation:
    """Check that a sequence can be reduced, and make what the reduction starts from.

    Parameters
    ----------
    sequence : Sequence
    opd : path, OPDMap, Quantity, array or "flat"
    options : ReduceOptions
    model : OpticalSystem, optional
        By default that of the frames' filter and mask, with `size` pixels a side, which must be
        inside the frames. With a model, as many pixels as its detector has are fitted; those beyond
        the edges of the frames are masked.

    Returns
    -------
    Preparation

    Raises
    ------
    DiffrenderError
        See `reduce`.
    """
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
    if model is None:
        model = model_for(sequence.science[0], options.size, device=options.device)
        cut = sequence.cutout(options.size)
    else:
        cut = sequence.cutout(model.detector.shape, beyond_edges=True)
    return Preparation(sequence, cut, model, wavefront, options)


@dataclass(frozen=True, eq=False)
class Preparation:
    """A reduction that was checked and can begin.

    Attributes
    ----------
    whole, sequence : Sequence
        The frames, and the same cut to the fitted pixels.
    model : OpticalSystem
    wavefront : OPDMap
        The wavefront to start from.
    options : ReduceOptions
    """

    whole: Sequence
    sequence: Sequence
    model: OpticalSystem
    wavefront: OPDMap
    options: ReduceOptions

    def run(self, *, progress: bool = False) -> Reduction:
        """Fit the star, search the frames, and do what else the options ask for; see `reduce`."""
        with numbered_stages():
            return _Run(self, progress).result()


@dataclass(frozen=True, eq=False)
class _Run:
    """The steps of a reduction."""

    preparation: Preparation
    progress: bool

    def result(self) -> Reduction:
        options, whole = self.preparation.options, self.preparation.whole.science
        choice, fit = fit_with_pattern(
            self.preparation.sequence.science,
            self.preparation.sequence.references,
            self.preparation.model,
            self.preparation.wavefront,
            self._first_fit,
            systematics=options.systematics,
            settings=options.settings,
            memory=options.memory,
            progress=self.progress,
        )
        sequence = replace(self.preparation.sequence, science=choice.science)
        disk = wide = injections = fractions = None
        if options.disk:
            with stage("extended light, and wavefront without it"):
                disk = fit_disk(fit, progress=self.progress)
                fit = disk.fit
        with stage("search"):
            detection = self._search(fit, disk)
            if options.wide:
                wide = wide_field(detection, whole)
        cleaned = None if wide is None else wide.subtracted(whole, sequence.science)
        if cleaned is not None:
            with stage("star and search without the light of sources beyond the fitted pixels"):
                fit = self._fit(cleaned, choice)
                detection = self._search(fit)
                wide = wide_field(detection, whole)
        if options.injections and len(detection.contrast_curve):
            with stage(f"{options.injections} injected planets"):
                injections = self._inject(detection, choice, disk)
        if options.completeness and len(detection.contrast_curve):
            with stage("completeness"):
                fractions = completeness(detection, progress=self.progress)
        self._require_plausible(detection.fits[0])  # It may have been fitted with companions.
        return Reduction(
            sequence,
            detection.fits[0],
            detection,
            choice.references,
            choice.systematics,
            choice.failed,
            choice.label,
            wide,
            disk,
            injections,
            fractions,
        )

    def _first_fit(self, choice: PatternChoice, again: bool) -> Refinement:
        without = ", without the library's flat-field pattern" if again else ""
        with stage(f"wavefront{without}"):
            return self._fit(choice.science, choice)

    def _fit(self, science: Iterable[Observation], choice: PatternChoice) -> Refinement:
        options = self.preparation.options
        fit = refine(
            self.preparation.model,
            tuple(science),
            self.preparation.wavefront,
            settings=choice.settings,
            start=options.start,
            systematics=choice.systematics,
            progress=self.progress,
        )
        self._require_plausible(fit)
        if options.star_flux is None:
            return fit
        flux, error = to_jansky(options.star_flux), options.star_flux_error
        return with_star_flux(fit, flux, error, progress=self.progress)

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
                return self._search(self._fit(science, choice))
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
