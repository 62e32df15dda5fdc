"""Find the star in frames: the one step of a reduction that this package replaces."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, cast

import numpy as np
from numpy.typing import NDArray

from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.io.progress import heard_by
from pyklip_diffrender.pyklip_backend.backend_settings import DiffrenderSettings
from pyklip_diffrender.pyklip_backend.fitted_pointing import FittedPointing
from pyklip_diffrender.pyklip_backend.pointings import Pointing, pointings_of
from pyklip_diffrender.scene.observation import Observation
from pyklip_diffrender.scene.real_frames import model_for
from pyklip_diffrender.scene.sequence import Sequence as FrameSequence
from pyklip_diffrender.scene.window import Window
from pyklip_diffrender.wavefront.opd import OPDMap

if TYPE_CHECKING:
    from pyklip_diffrender.detection import Detection
    from pyklip_diffrender.optics.system import OpticalSystem
    from pyklip_diffrender.pattern import PatternRequest
    from pyklip_diffrender.reduction import ReduceOptions, Reduction
    from pyklip_diffrender.refinement import Refinement

__all__ = ["FIT_PIXELS", "Fit", "Subtraction", "Subtractor", "subtract_by_refinement"]

logger = logging.getLogger(__name__)

FIT_PIXELS = 80
"""Default side of the fitted square: 5 arcsec, the reach of the occulter."""


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
    fits : tuple of Fit
        At least one; together they cover all frames.
    systematics : str
        Name of the flat-field pattern that was used.
    references : int
        Number of frames of reference stars that were used.
    pointings : tuple of FittedPointing
        The parts of the fits, one for each pointing; empty for other subtractors.
    reduction : Reduction, optional
        Fit, search and extended light, as `reduce` has them; None for other subtractors.
    kept : int
        Number of candidates whose light was kept out of the star.
    """

    star: NDArray[np.float64]
    fits: tuple[Fit, ...]
    systematics: str = "none"
    references: int = 0
    pointings: tuple[FittedPointing, ...] = ()
    reduction: Reduction | None = None
    kept: int = 0

    def __repr__(self) -> str:
        fits = "; ".join(f"{fit.status}, chi2/pixel {fit.chi2:.3g}" for fit in self.fits)
        return (
            f"<Subtraction: {_counted(len(self.star), 'frame')}, {fits}, flat-field pattern "
            f"{self.systematics}>"
        )

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
    """Reduce the frames as `pyklip_diffrender.reduce` does, and render the star (the default).

    All frames are fitted together: those with the same star centre and position angle, such as
    the integrations of one exposure, are averaged first, and all rolls and dithers share a
    wavefront. The fit uses a square about the star, the subtraction covers all valid pixels.

    Parameters
    ----------
    observation, opd, settings
        See `Subtractor`.
    pointings : sequence of Pointing, optional
        The frames by pointing, in order of time, with what their files say; by default the
        frames of `observation` are sorted by where they show the star.
    references : sequence of Observation
        Frames of reference stars.
    tell : callable
        Called with a line of text at every stage.

    Raises
    ------
    IncompatibleSetupError
        If there is neither a model nor a filter to make one for, or if "references" is asked for
        without any.
    RefinementError
        If a refinement has no usable or no plausible result.

    Warns
    -----
    DiffrenderWarning
        If a fit has not converged to a model that explains the data.
    """
    model = model_of(observation, settings)
    # Takes a second to import, so only after the input has been checked.
    from pyklip_diffrender.reduction import prepare
    from pyklip_diffrender.reduction.verdict import warn_of_status

    groups = list(pointings_of(observation) if pointings is None else pointings)
    science = tuple(group.observation for group in groups)
    sequence = FrameSequence(observation.target, science, tuple(references))
    options = _options(settings, observation, references)
    preparation = prepare(sequence, opd, options, model=model)
    tell(
        f"fitting {_counted(sum(map(len, science)), 'frame')} of "
        f"{_counted(len(science), 'pointing')}"
        f"{'' if len(science) == 1 else ' together'}, {model.detector.shape[1]} x "
        f"{model.detector.shape[0]} pixels"
    )
    with heard_by(tell):
        reduction = preparation.run()
    fit, number = reduction.fit, len(reduction.detection.sources)
    tell(f"{_described(fit)}, {fit.seconds:.0f} s, flat-field pattern: {reduction.pattern}")
    tell(f"{_counted(number, 'companion')} detected")
    warn_of_status(science[0].name, fit)
    windows, _ = sequence.windows(model.detector.shape)
    cut = preparation.sequence.science
    fitted = tuple(
        FittedPointing(
            fit, k, group, window, fit.frames[k].observation.center[0] - cut[k].center.mean(axis=0)
        )
        for k, (group, window) in enumerate(zip(groups, windows, strict=True))
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
        "none" if reduction.systematics is None else reduction.systematics.name,
        reduction.reference_frames,
        fitted,
        reduction,
        number if kept else len(fit.companions),
    )


def _give_back(
    star: NDArray[np.float64], fitted: Sequence[FittedPointing], detection: Detection
) -> None:
    """Take the light of candidates out of the star (n, Ny, Nx) in place, to first order.

    Those that are companions of the fit have lost nothing to the star.
    """
    # Takes a second to import.
    from pyklip_diffrender.detection.relinearise import are_companions

    candidates = detection.sources
    for k in np.flatnonzero(are_companions(detection.fits[0], candidates))[::-1]:
        candidates = candidates.without(int(k))
    if not len(candidates):
        return
    linear, templates = detection.groups[0]
    change = linear.response(candidates.light(templates))[:, 0]
    for part in fitted:
        star[part.pointing.frames] -= part.change_in_frames(change)


def _options(
    settings: DiffrenderSettings, observation: Observation, references: Sequence[Observation]
) -> ReduceOptions:
    """Options of the reduction; the settings that are None are those of `reduce`."""
    from pyklip_diffrender.reduction import ReduceOptions
    from pyklip_diffrender.reduction.verdict import MAX_CHI2

    given: dict[str, Any] = {
        "settings": settings.fit,
        "start": settings.start,
        "references": settings.references,
        "threshold": settings.threshold,
        "disk": settings.disk,
        "star_flux": settings.star_flux,
        "star_flux_error": settings.star_flux_error,
        "systematics": _requested_pattern(settings, observation, references),
        "max_chi2": MAX_CHI2 if settings.max_chi2 is None else settings.max_chi2,
    }
    return ReduceOptions(**{key: value for key, value in given.items() if value is not None})


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


def _described(result: Refinement) -> str:
    """How a fit ended, in a few words."""
    return f"{result.status.name}, chi2 per pixel {result.chi2_per_pixel:.3g}"


def _counted(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"


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
