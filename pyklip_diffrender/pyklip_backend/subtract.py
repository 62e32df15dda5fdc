"""Find the star in frames: the one step of a reduction that this package replaces."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, cast

import numpy as np
from numpy.typing import NDArray

from pyklip_diffrender.errors import DiffrenderWarning, IncompatibleSetupError
from pyklip_diffrender.io.progress import heard_by
from pyklip_diffrender.options import QUICK_SIDE, SIDE, ReduceOptions
from pyklip_diffrender.pyklip_backend.backend_settings import DiffrenderSettings
from pyklip_diffrender.pyklip_backend.fitted_star import (
    Fit,
    FittedPointing,
    Subtraction,
    counted,
)
from pyklip_diffrender.pyklip_backend.source_frames import Pointing, pointings_of
from pyklip_diffrender.scene.observation import Observation, Window
from pyklip_diffrender.scene.sequence import ExposureSequence
from pyklip_diffrender.scene.simulation import model_for
from pyklip_diffrender.wavefront.opd_map import OPDMap

if TYPE_CHECKING:
    from pyklip_diffrender.detection import Detection
    from pyklip_diffrender.optics.system import OpticalSystem
    from pyklip_diffrender.pattern import PatternRequest
    from pyklip_diffrender.refinement import Refinement

_log = logging.getLogger(__name__)


def subtract_by_refinement(
    observation: Observation,
    opd: OPDMap,
    settings: DiffrenderSettings,
    *,
    pointings: Sequence[Pointing] | None = None,
    references: Sequence[Observation] = (),
    tell: Callable[[str], None] = _log.info,
) -> Subtraction:
    """Reduce the frames as `pyklip_diffrender.reduce` does, and render the star (the default).

    `pointings` are the frames in order of time with what their files say, by default from
    `observation`; `tell` gets a line of text at every stage. Raises RefinementError for an
    implausible fit, and warns of one that has not converged.
    """
    # Frames with the same star centre and position angle, such as the integrations of one exposure,
    # are averaged; all rolls and dithers share a wavefront. The fit uses a square about the star,
    # the subtraction covers all valid pixels.
    groups = list(pointings_of(observation) if pointings is None else pointings)
    # Averaged before they are cut, as the means of files are, so that the weights are the same.
    science = tuple(group.observation.combined() for group in groups)
    model = model_of(observation, settings, science[0])
    # Takes a second to import, so only after the input has been checked.
    from pyklip_diffrender.reduction import prepare
    from pyklip_diffrender.reduction.fit_status import warn_of_status

    sequence = ExposureSequence(observation.target, science, tuple(references))
    options = _options(settings, observation, references)
    preparation = prepare(sequence, opd, options, model=model)
    tell(
        f"fitting {counted(sum(each.count for each in science), 'frame')} of "
        f"{counted(len(science), 'pointing')}"
        f"{'' if len(science) == 1 else ' together'}, {model.detector.shape[1]} x "
        f"{model.detector.shape[0]} pixels"
    )
    with heard_by(tell):
        reduction = preparation.run()
    fit, number = reduction.fit, len(reduction.detection.sources)
    tell(f"{_described(fit)}, {fit.seconds:.0f} s, detector pattern: {reduction.pattern_origin}")
    tell(f"{counted(number, 'companion')} detected")
    warn_of_status(science[0].name, fit)
    if references and not reduction.reference_frames:
        warnings.warn(
            f"{science[0].name}: the mode has RDI, but no frame of the library is used: "
            f"{reduction.visit.in_words()}",
            DiffrenderWarning,
            stacklevel=2,
        )
    cut = preparation.sequence.science
    fitted = tuple(
        FittedPointing(
            fit,
            k,
            group,
            _window(group.observation, each),
            fit.frames[k].observation.center[0] - each.center[0],
        )
        for k, (group, each) in enumerate(zip(groups, cut, strict=True))
    )
    star = np.full(observation.data.shape, np.nan)
    for part in fitted:
        star[part.pointing.frames] = part.star()
    keep = settings.keep_detected
    kept = observation.is_nircam if keep is None else keep
    if kept:
        _give_back(star, fitted, reduction.detection)
    frames = np.sort(np.concatenate([group.frames for group in groups]))
    return Subtraction(
        star,
        (Fit(tuple(map(int, frames)), fit.status.name, float(fit.chi2_per_pixel), fit),),
        "none" if reduction.pattern is None else reduction.pattern.name,
        reduction.reference_frames,
        fitted,
        reduction,
        number if kept else len(fit.companions),
    )


def _window(whole: Observation, cut: Observation) -> Window:
    """The pixels of a frame that a cutout of it has."""
    x, y = np.rint(whole.center[0] - cut.center[0]).astype(int).tolist()
    return Window(y, x, cut.shape)


def _give_back(
    star: NDArray[np.float64], fitted: Sequence[FittedPointing], detection: Detection
) -> None:
    """Take the light of candidates out of the star (n, Ny, Nx) in place, to first order."""
    # Takes a second to import.
    from pyklip_diffrender.detection.candidates import are_companions

    candidates = detection.sources
    for k in np.flatnonzero(are_companions(detection.fit, candidates))[::-1]:
        candidates = candidates.without(int(k))
    if not len(candidates):
        return
    # The star has taken J H^-1 G (their light); those that are companions of the fit, none.
    light = candidates.light(detection.templates)
    change = fitted[0].result.linear.response(light)[:, 0]
    for part in fitted:
        star[part.pointing.frames] -= part.change_in_frames(change)


def _options(
    settings: DiffrenderSettings, observation: Observation, references: Sequence[Observation]
) -> ReduceOptions:
    """Options of the reduction; settings that are None have the defaults of `reduce`."""
    from pyklip_diffrender.reduction.fit_status import MAX_CHI2

    pattern = _requested_pattern(settings, observation, references)
    return ReduceOptions(**{"max_chi2": MAX_CHI2, **settings.given, "pattern": pattern})


def _requested_pattern(
    settings: DiffrenderSettings, observation: Observation, references: Sequence[Observation]
) -> PatternRequest:
    """The pattern that is asked for; "auto" for real NIRCam frames and "off" for others by default.

    Raises IncompatibleSetupError if "references" is asked for without any.
    """
    from pyklip_diffrender.pattern import as_request

    requested = settings.pattern
    if requested is None:
        return "auto" if observation.is_nircam else "off"
    if requested == "references" and not references:
        raise IncompatibleSetupError(
            "pattern='references' needs frames of reference stars: give them to JWSTData as "
            "psflib_filepaths after register(), and RDI in the mode and psf_library= to "
            "klip_dataset"
        )
    return as_request(requested)


def _described(result: Refinement) -> str:
    """How a fit ended, in a few words."""
    return f"{result.status.name}, chi2 per pixel {result.chi2_per_pixel:.3g}"


def model_of(
    observation: Observation, settings: DiffrenderSettings, first: Observation
) -> OpticalSystem:
    """The model from the settings, else one made for the observation's filter.

    For a first look it is coarse, by the noise of the frame `first`.
    """
    if settings.model is not None:
        return cast("OpticalSystem", settings.model)
    if observation.filter is None:
        raise IncompatibleSetupError(
            f"{observation.name}: it is not known through which filter these frames were taken. "
            "Give filter='F444W', for example, or model=nircam_coronagraph(...) to register, to "
            "backend or to DiffrenderSettings"
        )
    options = dict(settings.model_options)
    if settings.pixelscale is not None:
        options = {"pixelscale": observation.pixelscale, **options}
    is_quick = settings.accuracy == "quick"
    most = QUICK_SIDE if is_quick else SIDE
    size = settings.size or min(most, *Window.holding(observation.valid).shape)
    if is_quick:
        # Takes a second to import.
        from pyklip_diffrender.refinement import coarse_arguments

        options = {**coarse_arguments(first, (size, size)), **options}
    return model_for(observation, size, **options)
