"""From a sequence of frames to planets: reference stars, systematics, joint fit, detection."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from pyklip_diffrender.detection import Detection, detect
from pyklip_diffrender.errors import DiffrenderError, IncompatibleSetupError
from pyklip_diffrender.optics.system import OpticalSystem
from pyklip_diffrender.refinement import (
    GaussNewton,
    Refinement,
    Systematics,
    known_systematics,
    refine,
)
from pyklip_diffrender.refinement.registration import register
from pyklip_diffrender.scene.observation import Observation
from pyklip_diffrender.scene.real_frames import model_for
from pyklip_diffrender.scene.sequence import Sequence
from pyklip_diffrender.wavefront.opd import OPDMap, as_opd_map

__all__ = ["Reduction", "reduce"]

_log = logging.getLogger(__name__)

_KNOWN_MODEL_ERROR = 0.002
"""Smallest model error, as a fraction of the star, where the pattern of the model's error is known
from other stars: the pattern's own error is counted apart."""


@dataclass(frozen=True, eq=False)
class Reduction:
    """Result of `reduce`.

    Attributes
    ----------
    sequence : Sequence
        What was reduced, cut to the fitted pixels.
    fit : Refinement
        All frames of the target, fitted together.
    detection : Detection
    references : tuple of Refinement
        One for each reference star.
    systematics : Systematics or None
        The pattern of the model's error that was used.
    failed : tuple of (str, str)
        Reference stars that could not be fitted, and why.
    """

    sequence: Sequence
    fit: Refinement
    detection: Detection
    references: tuple[Refinement, ...] = ()
    systematics: Systematics | None = None
    failed: tuple[tuple[str, str], ...] = ()

    def __repr__(self) -> str:
        return f"<Reduction of {self.sequence.target}: {self.fit!r}, {self.detection!r}>"

    def __str__(self) -> str:
        known = "none" if self.systematics is None else f"from {self.systematics.name}"
        return (
            f"{self.sequence!r}\n{self.fit.status.message}\n"
            f"pattern of the model's error: {known}\n{self.detection}"
        )

    def write(self, folder: str | os.PathLike[str]) -> list[Path]:
        """Write maps, tables, the fit, the systematics and a report; returns the paths."""
        from pyklip_diffrender import report

        folder = Path(folder)
        written = self.detection.write(folder)
        # With the candidates in the model if the star was refined again, so that `Detection.read`
        # measures in the same linear model.
        written.append(self.detection.fits[0].write(folder / "fit.fits"))
        if self.systematics is not None:
            written.append(self.systematics.write(folder / "systematics.fits"))
        return written + report.write_report(self, folder, written)


def reduce(
    sequence: Sequence | str | os.PathLike[str] | Iterable[str | os.PathLike[str]],
    opd: Any,
    *,
    target: str | None = None,
    filter: str | None = None,
    size: int = 80,
    systematics: Systematics | Literal["auto", "references", "off"] = "auto",
    settings: GaussNewton | None = None,
    threshold: float = 5.0,
    progress: bool = False,
) -> Reduction:
    """Search a sequence of real frames for planets.

    The pattern of the model's error on the detector's pixels comes from the package's library or,
    where that has none, from fits of the sequence's reference stars. With it, all frames of the
    target are fitted together and searched.

    Parameters
    ----------
    sequence : Sequence, or files as for `Sequence.from_files`
    opd : path, OPDMap, Quantity or array
        The wavefront to start from, as for `refine`.
    target, filter : str, optional
        See `Sequence.from_files`.
    size : int
        Side in pixels of the square about the star that is fitted.
    systematics : Systematics, "auto", "references" or "off"
        Pattern of the model's error. "auto" takes that of the library (see `known_systematics`),
        and fits the reference stars only where there is none for these pixels; "references" fits
        them in any case and uses both. With "off", or where neither has anything, the target is
        fitted without a pattern.
    settings : GaussNewton, optional
        Of the fits; default those of `refine`.
    threshold : float
        S/N of a candidate.
    progress : bool
        Show progress bars.

    Returns
    -------
    Reduction

    Raises
    ------
    DiffrenderError
        If the target cannot be fitted. A reference star that cannot be is left out.
    """
    if not isinstance(sequence, Sequence):
        sequence = Sequence.from_files(sequence, target=target, filter=filter)
    wavefront = as_opd_map(opd)
    model = model_for(sequence.science[0], size)
    sequence = sequence.cutout(size)
    common: dict[str, Any] = {"settings": settings, "progress": progress}
    references: list[Refinement] = []
    failed: list[tuple[str, str]] = []
    pattern = systematics if isinstance(systematics, Systematics) else None
    if systematics in ("auto", "references"):
        first = sequence.science[0]
        if systematics == "auto":
            pattern = known_systematics(first)
            if pattern is not None:
                sequence, pattern = _registered(sequence, pattern, model, wavefront, common)
        if pattern is None and sequence.references:
            references, failed = _fit_references(sequence, model, wavefront, common)
            pattern = known_systematics(first, references)
        _log.info("pattern of the model's error: %s", pattern)
    elif systematics != "off" and pattern is None:
        raise IncompatibleSetupError(
            f"systematics: got {systematics!r}, expected 'auto', 'references', 'off' or a "
            "Systematics"
        )
    if pattern is not None and settings is None and sequence.science[0].is_nircam:
        common["settings"] = GaussNewton.nircam(min_model_error=_KNOWN_MODEL_ERROR)
    fit = refine(model, sequence.science, wavefront, systematics=pattern, **common)
    detection = detect(fit, threshold=threshold, progress=progress)
    return Reduction(sequence, fit, detection, tuple(references), pattern, tuple(failed))


def _fit_references(
    sequence: Sequence, model: OpticalSystem, wavefront: OPDMap, common: dict[str, Any]
) -> tuple[list[Refinement], list[tuple[str, str]]]:
    """One fit for every reference star; names of those that fail, and why."""
    fits, failed = [], []
    for star, frames in _by_star(sequence.references).items():
        _log.info("reference star %s: %d frames", star, len(frames))
        try:
            fits.append(refine(model, frames, wavefront, **common))
        except DiffrenderError as error:
            _log.warning("reference star %s is left out: %s", star, error)
            failed.append((star, str(error)))
    return fits, failed


def _registered(
    sequence: Sequence,
    pattern: Systematics,
    model: OpticalSystem,
    wavefront: OPDMap,
    common: dict[str, Any],
) -> tuple[Sequence, Systematics | None]:
    """The sequence on the pixels of the library's pattern; no pattern if one frame is not."""
    frames = []
    for each in sequence.science:
        frame: Observation | None = each
        if each.first_pixel is None:
            _log.info("%s: looking for its place on the detector", each.name)
            frame = register(refine(model, each, wavefront, **common), pattern)
        if frame is None:
            _log.warning(
                "%s: the file does not say which pixels of the detector its frames show, and the "
                "known pattern of the flat field is not seen in them; it is not used", each.name
            )  # fmt: skip
            return sequence, None
        frames.append(frame)
    return replace(sequence, science=tuple(frames)), pattern


def _by_star(observations: Iterable[Observation]) -> dict[str, list[Observation]]:
    stars: dict[str, list[Observation]] = {}
    for each in observations:
        stars.setdefault(each.target, []).append(each)
    return stars
