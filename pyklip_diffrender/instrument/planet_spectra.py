"""Spectra of planets in the filters of a search: black bodies, model atmospheres, a flat one."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from astropy import units as u
from astropy.modeling.physical_models import BlackBody
from astropy.table import Table
from numpy.typing import NDArray

from pyklip_diffrender.errors import (
    CorruptFileError,
    DiffrenderError,
    IncompatibleSetupError,
    MissingFileError,
)
from pyklip_diffrender.instrument.star_flux import mean_in_filter
from pyklip_diffrender.io.units import native_float64

__all__ = ["TEMPERATURES", "PlanetSpectra", "planet_spectra"]

TEMPERATURES = (150, 175, 200, 250, 300, 350, 400, 500, 600, 750, 900, 1200, 1500)
"""Temperatures of black bodies, K. Neighbours differ so little that a search of F356W and F444W of
equal depth loses at most 0.2 % of the S/N of a planet between them."""

_SAMPLES = np.geomspace(0.5e-6, 8e-6, 2001)
"""Wavelengths of black bodies, m, which include those of every filter."""


@dataclass(frozen=True)
class PlanetSpectra:
    """Flux densities of planets in several filters.

    Attributes
    ----------
    names : tuple of str
        Of the spectra.
    filters : tuple of str
    flux : ndarray, (spectra, filters)
        Mean flux density per frequency over the photons that the filter detects, 1 in the filter
        where it is largest.
    left_out : tuple of (str, str)
        Spectra of a file that do not cover a filter or have no light in it, and why.
    """

    names: tuple[str, ...]
    filters: tuple[str, ...]
    flux: NDArray[np.float64]
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
    >>> from pyklip_diffrender.instrument.planet_spectra import planet_spectra
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
