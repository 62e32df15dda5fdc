"""The planet of a forward model as the linear model of the fit measures it.

A fit of the product, such as `pyklip.fitpsf.FMAstrometry`, has to estimate the noise from an
annulus about the star. The linear model knows the noise of every pixel and the self-subtraction, so
that its values are more precise and its errors are those of the values.
"""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

import numpy as np
from astropy.io import fits

from pyklip_diffrender.io.geometry import rotation_matrix
from pyklip_diffrender.io.keywords import set_keyword
from pyklip_diffrender.pyklip_backend.fitted_pointing import FittedPointing

if TYPE_CHECKING:
    from pyklip_diffrender.detection.error_factor import ErrorFactor
    from pyklip_diffrender.pyklip_backend.forward_model import PlanetInFrame

__all__ = ["planet_cards"]

logger = logging.getLogger(__name__)


def planet_cards(
    part: FittedPointing,
    planet: PlanetInFrame,
    angle: float,
    flipx: bool,
    error_factor: ErrorFactor | None = None,
) -> fits.Header:
    """Flux and position of a planet with their errors, as cards for the products.

    Parameters
    ----------
    part : FittedPointing
        The pointing of the fit's first frame.
    planet : PlanetInFrame
        The forward model there.
    angle : float
        Degrees counter-clockwise by which pyKLIP turns the pointing.
    flipx : bool
        See `pyklip.klip.rotate`.
    error_factor : ErrorFactor, optional
        By how much the errors are too small. By default it is measured with the planet, and the
        companions of the fit, removed.

    Returns
    -------
    Header
        Empty if no source is within lambda/D of the planet's place in the forward model.
    """
    from pyklip_diffrender.detection.calibration import calibration_errors
    from pyklip_diffrender.detection.candidates import Candidates, refine_candidates
    from pyklip_diffrender.detection.error_inflation import default_factor
    from pyklip_diffrender.detection.groups import groups_of
    from pyklip_diffrender.detection.position_errors import with_position_of_star

    cards = fits.Header()
    start, resolution = part.from_star(planet.offset), part.resolution
    others = Candidates.of_fit(part.result)
    for k in reversed(range(len(others))):
        if np.hypot(*(others.offsets[k].numpy() - start)) < resolution:
            others = others.without(k)
    groups = groups_of([part.result])
    sources = refine_candidates(
        groups, others.with_one_more(start, planet.contrast), resolution / 2
    )
    moved = sources.offsets[-1].numpy() - start
    flux = float(sources.contrasts[-1]) / planet.contrast
    if not (np.hypot(*moved) < resolution and flux > 0):
        logger.info("no source within lambda/D of the planet of the forward model")
        return cards
    sources = with_position_of_star(groups, sources)
    covariance = sources.covariance.numpy().reshape(3, len(sources), 3, len(sources))[:, -1, :, -1]
    if error_factor is None:
        error_factor = default_factor([part.result], groups, sources)
    factor = float(error_factor.of(sources.offsets[-1:])[0])
    error = factor * np.sqrt(covariance[0, 0])
    snr = sources.contrasts.new_tensor(sources.snr(error_factor)[-1:])
    factors = snr.new_full(snr.shape, factor)
    calibration = float(calibration_errors(groups, sources.offsets[-1:], snr, factors)[1, 0])
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
    flux_error = float(np.hypot(error / planet.contrast, flux * calibration))
    set_keyword(cards, "DRFMFERR", flux_error)
    set_keyword(cards, "DRFMFACT", factor)
    for axis, value, deviation in zip(("RA", "DE"), place, deviations, strict=True):
        set_keyword(cards, f"DRFM{axis}", float(value))
        set_keyword(cards, f"DRFM{axis}ER", float(deviation))
    return cards
