"""Find the star in frames: the one step of a reduction that this package replaces."""

from __future__ import annotations

import dataclasses
import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, cast

import numpy as np
from numpy.typing import NDArray

from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.pyklip_backend.pointings import Pointing, pointings_of
from pyklip_diffrender.pyklip_backend.references import References, pattern_for
from pyklip_diffrender.pyklip_backend.settings import DiffrenderSettings
from pyklip_diffrender.pyklip_backend.verdict import (
    require_plausible,
    warn_of_status,
)
from pyklip_diffrender.pyklip_backend.windows import Window, extent
from pyklip_diffrender.scene.detector_pixels import shift_frames
from pyklip_diffrender.scene.observation import Observation
from pyklip_diffrender.scene.real_frames import model_for
from pyklip_diffrender.wavefront.opd import OPDMap

if TYPE_CHECKING:
    from pyklip_diffrender.optics.system import OpticalSystem
    from pyklip_diffrender.refinement import FrameFit, Refinement

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
        The pattern of the model's error that was used, in words.
    references : int
        Number of frames of reference stars that were used.
    """

    star: NDArray[np.float64]
    method: str
    seed: int
    fits: tuple[Fit, ...]
    systematics: str = "none"
    references: int = 0

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
    references: References | None = None,
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
    references : References, optional
        Frames of reference stars.
    tell : callable
        Called with a line of text at every stage.

    Raises
    ------
    IncompatibleSetupError
        If there is neither a model nor a filter to make one for, or for `keep_detected` with a
        method that `detect` cannot use.
    RefinementError
        If a refinement has no usable or no plausible result.

    Warns
    -----
    DiffrenderWarning
        If a fit has not converged to a model that explains the data.
    """
    model = model_of(observation, settings)
    # Takes a second to import, so only after the input has been checked.
    from pyklip_diffrender.refinement import Adam, refine

    seed = SEED if settings.seed is None else settings.seed
    groups = list(pointings_of(observation) if pointings is None else pointings)
    windows = [Window.about(g.observation.center[0], model.detector.shape) for g in groups]
    cut = [window.of(group.observation) for window, group in zip(windows, groups, strict=True)]
    references = References() if references is None else references
    pattern = pattern_for(cut, references, model, opd, settings, tell)
    adam = isinstance(settings.fit, Adam)
    # The Adam recipe takes one observation at a time.
    together = [(k,) for k in range(len(groups))] if adam else [tuple(range(len(groups)))]
    tell(
        f"fitting {_counted(len(observation), 'frame')} of {_counted(len(groups), 'pointing')}"
        f"{'' if adam or len(groups) == 1 else ' together'}, {model.detector.shape[1]} x "
        f"{model.detector.shape[0]} pixels, pattern of the model's error: {pattern.label}"
    )
    results: list[Refinement] = []
    for chosen in together:
        name = cut[chosen[0]].name
        result = refine(
            model,
            [pattern.science[k] for k in chosen],
            opd,
            settings=pattern.settings,
            start=settings.start,
            systematics=pattern.systematics,
            plan="auto" if settings.plan is None else settings.plan,
            seed=seed,
        )
        require_plausible(name, result, settings.max_chi2)
        tell(f"{_described(result)}, {result.seconds:.0f} s")
        results.append(result)
    keep = settings.keep_detected
    if (observation.is_nircam and not adam) if keep is None else keep:
        results = _with_companions(results, tell)
    star = np.full(observation.data.shape, np.nan)
    fits = []
    for chosen, result in zip(together, results, strict=True):
        # It may have been refined again with companions.
        require_plausible(cut[chosen[0]].name, result, settings.max_chi2)
        warn_of_status(cut[chosen[0]].name, result)
        for k, frame in zip(chosen, result.frames, strict=True):
            away = frame.observation.center[0] - cut[k].center[0]
            star[groups[k].frames] = _star_everywhere(result, frame, groups[k], windows[k], away)
        frames = np.sort(np.concatenate([groups[k].frames for k in chosen]))
        status = result.status.name.lower()
        fits.append(Fit(tuple(map(int, frames)), status, float(result.chi2_per_pixel), result))
    return Subtraction(
        star, results[0].method, seed, tuple(fits), pattern.label, pattern.reference_frames
    )


def _described(result: Refinement) -> str:
    """How a fit ended, in a few words."""
    return f"{result.status.name.lower()}, chi2 per pixel {result.chi2_per_pixel:.3g}"


def _counted(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"


def _with_companions(results: list[Refinement], tell: Callable[[str], None]) -> list[Refinement]:
    """Refine again with the companions that are detected in all fits together."""
    from pyklip_diffrender.detection import detect
    from pyklip_diffrender.detection.relinearise import lacks_candidates, with_companions

    # No relinearisation: the fits are refined again below.
    tell("searching for companions")
    detection = detect(results, relinearise=math.inf)
    logger.info("companions kept out of the star: %s", detection.table)
    number = _counted(len(detection.candidates), "companion")
    if not lacks_candidates(results, detection.candidates):
        tell(f"{number} detected, as many as the fit has")
        return results
    tell(f"{number} detected, {len(results[0].companions)} in the fit: the star is fitted again")
    results = with_companions(results, detection.candidates)
    tell(_described(results[0]))
    return results


def _star_everywhere(
    result: Refinement,
    frame: FrameFit,
    pointing: Pointing,
    window: Window,
    away: NDArray[np.float64],
) -> NDArray[np.float64]:
    """The star over all valid pixels of the frames, (ny, nx), NaN elsewhere.

    The fitted wavefront is rendered on a larger detector. A model whose field of view cannot be
    changed covers the fitted square only.

    Parameters
    ----------
    result : Refinement
    frame : FrameFit
        The part of the result for this pointing.
    pointing : Pointing
    window : Window
        The fitted square.
    away : ndarray, (2,)
        x, y in pixels by which the fitted frames were moved onto the pixels of the detector.
    """
    group, box = pointing.observation, extent(pointing.observation)
    moved = bool(np.abs(away).max() > 0)
    if box not in window and "fov_pixels" in result.model.adjustable:
        x, y = group.center[0] + away - (box.x, box.y)
        star = frame.render(fov_pixels=box.shape, center=(x, y), background=False)
        if result.systematics is not None:
            origin = frame.observation.first_pixel
            if origin is not None:
                origin = (origin[0] - window.x, origin[1] - window.y)
            pixels = box.of(
                dataclasses.replace(group, center=group.center + away, first_pixel=origin)
            )
            star = star * (1 + result.systematics.at(pixels)[0])
        place, star = box, star + float(frame.values["background"][0])
    else:
        if box not in window:
            logger.warning(
                "%s: the model's field of view cannot be changed; pixels outside its %d x %d are "
                "NaN", group.name, window.shape[1], window.shape[0],
            )  # fmt: skip
        place, star = window, np.asarray(frame.star)
    if moved:
        star = shift_frames(star[np.newaxis], -away[np.newaxis])[0]
    return place.paste(star, group.shape)


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
    size = settings.fit_pixels or min(FIT_PIXELS, *extent(observation).shape)
    return model_for(observation, size, **options)
