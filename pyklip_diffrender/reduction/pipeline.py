"""From a sequence of frames to planets: reference stars, systematics, joint fit, detection."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from astropy import units as u
from astropy.table import QTable

from pyklip_diffrender import drawing
from pyklip_diffrender.detection import (
    Detection,
    Disk,
    WideField,
    detect,
    fit_disk,
    recover_planets,
    wide_field,
)
from pyklip_diffrender.errors import DiffrenderError, IncompatibleSetupError
from pyklip_diffrender.io.files import replacing
from pyklip_diffrender.io.html_repr import html_summary
from pyklip_diffrender.io.progress import stage
from pyklip_diffrender.io.units import require_bound, to_bytes
from pyklip_diffrender.pattern import PatternChoice, PatternRequest, fit_with_pattern
from pyklip_diffrender.refinement import (
    GaussNewton,
    Refinement,
    refine,
    require_calibrated,
    to_jansky,
    with_star_flux,
)
from pyklip_diffrender.scene.observation import Observation
from pyklip_diffrender.scene.real_frames import model_for
from pyklip_diffrender.scene.sequence import Sequence
from pyklip_diffrender.scene.systematics import Systematics
from pyklip_diffrender.wavefront.map_choice import wavefront_for

__all__ = ["Reduction", "reduce"]

_log = logging.getLogger(__name__)

_SEVERAL = 3
"""Number of candidates from which extended light is more likely than planets."""

_LARGE = 4.0
"""Chi-squared per pixel above which more is missing than what real frames leave where the pattern
of the flat field is known: at most 1.6 for stars without a disk, 5 to 32 for AU Mic."""


@dataclass(frozen=True, eq=False)
class Reduction:
    """Result of `reduce`.

    Attributes
    ----------
    sequence : Sequence
        What was reduced, cut to the fitted pixels.
    fit : Refinement
        All frames of the target, fitted together; without the light of a disk, if that was fitted.
    detection : Detection
    references : tuple of Refinement
        One for each reference star.
    systematics : Systematics or None
        The pattern of the model's error that was used.
    failed : tuple of (str, str)
        Reference stars that could not be fitted, and why.
    wide : WideField or None
        The search of the whole frames, if it was asked for.
    disk : Disk or None
        Extended light about the star, if it was asked for.
    injections : QTable or None
        What was measured of injected planets, see `recover_planets`, if it was asked for.

    Examples
    --------
    With frames and wavefront maps in folders, which the package does not contain:

    >>> import pyklip_diffrender as dr
    >>> result = dr.reduce("calints", "maps", target="HIP 65426")  # doctest: +SKIP
    >>> print(result.detection.table["separation", "contrast", "snr"])  # doctest: +SKIP
    >>> result.write("products")  # doctest: +SKIP
    """

    sequence: Sequence
    fit: Refinement
    detection: Detection
    references: tuple[Refinement, ...] = ()
    systematics: Systematics | None = None
    failed: tuple[tuple[str, str], ...] = ()
    wide: WideField | None = None
    disk: Disk | None = None
    injections: QTable | None = None

    @property
    def remark(self) -> str:
        """What to do if the frames seem to show extended light; else empty."""
        if self.disk is not None:
            return ""
        if len(self.detection.table) >= _SEVERAL:
            reason = (
                "Several candidates about one star are more often parts of a disk, or residuals of "
                "the star, than planets"
            )
        elif self.systematics is not None and self.fit.chi2_per_pixel > _LARGE:
            reason = "The residual is far above the noise, as it is where the star has a disk"
        else:
            return ""
        return f"{reason}: repeat the reduction with disk=True (--disk on the command line)."

    def __repr__(self) -> str:
        return f"<Reduction of {self.sequence.target}: {self.fit!r}, {self.detection!r}>"

    def __str__(self) -> str:
        known = "none" if self.systematics is None else f"from {self.systematics.name}"
        search = self.detection if self.wide is None else self.wide
        return (
            f"{self.sequence!r}\n{self.fit.status.message}\n"
            f"pattern of the model's error: {known}\n{search}\n{self.remark}"
        ).rstrip()

    def _repr_html_(self) -> str:
        facts = {
            "Status": self.fit.status.message,
            "Frames": f"{len(self.sequence.science)} of the target, "
            f"{len(self.sequence.references)} of reference stars",
            "Filter": self.sequence.filter,
            "Pattern of the model's error": (
                "none" if self.systematics is None else self.systematics.name
            ),
        }
        if self.remark:
            facts["Remark"] = self.remark
        head = html_summary(f"Reduction of {self.sequence.target}", facts)
        return f"{head}\n{self.detection._repr_html_()}"

    def write(self, folder: str | os.PathLike[str]) -> list[Path]:
        """Write maps, tables, the fit, the systematics and a report; returns the paths."""
        from pyklip_diffrender import report

        folder = Path(folder)
        written = self.detection.write(folder)
        # With the candidates in the model if the star was refined again, so that `Detection.read`
        # measures in the same linear model.
        written.append(self.detection.fits[0].write(folder / "fit.fits"))
        if self.wide is not None:
            written += self.wide.write(folder)
        if self.disk is not None:
            written.append(self.disk.write(folder))
        if self.systematics is not None:
            written.append(self.systematics.write(folder / "systematics.fits"))
        if self.injections is not None:
            written.append(folder / "injections.ecsv")
            with replacing(written[-1]) as temporary:
                self.injections.write(temporary, format="ascii.ecsv", overwrite=True)
        figure, axes = drawing.new_figure(1, 2)
        self.detection.plot(axes)
        written.append(folder / "detection.png")
        drawing.save(figure, written[-1])
        return written + report.write_report(self, folder, written)


def reduce(
    sequence: Sequence | str | os.PathLike[str] | Iterable[str | os.PathLike[str]],
    opd: Any,
    *,
    target: str | None = None,
    filter: str | None = None,
    size: int = 80,
    systematics: PatternRequest = "auto",
    settings: GaussNewton | None = None,
    threshold: float = 5.0,
    wide: bool = False,
    disk: bool = False,
    injections: int = 0,
    star_flux: float | str | u.Quantity | None = None,
    star_flux_error: float = 0.05,
    device: str = "cpu",
    memory: float | str | u.Quantity | None = None,
    progress: bool = False,
) -> Reduction:
    """Search a sequence of real frames for planets.

    The pattern of the model's error on the detector's pixels comes from the package's library or,
    where that has none, from fits of the sequence's reference stars. With it, all frames of the
    target are fitted together and searched.

    Parameters
    ----------
    sequence : Sequence, or files as for `Sequence.from_files`
    opd : path, OPDMap, Quantity, array or "flat"
        The wavefront to start from, as for `refine`. Of a folder of maps, the one nearest in time
        is taken; see `choose_map` for other rules. "flat" is for frames without a map: the fit
        then takes longer, and the star's flux is uncertain by 40 % unless `star_flux` says it.
    target, filter : str, optional
        See `Sequence.from_files`.
    size : int
        Side in pixels of the square about the star that is fitted.
    systematics : Systematics, "auto", "references" or "off"
        Pattern of the model's error. "auto" takes that of the library (see `known_systematics`),
        and fits the reference stars only where there is none for these pixels; "references" fits
        them in any case and uses both. A fit that shows less than half of the library's pattern is
        repeated without the library. Where nothing is known, rolls of the same pixels share a
        pattern of which only the size is known. With "off" there is no pattern.
    settings : GaussNewton, optional
        Of the fits; default those of `refine`.
    threshold : float
        S/N of a candidate.
    wide : bool
        Search the whole frames as well, see `wide_field`. If sources beyond the fitted pixels are
        bright enough to be seen in these, the star is fitted once more without their light.
    disk : bool
        Fit extended light about the star, see `fit_disk`, and search the frames without it.
    injections : int
        Number of planets to add to the fitted frames, slightly brighter than the limits, to see
        how well they are recovered; see `recover_planets`. Seven of them take as long as the
        fit and the search, fewer where the fitted square is smaller than 80 pixels.
    star_flux : float, str or Quantity, optional
        Flux density of the star in the filter, from a catalogue or a model of its spectrum: Jy, or
        an AB magnitude. Contrasts then refer to it, as spaceKLIP's do. By default the light that
        is diffracted around the mask determines the star's flux, to 10 %, which errors of
        contrasts include. Flux densities of planets do not depend on it. Takes a second, shorter
        fit.
    star_flux_error : float
        Relative error of `star_flux`, with that of the photometric calibration of the frames.
    device : str
        PyTorch device of the optical model.
    memory : float, str or Quantity, optional
        Memory that the process may take, bytes or such as "2 GB"; see `GaussNewton`, whose value
        it replaces.
    progress : bool
        Show progress bars.

    Returns
    -------
    Reduction

    Raises
    ------
    IncompatibleSetupError
        For a number of injections that is negative or not whole, for `wide` together with
        `disk` (beyond the fitted pixels a disk would be taken for point sources), and for
        `star_flux` with frames that are not calibrated.
    DiffrenderError
        If the target cannot be fitted. A reference star that cannot be is left out.

    Examples
    --------
    With frames and wavefront maps in folders, which the package does not contain:

    >>> import pyklip_diffrender as dr
    >>> result = dr.reduce("calints", "maps", target="HIP 65426")  # doctest: +SKIP
    >>> print(result)  # doctest: +SKIP
    """
    # Before the fits, which take minutes.
    require_bound(threshold, "threshold", "positive")
    require_bound(injections, "injections", "not negative")
    if injections != int(injections):
        raise IncompatibleSetupError(f"injections: got {injections}, expected a whole number")
    if wide and disk:
        raise IncompatibleSetupError(
            "got wide=True and disk=True, expected one of them: beyond the fitted pixels a disk "
            "would be taken for point sources"
        )
    jansky = None if star_flux is None else to_jansky(star_flux)
    require_bound(star_flux_error, "star_flux_error", "positive")
    limit = None if memory is None else to_bytes(memory, "memory")
    if not isinstance(sequence, Sequence):
        sequence = Sequence.from_files(sequence, target=target, filter=filter)
    wavefront = wavefront_for(opd, sequence.date)
    if jansky is not None:
        for each in sequence.science:
            require_calibrated(each)
    elif not wavefront.data.any() and sequence.science[0].is_nircam:
        _log.warning(
            "without a wavefront map the star's flux, and contrasts with it, may be wrong by 40 %; "
            "give the flux as star_flux (--star-flux)"
        )
    model = model_for(sequence.science[0], size, device=device)
    whole, cut = sequence.science, sequence.cutout(size)

    def fitted(science: tuple[Observation, ...], choice: PatternChoice) -> Refinement:
        fit = refine(
            model,
            science,
            wavefront,
            systematics=choice.systematics,
            settings=choice.settings,
            progress=progress,
        )
        if jansky is None:
            return fit
        return with_star_flux(fit, jansky, star_flux_error, progress=progress)

    def searched(science: tuple[Observation, ...]) -> Detection:
        return detect(fitted(science, choice), threshold=threshold, progress=progress)

    def first_fit(choice: PatternChoice, again: bool) -> list[Refinement]:
        without = ", without the pattern of the library" if again else ""
        with stage(f"2 of 4: wavefront{without}"):
            return [fitted(choice.science, choice)]

    choice, (fit,) = fit_with_pattern(
        cut.science,
        cut.references,
        model,
        wavefront,
        first_fit,
        systematics=systematics,
        settings=settings,
        memory=limit,
        progress=progress,
    )
    sequence = replace(cut, science=choice.science)
    extended = None
    if disk:
        with stage("2 of 4: extended light, and wavefront without it"):
            extended = fit_disk(fit, progress=progress)
            fit = extended.fit
    with stage("3 of 4: search"):
        detection = detect(fit, threshold=threshold, progress=progress)
        outside = wide_field(detection, whole) if wide else None
    cleaned = None if outside is None else outside.subtracted(whole, sequence.science)
    if cleaned is not None:
        with stage("3 of 4: star and search without the light of sources beyond the fitted pixels"):
            fit = fitted(cleaned, choice)
            detection = detect(fit, threshold=threshold, progress=progress)
            outside = wide_field(detection, whole)
    recovered = None
    if injections and len(detection.contrast_curve):
        with stage(f"3 of 4: {injections} injected planets"):
            try:
                recovered = recover_planets(detection, int(injections), searched)
            except DiffrenderError as error:  # The reduction is complete without it.
                _log.warning("no planets were injected: %s", error)
    return Reduction(
        sequence,
        fit,
        detection,
        choice.references,
        choice.systematics,
        choice.failed,
        outside,
        extended,
        recovered,
    )
