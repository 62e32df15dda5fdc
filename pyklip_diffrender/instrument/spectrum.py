"""Spectra of stars and planets in NIRCam's filters: weights of wavelengths, and flux densities."""

from __future__ import annotations

import logging
import os
import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from io import BytesIO
from itertools import takewhile
from pathlib import Path
from typing import Any

import numpy as np
from astropy import constants
from astropy import units as u
from astropy.io import ascii, fits
from astropy.io.votable import parse_single_table
from astropy.modeling.physical_models import BlackBody
from astropy.table import Column, Table
from numpy.typing import ArrayLike, NDArray

from pyklip_diffrender.errors import (
    CorruptFileError,
    DiffrenderError,
    IncompatibleSetupError,
    MissingFileError,
    UnitError,
)
from pyklip_diffrender.io.files import embedded_table, open_fits, read_bytes
from pyklip_diffrender.io.units import native_float64, to_metres, to_number, to_unit, unit_of
from pyklip_diffrender.optics.bandpass import Bandpass

_log = logging.getLogger(__name__)

_Spectrum = tuple[NDArray[np.float64], NDArray[np.float64]]


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


def vega_flux_density(filter: str | None) -> float | None:
    """Flux density of Vega magnitude 0 in a filter, Jy; None if it is not known."""
    table = embedded_table("nircam_vega")
    known = dict(zip(map(str, table["filter"]), map(float, table["flux_density"]), strict=True))
    return known.get((filter or "").upper())


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
    wavelength, throughput = filter_throughput(name)
    # Intervals are between the wavelengths at which the throughput is 1 % of its peak; intervals
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
        temperature = to_number(source, u.K, "source", "positive") * u.K
        radiance = BlackBody(temperature, scale=1 * u.W / (u.m**3 * u.sr))(middle * u.m)
        # The energy of a photon is h c / lambda.
        quanta = radiance * (middle * u.m) / (constants.h * constants.c)
        photons = native_float64(quanta.to_value(1 / (u.s * u.m**3 * u.sr)))
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

_BANDS_M = native_float64([1.235e-6, 1.662e-6, 2.159e-6, 3.3526e-6, 4.6028e-6])
_ZERO_POINTS_JY = native_float64([1594.0, 1024.0, 666.8, 309.54, 171.787])
"""Flux density of magnitude 0 in J, H, Ks, W1 and W2, Jy."""

_END_M = 5.2e-6
"""Wavelength to which the spectrum is continued, m, as the power law from W1 to W2."""


def _dwarf(match: re.Match[str]) -> _Spectrum:
    """Samples of the spectrum of a dwarf from B5 to M9, m and Jy."""
    table = embedded_table("dwarf_colors")
    places = native_float64([_place(each) for each in table["type"]])
    place = _place(match["type"])
    if not places[0] <= place <= places[-1]:
        raise IncompatibleSetupError(
            f"star: got type {match['type']}, expected {table['type'][0]} to {table['type'][-1]}"
        )
    # W1 - W2 is interpolated from K5 to M5, between which the table has no value.
    colours = [native_float64(table[name]) for name in ("j_h", "h_ks", "ks_w1", "w1_w2")]
    j_h, h_ks, ks_w1, w1_w2 = (
        float(np.interp(place, places[np.isfinite(each)], each[np.isfinite(each)]))
        for each in colours
    )
    ks = float(match["magnitude"])
    magnitudes = native_float64([ks + h_ks + j_h, ks + h_ks, ks, ks - ks_w1, ks - ks_w1 - w1_w2])
    flux = _ZERO_POINTS_JY * 10 ** (-0.4 * magnitudes)
    # F = a lambda^slope through W1 and W2.
    slope = np.log(flux[-1] / flux[-2]) / np.log(_BANDS_M[-1] / _BANDS_M[-2])
    end = flux[-1] * (_END_M / _BANDS_M[-1]) ** slope
    return np.append(_BANDS_M, _END_M), np.append(flux, end)


def _place(name: str) -> float:
    """Place of a spectral type such as "G2" in the sequence, where each letter has ten."""
    return 10.0 * "BAFGKM".index(name[0]) + float(name[1:])


# Flux density of a star in a filter, from its spectrum, its photometry or its spectral type.

_LARGEST_SAMPLE_STEP = 1.6
"""Largest step between samples, as a fraction of the wavelength, over which a power law is a fair
continuum of a star. Infrared photometry has points at 2.16, 3.35, 4.60 and 11.6 micron."""

_RANGE_M = (2e-6, 5.2e-6)
"""Wavelengths, m, between which steps must be smaller than `_LARGEST_SAMPLE_STEP`."""


def star_flux_density(star: str | os.PathLike[str], filter: str) -> u.Quantity:
    r"""Flux density of a star in a NIRCam filter, from its spectrum or its spectral type.

    The flux density is the mean over detected photons,
    ``integral(F_nu T dnu / nu) / integral(T dnu / nu)`` with the throughput T of the filter, to
    which the calibration of JWST refers (Gordon et al. 2022, AJ 163, 267).

    Parameters
    ----------
    star : path or str
        File with the spectrum or photometry: a table in text (also CSV, ECSV, CDS and IPAC), FITS
        or VOTable, gzipped or not. Units are given with the columns, in their names
        ("flux_mJy") or in comments ("# ANGSTROM FLAM"); without any, they are micron and Jy, and a
        warning is logged. Columns of errors are left out.
        Or spectral type of a dwarf (B5 to M9) and its 2MASS Ks magnitude, such as "A2V, K=6.77".
        From the type, the flux is good to about 5 %.
    filter : str
        Filter, such as "F444W".

    Returns
    -------
    Quantity
        Jy, for ``reduce(star_flux=...)``.

    Raises
    ------
    IncompatibleSetupError
        For an unknown filter, a spectrum that does not cover it, columns or units that are
        ambiguous, and numbers that cannot be true.
    CorruptFileError
        If the file cannot be read.
    FileNotFoundError
        If there is no such file.

    Examples
    --------
    The spectrum of a file:

    >>> from pathlib import Path
    >>> from tempfile import TemporaryDirectory
    >>> import pyklip_diffrender as dr
    >>> with TemporaryDirectory() as folder:
    ...     path = Path(folder, "star.txt")
    ...     _ = path.write_text("# um Jy\n3.0 0.9\n4.0 0.5\n5.0 0.3\n6.0 0.2\n")
    ...     print(dr.instrument.star_flux_density(path, "F444W").round(3))
    0.411 Jy

    A2V with the K magnitude of HIP 65426:

    >>> print(dr.instrument.star_flux_density("A2V, K=6.77", "F444W").round(3))
    0.378 Jy
    """
    dwarf = _DESCRIPTION.fullmatch(str(star))
    grid, flux = read_spectrum(star) if dwarf is None else _dwarf(dwarf)
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
    """Read the spectrum of a star: wavelengths, m, increasing, and flux densities, Jy.

    See `star_flux_density` for the files. Among several columns without errors, the flux density
    is the column called "flux", or the only column with such a unit. Samples at one wavelength are
    averaged by their median.

    MissingFileError if there is no such file, CorruptFileError if it is no table or has no positive
    flux, IncompatibleSetupError if columns or units are ambiguous or cannot be true, or if samples
    between 2 and 5.2 micron are too far apart for interpolation.
    """
    path = Path(path)
    axis, others = _columns(
        path,
        "a star's spectrum or photometry, or a spectral type and a K magnitude such as "
        '"A2V, K=6.77"',
    )
    possible = [each for each in others if each.unit is None or _is(each.unit, _DENSITIES)]
    named = [each for each in possible if re.match(r"(?i)(sed_)?flux(?![a-z])", each.name)]
    with_unit = [each for each in possible if each.unit is not None]
    level = next((group[0] for group in (named, possible, with_unit) if len(group) == 1), None)
    if level is None or (axis.unit is None) != (level.unit is None):
        expected = "one column of flux densities" if level is None else "units of both, or of none"
        raise _unclear(path, [axis, *others], expected)
    if level.unit is None:
        _log.warning("%s has no units; micron and Jy are assumed", path)
    wavelength, flux = _samples(path, axis, level)
    require_star(np.interp(_REFERENCE_WAVELENGTH_M, wavelength, flux), f"{path}: {level.name}")
    used = (wavelength[1:] > _RANGE_M[0]) & (wavelength[:-1] < _RANGE_M[1])
    step = np.where(used, np.diff(wavelength) / wavelength[:-1], 0.0)
    if step.max() > _LARGEST_SAMPLE_STEP:
        before, after = 1e6 * wavelength[step.argmax() : step.argmax() + 2]
        raise IncompatibleSetupError(
            f"{path}: no sample between {before:.2f} and {after:.2f} micron, expected steps of at "
            f"most {100 * _LARGEST_SAMPLE_STEP:.0f} % of the wavelength"
        )
    return wavelength, flux


def require_star(jansky: float, name: str) -> None:
    """Raise IncompatibleSetupError for a flux density, Jy, that no star has in the filters."""
    others = ("uJy", "W / (m2 um)", "erg / (s cm2 Angstrom)", "erg / (s cm2 Hz)")
    _require_overlap((jansky, jansky), _STAR_FLUX_RANGE_JY, "Jy", others, name)


def _require_overlap(
    found: tuple[float, float],
    expected: tuple[float, float],
    unit: str,
    others: Sequence[str],
    name: str,
) -> None:
    """Raise IncompatibleSetupError for numbers out of a range, with units that may be meant."""
    equivalences = u.spectral() + u.spectral_density(_REFERENCE_WAVELENGTH_M * u.m)

    def overlaps(other: str) -> bool:
        low, high = (found * u.Unit(other)).to_value(unit, equivalences)
        return bool(low <= expected[1] and high >= expected[0])

    if not overlaps(unit):
        meant = " or ".join(filter(overlaps, others))
        raise IncompatibleSetupError(
            f"{name}: got {' to '.join(dict.fromkeys(map('{:.4g}'.format, found)))} {unit}, "
            f"expected {expected[0]:g} to {expected[1]:g} {unit}. "
            + (f"In {meant} it would be plausible" if meant else "Check its unit")
        )


# Tables of spectra, whose units are written in many places.

_STAR_FLUX_RANGE_JY = (1e-6, 1e5)
"""Flux densities of stars from 2 to 5.2 micron, Jy: the brightest is R Doradus with 3e4 Jy, and
1e-6 Jy is the AB magnitude 24."""

_REFERENCE_WAVELENGTH_M = 3.2e-6
"""Wavelength in the middle of the filters, m."""

_AXES = ("length", "frequency", "wavenumber")
_DENSITIES = (
    "spectral flux density", "spectral flux density wav",
    "photon flux density", "photon flux density wav",
)  # fmt: skip
_BRIGHTNESSES = ("surface brightness", "surface brightness wav")
"""Physical types of units."""

_IS_AXIS = re.compile(r"(?i)(sed_)?(wave|freq|(w|wl|wvl|lam|lambda|nu)(?![a-z]))")
"""Beginning of the name of a column of wavelengths or frequencies."""

_IS_ERROR = re.compile(
    r"(?i)(^|[^a-z]|flux|stat|sys)(err|errors?|unc|uncertaint(y|ies)|sigma|std|rms|noise|snr)"
    r"($|[^a-z])|^[ed]_|^(sed_)?[ed](f|flux)($|[^a-z])"
)
"""Part of the name, the description or the UCD of a column of errors."""

_COLUMN_NAME = re.compile(r"[^\s,;|()\[\]]+(?:\s*(?:\((?:[^()]|\([^()]*\))*\)|\[[^\]]*\]))?")
"""Name of a column in a comment, with the unit in brackets."""


def _is(unit: u.UnitBase | None, kinds: Sequence[str]) -> bool:
    return unit is not None and any(unit.physical_type == kind for kind in kinds)


def _unclear(path: Path, columns: Sequence[Column], expected: str) -> IncompatibleSetupError:
    listed = ", ".join(f"{each.name} ({each.unit or 'no unit'})" for each in columns)
    return IncompatibleSetupError(
        f"{path}: got the columns {listed or 'without numbers'}; expected {expected}. Name the "
        'columns with their units, as a text does that begins with "# wave_um flux_mJy"'
    )


def _columns(path: Path, expected: str) -> tuple[Column, list[Column]]:
    """Wavelengths or frequencies, and the other columns of numbers, without errors.

    The unit of a column is None if the file does not say it.
    """
    if not path.is_file():
        raise MissingFileError(f"{path}: no such file; expected {expected}")
    try:
        with warnings.catch_warnings():
            # Warnings of units, which are judged here, and of deviations from VOTable's standard.
            warnings.simplefilter("ignore")
            table, comments = _table(path)
            if not len(table):
                raise ValueError("it has no rows")
            columns = [
                Column(native_float64(each), each.info.name, unit=_unit_of(each))
                for each in table.columns.values()
                if each.dtype.kind in "fiu" and each.ndim == 1 and not _is_error(each)
            ]
            mentioned = [_unit_in(name) for line in comments for name in _COLUMN_NAME.findall(line)]
    except UnitError as error:
        raise IncompatibleSetupError(f"{path}: {error}") from error
    except DiffrenderError:
        raise
    except (OSError, EOFError, ValueError, TypeError, KeyError, IndexError) as error:
        reason = (
            "" if isinstance(error, ascii.InconsistentTableError | IndexError) else f" ({error})"
        )
        raise CorruptFileError(
            f"{path}: not a table of numbers{reason}; expected wavelengths and flux densities in "
            "columns of text, with # before each comment, of FITS or of a VOTable"
        ) from error
    named = [each for each in columns if _IS_AXIS.match(each.name)]
    spectral = [each for each in columns if _is(each.unit, _AXES)]
    first = [each for each in columns[:1] if each.unit is None]
    group = next((each for each in (named, spectral, first) if each), [])
    if len(group) != 1:
        raise _unclear(path, columns, "one column of wavelengths")
    axis = group[0]
    for each in columns:
        kinds = _AXES if each is axis else (*_DENSITIES, *_BRIGHTNESSES)
        units = [unit for unit in mentioned if _is(unit, kinds)]
        if each.unit is None and units:
            if any(unit != units[0] for unit in units):
                listed = ", ".join(map(str, units))
                raise _unclear(path, columns, f"one such unit in the comments, not {listed}")
            each.unit = units[0]
    if axis.unit is None:
        if re.match(r"(?i)(sed_)?(freq|nu)", axis.name):
            raise _unclear(path, columns, "a unit of frequencies")
        _require_overlap(
            (np.nanmin(axis), np.nanmax(axis)), (1e6 * _RANGE_M[0], 1e6 * _RANGE_M[1]), "micron",
            ("Angstrom", "nm", "m"), f"{path}: {axis.name}, which has no unit",
        )  # fmt: skip
    return axis, [each for each in columns if each is not axis]


def _table(path: Path) -> tuple[Table, list[str]]:
    """Table of a file, whose kind its content tells, and the comments above it."""
    content = read_bytes(path)
    if content.startswith(b"SIMPLE"):
        with open_fits(path) as hdus:
            tables = [hdu for hdu in hdus if isinstance(hdu, fits.BinTableHDU | fits.TableHDU)]
            if not tables:
                raise ValueError("the FITS file has no table")
            table = Table.read(tables[0])
            if table.colnames == ["WAVELENGTH", "target"]:
                # lineplot_target.fits of the JWST ETC has a unit of wavelengths only.
                table["target"].unit = "mJy"
            return table, []
    if b"<VOTABLE" in content[:4096]:
        return parse_single_table(BytesIO(content)).to_table(use_names_over_ids=True), []
    lines = content.decode("utf-8-sig").splitlines()
    if lines and lines[0].startswith("# %ECSV"):
        return ascii.read(lines, format="ecsv"), []
    above = list(takewhile(lambda line: not line.strip() or line.lstrip().startswith("#"), lines))
    table = ascii.read(lines[len(above) :])
    comments = [line.strip("# \t") for line in above]
    if table.colnames[0] == "col1":
        for line in comments:
            names = _COLUMN_NAME.findall(line)
            if (
                len(names) == len(table.columns)
                and any(_IS_AXIS.match(each) or _is(_unit_in(each), _AXES) for each in names)
                and not re.search("[:=]", line)
            ):
                table.rename_columns(table.colnames, names)
                return table, [each for each in comments if each != line]
    return table, comments


def _is_error(column: Any) -> bool:
    texts = (column.info.name, column.info.description, column.info.meta)
    return any(_IS_ERROR.search(str(each or "")) for each in texts)


def _unit_of(column: Any) -> u.UnitBase | None:
    own = str(column.unit or "")
    return (unit_of(own) or u.UnrecognizedUnit(own)) if own else _unit_in(column.info.name)


def _unit_in(name: str) -> u.UnitBase | None:
    """Unit in the name of a column, or in a word of a comment."""
    if re.match(r"(?i)log(10)?[_( ]", name):
        return u.UnrecognizedUnit("logarithm")
    bracket = re.search(r"[\[(](.+)[\])]$", name)
    starts = [0, *(each.end() for each in re.finditer(r"[\s_/]+", name))]
    for text in [name, bracket[1]] if bracket else [name[start:] for start in starts]:
        # A letter is a unit only of wavelengths: "flux_A" may be the flux of star A.
        unit = unit_of(text) if bracket or len(text) > 1 or _IS_AXIS.match(name) else None
        # Parsecs are no unit of wavelengths.
        far = unit is not None and unit.is_equivalent(u.m) and unit > u.m
        if _is(unit, (*_AXES, *_DENSITIES, *_BRIGHTNESSES)) and not far:
            return unit
    if bracket:
        return u.UnrecognizedUnit(bracket[1])
    return u.mag if re.search(r"(?i)mag(nitude)?s?(?![a-z])", name) else None


def _samples(path: Path, axis: Column, level: Column) -> _Spectrum:
    """Wavelengths, m, increasing, and flux densities, Jy, or Jy/sr for surface brightnesses."""
    x, y = native_float64(axis), native_float64(level)
    usable = np.isfinite(x) & np.isfinite(y) & (x > 0)
    wavelength = (x[usable] * (axis.unit or u.micron)).to(u.m, u.spectral())
    # Shifted, not multiplied, because units of magnitudes take no product.
    unit = level.unit or u.Jy
    levels = y[usable] << (unit * u.sr if _is(unit, _BRIGHTNESSES) else unit)
    flux = native_float64(levels.to_value(u.Jy, u.spectral_density(wavelength)))
    usable = np.isfinite(flux) & (flux > 0)
    if usable.sum() < 2:
        raise CorruptFileError(
            f"{path}: {int(usable.sum())} of {len(y)} samples of {level.name} are positive "
            "numbers, expected at least two"
        )
    order = np.argsort(wavelength.value[usable], kind="stable")
    flux = flux[usable][order]
    grid, first = np.unique(wavelength.value[usable][order], return_index=True)
    if len(grid) < len(flux):
        flux = native_float64([np.median(each) for each in np.split(flux, first[1:])])
    return grid, flux


# Spectra of planets in the filters of a search: black bodies, model atmospheres, a flat one.

TEMPERATURES = (150, 175, 200, 250, 300, 350, 400, 500, 600, 750, 900, 1200, 1500)
"""Temperatures of black bodies, K. Neighbours differ so little that a search of F356W and F444W of
equal depth loses at most 0.2 % of the S/N of a planet between them."""

_SAMPLES_M = np.geomspace(0.5e-6, 8e-6, 2001)
"""Wavelengths of black bodies, m, which include every filter's."""


@dataclass(frozen=True)
class PlanetSpectra:
    """Flux densities of planets in several filters."""

    names: tuple[str, ...]  # names of the spectra
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
        wavelengths), or the file of a table, as `star_flux_density` reads it. Every column of flux
        densities, or of surface brightnesses, is a spectrum with the name of the column. Without
        units, wavelengths are in micron and spectra per frequency. Only their shape matters.
    filters : sequence of str
        Filters, such as "F444W".

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
    rows: list[tuple[str, list[float]]] = []
    left_out: list[tuple[str, str]] = []
    for request in requests:
        if request == "flat":
            rows.append(("flat", [1.0] * len(filters)))
        elif request == "blackbody":
            frequency = u.Quantity(_SAMPLES_M, u.m).to(u.Hz, u.spectral())
            for temperature in TEMPERATURES:
                name = f"black body of {temperature} K"
                flux = native_float64(BlackBody(temperature * u.K)(frequency).value)
                means = [mean_in_filter(_SAMPLES_M, flux, each, name) for each in filters]
                rows.append((name, means))
        else:
            found, lost = _spectra_in_file(Path(request), filters)
            rows += found
            left_out += lost
    flux = np.array([row for _, row in rows]).reshape(-1, len(filters))
    names = tuple(name for name, _ in rows)
    largest = flux.max(axis=1, keepdims=True)
    return PlanetSpectra(names, tuple(filters), flux / largest, tuple(left_out))


def _spectra_in_file(
    path: Path, filters: Sequence[str]
) -> tuple[list[tuple[str, list[float]]], list[tuple[str, str]]]:
    """Names of the spectra and their means in filters; names of what is left out, and why."""
    axis, columns = _columns(path, '"blackbody", "flat", "free", or a table of spectra')
    units = [each.unit for each in columns if each.unit is not None]
    rows, left_out = [], []
    for each in columns:
        try:
            if units and not _is(each.unit, (*_DENSITIES, *_BRIGHTNESSES)):
                raise _unclear(path, [each], "flux densities")
            grid, flux = _samples(path, axis, each)
            means = [mean_in_filter(grid, flux, name, each.name) for name in filters]
            rows.append((each.name, means))
        except (CorruptFileError, IncompatibleSetupError) as error:
            left_out.append((each.name, str(error)))
    if not rows:
        reasons = "; ".join(f"{name}: {reason}" for name, reason in left_out)
        raise IncompatibleSetupError(
            f"{path}: none of its spectra can be used ({reasons or 'it has a single column'})"
        )
    return rows, left_out
