"""Spectra of stars and planets in NIRCam's filters: weights of wavelengths, and flux densities."""

from __future__ import annotations

import os
import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from astropy import constants
from astropy import units as u
from astropy.io import fits
from astropy.io.votable import parse_single_table
from astropy.modeling.physical_models import BlackBody
from astropy.table import Table
from numpy.typing import ArrayLike, NDArray

from pyklip_diffrender.errors import (
    CorruptFileError,
    DiffrenderError,
    IncompatibleSetupError,
    MissingFileError,
)
from pyklip_diffrender.io.files import embedded_table, is_fits_name, open_fits, read_text
from pyklip_diffrender.io.units import native_float64, to_metres, to_number, to_unit
from pyklip_diffrender.optics.bandpass import Bandpass

__all__ = [
    "TEMPERATURES",
    "PlanetSpectra",
    "blackbody",
    "dwarf_photometry",
    "filter_bandpass",
    "filter_throughput",
    "is_dwarf",
    "mean_in_filter",
    "planet_spectra",
    "read_spectrum",
    "star_flux_density",
]


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

    IncompatibleSetupError if the filter has no embedded throughput.
    """
    try:
        return _throughputs()[name.upper()]
    except KeyError:
        raise IncompatibleSetupError(
            f"filter: got {name!r}, expected one that goes with the coronagraph: "
            f"{', '.join(_throughputs())}"
        ) from None


def blackbody(temperature: float, wavelengths: ArrayLike) -> NDArray[np.float64]:
    """Photons per unit wavelength of a blackbody of `temperature` (K), at wavelengths in m."""
    wavelength = native_float64(wavelengths) * u.m
    radiance = BlackBody(temperature * u.K, scale=1 * u.W / (u.m**3 * u.sr))(wavelength)
    # The energy of a photon is h c / lambda.
    photons = radiance * wavelength / (constants.h * constants.c)
    return native_float64(photons.to_value(1 / (u.s * u.m**3 * u.sr)))


def filter_bandpass(
    name: str,
    nlambda: int,
    source: float | tuple[ArrayLike, ArrayLike] = 5700.0,
) -> Bandpass:
    """Divide a filter into `nlambda` equal intervals and weight each by its detected photons.

    `source` is the temperature of a blackbody in K (default as in stpsf), or a spectrum:
    wavelengths in m and photons per unit wavelength; either may be a Quantity.
    IncompatibleSetupError for an unknown filter, or a spectrum that does not cover it or has no
    light in it.
    """
    if nlambda < 1:
        raise ValueError(f"nlambda: got {nlambda}, expected at least 1")
    wavelength, throughput = filter_throughput(name)
    # Intervals are between the wavelengths at which the throughput is 1 % of its peak; those
    # without light are omitted. Every wavelength is the photon-weighted mean of its interval, for
    # the best accuracy with few wavelengths.
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


# Infrared spectrum of a dwarf star from its spectral type and its K magnitude.
#
# The mean colours of its type (Pecaut and Mamajek 2013, ApJS 208, 9, table 5) give the magnitudes
# in the bands J, H and Ks of 2MASS and W1 and W2 of WISE. With the wavelengths and zero points of
# the bands (Cohen et al. 2003, AJ 126, 1090; Jarrett et al. 2011, ApJ 735, 112), these are five
# samples of the spectrum.

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
    """Samples of the spectrum of a dwarf, wavelengths in m and flux densities in Jy.

    `star` has a spectral type from B5 to M9 and the magnitude in Ks, such as "A2V, K=6.77".
    IncompatibleSetupError for another description, or a type that the table does not have.
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
    # W1 - W2 is interpolated from K5 to M5, between which the table has no value.
    j_h, h_ks, ks_w1, w1_w2 = (
        _interpolated(place, places, native_float64(table[name]))
        for name in ("j_h", "h_ks", "ks_w1", "w1_w2")
    )
    ks = float(match["magnitude"])
    magnitudes = native_float64([ks + h_ks + j_h, ks + h_ks, ks, ks - ks_w1, ks - ks_w1 - w1_w2])
    flux = _ZERO_POINTS * 10 ** (-0.4 * magnitudes)
    # F = a lambda^slope through W1 and W2.
    slope = np.log(flux[-1] / flux[-2]) / np.log(_WAVELENGTHS[-1] / _WAVELENGTHS[-2])
    end = flux[-1] * (_END / _WAVELENGTHS[-1]) ** slope
    return np.append(_WAVELENGTHS, _END), np.append(flux, end)


def _place(name: str) -> float:
    """Place of a spectral type such as "G2" in the sequence, where each letter has ten."""
    return 10.0 * "BAFGKM".index(name[0]) + float(name[1:])


def _interpolated(place: float, places: NDArray[np.float64], colours: NDArray[np.float64]) -> float:
    known = np.isfinite(colours)
    return float(np.interp(place, places[known], colours[known]))


# Flux density of a star in a filter, from its spectrum, its photometry or its spectral type.

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
    """Mean of a flux density per frequency over the photons that a filter detects.

    Wavelengths `grid`, m, increase, and the `flux` is positive, both (n,). IncompatibleSetupError
    for an unknown filter, or a spectrum that does not cover it.
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
    """Read a spectrum: wavelengths, m, increasing, and flux densities, Jy.

    - A text file of two columns without units: wavelength in micron and flux density in Jy, as
      the ``starfile`` of spaceKLIP. Lines that begin with ``#`` are comments.
    - A table with units (ECSV, FITS), whose first two columns are wavelengths or frequencies,
      and flux densities by wavelength or frequency, such as the spectra of CALSPEC.
    - Photometry as the VizieR photometry viewer saves it (VOTable with ``sed_freq`` and
      ``sed_flux``). Points at one frequency are averaged by their median.

    FileNotFoundError if there is no such file, CorruptFileError if it is not one of these, or has
    no positive flux, IncompatibleSetupError if its samples between 2 and 5.2 micron are too far
    apart for interpolation.
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


# Spectra of planets in the filters of a search: black bodies, model atmospheres, a flat one.

TEMPERATURES = (150, 175, 200, 250, 300, 350, 400, 500, 600, 750, 900, 1200, 1500)
"""Temperatures of black bodies, K. Neighbours differ so little that a search of F356W and F444W of
equal depth loses at most 0.2 % of the S/N of a planet between them."""

_SAMPLES = np.geomspace(0.5e-6, 8e-6, 2001)
"""Wavelengths of black bodies, m, which include those of every filter."""


@dataclass(frozen=True)
class PlanetSpectra:
    """Flux densities of planets in several filters."""

    names: tuple[str, ...]  # of the spectra
    filters: tuple[str, ...]
    # (spectra, filters): mean flux density per frequency over the photons that the filter detects,
    # 1 in the filter where it is largest.
    flux: NDArray[np.float64]
    # Spectra of a file that do not cover a filter or have no light in it, and why.
    left_out: tuple[tuple[str, str], ...] = ()


def planet_spectra(
    spectra: str | os.PathLike[str] | Sequence[str | os.PathLike[str]], filters: Sequence[str]
) -> PlanetSpectra:
    """Compute the flux densities of planets in filters.

    Parameters
    ----------
    spectra : str, path, or sequence of them
        "blackbody" (150 to 1,500 K), "flat" (the same flux density per frequency at all
        wavelengths), or the file of a table whose first column is a wavelength and whose other
        columns are spectra, each named by its column: ECSV or FITS with units, or text whose first
        line has the names, with wavelengths in micron and flux densities per frequency. Only the
        shape of a spectrum matters.
    filters : sequence of str
        Such as "F444W".

    Returns
    -------
    PlanetSpectra

    Raises
    ------
    IncompatibleSetupError
        For an unknown filter, or if no spectrum of a file covers all filters.
    CorruptFileError
        If a file is missing, or is no such table.

    Examples
    --------
    >>> from pyklip_diffrender.instrument.spectrum import planet_spectra
    >>> planets = planet_spectra(["blackbody", "flat"], ["F356W", "F444W"])
    >>> planets.names[-2:]
    ('black body of 1500 K', 'flat')
    >>> planets.flux[[0, -1]].round(3).tolist()
    [[0.014, 1.0], [1.0, 1.0]]
    """
    requests = [spectra] if isinstance(spectra, str | os.PathLike) else list(spectra)
    names: list[str] = []
    rows: list[NDArray[np.float64]] = []
    left_out: list[tuple[str, str]] = []
    for request in requests:
        if request == "flat":
            names.append("flat")
            rows.append(np.ones(len(filters)))
        elif request == "blackbody":
            for temperature in TEMPERATURES:
                names.append(f"black body of {temperature} K")
                frequency = u.Quantity(_SAMPLES, u.m).to(u.Hz, u.spectral())
                flux = native_float64(BlackBody(temperature * u.K)(frequency).value)
                rows.append(_in_filters(_SAMPLES, flux, filters, names[-1]))
        else:
            _add_file(Path(request), filters, names, rows, left_out)
    flux = np.array(rows).reshape(-1, len(filters))
    return PlanetSpectra(
        tuple(names), tuple(filters), flux / flux.max(axis=1, keepdims=True), tuple(left_out)
    )


def _add_file(
    path: Path,
    filters: Sequence[str],
    names: list[str],
    rows: list[NDArray[np.float64]],
    left_out: list[tuple[str, str]],
) -> None:
    """Append the spectra of a file to the names and rows, or to what is left out."""
    wavelength, columns = _read(path)
    before = len(names)
    for name, flux in columns.items():
        usable = np.isfinite(wavelength) & (wavelength > 0) & np.isfinite(flux) & (flux > 0)
        if usable.sum() < 2:
            left_out.append((name, "fewer than two samples are positive numbers"))
            continue
        order = np.argsort(wavelength[usable])
        grid, values = wavelength[usable][order], flux[usable][order]
        try:
            rows.append(_in_filters(grid, values, filters, name))
        except IncompatibleSetupError as error:
            left_out.append((name, str(error)))
            continue
        names.append(name)
    if len(names) == before:
        reasons = "; ".join(f"{name}: {reason}" for name, reason in left_out)
        raise IncompatibleSetupError(
            f"{path}: none of its spectra can be used ({reasons or 'it has a single column'})"
        )


def _in_filters(
    grid: NDArray[np.float64], flux: NDArray[np.float64], filters: Sequence[str], name: str
) -> NDArray[np.float64]:
    return np.array([mean_in_filter(grid, flux, each, name) for each in filters])


def _read(path: Path) -> tuple[NDArray[np.float64], dict[str, NDArray[np.float64]]]:
    """Wavelengths, m, and flux densities per frequency by the name of their column."""
    if not path.is_file():
        raise MissingFileError(
            f'{path}: no such file; expected "blackbody", "flat", "free", or a table of spectra'
        )
    try:
        forms = {".ecsv": "ascii.ecsv", ".fits": "fits", ".csv": "ascii.csv"}
        table = Table.read(path, format=forms.get(path.suffix.lower(), "ascii.commented_header"))
        first = table.columns[0]
        place = u.Quantity(native_float64(first), first.unit or u.micron)
        wavelength = place.to(u.m, u.spectral())
        spectra = {}
        for column in table.columns[1:].values():
            flux = native_float64(column)
            if column.unit is not None:
                flux = _per_frequency(flux * column.unit, wavelength)
            spectra[str(column.name)] = flux
    except (DiffrenderError, FileNotFoundError):
        raise
    except (OSError, ValueError, TypeError, KeyError, IndexError) as error:
        raise CorruptFileError(
            f"{path}: not a table of spectra ({error}). Expected wavelengths in the first column "
            "(micron, or with a unit) and a spectrum in each of the others; in a text file, the "
            "first line has the names after #"
        ) from error
    return native_float64(wavelength.value), spectra


def _per_frequency(flux: u.Quantity, wavelength: u.Quantity) -> NDArray[np.float64]:
    """Flux density, or surface brightness of the planet, per frequency, up to a constant."""
    per_area = flux.unit.is_equivalent(u.Jy / u.sr) or flux.unit.is_equivalent(
        u.W / (u.m**3 * u.sr)
    )
    flux = flux * u.sr if per_area else flux
    return native_float64(flux.to_value(u.Jy, u.spectral_density(wavelength)))
