"""NIRCam's internal wavefront error behind the Lyot stop, and its dependence on wavelength.

Tables are in the orientation of the exit pupil, in which y is inverted. Functions return the
orientation of the entrance pupil.
"""

from __future__ import annotations

from functools import lru_cache

import torch
from numpy.polynomial import Polynomial
from torch import Tensor

from pyklip_diffrender.io.files import embedded_table
from pyklip_diffrender.optics.zernike import noll_indices

__all__ = ["ChromaticAberration", "internal_wavefront_error", "parity_in_y"]

# Dependence on wavelength as in stpsf 2.2.0's NIRCamFieldAndWavelengthDependentAberration: defocus
# of the camera (R. Telfer's design model, m rms of Noll 4) and tilt from the dispersion of the
# coronagraph's wedge (m rms of Noll 3), both in the exit pupil; polynomials in micron, lowest
# order first, for the (short, long) wave channel.
_FOCUS = (
    Polynomial(
        [-59.64330811, 265.843112, -465.9818413, 415.9031962, -201.5444129, 50.62919436,
         -5.169185169]
    ) / -1.09746e7,
    Polynomial([1.641692934, 0.986462016, -1.100964635, 0.175718713]) / -1.09746e7,
)  # fmt: skip
_WEDGE_TILT = (
    Polynomial([3240.7584, -1620.3792]) * 1e-9,
    Polynomial([12515.1242, -8683.2786, 1939.0256, -134.9596]) * 1e-9,
)
_TABULATED_AT = (2.12, 3.23)
"""Wavelengths of the tabulated wavefront error, micron."""

_MIRRORED = {"MASKSWB": "MASKLWB", "MASKLWB": "MASKSWB"}
"""Masks of module A whose place is the mirror image of another mask's in module B."""


class ChromaticAberration:
    """Focus and wedge tilt in addition to the tabulated wavefront error.

    In the exit pupil the additional OPD is ``-(focus(lambda) - focus(tabulated)) Z4 +
    (tilt(lambda) - tilt(reference)) Z3``; y is inverted in the entrance pupil, which changes the
    sign of Z3.

    Parameters
    ----------
    reference : float
        Wavelength at which the tilt is zero, m.
    short_wave : bool
        Whether it is that of the short-wave channel.
    """

    def __init__(self, reference: float, short_wave: bool = False) -> None:
        self.reference, self.short_wave = reference, short_wave

    def __call__(self, wavelength: float) -> dict[int, float]:
        """Coefficients to add at a wavelength (m): Noll index to m rms."""
        channel = 0 if self.short_wave else 1
        focus, tilt = _FOCUS[channel], _WEDGE_TILT[channel]
        return {
            3: float(-(tilt(wavelength * 1e6) - tilt(self.reference * 1e6))),
            4: float(-(focus(wavelength * 1e6) - focus(_TABULATED_AT[channel]))),
        }


def internal_wavefront_error(
    mask: str = "MASK335R", flip: bool = True, *, short_wave: bool = False, module: str = "A"
) -> Tensor:
    """NIRCam's internal wavefront error at a mask.

    Parameters
    ----------
    mask : str
        A name of `MASKS`.
    flip : bool
        Flip the map vertically, as stpsf does from 2.2.0 on, because that matches images in flight
        better. False uses the tabulated orientation, that of the exit pupil, as stpsf did before.
    short_wave : bool
        In the short-wave channel, otherwise in the long-wave one.
    module : "A" or "B"
        STScI's table has the same values for B as for A, at places mirrored in V2. There the two
        bars change places.

    Returns
    -------
    Tensor, (36,), float64
        Noll coefficients in m, for the entrance-pupil orientation used here.
    """
    if module == "B":
        mask = _MIRRORED.get(mask, mask)
    exit_pupil = torch.tensor(_table(mask, short_wave), dtype=torch.float64) * 1e-9
    return exit_pupil if flip else exit_pupil * parity_in_y(len(exit_pupil))


@lru_cache(maxsize=4)
def _table(mask: str, short_wave: bool) -> tuple[float, ...]:
    """The tabulated coefficients, nm; cached because reading them takes longer than an image."""
    channel = "SW" if short_wave else "LW"
    return tuple(embedded_table("nircam_si_zernikes")[f"{channel} {mask}"].tolist())


def parity_in_y(count: int) -> Tensor:
    """-1 for the Zernikes that change sign with y (the sines), otherwise 1."""
    return torch.tensor(
        [-1.0 if noll_indices(j)[1] < 0 else 1.0 for j in range(1, count + 1)],
        dtype=torch.float64,
    )
