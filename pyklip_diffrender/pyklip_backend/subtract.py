"""Find the star in frames: the one step of a reduction that this package replaces."""

from __future__ import annotations

import dataclasses
import logging
import math
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
    observation: Observation, opd: OPDMap, settings: DiffrenderSettings
) -> Subtraction:
    """Refine the wavefront until the rendered star matches the frames (the default).

    Frames with the same star centre and position angle, such as the integrations of one
    exposure, share a fit; each roll and dither gets its own. The fit uses a square about the star,
    the subtraction covers all valid pixels.

    Raises
    ------
    IncompatibleSetupError
        If there is neither a model nor a filter to make one for, or for `keep_detected` with a
        method that `detect` cannot use.
    RefinementError
        If a refinement has no usable result.
    """
    model = model_of(observation, settings)
    # Takes a second to import, so only after the input has been checked.
    from pyklip_diffrender.refinement import refine

    seed = SEED if settings.seed is None else settings.seed
    groups = _groups(observation)
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
        star[frames] = _star_everywhere(result, group, window)
        fits.append(Fit(tuple(map(int, frames)), status, float(result.chi2_per_pixel), result))
    return Subtraction(star, results[0].method, seed, tuple(fits))


def _with_companions(results: list[Refinement]) -> list[Refinement]:
    """Refine again with the companions that are detected in all fits together."""
    from pyklip_diffrender.detection import detect
    from pyklip_diffrender.detection.relinearise import lacks_candidates, with_companions

    # No relinearisation: the fits are refined again below.
    detection = detect(results, relinearise=math.inf)
    logger.info("companions kept out of the star: %s", detection.table)
    if not lacks_candidates(results, detection.candidates):
        return results
    return with_companions(results, detection.candidates)


def _groups(observation: Observation) -> list[tuple[NDArray[np.intp], Observation]]:
    """Frames with the same star centre and position angle, with their indices."""
    known = observation.position_angles
    angles = np.zeros(len(observation)) if known is None else known
    keys = np.round(np.column_stack([observation.center, angles]), 6)
    _, first, group = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    groups = []
    for g in np.argsort(first):
        frames = np.flatnonzero(group.ravel() == g)
        part = dataclasses.replace(
            observation,
            data=observation.data[frames],
            error=observation.error[frames],
            valid=observation.valid[frames],
            center=observation.center[frames],
            position_angles=angles[frames],
        )
        groups.append((frames, part))
    return groups


def _star_everywhere(result: Refinement, group: Observation, window: Window) -> NDArray[np.float64]:
    """The star over all valid pixels of the frames, (ny, nx), NaN elsewhere.

    The fitted wavefront is rendered on a larger detector. A model whose field of view cannot be
    changed covers the fitted square only.
    """
    box = extent(group)
    frame = result.frames[0]
    if box not in window and "fov_pixels" in result.model.adjustable:
        x, y = group.center[0] - (box.x, box.y)
        star = frame.render(fov_pixels=box.shape, center=(x, y), background=False)
        if result.systematics is not None:
            star = star * (1 + result.systematics.at(box.of(group))[0])
        return box.paste(star + float(frame.values["background"][0]), group.shape)
    if box not in window:
        logger.warning(
            "%s: the model's field of view cannot be changed; pixels outside its %d x %d are NaN",
            group.name, window.shape[1], window.shape[0],
        )  # fmt: skip
    return window.paste(np.asarray(frame.star), group.shape)


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
