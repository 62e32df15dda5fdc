"""Infrared spectrum of a dwarf star from its spectral type and its K magnitude.

The mean colours of its type (Pecaut and Mamajek 2013, ApJS 208, 9, table 5) give the magnitudes in
the bands J, H and Ks of 2MASS and W1 and W2 of WISE. With the wavelengths and zero points of the
bands (Cohen et al. 2003, AJ 126, 1090; Jarrett et al. 2011, ApJ 735, 112), these are five samples
of the spectrum.
"""

from __future__ import annotations

import re

import numpy as np
from numpy.typing import NDArray

from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.io.files import embedded_table
from pyklip_diffrender.io.units import native_float64

__all__ = ["dwarf_photometry", "is_dwarf"]

_DESCRIPTION = re.compile(
    r"\s*(?P<type>[BAFGKM]\d(?:\.\d+)?)V?\s*,\s*K\s*=\s*(?P<magnitude>[-+]?\d+(?:\.\d*)?)\s*"
)

_WAVELENGTHS = native_float64([1.235e-6, 1.662e-6, 2.159e-6, 3.3526e-6, 4.6028e-6])
_ZERO_POINTS = native_float64([1594.0, 1024.0, 666.8, 309.54, 171.787])
"""Flux density of magnitude 0 in J, H, Ks, W1 and W2, Jy."""

_END = 5.2e-6
"""Wavelength to which the spectrum is continued, m, as the power law from W1 to W2."""


def is_dwarf(star: str) -> bool:
    """True for a spectral type and a K magnitude, such as "A2V, K=6.77"."""
    return _DESCRIPTION.fullmatch(star) is not None


def dwarf_photometry(star: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Samples of the spectrum of a dwarf.

    W1 - W2 is interpolated from K5 to M5, between which the table has no value.

    Parameters
    ----------
    star : str
        Spectral type from B5 to M9 and magnitude in Ks, such as "A2V, K=6.77".

    Returns
    -------
    wavelength, flux : ndarray
        m and Jy.

    Raises
    ------
    IncompatibleSetupError
        For another description, or a type that the table does not have.
    """
    match = _DESCRIPTION.fullmatch(star)
    if match is None:
        raise IncompatibleSetupError(
            f'star: got {star!r}, expected a spectral type and a K magnitude such as "A2V, K=6.77"'
        )
    table = embedded_table("dwarf_colors")
    places = native_float64([_place(each) for each in table["type"]])
    place = _place(match["type"])
    if not places[0] <= place <= places[-1]:
        raise IncompatibleSetupError(
            f"star: got type {match['type']}, expected {table['type'][0]} to {table['type'][-1]}"
        )
    j_h, h_ks, ks_w1, w1_w2 = (
        _interpolated(place, places, native_float64(table[name]))
        for name in ("j_h", "h_ks", "ks_w1", "w1_w2")
    )
    ks = float(match["magnitude"])
    magnitudes = native_float64([ks + h_ks + j_h, ks + h_ks, ks, ks - ks_w1, ks - ks_w1 - w1_w2])
    flux = _ZERO_POINTS * 10 ** (-0.4 * magnitudes)
    slope = np.log(flux[-1] / flux[-2]) / np.log(_WAVELENGTHS[-1] / _WAVELENGTHS[-2])
    end = flux[-1] * (_END / _WAVELENGTHS[-1]) ** slope
    return np.append(_WAVELENGTHS, _END), np.append(flux, end)


def _place(name: str) -> float:
    """Place of a spectral type such as "G2" in the sequence, where each letter has ten."""
    return 10.0 * "BAFGKM".index(name[0]) + float(name[1:])


def _interpolated(place: float, places: NDArray[np.float64], colours: NDArray[np.float64]) -> float:
    known = np.isfinite(colours)
    return float(np.interp(place, places[known], colours[known]))
