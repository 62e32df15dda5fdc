"""Size of the error of the model that neighbouring pixels share, from the evidence.

Relative to the flat-field pattern of the library, real frames have an error that is proportional to
the starlight and correlated over about a pixel, see `linear.noise`. Its size differs between stars:
0 to 2 % of the starlight. It is the size at which the data are most probable, marginalised over all
unknowns of the fit.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from pyklip_diffrender.linear.model import LinearModel
from pyklip_diffrender.linear.noise import UNCORRELATED, CorrelatedError

__all__ = ["fitted_correlated_error"]

_SIZES = (0.004, 0.008, 0.016, 0.032)
"""Sizes that are tried, as fractions of the starlight; no larger one was seen."""

_SHARES = (0.1, 0.3, 0.6)
"""Parts of the variance that differ between frames that are tried."""

_SIGNIFICANT = 3.0
"""Increase of the logarithm of the evidence below which there is no correlated error."""


def fitted_correlated_error(linear: LinearModel) -> CorrelatedError:
    """Find the size of the correlated error with the highest evidence.

    Frames of the same detector pixels have a common part and parts of their own. For others,
    the two cannot be told apart, and the whole is called shared.

    Parameters
    ----------
    linear : LinearModel
        About the solution of a fit.
    """

    def evidence(error: CorrelatedError) -> float:
        return linear.with_correlated_error(error).log_evidence

    without = linear.with_correlated_error(UNCORRELATED).log_evidence
    size, gain = _highest(lambda size: evidence(CorrelatedError(size)) - without, _SIZES)
    if gain < _SIGNIFICANT:
        return UNCORRELATED
    if not linear.noise.shares_pattern:
        return CorrelatedError(size)

    def split(share: float) -> CorrelatedError:
        return CorrelatedError(size * (1 - share) ** 0.5, size * share**0.5)

    share, better = _highest(lambda share: evidence(split(share)) - without - gain, _SHARES)
    return split(share) if better > 0 else CorrelatedError(size)


def _highest(gain: Callable[[float], float], places: tuple[float, ...]) -> tuple[float, float]:
    """Place of the highest value of a function that is 0 at 0, and its value there.

    Places are tried in order until the function falls. The result is the maximum of the parabola
    through the highest value and its neighbours, in the logarithm of the place (plus half of the
    first one), over which the evidence is nearly symmetric.
    """
    tried, values = [0.0], [0.0]
    for place in places:
        tried.append(place)
        values.append(gain(place))
        if values[-1] < values[-2]:
            break
    best = int(np.argmax(values))
    if best in (0, len(tried) - 1):
        return tried[best], values[best]
    around, offset = slice(best - 1, best + 2), places[0] / 2
    second, first, _ = np.polyfit(np.log(np.add(tried[around], offset)), values[around], 2)
    place = float(np.exp(-first / (2 * second)) - offset)
    return place, gain(place)
