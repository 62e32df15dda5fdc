"""Flux density of a star in a filter, from its spectrum, its photometry or its spectral type."""

from __future__ import annotations

import os
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from astropy import units as u
from astropy.io import fits
from astropy.io.votable import parse_single_table
from astropy.table import Table
from numpy.typing import NDArray

from pyklip_diffrender.errors import CorruptFileError, IncompatibleSetupError
from pyklip_diffrender.instrument.dwarf_stars import dwarf_photometry, is_dwarf
from pyklip_diffrender.instrument.spectrum import filter_throughput
from pyklip_diffrender.io.files import is_fits_name, open_fits, read_text
from pyklip_diffrender.io.units import native_float64

__all__ = ["mean_in_filter", "read_spectrum", "star_flux_density"]

_GAP = 1.6
"""Largest step between samples, as a fraction of the wavelength, over which a power law is a fair
continuum of a star. Infrared photometry has points at 2.16, 3.35, 4.60 and 11.6 micron."""

_RANGE = (2e-6, 5.2e-6)
"""Wavelengths, m, at which the samples have to be as close as that."""

_Spectrum = tuple[NDArray[np.float64], NDArray[np.float64]]


def star_flux_density(star: str | os.PathLike[str], filter: str) -> u.Quantity:
    r"""Flux density of a star in a NIRCam filter, from its spectrum or its spectral type.

    It is the mean over detected photons,
    ``integral(F_nu T dnu / nu) / integral(T dnu / nu)`` with the throughput T of the filter, to
    which the calibration of JWST refers (Gordon et al. 2022, AJ 163, 267).

    Parameters
    ----------
    star : path or str
        File with the spectrum, see `read_spectrum`; or spectral type of a dwarf (B5 to M9) and its
        2MASS Ks magnitude, such as "A2V, K=6.77". From the type, the flux is good to about 5 %.
    filter : str
        Such as "F444W".

    Returns
    -------
    Quantity
        Jy, for ``reduce(star_flux=...)``.

    Raises
    ------
    IncompatibleSetupError
        For an unknown filter, or a spectrum that does not cover it.
    CorruptFileError
        If the file cannot be read.
    FileNotFoundError
        If there is no such file.

    Examples
    --------
    A spectrum as spaceKLIP's ``starfile`` has it, micron and Jy:

    >>> from pathlib import Path
    >>> from tempfile import TemporaryDirectory
    >>> import pyklip_diffrender as dr
    >>> with TemporaryDirectory() as folder:
    ...     path = Path(folder, "star.txt")
    ...     _ = path.write_text("3.0 0.9\n4.0 0.5\n5.0 0.3\n6.0 0.2\n")
    ...     print(dr.star_flux_density(path, "F444W").round(3))
    0.411 Jy

    A2V with the K magnitude of HIP 65426:

    >>> print(dr.star_flux_density("A2V, K=6.77", "F444W").round(3))
    0.378 Jy
    """
    grid, flux = dwarf_photometry(str(star)) if is_dwarf(str(star)) else read_spectrum(star)
    return mean_in_filter(grid, flux, filter, str(star)) * u.Jy


def mean_in_filter(
    grid: NDArray[np.float64], flux: NDArray[np.float64], filter: str, name: str
) -> float:
    """Mean of a flux density over the photons that a filter detects; see `star_flux_density`.

    Parameters
    ----------
    grid : ndarray, (n,)
        Wavelengths, m, increasing.
    flux : ndarray, (n,)
        Flux density per frequency, positive.
    filter : str
    name : str
        Of the spectrum, for the message.

    Raises
    ------
    IncompatibleSetupError
        For an unknown filter, or a spectrum that does not cover it.
    """
    wavelength, throughput = filter_throughput(filter)
    inside = throughput > 0.01 * throughput.max()
    first, last = wavelength[inside][[0, -1]]
    if grid[0] > first or grid[-1] < last:
        raise IncompatibleSetupError(
            f"{name}: the spectrum covers {grid[0] * 1e6:.3f} to {grid[-1] * 1e6:.3f} micron, the "
            f"filter {filter} needs {first * 1e6:.3f} to {last * 1e6:.3f} micron"
        )
    fine = np.linspace(first, last, 4001)
    # A power law between samples, as the continuum of a star is beyond 2 micron.
    spectrum = np.exp(np.interp(np.log(fine), np.log(grid), np.log(flux)))
    # In photons per logarithmic interval of frequency, dnu / nu = dlambda / lambda.
    weight = np.interp(fine, wavelength, throughput) / fine
    return float((spectrum * weight).sum() / weight.sum())


def read_spectrum(path: str | os.PathLike[str]) -> _Spectrum:
    """Read a spectrum.

    Parameters
    ----------
    path : path
        - A text file of two columns without units: wavelength in micron and flux density in Jy, as
          the ``starfile`` of spaceKLIP. Lines that begin with ``#`` are comments.
        - A table with units (ECSV, FITS), whose first two columns are wavelengths or frequencies,
          and flux densities by wavelength or frequency, such as the spectra of CALSPEC.
        - Photometry as the VizieR photometry viewer saves it (VOTable with ``sed_freq`` and
          ``sed_flux``). Points at one frequency are averaged by their median.

    Returns
    -------
    wavelength, flux : ndarray
        m, increasing, and Jy.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    CorruptFileError
        If it is not one of these, or has no positive flux.
    IncompatibleSetupError
        If its samples between 2 and 5.2 micron are too far apart for interpolation.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(
            f"{path}: no such file; expected a star's spectrum or "
            'photometry, or a spectral type and a K magnitude such as "A2V, K=6.77"'
        )
    suffix = path.suffix.lower()
    is_photometry = suffix in (".vot", ".xml", ".votable")
    try:
        wavelength, flux = _photometry(path) if is_photometry else _table(path, suffix)
    except (OSError, ValueError, TypeError, KeyError, IndexError, StopIteration) as error:
        raise CorruptFileError(
            f"{path}: not a spectrum ({error}). Expected two columns, wavelength in micron and "
            "flux density in Jy, a table with units, or a VOTable of VizieR's photometry viewer"
        ) from error
    usable = np.isfinite(wavelength) & np.isfinite(flux) & (wavelength > 0) & (flux > 0)
    if usable.sum() < 2:
        raise CorruptFileError(
            f"{path}: {int(usable.sum())} of {len(flux)} samples are positive numbers, expected "
            "at least two"
        )
    wavelength, which = np.unique(wavelength[usable], return_inverse=True)
    flux = flux[usable]
    flux = native_float64([np.median(flux[which == k]) for k in range(len(wavelength))])
    used = (wavelength[1:] > _RANGE[0]) & (wavelength[:-1] < _RANGE[1])
    step = np.where(used, np.diff(wavelength) / wavelength[:-1], 0.0)
    if step.max() > _GAP:
        before, after = 1e6 * wavelength[step.argmax() : step.argmax() + 2]
        raise IncompatibleSetupError(
            f"{path}: no sample between {before:.2f} and {after:.2f} micron, expected steps of at "
            f"most {100 * _GAP:.0f} % of the wavelength"
        )
    return wavelength, flux


def _photometry(path: Path) -> _Spectrum:
    """Points of VizieR's photometry viewer, m and Jy."""
    with warnings.catch_warnings():
        # VizieR's files deviate from the standard in ways that do not concern these columns.
        warnings.simplefilter("ignore")
        table = parse_single_table(path).to_table()
    frequency = u.Quantity(np.ma.filled(table["sed_freq"], np.nan), table["sed_freq"].unit or u.GHz)
    flux = u.Quantity(np.ma.filled(table["sed_flux"], np.nan), table["sed_flux"].unit or u.Jy)
    wavelength = frequency.to_value(u.m, u.spectral())
    return native_float64(wavelength), native_float64(flux.to_value(u.Jy))


def _table(path: Path, suffix: str) -> _Spectrum:
    """Samples of a table, m and Jy; columns without units are in micron and Jy."""
    units: list[Any] = [None, None]
    if is_fits_name(path):
        with open_fits(path) as hdus:
            table = next(hdu for hdu in hdus if isinstance(hdu, fits.BinTableHDU))
            place, level = (native_float64(table.data.field(k)) for k in (0, 1))
            units = [column.unit for column in table.columns[:2]]
    elif suffix == ".ecsv":
        columns = [Table.read(read_text(path), format="ascii.ecsv").columns[k] for k in (0, 1)]
        place, level = (native_float64(np.ma.filled(each, np.nan)) for each in columns)
        units = [each.unit for each in columns]
    else:
        place, level = np.loadtxt(read_text(path).splitlines(), ndmin=2, usecols=(0, 1)).T
    wavelength = u.Quantity(place, _unit(units[0], u.micron)).to(u.m, u.spectral())
    flux = u.Quantity(level, _unit(units[1], u.Jy)).to(u.Jy, u.spectral_density(wavelength))
    return native_float64(wavelength.value), native_float64(flux.value)


def _unit(unit: Any, default: u.UnitBase) -> u.UnitBase:
    """Unit of a column; spectra of CALSPEC write theirs as ANGSTROMS and FLAM."""
    if unit is None:
        return default
    text = str(unit).strip().lower()
    if text == "angstroms":
        return u.AA
    if text == "flam":
        return u.erg / (u.s * u.cm**2 * u.AA)
    return u.Unit(unit)
