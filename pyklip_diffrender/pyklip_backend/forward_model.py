"""A planet's image as the subtraction leaves it: the forward model of `pyklip.fm`.

A planet adds its image p to the data. To first order in its light, the unknowns of the fit change
by H^-1 G p (see `linear.model`), and the star by the image s of that change, so that p - s is left
in the subtracted frames. Companions of the fit are unknowns too, but their light stays in the
frames: what they take of the planet's light is not subtracted. A planet that itself is a companion
of the fit loses nothing.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from astropy.io import fits
from numpy.typing import NDArray

from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.io.headers import set_keyword
from pyklip_diffrender.io.units import rotation_matrix
from pyklip_diffrender.pyklip_backend.backend_settings import DiffrenderSettings
from pyklip_diffrender.pyklip_backend.subtract import FittedPointing

if TYPE_CHECKING:
    from pyklip_diffrender.detection.error_factor import ErrorFactor
    from pyklip_diffrender.refinement import Refinement

Filter = Callable[[NDArray[Any]], NDArray[Any]]

_APERTURE_LAMBDA_D = 4.0
"""Radius in lambda/D of the circle in which the planet's image has the light of the user's PSF."""


@dataclass(frozen=True, eq=False)
class PlanetInFrame:
    """The planet in one frame, with the star's fit."""

    # (ny, nx), forward model on the pixels of the frame; NaN where there is no model.
    left: NDArray[np.float64]
    # (2,), x, y of the star in the frame.
    center: NDArray[np.float64]
    # Largest change of the star because of the planet, over the standard deviation of the star.
    taken: float
    # (2,), x, y of the planet in pixels from the star.
    offset: NDArray[np.float64]
    # Light of the planet over the star's.
    contrast: float


def is_planet(fm_class: Any) -> bool:
    """Whether an object of `pyklip.fmlib` models the image of a planet."""
    from pyklip.fmlib.fmpsf import FMPlanetPSF

    return isinstance(fm_class, FMPlanetPSF)


def check_forward_model(fm_class: Any, settings: DiffrenderSettings) -> None:
    """Raise IncompatibleSetupError for an object of `pyklip.fmlib` that is not supported."""
    from pyklip.fmlib.nofm import NoFM

    if type(fm_class) is NoFM:
        return
    if not is_planet(fm_class):
        raise IncompatibleSetupError(
            f"fm_class: {type(fm_class).__name__} is not supported by diffrender, only "
            "pyklip.fmlib.fmpsf.FMPlanetPSF and NoFM are. It models how KLIP subtracts a source "
            "from itself. For KLIP, call pyklip.fm.klip_dataset outside the backend block, without "
            "algo='diffrender' and without register(replace=True)"
        )
    if settings.injected_into is not None:
        raise IncompatibleSetupError(
            "injected_into: a planet is measured in a fit to the frames that show it. Call "
            "pyklip.fm.klip_dataset outside the block with injected_into"
        )
    if settings.subtractor is not None:
        raise IncompatibleSetupError(
            "fm_class: the forward model of a planet needs the linear model of a fit by "
            "FitSettings, which a subtractor of your own does not have"
        )


def planet_in_frames(
    fm_class: Any,
    pointings: Sequence[FittedPointing],
    frames: NDArray[np.intp],
    angles: NDArray[np.float64],
    wavelength: float,
    flipx: bool,
    filtered: Filter | None = None,
) -> dict[int, PlanetInFrame]:
    """Forward model of a planet in the frames of one wavelength, by place in `frames`, unfiltered.

    `fm_class` (`FMPlanetPSF`) has the planet and the user's PSF, which has been through `filtered`.
    `frames` (n,) are the dataset's indices of the fitted frames, which pyKLIP turns by `angles` in
    degrees counter-clockwise (`flipx` as in `pyklip.klip.rotate`). Raises RefinementError without a
    linear model.
    """
    planets = {}
    for result in dict.fromkeys(pointing.result for pointing in pointings):
        parts = [pointing for pointing in pointings if pointing.result is result]
        sources = [
            _PlanetImage.of(
                fm_class, part, float(angles[part.pointing.frames[0]]), wavelength, flipx, filtered
            )
            for part in parts
        ]
        # The frames of a pointing were averaged for the fit, so that the star has changed by the
        # image of the mean planet. It is subtracted from every frame; the planet keeps the factor
        # that `FMPlanetPSF` gives it in each.
        factors = [
            _light(fm_class, frames[part.pointing.frames], wavelength) * source.scale
            for part, source in zip(parts, sources, strict=True)
        ]
        means = [float(each.mean()) for each in factors]
        changes = _change_of_star(result, parts, sources, means)
        for part, source, factor, change in zip(parts, sources, factors, changes, strict=True):
            star = np.nan_to_num(part.paste(change, part.window))
            taken = float(np.abs(change).max() / np.std(part.frame.star))
            center = part.pointing.observation.center[0]
            for frame, of_frame in zip(part.pointing.frames, factor, strict=True):
                planets[int(frame)] = PlanetInFrame(
                    of_frame * source.image - star, center, taken, source.offset, float(of_frame)
                )
    return planets


def _light(fm_class: Any, frames: NDArray[np.intp], wavelength: float) -> NDArray[np.float64]:
    """Factor (n,) of the user's PSF in every frame, as `FMPlanetPSF` computes it."""
    spectrum = np.ravel(fm_class.spectrallib[0])
    number = np.abs(np.ravel(fm_class.input_psfs_wvs) - wavelength).argmin()
    conversion = np.asarray(fm_class.flux_conversion, dtype=float)[frames]
    return np.asarray(fm_class.dflux * conversion * spectrum[number], dtype=np.float64)


@dataclass(frozen=True, eq=False)
class _PlanetImage:
    """A planet in one pointing."""

    # (2,), x, y in pixels from the star.
    offset: NDArray[np.float64]
    # (ny, nx), the planet in the frames, as bright as the star; NaN where there is no model.
    image: NDArray[np.float64]
    # Light of the user's PSF over the light of `image`.
    scale: float

    @classmethod
    def of(
        cls,
        fm_class: Any,
        part: FittedPointing,
        angle: float,
        wavelength: float,
        flipx: bool,
        filtered: Filter | None,
    ) -> _PlanetImage:
        """Place the planet, and compare its image with the user's PSF at the same place.

        `angle` is in degrees counter-clockwise, by which pyKLIP turns the frames.
        """
        # From +x towards +y the planet is at 90 degrees + PA in the product, where east is to the
        # left, so at 90 - PA before a flip of x; pyKLIP has turned it there counter-clockwise by
        # `angle`.
        direction = np.radians(90.0 + (-1 if flipx else 1) * fm_class.pa - angle)
        offset = fm_class.sep * np.array([np.cos(direction), np.sin(direction)])
        window, center = part.window, part.frame.observation.center[0]
        ny, nx = window.shape
        x, y = center + offset
        if not (-0.5 < x < nx - 0.5 and -0.5 < y < ny - 0.5):
            raise IncompatibleSetupError(
                f"fm_class: the planet is {fm_class.sep:.1f} pixels from the star, outside the "
                f"{nx} x {ny} pixels that are fitted; give a larger size"
            )
        group, margin = part.pointing.observation, max(fm_class.input_psfs.shape[-2:])
        shape = (group.shape[0] + 2 * margin, group.shape[1] + 2 * margin)
        # With a margin, because pyKLIP cannot place a PSF that sticks out of its image.
        (users,) = fm_class.generate_models(
            shape, np.arange(shape[0] * shape[1]), [angle], [wavelength], 0, 0, 0, 0, 0,
            group.center[0] + margin, angle, wavelength, flipx, [0],
        )  # fmt: skip
        users = users.reshape(shape)[margin:-margin, margin:-margin]
        # The scale makes the rendered planet as bright as the user's PSF, both filtered alike: the
        # sums of their light within four lambda/D are equal.
        image = part.paste(part.source(offset, part.box), part.box)
        ours = np.nan_to_num(image)
        if filtered is not None:
            # As is the PSF that pyKLIP asks for.
            ours = filtered(ours)
        rows, columns = np.indices(group.shape)
        x, y = group.center[0] + offset
        pixelscale = np.sqrt(np.prod(part.frame.model.detector.pixelscale))
        radius = _APERTURE_LAMBDA_D * part.resolution / pixelscale
        # Where the user's PSF ends there is exactly nothing.
        near = (np.hypot(columns - x, rows - y) <= radius) & (users != 0)
        scale = users[near].sum() / ours[near].sum() if near.any() else 0.0
        if not (np.isfinite(scale) and scale > 0):
            raise IncompatibleSetupError(
                "fm_class: input_psfs has no light within 4 lambda/D of its middle; it must be "
                "centred on pixel (nx // 2, ny // 2)"
            )
        return cls(offset, image, float(scale))


def _change_of_star(
    result: Refinement,
    parts: Sequence[FittedPointing],
    sources: Sequence[_PlanetImage],
    factors: Sequence[float],
) -> list[NDArray[np.float64]]:
    """Light of the planet that the fit takes for star, (ny, nx) on each fitted square."""
    if _is_companion(result, parts[0], sources[0]):
        return [np.zeros(part.window.shape) for part in parts]
    # s = J H^-1 G p, the image in every frame of the change of the unknowns to which the planet's
    # light p in all frames leads; see `linear.model`.
    templates = {
        part.index: torch.from_numpy(factor * part.source(source.offset, part.window))[None]
        for part, source, factor in zip(parts, sources, factors, strict=True)
    }
    change = result.linear.response(templates)[:, 0]
    return [part.change_of_star(change) for part in parts]


def _is_companion(result: Refinement, part: FittedPointing, source: _PlanetImage) -> bool:
    """Whether the planet is one of the companions of the fit, within lambda/D."""
    if not len(result.companions):
        return False
    # Companions are relative to the fitted star in the first frame, as are the parts.
    offset = part.from_star(source.offset)
    return bool((np.hypot(*(result.companions[:, 1:] - offset).T) < part.resolution).any())


# The planet of a forward model as the linear model of the fit measures it.
#
# A fit of the product, such as `pyklip.fitpsf.FMAstrometry`, has to estimate the noise from an
# annulus about the star. The linear model knows the noise of every pixel and the self-subtraction,
# so that its values are more precise and its errors belong to the values.

_log = logging.getLogger(__name__)


def planet_cards(
    part: FittedPointing,
    planet: PlanetInFrame,
    angle: float,
    flipx: bool,
    error_factor: ErrorFactor | None = None,
) -> fits.Header:
    """Flux and position of a planet with their errors, as cards for the products.

    `part` is the pointing of the fit's first frame and `planet` the forward model there; pyKLIP
    turns it by `angle` in degrees counter-clockwise. Empty if no source is within lambda/D of the
    planet's place. The factor of the errors is, by default, measured with planet and companions
    removed.
    """
    from pyklip_diffrender.detection.candidates import (
        Candidates,
        calibration_errors,
        refine_candidates,
        with_position_of_star,
    )
    from pyklip_diffrender.detection.measurement import default_factor
    from pyklip_diffrender.detection.templates import Templates

    # A companion of the fit within lambda/D is the planet itself: it makes room for one with the
    # place and flux of the forward model, the last of the sources, which are then fitted together.
    cards = fits.Header()
    start, resolution = part.from_star(planet.offset), part.resolution
    others = Candidates.of_fit(part.result)
    for k in reversed(range(len(others))):
        if np.hypot(*(others.offsets[k].numpy() - start)) < resolution:
            others = others.without(k)
    templates = Templates(part.result)
    sources = refine_candidates(
        templates, others.with_one_more(start, planet.contrast), resolution / 2
    )
    moved = sources.offsets[-1].numpy() - start
    flux = float(sources.contrasts[-1]) / planet.contrast
    if not (np.hypot(*moved) < resolution and flux > 0):
        _log.info("no source within lambda/D of the planet of the forward model")
        return cards
    sources = with_position_of_star(templates, sources)
    # Rows and columns are contrasts, then x, then y, of all sources: of the last these are 3 x 3.
    covariance = sources.covariance.numpy().reshape(3, len(sources), 3, len(sources))[:, -1, :, -1]
    if error_factor is None:
        error_factor = default_factor(templates, sources)
    factor = float(error_factor.of(sources.offsets[-1:])[0])
    error = factor * np.sqrt(covariance[0, 0])
    snr = sources.contrasts.new_tensor(sources.snr(error_factor)[-1:])
    factors = snr.new_full(snr.shape, factor)
    calibration = float(calibration_errors(templates, sources.offsets[-1:], snr, factors)[1, 0])
    detector = part.frame.model.detector
    # From arcsec along x and y to pixels, then as pyKLIP turns the frames; east is to the left.
    pixels = np.linalg.inv([[1.0, 0.0], [detector.shear, 1.0]])
    pixels /= np.array(detector.pixelscale)[:, np.newaxis]
    turn = rotation_matrix(angle)
    turn[0] *= 1 if flipx else -1
    place = turn @ (planet.offset + pixels @ moved)
    jacobian = turn @ pixels
    deviations = factor * np.sqrt(np.diag(jacobian @ covariance[1:, 1:] @ jacobian.T))
    set_keyword(cards, "DRFMFLUX", flux)
    # Noise and the relative error of the image of the source are independent.
    flux_error = float(np.hypot(error / planet.contrast, flux * calibration))
    set_keyword(cards, "DRFMFERR", flux_error)
    set_keyword(cards, "DRFMFACT", factor)
    for axis, value, deviation in zip(("RA", "DE"), place, deviations, strict=True):
        set_keyword(cards, f"DRFM{axis}", float(value))
        set_keyword(cards, f"DRFM{axis}ER", float(deviation))
    return cards
