"""How much of a known pattern of the flat field's errors the frames of a fit show.

A library of patterns is valid for frames that were calibrated with the same flat field. With
another one, which may be better, the frames show less of the pattern, or none of it.
"""

from __future__ import annotations

import logging

import torch

from pyklip_diffrender.pattern.pedestal import light_and_residual
from pyklip_diffrender.refinement.fit_result import Refinement

__all__ = ["lacks_pattern", "pattern_size"]

_log = logging.getLogger(__name__)

_HALF = 0.5
"""Size below which more of the pattern would remain with it than without it."""

_SURE = 2.0
"""Standard deviations by which the size must be below that."""


def pattern_size(fit: Refinement) -> tuple[float, float] | None:
    """Measure how large the known pattern is in the frames, and the error of that.

    The size is 1 if the frames show what ``Systematics.pattern`` says, and 0 if they show nothing
    of it. All unknowns of the fit are marginalised, as well as the error of the pattern.

    Parameters
    ----------
    fit : Refinement

    Returns
    -------
    tuple of float, or None
        None for a fit without a pattern whose values are known, or without a linear model.

    Examples
    --------
    Frames with a quarter of the pattern that a fit takes for known:

    >>> from dataclasses import replace
    >>> import numpy as np
    >>> import pyklip_diffrender as dr
    >>> from pyklip_diffrender.pattern import pattern_size
    >>> model = dr.nircam_coronagraph("F444W", monochromatic=4.5e-6, npix=128, fov_pixels=32)
    >>> opd = dr.random_opd(1, npix=128)
    >>> frames = dr.simulate(model, dr.Scene(), opd, seed=3)
    >>> pattern = 0.04 * np.random.default_rng(1).normal(size=(32, 32))
    >>> frames = replace(frames, data=frames.data * (1 + pattern / 4))
    >>> error = np.full_like(pattern, 0.01)
    >>> known = dr.Systematics(pattern, error, frames.center[0], unknown=0.04)
    >>> settings = dr.GaussNewton(cycles=6)
    >>> fit = dr.refine(model, frames, opd, settings=settings, systematics=known)
    >>> size, error = pattern_size(fit)
    >>> print(f"{size:.2f} +- {error:.2f}")
    0.25 +- 0.02
    """
    if fit.systematics is None:
        return None
    templates = {}
    for k, frame in enumerate(fit.frames):
        light = light_and_residual(frame)[0] + frame.pedestal
        templates[k] = torch.from_numpy((frame.gain - 1) * light)[None]
    if not any(bool(each.any()) for each in templates.values()):
        return None
    products = fit.linear.weigh(templates)
    information = float(products.information)
    return 1 + float(products.numerator) / information, information**-0.5


def lacks_pattern(fit: Refinement) -> bool:
    """Whether the frames of a fit show less than half of its known pattern.

    If so, a warning is logged.
    """
    measured = pattern_size(fit)
    if measured is None:
        return False
    size, error = measured
    _log.info("the frames show %.2f +- %.2f of the pattern", size, error)
    lacks = size + _SURE * error < _HALF
    if lacks:
        assert fit.systematics is not None
        _log.warning(
            "%s: the frames show %.2f +- %.2f of the flat-field pattern of %s. They were probably "
            "calibrated with another flat field",
            fit.frames[0].observation.name, size, error, fit.systematics.name,
        )  # fmt: skip
    return lacks
