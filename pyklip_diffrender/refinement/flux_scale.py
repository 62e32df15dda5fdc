"""The flux of the star: from that of a fit to Jansky, and from a catalogue into a fit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from astropy import units as u

from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.refinement.continuation import refine_again
from pyklip_diffrender.refinement.fit_result import Refinement
from pyklip_diffrender.refinement.frame_fit import FrameFit
from pyklip_diffrender.scene.observation import Observation

__all__ = [
    "jansky_per_unit",
    "require_calibrated",
    "star_flux_error",
    "to_jansky",
    "with_star_flux",
]

_UNTIED = 0.1
"""Relative error of the star's flux in real frames if no catalogue says it. Only diffracted light
is seen, and the prior on the wavefront decides how much of it a star has: fits with a star 10 %
brighter or fainter explain real frames nearly as well (docs/validation/real_frames.md)."""

_WITHOUT_MAP = 0.4
"""Relative error for fits that start from a flat wavefront: two rolls of G 7-34 came out 2 % too
faint in F444W, and 44 % too bright in F356W."""

_HELD = 0.003
"""Relative deviation of a star's flux from that of a catalogue. The posterior of a fit understates
the error of the flux, so that a prior as wide as the catalogue's error would hardly move it."""

_AGREES = 0.005
"""Relative difference of the star's flux from that of a catalogue that is left: a tenth of the
error of a good catalogue."""

_ROUNDS = 3
"""Most fits with the flux held, of which each starts from the one before."""

_TIGHTER = 100.0
"""Factor by which the next of these fits holds the flux more tightly."""

_BRIGHTNESS = u.MJy / u.sr


def _pixel_area(observation: Observation) -> float | None:
    """Solid angle of a pixel, sr, in the photometric calibration; None without calibration."""
    area = observation.header.get("PIXAR_SR")
    if not (observation.is_nircam and observation.unit.is_equivalent(_BRIGHTNESS)):
        return None
    return area if isinstance(area, float) and area > 0 else None


def require_calibrated(observation: Observation) -> None:
    """Refuse frames without photometric calibration.

    Raises
    ------
    IncompatibleSetupError
    """
    if _pixel_area(observation) is None:
        raise IncompatibleSetupError(
            f"star_flux: {observation.name} is not calibrated: expected a frame of NIRCam in units "
            "of surface brightness, with PIXAR_SR in its header"
        )


def jansky_per_unit(frame: FrameFit) -> float | None:
    """Flux density, Jy, of a star of flux 1 in the unit of a fit.

    The fitted flux is the light that the entrance pupil collects, in the unit of the pixels. What
    the pipeline calibrates is the light of a source far from the occulter, all of its image
    through the Lyot stop. That is the fitted flux times the transmission of the stop, times the
    solid angle of a pixel for which the pipeline calculated its surface brightness (PIXAR_SR).

    Returns
    -------
    float or None
        None for frames that are not NIRCam's, that are not in units of surface brightness, or
        whose header has no PIXAR_SR.
    """
    area = _pixel_area(frame.observation)
    if area is None:
        return None
    # A tensor, because the wavefront is complex where the pupil's amplitude was fitted.
    opd = torch.from_numpy(np.ascontiguousarray(frame.opd))
    transmission = frame.model.transmission(opd, **frame.optical_values)
    return float(transmission * area * frame.observation.unit.to(_BRIGHTNESS) * 1e6)


def to_jansky(star_flux: float | str | u.Quantity) -> float:
    """Flux density of a star in Jy, from a number of Jy, a Quantity, an AB magnitude or text.

    Raises
    ------
    IncompatibleSetupError
        For anything that is not a positive flux density.
    """
    try:
        value = star_flux if isinstance(star_flux, u.Quantity) else u.Quantity(star_flux)
        if value.unit == u.dimensionless_unscaled:
            value = value * u.Jy
        jansky = float(value.to_value(u.Jy))
    except (TypeError, ValueError) as error:  # Units that cannot be converted are TypeErrors.
        raise IncompatibleSetupError(
            f"star_flux: got {star_flux!r}, expected a flux density such as '0.45 Jy' or "
            "an AB magnitude (9.8 * u.ABmag)"
        ) from error
    if not 0 < jansky < np.inf:
        raise IncompatibleSetupError(f"star_flux: got {star_flux}, expected a positive number")
    return jansky


def with_star_flux(
    fit: Refinement,
    star_flux: float,
    error: float,
    *,
    held: float = _HELD,
    progress: bool = False,
) -> Refinement:
    """Continue a fit with the flux of the star held at that of a catalogue.

    The wavefront then makes up for the change of the diffracted light, so that contrasts refer to
    the catalogue's star.

    Parameters
    ----------
    fit : Refinement
        Of one star.
    star_flux : float
        Flux density in the filter, Jy.
    error : float
        Its relative standard deviation, which errors of contrasts then include.
    held : float
        Relative deviation from it that the first fit allows.
    progress : bool
        Show progress bars.

    Raises
    ------
    IncompatibleSetupError
        If the frames have no photometric calibration.
    """
    for frame in fit.frames:
        require_calibrated(frame.observation)
    for _ in range(_ROUNDS):
        frames = [
            replace(frame, start={**frame.start, "flux": star_flux / _scale(frame)})
            for frame in fit.frames
        ]
        known = replace(fit, frames=tuple(frames), catalogue_error=error, catalogue_flux=star_flux)
        deviations = {**fit.settings.deviations, "flux": held}
        fit = refine_again(known, progress=progress, deviations=deviations)
        shares = [_scale(frame) * frame.flux / star_flux for frame in fit.frames]
        if max(abs(share - 1) for share in shares) < _AGREES:
            break
        # The light that passes the stop has changed with the wavefront and the pupil's amplitude,
        # or the frames pull at the flux more than it is held.
        held /= _TIGHTER
    return fit


def _scale(frame: FrameFit) -> float:
    scale = jansky_per_unit(frame)
    assert scale is not None
    return scale


def star_flux_error(fit: Refinement) -> float:
    """Relative error of the star's flux that is not in the fit's own covariance.

    That of the catalogue, if there is one. Otherwise 10 % for real frames, where only diffracted
    light tells how bright the star is (40 % without a wavefront map), and 0 for others.
    """
    if fit.catalogue_error is not None:
        return fit.catalogue_error
    if not fit.frames[0].observation.is_nircam:
        return 0.0
    return _UNTIED if fit.initial.data.any() else _WITHOUT_MAP
