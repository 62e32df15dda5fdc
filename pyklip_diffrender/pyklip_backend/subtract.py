"""The star in frames: how it is found, the one step of a reduction that this package replaces."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pyklip_diffrender.errors import DiffrenderWarning, IncompatibleSetupError
from pyklip_diffrender.io.progress import counted, heard_by
from pyklip_diffrender.io.units import ARCSEC
from pyklip_diffrender.options import QUICK_SIDE, SIDE, ReduceOptions
from pyklip_diffrender.pyklip_backend.backend_settings import DiffrenderSettings
from pyklip_diffrender.pyklip_backend.source_frames import Pointing, pointings_of
from pyklip_diffrender.scene.aligned_frames import shift_frames
from pyklip_diffrender.scene.observation import Observation, Window
from pyklip_diffrender.scene.sequence import ExposureSequence
from pyklip_diffrender.scene.simulation import field_of, model_for
from pyklip_diffrender.wavefront.opd_map import OPDMap

if TYPE_CHECKING:
    from pyklip_diffrender.detection import Detection
    from pyklip_diffrender.optics.system import OpticalSystem
    from pyklip_diffrender.reduction.pipeline import ReductionResult
    from pyklip_diffrender.refinement import FrameFit, Refinement


_log = logging.getLogger(__name__)

Image = NDArray[np.float64]

# One pointing of a fit: the star, and other sources, on the pixels of its frames.


@dataclass(frozen=True, eq=False)
class FittedPointing:
    """The part of a fit that belongs to one pointing."""

    result: Refinement
    index: int  # place of the pointing among the frames of the fit
    pointing: Pointing
    window: Window  # the fitted square
    # (2,), x, y in pixels by which the fitted frames were moved onto the pixels of the detector.
    away: Image

    def __repr__(self) -> str:
        return f"<FittedPointing: {self.pointing!r}, {self.result!r}>"

    @property
    def frame(self) -> FrameFit:
        """The star in the frames of the pointing."""
        return self.result.frames[self.index]

    @cached_property
    def box(self) -> Window:
        """Pixels that can be rendered: the valid ones in the field of the mask, or those fitted."""
        # The fitted wavefront can be rendered on a larger detector if the model's field can be
        # changed.
        observation = self.pointing.observation
        field = field_of(observation)
        inside = np.isfinite(field.paste(np.zeros(field.shape), observation.shape))
        box = Window.holding(observation.valid & inside)
        adjustable = "fov_pixels" in self.result.model.adjustable
        return box if box not in self.window and adjustable else self.window

    def star(self) -> Image:
        """The star over all pixels that can be rendered, (Ny, Nx) of the frame, NaN elsewhere."""
        # A fit ends where further steps gain less than the noise. How much of a faint planet it has
        # taken for star by then depends on where it stopped. So the last step of the linear model
        # is added, which is a small part of the noise, and after which every fit has taken as much
        # as the exact solution.
        return self._fitted_star() + self._last_step()

    def _fitted_star(self) -> Image:
        """The star as the fit has left it."""
        group, window, box = self.pointing.observation, self.window, self.box
        if box is not window:
            star = self._rendered(box, None)
            if self.result.pattern is not None:
                origin = self.frame.observation.first_pixel
                if origin is not None:
                    origin = (origin[0] - window.x, origin[1] - window.y)
                moved = replace(group, center=group.center + self.away, first_pixel=origin)
                pixels = moved.within(box)
                star = star * (1 + self.result.pattern.at(pixels)[0])
            return self.paste(star + float(self.frame.values["background"][0]), box)
        if Window.holding(group.valid) not in window:
            _log.warning(
                "%s: the model's field of view cannot be changed; pixels outside its %d x %d are "
                "NaN", group.name, window.shape[1], window.shape[0],
            )  # fmt: skip
        return self.paste(np.asarray(self.frame.star), window)

    def change_of_star(self, change: Tensor) -> Image:
        """Change of the star, (ny, nx) of the fitted square, for `change` (unknowns,).

        Changes of companions do not count.
        """
        linear = self.result.linear
        star = torch.tensor([unknown.name != "companions" for unknown in linear.unknowns])
        change = torch.where(star, change, 0.0)
        return np.asarray(linear.frames[self.index].image(change[:, None])[0].numpy())

    def change_in_frames(self, change: Tensor) -> Image:
        """Change of the star in the frames, (Ny, Nx); only background outside the square."""
        background = sum(
            float(value)
            for unknown, value in zip(self.result.linear.unknowns, change, strict=True)
            if unknown.name == "background" and unknown.frame in (-1, self.index)
        )
        star = self.paste(self.change_of_star(change), self.window)
        return np.where(np.isnan(star), background, star)

    def _last_step(self) -> Image:
        """Change of the star by the linear model's solution, (Ny, Nx)."""
        # Takes a second to import.
        from pyklip_diffrender.refinement import Status

        # Before a fit has converged, its linear model may not be good for so long a step.
        if self.result.status is Status.ITERATION_LIMIT:
            return np.zeros(self.pointing.observation.shape)
        return self.change_in_frames(self.result.linear.step)

    def source(self, offset: Image, box: Window) -> Image:
        """A source as bright as the star on the pixels of `box` as they were fitted, (ny, nx).

        `offset` is x, y in pixels from the star's place in the header.
        """
        return self._rendered(box, self.position(offset))

    def position(self, offset: Image) -> tuple[float, float]:
        """Position on the model's axes, arcsec, of a place in pixels from the header's star."""
        detector = self.frame.model.detector
        place = self.frame.observation.center[0] + offset
        x, y = (
            float(axis[: detector.oversample].mean()) / ARCSEC + pixels * scale
            for axis, pixels, scale in zip(
                detector.axes(self.frame.optical_values), place, detector.pixelscale, strict=True
            )
        )
        return x, y + detector.shear * x

    def from_star(self, offset: Image) -> Image:
        """x, y in arcsec from the fitted star, of a place in pixels from the header's star."""
        star = self.frame.optical_values.get("star_offset", torch.zeros(2))
        return np.subtract(self.position(offset), star.cpu().numpy())

    @property
    def resolution(self) -> float:
        """lambda/D, arcsec."""
        return self.frame.model.resolution

    def _rendered(self, box: Window, source: tuple[float, float] | None) -> Image:
        x, y = self.pointing.observation.center[0] + self.away - (box.x, box.y)
        return self.frame.render(
            fov_pixels=box.shape, center=(x, y), background=False, source=source
        )

    def mean_light(self, light: Image) -> Image:
        """Average light in all frames, (n, Ny, Nx), as the fit averages the frames: (ny, nx)."""
        group = self.pointing.observation
        # sum_k w_k light_k / sum_k w_k with w = 1 / error^2, which is 0 for pixels that are not
        # valid.
        weight = np.where(group.valid, group.error, np.inf) ** -2.0
        total = np.sum(weight * np.nan_to_num(light[self.pointing.frames]), axis=0)
        return self.cut(total / np.maximum(weight.sum(axis=0), np.finfo(float).tiny))

    def cut(self, image: Image) -> Image:
        """Cut the fitted square out of a frame, as it was fitted: (ny, nx)."""
        cut = self.window.cut(image[np.newaxis], 0.0)
        if np.abs(self.away).max() > 0:
            cut = shift_frames(cut, self.away[np.newaxis])
        return np.asarray(cut[0])

    def paste(self, image: Image, box: Window) -> Image:
        """Move an image of a box back to where the frames have it: (Ny, Nx), NaN elsewhere."""
        if np.abs(self.away).max() > 0:
            image = shift_frames(image[np.newaxis], -self.away[np.newaxis])[0]
        return box.paste(image, self.pointing.observation.shape)


@dataclass(frozen=True, eq=False)
class Fit:
    """One fit of the star, to some of the frames."""

    frames: tuple[int, ...]  # their indices
    status: str  # how the fit ended
    chi2: float  # per fitted pixel
    result: Any = None  # for `detect`; a `Refinement` by default


@dataclass(frozen=True, eq=False)
class Subtraction:
    """The star in the frames of a dataset."""

    # (n, ny, nx), star and uniform background to subtract, in the unit and on the pixels of the
    # observation; NaN outside the model's field.
    star: NDArray[np.float64]
    # At least one; together they cover all frames.
    fits: tuple[Fit, ...]
    # Name of the pattern that was used.
    pattern: str = "none"
    # Number of frames of reference stars that were used.
    references: int = 0
    # The parts of the fits, one for each pointing; empty for other subtractors.
    pointings: tuple[FittedPointing, ...] = ()
    # Fit, search and extended light, as `reduce` has them; None for other subtractors.
    reduction: ReductionResult | None = None
    # Number of candidates whose light was kept out of the star.
    kept: int = 0

    def __repr__(self) -> str:
        fits = "; ".join(f"{fit.status}, chi2/pixel {fit.chi2:.3g}" for fit in self.fits)
        return (
            f"<Subtraction: {counted(len(self.star), 'frame')}, {fits}, detector pattern "
            f"{self.pattern}>"
        )

    @property
    def worst(self) -> Fit:
        """The fit with the largest chi2."""
        return max(self.fits, key=lambda fit: fit.chi2)


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
    from pyklip_diffrender.reduction.pipeline import prepare
    from pyklip_diffrender.reduction.remarks import warn_of_status

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
    tell(
        f"{fit.status.name}, chi2 per pixel {fit.chi2_per_pixel:.3g}, {fit.seconds:.0f} s, "
        f"detector pattern: {reduction.pattern_origin}"
    )
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
    """Options of the reduction; settings that are None have the defaults of `reduce`.

    The pattern is by default "auto" for real NIRCam frames and "off" for others. Raises
    IncompatibleSetupError if "references" is asked for without any.
    """
    from pyklip_diffrender.reduction.remarks import MAX_CHI2

    pattern = settings.pattern
    if pattern is None:
        pattern = "auto" if observation.is_nircam else "off"
    elif pattern == "references" and not references:
        raise IncompatibleSetupError(
            "pattern='references' needs frames of reference stars: give them to JWSTData as "
            "psflib_filepaths after register(), and RDI in the mode and psf_library= to "
            "klip_dataset"
        )
    return ReduceOptions(**{"max_chi2": MAX_CHI2, **settings.given, "pattern": pattern})


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
