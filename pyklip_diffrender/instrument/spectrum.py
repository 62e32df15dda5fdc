"""Wavelengths and their weights: filter throughput times the star's spectrum."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from astropy import constants
from astropy import units as u
from numpy.typing import ArrayLike, NDArray

from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.io.files import embedded_table
from pyklip_diffrender.io.units import native_float64, to_metres, to_number, to_unit
from pyklip_diffrender.optics.bandpass import Bandpass

__all__ = ["blackbody", "filter_bandpass", "filter_throughput"]


@lru_cache(maxsize=1)
def _throughputs() -> dict[str, tuple[NDArray[np.float64], NDArray[np.float64]]]:
    table = embedded_table("nircam_filters")
    curves = {}
    for name in dict.fromkeys(str(value) for value in table["filter"]):
        rows = table[table["filter"] == name]
        curves[name] = (
            native_float64(rows["wavelength"].quantity.to_value(u.m)),
            native_float64(rows["throughput"]),
        )
    return curves


def filter_throughput(name: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Wavelengths (m) and relative response (peak 1) of a filter, to be interpolated linearly.

    Raises
    ------
    IncompatibleSetupError
        If the filter has no embedded throughput.
    """
    try:
        return _throughputs()[name.upper()]
    except KeyError:
        raise IncompatibleSetupError(
            f"filter: got {name!r}, expected one that goes with the coronagraph: "
            f"{', '.join(_throughputs())}"
        ) from None


def blackbody(temperature: float, wavelengths: ArrayLike) -> NDArray[np.float64]:
    """Photons per unit wavelength of a blackbody, up to a constant.

    Parameters
    ----------
    temperature : float
        K.
    wavelengths : array_like
        m.
    """
    exponent = (constants.h * constants.c / constants.k_B).to_value(u.m * u.K) / (
        native_float64(wavelengths) * temperature
    )
    return native_float64(1e-24 / native_float64(wavelengths) ** 4 / np.expm1(exponent))


def filter_bandpass(
    name: str,
    nlambda: int,
    source: float | tuple[ArrayLike, ArrayLike] = 5700.0,
) -> Bandpass:
    """Divide a filter into `nlambda` equal intervals and weight each by its detected photons.

    Every wavelength is the photon-weighted mean of its interval, for the best accuracy with few
    wavelengths.

    Parameters
    ----------
    name : str
        Filter.
    nlambda : int
        Number of intervals between the wavelengths at which the throughput is 1 % of its peak;
        intervals without light are omitted.
    source : float or (wavelengths, flux)
        Temperature of a blackbody in K (default as in stpsf), or a spectrum: wavelengths in m
        and photons per unit wavelength; either may be a Quantity.

    Raises
    ------
    IncompatibleSetupError
        For an unknown filter, or a spectrum that does not cover it or has no light in it.
    """
    if nlambda < 1:
        raise ValueError(f"nlambda: got {nlambda}, expected at least 1")
    wavelength, throughput = filter_throughput(name)
    # The table has few points, so the throughput is interpolated to find where it passes 1 %.
    dense = np.linspace(wavelength[0], wavelength[-1], 20_001)
    used = dense[np.interp(dense, wavelength, throughput) > 0.01 * throughput.max()]
    fine = np.linspace(used[0], used[-1], 200 * nlambda + 1)
    middle = (fine[1:] + fine[:-1]) / 2
    if isinstance(source, tuple):
        grid = to_metres(source[0], "source: wavelengths")
        flux = to_unit(source[1], "photon / (s m2 um)", "source: photons")
        if grid.min() > fine[0] or grid.max() < fine[-1]:
            raise IncompatibleSetupError(
                f"the spectrum covers {grid.min():.3e} to {grid.max():.3e} m, the filter "
                f"{name} needs {fine[0]:.3e} to {fine[-1]:.3e} m"
            )
        photons = np.interp(middle, grid, flux)
    else:
        photons = blackbody(to_number(source, u.K, "source", "positive"), middle)
    photons = (photons * np.interp(middle, wavelength, throughput)).reshape(nlambda, -1)
    weights = photons.sum(axis=1)
    detected = weights > 0
    if not detected.any():
        raise IncompatibleSetupError(f"the spectrum has no light in the filter {name}")
    weights, photons = weights[detected], photons[detected]
    centres = (photons * middle.reshape(nlambda, -1)[detected]).sum(axis=1) / weights
    return Bandpass(tuple(centres.tolist()), tuple(weights.tolist()))
