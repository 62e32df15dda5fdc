"""Table of the free parameters of models and fits, with their units and ranges.

The table defines the keywords of the forward model, the parameters of the fit, and FITS columns.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf


@dataclass(frozen=True)
class Parameter:
    """One named parameter, scalar or vector."""

    name: str  # the keyword of the forward model
    unit: str  # at the interface, in astropy's spelling ("" for a plain number)
    size: int  # number of components
    default: float  # value when none is given
    start: float  # from which a fit starts when none is given
    lower: float  # bound of every component
    upper: float
    prior: float  # standard deviation about the start, wide as without any earlier measurement
    label: str  # a few words for tables, with ``{}`` for the component: x, y or its number
    description: str  # one line

    def labels(self) -> list[str]:
        """Label of every component."""
        names = "xy" if self.size == 2 else range(1, self.size + 1)
        return [self.label.format(name) for name in names]


OPTICAL_PARAMETERS = (
    Parameter(
        "star_offset", "arcsec", 2, 0.0, 0.0, -5.0, 5.0, 0.1, "star {} from occulter",
        "position (x, y) of the star relative to the occulter, image orientation",
    ),
    Parameter(
        "lyot_shift", "", 2, 0.0, 0.0, -0.05, 0.05, 0.02, "Lyot stop {} / pupil",
        "shift (x, y) of the Lyot stop as a fraction of the pupil diameter",
    ),
    Parameter(
        "lyot_rotation", "deg", 1, 0.0, 0.0, -5.0, 5.0, 2.0, "Lyot stop rotation",
        "rotation of the Lyot stop, counter-clockwise in entrance-pupil orientation",
    ),
    Parameter(
        "si_zernikes", "m", 36, 0.0, 0.0, -1e-6, 1e-6, 3e-8, "Noll Zernike {}",
        "Noll Zernike coefficients added to the instrument's internal wavefront error",
    ),
    Parameter(
        "detector_shift", "arcsec", 2, 0.0, 0.0, -5.0, 5.0, 0.1, "axis {} from array centre",
        "displacement (x, y) of the optical axis from the centre of the pixel array",
    ),
    # Pixel and charge diffusion, 0.29 pixel each, make 0.42 pixel together. At 0 the derivative
    # of the image vanishes, so no fit could start there.
    Parameter(
        "blur", "arcsec", 1, 0.0, 0.026, 0.0, 0.1, 0.02, "sigma of a Gaussian blur",
        "standard deviation of a Gaussian blur on the detector (jitter, charge diffusion)",
    ),
)  # fmt: skip
"""Free parameters of the optics of a coronagraph, besides the OPD."""

LEVELS = (
    Parameter(
        "flux", "", 1, 1.0, 1.0, 0.0, inf, inf, "starlight in the pupil",
        "light of the star collected by the pupil, in the unit of the image",
    ),
    Parameter(
        "background", "", 1, 0.0, 0.0, -inf, inf, inf, "background per pixel",
        "uniform background per pixel, in units of the image",
    ),
    Parameter(
        "pedestal", "", 1, 0.0, 0.0, -inf, inf, inf, "light besides the star",
        "light per pixel that the detector pattern multiplies besides the star, in units of the "
        "image",
    ),
)  # fmt: skip
"""Free parameters of an observation, besides the parameters of the optics."""


def parameter(name: str) -> Parameter:
    """Look up a parameter by name; raises KeyError if the table has no such name."""
    entries = {p.name: p for p in (*OPTICAL_PARAMETERS, *LEVELS)}
    if name not in entries:
        raise KeyError(f"{name!r} is not a parameter; expected one of {', '.join(entries)}")
    return entries[name]
