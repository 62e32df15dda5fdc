"""Find the star in frames: the one step of a reduction that this package replaces."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, cast

import numpy as np
from numpy.typing import NDArray

from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.pyklip_backend.backend_settings import DiffrenderSettings
from pyklip_diffrender.pyklip_backend.fitted_pointing import FittedPointing
from pyklip_diffrender.pyklip_backend.pointings import Pointing, pointings_of
from pyklip_diffrender.pyklip_backend.verdict import (
    require_plausible,
    warn_of_status,
)
from pyklip_diffrender.scene.observation import Observation
from pyklip_diffrender.scene.real_frames import model_for
from pyklip_diffrender.scene.sequence import Sequence as Frames
from pyklip_diffrender.scene.window import Window
from pyklip_diffrender.wavefront.opd import OPDMap

if TYPE_CHECKING:
    from pyklip_diffrender.detection import Disk
    from pyklip_diffrender.detection.error_factor import ErrorFactor
    from pyklip_diffrender.optics.system import OpticalSystem
    from pyklip_diffrender.pattern import PatternChoice, PatternRequest
    from pyklip_diffrender.refinement import Refinement

__all__ = ["FIT_PIXELS", "Fit", "Subtraction", "Subtractor", "subtract_by_refinement"]

logger = logging.getLogger(__name__)

FIT_PIXELS = 80
"""Default side of the fitted square: 5 arcsec, the reach of the occulter."""

SEED = 0


@dataclass(frozen=True, eq=False)
class Fit:
    """One fit of the star, to some of the frames.

    Attributes
    ----------
    frames : tuple of int
        Indices of the frames.
    status : str
        How the fit ended.
    chi2 : float
        chi2 per fitted pixel.
    result : Any
        The full result, for `detect`; a `Refinement` by default.
    """

    frames: tuple[int, ...]
    status: str
    chi2: float
    result: Any = None


@dataclass(frozen=True, eq=False)
class Subtraction:
    """The star in the frames of one wavelength.

    Attributes
    ----------
    star : ndarray
        (n, ny, nx) star and uniform background to subtract, in the unit and on the pixels of the
        observation; NaN outside the model's field.
    method : str
        Name of the method.
    seed : int
        Random seed.
    fits : tuple of Fit
        At least one; together they cover all frames.
    systematics : str
        Origin of the flat-field pattern that was used, see `PatternChoice.label`.
    references : int
        Number of frames of reference stars that were used.
    pointings : tuple of FittedPointing
        The parts of the fits, one for each pointing; empty for other subtractors.
    error_factor : ErrorFactor, optional
        By how much the S/N scatters more than it should, if companions were searched.
    disk : Disk, optional
        Extended light in the frames, which the data of the fit do not have.
    """

    star: NDArray[np.float64]
    method: str
    seed: int
    fits: tuple[Fit, ...]
    systematics: str = "none"
    references: int = 0
    pointings: tuple[FittedPointing, ...] = ()
    error_factor: ErrorFactor | None = None
    disk: Disk | None = None

    @property
    def worst(self) -> Fit:
        """The fit with the largest chi2."""
        return max(self.fits, key=lambda fit: fit.chi2)


class Subtractor(Protocol):
    """A function that renders the star in frames; it runs in the main process."""

    def __call__(
        self, observation: Observation, opd: OPDMap, settings: DiffrenderSettings
    ) -> Subtraction:
        """Fit the star in all frames of an observation.

        Parameters
        ----------
        observation : Observation
            n frames of one wavelength, each with at least one valid pixel.
        opd : OPDMap
            The wavefront map to start from.
        settings : DiffrenderSettings
            `settings.model` is the model for this wavelength.

        Raises
        ------
        DiffrenderError
            If there is no usable result; the reduction then stops and leaves no products.
        """
        ...


def subtract_by_refinement(
    observation: Observation,
    opd: OPDMap,
    settings: DiffrenderSettings,
    *,
    pointings: Sequence[Pointing] | None = None,
    references: Sequence[Observation] = (),
    tell: Callable[[str], None] = logger.info,
) -> Subtraction:
    """Refine the wavefront until the rendered star matches the frames (the default).

    All frames are fitted together: those with the same star centre and position angle, such as
    the integrations of one exposure, are averaged first, and all rolls and dithers share a
    wavefront. The fit uses a square about the star, the subtraction covers all valid pixels.

    Parameters
    ----------
    observation, opd, settings
        See `Subtractor`.
    pointings : sequence of Pointing, optional
        The frames by pointing, with what their files say; found from `observation` by default.
    references : sequence of Observation
        Frames of reference stars.
    tell : callable
        Called with a line of text at every stage.

    Raises
    ------
    IncompatibleSetupError
        If there is neither a model nor a filter to make one for, for `keep_detected` with a
        method that `detect` cannot use, or if "references" is asked for without any.
    RefinementError
        If a refinement has no usable or no plausible result.

    Warns
    -----
    DiffrenderWarning
        If a fit has not converged to a model that explains the data.
    """
    model = model_of(observation, settings)
    # Takes a second to import, so only after the input has been checked.
    from pyklip_diffrender.pattern import fit_with_pattern

    groups = list(pointings_of(observation) if pointings is None else pointings)
    whole = Frames(observation.target, tuple(group.observation for group in groups))
    windows = whole.windows(model.detector.shape)
    cut = whole.cutout(model.detector.shape, beyond_edges=True).science

    def frames_of_references() -> list[Observation]:
        tell("fitting the reference stars")
        shape = model.detector.shape
        return [each.within(Window.about(each.center[0], shape)) for each in references]

    def fit(choice: PatternChoice, again: bool) -> Refinement:
        if again:
            tell("the frames do not show the pattern of the library")
        elif references and not choice.references:
            tell("the reference frames are not needed")
        return _refined(choice, model, opd, settings, tell)

    choice, result = fit_with_pattern(
        cut,
        frames_of_references if references else (),
        model,
        opd,
        fit,
        systematics=_requested_pattern(settings, observation, references),
        settings=settings.fit,
    )
    keep, error_factor, disk = settings.keep_detected, None, None
    if settings.disk:
        from pyklip_diffrender.detection import fit_disk

        tell("fitting the extended light")
        disk = fit_disk(result)
        result = disk.fit
        tell(f"{disk}: {_described(result)}")
    if observation.is_nircam if keep is None else keep:
        result, error_factor = _with_companions(result, tell)
    star = np.full(observation.data.shape, np.nan)
    # It may have been refined again with companions.
    require_plausible(cut[0].name, result, settings.max_chi2)
    warn_of_status(cut[0].name, result)
    fitted = []
    for k, (group, window) in enumerate(zip(groups, windows, strict=True)):
        away = result.frames[k].observation.center[0] - cut[k].center[0]
        fitted.append(FittedPointing(result, k, group, window, away))
        star[group.frames] = fitted[-1].star()
    frames = np.sort(np.concatenate([group.frames for group in groups]))
    status = result.status.name.lower()
    return Subtraction(
        star,
        result.method,
        _seed_of(settings),
        (Fit(tuple(map(int, frames)), status, float(result.chi2_per_pixel), result),),
        choice.label,
        choice.reference_frames,
        tuple(fitted),
        error_factor,
        disk,
    )


def _requested_pattern(
    settings: DiffrenderSettings, observation: Observation, references: Sequence[Observation]
) -> PatternRequest:
    """Return the pattern that is asked for: real NIRCam frames get "auto", others "off".

    Raises
    ------
    IncompatibleSetupError
        If "references" is asked for without any.
    """
    from pyklip_diffrender.pattern import as_request

    requested = settings.systematics
    if requested is None:
        return "auto" if observation.is_nircam else "off"
    if requested == "references" and not references:
        raise IncompatibleSetupError(
            "systematics='references' needs frames of reference stars: give them to JWSTData as "
            "psflib_filepaths after register(), and RDI in the mode and psf_library= to "
            "klip_dataset"
        )
    return as_request(requested)


def _refined(
    choice: PatternChoice,
    model: OpticalSystem,
    opd: OPDMap,
    settings: DiffrenderSettings,
    tell: Callable[[str], None],
) -> Refinement:
    """Fit all pointings together with a pattern."""
    from pyklip_diffrender.refinement import refine

    science = choice.science
    tell(
        f"fitting {_counted(sum(map(len, science)), 'frame')} of "
        f"{_counted(len(science), 'pointing')}"
        f"{'' if len(science) == 1 else ' together'}, {model.detector.shape[1]} x "
        f"{model.detector.shape[0]} pixels, flat-field pattern: {choice.label}"
    )
    result = refine(
        model,
        science,
        opd,
        settings=choice.settings,
        start=settings.start,
        systematics=choice.systematics,
        plan="auto" if settings.plan is None else settings.plan,
        seed=_seed_of(settings),
    )
    require_plausible(science[0].name, result, settings.max_chi2)
    tell(f"{_described(result)}, {result.seconds:.0f} s")
    return result


def _seed_of(settings: DiffrenderSettings) -> int:
    return SEED if settings.seed is None else settings.seed


def _described(result: Refinement) -> str:
    """How a fit ended, in a few words."""
    return f"{result.status.name.lower()}, chi2 per pixel {result.chi2_per_pixel:.3g}"


def _counted(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"


def _with_companions(
    result: Refinement, tell: Callable[[str], None]
) -> tuple[Refinement, ErrorFactor]:
    """Refine again with the companions that are detected.

    The second value is the factor by which the errors of the search are too small.
    """
    from pyklip_diffrender.detection import detect
    from pyklip_diffrender.detection.relinearise import lacks_candidates, with_companions

    # No relinearisation: the star is refined again below.
    tell("searching for companions")
    detection = detect(result, relinearise=math.inf)
    logger.info("companions kept out of the star: %s", detection.candidates)
    number = _counted(len(detection.sources), "companion")
    if not lacks_candidates([result], detection.sources):
        tell(f"{number} detected, as many as the fit has")
        return result, detection.error_factor
    tell(f"{number} detected, {len(result.companions)} in the fit: the star is fitted again")
    (result,) = with_companions([result], detection.sources)
    tell(_described(result))
    return result, detection.error_factor


def model_of(observation: Observation, settings: DiffrenderSettings) -> OpticalSystem:
    """The model from the settings, else one made for the observation's filter.

    Raises
    ------
    IncompatibleSetupError
        If there is neither a model nor a filter.
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
    size = settings.fit_pixels or min(FIT_PIXELS, *Window.holding(observation.valid).shape)
    return model_for(observation, size, **options)
