"""From frames to the star in them: the one step of a reduction that this package replaces."""

from __future__ import annotations

import dataclasses
import logging
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, cast

import numpy as np
from numpy.typing import NDArray

from pyklip_diffrender.errors import IncompatibleSetupError, RefinementError
from pyklip_diffrender.pyklip_backend.settings import DiffrenderSettings
from pyklip_diffrender.pyklip_backend.windows import Window, extent
from pyklip_diffrender.scene.observation import Observation
from pyklip_diffrender.scene.real_frames import model_for
from pyklip_diffrender.wavefront.opd import OPDMap

if TYPE_CHECKING:
    from pyklip_diffrender.optics.system import OpticalSystem
    from pyklip_diffrender.refinement import Refinement

__all__ = ["FIT_PIXELS", "Fit", "Subtraction", "Subtractor", "subtract_by_refinement"]

logger = logging.getLogger(__name__)

FIT_PIXELS = 80
"""Side of the fitted square unless something else is asked for: 5 arcsec, the occulter's reach."""

SEED = 0


@dataclass(frozen=True, eq=False)
class Fit:
    """How the star was found in some of the frames.

    Attributes
    ----------
    frames : tuple of int
        Which.
    status : str
        How the fit ended.
    chi2 : float
        chi2 per fitted pixel.
    result : Any
        All of it, for `detect` and for a closer look; a `Refinement` by default.
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
        (n, ny, nx) what to take away, star and uniform background, in the unit and on the pixels
        of the observation; NaN where the model does not reach.
    method : str
        How it was found.
    seed : int
        What made it repeatable.
    fits : tuple of Fit
        At least one; together they cover all frames.
    """

    star: NDArray[np.float64]
    method: str
    seed: int
    fits: tuple[Fit, ...]

    @property
    def worst(self) -> Fit:
        """The fit with the largest chi2."""
        return max(self.fits, key=lambda fit: fit.chi2)


class Subtractor(Protocol):
    """Anything that renders the star in frames. It runs in the main process, never in a pool."""

    def __call__(
        self, observation: Observation, opd: OPDMap, settings: DiffrenderSettings
    ) -> Subtraction:
        """Find the star in all frames of an observation.

        Parameters
        ----------
        observation : Observation
            n frames of one wavelength, each with at least one valid pixel.
        opd : OPDMap
            The wavefront map to start from.
        settings : DiffrenderSettings
            Everything else that was asked for; `settings.model` is the one for this wavelength.

        Raises
        ------
        DiffrenderError
            If there is no usable result: the reduction stops and leaves nothing behind.
        """
        ...


def subtract_by_refinement(
    observation: Observation, opd: OPDMap, settings: DiffrenderSettings
) -> Subtraction:
    """Refine the wavefront until the rendered star matches the frames (the default).

    Frames with the same star centre and position angle, such as the integrations of one
    exposure, are explained together; each roll and dither gets its own fit. The fit uses a square
    about the star, what is subtracted covers all valid pixels.

    Raises
    ------
    IncompatibleSetupError
        If there is no model and no filter to build one for, or if companions are to be kept by a
        method that `detect` cannot use.
    RefinementError
        If a refinement has no usable result.
    """
    model = model_of(observation, settings)
    # Only now, with all input found good, the part that takes a second to import.
    from pyklip_diffrender.refinement import refine

    seed = SEED if settings.seed is None else settings.seed
    groups = list(_alike(observation))
    windows = [Window.about(group.center[0], model.detector.shape) for _, group in groups]
    results: list[Refinement] = []
    for (_, group), window in zip(groups, windows, strict=True):
        result = refine(
            model,
            window.of(group),
            opd,
            settings=settings.fit,
            start=settings.start,
            systematics=settings.systematics,
            plan="auto" if settings.plan is None else settings.plan,
            seed=seed,
        )
        if not result.status.usable:
            raise RefinementError(f"{group.name}: {result.status.message}", result)
        results.append(result)
    if settings.keep_detected:
        results = _with_companions(results)
    star = np.empty_like(observation.data)
    fits = []
    for (frames, group), window, result in zip(groups, windows, results, strict=True):
        status = result.status.name.lower()
        logger.info("%s: %s, chi2/pixel %.4g", group.name, status, result.chi2_per_pixel)
        star[frames] = _everywhere(result, group, window)
        fits.append(Fit(tuple(map(int, frames)), status, float(result.chi2_per_pixel), result))
    return Subtraction(star, results[0].method, seed, tuple(fits))


def _with_companions(results: list[Refinement]) -> list[Refinement]:
    """The fits once more, with what is detected in all of them together as companions."""
    from pyklip_diffrender.detection import detect
    from pyklip_diffrender.detection.relinearise import lacks_candidates, with_companions

    # Refined again below, faint ones too: a second S/N map in between would be for nothing.
    found = detect(results, relinearise=math.inf)
    logger.info("companions that keep their light: %s", found.table)
    if not lacks_candidates(results, found.candidates):
        return results
    return with_companions(results, found.candidates)


def _alike(observation: Observation) -> Iterator[tuple[NDArray[np.intp], Observation]]:
    """Groups of frames that see the same star through the same wavefront, with their places."""
    angles = observation.position_angles
    turns = np.zeros(len(observation)) if angles is None else angles
    keys = np.round(np.column_stack([observation.center, turns]), 6)
    _, first, group = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    for g in np.argsort(first):
        frames = np.flatnonzero(group.ravel() == g)
        yield (
            frames,
            dataclasses.replace(
                observation,
                data=observation.data[frames],
                error=observation.error[frames],
                valid=observation.valid[frames],
                center=observation.center[frames],
                position_angles=turns[frames],
            ),
        )


def _everywhere(result: Refinement, group: Observation, window: Window) -> NDArray[np.float64]:
    """The star over all valid pixels of the frames, (ny, nx), NaN elsewhere.

    The fitted wavefront is rendered on a larger detector; a model that cannot be made again with
    one is good for the fitted square only.
    """
    box = extent(group)
    inside = window.y <= box.y and window.x <= box.x
    inside &= window.y + window.shape[0] >= box.y + box.shape[0]
    inside &= window.x + window.shape[1] >= box.x + box.shape[1]
    frame = result.frames[0]
    if not inside and "fov_pixels" in result.model.adjustable:
        x, y = group.center[0] - (box.x, box.y)
        star = frame.render(fov_pixels=box.shape, center=(x, y), background=False)
        if result.systematics is not None:
            star = star * (1 + result.systematics.at(box.of(group))[0])
        return box.paste(star + float(frame.values["background"][0]), group.shape)
    if not inside:
        logger.warning(
            "%s: the model's field of view cannot be changed; pixels outside its %d x %d are NaN",
            group.name, window.shape[1], window.shape[0],
        )  # fmt: skip
    return window.paste(np.asarray(frame.star), group.shape)


def model_of(observation: Observation, settings: DiffrenderSettings) -> OpticalSystem:
    """The model that was given, else that of the coronagraph in the observation's filter.

    Raises
    ------
    IncompatibleSetupError
        If there is neither a model nor a filter.
    """
    if settings.model is not None:
        return cast("OpticalSystem", settings.model)
    if observation.filter is None:
        raise IncompatibleSetupError(
            f"{observation.name}: nothing says through which filter these frames were taken. Give "
            "filter='F444W' (say) or model=nircam_coronagraph(...) to register, to backend or to "
            "DiffrenderSettings"
        )
    options = dict(settings.model_options)
    if settings.pixelscale is not None:
        options = {"pixelscale": observation.pixelscale, **options}
    size = settings.fit_pixels or min(FIT_PIXELS, *extent(observation).shape)
    return model_for(observation, size, **options)
